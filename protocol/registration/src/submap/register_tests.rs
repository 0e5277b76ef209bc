use super::super::Described;
use super::super::testing::{config, moved_room, room, room_points, submap};
use super::*;
use crate::submap::{Up, describe};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn settings() -> RegisterConfig {
    RegisterConfig { solver: SolverConfig { sigma_max: 0.15, ..Default::default() }, ..Default::default() }
}

fn registered(theirs: &Described, mine: &Described) -> Result<Registered, RegisterError> {
    register(&theirs.keypoints, &mine.features, &settings())
}

#[test]
fn one_room_from_two_places_is_aligned_and_another_room_is_not() {
    for (seed, turn) in [(6, Vector3::new(0.4, -0.3, 1.9)), (8, Vector3::new(-2.0, 1.0, 0.5))] {
        let (theirs, t_theirs_mine) = moved_room(seed, turn, Vector3::new(0.3, 0.1, 0.05));
        let found = registered(&theirs, &room(seed)).unwrap();
        let error = found.refined.pose.pose.local(&t_theirs_mine.inverse());
        assert!(error.fixed_rows::<3>(0).norm() < 0.01 && error.fixed_rows::<3>(3).norm() < 0.005, "{error}");
        assert!(found.refined.pose.covariance.mahalanobis_squared(&error) < 12.6);
        assert!(found.fit > 0.9 && found.contradiction < 0.02 && found.log10_nfa < -10.0, "{found:?}");
        // The same to the bit, whichever side's descriptors were computed before.
        assert_eq!(registered(&theirs, &room(seed)), Ok(found));
        let refused = registered(&theirs, &room(seed + 1)).unwrap_err();
        assert!(!matches!(refused, RegisterError::Solver(_)), "{refused}");
    }
}

/// A bare corridor fits itself wherever it is slid along.
#[test]
fn a_corridor_is_ambiguous() {
    let tube = |shift: f64| {
        let at = |k: i32| {
            let (along, around) = (f64::from(k / 80) * 0.08 - 12.0 + shift, f64::from(k % 80) * 0.1);
            let (y, z) = match (around / 2.0) as u32 {
                0 => (around - 1.0, -1.0),
                1 => (1.0, around - 3.0),
                2 => (5.0 - around, 1.0),
                _ => (-1.0, 7.0 - around),
            };
            Vector3::new(along, y, z)
        };
        let points: Vec<_> = (0..24_000).map(at).collect();
        describe(&submap(&points), &config())
    };
    let refused = registered(&tube(0.0), &tube(1.3)).unwrap_err();
    assert!(
        matches!(refused, RegisterError::Ambiguous { .. } | RegisterError::Refine(RefineError::Degenerate { .. })),
        "{refused}"
    );
}

#[test]
fn submaps_without_shape_are_refused_and_settings_checked() {
    let line: Vec<_> = (0..400).map(|k| Vector3::new(f64::from(k) * 0.05, 0.0, 0.0)).collect();
    let place = vec![Vector3::new(1.0, 2.0, 3.0); 400];
    let plane: Vec<_> =
        (0..6400).map(|k| Vector3::new(f64::from(k % 80) * 0.05, f64::from(k / 80) * 0.05, 2.0)).collect();
    let shapeless = [&[][..], &line, &place, &plane].map(|points| describe(&submap(points), &config()));
    for theirs in &shapeless {
        for mine in shapeless.iter().chain([&room(1)]) {
            registered(theirs, mine).unwrap_err();
            registered(mine, theirs).unwrap_err();
        }
    }
    let mut bad = settings();
    bad.solver.sigma_max = f64::NAN;
    let refused = register(&room(1).keypoints, &room(1).features, &bad);
    assert!(matches!(refused, Err(RegisterError::Solver(AlignError::BadConfig { field: "sigma_max", .. }))));
}

/// A hall furnished alike on both sides may be entered from either.
#[test]
fn a_room_that_is_its_own_half_turn_is_ambiguous() {
    let twice = |seed: u64| {
        let half = room_points(6);
        let points: Vec<_> = half.iter().flat_map(|p| [*p, Vector3::new(-p.x, -p.y, p.z)]).collect();
        // Both sides see other points of it.
        let some = points.chunks(2).skip(seed as usize).step_by(2).flatten().copied();
        describe(&submap(&some.collect::<Vec<_>>()), &config())
    };
    let refused = registered(&twice(0), &twice(1)).unwrap_err();
    assert!(matches!(refused, RegisterError::Ambiguous { elsewhere: false, .. }), "{refused:?}");
}

/// A silo looks the same however one is turned in it.
#[test]
fn a_round_room_is_ambiguous() {
    let silo = |seed: u64| {
        let mut dice = ChaCha8Rng::seed_from_u64(seed);
        let at = |_| {
            let (angle, kind) = (dice.random_range(0.0..core::f64::consts::TAU), dice.random_range(0..3u8));
            let (radius, z) = match kind {
                0 => (1.5, dice.random_range(-1.0..1.5)),
                1 => (1.5 * dice.random_range(0.0..1.0f64).sqrt(), -1.0),
                _ => (1.5 * dice.random_range(0.0..1.0f64).sqrt(), 1.5),
            };
            Vector3::new(radius * libm::cos(angle), radius * libm::sin(angle), z)
        };
        describe(&submap(&(0..30_000).map(at).collect::<Vec<_>>()), &config())
    };
    let refused = registered(&silo(1), &silo(2)).unwrap_err();
    assert!(matches!(refused, RegisterError::Ambiguous { elsewhere: false, .. }), "{refused:?}");
}

