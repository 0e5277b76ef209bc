//! Bytes as a story: who does what to which of two agents, and when. Messages of the agents are delivered, lost,
//! replayed, damaged and brought to the wrong door; the liar and the thief add their own; disks, clocks, jobs and
//! sensors fail in every order. Whatever happens, the agents do not panic and keep the contract ([`super::checks`]).

use super::Meter;
use super::checks::{Asked, Shell};
use super::forge::{self, Forge};
use super::people::{AGENTS, ROBOTS, SCAN, agent, name, robot, scan};
use super::reader::Reader;
use merganser_protocol::agent::io::{
    AskToken, Channel, Command, Input, JobId, PositionSighting, QueryId, QueryKind, Record, Sighting,
};
use merganser_protocol::agent::job::{JobResult, Measured, NotAligned};
use merganser_protocol::agent::{Agent, Restored};
use merganser_protocol::ids::RobotId;
use merganser_protocol::submap::place::Metric;
use merganser_protocol::submap::{CovarianceOf, Keyframe, PlaceDescriptor};
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::Message;
use merganser_protocol::wire::fact::RefusalReason;

/// Deeds in one story at most.
const DEEDS_MAX: usize = 96;
/// Heavy jobs run in one story at most; later ones never come back.
const RUNS_MAX: usize = 24;
/// Times that all goes well for a while, in one story at most.
const LIVES_MAX: usize = 12;
/// Messages remembered for replay.
const AIR_MAX: usize = 48;
/// Messages that are fresh enough to arrive by themselves.
const FRESH: usize = 8;
/// Later than this a clock stands still for an agent.
const END_OF_TIME: u64 = u64::MAX / 2;

/// Tells the story that `bytes` stand for. Panics if an agent breaks a promise.
pub fn handle(bytes: &[u8], meter: &impl Meter) {
    let mut story = Story::new(meter);
    let mut r = Reader::new(bytes);
    for _ in 0..DEEDS_MAX {
        if r.is_empty() {
            break;
        }
        story.deed(&mut r);
    }
    for agent in &story.agents {
        serde_json::to_string(&agent.snapshot(Instant::from_nanos(story.now))).unwrap();
    }
}

struct Story<'m, M: Meter> {
    meter: &'m M,
    agents: [Agent; AGENTS],
    shells: [Shell; AGENTS],
    forge: Forge,
    now: u64,
    token: u64,
    stamp: i64,
    runs: usize,
    lives: usize,
    air: Vec<(RobotId, Channel, Vec<u8>)>,
    results: Vec<(JobId, JobResult)>,
}

impl<'m, M: Meter> Story<'m, M> {
    fn new(meter: &'m M) -> Self {
        let restored = || Restored { records: Vec::new(), fresh_epoch: 1 };
        let agents = core::array::from_fn(|k| agent(k, restored(), Instant::ZERO));
        let forge = Forge::new(core::array::from_fn(|k: usize| agents[k].frame()));
        let shells = core::array::from_fn(|_| Shell::default());
        let (air, results) = (Vec::new(), Vec::new());
        Self { meter, agents, shells, forge, now: 0, token: 0, stamp: 0, runs: 0, lives: 0, air, results }
    }

    fn deed(&mut self, r: &mut Reader) {
        let deed = r.byte();
        let k = usize::from(deed >> 7);
        match deed & 31 {
            0 => self.pass_time(k, r),
            1 => {
                let (who, up) = (r.below(2 * ROBOTS), r.byte() < 192);
                let input = Input::Neighbour { robot: robot(who % ROBOTS), up };
                self.give(k, input);
            }
            2..=4 => self.hear_again(k, r),
            5..=9 => self.hear_forged(k, r),
            10 => self.hear_noise(k, r),
            11..=13 => self.answer_question(k, r),
            14 => self.answer_wrongly(k, r),
            15 | 16 => self.ask(k, r),
            17 | 18 => self.persisted(k, r),
            19 => self.give(k, Input::PersistFailed { batch: r.u64(), reason: "no space left on device".into() }),
            20 | 21 => self.finish_job(k, r),
            22..=24 => self.keyframe(k, r),
            25 => self.sighting(k, r),
            26 => self.give(k, Input::Command(if r.one_in(4) { Command::NewEpoch } else { Command::Flush })),
            27 => self.restart(k, r),
            28 => self.steal_time(k),
            _ => self.live(r.below(4)),
        }
    }

    /// Gives one agent one input and holds it to the contract.
    fn give(&mut self, k: usize, input: Input) {
        let _ = self.give_question(k, None, input);
    }

