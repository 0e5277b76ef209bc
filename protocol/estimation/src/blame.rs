//! Who is to blame where ties of frames contradict one another. What one robot states of itself has one witness, however
//! often it is stated, so that how strong a tie is decides nothing here: a liar's may be the strongest of all.
//!
//! Ties contradict one another where a loop of them does not close (χ², 99.99 %). What explains that is the fewest causes
//! without which every loop closes; a cause is one tie that is wrong, or one robot that is, with all its ties. Where one
//! explanation is the best, what it blames is left out. Where several are equally good, as in a lone loop of three,
//! nobody can know: all that any of them blames is left out, and no tie is kept at another's cost.

use super::forest::{Forest, Tie};
use super::geometry::{Disagreement, chi2};
use super::ids::{FrameId, RobotId};
use std::collections::{BTreeMap, BTreeSet};

/// Causes at most for which an explanation is looked for; of more, every loop that does not close is left out.
const CAUSES_MAX: usize = 3;
/// Ties looked at in the search, counted as often as they are: of about 30, each choice of three causes; of hundreds,
/// each choice of one.
const WORK_MAX: usize = 60_000;

/// What is left out, and whose fault it may be.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Blame {
    /// Robots of which at least one is wrong, ascending.
    pub robots: Vec<RobotId>,
    /// Nothing but these explains it as well: all of them are wrong.
    pub certain: bool,
}

/// Ties without contradictions.
pub(super) struct Settled {
    /// Those that hold all frames together.
    pub(super) tree: BTreeSet<usize>,
    /// Those left out.
    pub(super) out: BTreeMap<usize, Blame>,
}

/// Settles contradictions among ties, which are given from the strongest to the weakest.
pub(super) fn settle(ties: &[Tie]) -> Settled {
    let mut out = BTreeMap::new();
    for island in islands(ties) {
        let mut search = Search { ties, island: &island, work: 0, seen: BTreeSet::new(), found: BTreeMap::new() };
        out.extend(search.settle());
    }
    let left: BTreeSet<usize> = (0..ties.len()).filter(|k| !out.contains_key(k)).collect();
    let tree = grow(ties, left.iter().copied()).unwrap_or_default();
    Settled { tree, out }
}

/// The ties of each set of frames that are tied together: what one does is no other's fault.
fn islands(ties: &[Tie]) -> Vec<Vec<usize>> {
    let mut forest = Forest::default();
    for (k, tie) in ties.iter().enumerate() {
        if forest.way(tie.a, tie.b).is_none() {
            forest.add(k, tie);
        }
    }
    let mut by_root: BTreeMap<FrameId, Vec<usize>> = BTreeMap::new();
    let mut root_of: BTreeMap<FrameId, FrameId> = BTreeMap::new();
    for (k, tie) in ties.iter().enumerate() {
        if !root_of.contains_key(&tie.a) {
            root_of.extend(forest.reach(tie.a).into_keys().map(|frame| (frame, tie.a)));
        }
        by_root.entry(root_of[&tie.a]).or_default().push(k);
    }
    by_root.into_values().collect()
}

/// Takes ties into a forest in their order. The tree, or the first loop that does not close.
fn grow(ties: &[Tie], numbers: impl Iterator<Item = usize>) -> Result<BTreeSet<usize>, Vec<usize>> {
    let (mut forest, mut tree) = (Forest::default(), BTreeSet::new());
    for k in numbers {
        let tie = &ties[k];
        match forest.way(tie.a, tie.b) {
            None => {
                forest.add(k, tie);
                tree.insert(k);
            }
            Some(way) if agree(&way.t_from_to.disagreement(&tie.t_a_b)) => {}
            Some(way) => return Err(way.ties.into_iter().chain([k]).collect()),
        }
    }
    Ok(tree)
}

fn agree(d: &Disagreement) -> bool {
    d.distance_squared <= chi2::P9999[5 + usize::from(d.degrees_of_freedom == 7)]
}

