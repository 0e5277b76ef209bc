//! Is the merged map right, and does it know how right it is? Every frame alignment is compared with the truth of the
//! recordings: error e = log(t_true⁻¹ t_estimated), and NEES = eᵀ Σ⁻¹ e with the covariance the robots state (of the
//! local perturbation, MATH §1), which is χ²₆ if the covariance is honest; χ²₇ where a robot's unit is unknown, and the
//! error has a scale. All functions here are pure.

use super::certainty::Certainty;
use super::track::Track;
use super::trajectory::{self, Corrected, TrajectoryError};
use super::views::{Views, relative};
use merganser_protocol::geometry::{PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, chi2};
use merganser_protocol::snapshot::{PairStatus, PairView};
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::SVector;

/// χ²₆ at 95 %: one honest error in twenty lies outside.
pub const CHI2_6_95: f64 = chi2::P95[5];
/// χ²₆ at 99.9 %: an error outside is no accident.
pub const CHI2_6_999: f64 = chi2::P999[5];
/// χ²₇ at 95 %, for similarities...
pub const CHI2_7_95: f64 = chi2::P95[6];
/// ...and at 99.9 %.
const CHI2_7_999: f64 = chi2::P999[6];
/// How far off a scale may be, share.
const SCALE_OFF_MAX: f64 = 0.05;
/// Units this close are one unit, share.
const SAME_UNIT: f64 = 1e-9;
/// Estimates of different robots may differ by this, m (or units), rad and log-scale.
const SAME: f64 = 1e-6;

/// How large the error of a frame alignment may be: a goal for data that are known. Of others only what the robots claim
/// can be judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Translation, m.
    pub translation_m: f64,
    /// Rotation, degrees.
    pub rotation_deg: f64,
}

/// An estimate's error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseError {
    /// log(t_true⁻¹ t_estimated), (ρ, φ, λ); λ is log-scale, 0 for a rigid estimate of frames whose units are the same.
    pub xi: SVector<f64, 7>,
    /// Length of the difference of the translations, m.
    pub translation_m: f64,
    /// Angle between the rotations, degrees.
    pub rotation_deg: f64,
    /// Scale over its true value: 1 for a rigid estimate of frames whose units are the same.
    pub scale: f64,
    /// ξᵀ Σ⁻¹ ξ.
    pub nees: f64,
    /// Its degrees of freedom: 6, or 7 where there is a scale to be wrong.
    pub degrees_of_freedom: usize,
}

impl PoseError {
    /// The error of `estimate` (Σ of the local perturbation) against `truth`, where one is `unit_m` in the frame that
    /// both map into. A rigid estimate claims that the units are the same: where they are not, its error has a scale,
    /// too, far outside what it claims.
    pub fn of(estimate: &Relative, truth: &Sim3, unit_m: f64) -> Self {
        let sim = estimate.sim();
        let (xi, nees, degrees_of_freedom) = match estimate {
            Relative::Metric(t) if (truth.scale - 1.0).abs() <= SAME_UNIT => {
                let xi = truth.to_se3().local(&t.pose);
                (xi.push(0.0), t.covariance.mahalanobis_squared(&xi), 6)
            }
            _ => {
                let t = estimate.lifted();
                let xi = truth.local(&t.sim);
                (xi, t.covariance.mahalanobis_squared(&xi), 7)
            }
        };
        Self {
            xi,
            translation_m: unit_m * (sim.translation - truth.translation).norm(),
            rotation_deg: (truth.rotation.inverse() * sim.rotation).angle().to_degrees(),
            scale: sim.scale / truth.scale,
            nees,
            degrees_of_freedom,
        }
    }

    /// Whether the truth lies inside the claimed 95 % ellipsoid.
    pub fn inside_95(&self) -> bool {
        self.nees <= if self.degrees_of_freedom == 7 { CHI2_7_95 } else { CHI2_6_95 }
    }

