//! What stands in for a robot's own SLAM. Of the sightings of each bar code every other one makes the odometry, with
//! the commanded speeds; the others are handed over in the keyframes. So the odometry knows nothing of what the
//! alignments are made of, and nothing counts twice.
//!
//! A filter (EKF) goes over the log first. Its frame is the last keyframe's body (robocentric, Castellanos et al.
//! 2007): it holds the way since then, the landmarks about it, and by how much speeds and turns differ from the
//! commanded ones. These last two are a robot's own and do not change; a first run finds them, a second one begins with
//! them, cuts keyframes and leaves out misread bar codes. Then `smooth` refines all keyframes at once.
//!
//! Motions of consecutive keyframes are stated as independent. They are not: landmarks that are seen again tie them
//! together, so the way over many of them is known better than stated.

use super::smooth::{Node, Seen, between, smooth};
use super::{Sighting, Speed};
use libm::{atan2, cos, sin};
use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::{CovarianceOf, Keyframe, Mark};
use merganser_protocol::time::Stamp;
use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Matrix6, Vector2, Vector3};
use std::collections::BTreeMap;

/// A keyframe is taken after this way, m...
const STEP_M: f64 = 0.12;
/// ...or this turn, rad, once something was seen.
const STEP_RAD: f64 = 0.25;
/// What commanded speeds miss: variance per metre along...
const ALONG: f64 = 0.08 * 0.08;
/// ...and across the way, m² per m...
const ACROSS: f64 = 0.03 * 0.03;
/// ...and of the heading, rad² per metre...
const HEADING_PER_M: f64 = 0.06 * 0.06;
/// ...and per rad turned.
const HEADING_PER_RAD: f64 = 0.14 * 0.14;
/// Standard deviation of a range: at hand, and more with its square (per m). Single ones scatter by half of that, but
/// what is wrong with them stays so for as long as a landmark is in sight: with these, the constellations of submaps
/// differ from the survey as they say they do...
const RANGE: (f64, f64) = (0.12, 0.016);
/// ...and of a bearing, rad.
const BEARING: f64 = 0.05;
/// A sighting that contradicts the filter by more (χ²₂, 99.9 %) is left out.
const CHI2_MAX: f64 = 13.8;
/// Standard deviations of what speed and turn are multiplied by: of any robot, and once they are known.
const SCALES: (f64, f64) = (0.15, 0.01);
/// Height (m) and tilt (rad) of a robot that drives on a floor.
const OUT_OF_PLANE: (f64, f64) = (1e-3, 1e-4);
/// The same of what it sees there, m.
const FLAT: f64 = 1e-3;
/// Standard deviation of the height of another robot, m: nothing tells it.
const HEIGHT: f64 = 0.1;
/// Longest time for which a commanded speed holds, s; a log that pauses longer was interrupted.
const HOLD_SECS: f64 = 1.5;
/// Standard deviation of the way that such a pause may hide, m and rad.
const PAUSE: f64 = 0.05;
/// Landmarks held by the filter at most.
const LANDMARKS_MAX: usize = 64;
/// Variance that every motion has, m² and rad²: a robot that stands still is not stiller.
const LEAST: f64 = 1e-8;
/// Places in the state: x, y, heading, then the two scales, then the landmarks.
const BASE: usize = 5;

/// By how much a robot's speeds differ from what was commanded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// True speed over commanded.
    pub speed: f64,
    /// True turn over commanded.
    pub turn: f64,
}

impl Calibration {
    /// What a log says of its robot.
    pub fn of(speeds: &[Speed], sightings: &[Sighting]) -> Self {
        let mut filter = Filter::new(Self { speed: 1.0, turn: 1.0 }, SCALES.0);
        run(&mut filter, speeds, sightings, |_, _| {});
        Self { speed: filter.x[3], turn: filter.x[4] }
    }
}

