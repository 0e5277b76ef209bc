//! What was solved, to files: connected parts are told apart, because nothing ties one's coordinates to another's.

use super::{SolveArgs, counted};
use anyhow::{Context, Result};
use merganser_protocol::estimate::posegraph::fault::PoseName;
use merganser_protocol::estimate::posegraph::marginals::{self, Marginal};
use merganser_protocol::estimate::posegraph::robust::robot_of;
use merganser_protocol::estimate::posegraph::{PoseGraph, g2o};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A connected part that was solved.
pub struct Part {
    /// The pose that says where it lies, and that covariances are relative to.
    pub origin: u64,
    /// `t_world_pose`.
    pub poses: BTreeMap<u64, Se3>,
    /// Covariances of the poses given where the origin is; empty if nobody wants them.
    pub covariances: BTreeMap<u64, Covariance<6>>,
}

/// Writes what the arguments ask for, with the measurements to keep (by their places in the graph).
pub fn write_parts(args: &SolveArgs, graph: &PoseGraph, parts: &[Part], keep: impl Fn(usize) -> bool) -> Result<()> {
    if let Some(path) = &args.out {
        write(path, &g2o_text(graph, parts, keep))?;
    }
    if let Some(path) = &args.tum {
        for (path, text) in tum_texts(path, parts) {
            write(&path, &text)?;
        }
    }
    if let Some(path) = &args.marginals {
        let rows: Vec<Marginal> = parts.iter().flat_map(rows).collect();
        write(path, &marginals::write(&rows))?;
    }
    Ok(())
}

/// TUM trajectories, a file for each robot: one robot's numbers rise, several robots' repeat.
fn tum_texts(path: &Path, parts: &[Part]) -> Vec<(PathBuf, String)> {
    let robots: BTreeSet<u8> = parts.iter().flat_map(|part| part.poses.keys().map(|id| robot_of(*id))).collect();
    let text = |robot: u8| {
        told_apart(parts, |part| g2o::write_tum(part.poses.iter().filter(|(id, _)| robot_of(**id) == robot)))
    };
    robots.iter().map(|&robot| (tum_path(path, robot, robots.len()), text(robot))).collect()
}

/// Where a robot's trajectory goes: beside those of the others, by its letter.
fn tum_path(path: &Path, robot: u8, robots: usize) -> PathBuf {
    if robots < 2 {
        return path.into();
    }
    let letter = char::from(robot);
    let whose = if letter.is_ascii_alphabetic() { letter.to_string() } else { robot.to_string() };
    let mut name = path.file_stem().unwrap_or_default().to_os_string();
    name.push(format!("_{whose}"));
    if let Some(ending) = path.extension() {
        name.push(".");
        name.push(ending);
    }
    path.with_file_name(name)
}

fn rows(part: &Part) -> impl Iterator<Item = Marginal> {
    part.covariances.iter().filter_map(|(&id, &covariance)| {
        let estimate = PoseWithCovariance { pose: *part.poses.get(&id)?, covariance };
        Some(Marginal { id, origin: part.origin, estimate, line: 0 })
    })
}

fn g2o_text(graph: &PoseGraph, parts: &[Part], keep: impl Fn(usize) -> bool) -> String {
    let empty = || PoseGraph { planar: graph.planar, ..PoseGraph::default() };
    let part_of: BTreeMap<u64, usize> =
        parts.iter().enumerate().flat_map(|(k, part)| part.poses.keys().map(move |&id| (id, k))).collect();
    // What is left over comes last: measurements of poses for which no place was found.
    let mut graphs: Vec<PoseGraph> = (0..=parts.len()).map(|_| empty()).collect();
    for (graph, part) in graphs.iter_mut().zip(parts) {
        graph.poses = part.poses.iter().map(|(&id, &value)| (id, Some(value))).collect();
    }
    for &id in &graph.fixed {
        if let Some(&k) = part_of.get(&id) {
            graphs[k].fixed.insert(id);
        }
    }
    for (_, m) in graph.measurements.iter().enumerate().filter(|(k, _)| keep(*k)) {
        graphs[part_of.get(&m.i).copied().unwrap_or(parts.len())].measurements.push(m.clone());
    }
    let mut texts = graphs.iter().map(g2o::write);
    let mut out = told_apart(parts, |_| texts.next().unwrap_or_default());
    if let Some(rest) = texts.next().filter(|text| !text.is_empty()) {
        let _ = write!(out, "# not solved\n{rest}");
    }
    out
}

/// Each part's text, if there is any, below a comment that names it if there are several parts.
fn told_apart(parts: &[Part], mut text: impl FnMut(&Part) -> String) -> String {
    let mut out = String::new();
    for (k, part) in parts.iter().enumerate() {
        let text = text(part);
        if parts.len() > 1 && !text.is_empty() {
            let (poses, origin) = (counted(part.poses.len(), "pose"), PoseName(part.origin));
            let _ = writeln!(out, "# part {} of {}: {poses}, placed by {origin}", k + 1, parts.len());
        }
        out.push_str(&text);
    }
    out
}

/// Writes a text file.
pub fn write(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| path.display().to_string())
}
