//! `merganser-sim fingerprint`: what scenarios come to, to the bit. A change that must not change what robots decide
//! leaves every line as it was; one that must shows which lines it moved.
//!
//! A line names a scenario, its seed, the trace (BLAKE3 over every input and output of every robot), and the map:
//! BLAKE3 over every number of the joint estimates that the robots hold at the end. The first seed of `three` is the
//! drives that the demo's recordings are made from, so its map is the demo's.
//!
//! Runs are equal to the bit on one kind of processor: the dense kernels of the joint estimate follow its widest
//! instructions. So a file of expected lines says on which kind it was made, and is compared on that kind only.

use crate::band::{Band, jobs};
use crate::bar::progress_bar;
use crate::run::load;
use crate::swarm::{Outcome, Swarm};
use anyhow::Context;
use merganser_protocol::agent::Agent;
use merganser_protocol::ids::Hash;
use merganser_protocol::snapshot::{PoseView, RelationView, Snapshot};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Print what scenarios come to, to the bit, and check every invariant.
#[derive(Clone, Debug, clap::Args)]
pub struct FingerprintArgs {
    /// The scenario files (see sim/scenarios)
    #[arg(required = true)]
    pub scenarios: Vec<PathBuf>,
    /// The seed
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Compare with the lines of this file, which an earlier run printed
    #[arg(long, value_name = "FILE")]
    pub expect: Option<PathBuf>,
    /// Scenarios run at once; all processors if absent
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub jobs: Option<u16>,
}

/// Runs the scenarios. Whether all invariants held and every line is as expected.
///
/// # Errors
/// If a scenario or the file of expected lines cannot be used, or nothing can be printed.
pub fn run(args: &FingerprintArgs) -> anyhow::Result<bool> {
    let expected = args.expect.as_deref().map(read).transpose()?;
    let here = format!("processor {}", processor());
    say(&here)?;
    let expected = expected.filter(|lines| lines.contains(&here));
    if args.expect.is_some() && expected.is_none() {
        say("skipped: the expected lines are of another kind of processor; invariants alone are checked")?;
    }
    let bar = progress_bar(args.scenarios.len() as u64, "scenarios")?;
    let work = |index: u64| {
        let path = &args.scenarios[index as usize];
        let told = load(path).and_then(|scenario| {
            let name = scenario.name.clone();
            let outcome = Swarm::<Agent>::new(scenario, args.seed)?.run(|_| {})?;
            Ok((Line { name, seed: args.seed, trace: outcome.trace, map: map_digest(&outcome) }, outcome.violation))
        });
        bar.inc(1);
        Some(told)
    };
    let (mut good, mut errors) = (true, Vec::new());
    Band(0, args.scenarios.len() as u64).for_each(jobs(args.jobs), work, |index, told| {
        let told = told.and_then(|(line, violation)| {
            let mut text = line.to_string();
            if let Some(violation) = violation {
                good = false;
                let path = args.scenarios[index as usize].display();
                text += &format!(
                    "\nBROKEN   seed {}, at {:.3} s: {}\n         {}\nREPLAY   merganser-sim run {path} --seed {}",
                    args.seed, violation.at_secs, violation.invariant, violation.what, args.seed
                );
            }
            if let Some(difference) = expected.as_ref().and_then(|lines| difference(lines, &line)) {
                good = false;
                text += &format!("\nCHANGED  {difference}");
            }
            Ok(bar.suspend(|| say(&text))?)
        });
        errors.extend(told.err());
    });
    bar.finish_and_clear();
    errors.into_iter().next().map_or(Ok(good), Err)
}

/// The kind of processor, as far as results depend on it.
fn processor() -> String {
    #[cfg(target_arch = "x86_64")]
    let wide = [
        ("avx512", std::arch::is_x86_feature_detected!("avx512f")),
        ("avx2", std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")),
    ];
    #[cfg(not(target_arch = "x86_64"))]
    let wide: [(&str, bool); 0] = [];
    let wide: Vec<&str> = wide.iter().filter(|(_, has)| *has).map(|(name, _)| *name).collect();
    [&[std::env::consts::ARCH], &wide[..]].concat().join(" ")
}

fn say(text: &str) -> std::io::Result<()> {
    writeln!(std::io::stdout().lock(), "{text}")
}

/// What one scenario comes to.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Line {
    name: String,
    seed: u64,
    trace: Hash,
    map: Hash,
}

impl core::fmt::Display for Line {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{:<10} {} {} {}", self.name, self.seed, self.trace, self.map)
    }
}

