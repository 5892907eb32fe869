//! One enum of everything that can be wrong with a call, and one exhaustive map from it to gRPC statuses.

use crate::{batch::BatchError, registry::RegistryError, rollout::RolloutError, sessions::SessionError};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

/// A call that is answered with a status.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CallError {
    /// A field that cannot be read.
    #[error("{message}")]
    Malformed {
        /// Which, as a path.
        field: String,
        /// What was expected and what came.
        message: String,
    },
    /// No such environment, or a wrong option.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// A session that cannot be had.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A refused call on a batch.
    #[error(transparent)]
    Batch(#[from] BatchError),
    /// A refused roll-out.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// A limit of the server.
    #[error("expected at most {limit} {what}, asked for {asked}")]
    Limit {
        /// Field of the request that asks for it.
        field: &'static str,
        /// Of what.
        what: &'static str,
        /// The limit.
        limit: u64,
        /// What was asked for.
        asked: u64,
    },
    /// The server is going down.
    #[error("the server is shutting down")]
    ShuttingDown,
    /// A defect of ours.
    #[error("internal error: {0}")]
    Internal(String),
}

impl CallError {
    /// A field that cannot be read.
    pub fn malformed(field: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Malformed { field: field.into(), message: message.into() }
    }

    /// The code of the status.
    pub fn code(&self) -> Code {
        match self {
            Self::Malformed { .. } | Self::Rollout(_) => Code::InvalidArgument,
            Self::Registry(error) => match error {
                RegistryError::UnknownEnvironment { .. } => Code::NotFound,
                RegistryError::Option(_) => Code::InvalidArgument,
            },
            Self::Session(error) => match error {
                SessionError::Unknown => Code::NotFound,
                SessionError::Expired => Code::DeadlineExceeded,
                SessionError::Busy => Code::FailedPrecondition,
                SessionError::Limit { .. } => Code::ResourceExhausted,
                SessionError::Lease { .. } => Code::InvalidArgument,
                SessionError::Entropy(_) => Code::Unavailable,
            },
            Self::Batch(error) => match error {
                BatchError::ActionsLength { .. }
                | BatchError::ActionOutOfRange { .. }
                | BatchError::SeedsLength { .. }
                | BatchError::MaskLength { .. }
                | BatchError::MaskValue { .. }
                | BatchError::IndexOutOfRange { .. } => Code::InvalidArgument,
                BatchError::MaskLeavesUnborn { .. } | BatchError::NeverReset | BatchError::EpisodeEnded { .. } => {
                    Code::FailedPrecondition
                }
                BatchError::Entropy(_) => Code::Unavailable,
            },
            Self::Limit { .. } => Code::ResourceExhausted,
            Self::ShuttingDown => Code::Unavailable,
            Self::Internal(_) => Code::Internal,
        }
    }

    /// The field of the request, as a path, where one is to blame.
    pub fn field(&self) -> Option<String> {
        match self {
            Self::Malformed { field, .. } => Some(field.clone()),
            Self::Registry(RegistryError::UnknownEnvironment { .. }) => Some("env_id".into()),
            Self::Registry(RegistryError::Option(error)) => Some(format!("options.{}", error.field)),
            Self::Session(error) => match error {
                SessionError::Unknown | SessionError::Expired | SessionError::Busy => Some("session_id".into()),
                SessionError::Limit { field, .. } => Some((*field).into()),
                SessionError::Lease { .. } => Some("lease".into()),
                SessionError::Entropy(_) => None,
            },
            Self::Batch(error) => error.field(),
            Self::Rollout(error) => Some(error.field()),
            Self::Limit { field, .. } => Some((*field).into()),
            Self::ShuttingDown | Self::Internal(_) => None,
        }
    }

    /// What kind of state stands in the way of a call that would be right in another one.
    fn precondition(&self) -> &'static str {
        match self {
            Self::Session(SessionError::Busy) => "SESSION_IN_USE",
            Self::Batch(BatchError::EpisodeEnded { .. }) => "EPISODE_ENDED",
            _ => "NOT_RESET",
        }
    }
}

impl From<CallError> for Status {
    fn from(error: CallError) -> Self {
        with_details(error.code(), error.to_string(), error.field().unwrap_or_default(), error.precondition())
    }
}

/// Longest message of a status, in bytes: with its details it must fit into the headers of a response.
const MAX_MESSAGE_BYTES: usize = 1000;
/// Longest path of a field in the details of a status, in bytes.
const MAX_FIELD_BYTES: usize = 300;

fn clipped(text: String, most: usize) -> String {
    if text.len() <= most {
        return text;
    }
    let end = (0..=most).rev().find(|&end| text.is_char_boundary(end)).unwrap_or_default();
    format!("{}… ({} bytes)", &text[..end], text.len())
}

/// A status whose details name the field that is to blame, as every error of this server has them. However much of a
/// request an error repeats, the status stays small enough to be sent.
pub fn with_details(code: Code, message: String, field: String, precondition: &str) -> Status {
    let (message, field) = (clipped(message, MAX_MESSAGE_BYTES), clipped(field, MAX_FIELD_BYTES));
    let mut details = ErrorDetails::new();
    match code {
        Code::FailedPrecondition => {
            details.add_precondition_failure_violation(precondition, field, message.as_str());
        }
        Code::ResourceExhausted => {
            details.add_quota_failure_violation(field, message.as_str());
        }
        Code::Internal => {
            let incident = mazeway_serving::incident();
            tracing::error!(%message, incident, "a call failed through no fault of its caller");
            return Status::new(code, format!("internal error; the server's log has more under incident {incident}"));
        }
        Code::Unavailable => return Status::new(code, message),
        _ => {
            details.add_bad_request_violation(field, message.as_str());
        }
    }
    Status::with_error_details(code, message, details)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caller_learns_nothing_of_the_machine() {
        let status = Status::from(CallError::Internal("task 7 panicked at /srv/secret/place".into()));
        assert_eq!(status.code(), Code::Internal);
        assert!(!status.message().contains("secret") && status.message().contains(" incident "), "{status}");
        assert!(status.details().is_empty());
    }
}
