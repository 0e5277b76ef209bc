//! A ray-cast world: boxes seen from inside and outside, pillars, and a spinning range sensor with noise and odometry
//! that drifts inside each submap.

use crate::data::{Place, Set, config, place_drifted};
use merganser_protocol::config::Sensor;
use merganser_protocol::geometry::{Se3, So3};
use nalgebra::{Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub struct World {
    /// Axis-aligned boxes, by their corners: the first is the hall, seen from inside.
    boxes: Vec<[Vector3<f64>; 2]>,
    /// Upright cylinders: x, y, radius.
    pillars: Vec<[f64; 3]>,
}

const RANGE_MAX: f64 = 12.0;
const VOXEL: f64 = 0.15;
/// Half the width of an aisle.
const AISLE: f64 = 0.8;

impl World {
    /// A furnished hall of 14 × 9 × 3 m.
    pub fn hall(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut boxes = vec![[Vector3::new(-7.0, -4.5, 0.0), Vector3::new(7.0, 4.5, 3.0)]];
        for _ in 0..14 {
            let corner = Vector3::new(rng.random_range(-7.0..6.0), rng.random_range(-4.5..4.0), 0.0);
            let size = Vector3::new(rng.random_range(0.3..1.8), rng.random_range(0.3..1.2), rng.random_range(0.4..2.2));
            boxes.push([corner, corner + size]);
        }
        let pillars =
            (0..5).map(|_| [rng.random_range(-6.0..6.0), rng.random_range(-4.0..4.0), rng.random_range(0.1..0.3)]);
        Self { boxes, pillars: pillars.collect() }
    }

    /// A bare corridor, its ends beyond the sensor's range.
    pub fn corridor() -> Self {
        Self { boxes: vec![[Vector3::new(-100.0, -1.0, 0.0), Vector3::new(100.0, 1.0, 2.5)]], pillars: vec![] }
    }

    /// A corridor four metres wide whose ends are beyond the sensor's range, and so many cupboards in it, which alone
    /// tell how far along it one is.
    pub fn furnished_corridor(cupboards: usize) -> Self {
        let walls = [Vector3::new(-100.0, -2.0, 0.0), Vector3::new(100.0, 2.0, 2.5)];
        let cupboard = |k: usize| {
            // Never two at the same distance, on both sides by turns.
            let (at, side) = (-3.0 + 2.3 * k as f64, if k.is_multiple_of(2) { 1.25 } else { -2.0 });
            [Vector3::new(at, side, 0.0), Vector3::new(at + 0.9, side + 0.75, 2.0)]
        };
        Self { boxes: std::iter::once(walls).chain((0..cupboards).map(cupboard)).collect(), pillars: vec![] }
    }

    /// Shelves without end: one furnished cell of so many metres again and again, with aisles along x between; or, if
    /// they have walls, rooms with doors where the aisles pass.
    pub fn aisles(cell: f64, walls: bool, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let middle = cell / 2.0;
        let mut model = Vec::new();
        while model.len() < 8 {
            let corner = Vector3::new(rng.random_range(0.0..cell), rng.random_range(0.0..cell), 0.0);
            let size = Vector3::new(rng.random_range(0.3..1.8), rng.random_range(0.3..1.2), rng.random_range(0.4..2.2));
            if corner.y > middle + AISLE || corner.y + size.y < middle - AISLE {
                model.push([corner, corner + size]);
            }
        }
        if walls {
            let wall =
                |from: [f64; 2], to: [f64; 2]| [Vector3::new(from[0], from[1], 0.0), Vector3::new(to[0], to[1], 3.0)];
            model.push(wall([0.0, 0.0], [cell, 0.15]));
            model.push(wall([0.0, 0.0], [0.15, middle - AISLE]));
            model.push(wall([0.0, middle + AISLE], [0.15, cell]));
        }
        let mut boxes = vec![[Vector3::new(-100.0, -100.0, 0.0), Vector3::new(100.0, 100.0, 6.0)]];
        for (x, y) in (-6..6).flat_map(|x| (-6..6).map(move |y| (f64::from(x), f64::from(y)))) {
            let by = Vector3::new(x * cell, y * cell - middle, 0.0);
            boxes.extend(model.iter().map(|corners| corners.map(|corner| corner + by)));
        }
        Self { boxes, pillars: vec![] }
    }

    fn is_free(&self, p: &Vector3<f64>) -> bool {
        let inside =
            |b: &[Vector3<f64>; 2], margin: f64| (0..2).all(|k| p[k] > b[0][k] - margin && p[k] < b[1][k] + margin);
        inside(&self.boxes[0], -0.4)
            && !self.boxes[1..].iter().any(|b| inside(b, 0.3))
            && !self.pillars.iter().any(|c| (p.x - c[0]).hypot(p.y - c[1]) < c[2] + 0.3)
    }

    fn cast(&self, from: &Vector3<f64>, along: &Vector3<f64>) -> Option<f64> {
        let slabs = |b: &[Vector3<f64>; 2]| {
            let (mut near, mut far) = (f64::NEG_INFINITY, f64::INFINITY);
            for k in 0..3 {
                let (a, b) = ((b[0][k] - from[k]) / along[k], (b[1][k] - from[k]) / along[k]);
                near = near.max(a.min(b));
                far = far.min(a.max(b));
            }
            (near, far)
        };
        let mut best = slabs(&self.boxes[0]).1;
        for b in &self.boxes[1..] {
            let (near, far) = slabs(b);
            if near > 0.0 && near < far {
                best = best.min(near);
            }
        }
        for &[x, y, r] in &self.pillars {
            let (dx, dy) = (from.x - x, from.y - y);
            let a = along.x * along.x + along.y * along.y;
            let b = dx * along.x + dy * along.y;
            let root = b * b - a * (dx * dx + dy * dy - r * r);
            if root > 0.0 && -b - root.sqrt() > 0.0 {
                best = best.min((-b - root.sqrt()) / a);
            }
        }
        (best < RANGE_MAX).then_some(best)
    }

    fn scan(&self, t_world_body: &Se3, noise: f64, rng: &mut ChaCha8Rng) -> Vec<[f32; 3]> {
        let mut points = Vec::new();
        for ring in 0..32 {
            let elevation = (f64::from(ring) * 2.0 - 31.0_f64).to_radians();
            for step in 0..360 {
                let azimuth = (f64::from(step) + 0.5).to_radians();
                let ray =
                    Vector3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
                if let Some(range) = self.cast(&t_world_body.translation, &(t_world_body.rotation * ray)) {
                    let p = ray * (range + noise * gaussian(rng));
                    points.push([p.x as f32, p.y as f32, p.z as f32]);
                }
            }
        }
        points
    }

    /// A submap of 5 scans along a short drive from a random free place (within `spread` of the world's middle).
    fn drive(&self, spread: [f64; 2], noise: f64, drift: f64, voxel: f64, rng: &mut ChaCha8Rng) -> Place {
        let (mut t_world_body, heading) = loop {
            let at =
                Vector3::new(spread[0] * rng.random_range(-1.0..1.0), spread[1] * rng.random_range(-1.0..1.0), 1.0);
            let yaw = rng.random_range(-3.1..3.1);
            let pose = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, yaw)), at);
            let ahead = pose * Vector3::new(1.6, 0.0, 0.0);
            if self.is_free(&at) && self.is_free(&ahead) {
                break (pose, rng.random_range(-0.1..0.1));
            }
        };
        let mut believed = t_world_body;
        let (mut keyframes, mut truth) = (Vec::new(), Vec::new());
        for _ in 0..5 {
            truth.push(t_world_body);
            keyframes.push((believed, self.scan(&t_world_body, noise, rng)));
            let step = Vector6::new(0.4, 0.0, 0.0, 0.0, 0.0, heading);
            let error = Vector6::from_fn(|k, _| gaussian(rng) * drift * if k < 3 { 1.0 } else { 0.3 });
            t_world_body = t_world_body.retract(&step);
            believed = believed.retract(&(step + error));
        }
        place_drifted(&config(Sensor::Lidar3d, voxel, 5), keyframes, &truth)
    }

    /// Several submaps of this world.
    pub fn set(&self, name: &'static str, count: usize, spread: [f64; 2], drift: f64, seed: u64) -> Set {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let places = (0..count).map(|_| self.drive(spread, 0.02, drift, VOXEL, &mut rng)).collect();
        Set { name, places, rotation_deg_max: 5.0, translation_max: 0.4 }
    }
}

fn gaussian(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0
}
