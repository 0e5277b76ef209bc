//! The stage of a run: the world, every robot's drive through it, and the scans, all from one scenario and one seed. A
//! scan is made only when it is asked for, and the same whenever it is.

use crate::dice::Dice;
use crate::scenario::Scenario;
use crate::world::World;
use crate::world::drive::{Step, drive};
use crate::world::landmarks::{Camera, Sightings};
use crate::world::path::Path;
use crate::world::places::{PlaceOptions, Places};
use crate::world::sensor::Sensor;
use crate::world::trajectory::{Trajectory, TrajectoryError};
use core::f64::consts::FRAC_1_SQRT_2;
use merganser_protocol::geometry::{CovarianceError, Se3, So3};
use merganser_protocol::submap::{PlaceDescriptor, Up};
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::Vector3;
use thiserror::Error;

/// World, drives and sensor.
#[derive(Clone, Debug)]
pub struct Stage {
    seed: u64,
    names: Vec<String>,
    world: World,
    sensor: Sensor,
    /// Takes the sensor's place.
    camera: Option<Camera>,
    /// Tells places beside it.
    places: Option<Places>,
    /// What each robot's SLAM takes for one, m.
    units_m: Vec<f64>,
    /// Points of a made-up scan, at summary level.
    made_up: Option<usize>,
    /// Of an inertial sensor, rad.
    gravity_sigma: Option<f64>,
    steps: Vec<Vec<Step>>,
}

