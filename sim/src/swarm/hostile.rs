//! What the ill-willed and the unlucky put on the air: messages from nobody, mangled copies, another version, and a
//! member's second story.

use crate::dice::Dice;
use ed25519_dalek::SigningKey;
use merganser_protocol::agent::io::{Channel, Input};
use merganser_protocol::ids::{EntryId, FrameId, Hash, RobotId};
use merganser_protocol::wire::messages::Message;
use merganser_protocol::wire::{Entry, EntryBytes, EntryContent, HaveRoot, SwarmTag};

/// A message under an id that nobody has: a root, an entry with a good signature of a key that no roster has, rubbish.
pub fn from_nobody(dice: &mut Dice) -> Input {
    let from = RobotId(dice.bits().to_le_bytes());
    match dice.bits() % 4 {
        0 => {
            let root = HaveRoot { root: dice.bits().to_le_bytes(), count: dice.bits() >> 32 };
            Input::Received { from, channel: Channel::Have, bytes: Message::Have(root).encode() }
        }
        1 => {
            let bytes = Message::Facts(vec![EntryBytes(stranger(dice.bits()))]).encode();
            Input::Received { from, channel: Channel::Facts, bytes }
        }
        2 => Input::Neighbour { robot: from, up: true },
        _ => {
            let bytes = (0..dice.bits() % 200).map(|_| dice.bits() as u8).collect();
            Input::Received { from, channel: Channel::Facts, bytes }
        }
    }
}

/// An entry of somebody outside, signed once: what must be cheap is to refuse it.
fn stranger(number: u64) -> Vec<u8> {
    let key = SigningKey::from_bytes(&[9; 32]);
    let frame = FrameId { robot: RobotId::of_key(key.verifying_key().as_bytes()), epoch: number as u32 };
    let content = EntryContent {
        swarm: SwarmTag([7; 8]),
        id: EntryId { frame, seq: 0 },
        kind: 99,
        floor: 0,
        previous: Hash::default(),
        payload: number.to_le_bytes().to_vec(),
    };
    Entry::sign(&key, content).map(|entry| entry.encode()).unwrap_or_default()
}

/// Changes a message: cuts it, flips bits, appends, claims another length or version.
pub fn mangle(bytes: &[u8], how: u64) -> Vec<u8> {
    let mut mangled = bytes.to_vec();
    let at = (how >> 8) as usize % bytes.len().max(1);
    match how % 6 {
        0 => mangled.truncate(at),
        1 => mangled.extend(how.to_le_bytes()),
        2 => mangled.iter_mut().skip(2).take(1).for_each(|version| *version = (how >> 40) as u8),
        // A varint of the largest length there is.
        3 => mangled.iter_mut().skip(at).take(5).for_each(|byte| *byte = 0xff),
        4 => mangled.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= 1 << ((how >> 40) % 8)),
        _ => mangled.iter_mut().skip(4).take(1).for_each(|byte| *byte = byte.wrapping_add((how >> 40) as u8)),
    }
    mangled
}

/// A frame of the next version.
pub fn of_next_version(mut bytes: Vec<u8>) -> Vec<u8> {
    if let Some(version) = bytes.get_mut(2) {
        *version = version.wrapping_add(1);
    }
    bytes
}

/// The same message of a member with other facts in the same places, signed as well.
pub fn second_story(bytes: &[u8], secret: &[u8; 32]) -> Option<Vec<u8>> {
    let Ok(Message::Facts(entries)) = Message::decode(bytes) else { return None };
    let key = SigningKey::from_bytes(secret);
    let own = RobotId::of_key(key.verifying_key().as_bytes());
    let other = |bytes: &EntryBytes| {
        let entry = Entry::decode(&bytes.0).ok().filter(|entry| entry.id().frame.robot == own)?;
        let content = EntryContent {
            swarm: entry.swarm(),
            id: entry.id(),
            kind: 99,
            floor: entry.floor(),
            previous: entry.previous(),
            payload: b"another story".to_vec(),
        };
        Some(EntryBytes(Entry::sign(&key, content).ok()?.encode()))
    };
    // One entry is enough: what follows would name another predecessor.
    entries.first().and_then(other).map(|entry| Message::Facts(vec![entry]).encode())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mangled_message_is_another_message() {
        let bytes: Vec<u8> = (0..60).collect();
        let changed = (0..600).filter(|how| mangle(&bytes, how * 0x0102_0304_0506_0708) != bytes).count();
        assert!(changed > 500, "{changed}");
        assert!(mangle(&[], 77).len() <= 8);
    }

    #[test]
    fn a_second_story_is_well_signed_and_contradicts_the_first() {
        let key = SigningKey::from_bytes(&[9; 32]);
        let first = stranger(3);
        let told = Message::Facts(vec![EntryBytes(first.clone())]).encode();
        let Ok(Message::Facts(second)) = Message::decode(&second_story(&told, &[9; 32]).unwrap()) else { panic!() };
        let (a, b) = (Entry::decode(&first).unwrap(), Entry::decode(&second[0].0).unwrap());
        assert!(a.id() == b.id() && a != b && b.verify(&key.verifying_key()).is_ok());
        assert_eq!(second_story(&told, &[8; 32]), None, "only of one's own");
    }
}
