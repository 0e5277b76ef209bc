//! Nothing leaves a robot before it is durable there (DESIGN §8.5). No message is decoded: a message that contains the
//! bytes of a record that its sender's disk does not hold yet is a leak, whether the record was handed to the disk
//! before the message left or soon after.

use super::{Check, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::{Hash, RobotId};
use merganser_protocol::wire::Entry;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Messages remembered per robot, to be held against records that come later.
const SENT_MAX: usize = 64;
/// Shorter records could be found in a message by chance.
const RECORD_LEN_MIN: usize = 24;

/// See the module.
#[derive(Debug, Default)]
pub struct DurableFirst {
    /// Robots whose logs may have two histories. The proof of a fork travels at once, with entries that are not stored:
    /// it is no claim to hold them.
    doubted: BTreeSet<RobotId>,
    robots: BTreeMap<usize, Robot>,
}

#[derive(Debug, Default)]
struct Robot {
    /// Records handed to the disk, by batch.
    waiting: VecDeque<(u64, Needles)>,
    /// Records the disk holds: one may be stored twice.
    durable: BTreeSet<Hash>,
    sent: VecDeque<Vec<u8>>,
    /// Its blobs are others', who have stored them.
    mirrors: bool,
}

impl Check for DurableFirst {
    fn name(&self) -> &'static str {
        "durable first"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        let state = self.robots.entry(robot).or_default();
        match seen {
            Seen::Started(_) | Seen::Died => {
                state.waiting.clear();
                state.sent.clear();
            }
            Seen::Mirrors => state.mirrors = true,
            Seen::Wiped => state.durable.clear(),
            Seen::MayFork(origin) => {
                self.doubted.insert(*origin);
                let of_others =
                    |bytes: &Vec<u8>| Entry::decode(bytes).ok().is_none_or(|e| e.id().frame.robot != *origin);
                let waiting = self.robots.values_mut().flat_map(|robot| &mut robot.waiting);
                waiting.for_each(|(_, needles)| needles.list.retain(of_others));
            }
            Seen::Durable(batch) => {
                while state.waiting.front().is_some_and(|(number, _)| number <= batch) {
                    let records = state.waiting.pop_front().map(|(_, needles)| needles.list).unwrap_or_default();
                    state.durable.extend(records.iter().map(|bytes| Hash::of(bytes)));
                }
            }
            Seen::Output(Output::Persist { batch, records }) => {
                let new = |bytes: &Vec<u8>| !state.durable.contains(&Hash::of(bytes));
                let own = |record: &&Record| !(state.mirrors && matches!(record, Record::Blob { .. }));
                let records = records.iter().filter(own);
                let needles: Needles = records.filter_map(|r| sendable(r, &self.doubted)).filter(new).collect();
                if let Some(needle) = state.sent.iter().find_map(|message| needles.within(message).next()) {
                    return Err(format!("robot {robot}: sent {} B before it stored them", needle.len()));
                }
                state.waiting.push_back((*batch, needles));
            }
            Seen::Output(Output::Publish { bytes, .. } | Output::Answer { bytes, .. } | Output::Ask { bytes, .. }) => {
                for (batch, needles) in &state.waiting {
                    let leaked = |n: &&Vec<u8>| !state.durable.contains(&Hash::of(n));
                    if let Some(needle) = needles.within(bytes).find(leaked) {
                        return Err(format!(
                            "robot {robot}: sent a record of {} B while batch {batch} that holds it is not durable",
                            needle.len()
                        ));
                    }
                }
                state.sent.push_back(bytes.clone());
                if state.sent.len() > SENT_MAX {
                    state.sent.pop_front();
                }
            }
            _ => {}
        }
        Ok(())
    }
}

fn sendable(record: &Record, doubted: &BTreeSet<RobotId>) -> Option<Vec<u8>> {
    match record {
        Record::Entry { id, .. } if doubted.contains(&id.frame.robot) => None,
        Record::Entry { bytes, .. } | Record::Blob { bytes, .. } => {
            (bytes.len() >= RECORD_LEN_MIN).then(|| bytes.clone())
        }
        Record::Private { .. } | Record::Fork { .. } | Record::EpochClosed { .. } | Record::Replaced { .. } => None,
        Record::Session { .. } | Record::Refused { .. } | Record::Retired { .. } => None,
    }
}

/// Records of one batch, to be looked for in messages in one go. They end in a signature or in payload, so their last
/// bytes tell them apart sooner than their headers do.
#[derive(Debug, Default)]
struct Needles {
    list: Vec<Vec<u8>>,
    /// A bit for each two bytes that a record ends in.
    ends: Vec<u64>,
}

impl FromIterator<Vec<u8>> for Needles {
    fn from_iter<I: IntoIterator<Item = Vec<u8>>>(records: I) -> Self {
        let list: Vec<Vec<u8>> = records.into_iter().collect();
        let mut ends = vec![0; (1 << 16) / 64];
        for end in list.iter().filter_map(|record| record.last_chunk::<2>()) {
            let end = u16::from_le_bytes(*end);
            ends[usize::from(end / 64)] |= 1 << (end % 64);
        }
        Self { list, ends }
    }
}

