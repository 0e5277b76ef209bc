//! What befalls robots: processes that start and die, disks that fail, clocks that jump, and the healing of it all.

use super::robot::{NewFrame, Robot};
use super::{Event, Swarm, SwarmError, secs};
use crate::adversary::Adversary;
use crate::check::Seen;
use crate::core::Restartable;
use crate::dice::Dice;
use crate::faults::Fault;
use crate::network::millis;
use merganser_protocol::agent::Restored;
use merganser_protocol::agent::io::{Command, Input};
use merganser_protocol::time::Instant;
use merganser_store::StoreError;

/// Time until a supervisor starts a process again that could not open its store, s.
const SUPERVISOR_SECS: f64 = 1.0;
/// Time that a power cut in the middle of a commit waits for one, s.
const MID_COMMIT_SECS: f64 = 1.0;

impl<C: Restartable> Swarm<C> {
    pub(super) fn boot(&mut self, now: Instant, index: usize) -> Result<(), SwarmError> {
        let robot = &mut self.robots[index];
        if robot.core.is_some() || robot.gone {
            return Ok(());
        }
        let incarnation = robot.incarnation + 1;
        let fresh_epoch = if self.scenario.machine.wall_epochs { robot.slam.wall_epoch(now) } else { incarnation };
        let (records, fresh_epoch, report) = match robot.store.boot(fresh_epoch) {
            Ok(booted) => booted,
            // The advice that the error gives is taken: the file is moved away. (No other version is here: its number
            // was hit.)
            Err(StoreError::Damaged { .. } | StoreError::NotAStore { .. } | StoreError::Schema { .. }) => {
                self.wipe(index);
                self.counts.store_moved_away += 1;
                return self.boot(now, index);
            }
            Err(_) => {
                self.counts.store_unusable += 1;
                self.queue.push(now.after(millis(1e3 * SUPERVISOR_SECS)), Event::Boot { robot: index });
                return Ok(());
            }
        };
        robot.incarnation = incarnation;
        robot.booted = now;
        self.counts.damage_found += report.damaged_count as u64;
        self.counts.logs_closed += u64::from(report.entries_lost);
        let restored = Restored { records, fresh_epoch };
        let seed = Dice::new(self.seed, &format!("agent {index} {incarnation}")).bits();
        let robot = &mut self.robots[index];
        let config = self.scenario.config_of(robot.name.as_str());
        let core = C::start(config, robot.identity.clone(), seed, restored, robot.local(now))
            .map_err(|error| SwarmError::Start(robot.name.to_string(), error))?;
        robot.core = Some(core);
        self.trace.note(now, index, "boot");
        if report.damaged_count > 0 && self.robots[index].suspect {
            self.see(index, &Seen::Damaged);
        }
        let id = self.robots[index].id;
        self.see(index, &Seen::Started(id));
        if self.scenario.adversary(self.robots[index].name.as_str()) == Some(Adversary::Mirror) {
            self.see(index, &Seen::Mirrors);
        }
        self.counts.restarted += u64::from(incarnation > 1);
        self.drain(now, index);
        self.tell_of_new_frame(now, index);
        self.update_hearing(now);
        Ok(())
    }

    fn tell_of_new_frame(&mut self, now: Instant, robot: usize) {
        if self.robots[robot].core.is_some() && self.robots[robot].new_frame.is_some() {
            self.robots[robot].new_frame = Some(NewFrame::Owed);
            self.feed(now, robot, Input::Command(Command::NewEpoch));
        }
    }

    pub(super) fn kill(&mut self, now: Instant, index: usize) {
        if self.robots[index].core.is_none() {
            return;
        }
        let robot = &mut self.robots[index];
        robot.forget(now);
        self.counts.records_lost += robot.store.crash() as u64;
        self.counts.killed += 1;
        self.trace.note(now, index, "kill");
        self.see(index, &Seen::Died);
        self.update_hearing(now);
    }

    /// The power of one robot goes.
    pub(super) fn cut(&mut self, now: Instant, index: usize) {
        let robot = &mut self.robots[index];
        let runs = robot.core.is_some();
        robot.forget(now);
        let seed = Dice::new(self.seed, &format!("cut {index} {}", now.as_nanos())).bits();
        let lied = robot.store.disk().with_faults(|faults| faults.lies);
        let (records, cut) = robot.store.cut(seed);
        self.counts.records_lost += records as u64;
        self.counts.power_cuts += 1;
        self.counts.writes_lost += cut.lost;
        self.counts.writes_torn += cut.torn;
        self.trace.note(now, index, "power cut");
        if runs {
            self.see(index, &Seen::Died);
        }
        if lied {
            self.lost_what_it_confirmed(index);
        }
        self.update_hearing(now);
    }

