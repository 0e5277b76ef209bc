use super::*;
use crate::geometry::{Relative, Se3};
use crate::test_graphs::{frame, noise, rng, sigmas, submap};
use crate::test_walks::{Body, Walked, onward, walked};
use crate::test_world::{ALIGNMENT, World, rigid};
use nalgebra::Vector6;
use rand_chacha::ChaCha8Rng;

const WORLDS: u64 = 150;
const ANCHORS: usize = 6;
/// Keyframes of a submap: so many that it hardly matters how many, and as few as robots may well have.
const MANY: u16 = 17;
const FEW: u16 = 4;

/// Robots side by side whose alignments are surer than their odometry: that is where clouds count. And their last
/// bodies.
fn world_of_walks(rng: &mut ChaCha8Rng, keyframes: u16) -> (World, Vec<Body>) {
    let Walked { mut world, clouds, bodies } = walked(rng, 3, ANCHORS, keyframes);
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

/// Mean NEES of live poses, and what it would be were motions taken for independent of the anchors' errors.
fn nees_of_bodies(keyframes: u16, told: bool) -> [f64; 2] {
    let (mut together, mut independent, mut count) = (0.0, 0.0, 0.0);
    for seed in 0..WORLDS {
        let (mut world, bodies) = world_of_walks(&mut rng(seed), keyframes);
        if !told {
            world.problem.keyframes.clear();
        }
        let map = world.solve();
        let ends = map.ends(frame(0));
        let t_world_own = world.frames[&frame(0)].to_se3();
        for (robot, Body { t_anchor_body: since, t_world_body: body }) in [1, 2].into_iter().zip(&bodies[1..]) {
            let last = submap(robot, ANCHORS - 1);
            let t_own_anchor = rigid(&map.anchor(frame(0), last).unwrap());
            let truth = t_world_own.inverse() * *body;
            let nees = |t: &PoseWithCovariance| t.covariance.mahalanobis_squared(&t.pose.local(&truth));
            together += nees(&ends[&last].onward(&t_own_anchor, since));
            independent += nees(&t_own_anchor.compose(since));
            count += 1.0;
        }
    }
    let nees = [together, independent].map(|sum: f64| sum / count);
    println!("{keyframes} keyframes, told {told}: NEES of live poses {:.2}, as if independent {:.2}", nees[0], nees[1]);
    nees
}

/// To tell the body's motion from its anchor's error makes live poses surer, and never surer than they are. (Here they
/// stay too cautious: clouds are bent so much that the consensus of the pairs takes alignments for less sure than they
/// are.)
#[test]
fn live_poses_become_surer_and_not_surer_than_they_are() {
    // A world is one sample of χ²₆, of variance 12, as far as its robots err alike. 99 %.
    let off = 2.576 * (12.0 / WORLDS as f64).sqrt();
    for keyframes in [MANY, FEW] {
        let [together, independent] = nees_of_bodies(keyframes, true);
        assert!(together < 6.0 + off, "{together}");
        assert!(together > 1.2 * independent, "{together} {independent}");
    }
}

/// Of four keyframes two come after the anchor, and their cloud follows more of what is lost there than that of many.
#[test]
fn who_tells_of_few_keyframes_is_believed_to_be_surer() {
    let [told, untold] = [true, false].map(|told| nees_of_bodies(FEW, told)[0]);
    assert!(told > 1.05 * untold, "{told} {untold}");
}

/// What the odometry lost between the origin and the first anchor bent the first cloud: frames are surer than if it had
/// not.
#[test]
fn frames_are_surer_of_where_they_begin_and_not_surer_than_they_are() {
    let (mut together, mut independent, mut count) = (0.0, 0.0, 0.0);
    for seed in 0..WORLDS {
        let (world, _) = world_of_walks(&mut rng(seed), FEW + 1);
        let map = world.solve();
        let origin = |robot: u8| rigid(&map.anchor(frame(robot), submap(robot, 0)).unwrap());
        for robot in [1, 2] {
            let truth = world.frames[&frame(0)].to_se3().inverse() * world.frames[&frame(robot)].to_se3();
            let nees = |t: &PoseWithCovariance| t.covariance.mahalanobis_squared(&t.pose.local(&truth));
            together += nees(&rigid(&map.frame(frame(0), frame(robot)).unwrap()));
            let between = rigid(&map.relative(submap(0, 0), submap(robot, 0)).unwrap());
            independent += nees(&origin(0).compose(&between).compose(&origin(robot).inverse()));
            count += 1.0;
        }
        let all = map.anchors(frame(0));
        assert_eq!(all.len(), 3 * ANCHORS);
        for (id, t) in &all {
            let (t, alone) = (rigid(t), rigid(&map.anchor(frame(0), *id).unwrap()));
            let apart = (t.covariance.matrix() - alone.covariance.matrix()).amax();
            assert!(t.pose.local(&alone.pose).amax() < 1e-12 && apart < 1e-9 * t.covariance.matrix().amax());
        }
    }
    let (together, independent) = (together / count, independent / count);
    println!("NEES of frames {together:.2}, as if independent {independent:.2}");
    assert!(together < 6.0 + 2.576 * (12.0 / WORLDS as f64).sqrt(), "{together}");
    assert!(together > 1.1 * independent, "{together} {independent}");
}

/// A hole in the odometry makes the last step unsure, not what the body did after its anchor the surer.
#[test]
fn a_gap_before_the_last_anchor_is_not_taken_for_its_walk() {
    let (mut world, _) = world_of_walks(&mut rng(7), MANY);
    let last = submap(1, ANCHORS - 1);
    let walk = |world: &World| world.solve().ends(frame(0))[&last].stretch.lost;
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
    End { gain: Matrix6::identity() * gain, stretch: Stretch { lost: sigmas(0.02, 0.005), follows: 0.25 } }
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
    let (mut world, _) = world_of_walks(&mut rng(7), MANY);
    let lasts: Vec<SubmapId> = (0..3).map(|robot| submap(robot, ANCHORS - 1)).collect();
    assert_eq!(world.solve().ends(frame(1)).into_keys().collect::<Vec<_>>(), lasts);
    world.problem.alignments.retain(|a| a.i != lasts[1] && a.j != lasts[1]);
    assert_eq!(world.solve().ends(frame(1)).into_keys().collect::<Vec<_>>(), [lasts[0], lasts[2]]);
    world.problem.alignments.clear();
    assert!(world.solve().ends(frame(1)).is_empty());
}
