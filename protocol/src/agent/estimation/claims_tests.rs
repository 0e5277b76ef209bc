use super::*;
use crate::estimate::test_graphs::{frame, sigmas};
use crate::geometry::{PoseWithCovariance, Se3, So3};
use crate::ids::RobotId;
use nalgebra::Vector3;

/// The first two frames, so far apart and so well known.
fn pair(status: PairStatus, x: f64, sigma: f64) -> PairEstimate {
    let pose = Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0));
    let t_a_b = Relative::Metric(PoseWithCovariance { pose, covariance: sigmas(sigma, 0.1) });
    let (a, b) = (frame(0), frame(1));
    PairEstimate { a, b, status, agreed: 3, used: 3, log10_nfa: None, t_a_b: Some(t_a_b), middle: None, blame: None }
}

fn merged(x: f64, sigma: f64) -> PairEstimate {
    pair(PairStatus::Merged, x, sigma)
}

/// χ² of six values is 22.46 at 99.9 %: 4.74 standard deviations along one axis.
#[test]
fn what_moves_by_more_than_was_claimed_is_told_and_claimed_anew() {
    for (x, told) in [(0.47, false), (0.48, true)] {
        let mut claims = Claims::default();
        assert!(claims.renew(&[merged(0.0, 0.1)]).is_empty());
        let changes = claims.renew(&[merged(x, 0.1)]);
        assert_eq!(changes, if told { vec![Change::Moved(frame(0), frame(1), x)] } else { vec![] });
        assert!(claims.renew(&[merged(x, 0.1)]).is_empty());
    }
}

#[test]
fn what_moves_little_by_little_is_noticed() {
    let mut claims = Claims::default();
    let moved = (0..10).map(|k| claims.renew(&[merged(0.1 * f64::from(k), 0.1)]).len());
    assert_eq!(moved.sum::<usize>(), 1);
}

#[test]
fn a_tighter_claim_takes_the_place_of_a_looser_one_and_not_the_other_way() {
    let mut claims = Claims::default();
    let mut told = |x: f64, sigma: f64| !claims.renew(&[merged(x, sigma)]).is_empty();
    assert!(!told(0.0, 0.1) && !told(0.02, 0.01) && !told(0.02, 1.0));
    assert!(told(0.12, 1.0), "ten standard deviations of the tightest claim");
}

#[test]
fn a_pair_that_is_no_longer_merged_is_told_whatever_it_is_now() {
    let (a, b) = (frame(0), frame(1));
    for now in [None, Some(PairStatus::Provisional), Some(PairStatus::Inconsistent)] {
        let mut claims = Claims::default();
        claims.renew(&[merged(0.0, 0.1)]);
        let pairs: Vec<PairEstimate> = now.map(|status| pair(status, 0.0, 0.1)).into_iter().collect();
        assert_eq!(claims.renew(&pairs), [Change::Unmerged(a, b, now)]);
        assert!(claims.renew(&pairs).is_empty() && claims.renew(&[merged(9.0, 0.1)]).is_empty());
    }
}

#[test]
fn whom_contradictions_are_due_to_is_told_once() {
    let blame = |robots: &[u8]| Blame { robots: robots.iter().map(|k| RobotId([*k; 8])).collect(), certain: false };
    let blamed =
        |robots: &[u8]| PairEstimate { blame: Some(blame(robots)), ..pair(PairStatus::Inconsistent, 0.0, 0.1) };
    let mut claims = Claims::default();
    assert_eq!(claims.renew(&[blamed(&[0, 1]), blamed(&[0, 1])]), [Change::Contradict(blame(&[0, 1]))]);
    assert!(claims.renew(&[blamed(&[0, 1])]).is_empty());
    assert_eq!(claims.renew(&[blamed(&[0, 1, 2])]), [Change::Contradict(blame(&[0, 1, 2]))]);
    assert!(claims.renew(&[]).is_empty());
}

#[test]
fn who_does_not_fit_is_told_once() {
    let all = |odd: bool| -> Vec<PairEstimate> {
        let pairs = (0..4).flat_map(|a| (a + 1..4).map(move |b| (a, b)));
        let status = |a| if a == 0 && odd { PairStatus::Inconsistent } else { PairStatus::Merged };
        pairs.map(|(a, b)| PairEstimate { a: frame(a), b: frame(b), ..pair(status(a), 0.0, 0.1) }).collect()
    };
    let mut claims = Claims::default();
    assert_eq!(claims.renew(&all(true)), [Change::Misfit(frame(0).robot, 3)]);
    assert!(claims.renew(&all(true)).is_empty() && claims.renew(&all(false)).is_empty());
    assert!(claims.renew(&all(true)).contains(&Change::Misfit(frame(0).robot, 3)));
}
