//! Whether a front end means its poses and points as they are read here. Points in the SLAM's frame instead of the body's,
//! inverted poses, quaternions written w first, a camera's axes, millimetres: each gives submaps that are wrong in
//! themselves, and no later check can tell why.
//!
//! Two views of one place tell it. Each [`Reading`] says by which motion the second lies over the first; the right one
//! lays points on points, a wrong one does not, as soon as the two motions differ by more than points are apart.
//! Points that both readings lay on others, as on the ground, say nothing and are left out (as in McNemar's test): a
//! reading wins a pair if it alone explains a tenth of the points, and three times as many as what was stated alone does.
//! It is told when it won [`WINS_MIN`] pairs, three of four of those that could tell the two apart, and three more than
//! any other. Where the odometry is poor, or a corridor looks the same everywhere, the stated motion explains as much as
//! any other, and nothing is told. All lengths are shares of how far the points reach, so that no unit is taken for
//! granted.
//!
//! Quaternions that are written w first show in the poses alone as well ([`QuaternionOrder`]), whatever the sensor sees, and
//! labelled landmarks are looked at one by one (in `sightings`).
//!
//! Measured on seven laser logs as they were published: of 11,000 pairs that tell readings apart no wrong one won more
//! than 1.7 %.

use super::Keyframe;
use super::sightings::Sightings;
use crate::config::SubmapConfig;
use crate::geometry::quaternion_order::{QuaternionOrder, w_first};
use crate::geometry::{Se3, So3};
use crate::kinds::ScaleKind;
use crate::submap::stated::Oddity;
use crate::time::Stamp;
use core::fmt;
use nalgebra::{Matrix3, Vector3};
use serde::Serialize;
use std::collections::HashSet;

/// Points of a view that are kept, and points of the next that are laid over them, at most.
const SURFACE_MAX: usize = 20_000;
const PROBES_MAX: usize = 192;
/// Fewer points are no view.
const PROBES_MIN: usize = 64;
/// Edge of the cells that points are compared by, as a share of their median range; a probe lies on what is in its cell
/// or a neighbour's.
const CELL: f64 = 1.0 / 30.0;
/// Two readings differ if they move probes so many cells apart on average.
const APART_CELLS: f64 = 4.0;
/// How far the body moves between two views at least and at most: rad, and as a share of the median range.
const TURN: [f64; 2] = [0.2, 0.8];
const WAY: [f64; 2] = [0.2, 0.6];
/// A reading that wins lays so many of the probes on points, and so many that what was stated does not; those for which it
/// is the other way round are fewer by this factor.
const FITS_MIN: f64 = 0.5;
const ALONE_MIN: f64 = 0.1;
const ALONE_RATIO: usize = 3;
/// Pairs that a reading must win, and their share of those that tell it from what was stated.
pub const WINS_MIN: u32 = 6;
const WINS_SHARE: f64 = 0.75;
/// It leads others by so many pairs, or has had so many that the others are as good as the same.
const LEAD_MIN: u32 = 3;
const PAIRS_OF_RIVALS: u32 = 16;
/// After so many pairs that nothing was found in, no more is looked for: a front end does not change its mind.
pub const PAIRS_MAX: u32 = 32;
/// The same of views, where hardly any two overlap.
const VIEWS_MAX: u32 = 256;
/// A view that nothing came near of in so many keyframes is replaced.
const AGE_MAX: u32 = 100;

/// No sensor's points lie this far off in the median, m: what automotive LiDARs reach at most. In millimetres, all do.
pub const REACH_MAX_M: f64 = 300.0;
/// Steps between keyframes that are this many times as long as points reach lead to views that never overlap.
pub const STEP_MAX: f64 = 10.0;
/// Poses are looked at for their quaternions' order each so many steps, until so many looks, of which two in a row must
/// doubt it.
const ORDER_STEPS: u32 = 16;
const ORDER_LOOKS: u32 = 64;
/// Keyframes whose median counts for either.
const WINDOW: usize = 10;

/// How a front end may mean its poses and points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
pub enum Reading {
    /// Points are in the SLAM's frame, not in the body's.
    InFrame,
    /// Poses map the frame into the body.
    Inverse,
    /// Quaternions are `[w, x, y, z]`.
    WFirst,
    /// Points are in millimetres, poses in metres.
    PointsInMillimetres,
    /// Points have other axes than the body of the poses: of each of the body's, which one of the points' it is, from 1
    /// on, negative if it points the other way.
    Axes([i8; 3]),
}

/// x right, y down, z ahead.
const OPTICAL: [i8; 3] = [3, -1, -2];
/// x right, y up, z back.
const Y_UP: [i8; 3] = [-3, -1, 2];
/// y to the right, as of a scanner that is mounted upside down.
const MIRRORED: [i8; 3] = [1, -2, 3];