/// The keyframes of one robot's log in a frame that begins where it first saw something. `sightings` are those of
/// landmarks only.
pub fn keyframes(speeds: &[Speed], sightings: &[Sighting]) -> Vec<Keyframe> {
    let mut filter = Filter::new(Calibration::of(speeds, sightings), SCALES.1);
    let (mut stamps, mut nodes, mut handed) = (Vec::<Stamp>::new(), Vec::<Node>::new(), Vec::new());
    run(&mut filter, speeds, sightings, |stamp, filter| {
        let due = filter.way >= STEP_M || filter.turn >= STEP_RAD || stamps.is_empty();
        let later = stamps.last().is_none_or(|last| *last < stamp);
        if filter.handed.is_empty() || !due || !later {
            return;
        }
        let (way, moved) = (core::mem::take(&mut filter.wheels), filter.restart());
        let from = nodes.last().map_or_else(Vector3::zeros, |last: &Node| last.pose);
        let at = from.xy() + Matrix2::new(cos(from.z), -sin(from.z), sin(from.z), cos(from.z)) * moved.xy();
        let pose = if nodes.is_empty() { from } else { Vector3::new(at.x, at.y, from.z + moved.z) };
        let way = (way.0, way.1 + Matrix3::from_diagonal_element(LEAST));
        nodes.push(Node { pose, way, seen: core::mem::take(&mut filter.own) });
        handed.push(core::mem::take(&mut filter.handed));
        stamps.push(stamp);
    });
    let Some(covariances) = smooth(&mut nodes) else { return Vec::new() };
    let mut keyframes = Vec::with_capacity(nodes.len());
    for (k, handed) in handed.into_iter().enumerate() {
        let pose = &nodes[k].pose;
        // The covariance of the first is that of a motion that nobody asks for.
        let before = k.checked_sub(1).map_or(pose, |before| &nodes[before].pose);
        let covariance = covariances.get(k.saturating_sub(1)).copied().unwrap_or_else(Matrix3::identity);
        let pose = PoseWithCovariance { pose: in_space(pose), covariance: local(&between(before, pose), &covariance) };
        let (points, marks) = handed.into_iter().map(handed_over).unzip();
        keyframes.push(Keyframe {
            stamp: stamps[k],
            pose,
            covariance_of: CovarianceOf::Motion,
            session: None,
            points,
            marks,
            place: None,
            up: None,
        });
    }
    keyframes
}

/// Where another robot was seen, in the body frame. Nothing tells how high.
pub fn position(sighting: &Sighting, robot: Name) -> PositionSighting {
    let Seen { at, covariance, .. } = from_body(sighting);
    let (xx, xy, yy) = (covariance[(0, 0)], covariance[(0, 1)], covariance[(1, 1)]);
    let covariance = [xx, xy, 0.0, yy, 0.0, HEIGHT * HEIGHT];
    PositionSighting { stamp: sighting.stamp, robot, position: [at.x, at.y, 0.0], covariance }
}

fn in_space(pose: &Vector3<f64>) -> Se3 {
    Se3::new(So3::exp(&Vector3::new(0.0, 0.0, pose.z)), Vector3::new(pose.x, pose.y, 0.0))
}

/// The covariance of a motion's local perturbation, of one in the axes it begins in.
fn local(motion: &Vector3<f64>, covariance: &Matrix3<f64>) -> Covariance<6> {
    let (c, s) = (cos(motion.z), sin(motion.z));
    let back = Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0);
    let own = back * covariance * back.transpose();
    let mut m = Matrix6::zeros();
    for (r, row) in [0, 1, 5].into_iter().enumerate() {
        for (c, column) in [0, 1, 5].into_iter().enumerate() {
            m[(row, column)] = own[(r, c)];
        }
        m[(row, row)] += LEAST;
    }
    let (height, tilt) = OUT_OF_PLANE;
    m[(2, 2)] = height * height;
    (m[(3, 3)], m[(4, 4)]) = (tilt * tilt, tilt * tilt);
    Covariance::new_or_wider(m)
}

