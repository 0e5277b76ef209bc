//! Landmark worlds with known truth: what is found, what is refused, and whether the stated covariances are honest.

use super::super::{Features, Keypoints};
use super::{Aligned, Codec, Constellation, Descriptor, Landmark, LandmarkConfig, LandmarkError, Mark, register};
use crate::align::{Model, SolverConfig};
use crate::geometry::{Covariance, Relative, Sim3, So3};
use crate::kinds::RefusalReason;
use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub(super) type Dice = ChaCha8Rng;

pub(super) fn normal(dice: &mut Dice) -> f64 {
    let (u, v): (f64, f64) = (dice.random_range(f64::MIN_POSITIVE..1.0), dice.random_range(0.0..1.0));
    (-2.0 * u.ln()).sqrt() * (core::f64::consts::TAU * v).cos()
}

pub(super) fn vector(dice: &mut Dice, half: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| dice.random_range(-half..half))
}

/// A landmark of the world: where it is, and what it looks like.
pub(super) struct Thing {
    pub(super) at: Vector3<f64>,
    pub(super) descriptor: Descriptor,
}

pub(super) fn world(dice: &mut Dice, count: usize, half: f64, flat: bool) -> Vec<Thing> {
    let thing = |_| {
        let mut at = vector(dice, half);
        at.z *= if flat { 0.0 } else { 0.4 };
        Thing { at, descriptor: dice.random() }
    };
    (0..count).map(thing).collect()
}

/// A covariance with one long axis, as seen from somewhere.
fn covariance(dice: &mut Dice, sigma: f64, flat: bool) -> Covariance<3> {
    let turn = if flat { Vector3::new(0.0, 0.0, dice.random_range(0.0..3.0)) } else { vector(dice, 1.5) };
    let axes = So3::exp(&turn).matrix();
    let thin = if flat { 1e-3 } else { sigma };
    let m = axes
        * Matrix3::from_diagonal(&Vector3::new(9.0 * sigma * sigma, sigma * sigma, thin * thin))
        * axes.transpose();
    Covariance::new(m).unwrap()
}

/// How a robot sees things: from a frame of its own, with noise as stated, labelled by their numbers or described by
/// bits of which a tenth is wrong.
struct Look {
    /// `t_frame_world`.
    frame: Sim3,
    sigma: f64,
    labelled: bool,
    flat: bool,
}

impl Look {
    fn at(&self, dice: &mut Dice, things: &[Thing], which: impl Iterator<Item = usize>) -> Vec<Landmark> {
        let landmark = |k: usize| {
            let covariance = covariance(dice, self.sigma * self.frame.scale, self.flat);
            let root = covariance.matrix().cholesky().unwrap().l();
            let noise = Vector3::from_fn(|axis, _| if self.flat && axis == 2 { 0.0 } else { normal(dice) });
            let mut at = self.frame * things[k].at + root * noise;
            if self.flat {
                at.z = 0.0;
            }
            let mut descriptor = things[k].descriptor;
            for _ in 0..26 {
                let bit: usize = dice.random_range(0..256);
                descriptor[bit / 8] ^= 1 << (bit % 8);
            }
            let label = self.labelled.then_some(k as u32);
            let mark = Mark { covariance, label, descriptor: (!self.labelled).then_some(descriptor) };
            Landmark { at, mark, sightings: 3 }
        };
        which.map(landmark).collect()
    }
}

fn constellation(landmarks: &[Landmark]) -> Constellation {
    Constellation { landmarks: landmarks.to_vec(), ..Constellation::default() }
}

fn offered(landmarks: &[Landmark], voxel: f64) -> Keypoints {
    let keypoints = Keypoints::of_landmarks(Codec::new(voxel, &constellation(landmarks)));
    Keypoints::decode(&keypoints.encode()).unwrap()
}

fn kept(landmarks: &[Landmark], voxel: f64) -> Features {
    let features = Features::of_landmarks(Codec::new(voxel, &constellation(landmarks)), vec![[0.0; 3]]);
    Features::decode(&features.encode()).unwrap()
}

fn in_space(model: Model) -> LandmarkConfig {
    let solver = SolverConfig { model, sigma_max: 0.15, support_min: 8.0, ..SolverConfig::default() };
    LandmarkConfig { planar: false, solver }
}

