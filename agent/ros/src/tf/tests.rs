//! The tree against chains that are known, loops and gaps.

use super::{TfError, TfTree};
use crate::limits::{CHAIN_MAX, FRAME_BYTES_MAX, FRAMES_MAX, LATE_MAX, REORDER_NS_MAX};
use crate::msg::{Header, Quaternion, TfMessage, Transform, TransformStamped, Vector3};
use merganser_geometry::Se3;
use nalgebra::Vector6;
use proptest::prelude::*;

fn link(parent: &str, child: &str, stamp_ns: i64, t: &Se3) -> TransformStamped {
    let ([x, y, z, w], p) = (t.rotation.xyzw(), t.translation);
    TransformStamped {
        header: Header { stamp_ns, frame_id: parent.into() },
        child_frame_id: child.into(),
        transform: Transform { translation: Vector3 { x: p.x, y: p.y, z: p.z }, rotation: Quaternion { x, y, z, w } },
    }
}

fn pose(x: f64, yaw: f64) -> Se3 {
    Se3::exp(&Vector6::new(x, 0.1, -0.2, 0.1, 0.0, yaw))
}

fn near(a: &Se3, b: &Se3) -> bool {
    a.local(b).norm() < 1e-9
}

fn tree(links: &[TransformStamped], is_fixed: bool) -> TfTree {
    let mut tree = TfTree::default();
    links.iter().for_each(|link| tree.insert(link, is_fixed).unwrap());
    tree
}

const SEC: i64 = 1_000_000_000;

proptest! {
    /// A chain of frames, some of which are named the other way round, is the product of its links, either way.
    #[test]
    fn a_chain_is_the_product_of_its_links(
        links in prop::collection::vec((prop::array::uniform6(-1.5..1.5_f64), any::<bool>(), any::<bool>()), 1..8),
        slash: bool,
    ) {
        let mut tree = TfTree::default();
        let mut product = Se3::identity();
        for (k, (xi, turned, is_fixed)) in links.iter().enumerate() {
            let t = Se3::exp(&Vector6::from(*xi));
            let name = |k: usize| if slash { format!("/f{k}") } else { format!("f{k}") };
            let (a, b) = (name(k), name(k + 1));
            let stated = if *turned { link(&b, &a, 5, &t.inverse()) } else { link(&a, &b, 5, &t) };
            tree.insert(&stated, *is_fixed).unwrap();
            product = product * t;
        }
        let last = format!("f{}", links.len());
        prop_assert!(near(&tree.lookup("f0", &last, 99).unwrap(), &product));
        prop_assert!(near(&tree.lookup(&last, "f0", 99).unwrap(), &product.inverse()));
    }

    /// Interpolation meets its ends, turns at a constant rate, and does not depend on the order of arrival.
    #[test]
    fn what_moves_is_interpolated(a in -1.0..1.0_f64, b in -1.0..1.0_f64, share in 0.0..1.0_f64, late: bool) {
        let (from, to) = (pose(a, a), pose(b, 2.0 * b));
        let mut links = [link("odom", "base", 0, &from), link("odom", "base", SEC, &to)];
        if late {
            links.reverse();
        }
        let tree = tree(&links, false);
        let at = (share * SEC as f64) as i64;
        let t = tree.lookup("odom", "base", at).unwrap();
        let share = at as f64 / SEC as f64;
        prop_assert!((t.translation - from.translation.lerp(&to.translation, share)).norm() < 1e-9);
        prop_assert!(t.rotation.local(&from.rotation.interpolate(&to.rotation, share)).norm() < 1e-9);
        prop_assert!(near(&tree.lookup("odom", "base", 0).unwrap(), &from));
        prop_assert!(near(&tree.lookup("odom", "base", SEC).unwrap(), &to));
    }
}

#[test]
fn outside_and_in_gaps_there_is_nothing() {
    let links = [(0, 0.0), (SEC, 1.0), (2 * SEC + 1, 2.0)].map(|(at, x)| link("odom", "base", at, &pose(x, x)));
    let tree = tree(&links, false);
    for at_ns in [-1, 2 * SEC + 2] {
        let error = tree.lookup("odom", "base", at_ns).unwrap_err();
        assert!(matches!(error, TfError::Time { first_ns: 0, last_ns, .. } if last_ns == 2 * SEC + 1), "{error}");
    }
    assert!(tree.lookup("odom", "base", SEC / 2).is_ok(), "a gap of a second is bridged");
    let error = tree.lookup("odom", "base", SEC + 1).unwrap_err();
    assert_eq!(error.to_string(), "odom → base has a gap of 1000 ms; across 1 s at most it is interpolated");
    assert!(tree.lookup("odom", "base", SEC).is_ok());
}

