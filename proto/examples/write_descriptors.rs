//! Writes the descriptor set that the Python package ships, without the comments of the sources:
//! `cargo run -p mazeway-proto --example write_descriptors [-- PATH]`.

use prost::Message as _;
use std::{env, error::Error, fs, path::PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../clients/python/src/mazeway/_wire/mazeway.desc");
    let path = env::args_os().nth(1).map_or_else(|| PathBuf::from(default), PathBuf::from);
    let mut files = prost_types::FileDescriptorSet::decode(mazeway_proto::FILE_DESCRIPTOR_SET)?;
    for file in &mut files.file {
        file.source_code_info = None;
    }
    let bytes = files.encode_to_vec();
    fs::write(&path, &bytes)?;
    println!("wrote {} bytes to {}", bytes.len(), path.display());
    Ok(())
}
