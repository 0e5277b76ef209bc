//! Nothing below a floor returns (DESIGN §8.4): once a robot's disk has dropped what a writer replaced, or a log that it
//! gave up, no entry below that place, or of that log, is put on it again, in no later run, and the robot offers none to
//! others. A disk that was wiped, or that lost what it had confirmed, is excused.

use super::pending::Pending;
use super::{Check, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::FrameId;
use merganser_protocol::wire::{Entry, Message};
use std::collections::BTreeMap;

/// See the module.
#[derive(Debug, Default)]
pub struct Floors {
    robots: BTreeMap<usize, Disk>,
}

#[derive(Debug, Default)]
struct Disk {
    floors: BTreeMap<FrameId, u32>,
    waiting: Pending<(FrameId, u32)>,
}

impl Disk {
    fn above(&self, frame: FrameId, seq: u32) -> Result<(), String> {
        let floor = self.floors.get(&frame).copied().unwrap_or(0);
        if seq < floor { Err(format!("entry {frame}:{seq} came back from below the floor {floor}")) } else { Ok(()) }
    }

    fn persist(&mut self, batch: u64, records: &[Record]) -> Result<(), String> {
        for record in records {
            match record {
                Record::Entry { id, .. } => self.above(id.frame, id.seq)?,
                Record::Replaced { below, .. } => self.waiting.hand_over(batch, [(below.frame, below.seq)]),
                // No entry has the last place of all.
                Record::Retired { frame, .. } => self.waiting.hand_over(batch, [(*frame, u32::MAX)]),
                _ => {}
            }
        }
        Ok(())
    }

    fn offers(&self, bytes: &[u8]) -> Result<(), String> {
        // Looking into each message is dear, and without floors there is nothing to find.
        if self.floors.is_empty() {
            return Ok(());
        }
        let entries = match Message::decode(bytes) {
            Ok(Message::Facts(entries)) => entries,
            Ok(Message::SyncReply(delta)) => delta.entries,
            _ => return Ok(()),
        };
        let ids = entries.iter().filter_map(|entry| Entry::decode(&entry.0).ok()).map(|entry| entry.id());
        ids.into_iter().try_for_each(|id| self.above(id.frame, id.seq))
    }
}

impl Check for Floors {
    fn name(&self) -> &'static str {
        "nothing below a floor"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        let disk = self.robots.entry(robot).or_default();
        let seen = match seen {
            Seen::Output(Output::Persist { batch, records }) => disk.persist(*batch, records),
            Seen::Output(Output::Publish { bytes, .. } | Output::Answer { bytes, .. }) => disk.offers(bytes),
            Seen::Durable(batch) => {
                for (frame, seq) in disk.waiting.durable(*batch) {
                    let floor = disk.floors.entry(frame).or_default();
                    *floor = seq.max(*floor);
                }
                Ok(())
            }
            Seen::Died => {
                disk.waiting.lose();
                Ok(())
            }
            Seen::Wiped | Seen::Damaged => {
                *disk = Disk::default();
                Ok(())
            }
            _ => Ok(()),
        };
        seen.map_err(|what| format!("robot {robot}: {what}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::agent::io::{AskToken, Channel};
    use merganser_protocol::ids::{EntryId, Hash, Name, RobotId};
    use merganser_protocol::wire::{Delta, EntryBytes, EntryContent, SwarmTag};

    const FRAME: FrameId = FrameId { robot: RobotId([1; 8]), epoch: 4 };

    fn hand_over(check: &mut Floors, robot: usize, record: Record) -> Result<(), String> {
        check.see(robot, &Seen::Output(&Output::Persist { batch: 1, records: vec![record] }))
    }

    fn entry(seq: u32) -> Record {
        Record::Entry { id: EntryId { frame: FRAME, seq }, bytes: vec![] }
    }

    fn floor(seq: u32) -> Record {
        Record::Replaced { below: EntryId { frame: FRAME, seq }, submaps: vec![], blobs: vec![] }
    }

    #[test]
    fn an_entry_of_a_log_that_was_given_up_is_seen() {
        let mut check = Floors::default();
        let retired = Record::Retired { frame: FRAME, submaps: vec![], blobs: vec![] };
        hand_over(&mut check, 0, retired).unwrap();
        assert!(hand_over(&mut check, 0, entry(400)).is_ok(), "not on disk yet");
        check.see(0, &Seen::Durable(1)).unwrap();
        assert!(hand_over(&mut check, 0, entry(400)).is_err());
        assert!(hand_over(&mut check, 1, entry(400)).is_ok(), "another robot has not heard of it");
    }

    #[test]
    fn an_entry_that_comes_back_from_below_is_seen() {
        let mut check = Floors::default();
        hand_over(&mut check, 0, floor(5)).unwrap();
        assert!(hand_over(&mut check, 0, entry(4)).is_ok(), "not on disk yet");
        check.see(0, &Seen::Durable(1)).unwrap();
        assert!(hand_over(&mut check, 0, entry(5)).is_ok());
        assert!(hand_over(&mut check, 0, entry(4)).is_err());
        assert!(hand_over(&mut check, 1, entry(4)).is_ok(), "of another robot's disk nothing was said");
        check.see(0, &Seen::Died).unwrap();
        assert!(hand_over(&mut check, 0, entry(4)).is_err(), "no more after a restart");
        check.see(0, &Seen::Wiped).unwrap();
        assert!(hand_over(&mut check, 0, entry(4)).is_ok());
    }

    #[test]
    fn what_is_offered_from_below_is_seen_whichever_way() {
        let mut check = Floors::default();
        hand_over(&mut check, 0, floor(5)).unwrap();
        check.see(0, &Seen::Durable(1)).unwrap();
        let key = ed25519_dalek::SigningKey::from_bytes(&[1; 32]);
        let signed = |seq| {
            let (id, swarm) = (EntryId { frame: FRAME, seq }, SwarmTag::of(&Name::new("test").unwrap()));
            let content = EntryContent { swarm, id, kind: 200, floor: 0, previous: Hash([1; 32]), payload: vec![1] };
            EntryBytes(Entry::sign(&key, content).unwrap().encode())
        };
        let mut says = |seq| {
            let published =
                Output::Publish { channel: Channel::Facts, bytes: Message::Facts(vec![signed(seq)]).encode() };
            let delta = Delta { entries: vec![signed(seq)], ..Delta::default() };
            let answer = Output::Answer { token: AskToken(1), bytes: Message::SyncReply(delta).encode() };
            [published, answer].map(|output| check.see(0, &Seen::Output(&output)).is_ok())
        };
        assert_eq!((says(5), says(4)), ([true; 2], [false; 2]));
    }

    #[test]
    fn a_floor_that_died_with_its_process_binds_nobody() {
        let mut check = Floors::default();
        hand_over(&mut check, 0, floor(5)).unwrap();
        check.see(0, &Seen::Died).unwrap();
        check.see(0, &Seen::Durable(1)).unwrap();
        assert!(hand_over(&mut check, 0, entry(4)).is_ok());
    }
}
