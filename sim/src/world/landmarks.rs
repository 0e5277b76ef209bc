//! A camera whose SLAM keeps landmarks: points on the world's surfaces, seen with a depth that is less certain than the
//! direction, told apart by binary descriptors. What a place looks like changes with the side it is seen from, and from
//! one look to the next. A single camera measures in a unit of its own, which nobody knows.

use super::World;
use super::shape::Ray;
use crate::dice::Dice;
use crate::scenario::ROBOTS_MAX;
use core::f64::consts::{FRAC_PI_2, TAU};
use libm::{acos, cos, sin};
use merganser_protocol::geometry::{Covariance, CovarianceError, Se3};
use merganser_protocol::submap::Mark;
use merganser_protocol::submap::landmarks::{DESCRIPTOR_LEN, Descriptor};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

/// Bits of a descriptor.
const BITS: usize = 8 * DESCRIPTOR_LEN;
/// A landmark is seen if the first surface on the way to it is this near to it, m.
const SURFACE_M: f64 = 0.05;

/// What the camera and its landmarks are like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LandmarkOptions {
    /// New landmarks about each keyframe of a drive; others see them too.
    pub per_keyframe: usize,
    /// Shortest and longest range, m.
    pub range_m: [f64; 2],
    /// Opening of the view, across and upright, degrees.
    pub view_deg: [f64; 2],
    /// Share of the landmarks in view that SLAM hands over.
    pub seen: f64,
    /// Standard deviation of the direction, degrees.
    pub direction_sigma_deg: f64,
    /// Standard deviation of the depth at one metre, m; it grows with the square of the distance.
    pub depth_sigma: f64,
    /// Share of a descriptor's bits that are wrong in a look.
    pub bits_wrong: f64,
    /// Share of the landmarks that look like another one.
    pub alike: f64,
    /// Share of a look's descriptors that are another landmark's.
    pub mistaken: f64,
    /// Lengths that robots' SLAMs take for one, m: each robot whose SLAM knows no metre (`config.submap.scale =
    /// "unknown"`) draws its own between these.
    pub unit_m: [f64; 2],
    /// Robots whose SLAM does know it, whatever the configuration says of the others.
    pub metric: Vec<String>,
}

impl Default for LandmarkOptions {
    fn default() -> Self {
        Self {
            per_keyframe: 40,
            range_m: [0.5, 10.0],
            view_deg: [100.0, 75.0],
            seen: 0.6,
            direction_sigma_deg: 0.1,
            depth_sigma: 0.004,
            bits_wrong: 0.05,
            alike: 0.1,
            mistaken: 0.03,
            unit_m: [0.5, 2.0],
            metric: Vec::new(),
        }
    }
}

impl LandmarkOptions {
    /// Every knob's key, value, bounds and remedy, for the scenario's check.
    pub fn ranges(&self) -> [(&'static str, f64, f64, f64, &'static str); 14] {
        let share = "use a share from 0 to 1";
        let ([near, far], [across, upright], [least, most]) = (self.range_m, self.view_deg, self.unit_m);
        [
            ("landmarks.per_keyframe", self.per_keyframe as f64, 1.0, 1000.0, "use 1 to 1000"),
            ("landmarks.range_m[0]", near, 0.05, far, "use shortest (at least 0.05), then longest"),
            ("landmarks.range_m[1]", far, 0.1, 60.0, "use 0.1 to 60 m"),
            ("landmarks.view_deg[0]", across, 1.0, 360.0, "use 1 to 360 degrees"),
            ("landmarks.view_deg[1]", upright, 1.0, 180.0, "use 1 to 180 degrees"),
            ("landmarks.seen", self.seen, 0.0, 1.0, share),
            ("landmarks.direction_sigma_deg", self.direction_sigma_deg, 1e-3, 10.0, "use 0.001 to 10 degrees"),
            ("landmarks.depth_sigma", self.depth_sigma, 1e-5, 0.1, "use 0.00001 to 0.1"),
            ("landmarks.bits_wrong", self.bits_wrong, 0.0, 1.0, share),
            ("landmarks.alike", self.alike, 0.0, 1.0, share),
            ("landmarks.mistaken", self.mistaken, 0.0, 1.0, share),
            ("landmarks.unit_m[0]", least, 0.01, most, "use least (at least 0.01), then most"),
            ("landmarks.unit_m[1]", most, 0.01, 100.0, "use 0.01 to 100 m"),
            ("landmarks.metric", self.metric.len() as f64, 0.0, ROBOTS_MAX as f64, "name each robot once"),
        ]
    }
}

