//! Doubted where w stands first and the body drives, never where x does.

use super::*;
use proptest::prelude::*;

/// Drives ahead, by these turns (rad) about z and a metre each; as sent with quaternions in the right order.
fn driven(start: f64, tilt: f64, turns: &[f64]) -> Vec<Se3> {
    let mut at = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, start)), Vector3::new(3.0, -2.0, 0.5));
    let mut out = vec![at];
    for (k, turn) in turns.iter().enumerate() {
        let sway = tilt * (0.7 * k as f64).sin();
        at = at * Se3::new(So3::exp(&Vector3::new(sway, -0.6 * sway, *turn)), Vector3::new(1.0, 0.0, 0.0));
        out.push(at);
    }
    out
}

/// As poses come to be read whose quaternions were written w first.
fn sent_w_first(pose: &Se3) -> Se3 {
    let [x, y, z, w] = pose.rotation.xyzw();
    Se3::new(So3::from_xyzw([w, x, y, z]).unwrap(), pose.translation)
}

fn is_doubted(poses: &[Se3]) -> bool {
    let mut order = QuaternionOrder::default();
    poses.iter().for_each(|pose| order.push(pose));
    order.is_doubtful()
}

#[test]
fn a_planar_robot_that_drives_sideways_is_told_by_its_turns() {
    // Its steps are along no axis of its own, but it turns about one only.
    let poses: Vec<Se3> = (0..60)
        .map(|k| {
            let a = 0.1 * f64::from(k);
            Se3::new(So3::exp(&Vector3::new(0.0, 0.0, a)), Vector3::new(a.cos() * 3.0, (2.0 * a).sin(), 0.0))
        })
        .collect();
    assert!(!is_doubted(&poses));
    assert!(is_doubted(&poses.iter().map(sent_w_first).collect::<Vec<_>>()));
}

#[test]
fn a_straight_way_and_too_few_steps_tell_nothing() {
    let straight: Vec<Se3> = driven(0.0, 0.0, &[0.0; 60]).iter().map(sent_w_first).collect();
    assert!(!is_doubted(&straight));
    let round: Vec<Se3> = driven(0.0, 0.0, &[0.4; STEPS_MIN as usize]).iter().map(sent_w_first).collect();
    assert!(is_doubted(&round) && !is_doubted(&round[1..]));
}

#[test]
fn a_straight_way_with_a_swinging_heading_is_not_doubted() {
    // Held in the hand down a corridor, looking left and right; and spinning while it goes along.
    for heading in [|k: f64| 1.05 * (0.9 * k).sin(), |k: f64| 0.5 * k] {
        for direction in [Vector3::x(), -Vector3::x(), Vector3::y(), Vector3::new(0.8, 0.6, 0.0)] {
            let at = |k: f64| Se3::new(So3::exp(&Vector3::new(0.0, 0.0, heading(k))), direction * k);
            assert!(!is_doubted(&(0..80).map(f64::from).map(at).collect::<Vec<_>>()), "{direction}");
        }
    }
}

#[test]
fn what_stands_or_is_not_finite_is_no_step() {
    let mut order = QuaternionOrder::default();
    for _ in 0..100 {
        order.push(&Se3::identity());
        order.push(&Se3::new(So3::identity(), Vector3::new(f64::NAN, 0.0, 0.0)));
    }
    assert_eq!((order.steps(), order.is_doubtful()), (0, false));
}

proptest! {
    #[test]
    fn a_body_that_drives_round_is_doubted_with_w_first_and_only_then(
        start in -3.0..3.0_f64,
        tilt in 0.0..0.05_f64,
        mount in prop::array::uniform3(-3.0..3.0_f64),
        turns in prop::collection::vec(-0.05..0.25_f64, 60..120),
    ) {
        let good = driven(start, tilt, &turns);
        prop_assert!(!is_doubted(&good));
        // In whatever axes the body is.
        let mount = Se3::new(So3::exp(&Vector3::from(mount)), Vector3::zeros());
        let mounted: Vec<Se3> = good.iter().map(|pose| *pose * mount).collect();
        prop_assert!(!is_doubted(&mounted));
        prop_assert!(is_doubted(&good.iter().map(sent_w_first).collect::<Vec<_>>()));
    }

    #[test]
    fn a_body_that_moves_any_way_is_not_doubted(
        steps in prop::collection::vec(prop::array::uniform6(-1.0..1.0_f64), 32..150),
    ) {
        let mut at = Se3::identity();
        let poses: Vec<Se3> = steps.iter().map(|[x, y, z, a, b, c]| {
            at = at * Se3::new(So3::exp(&(0.4 * Vector3::new(*a, *b, *c))), Vector3::new(*x, *y, *z));
            at
        }).collect();
        prop_assert!(!is_doubted(&poses));
    }

    #[test]
    fn the_other_order_is_what_was_meant(q in prop::array::uniform4(-1.0..1.0_f64)) {
        prop_assume!(q.iter().map(|c| c * c).sum::<f64>() > 1e-3);
        let meant = Se3::new(So3::from_xyzw(q).unwrap(), Vector3::zeros());
        prop_assert!(w_first(&sent_w_first(&meant).rotation).local(&meant.rotation).norm() < 1e-9);
    }
}