fn any_scale() -> LandmarkConfig {
    in_space(Model::Similarity { scale_min: 0.05, scale_max: 20.0 })
}

pub(super) fn planar() -> LandmarkConfig {
    LandmarkConfig { planar: true, ..in_space(Model::Rigid) }
}

fn frame(dice: &mut Dice, scale: f64) -> Sim3 {
    Sim3::new(So3::exp(&vector(dice, 1.8)), vector(dice, 10.0), scale)
}

pub(super) fn flat_frame(dice: &mut Dice) -> Sim3 {
    let turn = Vector3::new(0.0, 0.0, dice.random_range(-3.1..3.1));
    let mut at = vector(dice, 5.0);
    at.z = 0.0;
    Sim3::new(So3::exp(&turn), at, 1.0)
}

/// Squared distance of an alignment from the truth by its own covariance.
pub(super) fn nees(found: &Aligned, truth: &Sim3) -> f64 {
    match &found.t_mine_theirs {
        Relative::Similarity(s) => s.covariance.mahalanobis_squared(&truth.local(&s.sim)),
        Relative::Metric(p) => p.covariance.mahalanobis_squared(&truth.to_se3().local(&p.pose)),
    }
}

/// Two robots of unknown scale that saw a third of the world in common, with a third of the matches wrong.
#[test]
fn a_similarity_is_found_with_an_honest_covariance() {
    let mut dice = Dice::seed_from_u64(1);
    let (trials, mut found, mut sum, mut inside) = (200, 0, 0.0, 0);
    for _ in 0..trials {
        let mut things = world(&mut dice, 150, 8.0, false);
        let scales = [0, 1].map(|_| libm::exp(dice.random_range(-1.5..1.5)));
        let looks =
            scales.map(|scale| Look { frame: frame(&mut dice, scale), sigma: 0.02, labelled: false, flat: false });
        let mine = looks[0].at(&mut dice, &things, 0..90);
        // A third of what both see has moved meanwhile, or looks like something else.
        for k in 0..10 {
            things[40 + 3 * k].at = vector(&mut dice, 8.0);
        }
        let theirs = looks[1].at(&mut dice, &things, 40..150);
        let truth = looks[0].frame * looks[1].frame.inverse();
        let config = LandmarkConfig {
            solver: SolverConfig { sigma_max: 0.15 * scales[0], ..any_scale().solver },
            ..any_scale()
        };
        let answer = register(&offered(&theirs, 0.1 * scales[1]), &kept(&mine, 0.1 * scales[0]), &config);
        let Ok(answer) = answer else { continue };
        let off = truth.inverse() * answer.t_mine_theirs.sim();
        assert!(off.rotation.angle() < 0.05 && libm::log(off.scale).abs() < 0.05, "a false alignment: {off:?}");
        found += 1;
        let d = nees(&answer, &truth);
        sum += d;
        inside += usize::from(d <= 14.067);
    }
    let (mean, coverage) = (sum / f64::from(found), inside as f64 / f64::from(found));
    println!("SIM(3): {found} of {trials} found, NEES {mean:.2} for 7, {:.1} % inside 95 %", 100.0 * coverage);
    assert!(found >= trials * 97 / 100, "{found}");
    assert!((4.5..9.0).contains(&mean) && coverage > 0.9, "{mean} {coverage}");
}

#[test]
fn labels_in_the_plane_are_enough_for_a_pose() {
    let mut dice = Dice::seed_from_u64(2);
    let (trials, mut found, mut sum) = (300, 0, 0.0);
    for _ in 0..trials {
        let things = world(&mut dice, 15, 6.0, true);
        let looks = [0, 1].map(|_| Look { frame: flat_frame(&mut dice), sigma: 0.03, labelled: true, flat: true });
        let mine = looks[0].at(&mut dice, &things, 0..10);
        let mut theirs = looks[1].at(&mut dice, &things, 4..15);
        // One bar code in six is misread.
        theirs[1].mark.label = Some(3);
        let truth = looks[0].frame * looks[1].frame.inverse();
        let Ok(answer) = register(&offered(&theirs, 0.1), &kept(&mine, 0.1), &planar()) else { continue };
        let off = truth.to_se3().local(&answer.t_mine_theirs.sim().to_se3());
        assert!(off.norm() < 0.6, "a false alignment: {off:?}");
        assert!(off[2] == 0.0 && off[3].abs() < 1e-9 && off[4].abs() < 1e-9, "out of the plane: {off:?}");
        found += 1;
        sum += nees(&answer, &truth);
    }
    let mean = sum / f64::from(found);
    println!("plane: {found} of {trials} found, NEES {mean:.2} for 3");
    assert!(found >= trials * 9 / 10, "{found}");
    assert!((1.5..4.0).contains(&mean), "{mean}");
}

