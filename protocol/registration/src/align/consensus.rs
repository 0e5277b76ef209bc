//! The whole estimator: search from tight to loose, accept by false alarms, look for a rival, refine, state the
//! uncertainty.

use super::accept::{self, COUNT_MIN, Significance};
use super::covariance::{self, Estimate};
use super::prepare::{self, Matches};
use super::refine::{self, Context, Fit};
use super::sample::{Candidate, Sampler, Step};
use super::solve::Motion;
use super::{AlignError, Alignment, Model, Problem, Refusal, SolverConfig, Standing};
use nalgebra::Vector3;

/// Prefixes of the matches searched: rigid, with scale. The costlier the search, the finer the steps; the largest
/// bounds time and memory, which grow with its square and worse.
const PREFIXES: [&[usize]; 2] = [&[128, 512, 2048, 8192], &[128, 256, 1024, 2048]];
/// σ levels, σ_max over 2^level, each with its relative cost, or doubt that it is the right one: σ_max is commonly 3–10
/// × the truth, and the tighter graph is the cheaper. With scale one level serves for noise from a half to three times
/// its own.
const LEVELS: [&[(u32, usize)]; 2] = [&[(0, 16), (1, 5), (2, 4), (3, 6), (4, 10)], &[(1, 24), (2, 4), (4, 16)]];
/// Candidates evaluated on all matches, per step.
const EVALUATED: usize = 3;
/// A candidate whose log₁₀ NFA in a prefix is beyond this is not evaluated,
const PREFIX_MAX: f64 = 2.5;
/// nor one that is so far from the bar on all matches.
const WHOLE_MARGIN: f64 = 3.0;
/// Matches of a rival expected in the prefix in which it is sought.
const RIVAL_EXPECTED: f64 = 14.0;
/// Motions whose scales differ by more than this factor do not share pairs of matches.
const RIVAL_SCALE: f64 = 1.2;
/// An inlier lies within so many σ̂: the 99 % quantile of χ₃, and a margin.
const INLIER_REACH: f64 = 4.0;

/// Finds the motion that maps source to target.
///
/// Same matches in any order and same `config` give the same result, to the bit.
///
/// # Errors
/// [`AlignError`] if the call is malformed; that there is no alignment is not an error but a [`Refusal`].
pub fn align(problem: &Problem, config: &SolverConfig) -> Result<Result<Alignment, Refusal>, AlignError> {
    let matches = prepare::prepare(problem, config)?;
    Ok(Search::new(&matches, config).run())
}

/// The estimator with its settings, checked once: [`align`] as a value.
#[derive(Clone, Debug, PartialEq)]
pub struct SigmaConsensus {
    config: SolverConfig,
}

impl SigmaConsensus {
    /// # Errors
    /// [`AlignError::BadConfig`], naming the first setting out of range.
    pub fn new(config: SolverConfig) -> Result<Self, AlignError> {
        config.check()?;
        Ok(Self { config })
    }

    /// The settings.
    pub fn config(&self) -> &SolverConfig {
        &self.config
    }

    /// See [`align`].
    ///
    /// # Errors
    /// [`AlignError`] if the problem is malformed.
    pub fn solve(&self, problem: &Problem) -> Result<Result<Alignment, Refusal>, AlignError> {
        align(problem, &self.config)
    }
}

/// A fit that was evaluated on all matches.
struct Evaluated {
    fit: Fit,
    significance: Significance,
    /// Σ of inlier probabilities over matches that count.
    support: f64,
}

struct Search<'a> {
    context: Context<'a>,
    config: &'a SolverConfig,
    sampler: Sampler,
    candidates: Vec<Candidate>,
    refine: refine::Scratch,
    accept: accept::Scratch,
    /// Best that was not accepted.
    refused: Significance,
    refused_support: f64,
    /// Smallest rotation uncertainty among significant but degenerate fits.
    degenerate: Option<f64>,
}

/// Where the search stands: a prefix of the pool and a σ level.
#[derive(Clone, Copy)]
struct Stage {
    prefix: usize,
    level: u32,
}

impl<'a> Search<'a> {
    fn new(matches: &'a Matches, config: &'a SolverConfig) -> Self {
        let with_scale = matches!(config.model, Model::Similarity { .. });
        let scale_range = config.model.scale_range();
        let sigma_max = config.sigma_max;
        let volume = matches.chance.volume(2.0 * sigma_max);
        Self {
            context: Context { matches, with_scale, scale_range, sigma_max, volume },
            config,
            sampler: Sampler::default(),
            candidates: Vec::new(),
            refine: refine::Scratch::default(),
            accept: accept::Scratch::default(),
            refused: Significance { log10_nfa: libm::log10(matches.len().max(1) as f64), count: 0 },
            refused_support: 0.0,
            degenerate: None,
        }
    }