    /// By how much the scale is off, for people; nothing where there is none.
    pub fn scale_off(&self) -> String {
        if self.degrees_of_freedom < 7 {
            return String::new();
        }
        format!(", scale {:+.2} %", 100.0 * (self.scale - 1.0))
    }

    /// Whether it is within the bounds, scale included, if there are any.
    fn is_within(&self, bounds: Option<&Bounds>) -> bool {
        bounds.is_none_or(|bounds| {
            self.translation_m <= bounds.translation_m
                && self.rotation_deg <= bounds.rotation_deg
                && (self.scale - 1.0).abs() <= SCALE_OFF_MAX
        })
    }

    /// Whether the truth lies inside the claimed 99.9 % ellipsoid.
    fn inside_999(&self) -> bool {
        self.nees <= if self.degrees_of_freedom == 7 { CHI2_7_999 } else { CHI2_6_999 }
    }
}

/// What became of a pair of robots.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// The robots, in order.
    pub robots: [String; 2],
    /// Merged or why not; `None` if no alignment is known.
    pub status: Option<PairStatus>,
    /// Alignments proposed, agreed, used.
    pub alignments: [u64; 3],
    /// log₁₀ of the number of false alarms.
    pub log10_nfa: Option<f64>,
    /// `t_a_b`.
    pub t_a_b: Option<Relative>,
    /// True `t_a_b`.
    pub truth: Option<Sim3>,
    /// Their difference, by where both robots began: of a SLAM that starts at its frame's origin, that is there. The origin
    /// of map coordinates (UTM) is thousands of kilometres away, where a milliradian is kilometres.
    pub error: Option<PoseError>,
    /// That of the two anchors in the middle of what both saw: what a merge is worth shows there. The frames' origins may
    /// be far away.
    pub middle: Option<PoseError>,
    /// What the map itself says for and against it.
    pub certainty: Certainty,
    /// What became of the pairs of submaps that both tried, if none aligned.
    pub in_vain: Option<String>,
}

/// Errors of the single alignments between submaps that the joint estimate uses: whether their covariances are honest
/// before anything is joined.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Singles {
    /// Alignments whose truth is known.
    pub count: usize,
    /// Mean NEES; 6 if the covariances are honest. That of similarities counts 6/7.
    pub nees_mean: f64,
    /// Inside their 95 % ellipsoid.
    pub inside_95: usize,
    /// Root mean square error of the translation, m.
    pub translation_rms_m: f64,
    /// Root mean square error of the rotation, degrees.
    pub rotation_rms_deg: f64,
}

/// Something that must be so.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Check {
    /// What must be so.
    pub what: String,
    /// Whether it is.
    pub held: bool,
    /// How it is; in particular what is missing.
    pub found: String,
}

/// The whole verdict.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// Every pair of robots.
    pub pairs: Vec<Pair>,
    /// Every robot's path in the frame of the first robot, where merged.
    pub corrected: Vec<Option<Corrected>>,
    /// What the map says for and against the loops of each robot, in the order of the tracks.
    pub loops: Vec<Certainty>,
    /// The single alignments.
    pub singles: Singles,
    /// The paths' errors, if all merged and all truths are known.
    pub trajectory: Option<TrajectoryError>,
    /// What must be so.
    pub checks: Vec<Check>,
}

impl Evaluation {
    /// Whether every check held.
    pub fn held(&self) -> bool {
        self.checks.iter().all(|check| check.held)
    }
}

