//! The stage of a run: the world, every robot's drive through it, and the scans, all from one scenario and one seed. A
//! scan is made only when it is asked for, and the same whenever it is.

use crate::dice::Dice;
use crate::scenario::Scenario;
use crate::world::World;
use crate::world::drive::{Step, drive};
use crate::world::path::Path;
use crate::world::sensor::Sensor;
use crate::world::trajectory::{Trajectory, TrajectoryError};
use merganser_protocol::geometry::CovarianceError;
use thiserror::Error;

/// World, drives and sensor.
#[derive(Clone, Debug)]
pub struct Stage {
    seed: u64,
    names: Vec<String>,
    world: World,
    sensor: Sensor,
    /// Points of a made-up scan, at summary level.
    made_up: Option<usize>,
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
    /// Sets the stage; each robot drives a loop of its own.
    ///
    /// # Errors
    /// [`StageError`] if the drift options are out of any covariance's range.
    pub fn new(scenario: &Scenario, seed: u64) -> Result<Self, StageError> {
        let options = &scenario.world;
        let path = |robot: usize| {
            let mut dice = Dice::new(seed, &format!("path {robot}"));
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
        let one = |(robot, path)| {
            let mut dice = Dice::new(seed, &format!("drive {robot}"));
            drive(&scenario.drive, path, scenario.duration_secs, &mut dice)
        };
        let steps = paths.iter().enumerate().map(one).collect::<Result<_, _>>()?;
        let made_up = scenario.summary.as_ref().map(|summary| summary.points);
        Ok(Self { seed, names: scenario.names(), world, sensor: Sensor::new(scenario.sensor.clone()), made_up, steps })
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

    /// The points of one keyframe, body frame, m.
    pub fn scan(&self, robot: usize, index: usize) -> Vec<[f32; 3]> {
        let mut dice = Dice::new(self.seed, &format!("scan {robot} {index}"));
        if let Some(points) = self.made_up {
            return (0..points).map(|_| [0; 3].map(|_| dice.range(-1.5, 1.5) as f32)).collect();
        }
        self.sensor.scan(&self.world, &self.steps[robot][index].t_world_body, &mut dice)
    }
}
