//! How drivers mark what they do not measure: by a variance of -1, or of 0, in z, roll or pitch. No covariance has these;
//! they stand for a variance that says the same.

use merganser_protocol::geometry::So3;
use nalgebra::Matrix6;

/// Variance of an axis that is not measured, m² or rad², as wheel odometry's drivers state it.
const UNMEASURED: f64 = 1e6;
/// Variance from which on z, roll or pitch say nothing, m² or rad²: 30 m of height, or more than any turn. Drivers
/// write 9999, 1e6 or the largest number that there is.
const SAYS_NOTHING: f64 = 1e3;
/// z, roll and pitch in a tangent (ρ, φ).
const AXES: [usize; 3] = [2, 3, 4];

/// `stated`, with [`UNMEASURED`] where an axis is marked and nothing is stated beside.
pub(super) fn marked_unmeasured(mut stated: Matrix6<f64>) -> Matrix6<f64> {
    for axis in AXES {
        let beside = (0..6).filter(|other| *other != axis).all(|other| stated[(axis, other)] == 0.0);
        if beside && (stated[(axis, axis)] == 0.0 || stated[(axis, axis)] == -1.0) {
            stated[(axis, axis)] = UNMEASURED;
        }
    }
    stated
}

/// A covariance of a pose as ROS states it, 6×6 in (ρ, φ) along and about the axes of the frame in which the body is
/// turned by `r_fixed_body`, along and about those of the body. What it leaves unmeasured of z, roll and pitch is a
/// habit of the driver and no direction in the world: turned with the rest, a thousand metres of height would become
/// twenty along the way of a robot that pitches by a degree. It is that of the body's axes, [`UNMEASURED`], and the rest
/// is turned alone.
pub(super) fn of_body(stated: &Matrix6<f64>, r_fixed_body: &So3) -> Matrix6<f64> {
    let mut known = marked_unmeasured(*stated);
    let blank = |of: &mut Matrix6<f64>, axis: usize, variance: f64| {
        of.row_mut(axis).fill(0.0);
        of.column_mut(axis).fill(0.0);
        of[(axis, axis)] = variance;
    };
    let open: Vec<usize> = AXES.into_iter().filter(|axis| known[(*axis, *axis)] >= SAYS_NOTHING).collect();
    open.iter().for_each(|axis| blank(&mut known, *axis, 0.0));
    let r = r_fixed_body.matrix().transpose();
    let mut turn = Matrix6::zeros();
    turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
    turn.fixed_view_mut::<3, 3>(3, 3).copy_from(&r);
    let mut turned = turn * known * turn.transpose();
    open.iter().for_each(|axis| blank(&mut turned, *axis, UNMEASURED));
    turned
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_out_of_the_plane_stand_for_what_is_not_measured_and_others_stay() {
        for mark in [0.0, -1.0] {
            let diagonal = [1e-4, 1e-4, mark, mark, mark, 1e-4];
            let stated = marked_unmeasured(Matrix6::from_diagonal(&diagonal.into()));
            let want = [1e-4, 1e-4, UNMEASURED, UNMEASURED, UNMEASURED, 1e-4];
            assert_eq!(stated, Matrix6::from_diagonal(&want.into()));
            for axis in [0, 1, 5] {
                let mut stated = Matrix6::identity();
                stated[(axis, axis)] = mark;
                assert_eq!(marked_unmeasured(stated), stated, "what a robot must measure");
            }
        }
        let mut correlated = Matrix6::identity();
        (correlated[(2, 2)], correlated[(2, 0)], correlated[(0, 2)]) = (0.0, 0.1, 0.1);
        assert_eq!(marked_unmeasured(correlated), correlated, "a mistake, which is told");
        let small = Matrix6::from_diagonal_element(1e-9);
        assert_eq!(marked_unmeasured(small), small);
    }

    #[test]
    fn what_is_not_measured_stays_out_of_what_is_however_the_body_is_turned() {
        let turned = So3::exp(&nalgebra::Vector3::new(0.01, 0.02, 1.2));
        for open in [0.0, -1.0, 9999.0, 1e6, 1e12, f64::MAX] {
            let stated = Matrix6::from_diagonal(&[1e-4, 1e-2, open, open, open, 1e-3].into());
            let body = of_body(&stated, &turned);
            for axis in AXES {
                let mut row = body.row(axis).into_owned();
                assert_eq!(row[axis], UNMEASURED);
                row[axis] = 0.0;
                assert_eq!(row.amax(), 0.0, "{open}");
            }
            assert!(body[(0, 0)] < 1.1e-2 && body[(1, 1)] < 1.1e-2 && body[(5, 5)] <= 1e-3, "{open}: {body}");
            assert!(body[(0, 0)] > 0.9 * (1e-4 * 0.13 + 1e-2 * 0.86), "along x lies most of what was y: {body}");
        }
        // What is measured turns as a whole.
        let stated = Matrix6::from_diagonal(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0].into());
        let quarter = So3::exp(&nalgebra::Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0));
        let want = Matrix6::from_diagonal(&[1.0, 3.0, 2.0, 4.0, 6.0, 5.0].into());
        assert!((of_body(&stated, &quarter) - want).amax() < 1e-12);
    }
}