    fn give_question(&mut self, k: usize, token: Option<AskToken>, input: Input) -> Option<Vec<u8>> {
        match &input {
            Input::Persisted { up_to } => self.shells[k].persisted(*up_to),
            Input::JobDone { job, result } => self.shells[k].job_done(*job, result),
            _ => {}
        }
        self.meter.begin();
        self.agents[k].handle(Instant::from_nanos(self.now), input);
        self.meter.end("an input");
        let answer = self.shells[k].drain(&mut self.agents[k], &self.forge, token);
        self.forge.frames[k] = self.agents[k].frame();
        for (channel, bytes) in self.shells[k].published.drain(..) {
            self.air.push((robot(k), channel, bytes));
        }
        let old = self.air.len().saturating_sub(AIR_MAX);
        self.air.drain(..old);
        answer
    }

    /// The clock of the process goes on, jumps, or goes back.
    fn pass_time(&mut self, k: usize, r: &mut Reader) {
        let wanted = self.agents[k].poll_timeout().map_or(self.now, Instant::as_nanos);
        self.now = match r.byte() {
            0..=99 => wanted,
            100..=199 => self.now.saturating_add(u64::from(r.byte()) * 20_000_000),
            200..=229 => self.now.saturating_sub(u64::from(r.byte()) * 1_000_000_000),
            230..=247 => self.now.saturating_add(1 << r.below(50)),
            248..=251 => u64::MAX - u64::from(r.byte()) * 100_000_000,
            _ => r.u64(),
        };
        self.give(k, Input::Timeout);
    }

    /// A timeout that was served moves on: nobody wakes for ever at one moment.
    fn steal_time(&mut self, k: usize) {
        for _ in 0..16 {
            let wanted = self.agents[k].poll_timeout().map_or(u64::MAX, Instant::as_nanos);
            if wanted > self.now {
                return;
            }
            self.give(k, Input::Timeout);
        }
        let latest = self.now; // An agent's clock never goes back; only one that is later than ours may wait for it.
        let wanted = self.agents[k].poll_timeout().map_or(u64::MAX, Instant::as_nanos);
        assert!(wanted > latest || latest > END_OF_TIME, "agent {k} wants {wanted} again and again at {latest}");
    }

    /// Something that was once on the air: for whom it may be, in whose name and on which channel it likes.
    fn hear_again(&mut self, k: usize, r: &mut Reader) {
        let Some((from, channel, bytes)) = r.choose(&self.air).cloned() else { return };
        let (from, channel) = (if r.one_in(16) { robot(3) } else { from }, any_channel(r, channel));
        let bytes = r.mangled(bytes);
        self.give(k, Input::Received { from, channel, bytes });
    }

    fn hear_forged(&mut self, k: usize, r: &mut Reader) {
        let (channel, message) = match r.byte() {
            0..=199 => {
                let entries = (0..=r.below(3)).map(|_| r_entry(&mut self.forge, r));
                (
                    Channel::Facts,
                    Message::facts(entries.collect::<Vec<_>>()).pop().unwrap_or(Message::Facts(Vec::new())),
                )
            }
            200..=229 => (Channel::Pose, self.forge.beacon(r)),
            _ => (Channel::Have, Forge::root(r)),
        };
        let bytes = r.mangled(message.encode());
        if self.air.len() < AIR_MAX {
            self.air.push((robot(2), channel, bytes.clone()));
        }
        let from = robot(r.pick(&[2, 2, 2, 0, 1, 3]));
        self.give(k, Input::Received { from, channel, bytes });
    }

    fn hear_noise(&mut self, k: usize, r: &mut Reader) {
        let (head, len) = (r.byte(), r.below(200));
        let mut bytes = if head < 200 { vec![b'm', b'g', 1, head % 11] } else { Vec::new() };
        bytes.extend_from_slice(r.bytes(len));
        let from = robot(r.below(ROBOTS));
        match head % 4 {
            0 => self.give(k, Input::Received { from, channel: any_channel(r, Channel::Facts), bytes }),
            _ => self.put(k, any_kind(r, QueryKind::Sync), bytes),
        }
    }

    /// A question of the agent's is carried to whom it asks; the answer comes whole, damaged, late or never, alone or
    /// behind a forged one.
    fn answer_question(&mut self, k: usize, r: &mut Reader) {
        let count = self.shells[k].asked.len();
        let Some(place) = (count > 0).then(|| r.below(256) % count) else { return };
        let Asked { query, peer, kind, bytes } = self.shells[k].asked.swap_remove(place);
        let other = 1 - k;
        let answer = if peer == robot(other) {
            let question = r.mangled(bytes.clone());
            let answer = self.put_question(other, kind, question);
            Some(r.mangled(answer))
        } else {
            Some(self.forge.answer(r, kind, &bytes))
        };
        let question = bytes;
        let bytes = answer.filter(|_| !r.one_in(16));
        if r.one_in(4) {
            let forged = self.forge.answer(r, kind, &question);
            self.give(k, Input::Answered { query, bytes: Some(forged) });
        }
        self.give(k, Input::Answered { query, bytes: bytes.clone() });
        if r.one_in(8) {
            self.give(k, Input::Answered { query, bytes });
        }
        if !r.one_in(16) {
            self.give(k, Input::Answered { query, bytes: None });
        }
    }

