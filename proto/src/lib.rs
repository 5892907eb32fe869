//! The wire of Mazeway and nothing else: messages and service stubs generated from the `.proto` files beside this
//! crate, and the descriptor set that reflection and dynamic clients use. Depends on no other member of the workspace.
//!
//! Packed arrays (`bytes` fields) are little-endian, row-major, without padding; the `.proto` comments give each
//! one's element type and shape.

#![allow(clippy::all, clippy::pedantic, reason = "generated code")]

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

pub use mazeway::env::v1 as env;
pub use mazeway::learner::v1 as learner;

/// Serialised `google.protobuf.FileDescriptorSet` of every file, dependencies included.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/mazeway.desc"));
