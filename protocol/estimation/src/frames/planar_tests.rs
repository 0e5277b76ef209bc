//! Frames of planar robots on seeded worlds: decided in the plane at least as well as in space, with an honest covariance,
//! and only where nothing leaves the plane.

use super::super::align_frames;
use super::super::tests::{config, draw, tally_of};
use super::super::world::{Draw, World};
use super::*;
use crate::geometry::Se3;
use nalgebra::Vector6;

/// As [`align_frames`], in six degrees of freedom wherever the robots move.
fn in_space(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment],
    config: &FrameConsensusConfig,
) -> FrameOutcome {
    let rigid = alignments.iter().map(|a| (a.i, a.j, (a.t_i_j.pose, a.t_i_j.covariance, true)));
    Measured::<6, Se3>::new(alpha, beta, rigid, config)
        .outcome()
        .map(|_, pose, covariance| PoseWithCovariance { pose, covariance })
}

#[test]
fn planar_frames_are_decided_in_the_plane() {
    for (d, right, ambiguous) in [
        (draw(4, 0, 16), 98, 0),
        (draw(3, 0, 17), 70, 0),
        (draw(10, 5, 5), 99, 0),
        (draw(4, 3, 13), 97, 0),
        (draw(4, 4, 12), 0, 98),
        (Draw { under_reported: 3.0, ..draw(4, 0, 16) }, 75, 0),
        (draw(0, 0, 20), 0, 0),
        (draw(0, 0, 60), 0, 0),
    ] {
        let plane = tally_of(World::planar, align_frames, d, &config(3.0));
        let space = tally_of(World::planar, in_space, d, &config(3.0));
        println!("{d:?}\n  plane {plane:?}\n  space {space:?}");
        assert!(plane.right >= right && plane.ambiguous >= ambiguous && plane.wrong == 0, "{plane:?}");
        // Six degrees of freedom do worse: what they add is not measured.
        assert!(plane.right + 2 >= space.right && plane.ambiguous + 2 >= space.ambiguous, "{plane:?} {space:?}");
    }
}

#[test]
fn the_covariance_of_planar_frames_is_honest_in_the_plane() {
    let (runs, mut sum, mut inside) = (300, 0.0, 0);
    for seed in 0..runs {
        let w = World::planar(20_000 + seed, draw(10, 0, 0));
        let outcome = align_frames(&w.alpha, &w.beta, &w.alignments, &config(3.0));
        let FrameOutcome::Merged(c) = outcome else { panic!("seed {seed}: {outcome:?}") };
        let error = Se2::of(&c.t_alpha_beta.pose).local(&Se2::of(&w.t_alpha_beta));
        let nees = Covariance::new(in_plane(c.t_alpha_beta.covariance.matrix())).unwrap().mahalanobis_squared(&error);
        (sum, inside) = (sum + nees, inside + u32::from(nees < 7.815));
        // Height and tilts are no better known than one alignment has them.
        let sigmas = c.t_alpha_beta.covariance.sigmas();
        assert!(sigmas[2] > 0.39 && sigmas[3].max(sigmas[4]) > 0.079, "{sigmas}");
    }
    let (anees, inside) = (sum / runs as f64, f64::from(inside) / runs as f64);
    println!("ANEES {anees:.3} of 3, {:.1} % inside the 95 % ellipsoid", 100.0 * inside);
    assert!((2.8 * 0.95..3.2 * 1.1).contains(&anees), "ANEES {anees} of 3");
    assert!((0.92..0.98).contains(&inside), "{inside} inside the 95 % ellipsoid");
}

#[test]
fn what_leaves_the_plane_is_decided_in_space() {
    let flat = World::planar(3, draw(4, 0, 4));
    let planar = |w: &World| is_planar(&w.alpha, &w.beta, &w.alignments);
    assert!(planar(&flat) && !planar(&World::new(3, draw(4, 0, 4))));
    let tilted_by = |roll: f64| Vector6::new(0.0, 0.0, 0.0, roll, 0.0, 0.0);
    for nudge in [Vector6::z() * 1e-3, tilted_by(1e-3), tilted_by(core::f64::consts::PI)] {
        let mut w = flat.clone();
        w.alignments[2].t_i_j.pose = w.alignments[2].t_i_j.pose.retract(&nudge);
        assert!(!planar(&w), "{nudge}");
    }
    let mut w = flat.clone();
    let mut tied = *w.alignments[2].t_i_j.covariance.matrix();
    (tied[(0, 2)], tied[(2, 0)]) = (0.01, 0.01);
    w.alignments[2].t_i_j.covariance = Covariance::new(tied).unwrap();
    assert!(!planar(&w));
    let mut w = flat;
    w.beta.push(PoseWithCovariance {
        pose: Se3::exp(&Vector6::new(1.0, 0.0, 0.1, 0.0, 0.0, 0.0)),
        covariance: Covariance::from_sigmas([0.1; 6]).unwrap(),
    });
    assert!(!planar(&w));
}
