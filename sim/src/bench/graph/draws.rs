//! Whether the solver's covariances are honest: graphs as published, their measurements drawn anew around the solution
//! with the noise that the graph states, solved, and compared with the poses they were drawn around. Where the truth is
//! known, also how far the published graph's solution is from it, beside what honest covariances give in one draw.
//!
//! Two numbers, each 1 for honest covariances. ANEES: the mean over all poses, each relative to the first. Their errors
//! are much alike (whoever mistakes the first heading mistakes all), so that one draw says little and the mean of many
//! is asked. Joint: the error of all poses at once under the whole covariance, `χ²(truth) − χ²(minimum)` by its degrees
//! of freedom; in a large graph one draw tells.

use super::ate::anees;
use super::files::Source;
use crate::dice::Dice;
use anyhow::Context;
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::solve::Start;
use merganser_protocol::geometry::{PoseWithCovariance, Se3};
use nalgebra::Vector6;
use std::collections::BTreeMap;
use std::fmt::Write;

const ITERATIONS_MAX: usize = 100;
/// Where the mean of many draws is to lie.
const MEAN_BAND: [f64; 2] = [0.93, 1.07];
/// Standard errors that the mean of few draws may be off by.
const ERRORS: f64 = 2.576;
/// Share of draws that lie beyond the stated range, on either side.
const BEYOND: f64 = 0.025;

/// What came of one graph.
pub(super) struct Drawn {
    name: String,
    poses: usize,
    /// Of each draw.
    honesty: Vec<Honesty>,
    /// Of the published graph, where its truth is known.
    published: Option<Honesty>,
}

/// Normalised squared errors by degrees of freedom.
#[derive(Clone, Copy, Debug)]
struct Honesty {
    anees: f64,
    joint: f64,
}

/// Draws and solves a connected graph; `None` for one of several parts.
///
/// # Errors
/// A graph that cannot be solved.
pub(super) fn measure(source: &Source, draws: u32, seed: u64) -> anyhow::Result<Option<Drawn>> {
    let graph = if source.has_truth() { source.read_robots()? } else { source.read()? };
    if graph.parts().len() != 1 || !graph.has_covariances() {
        return Ok(None);
    }
    let relaxed = graph.start(Start::Chordal, ITERATIONS_MAX)?;
    let values = graph.minimise(&relaxed, ITERATIONS_MAX)?.values;
    let reference: BTreeMap<u64, Se3> = graph.poses.keys().copied().zip(values).collect();
    let planar = is_planar(&reference);
    let mut dice = Dice::new(seed, &source.name);
    let mut honesty = Vec::new();
    for _ in 0..draws {
        honesty.push(Honesty::of(&drawn(&graph, &reference, planar, &mut dice)?, &reference)?);
    }
    let truth = source.truth()?;
    let published = if truth.is_empty() { None } else { Some(Honesty::of(&graph, &truth)?) };
    Ok(Some(Drawn { name: source.name.clone(), poses: graph.poses.len(), honesty, published }))
}

/// The graph with every measurement drawn anew around `reference`; in the plane, if that is where it lies.
fn drawn(
    graph: &PoseGraph,
    reference: &BTreeMap<u64, Se3>,
    planar: bool,
    dice: &mut Dice,
) -> anyhow::Result<PoseGraph> {
    let mut out = graph.clone();
    for m in &mut out.measurements {
        let l = m.information.cholesky().with_context(|| format!("line {}: no information", m.line))?.l();
        let mut whitened = Vector6::from_fn(|_, _| dice.normal());
        if planar {
            [2, 3, 4].into_iter().for_each(|k| whitened[k] = 0.0);
        }
        // Ω = L Lᵀ, so that L⁻ᵀ n has covariance Ω⁻¹.
        let noise = l.transpose().solve_upper_triangular(&whitened).context("an information without an inverse")?;
        m.t_i_j = (reference[&m.i].inverse() * reference[&m.j]).retract(&noise);
        m.printed = m.t_i_j.rotation.matrix();
    }
    Ok(out)
}

impl Honesty {
    /// Of the graph's solution, which the truth is the start of.
    fn of(graph: &PoseGraph, truth: &BTreeMap<u64, Se3>) -> anyhow::Result<Self> {
        let true_values: Vec<Se3> = graph
            .poses
            .keys()
            .map(|id| truth.get(id).copied())
            .collect::<Option<_>>()
            .context("a pose without truth")?;
        let minimum = graph.minimise(&true_values, ITERATIONS_MAX)?;
        let at_truth = graph.solve(&true_values, 0)?.solution.chi2;
        let solved = graph.solve(&minimum.values, 0)?;
        let first = minimum.values.first().context("an empty graph")?.inverse();
        let values: BTreeMap<u64, Se3> =
            graph.poses.keys().copied().zip(minimum.values.iter().map(|t| first * *t)).collect();
        let found: BTreeMap<u64, PoseWithCovariance> = solved
            .marginals()
            .into_iter()
            .filter_map(|(id, covariance)| Some((id, PoseWithCovariance { pose: *values.get(&id)?, covariance })))
            .collect();
        let directions = if is_planar(truth) { 3 } else { 6 };
        let dof = (directions * (graph.poses.len() - 1).max(1)) as f64;
        let anees = anees(truth, &found).context("a graph of one pose")?;
        Ok(Self { anees, joint: (at_truth - minimum.chi2) / dof })
    }
}

fn is_planar(poses: &BTreeMap<u64, Se3>) -> bool {
    poses.values().all(|t| t.translation.z.abs() < 1e-6)
}

