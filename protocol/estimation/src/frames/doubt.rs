//! Which members of an answer may be false, what the answer would be without them, and how far that would move it.
//!
//! Evidence weighs a member against chance spread evenly over the search volume. False alignments crowd where true ones
//! are (robots that know the vertical, places that look alike because they are near): *measured* over 28,000 worlds of
//! `merganser-sim bench frames`, about [`NEAR_MISSES`] times as densely. With the share of the others in the place of a
//! prior, a member that adds g to the evidence of a set of k, beside f false ones, is false with odds
//! NEAR_MISSES (f + ½) / k e^(−g) ([`Odds`]); in these worlds the odds hold within a factor of two from g = 8 to 12.
//!
//! What is merged wrongly looks alike: true alignments crowd in a short stretch, so that they predict little elsewhere,
//! and a near miss elsewhere, which passes every gate because they do, turns the whole. So no merge hangs on a doubtful
//! member.

use super::clique::{self, Set, bit};
use super::evidence::Evidence;
use super::gls::Gls;
use super::hypothesis::{self, Hypothesis};
use super::measured::Measured;
use super::pairs::Pairs;
use super::scaled::Scaled;
use libm::{exp, log};
use nalgebra::{SMatrix, Vector3};

/// How much denser false alignments lie near the truth than spread evenly, in space.
const NEAR_MISSES: f64 = 60.0;
/// The same in the plane, where no heights and tilts lie together: *measured* over 4,500 planar worlds, 53 members that
/// add 7 to 13 to the evidence were false where odds without this factor say 1.5.
const NEAR_MISSES_IN_PLANE: f64 = 35.0;
/// Rounds in which the number of false alignments settles; it falls from round to round.
const ROUNDS: usize = 12;
/// Odds of being false from which a member is doubtful.
const DOUBTFUL: f64 = 0.02;
/// Odds below which the covariance does not reckon with a member's being false.
const NEGLIGIBLE: f64 = 1e-4;

/// What doubt remains about an answer.
pub(super) struct Doubt<const N: usize> {
    /// Members without the doubtful ones.
    pub(super) certain: Set,
    /// How far the doubtful ones move β's map, times the probability that one is false; 0 if there are none.
    pub(super) risk: f64,
    /// What the covariance grows by when marginalised over which member may be false.
    pub(super) covariance: SMatrix<f64, N, N>,
}

impl<const N: usize> Doubt<N> {
    /// About `answer`. Two alone stay beyond doubt: neither says which of them is false.
    pub(super) fn of<G: Scaled<N>>(
        measured: &Measured<'_, N, G>,
        pairs: &Pairs,
        evidence: &mut Evidence<'_, N, G>,
        answer: &Hypothesis<N, G>,
    ) -> Self {
        let set = answer.set;
        let mut doubt = Self { certain: set, risk: 0.0, covariance: SMatrix::zeros() };
        if set.count_ones() <= 2 {
            return doubt;
        }
        let (mut doubts, of) = (0.0, Odds::of(evidence, measured.alignments.len(), set));
        for l in clique::vertices(set) {
            let odds = of.of_false(evidence.of_member(set, l));
            let p = odds / (1.0 + odds);
            if odds > DOUBTFUL {
                doubt.certain &= !bit(l);
                doubts += p;
            }
            if odds > NEGLIGIBLE
                && let Some(without) = solve(measured, pairs, set & !bit(l))
            {
                let apart = answer.t_alpha_beta().local(&without.t_alpha_beta);
                let between = apart * apart.transpose() * (1.0 - p);
                doubt.covariance += (between + without.covariance - answer.covariance()) * p;
            }
        }
        if doubt.certain != set {
            let shift = solve(measured, pairs, doubt.certain)
                .map_or(f64::INFINITY, |certain| shift(measured, answer.t_alpha_beta(), &certain.t_alpha_beta));
            doubt.risk = doubts * shift;
        }
        doubt
    }
}

/// How common false alignments are beside a set of true ones.
#[derive(Clone, Copy, Debug)]
pub(super) struct Odds {
    /// False ones to one that is true, before evidence.
    prior: f64,
    near_misses: f64,
}

impl Odds {
    /// Beside `set` of `n` alignments. The others count as false as far as they contradict it: one that is too vague to
    /// say anything is as likely false as any, whatever that is, so that the number of the false is the largest that
    /// agrees with the odds that follow from it. Near misses are no part of that: vague alignments are no nearer than
    /// chance.
    pub(super) fn of<const N: usize, G: Scaled<N>>(evidence: &mut Evidence<'_, N, G>, n: usize, set: Set) -> Self {
        let others: Vec<f64> = (0..n).filter(|&l| set & bit(l) == 0).map(|l| evidence.gain(set, l)).collect();
        let prior = |false_ones: f64| (false_ones + 0.5) / f64::from(set.count_ones().max(1));
        let mut false_ones = others.len() as f64;
        for _ in 0..ROUNDS {
            let prior = prior(false_ones);
            false_ones = others.iter().map(|&gain| prior / (prior + exp(gain))).sum();
        }
        Self { prior: prior(false_ones), near_misses: near_misses(N) }
    }

    /// Odds that an alignment is false which adds `gain` to the evidence of the set.
    pub(super) fn of_false(&self, gain: f64) -> f64 {
        self.near_misses * self.prior * exp(-gain)
    }
}

/// How much less than in space a member must add where one has `dimension` degrees of freedom, as a logarithm: as much
/// less as near misses are fewer.
pub(super) fn relief(dimension: usize) -> f64 {
    log(NEAR_MISSES / near_misses(dimension))
}

fn near_misses(dimension: usize) -> f64 {
    if dimension == 3 { NEAR_MISSES_IN_PLANE } else { NEAR_MISSES }
}

fn solve<const N: usize, G: Scaled<N>>(measured: &Measured<'_, N, G>, pairs: &Pairs, set: Set) -> Option<Gls<N, G>> {
    if set == 0 {
        return None;
    }
    let (_, hub) = pairs.log10_nfa(measured, set);
    Gls::solve(measured, set, hypothesis::start(measured, pairs, set, hub)?)
}

/// How far apart two T_αβ lay β's map, α's units: its middle, and an anchor at a typical distance, turned about any
/// axis.
fn shift<const N: usize, G: Scaled<N>>(measured: &Measured<'_, N, G>, a: &G, b: &G) -> f64 {
    let anchors = || (0..measured.beta.len()).filter_map(|k| measured.beta.pose(k)).map(|pose| pose.translation);
    let count = measured.beta.len().max(1) as f64;
    let middle = anchors().sum::<Vector3<f64>>() / count;
    let radius = (anchors().map(|p| (p - middle).norm_squared()).sum::<f64>() / count).sqrt() * a.scale();
    let place = |t: &G| t.rotation().matrix() * middle * t.scale() + t.translation();
    let turn = (a.rotation().inverse() * b.rotation()).angle();
    let stretch = b.scale() / a.scale() - 1.0;
    ((place(a) - place(b)).norm_squared() + radius * radius * (turn * turn + stretch * stretch)).sqrt()
}
