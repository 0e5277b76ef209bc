//! Rows, gathered into cells and printed.

use super::peers::{Peer, Peers};
use super::row::{Problem, Row, Status};
use super::solve::Solved;
use std::collections::BTreeMap;
use std::fmt::Write;

/// Problems of one kind.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cell {
    /// `SE3`, `SIM3` or `ALIAS`.
    pub group: String,
    /// Number of matches.
    pub n: u32,
    /// False ones, %.
    pub ratio: u32,
}

impl Cell {
    /// The cell of a problem.
    pub fn of(problem: &Problem) -> Self {
        Self { group: problem.group.clone(), n: problem.n, ratio: problem.ratio }
    }

    fn name(&self) -> String {
        format!("{} N={} {} %", self.group, self.n, self.ratio)
    }
}

/// Our own rows, a table per solver; then how peers compare.
pub fn table(solved: &[Solved], measured: &[Row], peers: Option<&Peers>) -> String {
    let mut by_solver: BTreeMap<&str, BTreeMap<Cell, Vec<&Solved>>> = BTreeMap::new();
    for s in solved {
        by_solver.entry(&s.row.solver).or_default().entry(Cell::of(&s.row.problem)).or_default().push(s);
    }
    let mut text = String::new();
    for (solver, cells) in &by_solver {
        text += &ours(solver, cells);
        text += &compared(solver, cells, measured, peers);
    }
    text + "success: right answers (rotation < 5°, translation < 0.1, scale < 10 %), the provisional ones among them in \
            brackets; a refusal is a miss\nWRONG: wrong answers accepted, (wrong provisional ones); errors: medians of all \
            answers; oracle: least squares on the true matches\nσ̂/σ: median; in 95 %: truths inside the ellipsoid of \
            right answers; cpu: thread time per solve\n"
}

fn ours(solver: &str, cells: &BTreeMap<Cell, Vec<&Solved>>) -> String {
    let mut text = format!(
        "{:<18} {:>11} {:>8} {:>6} {:>5} {:>9} {:>8} {:>8} {:>7} {:>6} {:>7} {:>4} {:>9} {:>9}\n",
        solver,
        "success",
        "WRONG",
        "ambig.",
        "none",
        "rot °",
        "oracle °",
        "trans",
        "scale %",
        "σ̂/σ",
        "in 95 %",
        "kde",
        "cpu ms",
        "max ms"
    );
    for (cell, all) in cells {
        let count = |keep: &dyn Fn(&Solved) -> bool| all.iter().filter(|s| keep(s)).count();
        let status = |status| count(&|s| s.row.status == status);
        let median = |of: &dyn Fn(&Solved) -> Option<f64>| median(all.iter().filter_map(|s| of(s)).collect());
        let answer = |s: &Solved, value| s.row.status.answered().then_some(value);
        let right = count(&|s| s.row.is_right());
        let provisional = count(&|s| s.row.is_right() && s.row.status == Status::Provisional);
        let wrong = count(&|s| s.row.is_wrong() && s.row.status == Status::Ok);
        let wrong_provisional = count(&|s| s.row.is_wrong() && s.row.status == Status::Provisional);
        let covered = count(&|s| s.row.is_right() && s.covered);
        let _ = writeln!(
            text,
            "{:<18} {:>11} {:>8} {:>6} {:>5} {:>9.3} {:>8.3} {:>8.4} {:>7.2} {:>6.2} {:>7} {:>4} {:>9.2} {:>9.2}",
            cell.name(),
            format!("{right}/{} ({provisional})", all.len()),
            format!("{wrong} ({wrong_provisional})"),
            status(Status::Ambiguous),
            status(Status::None),
            median(&|s| answer(s, s.row.rot_deg)),
            median(&|s| s.oracle_deg),
            median(&|s| answer(s, s.row.trans)),
            100.0 * median(&|s| answer(s, s.row.scale_rel)),
            median(&|s| s.sigma_ratio),
            format!("{covered}/{right}"),
            count(&|s| s.kde),
            1e3 * median(&|s| Some(s.row.cpu_s)),
            1e3 * all.iter().map(|s| s.row.cpu_s).fold(0.0, f64::max)
        );
    }
    text + "\n"
}

/// Peers beside ours: success, median ms, and their time over ours.
fn compared(solver: &str, cells: &BTreeMap<Cell, Vec<&Solved>>, measured: &[Row], peers: Option<&Peers>) -> String {
    let mut now: BTreeMap<(Cell, &str), Vec<&Row>> = BTreeMap::new();
    for row in measured {
        now.entry((Cell::of(&row.problem), &row.solver)).or_default().push(row);
    }
    if peers.is_none() && now.is_empty() {
        return String::new();
    }
    let mut text = format!(
        "{:<18} {:>16}   {:<44} {:<44} {}\n",
        "peers", solver, "best recorded", "TEASER++ recorded", "measured now"
    );
    for (cell, all) in cells {
        let own_ms = 1e3 * median(all.iter().map(|s| s.row.cpu_s).collect());
        let own = 100.0 * all.iter().filter(|s| s.row.is_right()).count() as f64 / all.len() as f64;
        let recorded = |peer: Option<&Peer>| {
            peer.map_or_else(|| "-".to_owned(), |p| entry(&p.solver, p.success_percent, p.cpu_ms, own_ms))
        };
        let fresh = now.iter().filter(|((c, _), _)| c == cell).map(|((_, name), rows)| {
            let right = rows.iter().filter(|row| row.is_right()).count() as f64 / rows.len() as f64;
            entry(name, 100.0 * right, 1e3 * median(rows.iter().map(|row| row.cpu_s).collect()), own_ms)
        });
        let _ = writeln!(
            text,
            "{:<18} {:>16}   {:<44} {:<44} {}",
            cell.name(),
            format!("{own:.0} % {own_ms:.2} ms"),
            recorded(peers.and_then(|p| p.best(cell))),
            recorded(peers.and_then(|p| p.headline(cell))),
            fresh.collect::<Vec<_>>().join(" | ")
        );
    }
    text + "\n"
}

fn entry(solver: &str, success_percent: f64, cpu_ms: f64, own_ms: f64) -> String {
    format!("{solver} {success_percent:.0} % {cpu_ms:.2} ms (x {:.2})", cpu_ms / own_ms)
}

/// The middle value, the mean of two in the middle; NaN of none.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.get(middle) {
        None => f64::NAN,
        Some(&upper) if values.len() % 2 == 1 => upper,
        Some(&upper) => 0.5 * (values[middle - 1] + upper),
    }
}