/// A robot_state_publisher of old sends fixed joints over and over.
#[test]
fn what_never_moved_is_known_at_any_time_and_takes_little_room() {
    let t = pose(1.0, 0.5);
    let links: Vec<_> = (0..5000).map(|k| link("base", "laser", k * SEC, &t)).collect();
    let mut tree = tree(&links, false);
    assert_eq!(tree.transforms, 2);
    assert!(near(&tree.lookup("base", "laser", -7).unwrap(), &t) && tree.is_fixed("base", "laser"));
    // Once it moves, it is known then alone; while it rested it rests, however long.
    tree.insert(&link("base", "laser", 5001 * SEC, &pose(2.0, 0.5)), false).unwrap();
    assert!(!tree.is_fixed("base", "laser") && tree.lookup("base", "laser", -7).is_err());
    assert!(near(&tree.lookup("base", "laser", 2500 * SEC).unwrap(), &t));
}

#[test]
fn a_frame_may_lie_in_two_and_the_shortest_way_is_taken() {
    let (base, foot) = (pose(1.0, 0.3), pose(1.0, 0.0));
    let mut tree = tree(&[link("odom", "base", 0, &base), link("odom", "foot", 0, &foot)], false);
    tree.insert(&link("base", "foot", 0, &pose(0.0, 0.1)), true).unwrap();
    assert!(near(&tree.lookup("odom", "base", 0).unwrap(), &base));
    assert!(near(&tree.lookup("base", "foot", 0).unwrap(), &pose(0.0, 0.1)));
    assert!(near(&tree.lookup("odom", "foot", 0).unwrap(), &foot));
}

#[test]
fn loops_are_named_and_left_out() {
    let t = pose(1.0, 0.0);
    let mut tree = tree(&[link("a", "b", 0, &t), link("b", "c", 0, &t)], true);
    let error = tree.insert(&link("c", "a", 0, &t), true).unwrap_err();
    assert_eq!(error.to_string(), "TF loop: a → b → c → a; these links are left out");
    let error = tree.insert(&link("b", "a", 0, &t), false).unwrap_err();
    assert_eq!(error.to_string(), "TF loop: a → b → a; these links are left out");
    assert!(near(&tree.lookup("a", "c", 0).unwrap(), &(t * t)), "nothing has changed");
    let twice = TfMessage { transforms: vec![link("c", "a", 0, &t), link("c", "a", 1, &t), link("a", "a", 0, &t)] };
    tree.take(&twice, false);
    let refused: Vec<u64> = tree.refused().values().copied().collect();
    assert_eq!(refused, [2, 1], "{:?}", tree.refused());
}

#[test]
fn what_is_not_there_is_named_with_what_is() {
    let t = pose(1.0, 0.0);
    let tree = tree(&[link("odom", "base", 0, &t), link("map", "tag", 0, &t)], true);
    let error = tree.lookup("base", "laser", 0).unwrap_err();
    assert_eq!(error.to_string(), "there is no frame \"laser\"; there are base, map, odom, tag");
    let error = tree.lookup("base", "tag", 0).unwrap_err();
    assert!(error.to_string().starts_with("frames \"tag\" and \"base\" are not connected"), "{error}");
    assert_eq!(TfTree::default().known(), "none, as no TF was recorded");
}

#[test]
fn transforms_that_are_none_are_refused() {
    let mut tree = TfTree::default();
    let bad = |x: f64, w: f64| {
        let mut link = link("a", "b", 0, &Se3::identity());
        (link.transform.translation.x, link.transform.rotation.w) = (x, w);
        link
    };
    for bad in [bad(f64::NAN, 1.0), bad(f64::INFINITY, 1.0), bad(0.0, 0.0), bad(2e7, 1.0)] {
        assert!(matches!(tree.insert(&bad, true), Err(TfError::Value { .. })));
    }
    assert!(matches!(tree.insert(&link("", "b", 0, &Se3::identity()), true), Err(TfError::Names { .. })));
    assert!(!tree.knows("a"));
}

