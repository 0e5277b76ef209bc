//! From a peer's landmarks to an alignment or a refusal.

use super::super::features::{Features, Keypoints};
use super::super::planar::{OUT_OF_PLANE_ALIGNED, in_space};
use super::flat::{self, Match, Place};
use super::gather::BITS_MAX;
use super::{Landmark, differing};
use crate::align::{AlignError, Model, Problem, Refusal, SolverConfig, align};
use crate::geometry::sim3::Matrix7;
use crate::geometry::{Covariance, Relative};
use crate::kinds::RefusalReason;
use nalgebra::{Matrix3, Vector3};
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Of the matches by label, at least this share agrees: where more lie, all are doubted.
const LABELS_AGREE_MIN: f64 = 0.6;
/// Landmarks that one may be, by their looks. More than one, so that where a place repeats itself each repetition is
/// found, and the answer is that it does.
const LOOK_ALIKES_MAX: usize = 4;
/// A second pose with this share of the support of the first makes the answer ambiguous: descriptors do not agree on a
/// pose by chance, so it tells that the place repeats itself, and which repetition is seen is then anyone's guess.
const RIVAL_RATIO_IN_SPACE: f64 = 0.1;
/// A rival that puts the middle of theirs so far from where the first pose does, in units of their spread, sees another
/// place; nearer, the same place turned.
const ELSEWHERE: f64 = 0.5;
/// Landmarks that lie in a plane to within so many times their noise look the same in a mirror.
const FLAT_SIGMAS: f64 = 3.0;
/// The noise scale may exceed the stated one by this factor.
const SIGMA_FACTOR: f64 = 3.0;
/// The search for similarities tells agreement from chance by matches that do not agree. Landmarks that are surely not
/// the same show it what chance looks like: a third as many as there are matches, and so many that there are this many
/// in all.
const CONTRASTED_MIN: usize = 48;
/// A match that agrees, by the consensus in space.
const AGREES: f64 = 0.5;
/// In the plane, a rival with this share of the members makes the answer ambiguous.
const RIVAL_RATIO: f64 = 0.75;
/// Largest standard deviation of the angle in the plane, rad.
const ANGLE_SIGMA_MAX: f64 = 0.25;

/// How landmarks are aligned.
#[derive(Clone, Debug, PartialEq)]
pub struct LandmarkConfig {
    /// In three degrees of freedom: all landmarks lie at z = 0, units are metres.
    pub planar: bool,
    /// The consensus in space (its `sigma_max` is raised where landmarks are less certain), and for both when to
    /// accept.
    pub solver: SolverConfig,
}

/// An alignment that passed.
#[derive(Clone, Debug, PartialEq)]
pub struct Aligned {
    /// `t_mine_theirs`: a similarity if a scale is unknown.
    pub t_mine_theirs: Relative,
    /// Noise scale, my units.
    pub sigma: f64,
    /// Landmarks that agree.
    pub support: f64,
    /// log₁₀ of the number of false alarms.
    pub log10_nfa: f64,
}

/// Why there is no alignment.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum LandmarkError {
    /// One of the submaps holds points on surfaces.
    #[error("a submap of landmarks cannot be compared with one of surfaces; set submap.sensor alike on all robots")]
    NotLandmarks,
    /// One submap is planar, the other one is not.
    #[error("planar landmarks cannot be compared with landmarks in space; set submap.sensor alike on all robots")]
    NotPlanar,
    /// Too few landmarks are common to both.
    #[error("{matches} landmarks with a common label or descriptor; {needed} are needed")]
    TooFew {
        /// How many.
        matches: usize,
        /// How many would do.
        needed: usize,
    },
    /// They do not agree on a pose.
    #[error("{members} landmarks agree, log10 of the number of false alarms {log10_nfa:.1}")]
    NoConsensus {
        /// How many agree on the best pose.
        members: usize,
        /// How likely that is by chance.
        log10_nfa: f64,
    },
    /// Most labels contradict the pose.
    #[error("{agreeing} of {labelled} labels agree on the best pose; labels must be unique")]
    LabelsLie {
        /// Matches by label that agree...
        agreeing: usize,
        /// ...of these.
        labelled: usize,
    },
    /// Two poses explain the matches about equally well.
    #[error("{members} landmarks agree on one pose, {rival} on another")]
    Ambiguous {
        /// Of the better pose.
        members: usize,
        /// Of the other.
        rival: usize,
        /// The other one sees another place, not the same one otherwise.
        elsewhere: bool,
    },
    /// All landmarks that agree lie in one plane: a mirror image would look the same.
    #[error("the landmarks lie {thickness:.3} off one plane, with noise of {sigma:.3}: a mirror image looks the same")]
    Mirror {
        /// Root mean square distance from the plane.
        thickness: f64,
        /// Noise scale.
        sigma: f64,
    },
    /// The landmarks leave a rotation undetermined.
    #[error("rotation known to {rotation_sigma:.2} rad only: landmarks on a line or in one cluster")]
    Degenerate {
        /// Standard deviation, rad.
        rotation_sigma: f64,
    },
    /// A setting or coordinate is out of range.
    #[error(transparent)]
    Solver(#[from] AlignError),
}

