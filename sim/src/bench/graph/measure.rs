//! One graph, solved each way and timed.

use crate::bench::cpu::thread_seconds;
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::solve::{ChordalOutcome, Start};
use merganser_protocol::geometry::Se3;

/// Iterations after which a minimisation gives up.
const ITERATIONS_MAX: usize = 100;

/// What came of a graph.
pub(super) struct Measured {
    pub(super) poses: usize,
    pub(super) measurements: usize,
    /// χ² from the relaxed start: minimum, iterations, whether it converged, processor s from the file's measurements
    /// to convergence, the start included.
    pub(super) chi2: f64,
    pub(super) iterations: usize,
    pub(super) converged: bool,
    pub(super) solve_s: f64,
    /// SE-Sync's cost: minimum and certificate, processor s with both.
    pub(super) chordal: ChordalOutcome,
    pub(super) chordal_s: f64,
    /// χ² from the certified minimum: the same minimum, if the relaxed start was good enough.
    pub(super) chi2_certified: f64,
    /// The poses at that minimum.
    pub(super) values: Vec<Se3>,
    /// All covariances relative to the first pose, processor s.
    pub(super) marginals_s: f64,
}

/// Solves a connected graph in every way.
pub(super) fn measure(graph: &PoseGraph, repeats: u8) -> anyhow::Result<Measured> {
    let (solve_s, solved) = timed(repeats, || {
        let start = graph.start(Start::Relaxed, ITERATIONS_MAX)?;
        graph.minimise(&start, ITERATIONS_MAX)
    })?;
    let (chordal_s, (values, chordal)) = timed(repeats, || graph.certified(ITERATIONS_MAX))?;
    let chi2_certified = graph.solve(&values, ITERATIONS_MAX)?.solution.chi2;
    let at_minimum = graph.solve(&solved.values, 0)?;
    let (marginals_s, _) = timed(repeats, || Ok::<_, anyhow::Error>(at_minimum.marginals()))?;
    Ok(Measured {
        poses: graph.poses.len(),
        measurements: graph.measurements.len(),
        chi2: solved.chi2,
        iterations: solved.iterations,
        converged: solved.converged,
        solve_s,
        chordal,
        chordal_s,
        chi2_certified,
        values: solved.values,
        marginals_s,
    })
}

/// The fastest of several runs, and the last one's result.
fn timed<T, E>(repeats: u8, mut run: impl FnMut() -> Result<T, E>) -> Result<(f64, T), E> {
    let mut once = || {
        let start = thread_seconds();
        let out = run()?;
        Ok((thread_seconds() - start, out))
    };
    let (mut best, mut out) = once()?;
    for _ in 1..repeats {
        let (seconds, again) = once()?;
        (best, out) = (best.min(seconds), again);
    }
    Ok((best, out))
}