impl fmt::Display for Reading {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::InFrame => f.write_str("points are in the SLAM's frame: send them in the body's, as the sensor saw them"),
            Self::Inverse => f.write_str("poses are inverted: send t_frame_body, where the body is in the SLAM's frame"),
            Self::WFirst => f.write_str("quaternions are written w first: send [x, y, z, w]"),
            Self::PointsInMillimetres => f.write_str("points are in millimetres and poses in metres: send metres"),
            Self::Axes(OPTICAL) => f.write_str(
                "points have a camera's axes (x right, y down, z ahead) and poses a body's: send points as (z, -x, -y), or \
                 poses of the camera",
            ),
            Self::Axes(Y_UP) => f.write_str(
                "points have y up (x right, z back) and poses a body's axes: send points as (-z, -x, y), or poses with the \
                 points' axes",
            ),
            Self::Axes(MIRRORED) => f.write_str(
                "points have y to the right, as of a scanner that is mounted upside down: send points as (x, -y, z)",
            ),
            Self::Axes(axes) => {
                let names = axes.map(|axis| {
                    let name = ["x", "y", "z"][usize::from(axis.unsigned_abs()).clamp(1, 3) - 1];
                    format!("{}{name}", if axis < 0 { "-" } else { "" })
                });
                write!(f, "points have other axes than the poses' body: send them as ({})", names.join(", "))
            }
        }
    }
}

impl Reading {
    /// All that are tried, the commonest first.
    pub(super) fn all(planar: bool) -> Vec<Self> {
        let mut all = vec![Self::InFrame, Self::PointsInMillimetres, Self::Inverse, Self::WFirst];
        let known = [OPTICAL, Y_UP, MIRRORED];
        all.extend(known.map(Self::Axes));
        let signs = || [1_i8, -1];
        for (a, b, c) in [(1, 2, 3), (2, 1, 3), (1, 3, 2), (3, 2, 1), (2, 3, 1), (3, 1, 2)] {
            for (p, (q, r)) in signs()
                .into_iter()
                .flat_map(|p| signs().map(|q| (p, q)))
                .flat_map(|(p, q)| signs().map(|r| (p, (q, r))))
            {
                let axes = [p * a, q * b, r * c];
                if axes != [1, 2, 3] && !known.contains(&axes) {
                    all.push(Self::Axes(axes));
                }
            }
        }
        all.retain(|reading| !planar || reading.is_planar());
        all
    }

    /// Whether it can be of a robot that moves in a plane.
    fn is_planar(self) -> bool {
        match self {
            Self::Axes(axes) => axes[2] == 3,
            Self::WFirst => false, // Such poses are refused as tilted.
            Self::InFrame | Self::Inverse | Self::PointsInMillimetres => true,
        }
    }

    /// The motion of the points from the view at pose `b` to that at `a`.
    pub(super) fn motion(self, a: &Se3, b: &Se3) -> Se3 {
        match self {
            Self::InFrame => Se3::identity(),
            Self::Inverse => *a * b.inverse(),
            Self::WFirst => {
                let [a, b] = [a, b].map(|pose| Se3::new(w_first(&pose.rotation), pose.translation));
                a.inverse() * b
            }
            Self::PointsInMillimetres => {
                let t = a.inverse() * *b;
                Se3::new(t.rotation, t.translation * 1000.0)
            }
            Self::Axes(axes) => {
                let t = a.inverse() * *b;
                let r_body_points = matrix(axes);
                let r_points_body = r_body_points.transpose();
                let rotation = So3::from_matrix(&(r_points_body * t.rotation.matrix() * r_body_points));
                Se3::new(rotation, r_points_body * t.translation)
            }
        }
    }
}

/// The body's axes by the points'.
fn matrix(axes: [i8; 3]) -> Matrix3<f64> {
    Matrix3::from_fn(|row, column| {
        let axis = axes[row];
        if usize::from(axis.unsigned_abs()) == column + 1 { f64::from(axis.signum()) } else { 0.0 }
    })
}

/// A view that others are laid over.
#[derive(Clone, Debug)]
struct View {
    t_frame_body: Se3,
    /// Cells that hold points; only asked whether they do, so that their order is no matter.
    cells: HashSet<[i32; 3]>,
    reach: f64,
    age: u32,
}

/// What pairs of views said of one reading.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    /// Pairs that tell it from what was stated, those it won, and probes that it laid on points in those.
    pairs: u32,
    wins: u32,
    hits: usize,
}

