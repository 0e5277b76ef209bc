//! Robots whose own statements do not fit together as others see them. Where two frames' alignments contradict one
//! another, the odometry of either is wrong, or far less certain than it says; one pair does not tell whose. A robot of
//! which several such pairs are, with others that agree among themselves, is the better explanation than all of these.

use super::ids::RobotId;
use super::kinds::PairStatus;
use super::pairs::PairEstimate;
use std::collections::BTreeMap;

/// Others with whom a robot's alignments contradict one another, from which on it is the likelier cause: as many as
/// causes that [`blame`](super::blame) looks for.
const OTHERS_MIN: usize = 3;

/// With how many others a robot's alignments are in one piece, and with how many they contradict one another.
#[derive(Clone, Copy, Default)]
struct Fit {
    merged: usize,
    contradict: usize,
}

/// Robots that do not fit, and with how many others.
pub fn misfits(pairs: &[PairEstimate]) -> BTreeMap<RobotId, usize> {
    let mut fits: BTreeMap<RobotId, Fit> = BTreeMap::new();
    for pair in pairs {
        for robot in [pair.a.robot, pair.b.robot] {
            let fit = fits.entry(robot).or_default();
            fit.merged += usize::from(pair.status == PairStatus::Merged);
            fit.contradict += usize::from(contradicts_itself(pair));
        }
    }
    let fits_well = |robot: &RobotId| fits.get(robot).is_some_and(|fit| fit.merged > fit.contradict);
    let others = |robot: RobotId| {
        let others = pairs.iter().filter(|pair| contradicts_itself(pair)).filter_map(|pair| match pair.a.robot {
            a if a == robot => Some(pair.b.robot),
            a => (pair.b.robot == robot).then_some(a),
        });
        others.filter(fits_well).count()
    };
    let odd = fits.iter().filter(|(_, fit)| fit.contradict >= OTHERS_MIN && fit.contradict > fit.merged);
    odd.map(|(robot, _)| (*robot, others(*robot))).filter(|(_, others)| *others >= OTHERS_MIN).collect()
}

/// Both ends measured alignments, and these do not fit together.
fn contradicts_itself(pair: &PairEstimate) -> bool {
    let odd = matches!(pair.status, PairStatus::Inconsistent | PairStatus::Ambiguous);
    odd && pair.blame.is_none() && pair.a.robot != pair.b.robot
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_graphs::frame;

    /// All pairs of so many robots; `of` says what each is.
    fn pairs(robots: u8, of: impl Fn(u8, u8) -> PairStatus) -> Vec<PairEstimate> {
        let all = (0..robots).flat_map(|a| (a + 1..robots).map(move |b| (a, b)));
        all.map(|(a, b)| PairEstimate {
            a: frame(a),
            b: frame(b),
            status: of(a, b),
            agreed: 5,
            used: 5,
            log10_nfa: None,
            t_a_b: None,
            middle: None,
            blame: None,
        })
        .collect()
    }

    fn odd(robots: u8, of: impl Fn(u8, u8) -> PairStatus) -> Vec<u8> {
        misfits(&pairs(robots, of)).keys().map(|robot| robot.0[0]).collect()
    }

    #[test]
    fn one_that_fits_with_none_of_three_who_agree_is_named() {
        use PairStatus::{Inconsistent, Merged, Provisional};
        assert_eq!(odd(4, |a, _| if a == 0 { Inconsistent } else { Merged }), [0]);
        let with_two = |a: u8, b: u8| match (a, b) {
            (0, 3) => Provisional,
            (0, _) => Inconsistent,
            _ => Merged,
        };
        assert_eq!(odd(4, with_two), [0; 0], "two are too few");
        assert_eq!(odd(4, |_, _| Inconsistent), [0; 0], "where nobody fits, nobody is named");
        assert_eq!(odd(8, |a, b| if a < 3 && b >= 3 { Inconsistent } else { Merged }), [0, 1, 2]);
        assert_eq!(odd(4, |a, _| if a == 0 { Provisional } else { Merged }), [0; 0], "too little is no contradiction");
    }

    /// Half of the robots are in a hall that repeats itself: all their pairs are ambiguous, and that is nobody's fault.
    #[test]
    fn a_place_that_repeats_itself_makes_nobody_suspect() {
        let in_hall = |a: u8, b: u8| if a < 4 && b < 4 { PairStatus::Ambiguous } else { PairStatus::Merged };
        assert_eq!(odd(8, in_hall), [0; 0]);
    }
}
