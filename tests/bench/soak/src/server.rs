//! The server under load, as a process, and what can be seen of it from outside.

use std::{
    io::{self, BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    path::Path,
    process::{Child, Command, Stdio},
    time::Duration,
};

/// A running server, killed when it is dropped.
#[derive(Debug)]
pub struct Server {
    child: Child,
    pub address: String,
    metrics: String,
}

/// A process that sends back what it gets, on the first core alone where it is `pinned`; killed when it is dropped.
#[derive(Debug)]
pub struct Echo {
    child: Child,
    pub address: String,
}

impl Echo {
    pub fn start(soak: &Path, pinned: bool) -> io::Result<Self> {
        let mut command = on_first_core(soak, pinned);
        let mut child = command.arg("echo").stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let mut address = String::new();
        BufReader::new(child.stdout.take().ok_or(io::ErrorKind::BrokenPipe)?).read_line(&mut address)?;
        Ok(Self { child, address: address.trim().to_owned() })
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn on_first_core(program: &Path, pinned: bool) -> Command {
    let mut command = Command::new(if pinned { Path::new("taskset") } else { program });
    if pinned {
        command.args(["-c", "0"]).arg(program);
    }
    command
}

/// What a server takes of the machine.
#[derive(Debug, Clone, Copy, Default)]
pub struct Taken {
    /// Resident bytes.
    pub resident: f64,
    /// Open files.
    pub files: usize,
}

impl Server {
    /// Starts the binary `server`, on the first core alone where it is `pinned`.
    pub fn start(binary: &Path, pinned: bool) -> io::Result<Self> {
        let mut command = on_first_core(binary, pinned);
        if pinned {
            command.args(["--threads", "1"]);
        }
        command.args(["--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--max-sessions", "4096"]);
        command.args(["--keepalive-secs", "2"]);
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_")) {
            command.env_remove(name);
        }
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let mut lines = BufReader::new(child.stdout.take().ok_or(io::ErrorKind::BrokenPipe)?).lines();
        let mut after = |what: &str| {
            let line = lines.next().unwrap_or_else(|| Ok(String::new()))?;
            let said = line.strip_prefix(what).map(str::to_owned);
            said.ok_or_else(|| io::Error::other(format!("expected {what:?} and an address, got {line:?}")))
        };
        let (address, metrics) = (after("listening on ")?, after("metrics on http://")?);
        let metrics = metrics.trim_end_matches("/metrics").to_owned();
        Ok(Self { child, address, metrics })
    }

    /// One of its numbers.
    pub fn number(&self, name: &str) -> io::Result<f64> {
        let mut stream = TcpStream::connect(&self.metrics)?;
        stream.set_read_timeout(Some(Duration::from_secs(30)))?;
        stream.write_all(b"GET /metrics HTTP/1.0\r\nHost: server\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let found = answer.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        let number = found.and_then(|number| number.trim().parse().ok());
        number.ok_or_else(|| io::Error::other(format!("no number {name} among\n{answer}")))
    }

    /// What it takes now.
    pub fn taken(&self) -> io::Result<Taken> {
        let process = format!("/proc/{}", self.child.id());
        let status = std::fs::read_to_string(format!("{process}/status"))?;
        let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
        let resident = resident.and_then(|kib| kib.trim().parse::<f64>().ok()).ok_or(io::ErrorKind::InvalidData)?;
        Ok(Taken { resident: resident * 1024.0, files: std::fs::read_dir(format!("{process}/fd"))?.count() })
    }

    /// Seconds of processor time that it has used.
    pub fn processor_secs(&self) -> io::Result<f64> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
        let ticks = |index: usize| fields.get(index).and_then(|ticks| ticks.parse::<f64>().ok()).unwrap_or(0.0);
        Ok((ticks(11) + ticks(12)) / 100.0)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
