//! What goes wrong, as three exceptions that Python translates: the same words for both clients are made there.

use crate::driver::Stopped;
use mazeway_client::{ClientError, Code};
use pyo3::{PyErr, create_exception, exceptions::PyException};
use std::error::Error as _;
use tonic::Status;
use tonic_types::StatusExt as _;

create_exception!(
    mazeway._native,
    CallError,
    PyException,
    "A call failed: its status code, its message, and field and description of each violation."
);
create_exception!(mazeway._native, LateError, PyException, "The answer did not come within the timeout.");
create_exception!(
    mazeway._native,
    ForeignProcessError,
    PyException,
    "The object belongs to the process that this one was forked from."
);

/// How a call failed.
#[derive(Debug)]
pub struct Failure {
    code: Code,
    message: String,
    violations: Vec<(String, String)>,
}

impl Failure {
    /// An answer that is not what the protocol says.
    pub fn protocol(message: impl Into<String>) -> Self {
        Self { code: Code::Internal, message: message.into(), violations: Vec::new() }
    }

    /// More than may wait to be sent.
    pub fn full(most: usize) -> Self {
        let message = format!("expected at most {most} requests that wait to be sent");
        Self { code: Code::ResourceExhausted, message, violations: Vec::new() }
    }

    /// A wrong argument.
    pub fn argument(field: &str, message: String) -> Self {
        Self { code: Code::InvalidArgument, violations: vec![(field.into(), message.clone())], message }
    }
}

impl From<Failure> for PyErr {
    fn from(failure: Failure) -> Self {
        CallError::new_err((failure.code as i32, failure.message, failure.violations))
    }
}

impl From<Status> for Failure {
    fn from(status: Status) -> Self {
        // What the server says has no source; what has one happened to the connection.
        if let Some(mut cause) = status.source() {
            while let Some(deeper) = cause.source() {
                cause = deeper;
            }
            return Self { code: Code::Unavailable, message: cause.to_string(), violations: Vec::new() };
        }
        let details = status.get_error_details();
        let fields = details.bad_request().into_iter().flat_map(|bad| &bad.field_violations);
        let fields = fields.map(|v| (v.field.clone(), v.description.clone()));
        let subjects = details.precondition_failure().into_iter().flat_map(|failure| &failure.violations);
        Self {
            violations: fields.chain(subjects.map(|v| (v.subject.clone(), v.description.clone()))).collect(),
            code: status.code(),
            message: status.message().to_owned(),
        }
    }
}

impl From<ClientError> for Failure {
    fn from(error: ClientError) -> Self {
        let code = error.code();
        match error {
            ClientError::Status { field, message, .. } => {
                let violations = field.into_iter().map(|field| (field, message.clone())).collect();
                Self { code, message, violations }
            }
            ClientError::Connect { message, .. } => Self { code, message, violations: Vec::new() },
            // Unlike a server that is away, it may have done what it was asked.
            ClientError::Interrupted { .. } => {
                Self { code: Code::Aborted, message: error.to_string(), violations: Vec::new() }
            }
            ClientError::Argument { field, message } => Self::argument(field, message),
            ClientError::Address { .. } | ClientError::Late { .. } | ClientError::Protocol(_) => {
                Self { code, message: error.to_string(), violations: Vec::new() }
            }
        }
    }
}

impl From<Stopped> for PyErr {
    fn from(stopped: Stopped) -> Self {
        match stopped {
            Stopped::Late => LateError::new_err(()),
            Stopped::Raised(error) => error,
        }
    }
}
