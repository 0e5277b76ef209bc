//! `merganser graph solve --robust`: measurements that contradict the rest are left out.

use super::read::Source;
use super::solve::unsigned;
use super::write::{Part, write, write_parts};
use super::{BadInput, SolveArgs, counted, say, waiting, warn};
use anyhow::Result;
use merganser_protocol::config::EstimateConfig;
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::fault::{PoseName, Unsolved};
use merganser_protocol::estimate::posegraph::robust::{RobustSolved, Verdict};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::Instant;

/// Parts without a place that are told one by one.
const UNSOLVED_SHOWN: usize = 5;

/// Decides what counts and solves with it; whether all was solved and converged.
pub fn solve(args: &SolveArgs) -> Result<bool> {
    let source = super::source_of(args)?;
    let graph = &source.graph;
    let began = Instant::now();
    let bar = waiting("deciding what counts");
    let config = EstimateConfig { iterations_max: args.iterations as usize, ..EstimateConfig::default() };
    let solved = graph.solve_robustly(&config);
    bar.finish_and_clear();
    let seconds = began.elapsed().as_secs_f64();
    let unsolved = graph.unsolved(&solved);
    if let (true, Some(first)) = (solved.components.is_empty(), unsolved.first()) {
        return Err(BadInput::told(format!("nothing could be solved: {}", why(&source, first))));
    }
    let count = |keep: fn(&Verdict) -> bool| solved.verdicts.iter().filter(|v| keep(v)).count();
    let placed: usize = solved.components.iter().map(BTreeMap::len).sum();
    say(&format!(
        "{} in {}; {} odometry, {} of {} used; χ² {:.3} of {} dof, {}, {seconds:.3} s",
        counted(placed, "pose"),
        counted(solved.components.len(), "part"),
        count(|v| *v == Verdict::Odometry),
        count(|v| matches!(v, Verdict::Used(_))),
        counted(count(|v| *v != Verdict::Odometry), "other measurement"),
        unsigned(solved.map.chi2),
        super::solve::dof(graph, solved.map.dof),
        if solved.map.converged { "converged" } else { "NOT CONVERGED" },
    ))?;
    if !solved.map.converged {
        warn(&format!(
            "not converged after {} iterations: give it more (--iterations); until then poses and covariances are \
             provisional",
            args.iterations
        ));
    }
    reasons(&solved).into_iter().try_for_each(|line| say(&line))?;
    for part in unsolved.iter().take(UNSOLVED_SHOWN) {
        warn(&why(&source, part));
    }
    if unsolved.len() > UNSOLVED_SHOWN {
        warn(&format!("{} more parts without a place", unsolved.len() - UNSOLVED_SHOWN));
    }
    if let Some(path) = &args.verdicts {
        write(path, &verdicts_csv(graph, &solved))?;
    }
    let keep = |k: usize| solved.verdicts.get(k).is_some_and(|v| !matches!(v, Verdict::Unused(_)));
    write_parts(args, graph, &parts(args, graph, &solved), keep)?;
    Ok(solved.map.converged)
}

/// The components where their files put them.
fn parts(args: &SolveArgs, graph: &PoseGraph, solved: &RobustSolved) -> Vec<Part> {
    // Of those that are fixed, the origin that `place` takes is the smallest, which is the one preferred here.
    let marginals = match args.marginals {
        Some(_) => solved.marginals_from(|id| graph.fixed.contains(&id)),
        None => BTreeMap::new(),
    };
    let part = |poses: &BTreeMap<_, _>| {
        let mut poses = poses.clone();
        let origin = graph.place(&mut poses)?;
        let covariances = poses.keys().filter_map(|id| Some((*id, marginals.get(id)?.covariance))).collect();
        Some(Part { origin, poses, covariances })
    };
    solved.components.iter().filter_map(part).collect()
}

/// Why there is no place for some poses.
fn why(source: &Source, unsolved: &Unsolved) -> String {
    let poses = counted(unsolved.poses, "pose");
    let what = match unsolved.why.clone() {
        Some(error) => source.explained(error, &PoseGraph::default()).to_string(),
        None => "each robot's own measurements can be solved, but not with those between robots that agree; \
                 --verdicts tells which"
            .to_owned(),
    };
    format!("no place for {poses} from {} on: {what}", PoseName(unsolved.first))
}

/// How many measurements were left out for which reason.
fn reasons(solved: &RobustSolved) -> Vec<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for verdict in &solved.verdicts {
        if let Verdict::Unused(reason) = verdict {
            // From the first number or bracket on, the text is each one's own.
            let text = reason.to_string();
            let common = text.split(|c: char| c == '(' || c.is_ascii_digit()).next().unwrap_or_default();
            *counts.entry(common.trim_end().to_owned()).or_default() += 1;
        }
    }
    counts.into_iter().map(|(reason, n)| format!("  {n} left out: {reason}")).collect()
}

fn verdicts_csv(graph: &PoseGraph, solved: &RobustSolved) -> String {
    let mut out = String::from("i,j,weight,reason\n");
    for (m, verdict) in graph.measurements.iter().zip(&solved.verdicts) {
        let _ = match verdict {
            Verdict::Odometry => writeln!(out, "{},{},1,odometry", m.i, m.j),
            Verdict::Used(weight) => writeln!(out, "{},{},{weight},", m.i, m.j),
            Verdict::Unused(reason) => writeln!(out, "{},{},0,\"{reason}\"", m.i, m.j),
        };
    }
    out
}