/// A place that SLAM would keep.
#[derive(Clone, Debug, PartialEq)]
struct Spot {
    at: Vector3<f64>,
    /// Unit vector to where it was first seen from.
    towards: Vector3<f64>,
    /// As it looks from there, and from the side.
    looks: [Descriptor; 2],
}

/// What SLAM hands over of one keyframe: places in the body frame, in its unit, and a mark for each.
pub type Sightings = (Vec<[f32; 3]>, Vec<Mark>);

/// A camera and all landmarks of its world.
#[derive(Clone, Debug)]
pub struct Camera {
    options: LandmarkOptions,
    spots: Vec<Spot>,
}

impl Camera {
    /// Landmarks on the surfaces about these places, as bodies see them. Where the world repeats itself every `cell_m`,
    /// so do they: elsewhere another landmark looks just the same.
    pub fn new(options: LandmarkOptions, world: &World, places: &[Se3], cell_m: Option<f64>, dice: &mut Dice) -> Self {
        let lattice = cell_m.map_or_else(|| vec![Vector3::zeros()], |cell_m| shifts(places, cell_m));
        let per_place = options.per_keyframe.div_ceil(lattice.len());
        let mut spots: Vec<Spot> = Vec::new();
        for place in places {
            for _ in 0..per_place {
                let (azimuth, up) = (dice.range(0.0, TAU), dice.range(-0.6, 0.6));
                let direction = Vector3::new(cos(azimuth) * cos(up), sin(azimuth) * cos(up), sin(up));
                let looks = [descriptor(dice), descriptor(dice)];
                let (alike, other) = (dice.chance(options.alike), dice.uniform());
                let ray = Ray { origin: place.translation, direction };
                let Some(range) = world.cast(&ray, options.range_m[1]) else { continue };
                let other = spots.get((other * spots.len() as f64) as usize).filter(|_| alike);
                let looks = other.map_or(looks, |spot| spot.looks);
                let at = ray.origin + direction * range;
                spots.extend(lattice.iter().map(|shift| Spot { at: at + shift, towards: -direction, looks }));
            }
        }
        Self { options, spots }
    }

    /// What SLAM, which takes `unit_m` for one, hands over of a keyframe at `t_world_body`. The camera looks along the
    /// body's x axis.
    ///
    /// # Errors
    /// [`CovarianceError`] if the options give a noise that no covariance can hold.
    pub fn look(
        &self,
        world: &World,
        t_world_body: &Se3,
        unit_m: f64,
        dice: &mut Dice,
    ) -> Result<Sightings, CovarianceError> {
        let t_body_world = t_world_body.inverse();
        let (mut points, mut marks) = (Vec::new(), Vec::new());
        for spot in &self.spots {
            let at = t_body_world * spot.at;
            if !self.in_view(&at) || !dice.chance(self.options.seen) || !shows(world, t_world_body, spot) {
                continue;
            }
            let (at, covariance) = self.measured(&at, dice)?;
            let looks_like = match dice.chance(self.options.mistaken) {
                true => &self.spots[(dice.uniform() * self.spots.len() as f64) as usize],
                false => spot,
            };
            let descriptor = Some(self.seen_from(looks_like, &t_world_body.translation, dice));
            points.push(at.map(|x| (x / unit_m) as f32).into());
            marks.push(Mark { covariance: covariance.scaled(1.0 / (unit_m * unit_m)), label: None, descriptor });
        }
        Ok((points, marks))
    }

    fn in_view(&self, at: &Vector3<f64>) -> bool {
        let [near, far] = self.options.range_m;
        let half = self.options.view_deg.map(|deg| 0.5 * deg.to_radians());
        let across = libm::atan2(at.y, at.x);
        let upright = libm::atan2(at.z, libm::hypot(at.x, at.y));
        (near..=far).contains(&at.norm()) && across.abs() <= half[0] && upright.abs() <= half[1]
    }

