//! Generates the stubs with protox, a protobuf compiler in pure Rust: no protoc is needed.

use prost::Message as _;
use std::{env, error::Error, fs, path::PathBuf};

const FILES: [&str; 5] = [
    "mazeway/env/v1/space.proto",
    "mazeway/env/v1/model.proto",
    "mazeway/env/v1/environment.proto",
    "mazeway/learner/v1/trajectory.proto",
    "mazeway/learner/v1/learner.proto",
];

/// Another protocol, with a descriptor set of its own: the Python client ships ours alone.
const DM_ENV_RPC_FILES: [&str; 2] = ["dm_env_rpc/v1/dm_env_rpc.proto", "dm_env_rpc/v1/extensions/properties.proto"];

fn main() -> Result<(), Box<dyn Error>> {
    for folder in ["mazeway", "dm_env_rpc", "google"] {
        println!("cargo:rerun-if-changed={folder}");
    }
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let descriptors = protox::compile(FILES, ["."])?;
    fs::write(out.join("mazeway.desc"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure().bytes(".").btree_map(".").compile_fds(descriptors)?;

    let descriptors = protox::compile(DM_ENV_RPC_FILES, ["."])?;
    fs::write(out.join("dm_env_rpc.desc"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure()
        .bytes(".")
        .btree_map(".")
        // The server writes its answers to steps itself, so it has a service of its own.
        .build_server(false)
        .extern_path(".google.rpc.Status", "::tonic_types::Status")
        .compile_fds(descriptors)?;
    Ok(())
}