/// A search for the fewest causes.
struct Search<'a> {
    ties: &'a [Tie],
    island: &'a [usize],
    work: usize,
    /// Sets of ties that were left out for a try, with how many causes were left to find.
    seen: BTreeSet<(BTreeSet<usize>, usize)>,
    /// What was left out where every loop closed, and the robots of each cause.
    found: BTreeMap<BTreeSet<usize>, BTreeSet<BTreeSet<RobotId>>>,
}

impl Search<'_> {
    fn settle(&mut self) -> BTreeMap<usize, Blame> {
        for causes in 0..=CAUSES_MAX {
            self.look(&BTreeSet::new(), &BTreeSet::new(), causes);
            if !self.found.is_empty() {
                return self.verdict();
            }
        }
        self.all_that_do_not_close()
    }

    /// Leaves out, beside `out`, what so many causes explain.
    fn look(&mut self, out: &BTreeSet<usize>, robots: &BTreeSet<BTreeSet<RobotId>>, causes: usize) {
        if self.work > WORK_MAX || (causes > 0 && !self.seen.insert((out.clone(), causes))) {
            return;
        }
        self.work += self.island.len();
        match grow(self.ties, self.island.iter().copied().filter(|k| !out.contains(k))) {
            Ok(_) => self.found.entry(out.clone()).or_default().extend(robots.iter().cloned()),
            Err(_) if causes == 0 => {}
            Err(open) => {
                for (blamed, cause) in self.causes_of(&open) {
                    let robots = robots.iter().cloned().chain([blamed]).collect();
                    self.look(&out.union(&cause).copied().collect(), &robots, causes - 1);
                }
            }
        }
    }

    /// What a loop that does not close may be due to: the robots that may be to blame, and the ties that go with them.
    fn causes_of(&self, open: &[usize]) -> Vec<(BTreeSet<RobotId>, BTreeSet<usize>)> {
        let of_tie = |k: &usize| (robots_of(&self.ties[*k]), BTreeSet::from([*k]));
        let all: BTreeSet<RobotId> = open.iter().flat_map(|k| robots_of(&self.ties[*k])).collect();
        let ties_of = |robot: &RobotId| {
            let its = self.island.iter().copied().filter(|k| robots_of(&self.ties[*k]).contains(robot));
            (BTreeSet::from([*robot]), its.collect())
        };
        open.iter().map(of_tie).chain(all.iter().map(ties_of)).collect()
    }

    /// Of explanations with equally many causes, those that leave out no more than another; if several are left, all.
    fn verdict(&self) -> BTreeMap<usize, Blame> {
        let is_least = |out: &BTreeSet<usize>| !self.found.keys().any(|less| less != out && less.is_subset(out));
        let least: Vec<_> = self.found.iter().filter(|(out, _)| is_least(out)).collect();
        let robots: BTreeSet<RobotId> = least.iter().flat_map(|(_, causes)| causes.iter().flatten().copied()).collect();
        // The robots of one explanation are known to be wrong if each of its causes is one robot.
        let certain = matches!(&least[..], [(_, causes)] if causes.iter().all(|cause| cause.len() == 1));
        let blame = Blame { robots: robots.into_iter().collect(), certain };
        least.iter().flat_map(|(out, _)| out.iter()).map(|k| (*k, blame.clone())).collect()
    }

    /// Every loop that does not close, one after the other.
    fn all_that_do_not_close(&self) -> BTreeMap<usize, Blame> {
        let (mut out, mut robots) = (BTreeSet::new(), BTreeSet::new());
        while let Err(open) = grow(self.ties, self.island.iter().copied().filter(|k| !out.contains(k))) {
            robots.extend(open.iter().flat_map(|k| robots_of(&self.ties[*k])));
            out.extend(open);
        }
        let blame = Blame { robots: robots.into_iter().collect(), certain: false };
        out.into_iter().map(|k| (k, blame.clone())).collect()
    }
}

fn robots_of(tie: &Tie) -> BTreeSet<RobotId> {
    BTreeSet::from([tie.a.robot, tie.b.robot])
}

#[cfg(test)]
#[path = "blame_tests.rs"]
mod tests;
