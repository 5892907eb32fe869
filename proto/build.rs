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

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=mazeway");
    let descriptors = protox::compile(FILES, ["."])?;
    let out = PathBuf::from(env::var("OUT_DIR")?).join("mazeway.desc");
    fs::write(out, descriptors.encode_to_vec())?;
    tonic_prost_build::configure().bytes(".").btree_map(".").compile_fds(descriptors)?;
    Ok(())
}