    pub(super) fn fault_begins(&mut self, now: Instant, index: usize) {
        let fault = self.scenario.faults[index].clone();
        let Some(&robot) = fault.robots().first() else { return };
        let Some(robot) = self.find(robot) else { return };
        match &fault {
            Fault::Partition { .. } | Fault::Isolate { .. } | Fault::OneWay { .. } => self.block(now, &fault, true),
            Fault::Kill { .. } => self.kill(now, robot),
            Fault::PowerCut { mid_commit: None, .. } => self.cut(now, robot),
            Fault::PowerCut { mid_commit: Some(writes), .. } => {
                self.robots[robot].store.disk().with_faults(|faults| faults.dies_after = Some(*writes));
                let incarnation = self.robots[robot].incarnation;
                let at = now.after(millis(1e3 * MID_COMMIT_SECS));
                self.queue.push(at, Event::CutNow { robot, incarnation });
            }
            Fault::Wipe { .. } => {
                self.kill(now, robot);
                self.wipe(robot);
                self.counts.wiped += 1;
            }
            Fault::FlipBits { bits, .. } => self.flip(now, robot, *bits),
            Fault::OldImage { .. } => {
                self.robots[robot].image = Some(self.robots[robot].store.picture());
            }
            Fault::LyingDisk { .. } => self.robots[robot].store.disk().with_faults(|faults| faults.lies = true),
            Fault::DiskFull { .. } => self.robots[robot].store.disk().with_faults(|faults| faults.full = true),
            Fault::DiskErrors { errors, reads, .. } => {
                let seed = Dice::new(self.seed, &format!("errors {index}")).bits();
                let after = seed % 16;
                let change = |faults: &mut merganser_store::simulated::Faults| {
                    (faults.errors_after, faults.errors, faults.reads, faults.seed) = (after, *errors, *reads, seed);
                };
                self.robots[robot].store.disk().with_faults(change);
                self.robots[robot].suspect = true;
            }
            Fault::Pause { lasts, .. } => {
                self.robots[robot].paused_until = now.after(millis(1e3 * lasts));
                self.counts.paused += 1;
                self.update_hearing(now);
            }
            Fault::NewFrame { .. } => {
                self.robots[robot].slam.restart();
                self.counts.new_frames += 1;
                self.robots[robot].new_frame = Some(NewFrame::Owed);
                self.tell_of_new_frame(now, robot);
            }
            Fault::ClockJump { secs, .. } => {
                self.robots[robot].slam.jump(*secs, now);
                self.counts.clock_jumps += 1;
                self.doubt(robot); // two stores made anew may begin with one epoch
            }
            Fault::Equivocate { .. } => {
                self.robots[robot].equivocates = true;
                self.doubt(robot);
                let id = self.robots[robot].id;
                self.see(robot, &Seen::Forges(id));
            }
            Fault::OtherVersion { .. } => self.robots[robot].other_version = true,
            Fault::Flood { .. } => self.queue.push(now, Event::Flood(index)),
            Fault::Leave { .. } => {
                self.kill(now, robot);
                self.robots[robot].gone = true;
                self.counts.left += 1;
            }
            Fault::Twin { .. } => self.twin_begins(now, index, robot),
        }
    }

    pub(super) fn fault_ends(&mut self, now: Instant, index: usize) -> Result<(), SwarmError> {
        let fault = self.scenario.faults[index].clone();
        let Some(&robot) = fault.robots().first() else { return Ok(()) };
        let Some(robot) = self.find(robot) else { return Ok(()) };
        match &fault {
            // The healing may have come first.
            Fault::Partition { .. } | Fault::Isolate { .. } | Fault::OneWay { .. } if !self.healed => {
                self.block(now, &fault, false);
            }
            Fault::Kill { .. } | Fault::Wipe { .. } | Fault::PowerCut { .. } | Fault::FlipBits { .. } => {
                self.boot(now, robot)?;
            }
            Fault::Pause { .. } => self.update_hearing(now),
            Fault::DiskFull { .. } => self.robots[robot].store.disk().with_faults(|faults| faults.full = false),
            Fault::LyingDisk { .. } => {
                self.trust_disk(robot);
                self.cut(now, robot);
                self.lost_what_it_confirmed(robot);
                self.boot(now, robot)?;
            }
            Fault::OldImage { .. } => {
                if let Some(image) = self.robots[robot].image.take() {
                    self.kill(now, robot);
                    self.robots[robot].store.restore(&image);
                    self.counts.old_images += 1;
                    self.lost_what_it_confirmed(robot);
                    self.boot(now, robot)?;
                }
            }
            Fault::Equivocate { .. } => self.robots[robot].equivocates = false,
            Fault::OtherVersion { .. } => self.robots[robot].other_version = false,
            Fault::Twin { .. } => self.twin_ends(now, index),
            _ => {}
        }
        Ok(())
    }

