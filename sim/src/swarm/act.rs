//! The shell's part of a robot: events become inputs, outputs become events.

use super::alignment_oracle;
use super::robot::{Asked, job_nanos};
use super::store::Committed;
use super::{Event, OUTPUTS_MAX, Swarm, TOLD_MAX, Told, hostile};
use crate::check::Seen;
use crate::core::Restartable;
use crate::network::{Tampering, millis};
use crate::world::drive::Step;
use merganser_protocol::agent::io::{AskToken, Channel, Command, Input, Output, QueryKind};
use merganser_protocol::agent::job::{Job, JobResult};
use merganser_protocol::geometry::Se3;
use merganser_protocol::submap::{Keyframe, Submap};
use merganser_protocol::time::Instant;

/// A timeout is never nearer than this, so that virtual time moves even under a core that is always due.
const WAKE_NANOS_MIN: u64 = 1_000;

impl<C: Restartable> Swarm<C> {
    fn publish(&mut self, now: Instant, robot: usize, channel: Channel, bytes: Vec<u8>) {
        let bytes = self.in_its_version(robot, bytes);
        self.robots[robot].count(now, channel_name(channel), bytes.len());
        let one = &self.robots[robot];
        let tells_two = one.equivocates && channel == Channel::Facts;
        let other = tells_two.then(|| hostile::second_story(&bytes, &one.identity.secret_key)).flatten();
        self.counts.equivocations += u64::from(other.is_some());
        for to in self.network.in_reach(robot) {
            let bytes = other.as_ref().filter(|_| to % 2 == 1).unwrap_or(&bytes);
            for at in self.network.send(now, robot, to, bytes.len(), &mut self.counts) {
                self.queue.push(at, Event::Broadcast { from: robot, to, channel, bytes: bytes.clone() });
            }
            if let Some((at, bytes)) = self.tamper(now, robot, to, bytes) {
                self.queue.push(at, Event::Broadcast { from: robot, to, channel, bytes });
            }
        }
    }

    /// What else of this message arrives, and when.
    fn tamper(&mut self, now: Instant, from: usize, to: usize, bytes: &[u8]) -> Option<(Instant, Vec<u8>)> {
        match self.network.tamper(now, from, to)? {
            Tampering::Mangled(at, how) => {
                self.counts.mangled += 1;
                Some((at, hostile::mangle(bytes, how)))
            }
            Tampering::Replayed(at) => {
                self.counts.replayed += 1;
                Some((at, bytes.to_vec()))
            }
        }
    }

    fn in_its_version(&mut self, robot: usize, bytes: Vec<u8>) -> Vec<u8> {
        if !self.robots[robot].other_version {
            return bytes;
        }
        self.counts.other_versions += 1;
        hostile::of_next_version(bytes)
    }

    /// Turns an event into the input it is.
    pub(super) fn deliver(&mut self, now: Instant, event: Event) {
        match event {
            Event::Keyframe { robot, index } => self.keyframe(now, robot, index),
            Event::DriveEnds { robot } => self.feed(now, robot, Input::Command(Command::Flush)),
            Event::Broadcast { from, to, channel, bytes } => {
                let from = self.robots[from].id;
                self.feed(now, to, Input::Received { from, channel, bytes });
            }
            Event::Ask { from, from_incarnation, to, query, kind, bytes } => {
                let robot = &mut self.robots[to];
                if robot.core.is_none() {
                    self.counts.to_the_dead += 1;
                    return;
                }
                robot.tokens += 1;
                let token = robot.tokens;
                let asked = Asked { from, incarnation: from_incarnation, query, kind: answer_name(kind) };
                robot.asked.insert(token, asked);
                self.see(to, &Seen::Asked(token));
                self.feed(now, to, Input::Asked { token: AskToken(token), kind, bytes });
            }
            Event::Answer { to, incarnation, query, bytes } => {
                let robot = &mut self.robots[to];
                // The first answer or the deadline counts; what comes after is late.
                if robot.incarnation == incarnation && robot.questions.remove(&query) {
                    self.counts.unanswered += u64::from(bytes.is_none());
                    if bytes.is_some() {
                        self.feed(now, to, Input::Answered { query, bytes });
                    }
                    self.feed(now, to, Input::Answered { query, bytes: None });
                }
            }
            Event::Commit { robot, incarnation } if self.runs(robot, incarnation) => self.commit(now, robot),
            Event::CutNow { robot, incarnation } if self.runs(robot, incarnation) => self.cut(now, robot),
            Event::JobDone { robot, incarnation, id, job } if self.runs(robot, incarnation) => {
                let result = self.work(robot, *job);
                self.feed(now, robot, Input::JobDone { job: id, result });
            }
            Event::Wake { robot, incarnation, at }
                if self.runs(robot, incarnation) && self.robots[robot].wake == Some(at) =>
            {
                self.robots[robot].wake = None;
                self.feed(now, robot, Input::Timeout);
            }
            Event::Hear { observer, subject, version } => {
                let id = self.robots[subject].id;
                let hearing = self.robots[observer].hears.entry(subject).or_default();
                if hearing.version == version && hearing.told != hearing.so {
                    hearing.told = hearing.so;
                    let up = hearing.so;
                    self.feed(now, observer, Input::Neighbour { robot: id, up });
                }
            }
            _ => {}
        }
    }