/// Clouds that were thinned differently show different things; a little difference does no harm.
#[test]
fn clouds_of_other_voxels_are_refused() {
    let theirs = |factor: f64| {
        let mut config = config();
        config.voxel_m *= factor;
        describe(&submap(&room_points(6)), &config)
    };
    for (factor, refused) in [(0.6, true), (0.7, false), (1.45, false), (1.55, true)] {
        let answer = registered(&theirs(factor), &room(6));
        assert_eq!(matches!(answer, Err(RegisterError::Thinning { .. })), refused, "{factor}: {answer:?}");
    }
}

/// Whoever repeats a keypoint would have it count more than once.
#[test]
fn keypoints_on_one_spot_are_refused() {
    let mine = room(6);
    let theirs = |share: f64| {
        let mut keypoints = moved_room(6, Vector3::new(0.4, -0.3, 1.9), Vector3::new(0.3, 0.1, 0.05)).0.keypoints;
        let (first, repeated) = (keypoints.block.points[0], (share * keypoints.len() as f64) as usize);
        keypoints.block.points[..repeated].fill(first);
        keypoints
    };
    let answer = |share| register(&theirs(share), &mine.features, &settings());
    assert!(answer(0.05).is_ok());
    assert!(matches!(answer(0.15), Err(RegisterError::Crowded { .. })));
}

/// Their submap, with what is up in it and in mine, where mine is tilted by `tilt` against the truth.
fn with_verticals(t_theirs_mine: &Se3, tilt: f64, sigma: f64) -> RegisterConfig {
    let up = |direction: Vector3<f64>| Up::new(direction.into(), sigma).unwrap();
    let theirs = up(t_theirs_mine.rotation * Vector3::z());
    let mine = up(So3::exp(&Vector3::new(tilt, 0.0, 0.0)) * Vector3::z());
    RegisterConfig { verticals: Some(Verticals { theirs, mine }), ..settings() }
}

#[test]
fn a_pose_that_tilts_what_is_upright_is_refused() {
    let (theirs, t_theirs_mine) = moved_room(6, Vector3::new(0.4, -0.3, 1.9), Vector3::new(0.3, 0.1, 0.05));
    let mine = room(6);
    let of = |tilt, sigma| register(&theirs.keypoints, &mine.features, &with_verticals(&t_theirs_mine, tilt, sigma));
    let unaware = registered(&theirs, &mine).unwrap();
    let found = of(0.0, 0.02).unwrap();
    let off = found.refined.pose.pose.local(&unaware.refined.pose.pose);
    assert!(off.norm() < 5e-3, "what is upright is found as before: {off}");
    assert!(of(0.05, 0.02).is_ok(), "a little over the sum of the standard deviations");
    // The one good pose tilts by 20 degrees, and is not even looked at.
    let tilted = of(20_f64.to_radians(), 0.02).unwrap_err();
    assert!(matches!(tilted, RegisterError::NoConsensus { .. }), "{tilted}");
    assert!(of(20_f64.to_radians(), 0.1).is_ok(), "unless little is known");
    // What polishing may correct, and what it may not.
    let refused = of(0.15, 0.02).unwrap_err();
    assert!(matches!(refused, RegisterError::NoConsensus { .. } | RegisterError::Tilted { .. }), "{refused}");
}

/// A box of a room looks much the same turned on its side; whoever knows what is up is not in doubt.
#[test]
fn what_is_up_settles_which_way_a_cube_lies() {
    let faces = |turn: So3, some: usize| {
        let mut dice = ChaCha8Rng::seed_from_u64(some as u64);
        // An L of bumps on each wall, the same on all that a quarter turn about the x axis leads to.
        let mut points = Vec::new();
        for quarter in 0..4 {
            let roll = So3::exp(&Vector3::new(f64::from(quarter) * core::f64::consts::FRAC_PI_2, 0.0, 0.0));
            for _ in 0..7000 {
                let (x, y) = (dice.random_range(-2.0..2.0), dice.random_range(-1.5..1.5));
                let bump = if x > 0.5 && y > 0.3 && x + y < 2.4 { 0.5 } else { 0.0 };
                points.push(turn * (roll * Vector3::new(x, y, 1.5 - bump)));
            }
        }
        for _ in 0..5000 {
            let (y, z): (f64, f64) = (dice.random_range(-1.5..1.5), dice.random_range(-1.5..1.5));
            points.push(turn * Vector3::new(2.0, y, z));
        }
        describe(&submap(&points), &config())
    };
    let turn = So3::exp(&Vector3::new(0.2, -0.1, 1.3));
    let (theirs, mine) = (faces(turn, 1), faces(So3::identity(), 2));
    let unaware = registered(&theirs, &mine).unwrap_err();
    assert!(matches!(unaware, RegisterError::Ambiguous { .. }), "{unaware}");
    let t_theirs_mine = Se3::new(turn, Vector3::zeros());
    let aware = register(&theirs.keypoints, &mine.features, &with_verticals(&t_theirs_mine, 0.0, 0.02)).unwrap();
    let off = aware.refined.pose.pose.local(&t_theirs_mine.inverse());
    assert!(off.norm() < 0.05, "{off}");
}