/// Runs the filter over a log; `seen` is called after each sighting.
fn run(filter: &mut Filter, speeds: &[Speed], sightings: &[Sighting], mut seen: impl FnMut(Stamp, &mut Filter)) {
    let mut order: BTreeMap<u32, usize> = BTreeMap::new();
    let mut k = 0;
    let Some(mut now) = speeds.first().map(|speed| speed.stamp) else { return };
    for sighting in sightings {
        // Before the first speed and after the last nobody knows how the robot moves.
        let Some(last) = speeds.last().filter(|last| now <= sighting.stamp && sighting.stamp <= last.stamp) else {
            continue;
        };
        while k + 1 < speeds.len() && speeds[k + 1].stamp <= sighting.stamp {
            filter.drive(&speeds[k], speeds[k + 1].stamp.secs_since(now));
            now = speeds[k + 1].stamp;
            k += 1;
        }
        filter.drive(speeds.get(k).unwrap_or(last), sighting.stamp.secs_since(now));
        now = sighting.stamp;
        let nth = order.entry(sighting.barcode).or_default();
        *nth += 1;
        if nth.is_multiple_of(2) {
            filter.hand_over(sighting);
        } else {
            filter.see(sighting);
        }
        seen(sighting.stamp, filter);
    }
}

fn handed_over(seen: Seen) -> ([f32; 3], Mark) {
    let mut m = Matrix3::from_diagonal_element(FLAT * FLAT);
    m.fixed_view_mut::<2, 2>(0, 0).copy_from(&seen.covariance);
    let mark = Mark { covariance: Covariance::new_or_wider(m), label: Some(seen.barcode), descriptor: None };
    ([seen.at.x as f32, seen.at.y as f32, 0.0], mark)
}

/// A sighting against the state.
struct Expected {
    /// Jacobian of range and bearing about the state...
    h: DMatrix<f64>,
    /// ...and the covariance of the state with them.
    ph: DMatrix<f64>,
    error: Vector2<f64>,
    /// Of the covariance of the error.
    inverse: Matrix2<f64>,
}

struct Filter {
    /// The state...
    x: DVector<f64>,
    /// ...its covariance...
    p: DMatrix<f64>,
    /// ...and where in it each landmark begins.
    places: BTreeMap<u32, usize>,
    /// Since the last keyframe, in the frame of the body as it is now: what is handed over...
    handed: Vec<Seen>,
    /// ...and what makes the odometry.
    own: Vec<Seen>,
    /// The wheels' way since the last keyframe, in its axes, and its covariance.
    wheels: (Vector3<f64>, Matrix3<f64>),
    /// Driven and turned since the last keyframe, m and rad.
    way: f64,
    turn: f64,
}

impl Filter {
    fn new(scales: Calibration, sigma: f64) -> Self {
        let x = DVector::from_vec(vec![0.0, 0.0, 0.0, scales.speed, scales.turn]);
        let mut p = DMatrix::zeros(BASE, BASE);
        (p[(3, 3)], p[(4, 4)]) = (sigma * sigma, sigma * sigma);
        let (handed, own, wheels) = (Vec::new(), Vec::new(), (Vector3::zeros(), Matrix3::zeros()));
        Self { x, p, places: BTreeMap::new(), handed, own, wheels, way: 0.0, turn: 0.0 }
    }

