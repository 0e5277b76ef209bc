//! Clouds that more than one robot states as its own. Points carry the noise of whoever saw them, so that no two robots
//! have a cloud alike to the bit, nor summaries of clouds: one of the two copied, and what a copy is aligned with says
//! nothing of where its robot was.
//!
//! The facts alone do not tell who copied, for a liar dates its own as it likes. Hence two rules:
//! - In the map, which is a function of the facts, no alignment of two robots counts if one of them states as its own
//!   what the other's submap shows. Whoever copies thus unties itself from those whom it copied, and from nobody else
//!   anything that these measured.
//! - Whoever negotiates believes the robot that it heard first, itself before all, and aligns no copy.

use super::knowledge::Known;
use crate::ids::{Hash, RobotId, SubmapId};
use crate::time::Stamp;
use std::collections::{BTreeMap, BTreeSet};

/// Keypoints of a blob from which on two alike are no chance: fewer may round to the same.
const KEYPOINTS_OF_BLOB_MIN: u16 = 3;
/// The same of a summary, which is no more than 128 levels.
const KEYPOINTS_OF_SUMMARY_MIN: u16 = 16;
/// Looks remembered for each submap that is held, before those that nobody states any more are forgotten.
const REMEMBERED_PER_SUBMAP: usize = 4;
/// The same in addition.
const REMEMBERED_MIN: usize = 1024;

/// What a submap shows, as far as it can be compared: the beginning of its blob's address, or of its summary's digest.
/// 64 bits: whoever can find another cloud of the same beginning in 2⁶⁴ tries may be called a copier.
type Look = u64;

/// What a submap shows, and whether its robot states enough of it to call others copiers.
fn looks(known: &Known) -> impl Iterator<Item = (Look, bool)> {
    let begin = |Hash(hash): Hash| u64::from_le_bytes([0, 1, 2, 3, 4, 5, 6, 7].map(|k: usize| hash[k]));
    let summary = known.summary.as_ref().and_then(|summary| summary.shares());
    let summary = summary.map(|shares| (begin(Hash::of(shares)), known.keypoints >= KEYPOINTS_OF_SUMMARY_MIN));
    [(begin(known.blob), known.keypoints >= KEYPOINTS_OF_BLOB_MIN)].into_iter().chain(summary)
}

/// Who was first heard to state a cloud.
#[derive(Clone, Debug, Default)]
pub(super) struct FirstHeard {
    by: BTreeMap<Look, RobotId>,
    /// How many submaps a robot stated whose looks another had stated.
    copied: BTreeMap<CopiedFrom, u64>,
}

/// Who states clouds as its own, and who stated them before.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(in crate::agent) struct CopiedFrom {
    pub(in crate::agent) by: RobotId,
    pub(in crate::agent) of: RobotId,
}

impl FirstHeard {
    /// A robot states a submap.
    pub(super) fn hear(&mut self, robot: RobotId, known: &Known) {
        if let Some(of) = self.before(robot, known) {
            *self.copied.entry(CopiedFrom { by: robot, of }).or_default() += 1;
        }
        for (look, _) in looks(known).filter(|(_, says)| *says) {
            self.by.entry(look).or_insert(robot);
        }
    }

    /// Who states others' clouds as its own, whose, and of how many submaps.
    pub(super) fn copied(&self) -> impl Iterator<Item = (CopiedFrom, u64)> {
        self.copied.iter().map(|(from, count)| (*from, *count))
    }

    /// Who stated before this robot what its submap shows.
    pub(super) fn before(&self, robot: RobotId, known: &Known) -> Option<RobotId> {
        looks(known).filter_map(|(look, _)| self.by.get(&look).copied()).find(|first| *first != robot)
    }

    /// The order that facts came in was not kept: this robot's own count before all, then what is dated earlier.
    pub(super) fn by_stamp<'k>(me: RobotId, all: impl Iterator<Item = (SubmapId, &'k Known)>) -> Self {
        let mut all: Vec<(bool, Stamp, SubmapId, &Known)> =
            all.map(|(id, known)| (id.frame.robot != me, known.stamps[1], id, known)).collect();
        all.sort_by_key(|(foreign, stamp, id, _)| (*foreign, *stamp, *id));
        let mut out = Self::default();
        all.into_iter().for_each(|(_, _, id, known)| out.hear(id.frame.robot, known));
        out
    }

    /// Forgets what is not stated any more, once that may be most.
    pub(super) fn prune<'k>(&mut self, submaps: usize, all: impl Iterator<Item = &'k Known>) {
        if self.by.len() > REMEMBERED_PER_SUBMAP * submaps + REMEMBERED_MIN {
            let stated: BTreeSet<Look> = all.flat_map(looks).map(|(look, _)| look).collect();
            self.by.retain(|look, _| stated.contains(look));
        }
    }
}

/// What several robots state, by all facts held.
#[derive(Debug, Default)]
pub(in crate::agent) struct Copies(BTreeMap<Look, BTreeSet<RobotId>>);

impl Copies {
    /// Of all these submaps.
    pub(super) fn among<'k>(all: impl Iterator<Item = (SubmapId, &'k Known)>) -> Self {
        let stated =
            |(id, known): (SubmapId, &'k Known)| looks(known).map(move |(look, says)| (look, id.frame.robot, says));
        let mut stated: Vec<(Look, RobotId, bool)> = all.flat_map(stated).collect();
        stated.sort_unstable();
        let several = stated.chunk_by(|a, b| a.0 == b.0).filter_map(|alike| {
            let robots: BTreeSet<RobotId> = alike.iter().map(|(_, robot, _)| *robot).collect();
            (robots.len() > 1 && alike.iter().any(|(_, _, says)| *says)).then(|| (alike[0].0, robots))
        });
        Self(several.collect())
    }

    /// Whether one of the two robots states as its own what the other's submap shows.
    pub(in crate::agent) fn void(&self, [i, j]: [(SubmapId, &Known); 2]) -> bool {
        let shown_by = |(id, known): (SubmapId, &Known), other: RobotId| {
            id.frame.robot != other
                && looks(known).any(|(look, _)| self.0.get(&look).is_some_and(|s| s.contains(&other)))
        };
        !self.0.is_empty() && (shown_by(i, j.0.frame.robot) || shown_by(j, i.0.frame.robot))
    }
}

#[cfg(test)]
#[path = "copies_tests.rs"]
mod tests;
