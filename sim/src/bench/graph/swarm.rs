//! Robots that search a field, each in a cell of its own and in its neighbours': the truth, and what they measure.

use crate::dice::Dice;
use libm::{atan2, sqrt};
use merganser_protocol::estimate::graph::{Factor, Source};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, So3};
use merganser_protocol::ids::{FrameId, RobotId, SubmapId};
use nalgebra::{Matrix6, Vector3, Vector6};
use std::collections::BTreeMap;

/// Side of a robot's cell, how far from its middle the robot strays, and its way between anchors, m.
const CELL_M: f64 = 100.0;
const STRAY_M: f64 = 80.0;
const STEP_M: f64 = 10.0;
/// How far apart two anchors may be aligned, m.
const REACH_M: f64 = 15.0;
/// Anchors of one robot fewer steps apart than this are not aligned.
const REVISIT_STEPS: usize = 4;
/// Standard deviations of a step, of an alignment, and of the frame alignments that a solve starts from: m, rad.
const ODOMETRY: (f64, f64) = (0.05, 0.005);
const ALIGNMENT: (f64, f64) = (0.1, 0.01);
const FRAME: (f64, f64) = (0.3, 0.02);

/// Factors that an anchor brings at most: a step, and alignments with one of its own robot's and two of others'.
const FACTORS_EACH: usize = 4;

/// The swarm so far.
pub(super) struct Swarm {
    dice: Dice,
    robots: Vec<Robot>,
    /// Measured since this was last taken.
    pub(super) new_factors: Vec<Factor<SubmapId>>,
}

struct Robot {
    middle: Vector3<f64>,
    /// True poses of its anchors.
    poses: Vec<Se3>,
    /// Its own measurements of its steps.
    steps: Vec<Se3>,
}

pub(super) fn submap(robot: usize, index: usize) -> SubmapId {
    let robot = RobotId((robot as u64).to_be_bytes());
    SubmapId { frame: FrameId { robot, epoch: 0 }, index: index as u32 }
}

impl Swarm {
    /// `robots` that have driven `anchors` each; every anchor is aligned with one of its own robot's and two of
    /// others' where any lie in reach, and each robot's first with its predecessor's.
    pub(super) fn new(seed: u64, robots: usize, anchors: usize) -> Self {
        let side = (1..).find(|n| n * n >= robots).unwrap_or(1);
        let mut dice = Dice::new(seed, "swarm");
        let robot = |k: usize| {
            let middle = Vector3::new((k % side) as f64 * CELL_M, (k / side) as f64 * CELL_M, 0.0);
            let heading = dice.range(-core::f64::consts::PI, core::f64::consts::PI);
            let offset = Vector3::new(dice.range(-0.3, 0.3) * CELL_M, dice.range(-0.3, 0.3) * CELL_M, 0.0);
            let first = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, heading)), middle + offset);
            Robot { middle, poses: vec![first], steps: Vec::new() }
        };
        let robots: Vec<Robot> = (0..robots).map(robot).collect();
        let new_factors = Vec::with_capacity(FACTORS_EACH * robots.len() * anchors);
        let mut swarm = Self { dice, robots, new_factors };
        for robot in 0..swarm.robots.len() {
            (1..anchors).for_each(|_| swarm.drive(robot));
            if robot > 0 {
                swarm.measure((robot - 1, 0), (robot, 0), ALIGNMENT);
            }
        }
        for robot in 0..swarm.robots.len() {
            for index in 0..anchors {
                swarm.close_loop((robot, index), |other, at| other == robot && at + REVISIT_STEPS <= index);
                (0..2).for_each(|_| swarm.close_loop((robot, index), |other, _| other != robot));
            }
        }
        swarm
    }

    /// Where a solve starts: each robot's own track, its frame aligned by a little error.
    pub(super) fn start(&mut self) -> BTreeMap<SubmapId, Sim3> {
        let mut start = BTreeMap::new();
        for (k, robot) in self.robots.iter().enumerate() {
            let mut pose = robot.poses[0].retract(&noise(&mut self.dice, FRAME));
            start.insert(submap(k, 0), Sim3::from_se3(&pose));
            for (index, step) in robot.steps.iter().enumerate() {
                pose = pose * *step;
                start.insert(submap(k, index + 1), Sim3::from_se3(&pose));
            }
        }
        start
    }

    /// Some robot makes one more anchor.
    pub(super) fn drive_on(&mut self, closes_loop: bool) -> SubmapId {
        let robot = (self.dice.bits() % self.robots.len() as u64) as usize;
        self.drive(robot);
        let index = self.robots[robot].poses.len() - 1;
        if closes_loop {
            self.close_loop((robot, index), |other, at| other != robot || at + REVISIT_STEPS <= index);
        }
        submap(robot, index)
    }

    fn drive(&mut self, robot: usize) {
        let Self { dice, robots, .. } = self;
        let own = &robots[robot];
        let last = own.poses[own.poses.len() - 1];
        let home = last.inverse() * own.middle;
        let strays = (own.middle - last.translation).norm() > STRAY_M;
        let turn = if strays { 0.6 * atan2(home.y, home.x) } else { 0.5 * dice.normal() };
        let tilt = Vector3::new(0.02 * dice.normal(), 0.02 * dice.normal(), turn);
        let step = Se3::new(So3::exp(&tilt), Vector3::new(STEP_M, 0.0, 0.1 * dice.normal()));
        self.robots[robot].poses.push(last * step);
        let index = self.robots[robot].poses.len() - 1;
        let measured = self.measure((robot, index - 1), (robot, index), ODOMETRY);
        self.robots[robot].steps.push(measured);
    }

    /// Aligns an anchor with one in reach among those `wanted`, if there is any.
    fn close_loop(&mut self, (robot, index): (usize, usize), wanted: impl Fn(usize, usize) -> bool) {
        let at = self.robots[robot].poses[index].translation;
        let mut near = Vec::new();
        for (other, own) in self.robots.iter().enumerate() {
            if (own.middle - self.robots[robot].middle).norm() > 4.0 * CELL_M {
                continue;
            }
            for (k, pose) in own.poses.iter().enumerate() {
                let off = pose.translation - at;
                if sqrt(off.x * off.x + off.y * off.y) < REACH_M && wanted(other, k) {
                    near.push((other, k));
                }
            }
        }
        if !near.is_empty() {
            let chosen = near[(self.dice.bits() % near.len() as u64) as usize];
            self.measure(chosen, (robot, index), ALIGNMENT);
        }
    }

    fn measure(&mut self, i: (usize, usize), j: (usize, usize), sigmas: (f64, f64)) -> Se3 {
        let truth = self.robots[i.0].poses[i.1].inverse() * self.robots[j.0].poses[j.1];
        let pose = truth.retract(&noise(&mut self.dice, sigmas));
        let (p, r) = (sigmas.0 * sigmas.0, sigmas.1 * sigmas.1);
        let covariance = Covariance::new_or_wider(Matrix6::from_diagonal(&Vector6::new(p, p, p, r, r, r)));
        let t_i_j = Relative::Metric(PoseWithCovariance { pose, covariance });
        let (i, j) = (submap(i.0, i.1), submap(j.0, j.1));
        self.new_factors.push(Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 });
        pose
    }
}

fn noise(dice: &mut Dice, (rho, phi): (f64, f64)) -> Vector6<f64> {
    Vector6::from_fn(|k, _| dice.normal() * if k < 3 { rho } else { phi })
}
