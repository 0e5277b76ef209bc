//! The estimator on one problem.

use super::corr::{Corr, oracle_degrees};
use super::cpu::thread_seconds;
use super::row::{Row, Status};
use anyhow::Context;
use clap::ValueEnum;
use merganser_protocol::align::{Model, POINTS_LIMIT, Problem, Refusal, SolverConfig, Standing, Weighting, align};
use merganser_protocol::geometry::{Relative, Se3, Sim3};

/// χ² quantiles at 95 % for 6 and 7 degrees of freedom.
const CHI2_95: [f64; 2] = [12.591_587_243_743_977, 14.067_140_449_340_169];
/// Scales that a similarity is searched in.
const SCALES: (f64, f64) = (0.4, 2.5);
/// Fewest matches an answer may rest on: below the agent's own bound, for cells with 5 true matches.
const SUPPORT_MIN: f64 = 4.0;
/// Answers above the accepting number of false alarms and below this are provisional.
const LOG10_NFA_PROVISIONAL: f64 = -1.0;

/// Which weights refine the answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Refinement {
    /// Whichever predicts held-out residuals better
    Auto,
    /// Posteriors of the Gaussian and uniform mixture
    Em,
    /// Kernel density weights, S(30)
    Kde,
}

impl Refinement {
    /// The solver's name in the CSV.
    pub fn solver(self) -> &'static str {
        match self {
            Self::Auto => "merganser",
            Self::Em => "merganser_em",
            Self::Kde => "merganser_kde",
        }
    }
}

/// A row and what the CSV has no column for.
#[derive(Clone, Debug, PartialEq)]
pub struct Solved {
    /// The row.
    pub row: Row,
    /// σ̂ over the true σ.
    pub sigma_ratio: Option<f64>,
    /// Whether the truth lies in the answer's 95 % ellipsoid.
    pub covered: bool,
    /// Rotation error of the least-squares fit to the true matches, °.
    pub oracle_deg: Option<f64>,
    /// Whether the kernel density weights refined it.
    pub kde: bool,
}

/// Solves one problem.
///
/// # Errors
/// A problem or a σ_max that the estimator does not take.
pub fn solve(corr: &Corr, sigma_max: f64, refinement: Refinement) -> anyhow::Result<Solved> {
    let model = match corr.problem.is_similarity() {
        true => Model::Similarity { scale_min: SCALES.0, scale_max: SCALES.1 },
        false => Model::Rigid,
    };
    let config = config(model, sigma_max, refinement);
    let problem = Problem { source: &corr.source, target: &corr.target, ..Problem::default() };
    let began = thread_seconds();
    let result = align(&problem, &config).context("cannot be aligned")?;
    let cpu_s = thread_seconds() - began;
    let mut row = Row {
        solver: refinement.solver().to_owned(),
        problem: corr.problem.clone(),
        status: Status::None,
        cpu_s,
        rot_deg: f64::NAN,
        trans: f64::NAN,
        scale_rel: f64::NAN,
    };
    let oracle_deg = oracle_degrees(corr);
    Ok(match result {
        Ok(found) => {
            let sim = found.t_target_source.sim();
            row.status = if found.standing == Standing::Accepted { Status::Ok } else { Status::Provisional };
            row.rot_deg = (sim.rotation.inverse() * corr.truth.rotation).angle().to_degrees();
            row.trans = (sim.translation - corr.truth.translation).norm();
            row.scale_rel = (sim.scale / corr.truth.scale - 1.0).abs();
            Solved {
                row,
                sigma_ratio: Some(found.sigma / corr.sigma),
                covered: covers(&found.t_target_source, &corr.truth),
                oracle_deg,
                kde: found.weighting == Weighting::Kde,
            }
        }
        Err(refusal) => {
            row.status = if matches!(refusal, Refusal::Ambiguous { .. }) { Status::Ambiguous } else { Status::None };
            Solved { row, sigma_ratio: None, covered: false, oracle_deg, kde: false }
        }
    })
}

/// The settings that every problem is solved with.
pub fn config(model: Model, sigma_max: f64, refinement: Refinement) -> SolverConfig {
    SolverConfig {
        model,
        sigma_max,
        support_min: SUPPORT_MIN,
        log10_nfa_provisional: Some(LOG10_NFA_PROVISIONAL),
        weighting: match refinement {
            Refinement::Auto => Weighting::Auto,
            Refinement::Em => Weighting::Em,
            Refinement::Kde => Weighting::Kde,
        },
        points_max: POINTS_LIMIT,
        ..SolverConfig::default()
    }
}

fn covers(answer: &Relative, truth: &Sim3) -> bool {
    match answer {
        Relative::Metric(p) => {
            let delta = p.pose.local(&Se3::new(truth.rotation, truth.translation));
            p.covariance.mahalanobis_squared(&delta) < CHI2_95[0]
        }
        Relative::Similarity(s) => s.covariance.mahalanobis_squared(&s.sim.local(truth)) < CHI2_95[1],
    }
}