impl From<&LandmarkError> for RefusalReason {
    fn from(error: &LandmarkError) -> Self {
        match error {
            LandmarkError::NotLandmarks | LandmarkError::NotPlanar | LandmarkError::Solver(_) => Self::BadInput,
            LandmarkError::TooFew { .. } => Self::TooFew,
            LandmarkError::NoConsensus { .. } => Self::NoConsensus,
            LandmarkError::LabelsLie { .. } => Self::PoorFit,
            LandmarkError::Ambiguous { .. } => Self::Ambiguous,
            // Which says nothing of other places.
            LandmarkError::Mirror { .. } | LandmarkError::Degenerate { .. } => Self::Degenerate,
        }
    }
}

impl From<Refusal> for LandmarkError {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::TooFew { distinct, needed } => Self::TooFew { matches: distinct, needed },
            Refusal::NoConsensus { log10_nfa, support } => Self::NoConsensus { members: support as usize, log10_nfa },
            Refusal::Ambiguous { support, rival_support, apart } => {
                let elsewhere = apart >= ELSEWHERE;
                Self::Ambiguous { members: support as usize, rival: rival_support as usize, elsewhere }
            }
            Refusal::Degenerate { rotation_sigma } => Self::Degenerate { rotation_sigma },
        }
    }
}

/// A landmark of theirs and one of mine that may be the same.
#[derive(Clone, Copy)]
struct Pairing<'a> {
    theirs: &'a Landmark,
    mine: &'a Landmark,
    labelled: bool,
    /// Higher is better.
    score: f64,
}

/// Aligns their landmarks with mine.
///
/// # Errors
/// [`LandmarkError`]: a refusal with its reason, or a solver setting out of range.
pub fn register(theirs: &Keypoints, mine: &Features, config: &LandmarkConfig) -> Result<Aligned, LandmarkError> {
    let (Some(theirs), Some(mine)) = (&theirs.landmarks, &mine.landmarks) else {
        return Err(LandmarkError::NotLandmarks);
    };
    let (common, ratio) = ((mine.common(), theirs.common()), theirs.voxel() / mine.voxel());
    let (theirs, mine) = (theirs.landmarks(), mine.landmarks());
    let flat = |landmarks: &[Landmark]| landmarks.iter().all(|l| l.at.z == 0.0);
    if config.planar && !(flat(&theirs) && flat(&mine)) {
        return Err(LandmarkError::NotPlanar);
    }
    let pairings = pairings(&theirs, &mine);
    let mut aligned =
        if config.planar { in_plane(&pairings, &theirs, &mine, config) } else { spatial(&pairings, ratio, config) }?;
    // Mine moved by exp(m) and theirs by exp(t): T exp(Ad(T⁻¹) m − t).
    match &mut aligned.t_mine_theirs {
        Relative::Metric(p) => {
            let ad = p.pose.inverse().adjoint();
            let both = ad * common.0.matrix() * ad.transpose() + common.1.matrix();
            p.covariance = Covariance::new_or_wider(p.covariance.matrix() + both);
        }
        Relative::Similarity(s) => {
            let lifted = |m: &Covariance<6>| {
                let mut seven = Matrix7::zeros();
                seven.fixed_view_mut::<6, 6>(0, 0).copy_from(m.matrix());
                seven
            };
            let ad = s.sim.inverse().adjoint();
            let both = ad * lifted(&common.0) * ad.transpose() + lifted(&common.1);
            s.covariance = Covariance::new_or_wider(s.covariance.matrix() + both);
        }
    }
    Ok(aligned)
}

