//! How drivers mark what they do not measure: by a variance of -1, or of 0, in z, roll or pitch. No covariance has these;
//! they stand for a variance that says the same.

use nalgebra::Matrix6;

/// Variance of an axis that is not measured, m² or rad², as wheel odometry's drivers state it.
const UNMEASURED: f64 = 1e6;
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
}
