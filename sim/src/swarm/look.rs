//! Looking at the swarm: samples for the checks, and where frames truly lie.

use super::robot::Robot;
use super::{Event, Swarm, all_agree, all_done};
use crate::check::{Phase, RobotSample, Sample, Seen};
use crate::core::Restartable;
use crate::field::{Layout, TICK};
use crate::network::millis;
use merganser_protocol::snapshot::SubmapView;
use merganser_protocol::time::Instant;
use std::collections::BTreeSet;

/// Between two samples at most, s.
const SAMPLE_SECS_MAX: f64 = 20.0;

impl<C: Restartable> Swarm<C> {
    /// Notices who can hear whom, and plans to tell those for whom it changed.
    pub(super) fn update_hearing(&mut self, now: Instant) {
        let options = self.network.options().clone();
        let alive: Vec<bool> = self.robots.iter().map(|r| r.core.is_some() && now >= r.paused_until).collect();
        for observer in 0..alive.len() {
            let running = self.robots[observer].core.is_some();
            let known = self.robots[observer].hears.keys().copied();
            let subjects: BTreeSet<usize> = known.chain(self.network.in_reach(observer)).collect();
            for subject in subjects {
                // Two robots under one name look like one: that a twin comes or goes, nobody sees.
                let shows = self.robots[subject].twin.is_none() && self.robots[subject].id != self.robots[observer].id;
                let so = running && alive[subject] && shows && self.network.is_open(subject, observer);
                let hearing = self.robots[observer].hears.entry(subject).or_default();
                if hearing.so == so {
                    continue;
                }
                hearing.so = so;
                hearing.version += 1;
                let delay = millis(if so { options.discover_ms } else { options.lease_ms });
                self.queue.push(now.after(delay), Event::Hear { observer, subject, version: hearing.version });
            }
        }
    }

    /// Robots drive on, and radios reach others.
    pub(super) fn move_on(&mut self, now: Instant) {
        self.field.drive(now.as_secs_f64(), TICK);
        self.reach();
        self.update_hearing(now);
        self.queue.push(now.after(millis(1e3 * TICK)), Event::Move);
    }

    /// Tells the network who is in reach of whom. Where all are, it knows. Once all is healed, no robot is out of reach
    /// of all others: whom nobody hears, nobody can be asked to have told.
    pub(super) fn reach(&mut self) {
        if self.scenario.radio == Layout::Mesh {
            return;
        }
        let place: Vec<usize> = (0..self.robots.len()).map(|robot| self.drives(robot)).collect();
        let mut reach = self.field.reach(&place);
        if self.healed {
            let runs: Vec<bool> = self.robots.iter().map(|robot| robot.core.is_some()).collect();
            self.field.join(&place, &runs, &mut reach);
        }
        self.network.set_reach(reach);
    }

    pub(super) fn sample(&mut self, now: Instant) {
        let robots = self.robot_samples(now);
        self.pin_frames(&robots);
        self.agreed_since = self.agreed_since.or(Some(now)).filter(|_| self.healed && all_agree(&robots));
        let (down, expect) = (self.down(), &self.scenario.expect);
        let done = self.healed && down.is_empty() && all_done(&robots);
        self.done_samples = if done { self.done_samples + 1 } else { 0 };
        let phase = if self.healed { Phase::Calm } else { Phase::Storm };
        let sample =
            Sample { at: now, phase, robots, down, truth: &self.truth, expect, adversaries: &self.adversaries };
        let (checks, stopwatch) = (&mut self.checks, &mut self.stopwatch);
        if let Some(violation) = stopwatch.time("check", || checks.sample(now, &sample)) {
            self.violation.get_or_insert(violation);
        }
        // A snapshot costs more the more robots there are, and there are as many of them.
        let pause = (0.2 * self.robots.len() as f64).clamp(1.0, SAMPLE_SECS_MAX);
        self.queue.push(now.after(millis(1e3 * pause)), Event::Sample);
    }

    /// Robots that should run and do not.
    pub(super) fn down(&self) -> Vec<String> {
        self.robots.iter().filter(|robot| robot.core.is_none() && !robot.gone).map(Robot::label).collect()
    }

    pub(super) fn robot_samples(&mut self, now: Instant) -> Vec<RobotSample> {
        let stopwatch = &mut self.stopwatch;
        let liars = self.scenario.summary.as_ref().map_or(&[][..], |summary| &summary.liars);
        let mut sample = |(index, robot): (usize, &Robot<C>)| {
            let local = robot.local(now);
            let core = robot.core.as_ref()?;
            Some(RobotSample {
                index,
                name: robot.label(),
                digest: core.digest(),
                logs: core.logs(),
                disk_bytes: robot.store.disk().len(),
                snapshot: stopwatch.time("snapshot", || core.snapshot(local)),
                lies: liars.iter().any(|liar| *liar == *robot.name.as_str()),
            })
        };
        self.robots.iter().enumerate().filter_map(&mut sample).collect()
    }

    /// A frame truly lies where the first keyframe of its first submap does: every estimate starts there. Until a robot
    /// has one, its first keyframe stands in; they differ if a crash swallowed what came between.
    pub(super) fn pin_frames(&mut self, samples: &[RobotSample]) {
        for snapshot in samples.iter().filter_map(|sample| sample.snapshot.as_ref()) {
            let first = |s: &&SubmapView| s.index == 0 && s.robot == snapshot.status.robot;
            for submap in snapshot.map.submaps.iter().filter(first) {
                let Some(robot) = self.find(&submap.robot) else { continue };
                let slam = &self.robots[robot].slam;
                let nanos = slam.drive_nanos(submap.stamps_secs[0]);
                if let Some(step) = self.stage.steps(robot).iter().min_by_key(|step| step.nanos.abs_diff(nanos)) {
                    self.truth.insert(submap.frame.clone(), slam.t_world_frame(step, self.stage.unit_m(robot)));
                }
            }
        }
    }

    pub(super) fn see(&mut self, robot: usize, seen: &Seen<'_>) {
        let (checks, now) = (&mut self.checks, self.queue.now());
        if let Some(violation) = self.stopwatch.time("check", || checks.see(now, robot, seen)) {
            self.violation.get_or_insert(violation);
        }
    }
}