/// What is still missing before the robots can be said to be done, a line each; empty when they are.
pub fn missing(tracks: &[Track], statuses: &[Option<&merganser_protocol::snapshot::StatusView>]) -> Vec<String> {
    let mut lines = Vec::new();
    for (track, status) in tracks.iter().zip(statuses) {
        let name = &track.name;
        let Some(status) = status else {
            lines.push(format!("{name} does not answer"));
            continue;
        };
        if status.keyframes != track.odometry.len() as u64 {
            lines.push(format!("{name} has taken {} of {} keyframes", status.keyframes, track.odometry.len()));
        }
        let apart: Vec<&str> =
            others(tracks, name).filter(|other| !status.merged_with.iter().any(|m| m == other)).collect();
        if !apart.is_empty() {
            lines.push(format!("{name} has not merged with {}", apart.join(" and ")));
        }
        if !status.idle {
            lines.push(format!("{name} still works ({} pending)", status.pending));
        }
        if status.receive_only {
            lines.push(format!("{name} is receive-only; its log says why"));
        }
    }
    let mut digests: Vec<&str> = statuses.iter().flatten().map(|status| status.digest.as_str()).collect();
    digests.dedup();
    if digests.len() > 1 {
        lines.push("the robots do not hold the same facts yet".into());
    }
    lines
}

fn others<'a>(tracks: &'a [Track], name: &'a str) -> impl Iterator<Item = &'a str> {
    tracks.iter().map(|track| track.name.as_str()).filter(move |other| *other != name)
}

/// Judges the views of all robots (in the order of `tracks`) against the truth.
pub fn evaluate(tracks: &[Track], views: &[Views], bounds: Option<&Bounds>) -> Evaluation {
    let pairs = pairs(tracks, views);
    let corrected: Vec<Option<Corrected>> = match views.first() {
        Some(reference) => {
            tracks.iter().zip(views).map(|(track, own)| trajectory::correct(track, reference, own)).collect()
        }
        None => Vec::new(),
    };
    let trajectory = trajectory::errors(tracks, &corrected);
    let singles = singles(tracks, views);
    let checks = checks(tracks, views, &pairs, bounds);
    let own = |robot: &Views| Certainty::of(&views[0], &[robot.frames.own.as_str(); 2]);
    let loops = views.iter().map(own).collect();
    Evaluation { pairs, corrected, loops, singles, trajectory, checks }
}

fn pairs(tracks: &[Track], views: &[Views]) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for (i, j) in indices(tracks.len()) {
        let found = views[0].pair(&views[i].frames.own, &views[j].frames.own);
        let (a, b) = (&tracks[i], &tracks[j]);
        let truth = a.t_world_frame().zip(b.t_world_frame()).map(|(a, b)| a.inverse() * b);
        let t_a_b = found.and_then(|(_, t)| t);
        let view = found.map(|(view, _)| view);
        pairs.push(Pair {
            robots: [a.name.clone(), b.name.clone()],
            status: view.map(|view| view.status),
            alignments: view.map_or([0; 3], |view| [view.proposed, view.agreed, view.used]),
            log10_nfa: view.and_then(|view| view.log10_nfa),
            t_a_b,
            truth,
            error: t_a_b.zip(truth).zip(a.unit_m).map(|((t, truth), unit_m)| {
                let (t, truth) = between_starts(&t, &truth, [a, b]);
                PoseError::of(&t, &truth, unit_m)
            }),
            middle: view.and_then(|view| middle(tracks, views, view)),
            certainty: Certainty::of(&views[0], &[&views[i], &views[j]].map(|views| views.frames.own.as_str())),
            in_vain: if found.is_some() { None } else { Some(in_vain(&views[i], &views[j])) },
        });
    }
    pairs
}

/// What became of the tries of two robots that have nothing in common.
fn in_vain(a: &Views, b: &Views) -> String {
    let of = |own: &Views, other: &Views| {
        let tries = own.frames.tries.iter().find(|tries| tries.other == other.frames.own);
        tries.filter(|tries| tries.own == own.frames.own).cloned()
    };
    let both = [of(a, b), of(b, a)].into_iter().flatten().reduce(|one, other| one.and(&other));
    let Some(tries) = both else {
        return "no pair of submaps was tried: no two looked alike, or they have no keypoints; see what merganser doctor says \
                of both"
            .into();
    };
    let found =
        || format!("{} pairs of submaps were tried and {} aligned, none of which counts", tries.tried(), tries.found);
    tries.told().unwrap_or_else(found)
}