/// The lines of a file, each with scenario and seed in front.
fn read(path: &Path) -> anyhow::Result<Vec<String>> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    Ok(text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.starts_with('#'))
        .map(String::from)
        .collect())
}

/// What is not as expected, in a sentence.
fn difference(expected: &[String], line: &Line) -> Option<String> {
    let words = |text: &str| text.split_whitespace().map(String::from).collect::<Vec<_>>();
    let found = words(&line.to_string());
    let Some(wanted) = expected.iter().map(|text| words(text)).find(|words| words.starts_with(&found[..2])) else {
        return Some(format!("no line is expected for {} with seed {}: add the one above", line.name, line.seed));
    };
    let moved: Vec<&str> = ["the trace", "the map"]
        .into_iter()
        .zip(2..)
        .filter(|(_, column)| wanted.get(*column) != found.get(*column))
        .map(|(what, _)| what)
        .collect();
    let moved = moved.join(" and ");
    (!moved.is_empty()).then(|| {
        format!("{moved} of {}: not as expected; a change that means to must say so, and replace the line", line.name)
    })
}

/// BLAKE3 over the joint estimates of all robots at the end: frames, anchors and weights, bit by bit.
fn map_digest(outcome: &Outcome<Agent>) -> Hash {
    let mut hasher = blake3::Hasher::new();
    for robot in &outcome.robots {
        hasher.update(robot.name.as_bytes());
        let Some(Snapshot { frames, map, graph, .. }) = &robot.snapshot else { continue };
        let mut number = |x: f64| {
            hasher.update(&x.to_bits().to_le_bytes());
        };
        frames.frames.iter().for_each(|frame| relation(&mut number, frame.t_own_frame.as_ref()));
        for submap in &map.submaps {
            pose(&mut number, &submap.t_frame_anchor);
            relation(&mut number, submap.t_own_anchor.as_ref());
        }
        graph.edges.iter().for_each(|edge| number(edge.weight));
        number(graph.chi2);
    }
    Hash(*hasher.finalize().as_bytes())
}

/// Nothing known is one number, that no relation begins with.
fn relation(number: &mut impl FnMut(f64), relation: Option<&RelationView>) {
    match relation {
        None => number(f64::NAN),
        Some(RelationView { pose: mean, covariance, .. }) => {
            pose(number, mean);
            covariance.iter().for_each(|x| number(*x));
        }
    }
}

fn pose(number: &mut impl FnMut(f64), pose: &PoseView) {
    pose.translation.iter().chain(&pose.rotation).chain([&pose.scale]).for_each(|x| number(*x));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(trace: u8, map: u8) -> Line {
        Line { name: "three".into(), seed: 1, trace: Hash([trace; 32]), map: Hash([map; 32]) }
    }

    #[test]
    fn a_line_that_differs_or_is_missing_is_told() {
        let expected = [line(1, 2).to_string()];
        assert_eq!(difference(&expected, &line(1, 2)), None);
        let told = |line| difference(&expected, &line).unwrap();
        assert!(told(line(3, 2)).starts_with("the trace of three"));
        assert!(told(line(1, 3)).starts_with("the map of three"));
        assert!(told(line(4, 3)).starts_with("the trace and the map of three"));
        assert!(told(Line { seed: 2, ..line(1, 2) }).starts_with("no line is expected for three with seed 2"));
    }

    #[test]
    fn every_number_of_an_estimate_counts() {
        let digest = |change: &dyn Fn(&mut RelationView)| {
            let mut view = RelationView {
                pose: PoseView { translation: [1.0, 2.0, 3.0], rotation: [0.0, 0.0, 0.0, 1.0], scale: 1.0 },
                covariance: vec![1.0; 21],
                sigmas: vec![1.0; 6],
            };
            change(&mut view);
            let mut numbers = Vec::new();
            relation(&mut |x| numbers.push(x.to_bits()), Some(&view));
            numbers
        };
        let same = digest(&|_| ());
        assert_eq!(same.len(), 3 + 4 + 1 + 21);
        assert_ne!(same, digest(&|view| view.pose.translation[2] += 1e-15 * 4.0));
        assert_ne!(same, digest(&|view| view.pose.rotation[0] = -0.0));
        assert_ne!(same, digest(&|view| view.pose.scale = 1.0 + f64::EPSILON));
        assert_ne!(same, digest(&|view| view.covariance[20] = 1.0 + f64::EPSILON));
    }
}