    fn run(mut self) -> Result<Alignment, Refusal> {
        let needed = (self.config.support_min.ceil() as usize).max(COUNT_MIN);
        if self.context.matches.inliers_max < needed {
            return Err(Refusal::TooFew { distinct: self.context.matches.inliers_max, needed });
        }
        let pool: Vec<u32> = (0..self.context.matches.len() as u32).collect();
        let Some((mut best, stage)) = self.first_accepted(&pool) else {
            return Err(match self.degenerate {
                Some(rotation_sigma) => Refusal::Degenerate { rotation_sigma },
                None => Refusal::NoConsensus { log10_nfa: self.refused.log10_nfa, support: self.refused_support },
            });
        };
        if let Some(rival) = self.rival(&best, stage) {
            let (a, b) = (best.support, rival.support);
            if a.min(b) >= self.config.rival_ratio * a.max(b) {
                let apart = self.apart(&best.fit.motion, &rival.fit.motion);
                return Err(Refusal::Ambiguous { support: a.max(b), rival_support: a.min(b), apart });
            }
            if b > a {
                best = rival;
            }
        }
        self.conclude(best)
    }

    /// How far from one another two motions put the middle of the sources, which are counted from there, in units of
    /// their root mean square distance from it.
    fn apart(&self, a: &Motion, b: &Motion) -> f64 {
        let source = &self.context.matches.source;
        let mean = source.iter().map(Vector3::norm_squared).sum::<f64>() / source.len().max(1) as f64;
        (a.translation - b.translation).norm() / (a.scale * mean.sqrt()).max(f64::MIN_POSITIVE)
    }

    /// Searches growing prefixes and σ levels until a fit is accepted; else the best provisional one of all.
    fn first_accepted(&mut self, pool: &[u32]) -> Option<(Evaluated, Stage)> {
        let bar = self.config.log10_nfa_provisional.unwrap_or(self.config.log10_nfa_max);
        let mut best: Option<(Evaluated, Stage)> = None;
        for stage in stages(pool.len(), self.context.with_scale) {
            let Some(found) = self.step(pool, stage, self.context.scale_range, bar, None) else { continue };
            let nfa = found.significance.log10_nfa;
            if best.as_ref().is_none_or(|(b, _)| nfa < b.significance.log10_nfa) {
                best = Some((found, stage));
            }
            if nfa <= self.config.log10_nfa_max {
                return best;
            }
        }
        best
    }

    /// One prefix at one σ level, for scales within `scales`: the best fit with log₁₀ NFA up to `bar`. Matches in
    /// `taken` do not count.
    fn step(
        &mut self,
        pool: &[u32],
        stage: Stage,
        scales: (f64, f64),
        bar: f64,
        taken: Option<&[bool]>,
    ) -> Option<Evaluated> {
        let sigma = self.config.sigma_max / f64::from(1_u32 << stage.level);
        let prefix = &pool[..stage.prefix.min(pool.len())];
        let step = Step { sigma, scales, hypotheses_max: self.config.hypotheses_max };
        let mut candidates = core::mem::take(&mut self.candidates);
        self.sampler.propose(&self.context, prefix, &step, &mut candidates);
        self.candidates = candidates;
        let whole = prefix.len() == self.context.matches.len();
        let hopeless = if whole { bar + WHOLE_MARGIN } else { PREFIX_MAX };
        self.best_candidate(EVALUATED, hopeless, bar, taken)
    }

    /// The best fit of the first `count` candidates with log₁₀ NFA up to `bar`.
    fn best_candidate(&mut self, count: usize, hopeless: f64, bar: f64, taken: Option<&[bool]>) -> Option<Evaluated> {
        let candidates = core::mem::take(&mut self.candidates);
        let mut best: Option<Evaluated> = None;
        for candidate in candidates.iter().take(count) {
            if -candidate.worth.score * core::f64::consts::LOG10_E > hopeless {
                break;
            }
            let Some(found) = self.evaluate(candidate, bar, taken) else { continue };
            if best.as_ref().is_none_or(|b| found.significance.log10_nfa < b.significance.log10_nfa) {
                best = Some(found);
            }
        }
        self.candidates = candidates;
        best
    }

