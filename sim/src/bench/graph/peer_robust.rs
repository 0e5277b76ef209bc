//! Robust peers on the same graph: a Python interpreter runs `peer_robust.py`.

use anyhow::{Context, bail};
use merganser_protocol::estimate::posegraph::{PoseGraph, g2o};
use merganser_protocol::geometry::{Se3, So3};
use nalgebra::Vector3;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

const SCRIPT: &str = include_str!("peer_robust.py");

/// What a peer came to.
#[derive(Clone, Debug, Deserialize)]
pub(super) struct RobustPeer {
    pub(super) name: String,
    pub(super) cpu_s: f64,
    /// Closures that it used, ascending.
    pub(super) used: Vec<usize>,
    /// Where it has each pose.
    places: Vec<(u64, f64, f64, f64)>,
}

impl RobustPeer {
    /// Its poses, without their rotations.
    pub(super) fn poses(&self) -> BTreeMap<u64, Se3> {
        self.places.iter().map(|&(id, x, y, z)| (id, Se3::new(So3::identity(), Vector3::new(x, y, z)))).collect()
    }
}

/// Solves a graph with each peer.
///
/// # Errors
/// An interpreter without GTSAM, or output that cannot be read.
pub(super) fn measure(python: &Path, graph: &PoseGraph) -> anyhow::Result<Vec<RobustPeer>> {
    let file = std::env::temp_dir().join(format!("merganser-spoiled-{}.g2o", std::process::id()));
    std::fs::write(&file, g2o::write(graph)).with_context(|| file.display().to_string())?;
    let output = Command::new(python).args(["-c", SCRIPT]).arg(&file).output();
    std::fs::remove_file(&file).with_context(|| file.display().to_string())?;
    let output = output.with_context(|| format!("{}: no Python interpreter starts there", python.display()))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        bail!("robust peers: {}", said.lines().last().unwrap_or("no reason given"));
    }
    parse(&String::from_utf8_lossy(&output.stdout))
}

fn parse(text: &str) -> anyhow::Result<Vec<RobustPeer>> {
    let rows = text.lines().filter(|line| line.starts_with('{'));
    rows.map(|line| serde_json::from_str(line).context("a robust peer's output cannot be read")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_read_and_others_skipped() {
        let row = r#"{"name": "GNC", "cpu_s": 0.5, "used": [3, 7], "places": [[9, 1.0, 2.0, 3.0]]}"#;
        let peers = parse(&format!("warning\n{row}\n")).unwrap();
        assert_eq!((peers.len(), peers[0].used.as_slice()), (1, &[3, 7][..]));
        assert_eq!(peers[0].poses()[&9].translation, Vector3::new(1.0, 2.0, 3.0));
        assert!(parse("{}").is_err());
    }
}
