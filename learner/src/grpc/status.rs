//! One enum of everything that can be wrong with a call, and one exhaustive map from it to gRPC statuses.

use crate::store::{FieldError, StoreError};
use mazeway_serving::incident;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

/// A call that is answered with a status.
#[derive(Debug, Clone, thiserror::Error)]
pub enum CallError {
    /// A field that does not hold what it should.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// The store refused.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Nothing of this name.
    #[error("there is no {what} {id:?}")]
    NotFound {
        /// Field that names it.
        field: &'static str,
        /// What it would be.
        what: &'static str,
        /// The name.
        id: String,
    },
    /// There is nothing, or not enough, to work on.
    #[error("{message}")]
    Precondition {
        /// What kind of thing is missing, in capitals.
        kind: &'static str,
        /// Field of the request that asks for it.
        field: &'static str,
        /// What was expected and what is there.
        message: String,
    },
    /// A limit of the service.
    #[error("{field}: expected at most {limit} {what}, got {got}")]
    Limit {
        /// Field that exceeds it.
        field: String,
        /// Of what.
        what: &'static str,
        /// The limit.
        limit: u64,
        /// What came.
        got: u64,
    },
    /// All callers together have as much under way as the service takes.
    #[error("{field}: there is no room for more {what} than {limit} of all callers together; try again later")]
    Full {
        /// Field that there is no room for.
        field: &'static str,
        /// Of what.
        what: &'static str,
        /// How much there is room for.
        limit: u64,
    },
    /// The other end of a model's stream sent or read too little in too long.
    #[error("expected the other end of the model's stream to go on within {}, it did not", humantime::format_duration(*.patience))]
    Slow {
        /// How long it was waited for.
        patience: Duration,
    },
    /// The caller went.
    #[error("the caller went before the fit was done")]
    Cancelled,
    /// The service is going down.
    #[error("the service is shutting down")]
    ShuttingDown,
    /// A status of the transport's, passed on.
    #[error("{0}")]
    Transport(Box<Status>),
    /// A defect of ours.
    #[error("internal error: {0}")]
    Internal(String),
}

impl CallError {
    /// A field that does not hold what it should.
    pub fn field(field: impl Into<String>, message: impl Into<String>) -> Self {
        FieldError::new(field, message).into()
    }
}

impl From<Status> for CallError {
    /// An error of reading the caller's stream. tonic calls a message above the limit OUT_OF_RANGE.
    fn from(status: Status) -> Self {
        if status.code() == Code::OutOfRange {
            return Self::Transport(Box::new(Status::resource_exhausted(status.message())));
        }
        Self::Transport(Box::new(status))
    }
}

impl From<CallError> for Status {
    fn from(error: CallError) -> Self {
        let message = told(&error);
        let mut details = ErrorDetails::new();
        let code = match &error {
            CallError::Field(error) => {
                details.add_bad_request_violation(error.field.as_str(), error.message.as_str());
                Code::InvalidArgument
            }
            CallError::NotFound { field, .. } => {
                details.add_bad_request_violation(*field, message.as_str());
                Code::NotFound
            }
            CallError::Precondition { kind, field, .. } => {
                details.add_precondition_failure_violation(*kind, *field, message.as_str());
                Code::FailedPrecondition
            }
            CallError::Limit { field, .. } => {
                details.add_quota_failure_violation(field.as_str(), message.as_str());
                Code::ResourceExhausted
            }
            CallError::Full { field, .. } => {
                details.add_quota_failure_violation(*field, message.as_str());
                Code::ResourceExhausted
            }
            CallError::Slow { .. } => Code::DeadlineExceeded,
            CallError::Store(error) => store_code(error, &message, &mut details),
            CallError::Cancelled => Code::Cancelled,
            CallError::ShuttingDown => Code::Unavailable,
            CallError::Transport(status) => return (**status).clone(),
            CallError::Internal(_) => Code::Internal,
        };
        Self::with_error_details(code, message, details)
    }
}

