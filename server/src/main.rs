//! The environment server's binary.

use clap::CommandFactory as _;
use mazeway_server::{
    Listener,
    config::{Cli, Command, PLACES, Settings, VARIABLES},
    serve_observed,
};
use mazeway_serving::{
    running::until_stopped,
    settings::{self, SettingsError},
    telemetry::{
        endpoint::{self, Endpoint},
        logs,
    },
};
use std::{
    env,
    io::{self, Write as _},
    process::ExitCode,
    sync::Arc,
};

/// Gives memory back once a load has gone; the system's allocator keeps what connections took at their most.
#[cfg(target_os = "linux")]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    let parsed = settings::parse(Cli::command(), VARIABLES, &PLACES, env::args_os());
    let (cli, settings) = match parsed.and_then(|settings| Ok((settings.typed::<Cli>()?, settings))) {
        Ok(parsed) => parsed,
        Err(SettingsError::Usage(error)) if !error.use_stderr() => {
            // Help and version; a closed pipe while printing them is nobody's failure.
            let _ = error.print();
            return ExitCode::SUCCESS;
        }
        Err(SettingsError::Usage(error)) => return misused(&error),
        Err(error) => return refuse(2, &error.to_string(), "see what there is with 'server config'"),
    };
    let cli = match cli.command {
        None => cli.settings,
        Some(Command::Config(_)) => return print(&settings.effective()),
        Some(Command::Token(args)) => {
            return match args.run() {
                Ok(text) => print(&text),
                Err((error, hint)) => refuse(1, &error, hint),
            };
        }
    };
    if let Err((error, hint)) = cli.limits.door.check_exposed(&cli.listen, cli.insecure) {
        return refuse(2, &error, hint);
    }
    if let Err(error) = cli.limits.door.check() {
        return refuse(2, &error.to_string(), "see SECURITY.md for how such files are made");
    }
    if !cli.telemetry.is_local() && !cli.insecure {
        let error =
            "the numbers of --metrics-listen would be reached from other machines, and nobody is asked who they are";
        return refuse(2, error, "listen on 127.0.0.1, or add --insecure where the network is trusted");
    }
    // Connections are served by threads of their own: this one takes them in.
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return refuse(1, &format!("no threads to run on: {error}"), "raise the limit on processes"),
    };
    runtime.block_on(run(cli, &settings))
}

/// clap's several paragraphs in two lines.
fn misused(error: &clap::Error) -> ExitCode {
    let text = error.to_string();
    // The first says what is wrong, and may name the arguments that are missing on lines of their own.
    let first = text.split("\n\n").next().unwrap_or_default();
    let message = first.split_whitespace().collect::<Vec<_>>().join(" ");
    let asked = env::args().nth(1).filter(|word| Cli::command().find_subcommand(word).is_some());
    let program = asked.map_or_else(|| "server".to_owned(), |word| format!("server {word}"));
    refuse(2, message.strip_prefix("error: ").unwrap_or(&message), &format!("see '{program} --help'"))
}

/// Writes what was asked for. A closed pipe is not a failure: the reader has seen enough.
fn print(text: &str) -> ExitCode {
    match io::stdout().write_all(text.as_bytes()).and_then(|()| io::stdout().flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            refuse(1, &format!("could not write: {error}"), "check that the disk has room")
        }
        _ => ExitCode::SUCCESS,
    }
}

async fn run(cli: Settings, from: &settings::Settings) -> ExitCode {
    let spans = match logs::start(&cli.telemetry, "mazeway-server") {
        Ok(spans) => spans,
        Err(error) => return refuse(2, &format!("no spans can be exported: {error}"), "see 'server --help'"),
    };
    from.warn_of_strangers();
    let code = observed(cli).await;
    spans.flush().await;
    code
}

async fn observed(cli: Settings) -> ExitCode {
    let listener = match Listener::bind(&cli.listen).await {
        Ok(listener) => listener,
        Err(error) => {
            return refuse(1, &format!("cannot listen on {}: {error}", cli.listen), cli.listen.otherwise());
        }
    };
    let telemetry = Arc::new(mazeway_server::telemetry());
    let shown = match cli.telemetry.metrics_listen {
        None => None,
        Some(address) => match endpoint::start(address, Arc::clone(&telemetry)).await {
            Ok(shown) => Some(shown),
            Err(error) => {
                let hint = "take a free port: --metrics-listen 127.0.0.1:0";
                return refuse(1, &format!("cannot show numbers on {address}: {error}"), hint);
            }
        },
    };
    let address = listener.address().unwrap_or(cli.listen);
    let stopped = match until_stopped(address, shown.as_ref().map(Endpoint::address)) {
        Ok(stopped) => stopped,
        Err(error) => return refuse(1, &format!("cannot catch signals: {error}"), "raise the limit on open files"),
    };
    match serve_observed(cli.limits, listener, telemetry, stopped).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => refuse(1, &error.to_string(), "add --log info to see more"),
    }
}

fn refuse(code: u8, error: &str, hint: &str) -> ExitCode {
    let _ = writeln!(io::stderr(), "error: {error}\nhint: {hint}");
    ExitCode::from(code)
}