    /// Lets the robot drive for so long.
    fn drive(&mut self, speed: &Speed, secs: f64) {
        let held = secs.min(HOLD_SECS);
        let (way, turn) = (speed.forward * held, speed.angular * held);
        let (d, a) = (way * self.x[3], turn * self.x[4]);
        let pause = if secs > held { PAUSE * PAUSE } else { 0.0 };
        let noise = [
            ALONG * d.abs() + pause,
            ACROSS * d.abs() + pause,
            HEADING_PER_M * d.abs() + HEADING_PER_RAD * a.abs() + pause,
        ];
        (self.way, self.turn) = (self.way + d.abs(), self.turn + a.abs());
        // Along the mean heading of the step.
        let heading = self.x[2] + a / 2.0;
        let (c, s) = (cos(heading), sin(heading));
        self.x[0] += d * c;
        self.x[1] += d * s;
        self.x[2] += a;
        let n = self.x.len();
        let mut f = DMatrix::<f64>::identity(n, n);
        (f[(0, 2)], f[(1, 2)]) = (-d * s, d * c);
        (f[(0, 3)], f[(1, 3)]) = (way * c, way * s);
        (f[(0, 4)], f[(1, 4)], f[(2, 4)]) = (-d * s * turn / 2.0, d * c * turn / 2.0, turn);
        self.p = &f * &self.p * f.transpose();
        let axes = Matrix2::new(c, -s, s, c);
        let added = axes * Matrix2::from_diagonal(&Vector2::new(noise[0], noise[1])) * axes.transpose();
        let mut view = self.p.fixed_view_mut::<2, 2>(0, 0);
        view += added;
        self.p[(2, 2)] += noise[2];
        let (at, covariance) = &mut self.wheels;
        let (c, s) = (cos(at.z + a / 2.0), sin(at.z + a / 2.0));
        let f = Matrix3::new(1.0, 0.0, -d * s, 0.0, 1.0, d * c, 0.0, 0.0, 1.0);
        let axes = Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
        *covariance = f * *covariance * f.transpose() + axes * Matrix3::from_diagonal(&noise.into()) * axes.transpose();
        *at += Vector3::new(d * c, d * s, a);
        for handed in self.handed.iter_mut().chain(&mut self.own) {
            let back = Matrix2::new(cos(a), sin(a), -sin(a), cos(a));
            handed.at = back * (handed.at - Vector2::new(d * cos(a / 2.0), d * sin(a / 2.0)));
            let aside = Vector2::new(handed.at.y, -handed.at.x);
            let moved =
                Matrix2::from_diagonal(&Vector2::new(noise[0], noise[1])) + aside * aside.transpose() * noise[2];
            handed.covariance = back * handed.covariance * back.transpose() + moved;
        }
    }

    /// Keeps a sighting for the next keyframe, unless it contradicts all that is known: a bar code is misread at times.
    fn hand_over(&mut self, sighting: &Sighting) {
        if self.expected(sighting).is_none() {
            return;
        }
        self.handed.push(from_body(sighting));
    }

    /// Corrects the state by a sighting, or takes in a landmark that was not seen before.
    fn see(&mut self, sighting: &Sighting) {
        if !self.places.contains_key(&sighting.barcode) {
            if self.places.len() < LANDMARKS_MAX {
                self.take_in(sighting);
                self.own.push(from_body(sighting));
            }
            return;
        }
        let Some(Expected { h, ph, error, inverse }) = self.expected(sighting) else { return };
        self.own.push(from_body(sighting));
        let n = self.x.len();
        let gain = &ph * inverse;
        self.x += &gain * error;
        // Joseph's form keeps the covariance positive.
        let left = DMatrix::identity(n, n) - &gain * h;
        self.p = &left * &self.p * left.transpose() + &gain * noise(sighting) * gain.transpose();
    }

    /// How a sighting of a known landmark differs from what the state lets expect; `None` if it contradicts that, or
    /// the landmark is not known.
    fn expected(&self, sighting: &Sighting) -> Option<Expected> {
        let at = *self.places.get(&sighting.barcode)?;
        let off = Vector2::new(self.x[at] - self.x[0], self.x[at + 1] - self.x[1]);
        let range = off.norm().max(1e-3);
        let ray = off / range;
        let mut h = DMatrix::<f64>::zeros(2, self.x.len());
        for (axis, towards) in [ray.x, ray.y].into_iter().enumerate() {
            (h[(0, at + axis)], h[(0, axis)]) = (towards, -towards);
        }
        for (axis, aside) in [-ray.y / range, ray.x / range].into_iter().enumerate() {
            (h[(1, at + axis)], h[(1, axis)]) = (aside, -aside);
        }
        h[(1, 2)] = -1.0;
        let turn = sighting.bearing - (atan2(off.y, off.x) - self.x[2]);
        let error = Vector2::new(sighting.range - range, atan2(sin(turn), cos(turn)));
        let ph = &self.p * h.transpose();
        let innovation: Matrix2<f64> = (&h * &ph).fixed_view::<2, 2>(0, 0) + noise(sighting);
        let inverse = innovation.try_inverse()?;
        (error.dot(&(inverse * error)) <= CHI2_MAX).then_some(Expected { h, ph, error, inverse })
    }

