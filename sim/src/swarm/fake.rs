//! A stand-in for the core, for the simulator's own tests: it writes an entry per keyframe, publishes it once it is
//! durable, and repairs by asking neighbours for everything when a heard digest differs. It can be told to misbehave.

use crate::core::Restartable;
use core::cell::RefCell;
use core::time::Duration;
use merganser_protocol::agent::io::{Channel, Input, Output, QueryId, QueryKind, Record};
use merganser_protocol::agent::{Core, Identity, Restored, StartError};
use merganser_protocol::config::Config;
use merganser_protocol::ids::{EntryId, FrameId, Hash, RobotId};
use merganser_protocol::time::Instant;
use std::collections::{BTreeMap, VecDeque};

/// A bug to plant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Bug {
    #[default]
    None,
    /// Publishes before the disk said so.
    EarlyPublish,
    /// Never asks for what it misses.
    NoRepair,
    /// Numbers its entries by what it remembers since its start, not by what it stored.
    ReusesNumbers,
    /// Outputs depend on something outside.
    Unseeded,
    /// Asks for a timeout that is always due.
    NeverRests,
    /// Trips over its second keyframe.
    Panics,
}

thread_local! {
    static BUG: RefCell<Bug> = const { RefCell::new(Bug::None) };
    static OUTSIDE: RefCell<u64> = const { RefCell::new(0) };
}

/// Runs `body` with fakes that have this bug.
pub fn with_bug<T>(bug: Bug, body: impl FnOnce() -> T) -> T {
    BUG.replace(bug);
    let result = body();
    BUG.replace(Bug::None);
    result
}

fn bug() -> Bug {
    BUG.with_borrow(|bug| *bug)
}

pub struct Fake {
    frame: FrameId,
    entries: BTreeMap<EntryId, Vec<u8>>,
    next: u32,
    waiting: BTreeMap<u64, Vec<Vec<u8>>>,
    batches: u64,
    queries: u64,
    neighbours: Vec<RobotId>,
    outputs: VecDeque<Output>,
    next_have: Instant,
}

const HAVE: Duration = Duration::from_millis(500);
const ENTRY_LEN: usize = 48;

impl Restartable for Fake {
    fn start(
        _config: Config,
        identity: Identity,
        _seed: u64,
        restored: Restored,
        now: Instant,
    ) -> Result<Self, StartError> {
        let robot = RobotId::of_key(&identity.roster[&identity.name]);
        let mut entries = BTreeMap::new();
        for record in restored.records {
            if let Record::Entry { id, bytes } = record {
                entries.insert(id, bytes);
            }
        }
        let own = entries.keys().filter(|id| id.frame.robot == robot).max().copied();
        let epoch = own.map_or(restored.fresh_epoch, |id| id.frame.epoch);
        let next = own.filter(|_| bug() != Bug::ReusesNumbers).map_or(0, |id| id.seq + 1);
        Ok(Self {
            frame: FrameId { robot, epoch },
            entries,
            next,
            waiting: BTreeMap::new(),
            batches: 0,
            queries: 0,
            neighbours: Vec::new(),
            outputs: VecDeque::new(),
            next_have: now.after(HAVE),
        })
    }

    fn frame(&self) -> FrameId {
        self.frame
    }

    fn logs(&self) -> BTreeMap<FrameId, Option<u32>> {
        let mut logs = BTreeMap::new();
        for id in self.entries.keys() {
            // Entries come in any order here: a log counts up to its first hole.
            let len: &mut Option<u32> = logs.entry(id.frame).or_insert(Some(0));
            *len = len.map(|len| if len == id.seq { len + 1 } else { len });
        }
        logs
    }
}

impl Core for Fake {
    fn handle(&mut self, now: Instant, input: Input) {
        match input {
            Input::Keyframe(keyframe) => {
                assert!(bug() != Bug::Panics || self.next == 0, "planted");
                let id = EntryId { frame: self.frame, seq: self.next };
                self.next += 1;
                let mut body = keyframe.stamp.0.to_le_bytes().repeat(4);
                if bug() == Bug::Unseeded {
                    body[0] ^= OUTSIDE.with_borrow_mut(|n| {
                        *n += 1;
                        *n as u8
                    });
                }
                let entry = encode(id, &body);
                self.persist(vec![entry.clone()]);
                if bug() == Bug::EarlyPublish {
                    self.outputs.push_back(Output::Publish { channel: Channel::Facts, bytes: entry });
                }
            }
            Input::Received { channel: Channel::Facts, bytes, .. } => self.learn(&bytes),
            Input::Received { from, channel: Channel::Have, bytes }
                if bytes != self.digest().0 && bug() != Bug::NoRepair =>
            {
                self.queries += 1;
                let query = QueryId(self.queries);
                self.outputs.push_back(Output::Ask { query, peer: from, kind: QueryKind::Sync, bytes });
            }
            Input::Asked { token, .. } => {
                let bytes = self.entries.values().flatten().copied().collect();
                self.outputs.push_back(Output::Answer { token, bytes });
            }
            Input::Answered { bytes: Some(bytes), .. } => self.learn(&bytes),
            Input::Persisted { up_to } => {
                for (_, entries) in self.waiting.split_off(&0).into_iter().filter(|(batch, _)| *batch <= up_to) {
                    for entry in entries {
                        let (id, bytes) = decode(&entry);
                        self.entries.insert(id, bytes);
                        if id.frame == self.frame {
                            self.outputs.push_back(Output::Publish { channel: Channel::Facts, bytes: entry });
                        }
                    }
                }
            }
            Input::Neighbour { robot, up: true } => self.neighbours.push(robot),
            Input::Timeout if now >= self.next_have => {
                self.next_have = now.after(HAVE);
                let bytes = self.digest().0.to_vec();
                self.outputs.push_back(Output::Publish { channel: Channel::Have, bytes });
            }
            _ => {}
        }
    }

    fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Some(if bug() == Bug::NeverRests { Instant::ZERO } else { self.next_have })
    }

    fn digest(&self) -> Hash {
        Hash::of(&self.entries.values().flatten().copied().collect::<Vec<u8>>())
    }
}

impl Fake {
    fn persist(&mut self, entries: Vec<Vec<u8>>) {
        self.batches += 1;
        let record = |entry: &Vec<u8>| {
            let (id, bytes) = decode(entry);
            Record::Entry { id, bytes }
        };
        let records = entries.iter().map(record).collect();
        self.outputs.push_back(Output::Persist { batch: self.batches, records });
        self.waiting.insert(self.batches, entries);
    }

    fn learn(&mut self, bytes: &[u8]) {
        let new = |entry: &&[u8]| !self.entries.contains_key(&decode(entry).0);
        let entries: Vec<Vec<u8>> = bytes.chunks_exact(ENTRY_LEN).filter(new).map(<[u8]>::to_vec).collect();
        if !entries.is_empty() {
            self.persist(entries);
        }
    }
}

fn encode(id: EntryId, body: &[u8]) -> Vec<u8> {
    let mut bytes = id.frame.robot.0.to_vec();
    bytes.extend(id.frame.epoch.to_le_bytes());
    bytes.extend(id.seq.to_le_bytes());
    bytes.extend(body);
    bytes
}

fn decode(bytes: &[u8]) -> (EntryId, Vec<u8>) {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let frame = FrameId { robot: RobotId(bytes[..8].try_into().unwrap()), epoch: word(8) };
    (EntryId { frame, seq: word(12) }, bytes.to_vec())
}
