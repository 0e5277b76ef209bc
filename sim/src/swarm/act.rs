//! The shell's part of a robot: events become inputs, outputs become events.

use super::robot::{Asked, job_nanos};
use super::{Event, OUTPUTS_MAX, Swarm, TOLD_MAX};
use crate::check::Seen;
use crate::core::Core;
use crate::network::millis;
use merganser_protocol::agent::io::{AskToken, Channel, Command, Input, Output, QueryKind};
use merganser_protocol::time::Instant;

/// A timeout is never nearer than this, so that virtual time moves even under a core that is always due.
const WAKE_NANOS_MIN: u64 = 1_000;

impl<C: Core> Swarm<C> {
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
                    self.feed(now, to, Input::Answered { query, bytes });
                }
            }
            Event::Durable { robot, incarnation, batch } if self.runs(robot, incarnation) => {
                self.robots[robot].store.commit(batch);
                self.see(robot, &Seen::Durable(batch));
                self.feed(now, robot, Input::Persisted { up_to: batch });
            }
            Event::DiskRefuses { robot, incarnation, batch } if self.runs(robot, incarnation) => {
                self.counts.disk_refused += 1;
                self.feed(now, robot, Input::PersistFailed { batch, reason: "no space left on device".to_owned() });
            }
            Event::JobDone { robot, incarnation, id, job } if self.runs(robot, incarnation) => {
                let result = self.stopwatch.time(job.kind(), || job.run());
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
                let hearing = &mut self.robots[observer].hears[subject];
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

    fn keyframe(&mut self, now: Instant, robot: usize, index: usize) {
        let step = &self.stage.steps(robot)[index];
        let one = &mut self.robots[robot];
        if one.core.is_none() {
            one.slam.skip(step);
            self.counts.keyframes_missed += 1;
            return;
        }
        let points = self.stopwatch.time("scan", || self.stage.scan(robot, index));
        let keyframe = match one.slam.keyframe(step, points) {
            Ok(keyframe) => keyframe,
            Err(error) => return self.object("stage", error.to_string()),
        };
        one.keyframes += 1;
        let t_world_frame = step.t_world_body * keyframe.pose.pose.inverse();
        self.feed(now, robot, Input::Keyframe(keyframe));
        // Where the frame of a new epoch lies, until its first submap says it exactly.
        let one = &self.robots[robot];
        if let Some(core) = &one.core {
            self.truth.entry(format!("{}/{}", one.name, core.frame().epoch)).or_insert(t_world_frame);
        }
    }

    /// Hands one input to a robot's core and acts on what comes out.
    pub(super) fn feed(&mut self, now: Instant, robot: usize, input: Input) {
        let one = &mut self.robots[robot];
        let local = one.local(now);
        let Some(core) = one.core.as_mut() else {
            self.counts.to_the_dead += 1;
            return;
        };
        self.trace.input(now, robot, &input);
        self.stopwatch.time("handle", || core.handle(local, input));
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
                let at = now.after(millis(self.scenario.machine.persist_ms));
                if self.robots[robot].disk_full {
                    self.queue.push(at, Event::DiskRefuses { robot, incarnation, batch });
                } else {
                    self.robots[robot].store.accept(batch, records);
                    self.queue.push(at, Event::Durable { robot, incarnation, batch });
                }
            }
            Output::Publish { channel, bytes } => {
                self.robots[robot].count(channel_name(channel), bytes.len());
                for to in (0..self.robots.len()).filter(|&to| to != robot) {
                    for at in self.network.send(now, robot, to, bytes.len(), &mut self.counts) {
                        self.queue.push(at, Event::Broadcast { from: robot, to, channel, bytes: bytes.clone() });
                    }
                }
            }
            Output::Ask { query, peer, kind, bytes } => {
                let one = &mut self.robots[robot];
                one.count(ask_name(kind), bytes.len());
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
                let deadline = now.after(millis(self.network.options().answer_ms_max));
                self.queue.push(deadline, Event::Answer { to: robot, incarnation, query, bytes: None });
            }
            Output::Answer { token, bytes } => {
                // One that nobody asked for is the contract check's business.
                let Some(asked) = self.robots[robot].asked.remove(&token.0) else { return };
                self.robots[robot].count(asked.kind, bytes.len());
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
                let nanos = job_nanos(job.kind(), &self.scenario.machine);
                let at = self.robots[robot].work(now, nanos);
                self.queue.push(at, Event::JobDone { robot, incarnation, id, job: Box::new(job) });
            }
            Output::Event(event) => {
                if self.told.len() < TOLD_MAX {
                    self.told.push((now.as_secs_f64(), robot, event));
                }
            }
        }
    }
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
    }
}

fn answer_name(kind: QueryKind) -> &'static str {
    match kind {
        QueryKind::Sync => "sync answer",
        QueryKind::Blob => "blob answer",
        QueryKind::Align => "align answer",
    }
}