    /// An answer under a number that may be nobody's, or to another question.
    fn answer_wrongly(&mut self, k: usize, r: &mut Reader) {
        let query = match r.choose(&self.shells[k].asked) {
            Some(asked) if r.one_in(2) => asked.query,
            _ => QueryId(r.u64()),
        };
        let kind = any_kind(r, QueryKind::Sync);
        let question = self.forge.question(r).1.encode();
        let bytes = self.forge.answer(r, kind, &question);
        self.shells[k].asked.retain(|asked| asked.query != query);
        self.give(k, Input::Answered { query, bytes: Some(bytes) });
    }

    fn ask(&mut self, k: usize, r: &mut Reader) {
        let (kind, question) = self.forge.question(r);
        let (kind, bytes) = (any_kind(r, kind), r.mangled(question.encode()));
        self.put(k, kind, bytes);
    }

    fn put(&mut self, k: usize, kind: QueryKind, bytes: Vec<u8>) {
        let _ = self.put_question(k, kind, bytes);
    }

    fn put_question(&mut self, k: usize, kind: QueryKind, bytes: Vec<u8>) -> Vec<u8> {
        // Shells count as they like.
        self.token = self.token.wrapping_mul(3).wrapping_add(1);
        let token = AskToken(self.token);
        self.give_question(k, Some(token), Input::Asked { token, kind, bytes }).unwrap()
    }

    /// The store confirms all, one, what it confirmed before, or what it was never given.
    fn persisted(&mut self, k: usize, r: &mut Reader) {
        let shell = &self.shells[k];
        let up_to = match r.byte() {
            0..=159 => shell.last_batch(),
            160..=199 => shell.first_waiting(),
            200..=229 => shell.first_waiting().saturating_sub(1),
            230..=239 => u64::MAX,
            _ => r.u64(),
        };
        self.give(k, Input::Persisted { up_to });
    }

    /// A job comes back: with its result, with another's, or with what nobody computed; once, twice, under any number.
    fn finish_job(&mut self, k: usize, r: &mut Reader) {
        let (way, place) = (r.byte(), r.below(256));
        let result = match (way, self.shells[k].jobs.get(place % self.shells[k].jobs.len().max(1)).cloned()) {
            (0..=191, Some((id, job))) if self.runs < RUNS_MAX => {
                self.runs += 1;
                (id, job.run())
            }
            (192..=215, job) => {
                let Some((_, old)) = r.choose(&self.results).cloned() else { return };
                (job.map_or(JobId(r.u64()), |(id, _)| id), old)
            }
            (216..=235, job) => {
                let why = NotAligned { reason: RefusalReason::Ambiguous, elsewhere: r.one_in(2) };
                (job.map_or(JobId(1), |(id, _)| id), JobResult::Aligned(Err(why)))
            }
            (236.., job) => {
                let [sigma, support, log10_nfa] = r.numbers();
                let measured = Measured { t_mine_theirs: forge::relative(r), sigma, support, log10_nfa };
                (job.map_or(JobId(1), |(id, _)| id), JobResult::Aligned(Ok(Box::new(measured))))
            }
            _ => return,
        };
        self.results.push(result.clone());
        self.give(k, Input::JobDone { job: result.0, result: result.1 });
    }

    fn keyframe(&mut self, k: usize, r: &mut Reader) {
        let look = r.byte();
        self.stamp = match look {
            0..=239 => self.stamp.saturating_add(1_000_000_000),
            _ => r.u64() as i64,
        };
        let mut points = scan(look % 4, if look < 200 { SCAN } else { usize::from(255 - look) });
        if look % 16 == 15 {
            points.push(r.numbers::<3>().map(|x| x as f32));
        }
        let place = (look % 8 == 3).then(|| {
            let metric = if r.byte() < 250 { Metric::Cosine } else { Metric::Euclidean };
            PlaceDescriptor::new("", metric, r.numbers::<5>().map(|x| x as f32).to_vec()).ok()
        });
        let covariance_of = if look % 32 == 1 { CovarianceOf::Pose } else { CovarianceOf::Motion };
        let keyframe = Keyframe {
            stamp: Stamp(self.stamp),
            session: None,
            pose: forge::pose(r),
            covariance_of,
            points,
            marks: Vec::new(),
            place: place.flatten(),
            up: None,
        };
        self.give(k, Input::Keyframe(keyframe));
    }

