//! Graphs and tables from files, and errors told by file and line.

use super::{BadInput, counted, identity, warn};
use anyhow::{Error, Result};
use merganser_protocol::estimate::posegraph::fault::{PoseGraphError, PoseName};
use merganser_protocol::estimate::posegraph::g2o::{Fault, G2oError, LINE_MAX, Parser, Stated};
use merganser_protocol::estimate::posegraph::kimera::Importer;
use merganser_protocol::estimate::posegraph::lines::Files;
use merganser_protocol::estimate::posegraph::marginals::{Marginal, Reader};
use merganser_protocol::estimate::posegraph::quaternions::{WFirst, w_first_in};
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// A graph, and where it was read.
pub struct Source {
    pub graph: PoseGraph,
    names: Vec<PathBuf>,
    lines: Files,
}

impl Source {
    /// The graph of some g2o files; says what in them is odd but no fault.
    pub fn read(files: &[PathBuf]) -> Result<Self> {
        let mut parser = Parser::default();
        for path in files {
            parser.begin();
            let mut otherwise = None;
            for line in lines(path)? {
                match parser.line(&line?) {
                    // The rest of the file tells which poses both have.
                    Err(G2oError { line, what: Fault::Otherwise(ends, first) }) => {
                        otherwise.get_or_insert((line, Stated(ends), first));
                    }
                    other => other.map_err(|e| at(path, e.line, e.what))?,
                }
            }
            if let Some((line, stated, first)) = otherwise {
                return Err(at(path, line, identity::two_robots(&parser, files, path, stated, first)));
            }
        }
        if let Some(doubt) = identity::doubt(&parser, files) {
            warn(&doubt);
        }
        let (lines, repeated) = (parser.files().clone(), parser.repeated());
        let graph = parser.finish();
        if graph.poses.is_empty() {
            let names = files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(", ");
            return Err(BadInput::told(format!("{names}: no pose in it")));
        }
        let source = Self { graph, names: files.to_vec(), lines };
        if let Some(repeated) = repeated {
            let place = source.place(repeated.line);
            let (count, s) = (counted(repeated.count, "measurement"), if repeated.count == 1 { "s" } else { "" });
            warn(&format!("{place}: {count} repeat{s} another to the bit, first here; each counts as one of its own"));
        }
        for doubt in source.w_first() {
            warn(&doubt);
        }
        for id in source.graph.fixed.iter().filter(|id| !source.graph.poses.contains_key(id)) {
            warn(&format!("FIX names {}, which has no vertex and no measurement", PoseName(*id)));
        }
        Ok(source)
    }

    /// Which files seem to have their quaternions w first.
    fn w_first(&self) -> Vec<String> {
        let mut of_files: Vec<Vec<&Measurement>> = vec![Vec::new(); self.names.len()];
        for measurement in &self.graph.measurements {
            if let Some(of_file) = of_files.get_mut(self.lines.place(measurement.line).file) {
                of_file.push(measurement);
            }
        }
        // Values belong to no file: without measurements all are in doubt together.
        if self.graph.measurements.is_empty() {
            let names: Vec<String> = self.names.iter().map(|name| name.display().to_string()).collect();
            let doubt = w_first_in(&self.graph, core::iter::empty());
            return doubt.into_iter().map(|which: WFirst| format!("{}: {which}", names.join(", "))).collect();
        }
        let told = |(name, of_file): (&PathBuf, Vec<&Measurement>)| {
            let which = w_first_in(&self.graph, of_file.into_iter())?;
            Some(format!("{}: {which}", name.display()))
        };
        // A file of vertices alone says nothing: what speaks of them stands in another.
        self.names.iter().zip(of_files).filter(|(_, of_file)| !of_file.is_empty()).filter_map(told).collect()
    }

    /// An error of a part of the graph: by file and line, or else by the part's smallest pose.
    pub fn explained(&self, error: PoseGraphError, part: &PoseGraph) -> Error {
        match (error, part.poses.keys().next()) {
            (PoseGraphError::At { line, what }, _) => BadInput::told(format!("{}: {what}", self.place(line))),
            (error, Some(&first)) => BadInput::told(format!("the part of {}: {error}", PoseName(first))),
            (error, None) => BadInput::told(error.to_string()),
        }
    }

    /// `FILE:LINE` of a line counted through all files.
    pub fn place(&self, line: usize) -> String {
        let place = self.lines.place(line);
        let name = self.names.get(place.file).map(|path| path.display().to_string()).unwrap_or_default();
        format!("{name}:{}", place.line)
    }
}

/// The graph of Kimera-Multi's tables.
pub fn kimera(tables: &[PathBuf]) -> Result<PoseGraph> {
    let mut importer = Importer::default();
    for path in tables {
        importer.begin();
        for line in lines(path)? {
            importer.line(&line?).map_err(|e| at(path, e.line, e.what))?;
        }
    }
    Ok(importer.finish().0)
}

/// The rows of a table of poses with covariances.
pub fn marginals(path: &Path) -> Result<BTreeMap<u64, Marginal>> {
    let mut reader = Reader::default();
    for line in lines(path)? {
        reader.line(&line?).map_err(|e| at(path, e.line, e.what))?;
    }
    let rows = reader.finish();
    if rows.is_empty() {
        return Err(BadInput::told(format!("{}: no pose in it", path.display())));
    }
    Ok(rows)
}

fn at(path: &Path, line: usize, what: impl Display) -> Error {
    BadInput::told(format!("{}:{line}: {what}", path.display()))
}

/// The lines of a text file; a line without end is cut, so that the parser refuses it.
fn lines(path: &Path) -> Result<impl Iterator<Item = Result<String>>> {
    let unread = |error: std::io::Error| BadInput::told(format!("{}: {error}", path.display()));
    let file = File::open(path).map_err(unread)?;
    let mut reader = BufReader::new(file);
    Ok(std::iter::from_fn(move || {
        let mut line = Vec::new();
        loop {
            let (used, done) = match reader.fill_buf() {
                Ok([]) if line.is_empty() => return None,
                Ok([]) => (0, true),
                Ok(bytes) => {
                    let end = bytes.iter().position(|&b| b == b'\n');
                    let text = &bytes[..end.unwrap_or(bytes.len())];
                    let room = (2 * LINE_MAX).saturating_sub(line.len());
                    line.extend_from_slice(&text[..text.len().min(room)]);
                    (text.len() + usize::from(end.is_some()), end.is_some())
                }
                Err(error) => return Some(Err(unread(error))),
            };
            reader.consume(used);
            if done {
                return Some(Ok(String::from_utf8_lossy(&line).into_owned()));
            }
        }
    }))
}
