//! `merganser graph split` and `merganser graph import`: graphs made of other graphs and tables.

use super::read::{self, Source};
use super::write::write;
use super::{BadInput, SplitArgs, counted, say};
use anyhow::Result;
use merganser_protocol::estimate::posegraph::g2o::number_of;
use merganser_protocol::estimate::posegraph::robust::robot_of;
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph, g2o};
use std::collections::BTreeMap;
use std::path::Path;

/// Shares a graph's poses among robots.
pub fn split(args: &SplitArgs) -> Result<bool> {
    let graph = Source::read(std::slice::from_ref(&args.file))?.graph;
    let (poses, robots) = (graph.poses.len(), usize::from(args.robots));
    if poses < robots {
        let (file, poses, robots) = (args.file.display(), counted(poses, "pose"), counted(robots, "robot"));
        return Err(BadInput::told(format!("{file}: {poses} cannot be shared among {robots}")));
    }
    let letter = u64::from(u32::from(args.first));
    if letter + robots as u64 > u64::from(b'z') + 1 {
        let letters = counted(robots, "letter");
        return Err(BadInput::told(format!("--first {}: from there on the alphabet has no {letters}", args.first)));
    }
    let of_one = |id: &u64| graph.poses.keys().next().is_some_and(|first| robot_of(*first) == robot_of(*id));
    let keep = robots == 1 && graph.poses.keys().all(of_one);
    let name = |(k, &id): (usize, &u64)| {
        let robot = k * robots / poses;
        let first = (robot * poses).div_ceil(robots);
        let number = if keep { number_of(id) } else { (k - first) as u64 };
        (id, ((letter + robot as u64) << 56) | number)
    };
    let names: BTreeMap<u64, u64> = graph.poses.keys().enumerate().map(name).collect();
    let renamed = |m: &Measurement| Measurement { i: names[&m.i], j: names[&m.j], ..m.clone() };
    let out = PoseGraph {
        poses: graph.poses.iter().map(|(id, value)| (names[id], *value)).collect(),
        measurements: graph.measurements.iter().map(renamed).collect(),
        planar: graph.planar,
        fixed: graph.fixed.iter().filter_map(|id| names.get(id).copied()).collect(),
    };
    let between = out.measurements.iter().filter(|m| robot_of(m.i) != robot_of(m.j)).count();
    write(&args.out, &g2o::write(&out))?;
    say(&format!(
        "{} shared among {}, {} between them",
        counted(poses, "pose"),
        counted(robots, "robot"),
        counted(between, "measurement")
    ))?;
    Ok(true)
}

/// Makes a graph of Kimera-Multi's tables.
pub fn import_kimera(folder: &Path, out: &Path) -> Result<bool> {
    let mut tables = Vec::new();
    let unread = |error: std::io::Error| BadInput::told(format!("{}: {error}", folder.display()));
    for entry in std::fs::read_dir(folder).map_err(unread)? {
        let path = entry.map_err(unread)?.path().join("measurements.csv");
        if path.is_file() {
            tables.push(path);
        }
    }
    tables.sort();
    if tables.is_empty() {
        return Err(BadInput::told(format!("{}: no folder in it has a measurements.csv", folder.display())));
    }
    let graph = read::kimera(&tables)?;
    if graph.poses.is_empty() {
        return Err(BadInput::told(format!("{}: no measurement in its tables", folder.display())));
    }
    write(out, &g2o::write(&graph))?;
    say(&format!(
        "{}: {}, {}",
        counted(tables.len(), "table"),
        counted(graph.poses.len(), "pose"),
        counted(graph.measurements.len(), "measurement")
    ))?;
    Ok(true)
}
