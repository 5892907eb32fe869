//! The programs beside the load, as processes, and what can be seen of the server from outside.

use std::{
    fs,
    io::{self, BufRead as _, BufReader, Lines, Read as _, Write as _},
    net::TcpStream,
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, Stdio},
    time::Duration,
};

/// What an operator gives a stream that nobody reads: short, so that a short run sees such streams end and come back.
const STALL_SECS: &str = "60";

/// A process and the lines that it has not said yet; killed when it is dropped.
#[derive(Debug)]
struct Running {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Running {
    fn start(mut command: Command) -> io::Result<Self> {
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_")) {
            command.env_remove(name);
        }
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let output = child.stdout.take().ok_or(io::ErrorKind::BrokenPipe)?;
        Ok(Self { child, lines: BufReader::new(output).lines() })
    }

    /// What its next line says after `what`.
    fn after(&mut self, what: &str) -> io::Result<String> {
        let line = self.lines.next().unwrap_or_else(|| Ok(String::new()))?;
        let said = line.strip_prefix(what).map(|said| said.trim().to_owned());
        said.ok_or_else(|| io::Error::other(format!("expected {what:?} and an address, got {line:?}")))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may be dead already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A program, on the first core alone where it is `pinned`.
fn on_first_core(program: &Path, pinned: bool) -> Command {
    let mut command = Command::new(if pinned { Path::new("taskset") } else { program });
    if pinned {
        command.args(["-c", "0"]).arg(program);
    }
    command
}

/// A process that sends back what it gets.
#[derive(Debug)]
pub struct Echo {
    _running: Running,
    pub address: String,
}

impl Echo {
    pub fn start(soak: &Path, pinned: bool) -> io::Result<Self> {
        let mut command = on_first_core(soak, pinned);
        command.arg("echo");
        let mut running = Running::start(command)?;
        let address = running.after("")?;
        Ok(Self { _running: running, address })
    }
}

/// A learner with a store of its own, which goes when it does.
#[derive(Debug)]
pub struct Learner {
    running: Running,
    data: PathBuf,
    pub address: String,
}

impl Learner {
    pub fn start(binary: &Path, pinned: bool) -> io::Result<Self> {
        let data = std::env::temp_dir().join(format!("mazeway-soak-{}", std::process::id()));
        let mut command = on_first_core(binary, pinned);
        command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(&data);
        let mut running = Running::start(command)?;
        let address = running.after("listening on ")?;
        Ok(Self { running, data, address })
    }

    /// Seconds of processor time that it has used.
    pub fn processor_secs(&self) -> io::Result<f64> {
        processor_secs(self.running.child.id())
    }
}

impl Drop for Learner {
    fn drop(&mut self) {
        let _ = self.running.child.kill();
        let _ = self.running.child.wait();
        let _ = fs::remove_dir_all(&self.data);
    }
}

/// A running server.
#[derive(Debug)]
pub struct Server {
    running: Running,
    pub address: String,
    metrics: String,
}

/// What a server takes of the machine.
#[derive(Debug, Clone, Copy, Default)]
pub struct Taken {
    /// Resident bytes.
    pub resident: f64,
    /// Those of them that are no part of a file, as the program itself is: heap and stacks.
    pub own: f64,
    /// Open files.
    pub files: usize,
}

/// What a server says of itself at one moment.
#[derive(Debug)]
pub struct Numbers(String);

impl Numbers {
    pub fn get(&self, name: &str) -> io::Result<f64> {
        let found = self.0.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        let number = found.and_then(|number| number.trim().parse().ok());
        number.ok_or_else(|| io::Error::other(format!("no number {name} among\n{}", self.0)))
    }
}

impl Server {
    /// Starts the binary `server`.
    pub fn start(binary: &Path, pinned: bool) -> io::Result<Self> {
        let mut command = on_first_core(binary, pinned);
        if pinned {
            command.args(["--threads", "1"]);
        }
        command.args(["--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--max-sessions", "4096"]);
        command.args(["--keepalive-secs", "2", "--stall-timeout-secs", STALL_SECS]);
        let mut running = Running::start(command)?;
        let (address, metrics) = (running.after("listening on ")?, running.after("metrics on http://")?);
        let metrics = metrics.trim_end_matches("/metrics").to_owned();
        Ok(Self { running, address, metrics })
    }

    /// What it says of itself now.
    pub fn numbers(&self) -> io::Result<Numbers> {
        let mut stream = TcpStream::connect(&self.metrics)?;
        stream.set_read_timeout(Some(Duration::from_secs(30)))?;
        stream.write_all(b"GET /metrics HTTP/1.0\r\nHost: server\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        Ok(Numbers(answer))
    }

    /// What it takes now.
    pub fn taken(&self) -> io::Result<Taken> {
        let process = format!("/proc/{}", self.running.child.id());
        let status = fs::read_to_string(format!("{process}/status"))?;
        let bytes = |name: &str| {
            let kib = status.lines().find_map(|line| line.strip_prefix(name)?.trim().strip_suffix(" kB"));
            kib.and_then(|kib| kib.trim().parse::<f64>().ok()).map(|kib| kib * 1024.0).ok_or(io::ErrorKind::InvalidData)
        };
        let files = fs::read_dir(format!("{process}/fd"))?.count();
        Ok(Taken { resident: bytes("VmRSS:")?, own: bytes("RssAnon:")?, files })
    }

    /// Seconds of processor time that it has used.
    pub fn processor_secs(&self) -> io::Result<f64> {
        processor_secs(self.running.child.id())
    }
}

fn processor_secs(process: u32) -> io::Result<f64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat"))?;
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |index: usize| fields.get(index).and_then(|ticks| ticks.parse::<f64>().ok()).unwrap_or(0.0);
    Ok((ticks(11) + ticks(12)) / 100.0)
}
