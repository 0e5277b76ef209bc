//! The shell of one agent, which holds it to the contract (`lib.rs`) after every input: outputs are well formed and
//! bounded, each question is answered once, nothing is said that is not durable, no list grows over its limit.

use super::forge::Forge;
use super::people::{MEMBERS, config, key, robot};
use merganser_protocol::agent::Agent;
use merganser_protocol::agent::io::{AskToken, Channel, Event, JobId, Output, QueryId, QueryKind, Record};
use merganser_protocol::agent::job::{Job, JobResult};
use merganser_protocol::ids::{EntryId, FrameId, RobotId};
use merganser_protocol::submap::runs::SESSIONS_OVER_MAX;
use merganser_protocol::wire::limits::{BLOB_LEN_MAX, ENTRY_LEN_MAX};
use merganser_protocol::wire::{Entry, Message};
use std::collections::{BTreeMap, BTreeSet};

/// Questions that one input may set off: one to each neighbour, the pieces of blobs that may be under way, one wish.
const ASKS_MAX: usize = MEMBERS + FETCHES_MAX + 1;
/// Blobs fetched at once (`agent::negotiation`).
const FETCHES_MAX: usize = 4;
/// Foreign alignments that wait for an answer (`agent::negotiation`).
const VERIFICATIONS_MAX: usize = 1_024;
/// Batches on their way to the disk beyond which facts of others are refused (`agent::gossip`).
const BATCHES_WAITING_MAX: usize = 1_024;
/// Finished submaps waiting to be described (`agent::mapping`).
const DESCRIBE_QUEUE_MAX: usize = 64;

/// A question of an agent's that the story has not answered yet.
pub struct Asked {
    pub query: QueryId,
    pub peer: RobotId,
    pub kind: QueryKind,
    pub bytes: Vec<u8>,
}

/// What surrounds one agent.
#[derive(Default)]
pub struct Shell {
    last_batch: u64,
    waiting: BTreeMap<u64, Vec<Record>>,
    /// All that is on the disk.
    pub disk: Vec<Record>,
    /// How long each log is whose entries were ever durable.
    places: BTreeMap<FrameId, u32>,
    durable: BTreeSet<Vec<u8>>,
    said: BTreeMap<EntryId, Vec<u8>>,
    pub jobs: Vec<(JobId, Job)>,
    pub asked: Vec<Asked>,
    pub published: Vec<(Channel, Vec<u8>)>,
    /// Answers the agent gave to the question under way.
    answers: Vec<(AskToken, Vec<u8>)>,
}

impl Shell {
    pub fn last_batch(&self) -> u64 {
        self.last_batch
    }

    pub fn first_waiting(&self) -> u64 {
        self.waiting.keys().next().copied().unwrap_or_default()
    }

    /// The store says that these are durable; so they are.
    pub fn persisted(&mut self, up_to: u64) {
        let later = self.waiting.split_off(&up_to.saturating_add(1));
        for record in core::mem::replace(&mut self.waiting, later).into_values().flatten() {
            if let Record::Entry { bytes, .. } = &record {
                let id = Entry::decode(bytes).unwrap().id();
                let len = self.places.entry(id.frame).or_default();
                *len = (*len).max(id.seq + 1);
                self.durable.insert(bytes.clone());
            }
            self.store(record);
        }
    }

    fn store(&mut self, record: Record) {
        if let Record::Refused { i, j, .. } = record {
            self.disk.retain(|other| !matches!(other, Record::Refused { i: a, j: b, .. } if (*a, *b) == (i, j)));
        }
        let (frame, below, submaps, blobs) = match record {
            Record::Replaced { below, submaps, blobs } => (below.frame, Some(below.seq), submaps, blobs),
            Record::Retired { frame, submaps, blobs } => (frame, None, submaps, blobs),
            record => {
                let stays = !matches!(record, Record::Refused { evidence: None, .. });
                return self.disk.extend(stays.then_some(record));
            }
        };
        self.disk.retain(|record| match record {
            Record::Entry { id, .. } => id.frame != frame || below.is_some_and(|below| id.seq >= below),
            Record::Fork { frame: of, .. } => *of != frame || below.is_some(),
            Record::Private { submap, .. } => !submaps.contains(submap),
            Record::Blob { hash, .. } => !blobs.contains(hash),
            _ => true,
        });
    }

