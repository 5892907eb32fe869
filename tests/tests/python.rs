//! The Python client, installed into virtual environments under the target directory, against the real programs:
//! its whole suite, for the native and the pure client, with the newest dependencies and with the oldest that it promises
//! to work with.
//!
//! Needs Python 3.10 or later with `venv` (`PYTHON` names another than `python3`) and, for the first run, a package
//! index. An environment is made anew when the requirements change; runs that share a target directory take turns. The
//! wheel with the native client is built once, unoptimised, with what cargo has built already.

use mazeway_tests::programs::program;
use prost::Message as _;
use std::{
    env, fs,
    fs::File,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::LazyLock,
    thread,
    time::{Duration, Instant},
};

/// Longest time for one command: far beyond what it takes, for a hang must end in a message.
const PATIENCE: Duration = Duration::from_mins(20);

#[test]
fn shipped_descriptor_set_is_current() {
    let mut files =
        prost_types::FileDescriptorSet::decode(mazeway_proto::FILE_DESCRIPTOR_SET).expect("a descriptor set");
    for file in &mut files.file {
        file.source_code_info = None;
    }
    let shipped = fs::read(package().join("src/mazeway/_wire/mazeway.desc")).expect("the shipped descriptor set");
    assert!(
        files.encode_to_vec() == shipped,
        "the Python package ships an outdated descriptor set: cargo run -p mazeway-proto --example write_descriptors"
    );
}

#[test]
fn suite_passes_with_the_newest_dependencies() {
    let python = Venv::new("newest", None);
    python.run("ruff", &["check", "."]);
    python.run("ruff", &["format", "--check", "."]);
    let said = python.run("pytest", &["-p", "no:cacheprovider"]);
    assert!(!said.contains(" skipped"), "tests were skipped:\n{said}");
}

#[test]
fn suite_passes_with_the_oldest_dependencies() {
    let python = Venv::new("oldest", Some("tests/constraints-oldest.txt"));
    let said = python.run("pytest", &["-p", "no:cacheprovider"]);
    let unexpected = said.lines().find(|line| line.starts_with("SKIPPED") && !line.contains("Gymnasium 1.0"));
    assert!(unexpected.is_none(), "tests were skipped without a reason to:\n{said}");
}

#[test]
fn package_builds_and_runs_without_a_compiler() {
    let python = Venv::new("newest", None);
    let wheel = build_wheel(&python, "pure", &[("MAZEWAY_PURE", "1")]);
    let name = wheel.file_name().expect("a name").to_string_lossy().into_owned();
    assert!(name.ends_with("-py3-none-any.whl"), "{name}");
    let code = "import sys; sys.path.insert(0, sys.argv[1]); import mazeway; from mazeway import _transport; \
        assert sys.argv[1] in mazeway.__file__, mazeway.__file__; assert not _transport.has_native(); \
        print(mazeway.Client('127.0.0.1:1')._transport)";
    let said = python.python(&["-c", code, wheel.to_str().expect("a path in UTF-8")], &[]);
    assert!(said.contains("GrpcTransport"), "{said}");
}

/// The wheel with the native client, as every test installs it.
static WHEEL: LazyLock<PathBuf> = LazyLock::new(|| {
    let python = Venv::bare("build", None);
    // The profile is the tests' own, so that the libraries need not be built again.
    build_wheel(&python, "native", &[("MATURIN_PEP517_ARGS", "--profile dev --locked")])
});

/// Builds a wheel into a directory of its own.
fn build_wheel(python: &Venv, name: &str, environment: &[(&str, &str)]) -> PathBuf {
    let directory = python.directory.with_file_name(format!("wheel-{name}"));
    if directory.exists() {
        fs::remove_dir_all(&directory).expect("an outdated wheel that can be removed");
    }
    let into = directory.to_str().expect("a path in UTF-8");
    python.python(
        &["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", into, "."],
        environment,
    );
    let mut wheels = fs::read_dir(&directory).expect("a directory").map(|entry| entry.expect("an entry").path());
    wheels.next().expect("a wheel")
}

/// Directory of the Python package.
fn package() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../clients/python").canonicalize().expect("clients/python")
}

/// A virtual environment that holds the package and what its tests need, ours alone while this lives.
struct Venv {
    directory: PathBuf,
    _lock: File,
}