    /// Refines a candidate on all matches; `None` unless it is significant, supported and well determined.
    fn evaluate(&mut self, candidate: &Candidate, bar: f64, taken: Option<&[bool]>) -> Option<Evaluated> {
        let fit = refine::em(&self.context, candidate.motion, &mut self.refine)?;
        let significance = accept::significance(&self.context, &fit, taken, &mut self.accept);
        if significance.log10_nfa > bar || (significance.count as f64) < self.config.support_min {
            if significance.log10_nfa < self.refused.log10_nfa && taken.is_none() {
                self.refused = significance;
                self.refused_support = fit.support();
            }
            return None;
        }
        let rotation_sigma = covariance::estimate(&self.context, &fit).map_or(f64::INFINITY, |e| e.rotation_sigma);
        if rotation_sigma > self.config.rotation_sigma_max {
            self.degenerate = Some(self.degenerate.map_or(rotation_sigma, |d| d.min(rotation_sigma)));
            return None;
        }
        let counts = |i: usize| taken.is_none_or(|t| !t[i]);
        let support = (0..fit.probabilities.len()).filter(|&i| counts(i)).map(|i| fit.probabilities[i]).sum();
        Some(Evaluated { fit, significance, support })
    }

    /// The best significant fit that shares no match with `best`: sought on a prefix in which a rival of weight has
    /// [`RIVAL_EXPECTED`] matches, at the σ level that found `best`, since both come from the same noise.
    fn rival(&mut self, best: &Evaluated, stage: Stage) -> Option<Evaluated> {
        let reach = INLIER_REACH * best.fit.sigma;
        let taken: Vec<bool> = best.fit.squared.iter().map(|r2| *r2 < reach * reach).collect();
        let pool: Vec<u32> = (0..taken.len() as u32).filter(|&i| !taken[i as usize]).collect();
        let weight = self.config.rival_ratio * best.support;
        if (pool.len() as f64) < weight || pool.len() < COUNT_MIN {
            return None;
        }
        let bar = best.significance.log10_nfa.max(self.config.log10_nfa_max);
        let enough = ((RIVAL_EXPECTED / weight * pool.len() as f64) as usize).min(pool.len());
        let mut scales = self.context.scale_range;
        let accepted = best.significance.log10_nfa <= self.config.log10_nfa_max;
        if self.context.with_scale && accepted && enough <= stage.prefix {
            // The step that found `best` looked for motions of each scale apart: one of another scale is among its
            // candidates. Only near its own scale may `best` have crowded out a rival.
            let other = self.best_candidate(usize::MAX, bar + WHOLE_MARGIN, bar, Some(&taken));
            if other.is_some() {
                return other;
            }
            // A small prefix is searched at every scale again: that costs little, and noise there may hide one.
            if stage.prefix > PREFIXES[1][0] {
                let scale = best.fit.motion.scale;
                scales = (scales.0.max(scale / RIVAL_SCALE), scales.1.min(scale * RIVAL_SCALE));
            }
        }
        let prefix = enough.max(stage.prefix).min(largest(self.context.with_scale));
        self.step(&pool, Stage { prefix, level: stage.level }, scales, bar, Some(&taken))
    }

    fn conclude(&mut self, best: Evaluated) -> Result<Alignment, Refusal> {
        let reweighted = refine::reweight(&self.context, &best.fit, self.config.weighting, &mut self.refine)
            .and_then(|fit| covariance::estimate(&self.context, &fit).map(|estimate| (fit, estimate)))
            .filter(|(_, estimate)| estimate.rotation_sigma <= self.config.rotation_sigma_max);
        let plain = || covariance::estimate(&self.context, &best.fit).map(|estimate| (best.fit.clone(), estimate));
        let Some((fit, Estimate { relative, eigenvalues, .. })) = reweighted.or_else(plain) else {
            return Err(Refusal::Degenerate { rotation_sigma: f64::INFINITY });
        };
        let matches = self.context.matches;
        Ok(Alignment {
            t_target_source: relative,
            standing: match best.significance.log10_nfa <= self.config.log10_nfa_max {
                true => Standing::Accepted,
                false => Standing::Provisional,
            },
            sigma: fit.sigma * fit.motion.residual_unit(),
            inlier_probabilities: matches.distinct_of_input.iter().map(|&k| fit.probabilities[k as usize]).collect(),
            support: fit.support(),
            log10_nfa: best.significance.log10_nfa,
            weighting: fit.weighting,
            information_eigenvalues: eigenvalues,
        })
    }
}

/// Growing prefixes, each at every σ level, cheapest and likeliest first.
fn stages(n: usize, with_scale: bool) -> Vec<Stage> {
    let kind = usize::from(with_scale);
    let n = n.min(largest(with_scale));
    let prefixes = PREFIXES[kind].iter().copied().take_while(|p| p * 3 / 2 < n).chain([n]);
    let costs = |prefix| LEVELS[kind].iter().map(move |&(level, cost)| (prefix * cost, Stage { prefix, level }));
    let mut stages: Vec<(usize, Stage)> = prefixes.flat_map(costs).collect();
    stages.sort_by_key(|(cost, _)| *cost);
    stages.into_iter().map(|(_, stage)| stage).collect()
}

/// The largest prefix searched.
fn largest(with_scale: bool) -> usize {
    PREFIXES[usize::from(with_scale)].last().copied().unwrap_or(0)
}