    /// The process dies: what was not durable is gone, and so are all jobs and questions.
    pub fn killed(&mut self) {
        self.waiting.clear();
        self.last_batch = 0;
        self.jobs.clear();
        self.asked.clear();
    }

    /// A result under this number will be taken for the job's if it is of its kind.
    pub fn job_done(&mut self, id: JobId, result: &JobResult) {
        let kind = match result {
            JobResult::Described(_) => "describe",
            JobResult::Aligned(_) => "align",
            JobResult::Solved(_) => "solve",
        };
        self.jobs.retain(|(other, job)| *other != id || job.kind() != kind);
    }

    /// Takes all outputs of one input and checks them. Returns the answer, if `token` was asked.
    pub fn drain(&mut self, agent: &mut Agent, forge: &Forge, token: Option<AskToken>) -> Option<Vec<u8>> {
        let (mut outputs, mut asks) = (0, 0);
        self.answers.clear();
        while let Some(output) = agent.poll_output() {
            outputs += 1;
            asks += usize::from(matches!(output, Output::Ask { .. }));
            self.take(agent, forge, output);
        }
        // An event for each entry that took effect, and a few of all else.
        let most = 64 + self.durable.len();
        assert!(outputs <= most && asks <= ASKS_MAX, "one input made {outputs} outputs, {asks} of them questions");
        assert_eq!(self.answers.len(), usize::from(token.is_some()), "every question is answered exactly once");
        self.check_limits(agent);
        let (answered, bytes) = self.answers.pop()?;
        assert_eq!(Some(answered), token);
        Some(bytes)
    }

    fn take(&mut self, agent: &Agent, forge: &Forge, output: Output) {
        match output {
            Output::Persist { batch, records } => {
                assert_eq!(batch, self.last_batch + 1, "batches have no holes");
                assert!(!records.is_empty());
                self.last_batch = batch;
                records.iter().for_each(check_record);
                self.waiting.insert(batch, records);
            }
            Output::Publish { channel, bytes } => {
                self.check_published(agent, forge, channel, &bytes);
                self.published.push((channel, bytes));
            }
            Output::Ask { query, peer, kind, bytes } => {
                let good = matches!(
                    (kind, Message::decode(&bytes).unwrap()),
                    (QueryKind::Sync, Message::SyncRequest(_))
                        | (QueryKind::Blob, Message::BlobRequest { .. })
                        | (QueryKind::Align, Message::AlignRequest { .. })
                        | (QueryKind::Life, Message::LifeRequest { .. })
                );
                assert!(good && peer != agent.robot() && (0..MEMBERS).any(|k| robot(k) == peer));
                assert!(self.asked.iter().all(|asked| asked.query != query), "questions have numbers of their own");
                self.asked.push(Asked { query, peer, kind, bytes });
            }
            Output::Answer { token, bytes } => {
                self.check_answer(&bytes);
                self.answers.push((token, bytes));
            }
            Output::Run { id, job } => self.jobs.push((id, job)),
            Output::Event(Event::Rejected { reason, .. }) => assert!(reason.len() < 1024, "{reason}"),
            Output::Event(_) => {}
        }
    }

