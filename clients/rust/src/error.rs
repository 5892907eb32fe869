//! What can go wrong between a client and a server.

use tonic::{Code, Status};
use tonic_types::StatusExt as _;

/// A call that failed. Keeps the server's status code, the field it blames and its message.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ClientError {
    /// An address that is none.
    #[error("expected an address such as 127.0.0.1:50051, got {address:?}: {message}")]
    Address {
        /// What came.
        address: String,
        /// Why it is none.
        message: String,
    },
    /// Nobody answers there.
    #[error("cannot reach a server at {address}: {message}")]
    Connect {
        /// Where.
        address: String,
        /// Why.
        message: String,
    },
    /// The server refused or failed.
    #[error("{message}")]
    Status {
        /// Its status code.
        code: Code,
        /// The field of the request that it blames, as a path, where it names one.
        field: Option<String>,
        /// What it says.
        message: String,
    },
    /// The connection broke while a request was under way, so that nobody knows whether it was carried out. The session
    /// lives on: the next call takes it up again.
    #[error("the connection broke during a {request}, whose outcome is unknown: {message}")]
    Interrupted {
        /// `"reset"`, `"step"` or `"close"`.
        request: &'static str,
        /// What broke.
        message: String,
    },
    /// No answer within the deadline.
    #[error("no answer within {secs} s")]
    Late {
        /// The deadline.
        secs: f64,
    },
    /// The server's answer is not what the protocol says.
    #[error("the server's answer breaks the protocol: {0}")]
    Protocol(String),
    /// An argument that need not travel to be refused.
    #[error("{field}: {message}")]
    Argument {
        /// Which.
        field: &'static str,
        /// What was expected and what came.
        message: String,
    },
}

impl ClientError {
    /// The status code that this error is, or would be, over the wire.
    pub fn code(&self) -> Code {
        match self {
            Self::Status { code, .. } => *code,
            Self::Address { .. } | Self::Argument { .. } => Code::InvalidArgument,
            Self::Connect { .. } | Self::Interrupted { .. } => Code::Unavailable,
            Self::Late { .. } => Code::DeadlineExceeded,
            Self::Protocol(_) => Code::Internal,
        }
    }

    /// The field that is wrong, as a path such as `"actions[3]"` or `"options.slip"`.
    pub fn field(&self) -> Option<&str> {
        match self {
            Self::Status { field, .. } => field.as_deref(),
            Self::Argument { field, .. } => Some(field),
            _ => None,
        }
    }

    pub(crate) fn protocol(message: impl Into<String>) -> Self {
        Self::Protocol(message.into())
    }
}

/// An error and what is behind it, in one line.
pub(crate) fn causes(error: &dyn std::error::Error) -> String {
    let mut message = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_message = cause.to_string();
        if !message.contains(&cause_message) {
            message = format!("{message}: {cause_message}");
        }
        source = cause.source();
    }
    message
}

/// True where the connection and not the server is to blame.
pub(crate) fn is_broken(status: &Status) -> bool {
    use std::error::Error as _;
    matches!(status.code(), Code::Unavailable | Code::Cancelled)
        || (status.code() == Code::Unknown && status.source().is_some())
        || (status.code() == Code::Internal && status.message().contains("h2 protocol error"))
}

impl From<Status> for ClientError {
    fn from(status: Status) -> Self {
        // What a server says has no source; what has one happened to the connection, whatever code it was given.
        if let Some(mut cause) = std::error::Error::source(&status).filter(|_| is_broken(&status)) {
            while let Some(deeper) = cause.source() {
                cause = deeper;
            }
            return Self::Status { code: Code::Unavailable, field: None, message: cause.to_string() };
        }
        let details = status.get_error_details();
        let bad_request = details.bad_request().and_then(|d| d.field_violations.first()).map(|v| v.field.clone());
        let precondition =
            || details.precondition_failure().and_then(|d| d.violations.first()).map(|v| v.subject.clone());
        let quota = || details.quota_failure().and_then(|d| d.violations.first()).map(|v| v.subject.clone());
        let field = bad_request.or_else(precondition).or_else(quota).filter(|field| !field.is_empty());
        Self::Status { code: status.code(), field, message: status.message().to_owned() }
    }
}