    /// All faults stop, whoever stood still starts again, disks that refused have room, and contact returns.
    pub(super) fn heal(&mut self, now: Instant) -> Result<(), SwarmError> {
        self.healed = true;
        self.network.heal();
        for robot in 0..self.robots.len() {
            self.trust_disk(robot);
            self.robots[robot].store.disk().with_faults(|faults| {
                (faults.full, faults.errors, faults.reads, faults.dies_after) = (false, 0, false, None);
            });
            self.boot(now, robot)?;
        }
        self.reach();
        self.update_hearing(now);
        Ok(())
    }

    /// What was wrong with its bytes is gone with them; what is wrong with the disk is not.
    fn wipe(&mut self, index: usize) {
        let robot = &mut self.robots[index];
        robot.store.wipe();
        robot.suspect &= robot.store.disk().with_faults(|faults| faults.errors > 0);
        self.see(index, &Seen::Wiped);
    }

    fn trust_disk(&mut self, robot: usize) {
        let lied = self.robots[robot].store.disk().with_faults(|faults| {
            faults.lies = false;
            core::mem::take(&mut faults.lied)
        });
        self.counts.syncs_lied += lied;
    }

    /// From now on this robot may have told two stories without being to blame.
    fn doubt(&mut self, robot: usize) {
        let id = self.robots[robot].id;
        self.see(robot, &Seen::MayFork(id));
    }

    fn flip(&mut self, now: Instant, robot: usize, bits: u64) {
        self.kill(now, robot);
        let mut dice = Dice::new(self.seed, &format!("flips {robot} {}", now.as_nanos()));
        let flipped = (0..bits).filter(|_| self.robots[robot].store.disk().flip(dice.bits())).count();
        self.counts.bits_flipped += flipped as u64;
        self.lost_what_it_confirmed(robot);
    }

    fn lost_what_it_confirmed(&mut self, robot: usize) {
        self.doubt(robot);
        self.robots[robot].suspect = true;
        self.see(robot, &Seen::Damaged);
    }

    fn twin_begins(&mut self, now: Instant, fault: usize, of: usize) {
        let Some(twin) = self.robots.iter().position(|robot| robot.twin == Some(fault)) else { return };
        let image = self.robots[of].store.picture();
        self.robots[twin].store.restore(&image);
        (self.robots[twin].gone, self.robots[twin].suspect) = (false, self.robots[of].suspect);
        self.counts.twins += 1;
        self.doubt(of);
        let id = self.robots[of].id;
        self.see(of, &Seen::Forges(id));
        self.queue.push(now, Event::Boot { robot: twin });
    }

    fn twin_ends(&mut self, now: Instant, fault: usize) {
        if let Some(twin) = self.robots.iter().position(|robot| robot.twin == Some(fault)) {
            self.kill(now, twin);
            self.robots[twin].gone = true;
        }
    }

    fn block(&mut self, now: Instant, fault: &Fault, blocked: bool) {
        let names: Vec<&str> = self.robots.iter().map(|robot| robot.name.as_str()).collect();
        for (from, to) in fault.severed(&names) {
            self.network.block(from, to, blocked);
        }
        self.update_hearing(now);
    }

    /// Robots of a swarm, and after them those that will be somebody's twin.
    pub(super) fn with_twins(robots: &mut Vec<Robot<C>>, scenario: &crate::scenario::Scenario) {
        for (index, fault) in scenario.faults.iter().enumerate() {
            let Fault::Twin { robot: of, .. } = fault else { continue };
            let Some(original) = robots.iter().find(|robot| robot.name.as_str() == of && robot.twin.is_none()) else {
                continue;
            };
            let mut twin = Robot::new(original.identity.clone(), original.id, original.slam.clone(), scenario);
            (twin.twin, twin.gone) = (Some(index), true);
            robots.push(twin);
        }
    }

    /// A message from nobody, and the next one.
    pub(super) fn flood(&mut self, now: Instant, index: usize) {
        let Some(Fault::Flood { at, lasts, robot, per_sec }) = self.scenario.faults.get(index).cloned() else { return };
        let Some(robot) = self.find(&robot) else { return };
        const TICK_SECS: f64 = 0.1;
        let mut dice = Dice::new(self.seed, &format!("flood {index} {}", now.as_nanos()));
        for _ in 0..(per_sec * TICK_SECS) as u64 {
            self.counts.floods += 1;
            let input = super::hostile::from_nobody(&mut dice);
            self.feed(now, robot, input);
        }
        if now < secs(at + lasts) {
            self.queue.push(now.after(millis(1e3 * TICK_SECS)), Event::Flood(index));
        }
    }
}
