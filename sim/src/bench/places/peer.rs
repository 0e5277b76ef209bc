//! KISS-Matcher on the same LiDAR pairs, with the complete clouds of both: a Python interpreter runs
//! `sim/bench/peer_places.py`.

use super::measure::{At, OVERLAP_FOUND, Tried, difference, place};
use super::sets::{Place, Set};
use anyhow::{Context, bail};
use merganser_protocol::geometry::Se3;
use nalgebra::Matrix4;
use serde::Deserialize;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

const SCRIPT: &str = include_str!("../../../bench/peer_places.py");

/// What it came to for one pair.
pub(super) struct Peer {
    /// The pair.
    pub pair: (At, At),
    /// Whether it says that it succeeded.
    pub valid: bool,
    /// Rotation (°) and translation (m) off the truth.
    pub error: (f64, f64),
    /// Processor and wall time, s.
    pub cpu_s: f64,
    /// See above.
    pub wall_s: f64,
}

#[derive(Deserialize)]
struct Answer {
    pose: [[f64; 4]; 4],
    valid: bool,
    cpu_s: f64,
    wall_s: f64,
}

/// Pairs of single scans that overlap, in one direction, and those that overlap by less and are to be refused.
pub(super) fn pairs(sets: &[Set], tried: &[Tried]) -> Vec<(At, At)> {
    let scans = |t: &&Tried| {
        let single = |at| place(sets, at).scan.is_some();
        t.their < t.mine && t.their.0 == t.mine.0 && single(t.their) && single(t.mine)
    };
    let wanted = |t: &&Tried| t.overlap >= OVERLAP_FOUND || super::table::is_hard(sets, t);
    tried.iter().filter(scans).filter(wanted).map(|t| (t.their, t.mine)).collect()
}

/// Measures it on those pairs.
///
/// # Errors
/// An interpreter without KISS-Matcher, or output that cannot be read.
pub(super) fn measure(python: &Path, voxel: f64, sets: &[Set], tried: &[Tried]) -> anyhow::Result<Vec<Peer>> {
    let pairs = pairs(sets, tried);
    let scan = |place: &Place| {
        place.scan.as_ref().map(|scan| {
            let turn = scan.turn.matrix();
            let rows: Vec<Vec<f64>> = (0..3).map(|r| (0..3).map(|c| turn[(r, c)]).collect()).collect();
            serde_json::json!({"path": scan.path, "stride": scan.stride, "turn": rows})
        })
    };
    let request: Vec<_> = pairs.iter().map(|&(a, b)| (scan(place(sets, a)), scan(place(sets, b)))).collect();
    let mut child = Command::new(python)
        .args(["-c", SCRIPT, &voxel.to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("{}: no Python interpreter starts there", python.display()))?;
    if let Some(mut pipe) = child.stdin.take() {
        // One that ends early says why itself.
        let _ = pipe.write_all(serde_json::to_string(&request)?.as_bytes());
    }
    let output = child.wait_with_output()?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        bail!("peer: {}: {}", output.status, said.lines().last().unwrap_or("no reason given"));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let line = text.lines().rev().find(|line| line.starts_with('[')).context("the peer printed no result")?;
    let answers: Vec<Answer> = serde_json::from_str(line).context("the peer's result")?;
    let judged = |(pair, answer): ((At, At), Answer)| {
        let (theirs, mine) = (place(sets, pair.0), place(sets, pair.1));
        let truth = mine.t_world_anchor.inverse() * theirs.t_world_anchor;
        let pose = Se3::from_matrix(&Matrix4::from_fn(|r, c| answer.pose[r][c]));
        let error = difference(&pose, &truth);
        Peer { pair, valid: answer.valid, error, cpu_s: answer.cpu_s, wall_s: answer.wall_s }
    };
    Ok(pairs.into_iter().zip(answers).map(judged).collect())
}