/// How the first bodies of both robots lie, by an estimate and by the truth of `t_a_b`. Both know where they began in
/// their own frames.
pub(super) fn between_starts(t_a_b: &Relative, truth: &Sim3, tracks: [&Track; 2]) -> (Relative, Sim3) {
    let [a, b] = tracks.map(|track| track.odometry.first().copied().unwrap_or_else(Se3::identity));
    let to_first = a.inverse();
    let estimate = match t_a_b.onto(&b) {
        Relative::Metric(t) => Relative::Metric(PoseWithCovariance { pose: to_first * t.pose, ..t }),
        Relative::Similarity(t) => {
            Relative::Similarity(SimWithCovariance { sim: Sim3::from_se3(&to_first) * t.sim, ..t })
        }
    };
    (estimate, Sim3::from_se3(&to_first) * *truth * Sim3::from_se3(&b))
}

/// True `t_world_anchor` of a submap, `name/epoch#index`, of any of the robots.
fn true_anchor(tracks: &[Track], views: &[Views], submap: &str) -> Option<Sim3> {
    let (frame, _) = submap.rsplit_once('#')?;
    let robot = views.iter().position(|views| views.frames.own == frame)?;
    trajectory::true_anchor(tracks.get(robot)?, &views[robot], submap)
}

/// How far off a pair is where both robots were.
fn middle(tracks: &[Track], views: &[Views], pair: &PairView) -> Option<PoseError> {
    let middle = pair.middle.as_ref()?;
    let [i, j] = [&middle.i, &middle.j].map(|submap| true_anchor(tracks, views, submap));
    let (i, j) = (i?, j?);
    Some(PoseError::of(&relative(&middle.t_i_j)?, &(i.inverse() * j), i.scale))
}

/// Compares the alignments that the first robot uses with the truth.
fn singles(tracks: &[Track], views: &[Views]) -> Singles {
    let Some(reference) = views.first() else { return Singles::default() };
    let t_world_anchor = |submap: &str| true_anchor(tracks, views, submap);
    let used = reference.graph.edges.iter().filter(|edge| edge.kind == "alignment" && edge.weight > 0.0);
    let mut singles = Singles::default();
    for edge in used {
        let truth = t_world_anchor(&edge.i).zip(t_world_anchor(&edge.j));
        let Some(((i, j), estimate)) = truth.zip(relative(&edge.t_i_j)) else { continue };
        let error = PoseError::of(&estimate, &(i.inverse() * j), i.scale);
        singles.count += 1;
        singles.nees_mean += error.nees * 6.0 / error.degrees_of_freedom as f64;
        singles.inside_95 += usize::from(error.inside_95());
        singles.translation_rms_m += error.translation_m.powi(2);
        singles.rotation_rms_deg += error.rotation_deg.powi(2);
    }
    let n = singles.count.max(1) as f64;
    Singles {
        nees_mean: singles.nees_mean / n,
        translation_rms_m: (singles.translation_rms_m / n).sqrt(),
        rotation_rms_deg: (singles.rotation_rms_deg / n).sqrt(),
        ..singles
    }
}

/// All pairs i < j.
fn indices(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |i| (i + 1..n).map(move |j| (i, j)))
}

fn checks(tracks: &[Track], views: &[Views], pairs: &[Pair], bounds: Option<&Bounds>) -> Vec<Check> {
    let check = |what: &str, held, found: String| Check { what: what.into(), held, found };
    let statuses: Vec<_> = views.iter().map(|views| Some(&views.status)).collect();
    let missing = missing(tracks, &statuses);
    let mut checks =
        vec![check("all robots are fed, merged and idle, with the same facts", missing.is_empty(), missing.join("; "))];
    let difference = difference(views);
    let found = difference.map_or("an estimate is absent".into(), |d| format!("{d:.1e} apart"));
    checks.push(check("all robots hold the same estimate", difference.is_some_and(|d| d <= SAME), found));
    let truths = pairs.iter().any(|pair| pair.truth.is_some());
    let against = contradictions(views, pairs);
    checks.push(check("the map does not contradict itself", against.is_empty(), against.join("; ")));
    let of_pair = |((i, j), pair)| pair_check([&tracks[i], &tracks[j]], pair, truths, bounds);
    checks.extend(indices(tracks.len()).zip(pairs).filter_map(of_pair));
    checks
}

