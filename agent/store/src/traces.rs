//! What a file tells that the database cannot open: whether it was a store of ours, whose, and how far this robot's own
//! log had come. Only what carries its seal is believed, but for one thing: a file that begins as a database does, and
//! holds nothing else that can be read, counts as a damaged store, since it lies where a store should.

use crate::tables::{self, number, unseal};
use crate::{Owner, StoreError};
use merganser_protocol::ids::{EntryId, FrameId, NAME_LEN_MAX};
use merganser_protocol::wire::entry::ENTRY_VERSION;
use merganser_protocol::wire::limits::ENTRY_LEN_MAX;
use merganser_protocol::wire::{Entry, SwarmTag};
use std::io::{self, Read};
use std::path::PathBuf;

/// How redb begins a file.
const MAGIC: [u8; 9] = *b"redb\x1a\x0a\xa9\x0d\x0a";
/// So many of its 72 bits may have turned: in other bytes, half of them are wrong, 36.
const MAGIC_TURNED_MAX: u32 = 12;
/// Where redb's header has the size of a page, and what it is.
const PAGE_SIZE: (usize, [u8; 4]) = (12, 4096_u32.to_le_bytes());
/// Where its two commit slots have the version of the file's format, and what it is.
const FORMAT: ([usize; 2], u8) = ([64, 192], 3);
/// Bytes looked at in one piece, and those that the next piece repeats: room for a sealed entry.
const PIECE: usize = 1 << 20;
const OVERLAP: usize = ENTRY_LEN_MAX + 2 * SEALED_NUMBER;
/// A sealed number of `meta`.
const SEALED_NUMBER: usize = 8 + 4;
/// `swarm/robot`.
const LABEL_LEN_MAX: usize = 2 * NAME_LEN_MAX + 1;

/// See the module.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Traces {
    /// Its length in bytes.
    pub len: u64,
    /// The largest epoch of this robot's own that it names.
    pub epoch: Option<u32>,
    head: Vec<u8>,
    all_zero: bool,
    /// `swarm/robot` it was made for.
    label: Option<String>,
    /// An entry that begins as this robot's own do.
    own_entry: bool,
}

impl Traces {
    /// Looks through all bytes. Without an owner, epochs are not looked for.
    pub fn of(mut bytes: impl Read, owner: Option<&Owner>) -> io::Result<Self> {
        let mut traces = Self { all_zero: true, ..Self::default() };
        let mut window = Vec::new();
        loop {
            let kept = window.len();
            let read = bytes.by_ref().take(PIECE as u64).read_to_end(&mut window)?;
            if read == 0 {
                return Ok(traces);
            }
            if traces.len == 0 {
                traces.head = window.iter().copied().take(512).collect();
            }
            traces.len += read as u64;
            traces.all_zero &= window[kept..].iter().all(|byte| *byte == 0);
            traces.look_for_label(&window, owner);
            if let Some(owner) = owner {
                traces.look_for_entries(&window, owner);
            }
            window.drain(..window.len().saturating_sub(OVERLAP));
        }
    }

    /// Why the database cannot open it, in the words that fit what it is.
    pub fn refuse(&self, path: PathBuf, owner: Option<&Owner>, reason: String) -> StoreError {
        let label = self.label.as_ref().filter(|_| !self.own_entry);
        match (label, owner.map(Owner::label)) {
            (Some(found), Some(wanted)) if *found != wanted => {
                return StoreError::Foreign { path, owner: found.clone(), wanted };
            }
            _ => {}
        }
        if let Some(format) = self.other_format() {
            return StoreError::Schema { path, found: format!("redb file format {format}") };
        }
        if self.own_entry || self.label.is_some() || self.begins_as_a_store() {
            StoreError::Damaged { path, reason }
        } else {
            StoreError::NotAStore { path, reason }
        }
    }

    /// A format that both slots agree on; one bit that turned changes but one of them.
    fn other_format(&self) -> Option<u8> {
        let [first, second] = FORMAT.0.map(|at| self.head.get(at).copied());
        let whole = self.head.starts_with(&MAGIC);
        first.filter(|found| whole && first == second && ![0, FORMAT.1].contains(found))
    }