/// Looks at keyframes as they come, until it is clear how they are meant.
#[derive(Clone, Debug, Default)]
pub struct Readings {
    view: Option<View>,
    tallies: Vec<Tally>,
    pairs: u32,
    /// Views that were replaced because the body moved on, and pairs that only millimetres would tell apart.
    views: u32,
    trembles: u32,
    is_over: bool,
    last: Option<(Stamp, Se3)>,
    reaches: Vec<f64>,
    steps: Vec<f64>,
    order: QuaternionOrder,
    /// Looks at the order, and those in a row that doubted it.
    looks: u32,
    doubts: u32,
    sightings: Sightings,
}

impl Readings {
    /// Takes a keyframe of finite numbers; what is odd about it and those before, if that shows now.
    pub fn look(&mut self, keyframe: &Keyframe, config: &SubmapConfig) -> Vec<Oddity> {
        if self.last.is_some_and(|(stamp, _)| keyframe.stamp <= stamp) {
            return Vec::new();
        }
        let is_planar = config.sensor.is_planar();
        let pose = if is_planar { super::planar::flat(&keyframe.pose.pose) } else { keyframe.pose.pose };
        let order = if is_planar { None } else { self.order(&pose) };
        let order = order.or_else(|| self.sightings.look(keyframe, &pose, config));
        let Some(reach) = median_range(&keyframe.points) else { return order.into_iter().collect() };
        let size = self.size(&pose, reach, config);
        self.last = Some((keyframe.stamp, pose));
        let reading = if self.is_over { None } else { self.compare(&pose, &keyframe.points, reach, config) };
        size.into_iter().chain(reading).chain(order).collect()
    }

    /// Whether the body moves as if quaternions were written w first, unless views have told so.
    fn order(&mut self, pose: &Se3) -> Option<Oddity> {
        let before = self.order.steps();
        if self.looks >= ORDER_LOOKS {
            return None;
        }
        self.order.push(pose);
        let steps = self.order.steps();
        if steps == before || !steps.is_multiple_of(ORDER_STEPS) {
            return None;
        }
        self.looks += 1;
        self.doubts = if self.order.is_doubtful() { self.doubts + 1 } else { 0 };
        if self.doubts < 2 {
            return None;
        }
        // Nothing else can be told by poses that are wrong.
        (self.looks, self.is_over) = (ORDER_LOOKS, true);
        self.sightings.stop();
        Some(Oddity::WFirst)
    }

    /// Whether points or steps are of another size than any sensor's or robot's.
    fn size(&mut self, pose: &Se3, reach: f64, config: &SubmapConfig) -> Option<Oddity> {
        let counts = |values: &[f64]| values.len() == WINDOW;
        let was_known = [&self.reaches, &self.steps].map(|values| counts(values));
        if !was_known[0] {
            self.reaches.push(reach);
        }
        // A body that stands takes no steps.
        let step = self.last.map(|(_, last)| (pose.translation - last.translation).norm());
        if !was_known[1] {
            self.steps.extend(step.filter(|step| *step > CELL * reach));
        }
        let reach = median(&mut self.reaches)?;
        if !was_known[0] && counts(&self.reaches) && config.scale == ScaleKind::Metric && reach > REACH_MAX_M {
            return Some(Oddity::Reach { metres: reach as u32 });
        }
        let step = median(&mut self.steps)?;
        let is_apart = !was_known[1] && counts(&self.steps) && step > STEP_MAX * reach;
        is_apart.then_some(Oddity::StepsApart { centimetres: [step, reach].map(|m| (100.0 * m) as u32) })
    }

    /// Lays a view over the last one, if the body moved between them as far as it takes to tell readings apart.
    fn compare(&mut self, pose: &Se3, points: &[[f32; 3]], reach: f64, config: &SubmapConfig) -> Option<Oddity> {
        let Some(view) = self.view.as_mut() else {
            self.view = Some(View::new(*pose, points, reach));
            return None;
        };
        view.age += 1;
        let t = view.t_frame_body.inverse() * *pose;
        let [turn, way] = [t.rotation.angle(), t.translation.norm() / view.reach];
        let is_far = turn > TURN[1] || way > WAY[1];
        let moved = turn >= TURN[0] || way >= WAY[0];
        // So does a body that stands and whose odometry trembles: it may not use up what it takes to judge a drive.
        let in_millimetres = !moved && self.trembles < PAIRS_MAX && (WAY[0]..=WAY[1]).contains(&(1000.0 * way));
        let is_old = view.age > AGE_MAX;
        if !moved && !in_millimetres && !is_old {
            return None;
        }
        let view = self.view.replace(View::new(*pose, points, reach))?;
        self.views += u32::from(moved);
        self.trembles += u32::from(in_millimetres);
        let found = if is_far || is_old { None } else { self.judge(&view, pose, points, config) };
        self.pairs += u32::from(moved && !is_far && !is_old);
        self.is_over = found.is_some() || self.pairs >= PAIRS_MAX || self.views >= VIEWS_MAX;
        if self.is_over {
            self.view = None;
        }
        if matches!(found, Some(Oddity::Read { reading: Reading::WFirst, .. })) {
            self.looks = ORDER_LOOKS;
        }
        found
    }