/// What the map says against itself, a line each.
fn contradictions(views: &[Views], pairs: &[Pair]) -> Vec<String> {
    let of_pair = |pair: &Pair| {
        let [a, b] = &pair.robots;
        let Certainty { hold, contradict, .. } = pair.certainty;
        match pair.status {
            Some(PairStatus::Inconsistent) => Some(format!("{a}–{b} is inconsistent")),
            Some(PairStatus::Merged) if contradict >= hold.max(1) => {
                Some(format!("{a}–{b}: {hold} alignments hold, {contradict} contradict them"))
            }
            _ => None,
        }
    };
    let failed = views.iter().flat_map(|views| {
        let of = views.status.robot.as_str();
        views.graph.failed.iter().map(move |failed| format!("{of} could not solve it: {}", failed.reason))
    });
    pairs.iter().filter_map(of_pair).chain(failed).collect()
}

/// How two frames are related. Where one's unit is unknown that must be a similarity, whatever the units happen to be,
/// and nobody can say how far off it is unless the recordings state the units.
fn pair_check(tracks: [&Track; 2], pair: &Pair, truths: bool, bounds: Option<&Bounds>) -> Option<Check> {
    let scaled = tracks.iter().any(|track| track.scale == ScaleKind::Unknown);
    let judged = truths && tracks.iter().all(|track| track.unit_m.is_some());
    let [a, b] = &pair.robots;
    let kind = if scaled { "a similarity" } else { "a rigid motion" };
    let bound = bounds.map_or(String::new(), |Bounds { translation_m, rotation_deg }| {
        let scale = if scaled { format!(" and {:.0} % of scale", 100.0 * SCALE_OFF_MAX) } else { String::new() };
        format!(", error at most {translation_m:.2} m, {rotation_deg:.1}°{scale}")
    });
    let what = match (scaled, judged) {
        (false, false) => return None,
        (_, true) => format!("{a}–{b}: {kind}{bound}, and inside the claimed 99.9 % ellipsoid"),
        (true, false) => format!("{a}–{b}: a similarity; how far off is unknown without unit_m and truth"),
    };
    let fits = !scaled || matches!(pair.t_a_b, Some(Relative::Similarity(_)));
    let kind = if fits { "" } else { "a rigid motion, " };
    let error = |e: &PoseError| {
        format!("{:.3} m, {:.2}°{}, NEES {:.1}", e.translation_m, e.rotation_deg, e.scale_off(), e.nees)
    };
    let middle = pair.middle.as_ref().map_or(String::new(), |middle| format!("; where both were {}", error(middle)));
    let (held, found) = match (&pair.t_a_b, &pair.error) {
        (_, Some(e)) => {
            let claimed = [Some(e), pair.middle.as_ref()].into_iter().flatten().all(PoseError::inside_999);
            (fits && claimed && e.is_within(bounds), format!("{kind}{}{middle}", error(e)))
        }
        (Some(_), None) if !judged => (fits, kind.trim_end_matches(", ").into()),
        _ => (false, "no alignment of the frames, or no truth".into()),
    };
    Some(Check { what, held, found })
}

/// Largest difference between what the robots estimate of any pair of frames, m or rad; `None` if one of them estimates
/// nothing.
fn difference(views: &[Views]) -> Option<f64> {
    let mut largest = 0.0_f64;
    for (i, j) in indices(views.len()) {
        let estimate = |robot: &Views| robot.pair(&views[i].frames.own, &views[j].frames.own)?.1;
        let first = estimate(&views[0])?;
        for robot in views {
            largest = largest.max(first.sim().local(&estimate(robot)?.sim()).amax());
        }
    }
    Some(largest)
}