    fn begins_as_a_store(&self) -> bool {
        let Some(begin) = self.head.first_chunk::<{ MAGIC.len() }>() else { return MAGIC.starts_with(&self.head) };
        let turned: u32 = begin.iter().zip(MAGIC).map(|(byte, wanted)| (byte ^ wanted).count_ones()).sum();
        // The database writes its name last: a power cut leaves zeros there, and a disk that lied zeros everywhere.
        let (at, size) = PAGE_SIZE;
        let nameless = *begin == [0; MAGIC.len()] && self.head.get(at..at + size.len()) == Some(&size[..]);
        turned <= MAGIC_TURNED_MAX || nameless || self.all_zero
    }

    /// Names around a slash, with their seal in front. This robot's own counts most.
    fn look_for_label(&mut self, window: &[u8], owner: Option<&Owner>) {
        let is_name = |byte: &u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || b"_-".contains(byte);
        let wanted = owner.map(Owner::label);
        for (slash, _) in window.iter().enumerate().filter(|(_, byte)| **byte == b'/') {
            let before = window[..slash].iter().rev().take(NAME_LEN_MAX).take_while(|byte| is_name(byte)).count();
            let after = window[slash + 1..].iter().take(NAME_LEN_MAX).take_while(|byte| is_name(byte)).count();
            let places = (1..=before).flat_map(|left| (1..=after).map(move |right| (slash - left, slash + 1 + right)));
            for (begin, end) in places {
                debug_assert!(end - begin <= LABEL_LEN_MAX);
                let Some(sealed) = begin.checked_sub(8).map(|seal| &window[seal..end]) else { continue };
                let Some(label) = unseal("meta", tables::META_OWNER.as_bytes(), sealed) else { continue };
                let label = String::from_utf8_lossy(label).into_owned();
                if wanted.as_ref() == Some(&label) {
                    self.look_for_numbers(&window[..begin - 8]);
                }
                if self.label.is_none() || wanted.as_ref() == Some(&label) {
                    self.label = Some(label);
                }
            }
        }
    }

    /// The database puts the values of `meta` in the order of their keys: the epochs stand before the owner.
    fn look_for_numbers(&mut self, before: &[u8]) {
        for key in [tables::META_FRESH_EPOCH, tables::META_CLOSED_EPOCH] {
            let sealed = |back: usize| Some(&before[before.len().checked_sub(back)?..][..SEALED_NUMBER]);
            for back in [SEALED_NUMBER, 2 * SEALED_NUMBER] {
                let value = sealed(back).and_then(|sealed| unseal("meta", key.as_bytes(), sealed)).and_then(number);
                self.epoch = self.epoch.max(value);
            }
        }
    }

    fn look_for_entries(&mut self, window: &[u8], owner: &Owner) {
        let mut begin = vec![ENTRY_VERSION];
        begin.extend_from_slice(&SwarmTag::of(&owner.swarm).0);
        begin.extend_from_slice(&owner.id.0);
        for (at, _) in window.iter().enumerate().filter(|(_, byte)| **byte == ENTRY_VERSION) {
            if !window[at..].starts_with(&begin) {
                continue;
            }
            self.own_entry = true;
            let Some(id) = entry_at(window, at, owner) else { continue };
            self.epoch = self.epoch.max(Some(id.frame.epoch));
        }
    }
}

/// The place of an own entry that begins here, if it is whole.
fn entry_at(window: &[u8], at: usize, owner: &Owner) -> Option<EntryId> {
    const FIXED: usize = 1 + 8 + 8;
    const SIGNATURE: usize = 64;
    let mut rest = window.get(at + FIXED..)?;
    let epoch = varint(&mut rest)?;
    let seq = varint(&mut rest)?;
    rest = rest.get(1..)?; // the kind
    varint(&mut rest)?; // the floor
    rest = rest.get(32..)?; // the hash of the one before
    let payload = varint(&mut rest)? as usize;
    let end = (window.len() - rest.len() + SIGNATURE).checked_add(payload)?;
    let sealed = window.get(at.checked_sub(8)?..end)?;
    let id = EntryId { frame: FrameId { robot: owner.id, epoch }, seq };
    let bytes = unseal("entries", &tables::join_key(id.frame, seq), sealed)?;
    Entry::decode(bytes).is_ok_and(|entry| entry.id() == id).then_some(id)
}

/// A number as postcard writes it.
fn varint(rest: &mut &[u8]) -> Option<u32> {
    let mut value = 0_u64;
    for shift in 0..5 {
        let (byte, tail) = rest.split_first()?;
        *rest = tail;
        value |= u64::from(byte & 0x7f) << (7 * shift);
        if byte & 0x80 == 0 {
            return u32::try_from(value).ok();
        }
    }
    None
}