    /// The place as it is measured, and the covariance that its error is drawn from: certain across the line of sight,
    /// less so along it.
    fn measured(&self, at: &Vector3<f64>, dice: &mut Dice) -> Result<(Vector3<f64>, Covariance<3>), CovarianceError> {
        let range = at.norm();
        let along = at / range;
        let across = range * self.options.direction_sigma_deg.to_radians();
        let depth = self.options.depth_sigma * range * range;
        let beside = along.cross(&Vector3::new(-along.y, along.z, along.x)).normalize();
        let axes = Matrix3::from_columns(&[along, beside, along.cross(&beside)]);
        let sigmas = Vector3::new(depth, across, across);
        let noise = Vector3::from_fn(|_, _| dice.normal()).component_mul(&sigmas);
        let covariance = axes * Matrix3::from_diagonal(&sigmas.component_mul(&sigmas)) * axes.transpose();
        Ok((at + axes * noise, Covariance::new(covariance)?))
    }

    /// The more it is seen from the side, the more of its bits are those of its side; some are wrong.
    fn seen_from(&self, spot: &Spot, from: &Vector3<f64>, dice: &mut Dice) -> Descriptor {
        let towards = (from - spot.at).normalize();
        let aside = acos(spot.towards.dot(&towards).clamp(-1.0, 1.0)) / FRAC_PI_2;
        let [front, side] = &spot.looks;
        let mut seen = [0; DESCRIPTOR_LEN];
        for bit in 0..BITS {
            // Which bits turn first is the same for all landmarks: they are drawn at random anyway.
            let look = if (bit as f64 + 0.5) < aside * BITS as f64 { side } else { front };
            let value = look[bit / 8] >> (bit % 8) & 1 ^ u8::from(dice.chance(self.options.bits_wrong));
            seen[bit / 8] |= value << (bit % 8);
        }
        seen
    }
}

fn descriptor(dice: &mut Dice) -> Descriptor {
    let mut descriptor = [0; DESCRIPTOR_LEN];
    descriptor.chunks_exact_mut(8).for_each(|bytes| bytes.copy_from_slice(&dice.bits().to_le_bytes()));
    descriptor
}

/// Whether there is a surface at the spot (in a copied cell something may be left out), and nothing before it.
fn shows(world: &World, t_world_body: &Se3, spot: &Spot) -> bool {
    let way = spot.at - t_world_body.translation;
    let ray = Ray { origin: t_world_body.translation, direction: way.normalize() };
    world.cast(&ray, way.norm() + SURFACE_M).is_some_and(|range| (range - way.norm()).abs() <= SURFACE_M)
}

