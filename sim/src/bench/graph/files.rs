//! Which graphs a folder holds, and what is known of their optima.

use anyhow::{Context, bail};
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::g2o::Parser;
use merganser_protocol::geometry::Se3;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// One graph: a file, or all robots' files in a folder.
pub(super) struct Source {
    /// Its name in optima.csv.
    pub(super) name: String,
    pub(super) files: Vec<PathBuf>,
    /// The whole graph in one file, where there is one; its poses may not tell their robots.
    full: Option<PathBuf>,
    /// Kollagen keeps closures between robots in a file of their own, and numbers each robot's poses from 0.
    closures: Option<PathBuf>,
}

impl Source {
    /// The one file that holds it all, if there is one.
    pub(super) fn one_file(&self) -> Option<&Path> {
        let only = || self.files.first().filter(|_| self.files.len() == 1);
        self.full.as_ref().or_else(only).map(PathBuf::as_path)
    }

    /// Reads it, from one file where there is one.
    pub(super) fn read(&self) -> anyhow::Result<PoseGraph> {
        let Some(path) = self.one_file() else { return self.read_robots() };
        let mut parser = Parser::default();
        read_into(&mut parser, path, |line| line)?;
        Ok(parser.finish())
    }

    /// Whether [`Source::truth`] may know where its robots truly were.
    pub(super) fn has_truth(&self) -> bool {
        self.closures.is_some()
    }

    /// Where the robots truly were, where a file tells (Kollagen's `*_GT.tum` beside each robot's graph, a line a
    /// pose).
    pub(super) fn truth(&self) -> anyhow::Result<BTreeMap<u64, Se3>> {
        let mut out = BTreeMap::new();
        for (robot, path) in (0..).zip(self.files.iter().filter(|_| self.closures.is_some())) {
            let name = path.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned();
            let Ok(text) = std::fs::read_to_string(path.with_file_name(format!("{name}_GT.tum"))) else { continue };
            for (k, line) in text.lines().filter(|line| !line.starts_with('#')).enumerate() {
                let numbers: Result<Vec<f64>, _> = line.split_whitespace().skip(1).map(str::parse).collect();
                let pose = numbers.ok().and_then(|n| {
                    let [x, y, z, rotation @ ..] = n.as_slice() else { return None };
                    Se3::from_xyzw(rotation.try_into().ok()?, [*x, *y, *z])
                });
                let pose = pose.with_context(|| format!("{name}_GT.tum: line {} is no pose", k + 1))?;
                out.insert(((u64::from(b'a') + robot) << 56) | k as u64, pose);
            }
        }
        Ok(out)
    }

    /// Reads all robots' files.
    pub(super) fn read_robots(&self) -> anyhow::Result<PoseGraph> {
        let mut parser = Parser::default();
        for (robot, path) in (0..).zip(&self.files) {
            let own = |line: String| if self.closures.is_some() { lettered(&line, robot) } else { line };
            read_into(&mut parser, path, own)?;
        }
        if let Some(path) = &self.closures {
            read_into(&mut parser, path, |line| closure(&line))?;
        }
        Ok(parser.finish())
    }
}

fn read_into(parser: &mut Parser, path: &Path, mend: impl Fn(String) -> String) -> anyhow::Result<()> {
    let place = || path.display().to_string();
    parser.begin();
    for line in BufReader::new(File::open(path).with_context(place)?).lines() {
        parser.line(&mend(line.with_context(place)?)).with_context(place)?;
    }
    Ok(())
}

/// The id of a robot's pose as GTSAM's symbols have it; what is no number stays, for the parser to refuse.
fn symbol(robot: u64, pose: &str) -> String {
    pose.parse::<u64>().map_or_else(|_| pose.to_owned(), |k| (((u64::from(b'a') + robot) << 56) | k).to_string())
}

/// A g2o line whose ids are given the robot's letter.
fn lettered(line: &str, robot: u64) -> String {
    let ids = if line.starts_with("EDGE") { 2 } else { 1 };
    let word = |(k, word): (usize, &str)| if (1..=ids).contains(&k) { symbol(robot, word) } else { word.to_owned() };
    line.split_whitespace().enumerate().map(word).collect::<Vec<_>>().join(" ")
}

/// `robot i robot j measurement information` as a g2o line; robots count from 1.
fn closure(line: &str) -> String {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [a, i, b, j, rest @ ..] = words.as_slice() else { return line.to_owned() };
    let robot = |text: &str| text.parse::<u64>().unwrap_or(1).saturating_sub(1);
    format!("EDGE_SE3:QUAT {} {} {}", symbol(robot(a), i), symbol(robot(b), j), rest.join(" "))
}

/// SE-Sync's objective by graph, from `optima.csv` in the folder; empty if there is none.
pub(super) fn optima(folder: &Path) -> anyhow::Result<BTreeMap<String, f64>> {
    let path = folder.join("optima.csv");
    if !path.is_file() {
        return Ok(BTreeMap::new());
    }
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let row = |line: &str| {
        let mut fields = line.split(',');
        let name = fields.next()?.to_owned();
        Some((name, fields.next()?.parse::<f64>().ok()?))
    };
    let parsed = text.lines().skip(1).map(|l| row(l).with_context(|| format!("{}: {l:?} is no row", path.display())));
    parsed.collect()
}

/// The graphs below a folder whose name contains `filter`: every folder that `optima.csv` names, every file of its own.
pub(super) fn find(root: &Path, optima: &BTreeMap<String, f64>, filter: &str) -> anyhow::Result<Vec<Source>> {
    let mut found = Vec::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        let mut files = Vec::new();
        let closures = folder.join("inter_agent_lc.dat");
        if closures.is_file() {
            let graph = |path: PathBuf| path.join("posegraph.g2o");
            let robots = std::fs::read_dir(&folder)?.filter_map(|entry| Some(graph(entry.ok()?.path())));
            let mut files: Vec<PathBuf> = robots.filter(|path| path.is_file()).collect();
            files.sort();
            let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            found.push(Source { name, files, full: None, closures: Some(closures) });
            continue;
        }
        for entry in std::fs::read_dir(&folder).with_context(|| folder.display().to_string())? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "g2o") {
                files.push(path);
            }
        }
        files.sort();
        let relative = folder.strip_prefix(root).unwrap_or(&folder);
        let name = relative.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("_") + ".g2o";
        if optima.contains_key(&name) {
            let is_full = |f: &PathBuf| f.file_stem().is_some_and(|stem| stem == "fullGraph");
            let (full, files) = files.into_iter().partition::<Vec<_>, _>(is_full);
            found.push(Source { name, files, full: full.into_iter().next(), closures: None });
        } else {
            let single = |path: PathBuf| Source {
                name: path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
                files: vec![path],
                full: None,
                closures: None,
            };
            found.extend(files.into_iter().map(single).filter(|s| optima.is_empty() || optima.contains_key(&s.name)));
        }
    }
    found.retain(|source| source.name.contains(filter));
    found.sort_by(|a, b| a.name.cmp(&b.name));
    if found.is_empty() {
        bail!("{}: no .g2o graph{} below", root.display(), if filter.is_empty() { "" } else { " of that filter" });
    }
    Ok(found)
}
