//! Keypoint blobs that are wanted and not here: what came of each, when to ask again, and which nobody in reach has.

use crate::agent::io::QueryId;
use crate::agent::replication::Lacking;
use crate::ids::{Hash, RobotId};
use crate::time::Instant;
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};

/// Blobs fetched at once.
const FETCHES_MAX: usize = 4;
/// Blobs begun and not yet here, at most.
const FETCHES_WAITING_MAX: usize = 64;
/// Attempts after which a blob counts as out of reach, until a neighbour appears who may have it.
const FETCH_ATTEMPTS_MAX: u32 = 6;
/// Longest pause between two attempts to fetch one blob.
const FETCH_BACKOFF_MAX: Duration = Duration::from_secs(30);
/// Times in a row that a piece of a blob may be put off; then its holder counts as one that does not have it.
pub const POSTPONED_MAX: u32 = 8;
/// Pause after a piece of a blob was put off; it doubles...
const POSTPONED_PAUSE: Duration = Duration::from_millis(500);
/// ...so many times at most.
const POSTPONED_DOUBLINGS: u32 = 4;

/// A blob on its way, piece by piece.
#[derive(Clone, Debug)]
struct Fetch {
    /// The pieces that came, in order.
    got: Vec<u8>,
    /// The robot that made it.
    owner: RobotId,
    /// The question under way, if any.
    query: Option<QueryId>,
    /// Questions that failed so far.
    failures: u32,
    /// Not asked again before.
    not_before: Instant,
}

impl Fetch {
    /// A fetch of which nothing came yet and no peer is asked.
    fn new(owner: RobotId, now: Instant) -> Self {
        Self { got: Vec::new(), owner, query: None, failures: 0, not_before: now }
    }
}

/// See the module.
#[derive(Default)]
pub(super) struct Fetches {
    wanted: BTreeMap<Hash, Fetch>,
    /// Blobs that nobody in reach has: pairs that need them wait without counting as work.
    out_of_reach: BTreeSet<Hash>,
    /// Times in a row that the next piece of a blob was put off.
    postponed: BTreeMap<Hash, u32>,
}

impl Fetches {
    /// Has a blob fetched that `owner` made.
    pub(super) fn want(&mut self, hash: Hash, owner: RobotId, now: Instant) {
        self.wanted.entry(hash).or_insert_with(|| Fetch::new(owner, now));
    }

    /// Whether nothing is wanted.
    pub(super) fn is_empty(&self) -> bool {
        self.wanted.is_empty()
    }

    /// Stops fetching what is not to stay, but for what was asked for already.
    pub(super) fn drop_idle(&mut self, stays: impl Fn(&Hash) -> bool) {
        self.wanted.retain(|hash, fetch| fetch.query.is_some() || stays(hash));
    }

    /// When a blob is to be asked for that is not being asked for.
    pub(super) fn timeout(&self) -> Option<Instant> {
        self.wanted.values().filter(|fetch| fetch.query.is_none()).map(|fetch| fetch.not_before).min()
    }

    /// Pieces to ask for now, and how many questions more may be under way.
    pub(super) fn due(&self, now: Instant) -> (Vec<Lacking>, usize) {
        let idle = |fetch: &Fetch| fetch.query.is_none() && fetch.not_before <= now;
        let lacking = |(hash, fetch): (&Hash, &Fetch)| Lacking {
            hash: *hash,
            offset: fetch.got.len(),
            owner: fetch.owner,
            failures: fetch.failures,
        };
        let due = self.wanted.iter().filter(|(_, fetch)| idle(fetch)).map(lacking).collect();
        let asked = self.wanted.values().filter(|fetch| fetch.query.is_some()).count();
        (due, FETCHES_MAX.saturating_sub(asked))
    }

    /// The next piece of a blob was asked for, or is to be asked for later.
    pub(super) fn asked(&mut self, hash: Hash, asked: Result<QueryId, Instant>) {
        let Some(fetch) = self.wanted.get_mut(&hash) else { return };
        match asked {
            Ok(query) => fetch.query = Some(query),
            Err(later) => fetch.not_before = later,
        }
    }

    /// A piece of a blob came that is as its address says. Pieces may come from different robots. The next is not asked
    /// for before `next_piece`. All bytes, if it was the last.
    pub(super) fn on_piece(
        &mut self,
        query: QueryId,
        hash: Hash,
        (offset, total): (u32, u32),
        piece: &[u8],
        [now, next_piece]: [Instant; 2],
    ) -> Piece {
        let Some(fetch) = self.wanted.get_mut(&hash) else { return Piece::Taken };
        let left = (total as usize).saturating_sub(fetch.got.len());
        let goes_on = offset as usize == fetch.got.len() && left > 0;
        if !goes_on {
            return self.failed(query, now);
        }
        fetch.got.extend_from_slice(piece);
        self.postponed.remove(&hash);
        if fetch.got.len() < total as usize {
            fetch.query = None;
            fetch.not_before = next_piece;
            return Piece::Taken;
        }
        Piece::Last(core::mem::take(&mut fetch.got))
    }

    /// The holder of a blob has no room on its link: it is asked again after a pause, and after many counts as one that
    /// does not have it.
    pub(super) fn put_off_by_holder(&mut self, query: QueryId, hash: Hash, now: Instant) -> Piece {
        if !self.wanted.contains_key(&hash) {
            return Piece::Taken;
        }
        self.postponed.retain(|hash, _| self.wanted.contains_key(hash));
        let times = self.postponed.entry(hash).or_default();
        *times += 1;
        if *times > POSTPONED_MAX {
            self.postponed.remove(&hash);
            return self.failed(query, now);
        }
        let pause = POSTPONED_PAUSE * 2u32.pow((*times - 1).min(POSTPONED_DOUBLINGS));
        if let Some(fetch) = self.wanted.get_mut(&hash) {
            fetch.query = None;
            fetch.not_before = now.after(pause);
        }
        Piece::Taken
    }