/// Why a stage could not be set.
#[derive(Debug, Error)]
pub enum StageError {
    /// The drift cannot be stated as a covariance.
    #[error("drive: {0}; choose drift noise between 1e-6 and 10")]
    Drift(#[from] CovarianceError),
    /// The recorded drive is too short for so many robots.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}

impl Stage {
    /// Sets the stage; each robot drives a loop of its own, or along an aisle.
    ///
    /// # Errors
    /// [`StageError`] if the drift options are out of any covariance's range.
    pub fn new(scenario: &Scenario, seed: u64) -> Result<Self, StageError> {
        let options = &scenario.world;
        let path = |robot: usize| {
            let mut dice = Dice::new(seed, &format!("path {robot}"));
            if options.aisles {
                let length = scenario.drive.speed_m_s * scenario.duration_secs;
                return Path::of_aisle(robot, options.cell_m, length, &mut dice);
            }
            Path::of_robot(robot, options.loop_radius_m, options.loop_spread_m, &mut dice)
        };
        let paths: Vec<Path> = (0..scenario.robots).map(path).collect();
        Self::of(scenario, &paths, seed)
    }

    /// Sets the stage; each robot drives its stretch of a recorded drive.
    ///
    /// # Errors
    /// [`StageError`] as for [`new`](Self::new), or if the drive is too short for so many robots.
    pub fn along(scenario: &Scenario, trajectory: &Trajectory, seed: u64) -> Result<Self, StageError> {
        Self::of(scenario, &trajectory.cut(scenario.robots)?, seed)
    }

    fn of(scenario: &Scenario, paths: &[Path], seed: u64) -> Result<Self, StageError> {
        let world = World::generate(&scenario.world, paths, seed);
        let names = scenario.names();
        let unit = |robot: usize| match &scenario.landmarks {
            Some(camera) if scenario.config_of(&names[robot]).submap.scale == ScaleKind::Unknown => {
                let [least, most] = camera.unit_m;
                least * libm::pow(most / least, Dice::new(seed, &format!("unit {robot}")).uniform())
            }
            _ => 1.0,
        };
        let units_m: Vec<f64> = (0..scenario.robots).map(unit).collect();
        let one = |(robot, path)| {
            let mut dice = Dice::new(seed, &format!("drive {robot}"));
            let steps = drive(&scenario.drive, path, scenario.duration_secs, &mut dice)?;
            steps.into_iter().map(|step| step.in_units(units_m[robot])).collect::<Result<_, _>>()
        };
        let steps: Vec<Vec<Step>> = paths.iter().enumerate().map(one).collect::<Result<_, CovarianceError>>()?;
        let camera = scenario.landmarks.as_ref().map(|options| {
            let places: Vec<Se3> = steps.iter().flatten().map(|step| step.t_world_body).collect();
            let cell_m = scenario.world.aliased.then_some(scenario.world.cell_m);
            Camera::new(options.clone(), &world, &places, cell_m, &mut Dice::new(seed, "landmarks"))
        });
        let of_network = |options: &PlaceOptions| Places::new(options.clone(), &mut Dice::new(seed, "places"));
        let places = scenario.places.as_ref().map(of_network);
        let made_up = scenario.summary.as_ref().map(|summary| summary.points);
        let sensor = Sensor::new(scenario.sensor.clone());
        let gravity_sigma = scenario.sensor.gravity_sigma_deg.map(f64::to_radians);
        Ok(Self { seed, names, world, sensor, camera, places, units_m, made_up, gravity_sigma, steps })
    }

    /// The robots' names.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The world.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// One robot's keyframes.
    pub fn steps(&self, robot: usize) -> &[Step] {
        &self.steps[robot]
    }

    /// What one robot's SLAM takes for one, m.
    pub fn unit_m(&self, robot: usize) -> f64 {
        self.units_m[robot]
    }

    /// What a place-recognition network says of one keyframe, if one runs.
    pub fn place(&self, robot: usize, index: usize) -> Option<PlaceDescriptor> {
        let mut dice = Dice::new(self.seed, &format!("place {robot} {index}"));
        let at = self.steps[robot][index].t_world_body.translation;
        self.places.as_ref()?.look(&at, &mut dice).ok()
    }

    /// What one keyframe takes for up, if an inertial sensor tells: off by what all of the robot's have in common, and
    /// by a draw of its own.
    pub fn up(&self, robot: usize, index: usize) -> Option<Up> {
        let sigma = self.gravity_sigma?;
        let draw = |label: String| {
            let mut dice = Dice::new(self.seed, &label);
            Vector3::from_fn(|_, _| dice.normal())
        };
        let off = draw(format!("up {robot}")) + draw(format!("up {robot} {index}"));
        let r_body_world = self.steps[robot][index].t_world_body.rotation.inverse();
        let seen = So3::exp(&(off * (sigma * FRAC_1_SQRT_2))) * (r_body_world * Vector3::z());
        Up::new(seen.into(), sigma).ok()
    }

    /// The points of one keyframe, body frame, in its SLAM's unit, and a mark for each if they are landmarks.
    ///
    /// # Errors
    /// [`CovarianceError`] if the options of landmarks give a noise that no covariance can hold.
    pub fn scan(&self, robot: usize, index: usize) -> Result<Sightings, CovarianceError> {
        let mut dice = Dice::new(self.seed, &format!("scan {robot} {index}"));
        if let Some(points) = self.made_up {
            return Ok(((0..points).map(|_| [0; 3].map(|_| dice.range(-1.5, 1.5) as f32)).collect(), Vec::new()));
        }
        let t_world_body = &self.steps[robot][index].t_world_body;
        match &self.camera {
            Some(camera) => camera.look(&self.world, t_world_body, self.units_m[robot], &mut dice),
            None => Ok((self.sensor.scan(&self.world, t_world_body, &mut dice), Vec::new())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_inertial_sensor_tells_what_is_up_to_what_it_says() {
        let minimal = "name = \"x\"\nrobots = 2\nduration_secs = 60\n";
        let stage = |extra: &str| Stage::new(&Scenario::parse(&format!("{minimal}{extra}")).unwrap(), 3).unwrap();
        let (without, with) = (stage(""), stage("[sensor]\ngravity_sigma_deg = 2.0"));
        assert_eq!(without.up(0, 0), None);
        // Nothing else of the stage depends on it.
        assert_eq!(without.scan(1, 3).unwrap(), with.scan(1, 3).unwrap());
        let off = |robot: usize, index: usize| {
            let up = with.up(robot, index).unwrap();
            let truth = with.steps(robot)[index].t_world_body.rotation.inverse() * Vector3::z();
            up.direction().cross(&truth).norm() / up.sigma()
        };
        let all: Vec<f64> = (0..2)
            .flat_map(|robot| (0..with.steps(robot).len()).map(move |k| (robot, k)))
            .map(|(r, k)| off(r, k))
            .collect();
        assert!(all.iter().all(|&off| off > 0.0 && off < 5.0), "{all:?}");
        let square = all.iter().map(|off| off * off).sum::<f64>() / all.len() as f64;
        assert!((0.5..5.0).contains(&square), "two axes: {square}");
    }
}
