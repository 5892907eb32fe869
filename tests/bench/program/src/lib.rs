//! Builds the programs that tests and benchmarks run, from the present sources and in the profile of who asks. It has no
//! dependencies, so that a benchmark takes a build of what it measures and of nothing else.

use std::{
    env,
    path::{Path, PathBuf},
    process::Command,
};

/// Cargo, as if called from a shell: it sets variables for what it runs that build scripts of dependencies look at, and would
/// build them, and all that stands on them, again and again.
pub fn cargo() -> Command {
    let mut cargo = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    for (name, _) in env::vars_os() {
        let of_package = |name: &str| {
            name == "CARGO_CRATE_NAME"
                || ["CARGO_PKG_", "CARGO_MANIFEST_", "CARGO_BIN_"].iter().any(|start| name.starts_with(start))
        };
        if name.to_str().is_some_and(of_package) {
            cargo.env_remove(name);
        }
    }
    cargo
}

/// The profile whose programs lie in a directory.
///
/// # Panics
/// It is none of cargo's.
pub fn profile(directory: &Path) -> &str {
    match directory.file_name().and_then(|name| name.to_str()).expect("a profile's directory") {
        "debug" => "dev",
        name => name,
    }
}

/// Builds `server` beside the present program, which is one of cargo's binaries, and gives its path.
///
/// # Panics
/// It does not build.
pub fn server() -> PathBuf {
    let own = env::current_exe().expect("a path of this program");
    let directory = own.parent().expect("a profile's directory");
    let mut cargo = cargo();
    cargo.args(["build", "--quiet", "-p", "mazeway-server", "--bin", "server", "--profile", profile(directory)]);
    let status = cargo.current_dir(env!("CARGO_MANIFEST_DIR")).status().expect("cargo");
    assert!(status.success(), "{cargo:?}: {status}");
    directory.join(format!("server{}", env::consts::EXE_SUFFIX))
}
