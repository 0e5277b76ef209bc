//! The order of quaternions is doubted in what a file states w first, and nowhere else.

use super::super::g2o::Parser;
use super::*;
use crate::geometry::Se3;
use nalgebra::Vector3;
use proptest::prelude::*;
use std::fmt::Write as _;

/// A way through space: ahead, with turns of its own.
fn way(count: u32, turn: f64) -> Vec<Se3> {
    let step = |k: u32| {
        let a = f64::from(k);
        let turn = Vector3::new(0.1 * (0.9 * a).sin(), 0.1 * (0.7 * a).cos(), turn * (1.0 + (0.3 * a).sin()));
        Se3::new(So3::exp(&turn), Vector3::new(1.0, 0.0, 0.0))
    };
    (0..count).scan(Se3::identity(), |at, k| Some(core::mem::replace(at, *at * step(k)))).collect()
}

fn numbers(pose: &Se3, w_first: bool) -> String {
    let (p, [x, y, z, w]) = (pose.translation, pose.rotation.xyzw());
    let turn = if w_first { [w, x, y, z] } else { [x, y, z, w] };
    format!("{} {} {} {} {} {} {}", p.x, p.y, p.z, turn[0], turn[1], turn[2], turn[3])
}

/// The graph of a file whose vertices and edges, if there are any, have this order; loops skip `apart` poses.
fn file(poses: &[Se3], vertices: Option<bool>, edges: Option<bool>, apart: usize) -> PoseGraph {
    let mut text = String::new();
    for (k, pose) in poses.iter().enumerate().filter(|_| vertices.is_some()) {
        let _ = writeln!(text, "VERTEX_SE3:QUAT {k} {}", numbers(pose, vertices == Some(true)));
    }
    let information = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1";
    for k in (apart..poses.len()).filter(|_| edges.is_some()) {
        let measured = numbers(&(poses[k - apart].inverse() * poses[k]), edges == Some(true));
        let _ = writeln!(text, "EDGE_SE3:QUAT {} {k} {measured} {information}", k - apart);
    }
    let mut parser = Parser::default();
    text.lines().for_each(|line| parser.line(line).unwrap());
    parser.finish()
}

fn found(graph: &PoseGraph) -> Option<WFirst> {
    w_first_in(graph, graph.measurements.iter())
}

#[test]
fn bad_first_values_are_no_other_order() {
    // As of a solver that begins anywhere.
    let poses = way(60, 0.2);
    let mut graph = file(&poses, Some(false), Some(false), 1);
    for (k, value) in graph.poses.values_mut().enumerate() {
        let a = k as f64;
        *value =
            Some(Se3::new(So3::exp(&Vector3::new(2.0 * a.sin(), a.cos(), 3.0 * (0.5 * a).sin())), Vector3::zeros()));
    }
    assert_eq!(found(&graph), None);
}

#[test]
fn what_is_told_names_the_lines_and_the_cure() {
    let told = found(&file(&way(60, 0.2), Some(false), Some(true), 7)).unwrap().to_string();
    assert!(told.contains("EDGE_SE3:QUAT lines") && told.contains("w first") && told.contains("put w last"), "{told}");
}

proptest! {
    #[test]
    fn each_order_is_told_from_the_others(count in 40_u32..120, turn in 0.1..0.4_f64, apart in 1_usize..6) {
        let poses = way(count, turn);
        let found = |vertices, edges| found(&file(&poses, vertices, edges, apart));
        prop_assert_eq!(found(Some(false), Some(false)), None);
        prop_assert_eq!(found(Some(false), None), None);
        prop_assert_eq!(found(None, Some(false)), None);
        // Values alone tell it of who turns by more than a full turn.
        if f64::from(count) * turn > 8.0 {
            prop_assert_eq!(found(Some(true), None), Some(WFirst::Vertices));
        }
        prop_assert_eq!(found(Some(true), Some(true)), Some(WFirst::All));
        // Measurements across half a radian contradict values of another order by enough.
        if turn * apart as f64 > 0.6 {
            prop_assert_eq!(found(Some(true), Some(false)), Some(WFirst::Vertices));
            prop_assert_eq!(found(Some(false), Some(true)), Some(WFirst::Edges));
        }
        // Steps from pose to pose that turn little tell it without values as well.
        if apart == 1 && turn < 0.2 {
            prop_assert_eq!(found(None, Some(true)), Some(WFirst::Edges));
        }
    }
}
