use super::*;
use crate::geometry::{Se3, So3};
use crate::submap::testing::{config, keyframe};
use crate::submap::{Submap, SubmapBuilder};
use nalgebra::Vector3;
use proptest::prelude::*;

/// A drive ahead of so many steps of 0.1 m with these standard deviations stated for each.
fn drive(steps: i64, sigmas: [f64; 6], of: CovarianceOf) -> (Vec<Submap>, Vec<Oddity>) {
    let config = SubmapConfig { distance_m: 1.0, ..config() };
    let mut builder = SubmapBuilder::new(config);
    let (mut submaps, mut oddities) = (Vec::new(), Vec::new());
    for k in 0..steps {
        let pose = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 0.01 * k as f64)), Vector3::new(0.1 * k as f64, 0.0, 0.0));
        let mut next = keyframe(k + 1, pose, &[Vector3::new(1.0, 2.0, 3.0)]);
        next.pose.covariance = Covariance::from_sigmas(sigmas).unwrap();
        next.covariance_of = of;
        submaps.extend(builder.push(next).unwrap());
        oddities.extend(builder.take_oddities());
    }
    (submaps, oddities)
}

#[test]
fn what_wheels_do_not_measure_ends_no_submap_and_is_named_once() {
    let measured = drive(60, [1e-3; 6], CovarianceOf::Motion);
    assert_eq!(measured.1, []);
    for wide in [1e3, 100.0, 5.0] {
        let (submaps, oddities) = drive(60, [1e-3, 1e-3, wide, wide, wide, 1e-3], CovarianceOf::Motion);
        assert_eq!(submaps.len(), measured.0.len(), "σ {wide}");
        let [Oddity::Unmeasured(axes)] = oddities[..] else { panic!("{oddities:?}") };
        assert_eq!(axes.to_string(), "z, roll, pitch");
        for (loose, tight) in submaps.iter().zip(&measured.0).skip(1) {
            let (loose, tight) = (loose.odometry.covariance.sigmas(), tight.odometry.covariance.sigmas());
            assert!(loose[2] > 10.0 * tight[2] && loose[3] > 3.0 * tight[3], "it is loose: {loose:?}");
            assert!(loose[2] < 0.2 && loose[3] < 0.1, "by a tenth of the way: {loose:?}");
            assert!((loose[0] - tight[0]).abs() < 1e-2 && (loose[5] - tight[5]).abs() < 1e-3, "what is measured stays");
        }
    }
    let (submaps, oddities) = drive(60, [1e-3, 1e-3, 1e3, 1e-3, 1e-3, 1e-3], CovarianceOf::Motion);
    assert_eq!((submaps.len(), oddities[0].to_string().contains("not measure z,")), (measured.0.len(), true));
}

#[test]
fn what_is_not_known_ahead_ends_submaps_and_the_axes_are_named() {
    for (sigmas, axes) in
        [([1.0, 1.0, 1.0, 1.0, 1.0, 1.0], "roll, pitch, yaw"), ([1e3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3], "x")]
    {
        let (submaps, oddities) = drive(30, sigmas, CovarianceOf::Motion);
        assert_eq!(submaps.len(), 29, "each keyframe is one");
        let [Oddity::Blurs(named)] = oddities[..] else { panic!("{oddities:?}") };
        assert_eq!(named.to_string(), axes);
    }
    let odd = |sigmas| drive(30, sigmas, CovarianceOf::Motion).1[0].to_string();
    assert!(odd([1e3, 1e3, 1e-3, 1e-3, 1e-3, 1e3]).contains("state translation first"));
    assert!(odd([1e3, 1e-3, 1e-3, 1e-3, 1e-3, 1e3]).contains("or raise submap.sigma_max_m"));
    let few = drive(i64::from(BLURRED_MAX), [1.0; 6], CovarianceOf::Motion).1;
    assert_eq!(few, [], "a few gaps in a row are no habit");
    assert_eq!(drive(i64::from(BLURRED_MAX) + 1, [1.0; 6], CovarianceOf::Motion).1.len(), 1);
}

