//! Logs: lines for people or JSON, on the standard error stream, filtered as the configuration says or as `RUST_LOG`
//! does. Policy: ERROR needs an operator, WARN deserves a look, INFO tells what a robot decided, DEBUG explains,
//! TRACE is per message.

use crate::config::{LogConfig, LogFormat};
use crate::link::refusals::{self, Refusals};
use std::io::IsTerminal;
use std::sync::Arc;
use tracing_subscriber::filter::{FilterExt, filter_fn};
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, fmt, registry};

/// Starts logging. A second call (tests) changes nothing. Links that fail by their certificates are not logged as Zenoh
/// tells of them, each time and without the cure, but kept for whoever tells them once.
pub fn init(config: &LogConfig) -> Arc<Refusals> {
    let refused = Arc::<Refusals>::default();
    let filter = EnvFilter::try_from_default_env().or_else(|_| EnvFilter::try_new(&config.filter)).unwrap_or_default();
    let filter = filter.and(filter_fn(|event| !refusals::is_told_otherwise(event)));
    let lines = fmt::layer().with_writer(std::io::stderr);
    let begun = registry().with(refusals::layer(refused.clone()));
    let begun = match config.format {
        LogFormat::Text => {
            let lines = lines.with_ansi(std::io::stderr().is_terminal()).with_target(false);
            begun.with(lines.with_filter(filter)).try_init()
        }
        LogFormat::Json => begun.with(lines.json().flatten_event(true).with_filter(filter)).try_init(),
    };
    drop(begun); // fails only if a logger is there already
    refused
}