/// Labels and descriptors of other things, in space and in the plane: nothing is ever found.
#[test]
fn lies_are_refused() {
    let mut dice = Dice::seed_from_u64(3);
    for trial in 0..400 {
        let flat = trial % 2 == 0;
        let (here, there) = (world(&mut dice, 40, 6.0, flat), world(&mut dice, 40, 6.0, flat));
        let labelled = trial % 4 < 2;
        let look = |frame| Look { frame, sigma: 0.03, labelled, flat };
        let frames = [0, 1].map(|_| if flat { flat_frame(&mut dice) } else { frame(&mut dice, 1.0) });
        let count = dice.random_range(3..40);
        let mine = look(frames[0]).at(&mut dice, &here, 0..count);
        let mut theirs = look(frames[1]).at(&mut dice, &there, 0..count);
        if !labelled {
            theirs.iter_mut().zip(&mine).for_each(|(t, m)| t.mark.descriptor = m.mark.descriptor);
        }
        for config in if flat { vec![planar()] } else { vec![any_scale(), in_space(Model::Rigid)] } {
            let answer = register(&offered(&theirs, 0.1), &kept(&mine, 0.1), &config);
            assert!(answer.is_err(), "{trial}: {answer:?}");
        }
    }
}

/// Theirs shows one of two bays that look the same, mine shows both: whichever it is, nobody can tell. Alone among
/// other things, what looks alike does no harm.
#[test]
fn what_repeats_itself_is_ambiguous_and_a_few_look_alikes_are_not() {
    let mut dice = Dice::seed_from_u64(9);
    let look = |frame| Look { frame, sigma: 0.02, labelled: false, flat: false };
    let copy = |thing: &Thing, to: Vector3<f64>| Thing { at: to, descriptor: thing.descriptor };
    for trial in 0..100 {
        let mut things = world(&mut dice, 60, 4.0, false);
        let other_bay: Vec<Thing> = things.iter().map(|t| copy(t, t.at + Vector3::new(9.0, 0.0, 0.0))).collect();
        let frames = [0, 1].map(|_| frame(&mut dice, 1.0));
        let theirs = look(frames[1]).at(&mut dice, &things, 0..60);
        let alone = look(frames[0]).at(&mut dice, &things, 0..60);
        // Of the other bay less is seen.
        let seen = dice.random_range(30..60);
        let rest = look(frames[0]).at(&mut dice, &other_bay, 0..seen);
        let both: Vec<Landmark> = alone.iter().chain(&rest).copied().collect();
        // A third of all looks like something elsewhere, each at a place of its own.
        (0..20).for_each(|k| things[40 + k].descriptor = things[k].descriptor);
        let strewn = [0, 1].map(|k| look(frames[k]).at(&mut dice, &things, 0..60));
        for config in [any_scale(), in_space(Model::Rigid)] {
            let answer = register(&offered(&theirs, 0.1), &kept(&both, 0.1), &config);
            assert!(matches!(answer, Err(LandmarkError::Ambiguous { elsewhere: true, .. })), "{trial}: {answer:?}");
            assert!(register(&offered(&theirs, 0.1), &kept(&alone, 0.1), &config).is_ok(), "{trial}");
            let [mine, theirs] = &strewn;
            let answer = register(&offered(theirs, 0.1), &kept(mine, 0.1), &config).unwrap();
            let off = (frames[0] * frames[1].inverse()).inverse() * answer.t_mine_theirs.sim();
            assert!(off.rotation.angle() < 0.05 && off.translation.norm() < 0.2, "{trial}: {off:?}");
        }
    }
}