#[test]
fn a_constant_pose_covariance_is_no_chain() {
    let sigmas = |submaps: &[Submap]| submaps[1].odometry.covariance.sigmas();
    let gap = config().gap_sigma_per_m;
    for wide in [0.05, 1e3] {
        let (submaps, oddities) = drive(60, [0.05, 0.05, wide, wide, wide, 0.05], CovarianceOf::Pose);
        // The first step is within a voxel, and may be of a robot that stands.
        assert_eq!((oddities.last(), oddities.len()), (Some(&Oddity::Constant), if wide < 1.0 { 1 } else { 2 }));
        let sigma = sigmas(&submaps)[0];
        assert!((0.2..2.0).contains(&(sigma / (gap * 0.1 * 10.0_f64.sqrt()))), "{sigma}: a tenth of each step");
    }
}

/// A chain whose errors add up in what is measured, and state 1e6 out of the plane throughout.
#[test]
fn a_chain_with_unmeasured_axes_gives_the_motions_of_one_without() {
    let chain = |wide: f64| {
        let (mut at, mut covariance) = (Se3::identity(), Covariance::from_sigmas([1e-3; 6]).unwrap());
        let mut before: Option<Keyframe> = None;
        let mut motions = Vec::new();
        for k in 0..20 {
            let step = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 0.05)), Vector3::new(0.1, 0.0, 0.0));
            let noise = Covariance::from_sigmas([2e-3; 6]).unwrap();
            let ad = step.inverse().adjoint();
            covariance = Covariance::new(ad * covariance.matrix() * ad.transpose() + noise.matrix()).unwrap();
            at = at * step;
            let mut next = keyframe(k + 1, at, &[]);
            next.covariance_of = CovarianceOf::Pose;
            let axes = Axes([false, false, true, true, true, false]);
            let loose = Covariance::from_sigmas([wide; 6]).unwrap();
            next.pose.covariance = if wide > 0.1 { axes.loosened(&covariance, &loose) } else { covariance };
            motions.extend(before.map(|last| crate::submap::odometry::motion(&last, &next, &config())));
            before = Some(next);
        }
        motions
    };
    for (loose, tight) in chain(1e3).iter().zip(&chain(0.05)) {
        let (loose, tight) = (loose.covariance.sigmas(), tight.covariance.sigmas());
        for axis in [0, 1, 5] {
            assert!((loose[axis] / tight[axis] - 1.0).abs() < 0.2, "{axis}: {loose:?} {tight:?}");
        }
        assert!(loose[2] > 2.0 * tight[2] && loose[2] < 1.0, "{loose:?}");
    }
}

proptest! {
    #[test]
    fn loosened_covariances_are_covariances_and_what_is_measured_stays(
        raw in prop::array::uniform32(-1.0..1.0_f64), wide in prop::array::uniform3(-3.0..4.0_f64),
    ) {
        let half = nalgebra::Matrix6::from_fn(|r, c| raw[(6 * r + c) % 32] * 0.05);
        let mut stated = half * half.transpose() + nalgebra::Matrix6::identity() * 1e-6;
        for (axis, exponent) in [2, 3, 4].into_iter().zip(wide) {
            stated[(axis, axis)] += libm::pow(10.0, 2.0 * exponent);
        }
        let stated = Covariance::new(stated).unwrap();
        let axes = Axes::unmeasured(&stated, &config());
        let loosened = axes.loosened(&stated, &Covariance::from_sigmas([0.1; 6]).unwrap());
        for r in 0..6 {
            for c in 0..6 {
                let want = match (axes.0[r] || axes.0[c], r == c) {
                    (false, _) => stated.matrix()[(r, c)],
                    (true, true) => 0.1 * 0.1,
                    (true, false) => 0.0,
                };
                prop_assert!((loosened.matrix()[(r, c)] - want).abs() < 1e-12);
            }
        }
        prop_assert!(Axes::unmeasured(&loosened, &config()).is_empty());
    }
}
