//! How the programs of both services run: they say where they are once they serve, and go on until they are told to stop, and
//! a while beyond.

use std::{
    fmt::Display,
    io::{self, Write as _},
    net::SocketAddr,
    pin::pin,
    time::Duration,
};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

/// Says where a service and its numbers are, and then waits for SIGINT or SIGTERM. The lines are written when the future is
/// first polled, so that who reads them may connect; the signals are watched from the call on.
///
/// # Errors
/// Signals cannot be watched.
pub fn until_stopped(address: impl Display, numbers: Option<SocketAddr>) -> io::Result<impl Future<Output = ()>> {
    let stop = stop_signal()?;
    Ok(async move {
        say(&format!("listening on {address}"));
        if let Some(numbers) = numbers {
            say(&format!("metrics on http://{numbers}/metrics"));
        }
        let signal = stop.await;
        tracing::info!("{signal} came");
    })
}

/// Writes a line. Whoever started this may have closed the other end; the service serves all the same.
fn say(line: &str) {
    let _ = writeln!(io::stdout(), "{line}").and_then(|()| io::stdout().flush());
}

/// The name of the signal, once it has come.
#[cfg(unix)]
fn stop_signal() -> io::Result<impl Future<Output = &'static str>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => "SIGINT",
            _ = terminate.recv() => "SIGTERM",
        }
    })
}

/// As above, where there is but one.
#[cfg(not(unix))]
fn stop_signal() -> io::Result<impl Future<Output = &'static str>> {
    Ok(async {
        let _ = tokio::signal::ctrl_c().await;
        "Ctrl-C"
    })
}

/// Time before the end of a grace in which whoever is still inside is told, a quarter of the grace at most.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// Waits for the end of what has so much time left, and cancels `last_words` shortly before that is over.
pub async fn ends_within<T>(grace: Duration, end: impl Future<Output = T>, last_words: &CancellationToken) -> T {
    let mut end = pin!(end);
    if let Ok(ended) = timeout(grace.saturating_sub(LAST_WORDS.min(grace / 4)), end.as_mut()).await {
        return ended;
    }
    last_words.cancel();
    end.await
}
