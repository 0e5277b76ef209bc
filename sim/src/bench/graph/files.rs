//! Which graphs a folder holds, and what is known of their optima.

use anyhow::{Context, bail};
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::g2o::Parser;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// One graph: a file, or all robots' files in a folder.
pub(super) struct Source {
    /// Its name in optima.csv.
    pub(super) name: String,
    pub(super) files: Vec<PathBuf>,
}

impl Source {
    /// Reads it.
    pub(super) fn read(&self) -> anyhow::Result<PoseGraph> {
        let mut parser = Parser::default();
        for path in &self.files {
            let place = || path.display().to_string();
            parser.begin();
            for line in BufReader::new(File::open(path).with_context(place)?).lines() {
                parser.line(&line.with_context(place)?).with_context(place)?;
            }
        }
        Ok(parser.finish())
    }
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
        let name = relative.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("_");
        if optima.contains_key(&name) {
            let full = files.iter().find(|f| f.file_stem().is_some_and(|stem| stem == "fullGraph")).cloned();
            found.push(Source { name, files: full.map_or(files, |full| vec![full]) });
        } else {
            let single = |path: PathBuf| Source {
                name: path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
                files: vec![path],
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
