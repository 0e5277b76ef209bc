//! A spinning 3-D range sensor: rows of rays that turn once per scan, range noise, drop-outs. The scan is taken in an
//! instant (no motion distortion), from a seed per keyframe, so any scan can be made without the ones before it.

use super::World;
use super::shape::Ray;
use crate::dice::Dice;
use core::f64::consts::TAU;
use libm::{cos, sin};
use merganser_protocol::geometry::Se3;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// What the sensor is like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorOptions {
    /// Rows of rays, evenly spaced between the two elevations.
    pub rows: usize,
    /// Rays per row and turn.
    pub columns: usize,
    /// Lowest and highest elevation, degrees.
    pub elevation_deg: [f64; 2],
    /// Shortest and longest range, m.
    pub range_m: [f64; 2],
    /// Standard deviation of a range, m.
    pub range_sigma_m: f64,
    /// Share of rays that return nothing though something is there.
    pub dropout: f64,
    /// Standard deviation of what an inertial sensor beside it takes for up, degrees; without it, there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gravity_sigma_deg: Option<f64>,
}

impl Default for SensorOptions {
    fn default() -> Self {
        Self {
            rows: 24,
            columns: 180,
            elevation_deg: [-24.0, 22.0],
            range_m: [0.4, 20.0],
            range_sigma_m: 0.01,
            dropout: 0.02,
            gravity_sigma_deg: None,
        }
    }
}

/// The sensor, with its directions worked out.
#[derive(Clone, Debug)]
pub struct Sensor {
    options: SensorOptions,
    /// (cos, sin) of each row's elevation.
    rows: Vec<[f64; 2]>,
}

impl Sensor {
    /// A sensor.
    pub fn new(options: SensorOptions) -> Self {
        let [low, high] = options.elevation_deg;
        let last = options.rows.saturating_sub(1).max(1) as f64;
        let elevation = |row: usize| (low + (high - low) * row as f64 / last).to_radians();
        let rows = (0..options.rows).map(elevation).map(|e| [cos(e), sin(e)]).collect();
        Self { options, rows }
    }

    /// What the sensor sees from `t_world_body`: points in the body frame, m.
    pub fn scan(&self, world: &World, t_world_body: &Se3, dice: &mut Dice) -> Vec<[f32; 3]> {
        let [near, far] = self.options.range_m;
        let rotation = t_world_body.rotation.matrix();
        // Each turn begins anywhere, so that two scans of one place do not sample the same spots.
        let phase = dice.range(0.0, TAU);
        let mut points = Vec::with_capacity(self.options.columns * self.rows.len());
        for column in 0..self.options.columns {
            let azimuth = phase + TAU * column as f64 / self.options.columns as f64;
            let (s, c) = (sin(azimuth), cos(azimuth));
            for &[level, up] in &self.rows {
                let direction = Vector3::new(level * c, level * s, up);
                let ray = Ray { origin: t_world_body.translation, direction: rotation * direction };
                let dropped = dice.chance(self.options.dropout);
                let noise = self.options.range_sigma_m * dice.normal();
                let Some(range) = world.cast(&ray, far).filter(|&r| r >= near && !dropped) else { continue };
                let point = direction * (range + noise);
                points.push([point.x as f32, point.y as f32, point.z as f32]);
            }
        }
        points
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::shape::Shape;
    use merganser_protocol::geometry::So3;

    /// A square room, 10 m wide, walls 1 m thick and 5 m high.
    fn room() -> World {
        let wall = |x, y, dx, dy| Shape::block([x, y], 0.0, [dx, dy, 5.0], 0.0, 0.0);
        World::of(vec![
            wall(5.5, 0.0, 1.0, 12.0),
            wall(-5.5, 0.0, 1.0, 12.0),
            wall(0.0, 5.5, 12.0, 1.0),
            wall(0.0, -5.5, 12.0, 1.0),
        ])
    }

    #[test]
    fn points_lie_on_the_walls_and_the_ground() {
        let options = SensorOptions { range_sigma_m: 0.0, dropout: 0.0, ..SensorOptions::default() };
        let sensor = Sensor::new(options.clone());
        let pose = Se3::new(So3::exp(&Vector3::new(0.02, -0.03, 0.7)), Vector3::new(1.0, -0.5, 1.0));
        let points = sensor.scan(&room(), &pose, &mut Dice::new(1, "scan"));
        assert!(points.len() > options.rows * options.columns * 9 / 10, "{}", points.len());
        for p in points {
            let p = pose * Vector3::from(p.map(f64::from));
            let off = (5.0 - p.x.abs()).abs().min((5.0 - p.y.abs()).abs()).min(p.z.abs());
            assert!(off < 1e-5, "{p} lies on no surface");
        }
    }

    #[test]
    fn noise_and_dropouts_are_as_stated() {
        let world = room();
        let pose = Se3::new(So3::identity(), Vector3::new(0.0, 0.0, 1.0));
        let scan = |range_sigma_m, dropout, elevation_deg| {
            let options = SensorOptions { range_sigma_m, dropout, elevation_deg, ..SensorOptions::default() };
            Sensor::new(options).scan(&world, &pose, &mut Dice::new(2, "scan"))
        };
        let all = scan(0.0, 0.0, [-1.0, 1.0]).len() as f64;
        let kept = scan(0.0, 0.25, [-1.0, 1.0]).len() as f64 / all;
        assert!((kept - 0.75).abs() < 0.03, "{kept}");
        let clean = scan(0.0, 0.0, [-1.0, 1.0]);
        let noisy = scan(0.05, 0.0, [-1.0, 1.0]);
        let norm = |p: &[f32; 3]| Vector3::from(p.map(f64::from)).norm();
        let square: f64 = clean.iter().zip(&noisy).map(|(a, b)| (norm(a) - norm(b)).powi(2)).sum();
        let sigma = (square / clean.len() as f64).sqrt();
        assert!((sigma - 0.05).abs() < 0.003, "{sigma}");
    }
}
