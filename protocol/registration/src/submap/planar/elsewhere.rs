//! Where else a scan fits the walls of those before it. Wheels spin, count a way back as a way ahead, or stand while the
//! robot is pushed: then the motion is not near what they say, and a fit that begins there ends at the wrong wall.

use super::super::near::Near;
use super::fit::{Walls, system};
use super::se2::Se2;

use core::f64::consts::TAU;
use libm::{atan2, exp, log};
use nalgebra::{Matrix3, Vector2, Vector3};

/// Wheels may be off by so many times the way that they tell...
const WAY: f64 = 1.5;
/// ...and so many voxels more, in any direction from where the robot was.
const BESIDES: f64 = 3.0;
/// Farther off than this they are not looked for, voxels.
const RADIUS_MAX: f64 = 16.0;
/// They may be off by this, rad, either way.
const TURN: f64 = 0.45;
/// Steps of the search: voxels, which is the edge of a cell as well, and rad.
const STEP: (f64, f64) = (2.0, 0.05);
/// Points of a scan that are looked at.
const POINTS: usize = 120;
/// Cells along either axis at most; what lies beyond is not looked at.
const SIDE_MAX: usize = 1024;
/// Places that are looked at more closely, at most...
const CANDIDATES_MAX: usize = 4;
/// ...which differ by so much, voxels and rad.
const SAME: (f64, f64) = (3.0, 0.1);
/// Search radii while polishing, voxels.
const RADII: [f64; 6] = [4.0, 3.0, 3.0, 2.0, 2.0, 1.5];
/// Damping of a direction that no wall tells of, in pairs.
const DAMPING: f64 = 1e-2;
/// A point this far from all walls, voxels, is of something new; a place this far before what was hit is free.
const BEFORE: f64 = 3.0;
/// Something new may stand anywhere within so many voxels.
const NEW: f64 = 8.0;
/// Directions in which a sensor's sight is told.
const BEARINGS: usize = 360;
/// Share of the points that are.
const NEW_SHARE: f64 = 0.1;
/// Standard deviation of a point about its wall, voxels.
const SIGMA: f64 = 0.5;
/// Share of the motions of which the wheels tell nothing.
const SLIP_SHARE: f64 = 0.05;

/// What the wheels say of the motion since the last keyframe.
pub(super) struct Odometry {
    /// `t_last_now`, in voxels.
    pub motion: Se2,
    /// Its information, if the wheels hold.
    pub information: Matrix3<f64>,
}

impl Odometry {
    /// How far from where the robot was it may be, voxels.
    fn radius(&self) -> f64 {
        (WAY * self.motion.at.norm() + BESIDES).min(RADIUS_MAX)
    }

    /// What remains known where the wheels do not hold: that the robot is in reach.
    pub fn reach(&self) -> Matrix3<f64> {
        let radius = self.radius();
        Matrix3::from_diagonal(&Vector3::new(radius, radius, TURN).map(|x| 3.0 / (x * x)))
    }

    /// The squared normalised distance of a motion from what the wheels say.
    pub fn distance_squared(&self, motion: &Se2) -> f64 {
        let off = self.motion.local(motion);
        off.dot(&(self.information * off))
    }

    /// How likely a motion is if the wheels hold, and if they tell nothing and anything in reach is as likely: both over
    /// the density of the motion that they tell.
    fn likelihoods(&self, motion: &Se2) -> [f64; 2] {
        let radius = self.radius();
        let reach = core::f64::consts::PI * radius * radius * 2.0 * TURN;
        let spread = (TAU * TAU * TAU / self.information.determinant()).sqrt();
        let hold = exp(-0.5 * self.distance_squared(motion));
        [(1.0 - SLIP_SHARE) * hold, SLIP_SHARE * (spread / reach).min(1.0)]
    }

    /// Logarithm of how likely a motion is.
    pub fn log_likelihood(&self, motion: &Se2) -> f64 {
        let [hold, slip] = self.likelihoods(motion);
        log(hold + slip)
    }

    /// Whether a motion is likelier as one of which the wheels tell nothing.
    pub fn is_slip(&self, motion: &Se2) -> bool {
        let [hold, slip] = self.likelihoods(motion);
        hold < slip
    }
}

