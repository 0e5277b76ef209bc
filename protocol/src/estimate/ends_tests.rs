use super::*;
use crate::estimate::test_graphs::{frame, noise, rng, sigmas, submap};
use crate::estimate::test_world::{ALIGNMENT, ODOMETRY, World, rigid};
use crate::geometry::Se3;
use nalgebra::Vector6;
use rand_chacha::ChaCha8Rng;

const WORLDS: u64 = 150;
const ANCHORS: usize = 6;
/// Steps of odometry on either side of an anchor.
const STEPS: usize = 8;

/// From the last anchor to the last keyframe.
fn onward() -> Se3 {
    Se3::exp(&Vector6::new(1.0, 0.1, 0.0, 0.02, -0.01, 0.2))
}

/// Half a submap's odometry, seen from its anchor: what it is off by as a whole, and the mean of what the keyframes on the
/// way are off by.
fn half_walk(rng: &mut ChaCha8Rng, step: &Covariance<6>) -> [Vector6<f64>; 2] {
    let (mut off, mut sum) = (Vector6::zeros(), Vector6::zeros());
    for _ in 0..STEPS {
        let before = off;
        off += noise(rng, step);
        sum += (before + off) / 2.0;
    }
    [off, sum / STEPS as f64]
}

/// Robots side by side, whose clouds lie where their keyframes do in the mean, and the last body of each: its motion since
/// its last anchor, as measured, and the truth.
fn world_of_walks(rng: &mut ChaCha8Rng) -> (World, Vec<(PoseWithCovariance, Se3)>) {
    let mut world = World::new(rng, 3, ANCHORS, true);
    let step = sigmas(ODOMETRY.0, ODOMETRY.1).scaled(0.5 / STEPS as f64);
    let half = step.scaled(STEPS as f64);
    let mut clouds: BTreeMap<SubmapId, Se3> = BTreeMap::new();
    let mut bodies = Vec::new();
    for robot in 0..3 {
        let chain = &mut world.problem.frames.get_mut(&frame(robot)).unwrap().odometry;
        // What was lost since the anchor before.
        let mut since = Vector6::zeros();
        for (index, measured) in chain.iter_mut().enumerate() {
            let [to, cloud_before] = half_walk(rng, &step);
            let [from, cloud_after] = half_walk(rng, &step);
            // A keyframe before the anchor lies behind by what was lost on the way to it.
            let cloud = (cloud_after - cloud_before) * 0.5;
            let truth = world.truth[&submap(robot, index)];
            clouds.insert(submap(robot, index), truth * Se3::exp(&cloud));
            if index > 0 {
                let t = measured.pose;
                let moved = t.inverse().adjoint();
                let covariance = half.transported(&moved).unwrap().plus(&half);
                *measured = PoseWithCovariance { pose: Se3::exp(&-since) * t * Se3::exp(&-to), covariance };
            }
            since = from;
            if index + 1 == ANCHORS {
                let t_anchor_body = onward();
                let covariance = half.transported(&t_anchor_body.inverse().adjoint()).unwrap();
                let body = truth * Se3::exp(&from) * t_anchor_body;
                bodies.push((PoseWithCovariance { pose: t_anchor_body, covariance }, body));
            }
        }
    }
    // Surer than the odometry is: that is where the cloud counts.
    let covariance = sigmas(ALIGNMENT.0, ALIGNMENT.1).scaled(0.1);
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        for (k, l) in (0..ANCHORS).flat_map(|k| [0, 1, 3].map(|gap| (k, (k + gap) % ANCHORS))) {
            let (i, j) = (submap(a, k), submap(b, l));
            let pose = (clouds[&i].inverse() * clouds[&j]).retract(&noise(rng, &covariance));
            world.state(i, j, Relative::Metric(PoseWithCovariance { pose, covariance }));
        }
    }
    // Next to nothing in common: what is left are the walks.
    world.problem.common = world.problem.alignments.iter().map(|a| (a.entry, 1e-3)).collect();
    (world, bodies)
}

