//! `merganser graph solve` without `--robust`: every measurement counts.

use super::write::{Part, write_parts};
use super::{SolveArgs, StartArg, counted, say, waiting, warn};
use anyhow::Result;
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::fault::{PoseGraphError, PoseName};
use merganser_protocol::estimate::posegraph::solve::{ChordalOutcome, Solved, Start};
use std::collections::BTreeMap;
use std::time::Instant;

/// Solves each part; whether all converged and, where asked, are certified.
pub fn solve(args: &SolveArgs) -> Result<bool> {
    let source = super::source_of(args)?;
    let graph = &source.graph;
    let parts = graph.parts();
    let (mut good, mut solved) = (true, Vec::new());
    for (k, part) in parts.iter().enumerate() {
        let began = Instant::now();
        let bar = waiting(&format!("part {} of {}", k + 1, parts.len()));
        let (out, certified) = solved_part(args, part).map_err(|error| source.explained(error, part))?;
        bar.finish_and_clear();
        let seconds = began.elapsed().as_secs_f64();
        good &= out.solution.converged && certified.as_ref().is_none_or(|c| c.converged && c.certificate.certified);
        say(&format!(
            "part {} of {}: {}, {}, {} after {}, χ² {:.6} of {} dof, {seconds:.3} s",
            k + 1,
            parts.len(),
            counted(part.poses.len(), "pose"),
            counted(part.measurements.len(), "measurement"),
            if out.solution.converged { "converged" } else { "NOT CONVERGED" },
            counted(out.solution.iterations, "iteration"),
            unsigned(out.solution.chi2),
            dof(part, out.solution.dof),
        ))?;
        if !out.solution.converged {
            warn(&not_converged(args, k + 1));
        }
        if let Some(outcome) = &certified {
            say(&certificate_line(part, outcome))?;
        }
        solved.extend(placed(args, part, &out));
    }
    write_parts(args, graph, &solved, |_| true)?;
    Ok(good)
}

fn solved_part(args: &SolveArgs, part: &PoseGraph) -> Result<(Solved, Option<ChordalOutcome>), PoseGraphError> {
    let iterations = args.iterations as usize;
    let (start, certified) = if args.certify {
        let (values, outcome) = part.certified(iterations)?;
        (values, Some(outcome))
    } else {
        let start = match args.start {
            StartArg::Relaxed => Start::Relaxed,
            StartArg::Chordal => Start::Chordal,
            StartArg::Given => Start::Given,
        };
        (part.start(start, iterations)?, None)
    };
    Ok((part.solve(&start, iterations)?, certified))
}

/// The part where its file puts it.
fn placed(args: &SolveArgs, part: &PoseGraph, out: &Solved) -> Option<Part> {
    let mut poses: BTreeMap<_, _> = out.ids.iter().copied().zip(out.values.iter().copied()).collect();
    let origin = part.place(&mut poses)?;
    if part.fixed.len() > 1 {
        warn(&format!(
            "FIX names {} of one part; {} says where it lies, the others are estimated",
            counted(part.fixed.len(), "pose"),
            PoseName(origin)
        ));
    }
    let mut covariances = BTreeMap::new();
    if args.marginals.is_some() {
        let place = out.ids.iter().position(|&id| id == origin)?;
        covariances.extend(out.marginals_from(place));
    }
    Some(Part { origin, poses, covariances })
}

/// What is wrong and what may help: more iterations, another start, or fewer contradictions.
fn not_converged(args: &SolveArgs, part: usize) -> String {
    let elsewhere = match (args.certify, args.start) {
        (true, _) => "",
        (false, StartArg::Chordal) => ", start from the certified minimum (--certify)",
        (false, _) => ", start elsewhere (--start chordal, or --certify)",
    };
    format!(
        "part {part} is not at a minimum after {}: give it more (--iterations){elsewhere}, or leave out what contradicts \
         the rest (--robust); until then poses and covariances are provisional",
        counted(args.iterations as usize, "iteration")
    )
}

fn certificate_line(part: &PoseGraph, outcome: &ChordalOutcome) -> String {
    let certificate = &outcome.certificate;
    let verdict = match (certificate.certified, part.is_isotropic()) {
        (true, true) => "certified: the global minimum",
        (true, false) => {
            "certified for the isotropic weights; not applicable to the graph's own, which are not isotropic"
        }
        (false, _) => "NOT CERTIFIED",
    };
    let gap = certificate.gap.map_or_else(|| "unknown".to_owned(), |gap| format!("{gap:.1e}"));
    let eigenvalue = certificate.eigenvalue.map_or_else(|| "far below 0".to_owned(), |x| format!("{x:.1e}"));
    format!(
        "  SE-Sync's cost {:.8} after {} iterations; {verdict} (smallest eigenvalue {eigenvalue}, gap at most {gap})",
        unsigned(outcome.cost),
        outcome.iterations
    )
}

/// Degrees of freedom: planar measurements are kept as spatial ones, which hold the plane without saying anything of it.
pub fn dof(graph: &PoseGraph, spatial: usize) -> usize {
    if graph.planar { spatial / 2 } else { spatial }
}

/// A sum of squares; that of none is −0.
pub fn unsigned(sum: f64) -> f64 {
    sum + 0.0
}
