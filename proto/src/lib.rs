//! The wire of Mazeway and nothing else: messages and service stubs generated from the `.proto` files beside this
//! crate, and the descriptor set that reflection and dynamic clients use. Depends on no other member of the workspace.
//!
//! Packed arrays (`bytes` fields) are little-endian, row-major, without padding; the `.proto` comments give each
//! one's element type and shape.

#![forbid(unsafe_code)]
#![allow(clippy::all, clippy::pedantic, reason = "generated code")]

pub mod raw;

/// Package `mazeway`.
pub mod mazeway {
    /// Package `mazeway.env`.
    pub mod env {
        /// Package `mazeway.env.v1`: environments, sessions, models.
        pub mod v1 {
            tonic::include_proto!("mazeway.env.v1");
        }
    }
    /// Package `mazeway.learner`.
    pub mod learner {
        /// Package `mazeway.learner.v1`: trajectories, models, fits.
        pub mod v1 {
            tonic::include_proto!("mazeway.learner.v1");
        }
    }
}

/// Package `dm_env_rpc`: DeepMind's protocol, which the environment server speaks as well.
pub mod dm_env_rpc {
    /// Package `dm_env_rpc.v1`: worlds, tensors, the stream.
    pub mod v1 {
        tonic::include_proto!("dm_env_rpc.v1");
        /// Package `dm_env_rpc.v1.extensions`.
        pub mod extensions {
            /// Package `dm_env_rpc.v1.extensions.properties`: values beside the stream of steps.
            pub mod properties {
                tonic::include_proto!("dm_env_rpc.v1.extensions.properties");
            }
        }
    }
}

pub use dm_env_rpc::v1 as dm_env;
pub use mazeway::env::v1 as env;
pub use mazeway::learner::v1 as learner;

/// Serialised `google.protobuf.FileDescriptorSet` of every file of `mazeway`, dependencies included.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/mazeway.desc"));
/// Serialised `google.protobuf.FileDescriptorSet` of every file of `dm_env_rpc`, dependencies included.
pub const DM_ENV_RPC_FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/dm_env_rpc.desc"));
