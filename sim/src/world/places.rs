//! What a place-recognition network would say of a keyframe: a vector whose cosine with another falls with the distance
//! between the two places as a Gaussian does, and with noise. Random Fourier features of the position (Rahimi & Recht
//! 2007): as meaningless to the agent as the numbers of a real network.

use crate::dice::Dice;
use core::f64::consts::TAU;
use libm::{cos, sqrt};
use merganser_protocol::submap::PlaceDescriptor;
use merganser_protocol::submap::place::{Metric, PlaceError};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// What the network is like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlaceOptions {
    /// Numbers of a vector.
    pub numbers: usize,
    /// Distance at which two places have a cosine of 0.61, m.
    pub reach_m: f64,
    /// Length of the noise beside that of the vector.
    pub noise: f64,
    /// How vectors are compared.
    pub metric: Metric,
}

impl Default for PlaceOptions {
    fn default() -> Self {
        Self { numbers: 4096, reach_m: 4.0, noise: 0.3, metric: Metric::Cosine }
    }
}

impl PlaceOptions {
    /// What each value may be, and how to mend one that is not.
    pub fn ranges(&self) -> [(&'static str, f64, f64, f64, &'static str); 3] {
        [
            ("places.numbers", self.numbers as f64, 2.0, 16_384.0, "use 2 to 16384 numbers"),
            ("places.reach_m", self.reach_m, 0.1, 1000.0, "use 0.1 to 1000 m"),
            ("places.noise", self.noise, 0.0, 10.0, "use 0 to 10"),
        ]
    }
}

/// The network, the same on all robots.
#[derive(Clone, Debug)]
pub struct Places {
    options: PlaceOptions,
    /// Wave vector and phase of each number.
    waves: Vec<(Vector3<f64>, f64)>,
}

impl Places {
    /// A network.
    pub fn new(options: PlaceOptions, dice: &mut Dice) -> Self {
        let mut wave = |_| (Vector3::from_fn(|_, _| dice.normal() / options.reach_m), dice.range(0.0, TAU));
        let waves = (0..options.numbers).map(&mut wave).collect();
        Self { options, waves }
    }

    /// What it says of a place in the world.
    ///
    /// # Errors
    /// [`PlaceError`] for options that give no vector.
    pub fn look(&self, at: &Vector3<f64>, dice: &mut Dice) -> Result<PlaceDescriptor, PlaceError> {
        let scale = sqrt(2.0 / self.options.numbers as f64);
        let noise = self.options.noise / sqrt(self.options.numbers as f64);
        let mut number =
            |(wave, phase): &(Vector3<f64>, f64)| (scale * cos(wave.dot(at) + phase) + noise * dice.normal()) as f32;
        let vector = self.waves.iter().map(&mut number).collect();
        PlaceDescriptor::new("simulated", self.options.metric, vector)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cosines_fall_with_the_distance() {
        let options = PlaceOptions::default();
        let places = Places::new(options.clone(), &mut Dice::new(1, "places"));
        let mut dice = Dice::new(1, "noise");
        let mut look = |x: f64| places.look(&Vector3::new(x, 1.0, 0.5), &mut dice).unwrap().vector().to_vec();
        let origin = look(3.0);
        let length = |a: &[f32]| a.iter().map(|x| x * x).sum::<f32>().sqrt();
        for apart in [0.0, 2.0, 4.0, 20.0] {
            let there = look(3.0 + apart);
            let dot: f32 = origin.iter().zip(&there).map(|(a, b)| a * b).sum();
            let cosine = f64::from(dot / length(&origin) / length(&there));
            let expected = libm::exp(-0.5 * (apart / options.reach_m).powi(2)) / (1.0 + options.noise * options.noise);
            assert!((cosine - expected).abs() < 0.06, "{apart} m: {cosine} instead of {expected}");
        }
    }
}