/// How far a sensor sees through each direction: the nearest that it hit there.
pub(super) struct Sight {
    ranges: [f64; BEARINGS],
}

impl Sight {
    /// Of a scan, in the frame of its sensor.
    pub fn of(scan: &[Vector2<f64>]) -> Self {
        let mut ranges = [f64::INFINITY; BEARINGS];
        for p in scan {
            let range = &mut ranges[bearing(p)];
            *range = range.min(p.norm());
        }
        // Where nothing was hit, nothing is known.
        Self { ranges: ranges.map(|range| if range.is_finite() { range } else { 0.0 }) }
    }

    /// Whether a place lies well before what was hit in its direction and beside it: there is nothing.
    fn is_free(&self, at: &Vector2<f64>) -> bool {
        let k = bearing(at);
        let beside = [k + BEARINGS - 1, k, k + 1].map(|k| self.ranges[k % BEARINGS]);
        at.norm() + BEFORE < beside.into_iter().fold(f64::INFINITY, f64::min)
    }
}

fn bearing(p: &Vector2<f64>) -> usize {
    ((atan2(p.y, p.x) / TAU).rem_euclid(1.0) * BEARINGS as f64) as usize % BEARINGS
}

/// What two scans and the walls before them say of the motion between the two.
pub(super) struct Evidence<'a> {
    now: &'a [Vector2<f64>],
    last: &'a [Vector2<f64>],
    near: &'a Near,
    /// From where the scans were made, each in its own frame.
    seen: [Sight; 2],
}

impl<'a> Evidence<'a> {
    /// Of the scan now, in the body's frame; of the scan before it, in its own; and of the walls, in that frame.
    pub fn new(now: &'a [Vector2<f64>], last: &'a [Vector2<f64>], near: &'a Near) -> Self {
        Self { now, last, near, seen: [Sight::of(last), Sight::of(now)] }
    }

    /// Logarithm of how likely the points are if the body moved so, per point. A point lies on a wall, or is of
    /// something new; new things stand where nothing had been seen through. What comes into view for the first time
    /// speaks neither for a motion nor against it: else the shorter of two would always fit better.
    pub fn log_likelihood(&self, motion: &Se2) -> f64 {
        let [before, after] = &self.seen;
        let expected = log((1.0 - NEW_SHARE) / (SIGMA * TAU.sqrt())) - 0.5;
        let new = log(NEW_SHARE / (2.0 * NEW));
        let of_now = |p: &Vector2<f64>| {
            let at = motion.apply(p);
            match self.aside(&at) {
                Some(aside) => log(exp(expected + 0.5 - 0.5 * (aside / SIGMA) * (aside / SIGMA)) + exp(new)),
                None if before.is_free(&at) => new,
                None => expected,
            }
        };
        let back = motion.inverse();
        let of_last = |q: &Vector2<f64>| if after.is_free(&back.apply(q)) { new } else { expected };
        let sum = self.now.iter().map(of_now).sum::<f64>() + self.last.iter().map(of_last).sum::<f64>();
        sum / (self.now.len() + self.last.len()).max(1) as f64
    }

    /// How far a place is from the wall beside it, voxels; `None` if there is none.
    fn aside(&self, at: &Vector2<f64>) -> Option<f64> {
        let mine = self.near.nearest(&[at.x as f32, at.y as f32, 0.0], BEFORE as f32, |_| true)?;
        let d = at - Vector2::new(f64::from(mine.point[0]), f64::from(mine.point[1]));
        Some(Vector2::new(f64::from(mine.normal[0]), f64::from(mine.normal[1])).dot(&d).abs())
    }
}

/// Cells with a wall in them or beside them.
struct Raster {
    low: [i32; 2],
    size: [usize; 2],
    cells: Vec<bool>,
}