/// Landmarks of one label, if only one on either side has it; and those without a label that look alike. Best first.
fn pairings<'a>(theirs: &'a [Landmark], mine: &'a [Landmark]) -> Vec<Pairing<'a>> {
    let (their_labels, my_labels) = (unique(theirs), unique(mine));
    let by_label = their_labels.iter().filter_map(|(label, theirs)| {
        let mine = my_labels.get(label)?;
        Some(Pairing { theirs, mine, labelled: true, score: 2.0 })
    });
    let mut pairings: Vec<Pairing> = by_label.collect();
    let bare = |all: &'a [Landmark]| -> Vec<&'a Landmark> { all.iter().filter(|l| l.mark.label.is_none()).collect() };
    let (bare_theirs, bare_mine) = (bare(theirs), bare(mine));
    let back: Vec<Vec<(u32, usize)>> = bare_mine.iter().map(|l| alike(l, &bare_theirs)).collect();
    for (t, theirs) in bare_theirs.iter().enumerate() {
        for (bits, m) in alike(theirs, &bare_mine) {
            if back[m].iter().any(|&(_, b)| b == t) {
                let score = 1.0 / (1.0 + f64::from(bits));
                pairings.push(Pairing { theirs, mine: bare_mine[m], labelled: false, score });
            }
        }
    }
    pairings.sort_by(|a, b| b.score.total_cmp(&a.score));
    pairings
}

/// The landmark of each label that only one has.
fn unique(landmarks: &[Landmark]) -> BTreeMap<u32, &Landmark> {
    let mut all = BTreeMap::new();
    let mut twice = BTreeSet::new();
    for landmark in landmarks {
        if let Some(label) = landmark.mark.label
            && all.insert(label, landmark).is_some()
        {
            twice.insert(label);
        }
    }
    all.retain(|label, _| !twice.contains(label));
    all
}

/// Those of `others` that look most like the landmark, and in how many bits they differ; nearest first.
fn alike(landmark: &Landmark, others: &[&Landmark]) -> Vec<(u32, usize)> {
    let Some(own) = landmark.mark.descriptor else { return Vec::new() };
    let mut found: Vec<(u32, usize)> = Vec::new();
    for (k, other) in others.iter().enumerate() {
        let Some(descriptor) = &other.mark.descriptor else { continue };
        let bits = differing(&own, descriptor);
        if bits <= BITS_MAX && (found.len() < LOOK_ALIKES_MAX || found.last().is_some_and(|&(most, _)| bits < most)) {
            found.truncate(LOOK_ALIKES_MAX - 1);
            found.insert(found.partition_point(|&(b, _)| b <= bits), (bits, k));
        }
    }
    found
}

/// Refuses where too few of the labels agree.
fn check_labels(pairings: &[Pairing], agrees: impl Fn(usize) -> bool) -> Result<(), LandmarkError> {
    let labelled = pairings.iter().filter(|p| p.labelled).count();
    let agreeing = (0..pairings.len()).filter(|&k| pairings[k].labelled && agrees(k)).count();
    if (agreeing as f64) < LABELS_AGREE_MIN * labelled as f64 {
        return Err(LandmarkError::LabelsLie { agreeing, labelled });
    }
    Ok(())
}

fn in_plane(
    pairings: &[Pairing],
    theirs: &[Landmark],
    mine: &[Landmark],
    config: &LandmarkConfig,
) -> Result<Aligned, LandmarkError> {
    let place = |l: &Landmark| Place {
        at: l.at.xy(),
        covariance: l.mark.covariance.matrix().fixed_view::<2, 2>(0, 0).into_owned(),
    };
    let matches: Vec<Match> =
        pairings.iter().map(|p| Match { theirs: place(p.theirs), mine: place(p.mine), labelled: p.labelled }).collect();
    let area = area(theirs).max(area(mine));
    let agreed = flat::agree(&matches, area, RIVAL_RATIO, ANGLE_SIGMA_MAX)?;
    let members: BTreeSet<usize> = agreed.members.iter().copied().collect();
    check_labels(pairings, |k| members.contains(&k) || k >= flat::MATCHES_MAX)?;
    if agreed.log10_nfa > config.solver.log10_nfa_max {
        return Err(LandmarkError::NoConsensus { members: members.len(), log10_nfa: agreed.log10_nfa });
    }
    let pose = in_space(&agreed.pose, 1.0, &agreed.covariance, OUT_OF_PLANE_ALIGNED);
    Ok(Aligned {
        t_mine_theirs: Relative::Metric(pose),
        sigma: agreed.rms,
        support: members.len() as f64,
        log10_nfa: agreed.log10_nfa,
    })
}

