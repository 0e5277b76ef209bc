//! A progress bar on standard error, hidden where that is no terminal.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;

/// A bar of `len` steps named `unit`.
///
/// # Errors
/// A unit that breaks the bar's template.
pub fn progress_bar(len: u64, unit: &str) -> anyhow::Result<ProgressBar> {
    let hidden = !std::io::stderr().is_terminal();
    let target = if hidden { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
    let style = ProgressStyle::with_template(&format!("{{bar:40}} {{pos}}/{{len}} {unit}, {{elapsed}}"))?;
    Ok(ProgressBar::with_draw_target(Some(len), target).with_style(style))
}
