//! What others gave on the same problems, as `peers.csv` records it: a row per solver and cell.

use super::table::Cell;
use anyhow::{Context, bail};
use std::collections::BTreeMap;
use std::path::Path;

const HEADER: &str = "group,solver,N,outlier_pct,seeds,success_pct,rot_med_deg,trans_med,scale_med_rel,cpu_med_ms,\
                      cpu_max_ms,timeouts";
/// The solver whose times ours are compared with.
const HEADLINE: &str = "teaser";

/// One solver in one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Peer {
    /// Its name.
    pub solver: String,
    /// Problems it was given.
    pub seeds: u32,
    /// Right answers, %.
    pub success_percent: f64,
    /// Median rotation error, °.
    pub rot_deg: f64,
    /// Median processor time, ms.
    pub cpu_ms: f64,
}

/// Solvers by cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Peers(BTreeMap<Cell, Vec<Peer>>);

impl Peers {
    /// Reads a `peers.csv`.
    ///
    /// # Errors
    /// A file that cannot be read or is none.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        Self::parse(&text).with_context(|| path.display().to_string())
    }

    /// Parses its text.
    ///
    /// # Errors
    /// The first line that is not as the header says.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        let mut lines = text.lines();
        if lines.next().map(str::trim) != Some(HEADER) {
            bail!("the first line is not {HEADER}");
        }
        let mut peers = Self::default();
        for (k, line) in lines.enumerate().filter(|(_, line)| !line.trim().is_empty()) {
            let (cell, peer) = parse_line(line).with_context(|| format!("line {}: {line:?}", k + 2))?;
            peers.0.entry(cell).or_default().push(peer);
        }
        Ok(peers)
    }

    /// The one with the most right answers, of those the fastest.
    pub fn best(&self, cell: &Cell) -> Option<&Peer> {
        let better =
            |a: &&Peer, b: &&Peer| a.success_percent.total_cmp(&b.success_percent).then(b.cpu_ms.total_cmp(&a.cpu_ms));
        self.0.get(cell)?.iter().max_by(better)
    }

    /// TEASER++'s variant with the most problems, of those the best.
    pub fn headline(&self, cell: &Cell) -> Option<&Peer> {
        let better = |a: &&Peer, b: &&Peer| {
            let success = || a.success_percent.total_cmp(&b.success_percent);
            a.seeds.cmp(&b.seeds).then_with(success).then(b.cpu_ms.total_cmp(&a.cpu_ms))
        };
        self.0.get(cell)?.iter().filter(|p| p.solver.starts_with(HEADLINE)).max_by(better)
    }
}

fn parse_line(line: &str) -> anyhow::Result<(Cell, Peer)> {
    let fields: Vec<&str> = line.trim().split(',').collect();
    let [group, solver, n, ratio, seeds, success, rot, _, _, cpu, _, _] = fields[..] else {
        bail!("{} fields, 12 expected", fields.len())
    };
    let cell = Cell { group: group.to_owned(), n: n.parse()?, ratio: ratio.parse()? };
    let peer = Peer {
        solver: solver.to_owned(),
        seeds: seeds.parse()?,
        success_percent: success.parse()?,
        rot_deg: rot.parse()?,
        cpu_ms: cpu.parse()?,
    };
    Ok((cell, peer))
}