    fn take_in(&mut self, sighting: &Sighting) {
        let n = self.x.len();
        let (c, s) = (cos(self.x[2]), sin(self.x[2]));
        let body = Matrix2::new(c, -s, s, c);
        let off = body * place(sighting);
        let mut j = DMatrix::<f64>::zeros(2, n);
        (j[(0, 0)], j[(1, 1)]) = (1.0, 1.0);
        (j[(0, 2)], j[(1, 2)]) = (-off.y, off.x);
        let scaled = body * axes(sighting.bearing) * Matrix2::from_diagonal(&Vector2::new(1.0, sighting.range));
        let with = &j * &self.p;
        let own = &with * j.transpose();
        let own: Matrix2<f64> = own.fixed_view::<2, 2>(0, 0) + scaled * noise(sighting) * scaled.transpose();
        self.places.insert(sighting.barcode, n);
        let (x, y) = (self.x[0] + off.x, self.x[1] + off.y);
        self.x = self.x.clone().resize_vertically(n + 2, 0.0);
        (self.x[n], self.x[n + 1]) = (x, y);
        self.p = self.p.clone().resize(n + 2, n + 2, 0.0);
        self.p.view_mut((n, 0), (2, n)).copy_from(&with);
        self.p.view_mut((0, n), (n, 2)).copy_from(&with.transpose());
        self.p.view_mut((n, n), (2, 2)).copy_from(&own);
    }

    /// Begins anew at the body; gives back the motion since the last time.
    fn restart(&mut self) -> Vector3<f64> {
        let n = self.x.len();
        let (c, s) = (cos(self.x[2]), sin(self.x[2]));
        let back = Matrix2::new(c, s, -s, c);
        let moved = Vector3::new(self.x[0], self.x[1], self.x[2]);
        let mut j = DMatrix::<f64>::zeros(n, n);
        (j[(3, 3)], j[(4, 4)]) = (1.0, 1.0);
        for &k in self.places.values() {
            let place = back * (Vector2::new(self.x[k], self.x[k + 1]) - moved.xy());
            (self.x[k], self.x[k + 1]) = (place.x, place.y);
            j.view_mut((k, k), (2, 2)).copy_from(&back);
            j.view_mut((k, 0), (2, 2)).copy_from(&-back);
            (j[(k, 2)], j[(k + 1, 2)]) = (place.y, -place.x);
        }
        self.p = &j * &self.p * j.transpose();
        self.x.fixed_rows_mut::<3>(0).fill(0.0);
        (self.way, self.turn) = (0.0, 0.0);
        moved
    }
}

/// What was seen, in the body frame.
fn from_body(sighting: &Sighting) -> Seen {
    let scaled = axes(sighting.bearing) * Matrix2::from_diagonal(&Vector2::new(1.0, sighting.range));
    let covariance = scaled * noise(sighting) * scaled.transpose();
    Seen { barcode: sighting.barcode, at: place(sighting), covariance }
}

/// Where what was seen is, body frame.
fn place(sighting: &Sighting) -> Vector2<f64> {
    Vector2::new(sighting.range * cos(sighting.bearing), sighting.range * sin(sighting.bearing))
}

/// Along the ray and to its left.
fn axes(bearing: f64) -> Matrix2<f64> {
    Matrix2::new(cos(bearing), -sin(bearing), sin(bearing), cos(bearing))
}

/// Covariance of range and bearing.
fn noise(sighting: &Sighting) -> Matrix2<f64> {
    let range = RANGE.0 + RANGE.1 * sighting.range * sighting.range;
    Matrix2::from_diagonal(&Vector2::new(range * range, BEARING * BEARING))
}