/// What a caller is told of an error: what it did wrong in full, and of what went wrong inside no more than that, and the
/// number under which the log has the rest. Paths and the words of the operating system stay here.
fn told(error: &CallError) -> String {
    let kept = match error {
        CallError::Store(StoreError::DiskFull { .. }) => "the disk that holds the store is full",
        CallError::Store(StoreError::Busy { .. }) => "the store is locked by another process",
        CallError::Store(
            StoreError::Directory { .. }
            | StoreError::NewerSchema { .. }
            | StoreError::Foreign { .. }
            | StoreError::Database { .. },
        ) => "the store failed",
        CallError::Internal(_) => "internal error",
        // What the store holds is of all callers: none is told how much the others have.
        CallError::Store(StoreError::QuotaReached { limit, .. }) => {
            return format!(
                "the store has no room for this: it may hold {limit} bytes; delete recordings, or raise the limit"
            );
        }
        CallError::Store(StoreError::Corrupt { .. }) => {
            tracing::error!(%error, "a call failed through no fault of its caller");
            return error.to_string();
        }
        _ => return error.to_string(),
    };
    let incident = incident();
    tracing::error!(%error, incident, "a call failed through no fault of its caller");
    format!("{kept}; the service's log has more under incident {incident}")
}

fn store_code(error: &StoreError, message: &str, details: &mut ErrorDetails) -> Code {
    match error {
        StoreError::TrajectoryExists { index, .. } => {
            details.add_bad_request_violation(format!("trajectories[{index}].trajectory_id"), message);
            Code::AlreadyExists
        }
        StoreError::ModelExists { .. } => {
            details.add_bad_request_violation("part.header", message);
            Code::AlreadyExists
        }
        StoreError::AmbiguousFit { .. } => {
            details.add_bad_request_violation("fit_id", message);
            Code::InvalidArgument
        }
        StoreError::DiskFull { .. } => {
            details.add_quota_failure_violation("disk", message);
            Code::ResourceExhausted
        }
        StoreError::QuotaReached { .. } => {
            details.add_quota_failure_violation("max_store_bytes", message);
            Code::ResourceExhausted
        }
        StoreError::AllowanceSpent { .. } => {
            details.add_quota_failure_violation("max_recorded_bytes", message);
            Code::ResourceExhausted
        }
        StoreError::Busy { .. } | StoreError::Closed => Code::Unavailable,
        StoreError::Corrupt { .. } => Code::DataLoss,
        StoreError::Directory { .. }
        | StoreError::NewerSchema { .. }
        | StoreError::Foreign { .. }
        | StoreError::Database { .. } => Code::Internal,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{io, path::Path};

    #[test]
    fn a_caller_learns_nothing_of_the_machine() {
        let path = || Path::new("/srv/secret/place").to_path_buf();
        let message = || "/srv/secret/place: permission denied".to_owned();
        let inside = [
            StoreError::Directory { path: path(), message: message(), kind: io::ErrorKind::PermissionDenied }.into(),
            StoreError::NewerSchema { path: path(), found: 9, supported: 1 }.into(),
            StoreError::Foreign { path: path(), found: 9 }.into(),
            StoreError::DiskFull { path: path() }.into(),
            StoreError::Busy { path: path() }.into(),
            StoreError::Database { path: path(), message: message() }.into(),
            CallError::Internal(message()),
        ];
        for error in inside {
            let status = Status::from(error);
            assert!(!status.message().contains("secret") && status.message().contains(" incident "), "{status}");
            let details = String::from_utf8_lossy(status.details()).into_owned();
            assert!(!details.contains("secret"), "{details}");
        }
    }
    #[test]
    fn a_caller_learns_a_limit_and_not_what_others_have_of_it() {
        let status = Status::from(CallError::from(StoreError::QuotaReached { limit: 1000, used: 777 }));
        assert_eq!(status.code(), Code::ResourceExhausted);
        let details = String::from_utf8_lossy(status.details()).into_owned();
        assert!(status.message().contains("1000") && details.contains("1000"), "{status}");
        assert!(!status.message().contains("777") && !details.contains("777"), "{status}");
    }
}
