//! Keypoint blobs as they are sent: raw bytes by their address, kept to serve others.

use crate::agent::recent::Recent;
use crate::ids::Hash;
use crate::submap::Keypoints;
use std::collections::BTreeSet;

/// Raw blobs kept in memory to serve others: of each own submap two.
pub const BLOBS_MAX: usize = 4_096;

/// See the module.
#[derive(Default)]
pub(in crate::agent) struct Blobs(Recent<Vec<u8>>);

impl Blobs {
    /// The bytes of a blob, if it is here.
    pub(in crate::agent) fn get(&self, hash: Hash) -> Option<&[u8]> {
        self.0.get(hash).map(Vec::as_slice)
    }

    /// These blobs, and those that go on with them as far as they are here to say so.
    pub(super) fn with_further(&self, blobs: impl IntoIterator<Item = Hash>) -> BTreeSet<Hash> {
        let further = |blob| self.get(blob).and_then(Keypoints::address_in);
        blobs.into_iter().flat_map(|blob| [Some(blob), further(blob)]).flatten().collect()
    }

    /// Whether a blob more makes another one go.
    pub(super) fn is_full(&self) -> bool {
        self.0.len() >= BLOBS_MAX
    }

    /// Keeps a blob. Beyond [`BLOBS_MAX`] one goes that is not among `ours`, which are told only then: what others
    /// made they can serve themselves. If all are ours, what others made is not kept.
    pub(super) fn add(&mut self, hash: Hash, bytes: Vec<u8>, ours: Option<BTreeSet<Hash>>) {
        if let Some(ours) = ours.filter(|_| self.is_full() && self.0.get(hash).is_none()) {
            let has_gone = self.0.drop_oldest(|hash| !ours.contains(hash))
                || (ours.contains(&hash) && self.0.drop_oldest(|_| true));
            if !has_gone {
                return;
            }
        }
        self.0.insert(hash, bytes);
    }
}

/// As many blobs as are kept: first those that are `named` or go on with these, then the others.
pub(super) fn ours_first(named: &BTreeSet<Hash>, blobs: Vec<Vec<u8>>) -> Vec<Vec<u8>> {
    let is_named = |bytes: &&Vec<u8>| named.contains(&Hash::of(bytes));
    let further: Vec<Hash> = blobs.iter().filter(is_named).filter_map(|bytes| Keypoints::address_in(bytes)).collect();
    let ours: BTreeSet<Hash> = named.iter().copied().chain(further).collect();
    let (own, foreign): (Vec<_>, Vec<_>) = blobs.into_iter().partition(|bytes| ours.contains(&Hash::of(bytes)));
    own.into_iter().chain(foreign).take(BLOBS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blob(number: usize) -> (Hash, Vec<u8>) {
        let bytes = number.to_le_bytes().to_vec();
        (Hash::of(&bytes), bytes)
    }

    #[test]
    fn what_others_made_goes_first_and_never_for_what_others_made_alone() {
        let mut blobs = Blobs::default();
        let ours: BTreeSet<Hash> = (0..=BLOBS_MAX).map(|number| blob(number).0).collect();
        let add = |blobs: &mut Blobs, number| {
            let (hash, bytes) = blob(number);
            blobs.add(hash, bytes, Some(ours.clone()));
        };
        let held = |blobs: &Blobs, numbers: core::ops::Range<usize>| {
            numbers.filter(|number| blobs.get(blob(*number).0).is_some()).count()
        };
        let foreign = BLOBS_MAX + 1..2 * BLOBS_MAX + 1;
        (1..BLOBS_MAX).for_each(|number| add(&mut blobs, number));
        foreign.clone().for_each(|number| add(&mut blobs, number));
        assert_eq!((held(&blobs, 0..BLOBS_MAX), held(&blobs, foreign.clone())), (BLOBS_MAX - 1, 1));
        add(&mut blobs, 0);
        assert_eq!((held(&blobs, 0..BLOBS_MAX), held(&blobs, foreign.clone())), (BLOBS_MAX, 0));
        add(&mut blobs, foreign.start);
        assert_eq!((held(&blobs, 0..BLOBS_MAX), held(&blobs, foreign)), (BLOBS_MAX, 0));
        add(&mut blobs, BLOBS_MAX);
        assert_eq!(held(&blobs, 0..BLOBS_MAX + 1), BLOBS_MAX);
        assert!(blobs.get(blob(BLOBS_MAX).0).is_some(), "the latest of ours is served");
    }
}
