use super::super::Described;
use super::super::testing::{config, moved_room, room, submap};
use super::*;
use crate::submap::describe;

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