/// From a place to its like in every other cell: as far as the places reach.
fn shifts(places: &[Se3], cell_m: f64) -> Vec<Vector3<f64>> {
    let cells = |axis: usize| {
        let along = places.iter().map(|place| place.translation[axis]);
        let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        libm::ceil((high - low).max(0.0) / cell_m) as i32
    };
    let (x, y) = (cells(0), cells(1));
    let shift = |x: i32, y: i32| Vector3::new(f64::from(x), f64::from(y), 0.0) * cell_m;
    (-x..=x).flat_map(|x| (-y..=y).map(move |y| shift(x, y))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::WorldOptions;
    use crate::world::path::Path;
    use merganser_protocol::geometry::So3;
    use merganser_protocol::submap::landmarks::Descriptor;

    /// A world, and places along a loop in it.
    fn hall(aliased: bool) -> (World, Vec<Se3>) {
        let path = Path::of_robot(0, 5.0, 3.0, &mut Dice::new(1, "path"));
        let options = WorldOptions { aliased, cell_m: 7.0, ..WorldOptions::default() };
        let place = |k: u32| {
            let ([x, y], heading) = path.at(f64::from(k));
            Se3::new(So3::exp(&Vector3::new(0.0, 0.0, heading)), Vector3::new(x, y, 0.8))
        };
        (World::generate(&options, core::slice::from_ref(&path), 1), (0..30).map(place).collect())
    }

    fn exact() -> LandmarkOptions {
        LandmarkOptions {
            seen: 1.0,
            direction_sigma_deg: 1e-3,
            depth_sigma: 1e-5,
            bits_wrong: 0.0,
            alike: 0.0,
            mistaken: 0.0,
            ..LandmarkOptions::default()
        }
    }

    fn camera(options: LandmarkOptions, aliased: bool) -> (Camera, World, Vec<Se3>) {
        let (world, places) = hall(aliased);
        let camera = Camera::new(options, &world, &places, aliased.then_some(7.0), &mut Dice::new(1, "landmarks"));
        (camera, world, places)
    }

    fn differing(a: &Descriptor, b: &Descriptor) -> u32 {
        a.iter().zip(b).map(|(a, b)| (a ^ b).count_ones()).sum()
    }

    #[test]
    fn landmarks_lie_on_surfaces_in_view_and_in_the_slams_unit() {
        let (camera, world, places) = camera(exact(), false);
        let mut count = 0;
        for place in &places {
            let [metres, units] =
                [1.0, 0.5].map(|unit| camera.look(&world, place, unit, &mut Dice::new(2, "look")).unwrap());
            count += metres.0.len();
            for (((p, mark), q), other) in metres.0.iter().zip(&metres.1).zip(&units.0).zip(&units.1) {
                let p = Vector3::from(p.map(f64::from));
                assert!(p.norm() <= 10.01 && p.y.atan2(p.x).to_degrees().abs() <= 50.1, "{p}");
                let spot = camera.spots.iter().find(|spot| (spot.at - *place * p).norm() < 0.02);
                assert!(spot.is_some_and(|spot| shows(&world, place, spot)), "{p} is no landmark, or hidden");
                assert!((Vector3::from(q.map(f64::from)) - 2.0 * p).norm() < 1e-4);
                assert!((other.covariance.matrix() - 4.0 * mark.covariance.matrix()).norm() < 1e-9);
            }
        }
        assert!(count > 100 * places.len(), "{count}");
    }

    #[test]
    fn errors_fit_their_covariances() {
        let options = LandmarkOptions { direction_sigma_deg: 0.2, depth_sigma: 0.01, ..exact() };
        let (noisy, world, places) = camera(options, false);
        let (mut sum, mut count) = (0.0, 0.0);
        for place in &places {
            let (points, marks) = noisy.look(&world, place, 1.0, &mut Dice::new(3, "look")).unwrap();
            for (point, mark) in points.iter().zip(&marks) {
                // Seen from the front it is told by its looks.
                let looks = mark.descriptor.unwrap();
                let Some(spot) = noisy.spots.iter().find(|spot| differing(&spot.looks[0], &looks) < 64) else {
                    continue;
                };
                let off = Vector3::from(point.map(f64::from)) - place.inverse() * spot.at;
                sum += mark.covariance.mahalanobis_squared(&off);
                count += 1.0;
            }
        }
        // χ²₃ has mean 3 and variance 6.
        let mean: f64 = sum / count;
        assert!(count > 1000.0 && (mean - 3.0).abs() < 4.0 * (6.0f64 / count).sqrt(), "{mean} over {count}");
    }

    #[test]
    fn looks_change_with_the_side_and_from_one_to_the_next() {
        let (still, ..) = camera(exact(), false);
        let spot = &still.spots[0];
        let beside = spot.towards.cross(&Vector3::z()).normalize();
        let seen = |camera: &Camera, degrees: f64, dice: u64| {
            let angle = degrees.to_radians();
            let from = spot.at + 3.0 * (spot.towards * cos(angle) + beside * sin(angle));
            camera.seen_from(spot, &from, &mut Dice::new(dice, "bits"))
        };
        assert_eq!(seen(&still, 0.0, 1), spot.looks[0]);
        assert_eq!(seen(&still, 90.0, 1), spot.looks[1]);
        let turned = [10.0, 30.0, 60.0].map(|degrees| differing(&seen(&still, degrees, 1), &spot.looks[0]));
        assert!(turned[0] < turned[1] && turned[1] < turned[2], "{turned:?}");
        // Half of the 256/3 bits that are those of the side differ.
        assert!((28..=58).contains(&turned[1]), "{turned:?}");
        let (shaky, ..) = camera(LandmarkOptions { bits_wrong: 0.1, ..exact() }, false);
        let wrong = differing(&seen(&shaky, 0.0, 1), &spot.looks[0]);
        assert!((10..=42).contains(&wrong), "{wrong}");
        assert_ne!(seen(&shaky, 0.0, 1), seen(&shaky, 0.0, 2));
    }

    #[test]
    fn a_repeated_world_has_repeated_landmarks() {
        let (camera, world, places) = camera(exact(), true);
        let mut twice = 0;
        for place in &places {
            let (_, marks) = camera.look(&world, place, 1.0, &mut Dice::new(4, "look")).unwrap();
            let fronts = marks.iter().filter_map(|mark| mark.descriptor);
            let known = fronts.filter(|d| camera.spots.iter().filter(|s| s.looks[0] == *d).count() > 1);
            twice += known.count();
        }
        assert!(camera.spots.len() > 1000 && twice > 0, "{} {twice}", camera.spots.len());
    }
}