/// To tell the body's motion from its anchor's error makes live poses surer, and never surer than they are. (Here they
/// stay too cautious: clouds are bent so much that the consensus of the pairs takes alignments for less sure than they
/// are.)
#[test]
fn live_poses_become_surer_and_not_surer_than_they_are() {
    let (mut together, mut independent, mut count) = (0.0, 0.0, 0.0);
    for seed in 0..WORLDS {
        let (world, bodies) = world_of_walks(&mut rng(seed));
        let map = world.solve();
        let ends = map.ends(frame(0));
        let t_world_own = world.frames[&frame(0)].to_se3();
        for (robot, (since, body)) in [1, 2].into_iter().zip(&bodies[1..]) {
            let last = submap(robot, ANCHORS - 1);
            let t_own_anchor = rigid(&map.anchor(frame(0), last).unwrap());
            let truth = t_world_own.inverse() * *body;
            let nees = |t: &PoseWithCovariance| t.covariance.mahalanobis_squared(&t.pose.local(&truth));
            together += nees(&ends[&last].onward(&t_own_anchor, since));
            independent += nees(&t_own_anchor.compose(since));
            count += 1.0;
        }
    }
    let (together, independent) = (together / count, independent / count);
    println!("NEES of live poses {together:.2}, as if independent {independent:.2}");
    // A world is one sample of χ²₆, of variance 12, as far as its robots err alike. 99 %.
    let off = 2.576 * (12.0 / WORLDS as f64).sqrt();
    assert!(together < 6.0 + off, "{together}");
    assert!(together > 1.2 * independent, "{together} {independent}");
}

/// A hole in the odometry makes the last step unsure, not what the body did after its anchor the surer.
#[test]
fn a_gap_before_the_last_anchor_is_not_taken_for_its_walk() {
    let (mut world, _) = world_of_walks(&mut rng(7));
    let last = submap(1, ANCHORS - 1);
    let walk = |world: &World| world.solve().ends(frame(0))[&last].walk;
    let sound = walk(&world);
    let steps = &mut world.problem.frames.get_mut(&frame(1)).unwrap().odometry;
    let step = steps.last_mut().unwrap();
    step.covariance = step.covariance.scaled(9.0);
    assert_eq!(walk(&world), sound);
    // The other way round, too.
    let steps = &mut world.problem.frames.get_mut(&frame(1)).unwrap().odometry;
    let [.., before, step] = steps.as_mut_slice() else { panic!("too few steps") };
    core::mem::swap(&mut before.covariance, &mut step.covariance);
    assert!(walk(&world).matrix().determinant() < 1.01 * sound.matrix().determinant());
    // Of one step nobody knows whether it leads over a gap.
    let chain = world.problem.frames.get_mut(&frame(1)).unwrap();
    chain.odometry.truncate(2);
    world.problem.alignments.retain(|a| [a.i, a.j].iter().all(|id| id.frame != frame(1) || id.index < 2));
    assert!(!world.solve().ends(frame(0)).contains_key(&submap(1, 1)));
}

fn end(gain: f64) -> End {
    End { gain: Matrix6::identity() * gain, walk: sigmas(0.02, 0.005) }
}

#[test]
fn a_body_is_the_surer_the_more_alignments_tell_of_its_anchor() {
    let t = PoseWithCovariance { pose: Se3::exp(&Vector6::repeat(0.3)), covariance: sigmas(0.05, 0.01) };
    let since = PoseWithCovariance { pose: onward(), covariance: sigmas(0.03, 0.01) };
    let size = |t: PoseWithCovariance| t.covariance.matrix().determinant();
    let independent = t.compose(&since);
    assert_eq!(end(0.0).onward(&t, &since).pose, independent.pose);
    assert!((end(0.0).onward(&t, &since).covariance.matrix() - independent.covariance.matrix()).amax() < 1e-12);
    assert!(size(end(-1.0).onward(&t, &since)) < size(end(-0.5).onward(&t, &since)));
    assert!(size(end(-0.5).onward(&t, &since)) < size(independent));
    // What nobody can mean is not believed.
    assert_eq!(end(-1e6).onward(&t, &since), independent);
    // A body that stands at its anchor owes the odometry nothing.
    let still = PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(1e-6, 1e-6) };
    let more = end(-1.0).onward(&t, &still).covariance.matrix() - t.covariance.matrix();
    assert!(more.amax() < 1e-11, "{more}");
}

#[test]
fn only_the_last_submaps_that_alignments_tell_of_have_an_end() {
    let (mut world, _) = world_of_walks(&mut rng(7));
    let lasts: Vec<SubmapId> = (0..3).map(|robot| submap(robot, ANCHORS - 1)).collect();
    assert_eq!(world.solve().ends(frame(1)).into_keys().collect::<Vec<_>>(), lasts);
    world.problem.alignments.retain(|a| a.i != lasts[1] && a.j != lasts[1]);
    assert_eq!(world.solve().ends(frame(1)).into_keys().collect::<Vec<_>>(), [lasts[0], lasts[2]]);
    world.problem.alignments.clear();
    assert!(world.solve().ends(frame(1)).is_empty());
}