    fn judge(&mut self, view: &View, pose: &Se3, points: &[[f32; 3]], config: &SubmapConfig) -> Option<Oddity> {
        let probes: Vec<Vector3<f64>> = at_most(points, PROBES_MAX).map(|p| Vector3::from(p.map(f64::from))).collect();
        let stated = view.t_frame_body.inverse() * *pose;
        let by_stated: Vec<bool> = probes.iter().map(|p| view.has(&(stated * *p))).collect();
        let share = |count: usize| count as f64 / probes.len() as f64;
        let readings = Reading::all(config.sensor.is_planar());
        self.tallies.resize(readings.len(), Tally::default());
        for (reading, tally) in readings.iter().zip(&mut self.tallies) {
            let motion = reading.motion(&view.t_frame_body, pose);
            let apart: f64 = probes.iter().map(|p| (motion * *p - stated * *p).norm()).sum();
            if apart < APART_CELLS * CELL * view.reach * probes.len() as f64 {
                continue;
            }
            tally.pairs += 1;
            let count = |is_stated: bool| {
                let of_those = probes.iter().zip(&by_stated).filter(|(_, by_stated)| **by_stated == is_stated);
                of_those.filter(|(p, _)| view.has(&(motion * **p))).count()
            };
            // Where little is left for a reading to explain alone, it has lost.
            let alone = count(false);
            if share(alone) < ALONE_MIN {
                continue;
            }
            let both = count(true);
            let against = by_stated.iter().filter(|by_stated| **by_stated).count() - both;
            if share(alone + both) >= FITS_MIN && alone >= ALONE_RATIO * against {
                tally.wins += 1;
                tally.hits += alone + both;
            }
        }
        let holds = |tally: &Tally| f64::from(tally.wins) >= WINS_SHARE * f64::from(tally.pairs);
        let all = || readings.iter().zip(&self.tallies);
        // Of equals the first, which is the commonest.
        let rank = |tally: &Tally| (tally.wins, tally.hits);
        let best = all().reduce(|best, next| if rank(next.1) > rank(best.1) { next } else { best });
        let (reading, tally) = best.filter(|(_, tally)| tally.wins >= WINS_MIN && holds(tally))?;
        // On straight ways several readings come to the same motion.
        let rivals = all().filter(|(other, tally)| *other != reading && holds(tally));
        let rival = rivals.map(|(_, tally)| tally.wins).max().unwrap_or_default();
        let is_told = tally.wins >= rival + LEAD_MIN || tally.pairs >= PAIRS_OF_RIVALS;
        is_told.then_some(Oddity::Read { reading: *reading, pairs: [tally.wins, tally.pairs] })
    }
}

impl View {
    fn new(t_frame_body: Se3, points: &[[f32; 3]], reach: f64) -> Self {
        let cells = at_most(points, SURFACE_MAX).map(|p| cell(&Vector3::from(p.map(f64::from)), reach)).collect();
        Self { t_frame_body, cells, reach, age: 0 }
    }

    /// Whether there are points at, or next to, this place.
    fn has(&self, p: &Vector3<f64>) -> bool {
        let [x, y, z] = cell(p, self.reach);
        let about = |v: i32| [v, v.saturating_sub(1), v.saturating_add(1)];
        about(x).iter().any(|x| about(y).iter().any(|y| about(z).iter().any(|z| self.cells.contains(&[*x, *y, *z]))))
    }
}

fn cell(p: &Vector3<f64>, reach: f64) -> [i32; 3] {
    // Numbers beyond what an i32 holds end at its bounds.
    [p.x, p.y, p.z].map(|v| (v / (CELL * reach)).floor() as i32)
}

/// How far points lie off in the median; `None` of too few.
fn median_range(points: &[[f32; 3]]) -> Option<f64> {
    let mut ranges: Vec<f64> = at_most(points, PROBES_MAX).map(|p| Vector3::from(p.map(f64::from)).norm()).collect();
    let reach = if ranges.len() < PROBES_MIN { None } else { median(&mut ranges) };
    reach.filter(|reach| *reach > 0.0)
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// At most so many of the points, evenly.
fn at_most(points: &[[f32; 3]], count: usize) -> impl Iterator<Item = &[f32; 3]> {
    points.iter().step_by(points.len().div_ceil(count).max(1))
}

#[cfg(test)]
#[path = "reading_tests.rs"]
mod tests;