impl Raster {
    /// Of walls within reach of a scan around the origin.
    fn new(walls: &Walls, reach: f64) -> Self {
        let half = ((reach / STEP.0).ceil().max(1.0) as usize + 1).min(SIDE_MAX / 2);
        let (low, size) = ([-(half as i32); 2], [2 * half; 2]);
        let mut raster = Self { low, size, cells: vec![false; size[0] * size[1]] };
        for p in &walls.points {
            let [x, y] = cell(p);
            for (i, j) in (-1..=1).flat_map(|i| (-1..=1).map(move |j| (i, j))) {
                // A wall fills its cell and reaches into the one it is nearest to.
                let near = |offset: i32, value: f64| {
                    let inside = value / STEP.0 - (value / STEP.0).floor();
                    offset == 0 || (offset < 0) == (inside < 0.5)
                };
                if near(i, p.x)
                    && near(j, p.y)
                    && let Some(place) = raster.place([x.saturating_add(i), y.saturating_add(j)])
                {
                    raster.cells[place] = true;
                }
            }
        }
        raster
    }

    fn place(&self, at: [i32; 2]) -> Option<usize> {
        let [x, y] =
            [0, 1].map(|k| usize::try_from(at[k].checked_sub(self.low[k])?).ok().filter(|i| *i < self.size[k]));
        Some(x? * self.size[1] + y?)
    }

    fn hits(&self, points: &[Vector2<f64>], shift: Vector2<f64>) -> usize {
        points.iter().filter(|p| self.place(cell(&(*p + shift))).is_some_and(|place| self.cells[place])).count()
    }
}

fn cell(p: &Vector2<f64>) -> [i32; 2] {
    (p / STEP.0).map(|x| x.floor() as i32).into()
}

/// Motions, polished, at which a scan fits the walls better at a glance than at `settled`, best first.
pub(super) fn candidates(scan: &Walls, walls: &Walls, near: &Near, odometry: &Odometry, settled: &Se2) -> Vec<Se2> {
    let stride = scan.points.len().div_ceil(POINTS).max(1);
    let points: Vec<Vector2<f64>> = scan.points.iter().step_by(stride).copied().collect();
    let radius = odometry.radius();
    let reach = points.iter().map(|p| p.norm()).fold(0.0, f64::max) + radius;
    let raster = Raster::new(walls, reach);
    let turned = |angle: f64| -> Vec<Vector2<f64>> {
        let turn = Se2::new(angle, Vector2::zeros());
        points.iter().map(|p| turn.turn(p)).collect()
    };
    let bar = raster.hits(&turned(settled.angle), settled.at);
    let mut found: Vec<(usize, i32, [i32; 2])> = Vec::new();
    let (turns, steps) = ((TURN / STEP.1).ceil() as i32, (radius / STEP.0).ceil() as i32);
    for turn in -turns..=turns {
        let points = turned(odometry.motion.angle + f64::from(turn) * STEP.1);
        for shift in (-steps..=steps).flat_map(|x| (-steps..=steps).map(move |y| [x, y])) {
            let hits = raster.hits(&points, Vector2::from(shift).map(f64::from) * STEP.0);
            if hits > bar {
                found.push((hits, turn, shift));
            }
        }
    }
    found.sort_unstable_by(|a, b| b.0.cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut distinct: Vec<Se2> = Vec::new();
    for (_, turn, shift) in found {
        let angle = odometry.motion.angle + f64::from(turn) * STEP.1;
        let pose = Se2::new(angle, Vector2::from(shift).map(f64::from) * STEP.0);
        if distinct.iter().all(|other| differ(&pose, other)) {
            distinct.push(pose);
            if distinct.len() == CANDIDATES_MAX {
                break;
            }
        }
    }
    distinct.into_iter().map(|pose| polished(scan, near, pose)).collect()
}

/// Whether two motions of the body are two.
pub(super) fn differ(a: &Se2, b: &Se2) -> bool {
    let off = a.local(b);
    off.xy().norm() > SAME.0 || off.z.abs() > SAME.1
}

fn polished(scan: &Walls, near: &Near, mut pose: Se2) -> Se2 {
    for radius in RADII {
        let system = system(scan, near, &pose, radius, super::motion::FACING);
        let damping = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 900.0)) * (DAMPING * system.pairs as f64);
        let Some(solver) = (system.h + damping).cholesky() else { break };
        pose = pose.retract(&-solver.solve(&system.g));
    }
    pose
}