    /// Only what is durable is said, and never two things in one place.
    fn check_published(&mut self, agent: &Agent, forge: &Forge, channel: Channel, bytes: &[u8]) {
        match (channel, Message::decode(bytes).unwrap()) {
            (Channel::Pose, Message::Pose(beacon)) => assert_eq!(beacon.robot(), agent.robot()),
            (Channel::Facts, Message::Facts(entries)) => {
                for bytes in entries.into_iter().map(|entry| entry.0) {
                    assert!(self.durable.contains(&bytes), "published before it is durable");
                    let id = Entry::decode(&bytes).unwrap().id();
                    assert_eq!(id.frame.robot, agent.robot(), "only one's own entries are published");
                    let said = self.said.entry(id).or_insert_with(|| bytes.clone());
                    assert!(*said == bytes || forge.knows(id.frame), "{id} was said to be something else");
                }
            }
            (Channel::Have, Message::Have(have)) => {
                // Places below a floor count as well.
                let places: u64 = self.places.values().map(|len| u64::from(*len)).sum();
                assert!(have.count <= places, "advertised before it is durable");
            }
            (channel, other) => panic!("{other:?} on channel {channel:?}"),
        }
    }

    fn check_answer(&self, bytes: &[u8]) {
        if bytes.is_empty() {
            return; // "I cannot."
        }
        match Message::decode(bytes).unwrap() {
            Message::SyncReply(delta) => {
                let durable = |bytes: &Vec<u8>| self.durable.contains(bytes);
                assert!(delta.entries.iter().all(|entry| durable(&entry.0)), "served before it is durable");
                let carried = delta.entries.iter().chain(delta.forks.iter().flatten());
                assert!(carried.map(|entry| entry.0.len()).sum::<usize>() <= config().gossip.delta_bytes_max);
            }
            Message::BlobReply { total, .. } => assert!(total as usize <= BLOB_LEN_MAX),
            Message::AlignReply { .. } | Message::LifeReply(_) => {}
            other => panic!("{other:?} is no answer"),
        }
    }

    fn check_limits(&self, agent: &Agent) {
        let (config, status) = (config(), agent.status());
        let count = |kind: &str| self.jobs.iter().filter(|(_, job)| job.kind() == kind).count();
        assert!(count("align") <= config.align.jobs_max && count("describe") <= 1 && count("solve") <= 1);
        assert!(status.entries <= self.durable.len() as u64);
        let logs = agent.heads().count() as u64;
        assert!(status.entries <= logs * u64::from(config.gossip.entries_per_frame_max), "{} entries", status.entries);
        let pending = BATCHES_WAITING_MAX + DESCRIBE_QUEUE_MAX + 1;
        assert!(status.unsaved <= pending as u64, "{} records and submaps wait", status.unsaved);
        let aligning = config.align.jobs_max + config.align.candidates_max + VERIFICATIONS_MAX;
        assert!(status.pending - status.unsaved <= aligning as u64, "{} pairs wait", status.pending);
        let mut epochs = BTreeMap::<RobotId, usize>::new();
        for (frame, _) in agent.heads() {
            *epochs.entry(frame.robot).or_default() += 1;
        }
        // Its own epochs an agent counts itself.
        let others = epochs.iter().filter(|(robot, _)| **robot != agent.robot());
        assert!(others.clone().count() < MEMBERS, "only members are held");
        assert!(others.clone().all(|(_, epochs)| *epochs <= config.gossip.epochs_per_robot_max));
    }
}

/// What goes to the disk is what it says it is, and signed by a member.
fn check_record(record: &Record) {
    match record {
        Record::Entry { id, bytes } => {
            assert!(bytes.len() <= ENTRY_LEN_MAX);
            let entry = Entry::decode(bytes).unwrap();
            let signer = (0..MEMBERS).find(|k| robot(*k) == id.frame.robot).unwrap();
            assert_eq!(entry.id(), *id);
            entry.verify(&key(signer).verifying_key()).unwrap();
        }
        Record::Blob { bytes, .. } => assert!(bytes.len() <= BLOB_LEN_MAX),
        Record::Fork { proof: [a, b], .. } => assert!(a.len() + b.len() <= 2 * ENTRY_LEN_MAX && a != b),
        Record::Session { over, .. } => assert!(over.len() <= SESSIONS_OVER_MAX),
        // One with a turned byte may be no pair: it goes off the disk under the name that it has.
        Record::Refused { i, j, evidence } => assert!(evidence.is_none() || i < j),
        Record::Private { .. } | Record::EpochClosed { .. } | Record::Replaced { .. } | Record::Retired { .. } => {}
    }
}
