//! Virtual environments of Python under the target directory, and commands whose output is kept in case they fail.

use std::{
    env, fs,
    fs::File,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

/// Longest time for one command: far beyond what it takes, for a hang must end in a message.
const PATIENCE: Duration = Duration::from_mins(20);

/// A virtual environment with the packages of a requirements file, ours alone while this lives.
#[derive(Debug)]
pub struct Venv {
    directory: PathBuf,
    _lock: File,
}

impl Venv {
    /// Makes it, or takes the one that is there already where the requirements and the interpreter are still the same.
    /// `PYTHON` names another interpreter than `python3`.
    ///
    /// # Panics
    /// There is no Python, or no package index for what is not installed yet.
    pub fn new(name: &str, requirements: &Path) -> Self {
        let home = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/tmp/python");
        fs::create_dir_all(&home).expect("a directory for virtual environments");
        let home = home.canonicalize().expect("the directory just made");
        let lock = File::create(home.join(format!("{name}.lock"))).expect("a lock file");
        lock.lock().expect("a lock");
        let venv = Self { directory: home.join(name), _lock: lock };
        let interpreter = env::var("PYTHON").unwrap_or_else(|_| "python3".into());
        let mut version = Command::new(&interpreter);
        version.args(["-c", "import sys; print(sys.version, sys.executable)"]);
        let version = finish(&mut version, &home.join(format!("{name}.version.log")));
        let wanted = version + &fs::read_to_string(requirements).expect("a requirements file");
        let stamp = venv.directory.join("requirements");
        if fs::read_to_string(&stamp).ok().as_ref() != Some(&wanted) {
            if venv.directory.exists() {
                fs::remove_dir_all(&venv.directory).expect("an outdated environment that can be removed");
            }
            let mut make = Command::new(&interpreter);
            make.args(["-m", "venv"]).arg(&venv.directory);
            finish(&mut make, &home.join(format!("{name}.log")));
            let mut install = venv.module("pip");
            install.args(["install", "--quiet", "--disable-pip-version-check", "--requirement"]).arg(requirements);
            venv.run(&mut install);
            fs::write(stamp, wanted).expect("a stamp");
        }
        venv
    }

    /// A command that runs a module of the environment.
    pub fn module(&self, module: &str) -> Command {
        let scripts = self.directory.join(if cfg!(windows) { "Scripts" } else { "bin" });
        let mut command = Command::new(scripts.join("python"));
        command.arg("-m").arg(module).env("PYTHONDONTWRITEBYTECODE", "1");
        command
    }

    /// Runs a command to its end and returns what it said.
    ///
    /// # Panics
    /// It fails, or hangs.
    pub fn run(&self, command: &mut Command) -> String {
        finish(command, &self.directory.with_extension("log"))
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
        thread::sleep(Duration::from_millis(20));
    };
    let said = String::from_utf8_lossy(&fs::read(log).expect("a log file")).into_owned();
    match status {
        Some(status) => assert!(status.success(), "{command:?}: {status}\n{said}"),
        None => panic!("{command:?}: no end after {PATIENCE:?}\n{said}"),
    }
    said
}