    /// A blob is here, and can be read.
    pub(super) fn has_come(&mut self, hash: Hash) {
        self.wanted.remove(&hash);
    }

    /// What a blob says is known.
    pub(super) fn is_read(&mut self, hash: Hash) {
        self.out_of_reach.remove(&hash);
    }

    /// Whether nobody in reach has a blob.
    pub(super) fn is_out_of_reach(&self, hash: Hash) -> bool {
        self.out_of_reach.contains(&hash)
    }

    /// A robot came into reach that may have what nobody had.
    pub(super) fn on_neighbour(&mut self) {
        self.out_of_reach.clear();
    }

    /// Whether no further fetch is to be begun. Those that wait for a holder's link do not count, up to a limit: one
    /// neighbour that puts everything off must not keep us from the blobs of others.
    pub(super) fn are_enough(&self, now: Instant) -> bool {
        let live = self.wanted.values().filter(|fetch| fetch.query.is_some() || fetch.not_before <= now).count();
        live >= 2 * FETCHES_MAX || self.wanted.len() >= FETCHES_WAITING_MAX
    }

    /// A question for a piece was in vain. A blob that was asked for often enough counts as out of reach.
    pub(super) fn failed(&mut self, query: QueryId, now: Instant) -> Piece {
        let failed = self.wanted.iter_mut().find(|(_, fetch)| fetch.query == Some(query));
        let Some((&hash, fetch)) = failed else { return Piece::Taken };
        fetch.query = None;
        if fetch.failures + 1 >= FETCH_ATTEMPTS_MAX {
            self.wanted.remove(&hash);
            self.out_of_reach.insert(hash);
            return Piece::GivenUp;
        }
        fetch.failures = fetch.failures.saturating_add(1);
        let backoff = Duration::from_millis(500) * 2u32.pow(fetch.failures.min(7));
        fetch.not_before = now.after(backoff.min(FETCH_BACKOFF_MAX));
        Piece::Taken
    }
}

/// What came of a question for a piece of a blob.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Piece {
    /// It goes on, or is tried again.
    Taken,
    /// These are all bytes.
    Last(Vec<u8>),
    /// Nobody in reach has the blob.
    GivenUp,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fetches_that_wait_for_a_link_stop_no_others_up_to_a_limit() {
        let later = Instant::ZERO.after(Duration::from_secs(5));
        for (not_before, limit) in [(later, FETCHES_WAITING_MAX), (Instant::ZERO, 2 * FETCHES_MAX)] {
            let mut fetches = Fetches::default();
            for k in 0..limit {
                assert!(!fetches.are_enough(Instant::ZERO), "{k} of {limit}");
                let fetch = Fetch { not_before, ..Fetch::new(RobotId([2; 8]), Instant::ZERO) };
                fetches.wanted.insert(Hash::of(&k.to_le_bytes()), fetch);
            }
            assert!(fetches.are_enough(Instant::ZERO));
        }
    }

    #[test]
    fn a_failing_fetch_backs_off_and_is_given_up_at_the_bound() {
        let mut fetches = Fetches::default();
        let (hash, query) = (Hash::of(b"x"), QueryId(7));
        fetches.wanted.insert(hash, Fetch::new(RobotId([2; 8]), Instant::ZERO));
        let mut last = Duration::ZERO;
        for _ in 1..FETCH_ATTEMPTS_MAX {
            fetches.wanted.get_mut(&hash).unwrap().query = Some(query);
            fetches.failed(query, Instant::ZERO);
            let pause = fetches.wanted[&hash].not_before.since(Instant::ZERO);
            assert!(pause > last && pause <= FETCH_BACKOFF_MAX);
            last = pause;
        }
        assert!(!fetches.out_of_reach.contains(&hash));
        fetches.wanted.get_mut(&hash).unwrap().query = Some(query);
        fetches.failed(query, Instant::ZERO);
        assert!(fetches.wanted.is_empty() && fetches.out_of_reach.contains(&hash));
    }

    #[test]
    fn a_blob_that_is_put_off_is_asked_for_again_until_its_holder_counts_as_one_without_it() {
        let mut fetches = Fetches::default();
        let (hash, query) = (Hash::of(b"x"), QueryId(7));
        let mut fetch = Fetch::new(RobotId([2; 8]), Instant::ZERO);
        fetch.query = Some(query);
        fetches.wanted.insert(hash, fetch);
        let mut pauses = Vec::new();
        for _ in 0..POSTPONED_MAX {
            fetches.wanted.get_mut(&hash).unwrap().query = Some(query);
            fetches.put_off_by_holder(query, hash, Instant::ZERO);
            let fetch = &fetches.wanted[&hash];
            assert!(fetch.failures == 0 && fetch.query.is_none());
            pauses.push(fetch.not_before.since(Instant::ZERO).as_millis());
        }
        assert_eq!(pauses[..6], [500, 1_000, 2_000, 4_000, 8_000, 8_000]);
        fetches.wanted.get_mut(&hash).unwrap().query = Some(query);
        fetches.put_off_by_holder(query, hash, Instant::ZERO);
        assert_eq!(fetches.wanted[&hash].failures, 1);
        fetches.postponed.remove(&hash);
        fetches.put_off_by_holder(query, hash, Instant::ZERO);
        assert_eq!(fetches.wanted[&hash].not_before.since(Instant::ZERO).as_millis(), 500);
    }
}