/// What geometry cannot tell is refused with its reason.
#[test]
fn poor_constellations_are_refused() {
    let mut dice = Dice::seed_from_u64(4);
    let look = |labelled, flat, frame| Look { frame, sigma: 0.005, labelled, flat };
    let unmoved = Sim3::identity();
    let answer = |mine: &[Landmark], theirs: &[Landmark], config: &LandmarkConfig| {
        register(&offered(theirs, 0.1), &kept(mine, 0.1), config)
    };
    let mut things = world(&mut dice, 20, 6.0, false);
    let turned = frame(&mut dice, 1.0);
    let both = |dice: &mut Dice, things: &[Thing], count| {
        let mine = look(true, false, unmoved).at(dice, things, 0..count);
        (mine, look(true, false, turned).at(dice, things, 0..count))
    };
    let (mine, theirs) = both(&mut dice, &things, 20);
    for config in [any_scale(), in_space(Model::Rigid)] {
        let good = answer(&mine, &theirs, &config);
        assert!(good.is_ok(), "{good:?}");
        let few = answer(&mine[..3], &theirs[..3], &config);
        assert!(matches!(few, Err(LandmarkError::TooFew { matches: 3, .. })), "{few:?}");
        // A mirrored world is another world.
        let mut mirrored = theirs.clone();
        mirrored.iter_mut().for_each(|l| l.at.z = -l.at.z);
        assert!(answer(&mine, &mirrored, &config).is_err());
        // Every label twice on one side is no label.
        let twice: Vec<Landmark> = theirs.iter().chain(&theirs).copied().collect();
        let none = answer(&mine, &twice, &config);
        assert!(matches!(none, Err(LandmarkError::TooFew { matches: 0, .. })), "{none:?}");
        // Half of the labels are those of their neighbours.
        let mut half = theirs.clone();
        half.iter_mut().take(10).for_each(|l| l.mark.label = l.mark.label.map(|k| (k + 1) % 10));
        let lies = answer(&mine, &half, &config);
        assert!(matches!(lies, Err(LandmarkError::LabelsLie { agreeing: 10, labelled: 20 })), "{lies:?}");
    }
    for (k, thing) in things.iter_mut().enumerate() {
        thing.at = Vector3::new(k as f64 * 0.5, 0.0, 0.0);
    }
    let (mine, theirs) = both(&mut dice, &things, 20);
    let line = answer(&mine, &theirs, &in_space(Model::Rigid));
    assert!(matches!(line, Err(LandmarkError::Degenerate { .. })), "{line:?}");
    for thing in &mut things {
        thing.at = vector(&mut dice, 6.0);
        thing.at.z = 0.0;
    }
    let (mine, theirs) = both(&mut dice, &things, 20);
    let plane = answer(&mine, &theirs, &in_space(Model::Rigid));
    assert!(matches!(plane, Err(LandmarkError::Mirror { .. })), "{plane:?}");
    assert_eq!(RefusalReason::from(&plane.unwrap_err()), RefusalReason::Degenerate, "of other places it says nothing");
    assert_eq!(answer(&mine, &theirs, &planar()), Err(LandmarkError::NotPlanar));

    // In the plane: three could agree by accident, four are enough; a mirrored world is another one.
    let flat = look(true, true, unmoved).at(&mut dice, &things, 0..20);
    let config = planar();
    assert!(matches!(answer(&flat[..3], &flat[..3], &config), Err(LandmarkError::TooFew { matches: 3, needed: 4 })));
    assert!(answer(&flat[..4], &flat[..4], &config).is_ok());
    let mut mirrored = flat.clone();
    mirrored.iter_mut().for_each(|l| l.at.y = -l.at.y);
    assert!(answer(&flat, &mirrored, &config).is_err());
    // One cluster seen from afar leaves the angle open.
    let mut cluster = flat.clone();
    cluster.iter_mut().for_each(|l| l.at = l.at * 0.001 + Vector3::new(20.0, 0.0, 0.0));
    assert!(answer(&cluster, &cluster, &config).is_err());
    // Half of what they saw was moved, together: two answers.
    let mut moved = flat.clone();
    moved.iter_mut().take(10).for_each(|l| l.at.x += 3.0);
    let two = answer(&flat, &moved, &config);
    assert!(matches!(two, Err(LandmarkError::Ambiguous { members: 10, rival: 10, elsewhere: false })), "{two:?}");
}