#[test]
fn frames_chains_and_late_ones_are_bounded_on_both_sides() {
    let t = pose(0.0, 0.0);
    let chain = |length: usize| {
        let links: Vec<_> = (1..length).map(|k| link(&format!("f{}", k - 1), &format!("f{k}"), 0, &t)).collect();
        tree(&links, true).lookup("f0", &format!("f{}", length - 1), 0)
    };
    assert!(chain(CHAIN_MAX).is_ok() && chain(CHAIN_MAX + 1).is_err());
    let mut wide = TfTree::default();
    for k in 0..FRAMES_MAX {
        wide.insert(&link("root", &format!("f{k}"), 0, &t), true).unwrap();
    }
    assert_eq!(wide.insert(&link("root", "one_more", 0, &t), true), Err(TfError::Frames));
    assert!(wide.insert(&link("root", "f7", 1, &t), true).is_ok());
    let moving = |k: i64| link("odom", "base", k, &pose(k as f64, 0.0));
    let mut tree = TfTree::default();
    (1..=LATE_MAX as i64 + 1).for_each(|k| tree.insert(&moving(10 * k), false).unwrap());
    assert!(matches!(tree.insert(&moving(9), false), Err(TfError::Late { .. })));
    assert!(tree.insert(&moving(11), false).is_ok());
}

/// A bag that loops: what comes the second time round is not mixed with the first.
#[test]
fn a_clock_set_back_is_left_out_of_its_link_alone() {
    let mut tree = TfTree::default();
    let moving = |k: i64, y: f64| link("odom", "base", k * REORDER_NS_MAX / 2, &pose(k as f64, y));
    let round = |y: f64| TfMessage { transforms: (0..20).map(|k| moving(k, y)).collect() };
    tree.take(&round(0.0), false);
    tree.take(&round(0.7), false);
    let back: Vec<_> = tree.refused().iter().collect();
    assert_eq!(back, [(&"odom → base: the clock was set back, or the bag loops; left out".to_owned(), &20)]);
    let at = |k: i64| tree.lookup("odom", "base", k * REORDER_NS_MAX / 2).unwrap();
    assert!((0..20).all(|k| near(&at(k), &pose(k as f64, 0.0))));
}

#[test]
fn a_stamp_far_ahead_does_not_shut_out_what_follows() {
    for rests in [false, true] {
        let at = |k: i64| pose(if rests { 0.0 } else { k as f64 }, 0.0);
        let mut tree = TfTree::default();
        for k in 0..40_i64 {
            let stamp_ns = if k == 20 { 1000 * SEC } else { k * SEC / 10 };
            tree.take(&TfMessage { transforms: vec![link("odom", "base", stamp_ns, &at(k))] }, false);
        }
        assert_eq!(tree.refused().values().sum::<u64>(), 1, "{:?}", tree.refused());
        assert!(tree.refused().keys().all(|why| why.contains("far ahead")));
        assert_eq!(tree.stamps("odom", "base").unwrap().last(), Some(39 * SEC / 10));
        assert!(near(&tree.lookup("odom", "base", 39 * SEC / 10).unwrap(), &at(39)));
        assert_eq!(tree.transforms, tree.links.values().map(|link| link.samples.len()).sum::<usize>());
    }
}

#[test]
fn names_are_bounded_on_both_sides() {
    let mut tree = TfTree::default();
    let long = "f".repeat(FRAME_BYTES_MAX);
    assert!(tree.insert(&link("root", &long, 0, &pose(1.0, 0.0)), true).is_ok());
    let error = tree.insert(&link("root", &(long + "f"), 0, &pose(1.0, 0.0)), true).unwrap_err();
    assert_eq!(error, TfError::Long(FRAME_BYTES_MAX + 1));
}

/// Every link of a long chain back to its top is a loop: each is found once, however often it is said.
#[test]
fn a_long_chain_that_loops_again_and_again_is_told_shortly() {
    let t = pose(1.0, 0.0);
    let mut tree = TfTree::default();
    for k in 1..FRAMES_MAX {
        tree.insert(&link(&format!("f{}", k - 1), &format!("f{k}"), 0, &t), true).unwrap();
    }
    let last = format!("f{}", FRAMES_MAX - 1);
    let closing = TfMessage { transforms: vec![link(&last, "f0", 0, &t)] };
    (0..2_000).for_each(|_| tree.take(&closing, false));
    let refused: Vec<_> = tree.refused().iter().collect();
    assert_eq!((refused.len(), *refused[0].1, tree.loops.len()), (1, 2_000, 1));
    assert!(refused[0].0.len() < 200 && refused[0].0.contains("f0 → f1 → f2"), "{refused:?}");
}