/// What many draws amount to.
struct Summary {
    mean: f64,
    standard_error: f64,
    /// What lies between the outer shares of draws.
    of_one: [f64; 2],
}

impl Summary {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut sorted: Vec<f64> = values.collect();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len().max(1) as f64;
        let mean = sorted.iter().sum::<f64>() / n;
        let variance = sorted.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        let at = |share: f64| {
            let k = (share * n) as usize;
            sorted.get(k.min(sorted.len().saturating_sub(1))).copied().unwrap_or(f64::NAN)
        };
        Self { mean, standard_error: (variance / n).sqrt(), of_one: [at(BEYOND), at(1.0 - BEYOND)] }
    }

    /// Whether the mean of ever more draws may lie in the band.
    fn may_be_one(&self) -> bool {
        let off = ERRORS * self.standard_error;
        self.mean - off <= MEAN_BAND[1] && self.mean + off >= MEAN_BAND[0]
    }
}

impl Drawn {
    /// Whether the means of many draws are 1 for all that can be told, and the published graph is like one of them.
    pub(super) fn is_good(&self) -> bool {
        let anees = Summary::of(self.honesty.iter().map(|h| h.anees));
        let joint = Summary::of(self.honesty.iter().map(|h| h.joint));
        // More cautious than need be is no lie.
        let is_like_one = |h: Honesty| h.anees <= anees.of_one[1] && h.joint <= MEAN_BAND[1].max(joint.of_one[1]);
        anees.may_be_one() && joint.may_be_one() && self.published.is_none_or(is_like_one)
    }
}

/// The rows as text.
pub(super) fn table(draws: u32, seed: u64, rows: &[Drawn]) -> String {
    let mut text = format!(
        "{draws} draws of every measurement with the noise that the graph states, seed {seed}\n\
         {:<26} {:>6}  {:>13} {:>15}  {:>13} {:>15}  {:>15}\n",
        "", "poses", "ANEES", "of one draw", "joint", "of one draw", "published"
    );
    for row in rows {
        let anees = Summary::of(row.honesty.iter().map(|h| h.anees));
        let joint = Summary::of(row.honesty.iter().map(|h| h.joint));
        let mean = |of: &Summary| format!("{:.3} ± {:.3}", of.mean, of.standard_error);
        let one = |of: &Summary| format!("{:.3} to {:.3}", of.of_one[0], of.of_one[1]);
        let published = row.published.map_or_else(|| "-".to_owned(), |h| format!("{:.3} / {:.3}", h.anees, h.joint));
        let _ = writeln!(
            text,
            "{:<26} {:>6}  {:>13} {:>15}  {:>13} {:>15}  {published:>15}",
            row.name,
            row.poses,
            mean(&anees),
            one(&anees),
            mean(&joint),
            one(&joint),
        );
    }
    text + "ANEES: normalised squared error of poses relative to the first; joint: of all poses at once; both by degrees of \
            freedom, so that 1 is honest, with the mean's standard error; of one draw: 95 % of them; published: ANEES / joint of the graph as it is, where \
            the truth is known\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::estimate::posegraph::g2o::Parser;

    /// A ring of poses with a chord, whose measurements state their noise.
    fn ring() -> PoseGraph {
        let mut parser = Parser::default();
        parser.begin();
        let n = 12;
        let at = |k: u64| {
            let turn = std::f64::consts::TAU * k as f64 / n as f64;
            Se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, turn))
                * Se3::exp(&Vector6::new(5.0, 0.0, 0.3 * k as f64, 0.0, 0.1, 0.0))
        };
        let ends = (0..n).map(|k| (k, (k + 1) % n)).chain([(0, 6)]);
        for (i, j) in ends {
            let t = at(i).inverse() * at(j);
            let [x, y, z, w] = t.rotation.xyzw();
            let p = t.translation;
            parser
                .line(&format!(
                    "EDGE_SE3:QUAT {i} {j} {} {} {} {x} {y} {z} {w} 400 0 0 0 0 0 400 0 0 0 0 100 0 0 0 2500 0 0 2500 0 2500",
                    p.x, p.y, p.z
                ))
                .unwrap();
        }
        parser.finish()
    }

    fn honesty(claim: f64) -> Drawn {
        let graph = ring();
        let start = graph.start(Start::Chordal, ITERATIONS_MAX).unwrap();
        let values = graph.minimise(&start, ITERATIONS_MAX).unwrap().values;
        let reference: BTreeMap<u64, Se3> = graph.poses.keys().copied().zip(values).collect();
        let mut dice = Dice::new(5, "ring");
        let one = |_| {
            let mut drawn = drawn(&graph, &reference, false, &mut dice).unwrap();
            drawn.measurements.iter_mut().for_each(|m| m.information *= claim);
            Honesty::of(&drawn, &reference).unwrap()
        };
        Drawn { name: "ring".into(), poses: 12, honesty: (0..600).map(one).collect(), published: None }
    }

    #[test]
    fn honest_covariances_have_ones_and_a_lie_of_a_fifth_is_seen() {
        assert!(honesty(1.0).is_good());
        assert!(!honesty(1.2).is_good());
        assert!(!honesty(0.8).is_good());
    }

    #[test]
    fn a_truth_farther_off_than_any_draw_is_seen() {
        let mut drawn = honesty(1.0);
        drawn.published = Some(Honesty { anees: 1.0, joint: 1.0 });
        assert!(drawn.is_good());
        drawn.published = Some(Honesty { anees: 9.0, joint: 1.0 });
        assert!(!drawn.is_good());
        drawn.published = Some(Honesty { anees: 1.0, joint: 2.0 });
        assert!(!drawn.is_good());
    }
}