#[test]
fn summaries_tell_who_saw_the_same_and_are_of_their_own_kind() {
    let mut dice = Dice::seed_from_u64(9);
    let things = world(&mut dice, 60, 5.0, false);
    for labelled in [true, false] {
        let look = Look { frame: Sim3::identity(), sigma: 0.01, labelled, flat: false };
        let mut summary = |which| {
            let landmarks = look.at(&mut dice, &things, which);
            super::super::summary::Summary::of_landmarks(0.1, &super::describe::shares(&landmarks))
        };
        let (a, near, far) = (summary(0..20), summary(5..25), summary(40..60));
        assert!(a.similarity(&near) > a.similarity(&far) + 0.03, "{} {}", a.similarity(&near), a.similarity(&far));
        assert_eq!(super::super::Summary::decode(&a.encode()).unwrap(), a);
        let room = super::super::testing::room(1).summary;
        assert_eq!((a.similarity(&room), room.similarity(&a)), (0.0, 0.0));
    }
    let room = super::super::testing::room(1);
    let look = Look { frame: Sim3::identity(), sigma: 0.01, labelled: true, flat: false };
    let mine = kept(&look.at(&mut dice, &things, 0..20), 0.1);
    assert_eq!(register(&room.keypoints, &mine, &any_scale()), Err(LandmarkError::NotLandmarks));
}

#[test]
fn landmarks_on_the_wire_come_back_or_are_refused() {
    let mut dice = Dice::seed_from_u64(10);
    let things = world(&mut dice, 6, 5.0, false);
    let look = |labelled| Look { frame: Sim3::identity(), sigma: 0.02, labelled, flat: false };
    let mut landmarks = look(true).at(&mut dice, &things, 0..3);
    landmarks.extend(look(false).at(&mut dice, &things, 3..6));
    let keypoints = offered(&landmarks, 0.1);
    let bytes = keypoints.encode();
    for (a, b) in landmarks.iter().zip(keypoints.landmarks.as_ref().unwrap().landmarks()) {
        assert!((a.at - b.at).amax() < 0.001 && a.mark.label == b.mark.label && a.mark.descriptor == b.mark.descriptor);
        // Rounding never makes a landmark surer by more than a few percent in any direction.
        let least = (b.mark.covariance.matrix() - a.mark.covariance.matrix() * 0.9).symmetric_eigenvalues().min();
        assert!(least > 0.0, "{least}");
    }
    for len in 0..bytes.len() {
        assert!(Keypoints::decode(&bytes[..len]).is_err(), "cut to {len}");
    }
    assert!(Keypoints::decode(&[&bytes[..], &[0]].concat()).is_err());
    assert!(Features::decode(&bytes).is_err());
    for at in 0..bytes.len() {
        for bit in 0..8 {
            let mut bytes = bytes.clone();
            bytes[at] ^= 1 << bit;
            if let Ok(other) = Keypoints::decode(&bytes) {
                assert_eq!(other.encode(), bytes, "{at} {bit}");
            }
        }
    }
}

/// A dozen landmarks are enough, with or without wrong ones among them: similarities were once found among many only.
#[test]
fn a_dozen_landmarks_are_enough_for_a_similarity() {
    let mut dice = Dice::seed_from_u64(11);
    for (count, wrong) in [(10, 0), (12, 0), (12, 3), (16, 4), (40, 0), (40, 10)] {
        for trial in 0..20 {
            let mut things = world(&mut dice, count, 6.0, false);
            let scales = [0, 1].map(|_| libm::exp(dice.random_range(-1.0..1.0)));
            let looks = scales.map(|s| Look { frame: frame(&mut dice, s), sigma: 0.01, labelled: true, flat: false });
            let mine = looks[0].at(&mut dice, &things, 0..count);
            for thing in &mut things[..wrong] {
                thing.at = vector(&mut dice, 6.0);
            }
            let theirs = looks[1].at(&mut dice, &things, 0..count);
            let [my_voxel, their_voxel] = scales.map(|scale| 0.1 * scale);
            let solver = SolverConfig { sigma_max: 1.5 * my_voxel, ..any_scale().solver };
            let config = LandmarkConfig { solver, ..any_scale() };
            let answer = register(&offered(&theirs, their_voxel), &kept(&mine, my_voxel), &config);
            let found = answer.unwrap_or_else(|error| panic!("{count} with {wrong} wrong, {trial}: {error}"));
            let off = (looks[0].frame * looks[1].frame.inverse()).inverse() * found.t_mine_theirs.sim();
            assert!(off.rotation.angle() < 0.05 && libm::log(off.scale).abs() < 0.05, "a false alignment: {off:?}");
        }
    }
}
