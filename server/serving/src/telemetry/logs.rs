//! Logs on standard error and spans to a collector.
//!
//! Invariants: what is exported does not depend on what is logged; whoever ends the program waits for the spans that are on
//! their way, but not for long.

use super::TelemetryConfig;
use opentelemetry::{KeyValue, trace::TracerProvider as _};
use opentelemetry_otlp::{SpanExporter, WithExportConfig as _};
use opentelemetry_sdk::{Resource, trace::SdkTracerProvider};
use std::{
    env,
    io::{self, IsTerminal as _},
    time::Duration,
};
use tracing_subscriber::{
    Layer as _, Registry,
    filter::{LevelFilter, Targets, filter_fn},
    layer::SubscriberExt as _,
    util::SubscriberInitExt as _,
};

/// Longest that the end of a program waits for spans on their way.
const FLUSH_TIME: Duration = Duration::from_secs(3);

/// How a log is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum LogFormat {
    /// Lines for people
    #[default]
    Text,
    /// One JSON object a line, for programs
    Json,
}

/// Levels of modules, comma-separated; one without a module is everybody's. Deliberately absent: conditions on spans and on
/// values of fields, as the library's `EnvFilter` has them, whose expressions can take minutes and gigabytes to compile.
///
/// # Errors
/// A part is neither. A word alone may be a module, of which everything is logged, but is more often a level misspelt.
fn parse(text: &str) -> Result<Targets, String> {
    let known = |part: &str| match part.split_once('=') {
        Some((module, level)) => !module.is_empty() && !level.is_empty(),
        None => !part.is_empty() && part.parse::<LevelFilter>().is_ok(),
    };
    let targets = if text.split(',').all(known) { text.parse().ok() } else { None };
    targets
        .ok_or_else(|| "expected a level such as info, or levels of modules such as warn,mazeway_server=debug".into())
}

/// Reads what `--log` takes.
pub(super) fn filter(text: &str) -> Result<String, String> {
    parse(text).map(|_| text.into())
}

/// What `RUST_LOG` says is logged, a module alone being all of it, and `otherwise` where it says nothing that can be followed.
pub fn asked(otherwise: LevelFilter) -> Targets {
    let asked = env::var("RUST_LOG").ok().filter(|text| !text.trim().is_empty());
    let asked = asked.and_then(|text| text.parse().ok());
    asked.unwrap_or_else(|| Targets::new().with_default(otherwise))
}

/// Reads what `--otlp-endpoint` takes.
pub(super) fn endpoint(text: &str) -> Result<String, String> {
    match text.parse::<http::Uri>() {
        Ok(uri) if uri.scheme_str() == Some("http") && uri.authority().is_some() => Ok(text.into()),
        _ => Err("expected a URL such as http://127.0.0.1:4317".into()),
    }
}

/// Spans on their way out.
#[derive(Debug, Default)]
#[must_use = "spans that are on their way are lost unless it is waited for"]
pub struct Spans(Option<SdkTracerProvider>);

impl Spans {
    /// Waits until they are out, for a while.
    pub async fn flush(self) {
        let Some(provider) = self.0 else { return };
        // It blocks, and needs the runtime to go on meanwhile.
        let flushing = tokio::task::spawn_blocking(move || provider.shutdown_with_timeout(FLUSH_TIME));
        if let Ok(Err(error)) = flushing.await {
            tracing::warn!(%error, "some spans were not exported");
        }
    }
}

/// Begins to log and, where there is a collector, to export spans of `service`. Called once, within a runtime.
///
/// # Errors
/// The collector's address serves for nothing.
pub fn start(config: &TelemetryConfig, service: &'static str) -> io::Result<Spans> {
    let filter = match &config.log {
        Some(filter) => parse(filter).map_err(io::Error::other)?,
        None => asked(LevelFilter::WARN),
    };
    // Colours are for eyes; a file or a collector would keep their codes.
    let coloured = io::stderr().is_terminal() && env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let writing = tracing_subscriber::fmt::layer().with_writer(io::stderr).with_ansi(coloured);
    let writing = match config.log_format {
        LogFormat::Text => writing.boxed(),
        LogFormat::Json => writing.json().flatten_event(true).boxed(),
    };
    let provider = config.otlp_endpoint.as_deref().map(|endpoint| exporter(endpoint, service)).transpose()?;
    let exporting = provider.as_ref().map(|provider| {
        // What the transport of the exporter itself does would be exported for ever.
        let ours =
            filter_fn(|metadata| metadata.target().starts_with("mazeway") && *metadata.level() <= tracing::Level::INFO);
        tracing_opentelemetry::layer().with_tracer(provider.tracer("mazeway")).with_filter(ours)
    });
    let _ = Registry::default().with(writing.with_filter(filter)).with(exporting).try_init();
    Ok(Spans(provider))
}

fn exporter(endpoint: &str, service: &'static str) -> io::Result<SdkTracerProvider> {
    let exporter = SpanExporter::builder().with_tonic().with_endpoint(endpoint).build().map_err(io::Error::other)?;
    let attributes = [KeyValue::new("service.version", env!("CARGO_PKG_VERSION"))];
    let resource = Resource::builder().with_service_name(service).with_attributes(attributes).build();
    Ok(SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_and_endpoints_are_checked_before_anything_starts() {
        for right in ["info", "WARN,mazeway_server=debug", "off", "mazeway_server::grpc=trace,h2=off", "3"] {
            assert_eq!(filter(right).as_deref(), Ok(right));
        }
        for wrong in [
            "",
            " ",
            "inof",
            "info,",
            "mazeway=loud",
            "=info",
            "mazeway=",
            "==",
            "\u{2008}0=",
            "[{a=.*}]",
            "[{a=1}]=info",
        ] {
            assert!(filter(wrong).is_err(), "{wrong}");
        }
        assert!(endpoint("http://127.0.0.1:4317").is_ok());
        for wrong in ["", "127.0.0.1:4317", "https://collector:4317", "http://"] {
            assert!(endpoint(wrong).is_err(), "{wrong}");
        }
    }
}