/// Of the box around landmarks in the plane.
fn area(landmarks: &[Landmark]) -> f64 {
    let edge = |axis: usize| {
        let (low, high) = landmarks.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high): (f64, f64), l| {
            (low.min(l.at[axis]), high.max(l.at[axis]))
        });
        (high - low).max(0.0)
    };
    // Landmarks on a line leave no area; a wrong one could still lie as far off the line as along it.
    let (x, y) = (edge(0), edge(1));
    x.max(0.25 * y) * y.max(0.25 * x)
}

/// `ratio` is their voxel over mine.
fn spatial(pairings: &[Pairing], ratio: f64, config: &LandmarkConfig) -> Result<Aligned, LandmarkError> {
    let (count, needed) = (pairings.len(), config.solver.support_min.ceil() as usize);
    if count < needed {
        return Err(LandmarkError::TooFew { matches: count, needed });
    }
    let decoys = match config.solver.model {
        Model::Rigid => 0,
        Model::Similarity { .. } => (count / 3).max(CONTRASTED_MIN.saturating_sub(count)),
    };
    let crossed =
        |k: usize| Pairing { mine: pairings[(k + 1 + k / count) % count].mine, score: 0.0, ..pairings[k % count] };
    let tried: Vec<Pairing> = pairings.iter().copied().chain((0..decoys).map(crossed)).collect();
    let place = |l: &Landmark| -> ([f64; 3], Covariance<3>) { (l.at.into(), l.mark.covariance) };
    let (source, source_covariances): (Vec<_>, Vec<_>) = tried.iter().map(|p| place(p.theirs)).unzip();
    let (target, target_covariances): (Vec<_>, Vec<_>) = tried.iter().map(|p| place(p.mine)).unzip();
    let scores: Vec<f64> = tried.iter().map(|p| p.score).collect();
    // Of two units the solver counts in the coarser: that in which the same noise has the larger number.
    let typical = |pick: for<'a> fn(&Pairing<'a>) -> &'a Landmark| {
        let mut sigmas: Vec<f64> =
            pairings.iter().map(|p| (pick(p).mark.covariance.matrix().trace() / 3.0).sqrt()).collect();
        sigmas.sort_by(f64::total_cmp);
        sigmas.get(sigmas.len() / 2).copied().unwrap_or(0.0)
    };
    let stated = typical(|p| p.theirs).max(typical(|p| p.mine));
    let coarser = if config.solver.model == Model::Rigid { 1.0 } else { ratio.max(1.0) };
    let sigma_max = (coarser * config.solver.sigma_max).max(SIGMA_FACTOR * stated);
    let solver = SolverConfig { sigma_max, rival_ratio: RIVAL_RATIO_IN_SPACE, ..config.solver.clone() };
    let problem = Problem {
        source: &source,
        target: &target,
        scores: Some(&scores),
        source_covariances: Some(&source_covariances),
        target_covariances: Some(&target_covariances),
    };
    let found = align(&problem, &solver)??;
    let agrees = |k: usize| found.inlier_probabilities.get(k).is_some_and(|&p| p >= AGREES);
    check_labels(pairings, agrees)?;
    let members: Vec<Vector3<f64>> = (0..count).filter(|&k| agrees(k)).map(|k| target[k].into()).collect();
    let thickness = thickness(&members);
    let scale = found.t_target_source.sim().scale.min(1.0);
    if thickness < FLAT_SIGMAS * found.sigma * scale {
        return Err(LandmarkError::Mirror { thickness, sigma: found.sigma });
    }
    Ok(Aligned {
        t_mine_theirs: found.t_target_source,
        sigma: found.sigma,
        support: found.support,
        log10_nfa: found.log10_nfa,
    })
}

/// Root mean square distance of points from the plane that fits them best.
fn thickness(points: &[Vector3<f64>]) -> f64 {
    let count = points.len().max(1) as f64;
    let middle = points.iter().sum::<Vector3<f64>>() / count;
    let scatter: Matrix3<f64> = points.iter().map(|p| (p - middle) * (p - middle).transpose()).sum();
    (scatter.symmetric_eigenvalues().min().max(0.0) / count).sqrt()
}
