//! What the workspace is built of: every crate comes from the registry of Rust's community under a licence that goes with
//! ours, and our own crates keep to the workspace's lints, `unsafe_code = "forbid"` among them.
//!
//! Deliberately absent: advisories and yanked releases. Their lists are kept where a build machine without the open Internet
//! does not reach; SECURITY.md says how to ask for them.

use serde_json::Value;
use spdx::{Expression, LicenseItem, ParseMode};
use std::{path::Path, process::Command};

const REGISTRY: &str = "registry+https://github.com/rust-lang/crates.io-index";
/// Licences that ask for no more than to be named and passed on, and one, MPL-2.0, that asks for changes to the crate's own
/// files, of which we make none.
const LICENCES: [&str; 13] = [
    "0BSD",
    "Apache-2.0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "ISC",
    "MIT",
    "MPL-2.0",
    "OFL-1.1",
    "Ubuntu-font-1.0",
    "Unicode-3.0",
    "Zlib",
];

fn metadata() -> Value {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["metadata", "--format-version", "1", "--locked"]).current_dir(env!("CARGO_MANIFEST_DIR"));
    let output = cargo.output().expect("cargo");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("metadata")
}

fn packages(metadata: &Value) -> impl Iterator<Item = (&str, &Value)> {
    let packages = metadata["packages"].as_array().expect("packages").iter();
    packages.map(|package| (package["name"].as_str().expect("a name"), package))
}

/// Whether we may use what is under this expression.
fn is_allowed(expression: &str) -> Result<bool, String> {
    let expression = Expression::parse_mode(expression, ParseMode::LAX).map_err(|error| error.to_string())?;
    Ok(expression.evaluate(|requirement| match &requirement.license {
        LicenseItem::Spdx { id, .. } => LICENCES.contains(&id.name),
        LicenseItem::Other(..) => false,
    }))
}

#[test]
fn every_crate_comes_from_the_registry_under_a_licence_that_goes_with_ours() {
    let metadata = metadata();
    let (mut foreign, mut unlicensed, mut seen) = (Vec::new(), Vec::new(), 0);
    for (name, package) in packages(&metadata).filter(|(_, package)| !package["source"].is_null()) {
        seen += 1;
        if package["source"] != REGISTRY {
            foreign.push(format!("{name}: {}", package["source"]));
        }
        let licence = package["license"].as_str().unwrap_or_default();
        if is_allowed(licence) != Ok(true) {
            unlicensed.push(format!("{name}: {licence:?}"));
        }
    }
    assert!(seen > 100, "{seen} packages");
    assert!(foreign.is_empty() && unlicensed.is_empty(), "{foreign:#?}\n{unlicensed:#?}");
    for wrong in ["GPL-3.0-only", "MIT AND AGPL-3.0-only", "", "Mine"] {
        assert_ne!(is_allowed(wrong), Ok(true), "{wrong}");
    }
}

#[test]
fn our_own_crates_forbid_unsafe_code() {
    let metadata = metadata();
    let root = metadata["workspace_root"].as_str().expect("a path");
    let workspace = std::fs::read_to_string(Path::new(root).join("Cargo.toml")).expect("a manifest");
    assert!(workspace.contains("unsafe_code = \"forbid\""));
    for (name, package) in packages(&metadata).filter(|(_, package)| package["source"].is_null()) {
        let manifest = std::fs::read_to_string(package["manifest_path"].as_str().expect("a path")).expect("a manifest");
        // Generated code is none of ours to lint: that crate forbids what it must itself.
        let own = name == "mazeway-proto" && {
            let library = Path::new(root).join("proto").join("src").join("lib.rs");
            std::fs::read_to_string(library).expect("sources").contains("#![forbid(unsafe_code)]")
        };
        assert!(own || manifest.contains("[lints]\nworkspace = true"), "{name}");
    }
}