impl Venv {
    /// With the package as users get it.
    fn new(name: &str, constraints: Option<&str>) -> Self {
        let wheel = WHEEL.to_str().expect("a path in UTF-8");
        let venv = Self::bare(name, constraints);
        venv.run("pip", &["install", "--quiet", "--no-deps", "--force-reinstall", wheel]);
        venv
    }

    /// With the requirements alone.
    fn bare(name: &str, constraints: Option<&str>) -> Self {
        let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("python");
        fs::create_dir_all(&home).expect("a directory for virtual environments");
        let lock = File::create(home.join(format!("{name}.lock"))).expect("a lock file");
        lock.lock().expect("a lock");
        let venv = Self { directory: home.join(name), _lock: lock };

        let interpreter = env::var("PYTHON").unwrap_or_else(|_| "python3".into());
        let version = "import sys; assert sys.version_info >= (3, 10), sys.version; print(sys.version, sys.executable)";
        let log = home.join(format!("{name}-version.log"));
        let version = finish(Command::new(&interpreter).args(["-c", version]), &log);
        let project = fs::read_to_string(package().join("pyproject.toml")).expect("pyproject.toml");
        let pins = constraints.map(|path| fs::read_to_string(package().join(path)).expect("constraints"));
        let wanted = format!("{version}{project}{}", pins.unwrap_or_default());
        let stamp = venv.directory.join("requirements");
        if fs::read_to_string(&stamp).ok().as_ref() != Some(&wanted) {
            if venv.directory.exists() {
                fs::remove_dir_all(&venv.directory).expect("an outdated environment that can be removed");
            }
            let directory = venv.directory.to_str().expect("a path in UTF-8").to_owned();
            finish(Command::new(&interpreter).args(["-m", "venv", &directory]), &home.join(format!("{name}.log")));
            let mut arguments = vec!["-m", "pip", "install", "--quiet", ".[test]"];
            if let Some(path) = constraints {
                arguments.extend(["--constraint", path]);
            }
            // Brings what the package needs; the package itself is replaced by a wheel.
            venv.python(&arguments, &[("MAZEWAY_PURE", "1")]);
            fs::write(stamp, wanted).expect("a stamp");
        }
        venv
    }

    /// Runs a module of the environment in the package's directory, with the real programs at hand; returns what it
    /// said. Panics with that where it fails.
    fn run(&self, module: &str, arguments: &[&str]) -> String {
        self.python(&[&["-m", module], arguments].concat(), &[])
    }

    fn python(&self, arguments: &[&str], environment: &[(&str, &str)]) -> String {
        let scripts = self.directory.join(if cfg!(windows) { "Scripts" } else { "bin" });
        let mut command = Command::new(scripts.join("python"));
        command.args(arguments).current_dir(package());
        command
            .env("MAZEWAY_BIN_DIR", program("server").parent().expect("a directory"))
            .env("PYTHONDONTWRITEBYTECODE", "1");
        command.env("PIP_DISABLE_PIP_VERSION_CHECK", "1").env("RUFF_NO_CACHE", "true");
        // The environment's own tools come first: the package's build looks for them by name.
        let path = env::var_os("PATH").unwrap_or_default();
        let path = env::join_paths([scripts].into_iter().chain(env::split_paths(&path))).expect("a search path");
        command.env("PATH", path).envs(environment.iter().copied());
        finish(&mut command, &self.directory.with_extension("log"))
    }
}

/// Runs a command with its output in a file; returns that output. Panics with it where the command fails or hangs.
fn finish(command: &mut Command, log: &Path) -> String {
    let output = File::create(log).expect("a log file");
    let errors = output.try_clone().expect("a log file");
    let spawned = command.stdin(Stdio::null()).stdout(output).stderr(errors).spawn();
    let mut child = spawned.unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let began = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().expect("a child to wait for") {
            break Some(status);
        }
        if began.elapsed() > PATIENCE {
            child.kill().expect("a child to kill");
            child.wait().expect("a child to wait for");
            break None;
        }
        thread::sleep(Duration::from_millis(50));
    };
    let said = String::from_utf8_lossy(&fs::read(log).expect("a log file")).into_owned();
    match status {
        Some(status) => assert!(status.success(), "{command:?}: {status}\n{said}"),
        None => panic!("{command:?}: no end after {PATIENCE:?}\n{said}"),
    }
    said
}
