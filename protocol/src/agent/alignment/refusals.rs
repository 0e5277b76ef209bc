//! Pairs of submaps that were tried and refused, kept over restarts: no pair is tried twice on the same evidence, which
//! is the two submaps' keypoints and how they are looked at. A submap never changes, so new evidence is another submap
//! under the same id (the log that stated it was lost, or is in quarantine), another configuration, or an aligner that
//! was made better.
//!
//! A refusal that is lost costs a try and no truth. So nothing waits for it, and it waits itself, for other records to
//! go to the disk with or until there are several: a commit for each would wear small disks out.

use crate::agent::io::Record;
use crate::agent::replication::knowledge::{Knowledge, Pair};
use crate::config::{AlignConfig, Config, SubmapConfig};
use crate::ids::Hash;
use std::collections::BTreeMap;

/// Refused pairs kept on the disk, of about 100 bytes each. Further ones are tried again after a restart.
pub const REFUSED_MAX: usize = 32_768;
/// Refusals that wait for other records to go to the disk with; a kill loses fewer than these.
pub const REFUSED_WAITING_MAX: usize = 16;

/// To be raised when pairs that were refused may be aligned by a later version.
const ALIGNER: u32 = 2;

/// See the module.
pub(super) struct Refusals {
    /// A digest of how pairs are looked at.
    how: Hash,
    /// What each refusal on the disk, or on its way there, rests on.
    held: BTreeMap<Pair, u64>,
    waiting: Vec<Record>,
}

impl Refusals {
    /// None yet.
    pub fn new(config: &Config) -> Self {
        Self { how: how(config), held: BTreeMap::new(), waiting: Vec::new() }
    }

    /// Takes what the disk held. What is too much, or no pair, goes off it.
    pub fn restore(&mut self, refused: Vec<(Pair, u64)>) {
        for (pair, evidence) in refused {
            if pair.0 < pair.1 && self.has_room(pair) {
                self.held.insert(pair, evidence);
            } else {
                self.waiting.push(counts_no_more(pair));
            }
        }
    }

    /// So many wait that they go to the disk by themselves.
    pub fn are_many(&self) -> bool {
        self.waiting.len() >= REFUSED_WAITING_MAX
    }

    fn has_room(&self, pair: Pair) -> bool {
        self.held.len() < REFUSED_MAX || self.held.contains_key(&pair)
    }

    /// A pair was refused on this evidence.
    pub fn add(&mut self, pair: Pair, evidence: u64) {
        if self.has_room(pair) && self.held.insert(pair, evidence) != Some(evidence) {
            self.waiting.push(Record::Refused { i: pair.0, j: pair.1, evidence: Some(evidence) });
        }
    }

    /// Takes pairs off the list, and off the disk.
    pub fn forget(&mut self, gone: &[Pair]) {
        for pair in gone.iter().filter(|pair| self.held.remove(pair).is_some()) {
            self.waiting.push(counts_no_more(*pair));
        }
    }

    /// All pairs held.
    pub fn pairs(&self) -> impl Iterator<Item = Pair> {
        self.held.keys().copied()
    }

    /// Those that wait go to the disk with whatever else does now.
    pub fn save(&mut self, mut keep: impl FnMut(Record)) {
        self.waiting.drain(..).for_each(&mut keep);
    }

    /// A digest of what a try of this pair rests on; `None` if a submap of it is not known.
    pub fn evidence(&self, knowledge: &Knowledge, (i, j): Pair) -> Option<u64> {
        let blob = |id| knowledge.submap(id).map(|known| known.blob);
        let Hash(digest) = Hash::of(&[self.how.0, blob(i)?.0, blob(j)?.0].concat());
        Some(u64::from_le_bytes(*digest.first_chunk()?))
    }

    /// The pairs of which this is so.
    pub fn which(&self, is_so: impl Fn(Pair, u64) -> bool) -> Vec<Pair> {
        let pairs = self.held.iter().map(|(pair, evidence)| (*pair, *evidence));
        pairs.filter(|(pair, evidence)| is_so(*pair, *evidence)).map(|(pair, _)| pair).collect()
    }
}

fn counts_no_more((i, j): Pair) -> Record {
    Record::Refused { i, j, evidence: None }
}

/// All knobs that an alignment turns on.
fn how(config: &Config) -> Hash {
    let AlignConfig { sigma_max_voxels, log10_nfa_max, support_min, fit_min, .. } = &config.align;
    let SubmapConfig { sensor, voxel_m, scale, .. } = &config.submap;
    let numbers = [sigma_max_voxels, log10_nfa_max, support_min, fit_min, voxel_m];
    Hash::of(format!("{ALIGNER} {sensor:?} {scale:?} {numbers:?}").as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{FrameId, RobotId, SubmapId};

    fn pair(index: u32) -> Pair {
        let submap = |robot, index| SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, index };
        (submap(1, 0), submap(2, index))
    }

    #[test]
    fn as_many_are_kept_as_the_limit_says_and_what_goes_makes_room() {
        let max = REFUSED_MAX as u32;
        let mut refusals = Refusals::new(&Config::default());
        (0..max - 1).for_each(|index| refusals.add(pair(index), 7));
        assert_eq!(refusals.waiting.len(), REFUSED_MAX - 1);
        (0..3).for_each(|_| refusals.add(pair(max - 1), 7));
        refusals.add(pair(max), 7);
        assert_eq!((refusals.waiting.len(), refusals.held.len()), (REFUSED_MAX, REFUSED_MAX), "and one record each");
        refusals.add(pair(0), 8);
        assert_eq!(refusals.held[&pair(0)], 8, "known pairs take no room");
        assert_eq!(refusals.which(|one, _| one == pair(5)), [pair(5)]);
        (0..2).for_each(|_| refusals.forget(&[pair(5)]));
        assert_eq!(refusals.waiting.len(), REFUSED_MAX + 2, "one changed, one gone");
        assert_eq!(refusals.waiting.last(), Some(&counts_no_more(pair(5))));
        refusals.add(pair(max), 7);
        assert!(refusals.held.contains_key(&pair(max)));
    }

    #[test]
    fn of_a_disk_that_holds_too_many_the_rest_goes() {
        let mut refusals = Refusals::new(&Config::default());
        let backwards = (pair(0).1, pair(0).0);
        refusals.restore((0..REFUSED_MAX as u32 + 1).map(|index| (pair(index), 7)).chain([(backwards, 7)]).collect());
        assert_eq!(refusals.held.len(), REFUSED_MAX);
        assert_eq!(refusals.waiting, [counts_no_more(pair(REFUSED_MAX as u32)), counts_no_more(backwards)]);
    }

    #[test]
    fn only_several_go_to_the_disk_by_themselves() {
        let mut refusals = Refusals::new(&Config::default());
        (0..REFUSED_WAITING_MAX as u32 - 1).for_each(|index| refusals.add(pair(index), 7));
        assert!(!refusals.are_many());
        refusals.add(pair(99), 7);
        assert!(refusals.are_many());
    }

    #[test]
    fn what_an_alignment_turns_on_is_evidence_and_nothing_else() {
        let changed = |change: fn(&mut Config)| {
            let mut config = Config::default();
            change(&mut config);
            how(&config) != how(&Config::default())
        };
        assert!(changed(|config| config.align.fit_min = 0.1) && changed(|config| config.submap.voxel_m = 0.3));
        assert!(
            !changed(|config| config.align.jobs_max = 7) && !changed(|config| config.gossip.epochs_per_robot_max = 3)
        );
    }
}
