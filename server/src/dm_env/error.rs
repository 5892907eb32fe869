//! One enum of everything that can be wrong with a request, and one exhaustive map from it to google.rpc statuses.

use crate::{
    batch::BatchError,
    grpc::{CallError, with_details},
    registry::RegistryError,
    sessions::SessionError,
};
use prost::Message as _;
use tonic::Code;

/// A request that is answered with an error.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldError {
    /// As the other face would refuse it.
    #[error(transparent)]
    Call(#[from] CallError),
    /// A request that is no message of the protocol.
    #[error("not a request of this protocol: {0}")]
    Undecodable(String),
    /// A step or a reset without a world.
    #[error("expected a connection that has joined a world: send a join_world request first")]
    NotJoined,
    /// A second world for a connection.
    #[error("the connection has joined a world already: send a leave_world request first")]
    AlreadyJoined,
    /// The end of a world that somebody is in.
    #[error("the connection is in that world: send a leave_world request first")]
    DestroyJoined,
    /// Somebody else is in the world.
    #[error("another connection or call is in the world")]
    Occupied,
    /// The agent in the world did not step, so that it could not be told of the reset.
    #[error("the agent in the world sent no step within {secs} s and so could not be told of the reset")]
    AgentSilent {
        /// How long the request has waited.
        secs: f64,
    },
    /// An option that would change the specs of an agent who is not told.
    #[error("{message}")]
    SpecsWouldChange {
        /// Which, as a path.
        field: String,
        /// What to do instead.
        message: String,
    },
    /// No such property.
    #[error("no property {key:?}: list the properties with an empty key to see what there is")]
    UnknownProperty {
        /// What came.
        key: String,
    },
    /// A property that cannot be used so.
    #[error("property {key:?} cannot be {action}")]
    PropertyDenied {
        /// Which.
        key: String,
        /// `"read"` or `"written"`.
        action: &'static str,
    },
    /// Nothing lies under the property.
    #[error("property {key:?} has nothing under it")]
    NotListable {
        /// Which.
        key: String,
    },
    /// A world that was never given a seed.
    #[error("the world was given no seed")]
    NoSeed,
    /// An extension that this server does not have.
    #[error("no extension {type_url:?}; there is dm_env_rpc.v1.extensions.properties.PropertyRequest")]
    UnknownExtension {
        /// What came, shortened.
        type_url: String,
    },
}

impl From<BatchError> for WorldError {
    fn from(error: BatchError) -> Self {
        Self::Call(error.into())
    }
}

impl From<SessionError> for WorldError {
    fn from(error: SessionError) -> Self {
        match error {
            SessionError::Busy => Self::Occupied,
            other => Self::Call(other.into()),
        }
    }
}

impl From<RegistryError> for WorldError {
    fn from(error: RegistryError) -> Self {
        Self::Call(error.into())
    }
}

impl WorldError {
    /// A field that cannot be read.
    pub fn malformed(field: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Call(CallError::malformed(field, message))
    }

    /// The code of the status.
    pub fn code(&self) -> Code {
        match self {
            Self::Call(error) => error.code(),
            Self::Undecodable(_) | Self::NotListable { .. } => Code::InvalidArgument,
            Self::NotJoined
            | Self::AlreadyJoined
            | Self::DestroyJoined
            | Self::Occupied
            | Self::SpecsWouldChange { .. }
            | Self::NoSeed => Code::FailedPrecondition,
            Self::AgentSilent { .. } => Code::DeadlineExceeded,
            Self::UnknownProperty { .. } => Code::NotFound,
            Self::PropertyDenied { .. } => Code::PermissionDenied,
            Self::UnknownExtension { .. } => Code::Unimplemented,
        }
    }

    /// The field of the request, as a path in the words of this protocol, where one is to blame.
    pub fn field(&self) -> Option<String> {
        match self {
            Self::Call(CallError::Malformed { field, .. }) | Self::SpecsWouldChange { field, .. } => {
                Some(field.clone())
            }
            Self::Call(CallError::Batch(BatchError::ActionOutOfRange { .. } | BatchError::ActionsLength { .. })) => {
                Some("actions[1]".into())
            }
            Self::Call(error) => error.field().map(|field| match field.as_str() {
                "session_id" => "world_name".into(),
                "lease" => "settings.lease_secs".into(),
                "sessions" => "worlds".into(),
                _ => format!("settings.{field}"),
            }),
            Self::DestroyJoined | Self::Occupied | Self::AgentSilent { .. } => Some("world_name".into()),
            Self::UnknownProperty { .. } | Self::PropertyDenied { .. } | Self::NotListable { .. } | Self::NoSeed => {
                Some("key".into())
            }
            Self::UnknownExtension { .. } => Some("extension.type_url".into()),
            Self::Undecodable(_) | Self::NotJoined | Self::AlreadyJoined => None,
        }
    }

    fn text(&self) -> String {
        match self {
            // The field says which option it is.
            Self::Call(CallError::Registry(RegistryError::Option(error))) => error.message.clone(),
            Self::Call(CallError::Session(SessionError::Unknown)) => "no such world".into(),
            Self::Call(CallError::Session(SessionError::Expired)) => "the world's lease has expired".into(),
            other => other.to_string(),
        }
    }

    fn precondition(&self) -> &'static str {
        match self {
            Self::NotJoined => "NOT_JOINED",
            Self::AlreadyJoined | Self::DestroyJoined => "JOINED",
            Self::Occupied => "WORLD_IN_USE",
            Self::SpecsWouldChange { .. } => "SPECS_WOULD_CHANGE",
            Self::NoSeed => "NO_SEED",
            _ => "WRONG_STATE",
        }
    }
}

impl From<WorldError> for tonic_types::Status {
    fn from(error: WorldError) -> Self {
        let (code, field) = (error.code(), error.field());
        let text = error.text();
        let message = field.as_ref().map_or_else(|| text.clone(), |field| format!("{field}: {text}"));
        let status = with_details(code, message, field.unwrap_or_default(), error.precondition());
        // The details of a status are this very message, unless there are none.
        Self::decode(status.details()).ok().filter(|decoded| decoded.code != 0).unwrap_or_else(|| Self {
            code: code.into(),
            message: status.message().to_owned(),
            details: Vec::new(),
        })
    }
}
