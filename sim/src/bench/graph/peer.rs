//! GTSAM on the same file: a Python interpreter runs `sim/bench/peer_graph.py`.

use anyhow::{Context, bail};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output};

const SCRIPT: &str = include_str!("../../../bench/peer_graph.py");

/// What GTSAM came to.
#[derive(Clone, Copy, Debug, Deserialize)]
pub(super) struct Peer {
    /// Twice its error: χ².
    pub(super) chi2: f64,
    pub(super) solve_s: f64,
    /// All covariances, extrapolated from some where it takes long.
    pub(super) marginals_s: f64,
}

/// Tries whether there is a peer at all, before the first graph is measured.
///
/// # Errors
/// An interpreter that does not start, or that has no GTSAM.
pub(super) fn expect(python: &Path) -> anyhow::Result<()> {
    let output = Command::new(python).args(["-c", "import gtsam"]).output();
    let output = output.with_context(|| format!("{}: no Python interpreter starts there", python.display()))?;
    if !output.status.success() {
        bail!("{}: has no GTSAM: pip install gtsam", python.display());
    }
    Ok(())
}

/// What a peer came to on a graph. Where it fails, that is told, and the other graphs are measured nevertheless.
pub(super) fn or_told<T>(peer: anyhow::Result<T>, graph: &str) -> Option<T> {
    let tell = |error: &anyhow::Error| {
        // Nowhere left to say that it cannot be said.
        let _ = writeln!(std::io::stderr().lock(), "{graph}: no figures of the peer: {error:#}");
    };
    peer.inspect_err(tell).ok()
}

/// Solves `file` with GTSAM.
///
/// # Errors
/// An interpreter without GTSAM, or output that cannot be read.
pub(super) fn measure(python: &Path, file: &Path, repeats: u8) -> anyhow::Result<Peer> {
    let output = Command::new(python).args(["-c", SCRIPT]).arg(file).arg(repeats.to_string()).output();
    json_line(python, file, output)
}

/// What a peer's script printed last.
///
/// # Errors
/// An interpreter that did not start, a script that failed, or output that cannot be read.
pub(super) fn json_line<T: DeserializeOwned>(
    python: &Path,
    file: &Path,
    output: std::io::Result<Output>,
) -> anyhow::Result<T> {
    let output = output.with_context(|| format!("{}: no Python interpreter starts there", python.display()))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        bail!("peer on {}: {}", file.display(), said.lines().last().unwrap_or("no reason given"));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let line = text.lines().rev().find(|line| line.starts_with('{')).context("the peer printed no result")?;
    let shown: String = line.chars().take(80).collect();
    serde_json::from_str(line).with_context(|| format!("the peer's {shown:?}"))
}