    fn runs(&self, robot: usize, incarnation: u32) -> bool {
        self.robots[robot].core.is_some() && self.robots[robot].incarnation == incarnation
    }

    fn commit(&mut self, now: Instant, robot: usize) {
        let store = &mut self.robots[robot].store;
        store.busy = false;
        match self.stopwatch.time("commit", || store.commit()) {
            Committed::Nothing => {}
            Committed::Durable(up_to, healed) => {
                self.counts.disk_healed += u64::from(healed);
                self.see(robot, &Seen::Durable(up_to));
                self.robots[robot].is_durable(up_to);
                self.feed(now, robot, Input::Persisted { up_to });
            }
            Committed::Refused(batch, reason, news, pause) => {
                self.counts.disk_refused += 1;
                self.robots[robot].store.busy = true;
                let incarnation = self.robots[robot].incarnation;
                self.queue.push(now.after(pause), Event::Commit { robot, incarnation });
                if news {
                    self.feed(now, robot, Input::PersistFailed { batch, reason });
                }
            }
            Committed::Conflict(what) => self.object("unique entries", format!("robot {robot}: {what}")),
            Committed::PowerGone => {
                self.counts.cut_in_commit += 1;
                self.cut(now, robot);
            }
        }
    }

    /// Does heavy work, or what stands for it.
    fn work(&mut self, robot: usize, job: Job) -> JobResult {
        let drive = self.drives(robot);
        let Some(stand_in) = &mut self.oracle else {
            return self.stopwatch.time(job.kind(), || job.run());
        };
        let (one, steps) = (&self.robots[robot], self.stage.steps(drive));
        let locate = |submap: &Submap| {
            // Among the submap's own keyframes: near their origins, two frames of one robot know the same poses.
            let [a, b] = submap.stamps.map(|stamp| one.slam.drive_nanos(stamp.as_secs_f64()));
            let span = a.min(b)..=a.max(b);
            let own: Vec<&Step> = steps.iter().filter(|step| span.contains(&step.nanos)).collect();
            let by_keyframe = |t_anchor_body: &Se3| {
                let there = (submap.t_frame_anchor * *t_anchor_body).translation;
                let apart = |step: &&&Step| (one.slam.t_frame_body(step).translation - there).norm();
                let step = own.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)))?;
                Some(step.t_world_body * t_anchor_body.inverse())
            };
            alignment_oracle::middle(&submap.keyframes.iter().filter_map(by_keyframe).collect::<Vec<_>>())
        };
        let kind = job.kind();
        let (result, lied) = self.stopwatch.time(kind, || stand_in.run(one.name.as_str(), job, locate));
        self.counts.lies += u64::from(lied);
        result
    }

    /// Whose drive a robot is on: its own, or that of the robot it is the twin of.
    pub(super) fn drives(&self, robot: usize) -> usize {
        self.ids.get(&self.robots[robot].id).copied().unwrap_or(robot)
    }

    /// A robot's SLAM finished a keyframe, and so does that of its twin.
    fn keyframe(&mut self, now: Instant, robot: usize, index: usize) {
        self.keyframe_of(now, robot, robot, index);
        for twin in self.stage.names().len()..self.robots.len() {
            if self.robots[twin].core.is_some() && self.drives(twin) == robot {
                self.keyframe_of(now, twin, robot, index);
            }
        }
    }

    fn keyframe_of(&mut self, now: Instant, robot: usize, drive: usize, index: usize) {
        let step = &self.stage.steps(drive)[index];
        let one = &mut self.robots[robot];
        if one.core.is_none() {
            one.slam.skip(step);
            self.counts.keyframes_missed += 1;
            return;
        }
        let seen = self.stopwatch.time("scan", || self.stage.scan(drive, index));
        let keyframe = match seen.and_then(|seen| one.slam.keyframe(step, seen)) {
            Ok(keyframe) => {
                let (place, up) = (self.stage.place(drive, index), self.stage.up(drive, index));
                Keyframe { place, up, ..keyframe }
            }
            Err(error) => return self.object("stage", error.to_string()),
        };
        one.keyframes += 1;
        let t_world_frame = one.slam.t_world_frame(step, self.stage.unit_m(drive));
        self.feed(now, robot, Input::Keyframe(keyframe));
        // Where the frame of a new epoch lies, until its first submap says it exactly.
        let one = &self.robots[robot];
        if let Some(core) = &one.core {
            self.truth.entry(format!("{}/{}", one.name, core.frame().epoch)).or_insert(t_world_frame);
        }
    }

    /// Hands one input to a robot's core and acts on what comes out.
    pub(super) fn feed(&mut self, now: Instant, robot: usize, input: Input) {
        if self.robots[robot].core.is_none() {
            self.counts.to_the_dead += 1;
            return;
        }
        self.trace.input(now, robot, &input);
        self.see(robot, &Seen::Heard(message(&input)));
        let one = &mut self.robots[robot];
        let local = one.local(now);
        if let Some(core) = one.core.as_mut() {
            self.stopwatch.time("handle", || core.handle(local, input));
        }
        self.drain(now, robot);
    }

    /// Drains the outputs and sets the alarm.
    pub(super) fn drain(&mut self, now: Instant, robot: usize) {
        let Some(core) = self.robots[robot].core.as_mut() else { return };
        let outputs: Vec<Output> = core::iter::from_fn(|| core.poll_output()).take(OUTPUTS_MAX + 1).collect();
        if outputs.len() > OUTPUTS_MAX {
            return self.object("no endless loop", format!("robot {robot}: more than {OUTPUTS_MAX} outputs in a row"));
        }
        let timeout = core.poll_timeout();
        for output in outputs {
            self.trace.output(now, robot, &output);
            self.see(robot, &Seen::Output(&output));
            self.act(now, robot, output);
        }
        let one = &mut self.robots[robot];
        let at = timeout.map(|local| one.global(local).max(Instant::from_nanos(now.as_nanos() + WAKE_NANOS_MIN)));
        if at != one.wake {
            one.wake = at;
            let incarnation = one.incarnation;
            if let Some(at) = at.filter(|&at| at < Instant::MAX) {
                self.queue.push(at, Event::Wake { robot, incarnation, at });
            }
        }
    }

    fn act(&mut self, now: Instant, robot: usize, output: Output) {
        let incarnation = self.robots[robot].incarnation;
        match output {
            Output::Persist { batch, records } => {
                let writes = self.robots[robot].core.as_ref().map(|core| core.frame().epoch);
                self.robots[robot].hands_over(writes, batch, &records);
                let store = &mut self.robots[robot].store;
                store.accept(batch, records);
                // What comes while a commit is on its way shares it.
                if !core::mem::replace(&mut store.busy, true) {
                    let at = now.after(millis(self.scenario.machine.persist_ms));
                    self.queue.push(at, Event::Commit { robot, incarnation });
                }
            }
            Output::Publish { channel, bytes } => self.publish(now, robot, channel, bytes),
            Output::Ask { query, peer, kind, bytes } => {
                let bytes = self.in_its_version(robot, bytes);
                let one = &mut self.robots[robot];
                one.count(now, ask_name(kind), bytes.len());
                one.questions.insert(query);
                let Some(&to) = self.ids.get(&peer).filter(|&&to| to != robot) else {
                    self.queue.push(now, Event::Answer { to: robot, incarnation, query, bytes: None });
                    return;
                };
                for at in self.network.send(now, robot, to, bytes.len(), &mut self.counts) {
                    let bytes = bytes.clone();
                    self.queue
                        .push(at, Event::Ask { from: robot, from_incarnation: incarnation, to, query, kind, bytes });
                }
                if let Some((at, bytes)) = self.tamper(now, robot, to, &bytes) {
                    self.queue
                        .push(at, Event::Ask { from: robot, from_incarnation: incarnation, to, query, kind, bytes });
                }
                let deadline = now.after(millis(self.network.options().answer_ms_max));
                self.queue.push(deadline, Event::Answer { to: robot, incarnation, query, bytes: None });
            }
            Output::Answer { token, bytes } => {
                // One that nobody asked for is the contract check's business.
                let Some(asked) = self.robots[robot].asked.remove(&token.0) else { return };
                let bytes = self.in_its_version(robot, bytes);
                self.robots[robot].count(now, asked.kind, bytes.len());
                // The first to come counts: a mangled one may be it.
                if let Some((at, bytes)) = self.tamper(now, robot, asked.from, &bytes) {
                    let (to, incarnation, query) = (asked.from, asked.incarnation, asked.query);
                    self.queue.push(at, Event::Answer { to, incarnation, query, bytes: Some(bytes) });
                }
                for at in self.network.send(now, robot, asked.from, bytes.len(), &mut self.counts) {
                    let answer = Event::Answer {
                        to: asked.from,
                        incarnation: asked.incarnation,
                        query: asked.query,
                        bytes: Some(bytes.clone()),
                    };
                    self.queue.push(at, answer);
                }
            }
            Output::Run { id, job } => {
                let nanos = job_nanos(job.kind(), job.size(), &self.scenario.machine);
                let at = self.robots[robot].work(now, nanos);
                self.queue.push(at, Event::JobDone { robot, incarnation, id, job: Box::new(job) });
            }
            Output::Event(event) => {
                self.counts.epochs_begun += u64::from(matches!(event, Told::EpochBegan { .. }));
                self.counts.condensed += u64::from(matches!(event, Told::Condensed { .. }));
                self.counts.forks += u64::from(is_fork(&event));
                if self.told.len() < TOLD_MAX {
                    self.told.push((now.as_secs_f64(), robot, event));
                }
            }
        }
    }
}

/// A robot learned that a log has two histories.
fn is_fork(event: &Told) -> bool {
    matches!(event, Told::Rejected { reason, .. } if reason.contains("two histories"))
}

fn channel_name(channel: Channel) -> &'static str {
    match channel {
        Channel::Pose => "pose",
        Channel::Facts => "facts",
        Channel::Have => "have",
    }
}

fn ask_name(kind: QueryKind) -> &'static str {
    match kind {
        QueryKind::Sync => "sync",
        QueryKind::Blob => "blob",
        QueryKind::Align => "align",
        QueryKind::Life => "life",
    }
}

fn answer_name(kind: QueryKind) -> &'static str {
    match kind {
        QueryKind::Sync => "sync answer",
        QueryKind::Blob => "blob answer",
        QueryKind::Align => "align answer",
        QueryKind::Life => "life answer",
    }
}

/// The bytes of an input that is a message.
fn message(input: &Input) -> &[u8] {
    match input {
        Input::Received { bytes, .. } | Input::Asked { bytes, .. } | Input::Answered { bytes: Some(bytes), .. } => {
            bytes
        }
        _ => &[],
    }
}
