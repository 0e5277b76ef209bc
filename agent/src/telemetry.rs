//! Logs: lines for people or JSON, on the standard error stream, filtered as the configuration says or as `RUST_LOG`
//! does. Policy: ERROR needs an operator, WARN deserves a look, INFO tells what a robot decided, DEBUG explains,
//! TRACE is per message.

use crate::config::{LogConfig, LogFormat};
use std::io::IsTerminal;
use tracing_subscriber::EnvFilter;

/// Starts logging. A second call (tests) changes nothing.
pub fn init(config: &LogConfig) {
    let filter = EnvFilter::try_from_default_env().or_else(|_| EnvFilter::try_new(&config.filter)).unwrap_or_default();
    let lines = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    let begun = match config.format {
        LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).with_target(false).try_init(),
        LogFormat::Json => lines.json().flatten_event(true).try_init(),
    };
    drop(begun); // fails only if a logger is there already
}