impl Needles {
    /// The records that the message contains.
    fn within<'a>(&'a self, message: &'a [u8]) -> impl Iterator<Item = &'a Vec<u8>> {
        let ends_one = |pair: &[u8]| {
            let end = pair.first_chunk::<2>().map_or(0, |pair| u16::from_le_bytes(*pair));
            self.ends[usize::from(end / 64)] >> (end % 64) & 1 == 1
        };
        let pairs = if self.list.is_empty() { [].windows(2) } else { message.windows(2) };
        let heads = pairs.enumerate().filter(move |(_, pair)| ends_one(pair)).map(|(at, _)| &message[..at + 2]);
        heads.flat_map(|head| self.list.iter().filter(move |record| head.ends_with(record)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::agent::io::{AskToken, Channel};
    use merganser_protocol::ids::{EntryId, FrameId};
    use merganser_protocol::wire::{EntryContent, SwarmTag};

    fn persist() -> Output {
        let bytes: Vec<u8> = (0..40).collect();
        Output::Persist { batch: 1, records: vec![Record::Blob { hash: Hash::of(&bytes), bytes }] }
    }

    fn publish() -> Output {
        Output::Publish { channel: Channel::Facts, bytes: (0..=60).collect() }
    }

    #[test]
    fn it_bites_on_a_message_that_is_too_early() {
        let mut check = DurableFirst::default();
        assert!(check.see(0, &Seen::Output(&persist())).is_ok());
        assert!(check.see(1, &Seen::Output(&publish())).is_ok(), "another robot may hold it");
        assert!(check.see(0, &Seen::Output(&publish())).is_err());
    }

    #[test]
    fn it_bites_on_a_record_that_is_stored_after_it_was_sent() {
        let mut check = DurableFirst::default();
        assert!(check.see(0, &Seen::Output(&publish())).is_ok());
        assert!(check.see(0, &Seen::Output(&persist())).is_err());
    }

    #[test]
    fn the_proof_of_a_fork_may_travel_before_it_is_stored() {
        let key = ed25519_dalek::SigningKey::from_bytes(&[7; 32]);
        let origin = RobotId::of_key(key.verifying_key().as_bytes());
        let id = EntryId { frame: FrameId { robot: origin, epoch: 1 }, seq: 0 };
        let (swarm, previous) = (SwarmTag([1; 8]), Hash::default());
        let content = EntryContent { swarm, id, kind: 9, floor: 0, previous, payload: vec![3; 40] };
        let bytes = Entry::sign(&key, content).unwrap().encode();
        let persist = Output::Persist { batch: 1, records: vec![Record::Entry { id, bytes: bytes.clone() }] };
        let answer = Output::Answer { token: AskToken(1), bytes };
        for doubted in [None, Some(RobotId([1; 8])), Some(origin)] {
            let mut check = DurableFirst::default();
            check.see(0, &Seen::Output(&persist)).unwrap();
            if let Some(doubted) = doubted {
                check.see(1, &Seen::MayFork(doubted)).unwrap();
            }
            assert_eq!(check.see(0, &Seen::Output(&answer)).is_ok(), doubted == Some(origin), "{doubted:?}");
        }
    }

    /// Its own entries it stores first, like everybody.
    #[test]
    fn whoever_mirrors_others_clouds_may_pass_them_on_before_it_states_them() {
        let mut check = DurableFirst::default();
        check.see(0, &Seen::Mirrors).unwrap();
        check.see(0, &Seen::Output(&publish())).unwrap();
        assert!(check.see(0, &Seen::Output(&persist())).is_ok());
        let Output::Persist { records, .. } = persist() else { panic!() };
        let [Record::Blob { bytes, .. }] = &records[..] else { panic!() };
        let id = EntryId { frame: FrameId { robot: RobotId([1; 8]), epoch: 1 }, seq: 0 };
        let entry = Output::Persist { batch: 2, records: vec![Record::Entry { id, bytes: bytes.clone() }] };
        assert!(check.see(0, &Seen::Output(&entry)).is_err());
    }

    #[test]
    fn it_is_content_once_the_disk_is() {
        let mut check = DurableFirst::default();
        assert!(check.see(0, &Seen::Output(&persist())).is_ok());
        assert!(check.see(0, &Seen::Durable(1)).is_ok());
        assert!(check.see(0, &Seen::Output(&publish())).is_ok());
        assert!(check.see(0, &Seen::Output(&persist())).is_ok(), "stored once more");
        assert!(check.see(0, &Seen::Output(&publish())).is_ok());
        for seen in [Seen::Died, Seen::Wiped, Seen::Started(RobotId([1; 8]))] {
            assert!(check.see(0, &seen).is_ok());
        }
        assert!(check.see(0, &Seen::Output(&persist())).is_ok());
        assert!(check.see(0, &Seen::Output(&publish())).is_err(), "the new disk does not hold it");
    }
}