    fn sighting(&mut self, k: usize, r: &mut Reader) {
        let mut covariance = [0.0; 21];
        for diagonal in [0, 6, 11, 15, 18, 20] {
            covariance[diagonal] = 0.01;
        }
        let plain = r.byte() < 128;
        if r.one_in(2) {
            let robot = name(r.below(ROBOTS));
            let (position, covariance) =
                if plain { ([1.0, 2.0, 0.0], [0.01, 0.0, 0.0, 0.01, 0.0, 0.01]) } else { (r.numbers(), r.numbers()) };
            let sighting = PositionSighting { stamp: Stamp(self.stamp), robot, position, covariance };
            return self.give(k, Input::Position(sighting));
        }
        let sighting = Sighting {
            stamp: Stamp(self.stamp),
            robot: name(r.below(ROBOTS)),
            t_body_other: if plain { [1.0, 2.0, 0.0, 0.0, 0.0, 0.6, 0.8] } else { r.numbers() },
            covariance: if plain { covariance } else { r.numbers() },
        };
        self.give(k, Input::Sighting(sighting));
    }

    /// The process is killed and starts again from its disk, of which a byte may have turned.
    fn restart(&mut self, k: usize, r: &mut Reader) {
        self.shells[k].killed();
        let mut records = self.shells[k].disk.clone();
        if let (true, Some(record)) = (r.one_in(2), r.choose(&self.shells[k].disk)) {
            let mut damaged = record.clone();
            match &mut damaged {
                Record::Entry { bytes, .. } | Record::Blob { bytes, .. } | Record::Private { bytes, .. } => {
                    *bytes = r.mangled(core::mem::take(bytes));
                }
                Record::Fork { proof, .. } => proof.swap(0, 1),
                Record::Session { session, over, .. } => over.push(core::mem::replace(session, u64::from(r.byte()))),
                Record::Refused { i, j, .. } if r.one_in(2) => core::mem::swap(i, j),
                Record::Refused { evidence, .. } => *evidence = evidence.map(|evidence| evidence ^ 1),
                Record::EpochClosed { .. } | Record::Replaced { .. } | Record::Retired { .. } => {}
            }
            records.iter_mut().filter(|other| *other == record).for_each(|other| other.clone_from(&damaged));
        }
        let epoch = self.agents[k].frame().epoch;
        let restored = Restored { records, fresh_epoch: epoch.saturating_add(1) };
        self.meter.begin();
        self.agents[k] = agent(k, restored, Instant::from_nanos(self.now));
        self.meter.end("a start");
        let _ = self.shells[k].drain(&mut self.agents[k], &self.forge, None);
        self.forge.frames[k] = self.agents[k].frame();
    }

    /// For a while all goes well between the two agents.
    fn live(&mut self, rounds: usize) {
        if self.lives == LIVES_MAX {
            return;
        }
        self.lives += 1;
        for k in 0..AGENTS {
            self.give(k, Input::Neighbour { robot: robot(1 - k), up: true });
        }
        for _ in 0..=rounds {
            self.now = self.now.saturating_add(300_000_000);
            for k in 0..AGENTS {
                self.give(k, Input::Timeout);
                self.give(k, Input::Persisted { up_to: self.shells[k].last_batch() });
                while self.runs < RUNS_MAX
                    && let Some((job, work)) = self.shells[k].jobs.first().cloned()
                {
                    self.runs += 1;
                    self.give(k, Input::JobDone { job, result: work.run() });
                }
                for Asked { query, peer, kind, bytes } in core::mem::take(&mut self.shells[k].asked) {
                    if peer == robot(1 - k) {
                        let bytes = Some(self.put_question(1 - k, kind, bytes));
                        self.give(k, Input::Answered { query, bytes });
                    }
                    self.give(k, Input::Answered { query, bytes: None });
                }
                let old = self.air.len().saturating_sub(FRESH);
                let fresh: Vec<_> = self.air.iter().skip(old).cloned().collect();
                for (from, channel, bytes) in fresh {
                    if from == robot(1 - k) {
                        self.give(k, Input::Received { from, channel, bytes });
                    }
                }
            }
        }
    }
}

fn r_entry(forge: &mut Forge, r: &mut Reader) -> Vec<u8> {
    let entry = forge.entry(r);
    r.mangled(entry)
}

fn any_channel(r: &mut Reader, usual: Channel) -> Channel {
    r.pick(&[usual, usual, usual, usual, usual, Channel::Pose, Channel::Facts, Channel::Have])
}

fn any_kind(r: &mut Reader, usual: QueryKind) -> QueryKind {
    r.pick(&[usual, usual, usual, usual, usual, QueryKind::Sync, QueryKind::Blob, QueryKind::Align, QueryKind::Life])
}
