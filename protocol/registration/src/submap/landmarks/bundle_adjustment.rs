//! Where the landmarks of a submap lie: the least-squares solution of the motions between its keyframes and all
//! sightings, with the anchor fixed (bundle adjustment; landmarks are eliminated first, Schur). So a landmark seen at
//! the end of a submap is as uncertain about its anchor as the way between is, and sightings of one landmark from two
//! places tell how the body turned meanwhile.
//!
//! Motions and sightings are taken as independent. Only the landmarks are used of the solution: the odometry between
//! submaps stays what the motions say, so what was seen counts once, in the alignments.
//!
//! A sighting that contradicts the others of its landmark is left out; a landmark whose sightings mostly contradict
//! each other is left out altogether: its label lies.

use super::gather::{Seen, Sighting};
use super::{Constellation, Landmark, Mark, SIGMA_RANGE};
use crate::geometry::so3::hat;
use crate::geometry::{Covariance, PoseWithCovariance, Se3};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix3x6, Matrix6, Matrix6x3, Vector3, Vector6};

/// Keyframes of a submap that are adjusted; those of a longer one stay where the motions put them.
pub const KEYFRAMES_MAX: usize = 64;
/// Gauss–Newton steps per round.
const STEPS: usize = 4;
/// Rounds in which contradicting sightings are left out.
const ROUNDS: usize = 4;
/// A sighting contradicts beyond this squared distance (χ²₃, 99.9 %).
const CHI2_MAX: f64 = 16.27;
/// Information that holds the anchor fixed.
const FIXED: f64 = 1e14;
/// Share of its sightings that may contradict a landmark.
const CONTRADICTED_MAX: f64 = 0.34;
/// Least share of the smallest eigenvalue in a system of full rank.
const RANK: f64 = 1e-6;
/// What the constellation takes up of a landmark's own noise is given back in part: others may share only some of it.
const OWN_KEPT: f64 = 0.5;

/// Landmarks in the anchor frame, those of most sightings first. `motions[k]` leads from keyframe k to the next,
/// `start` is `t_anchor_body` of each by the motions alone, and `anchor` is the one that stays.
pub fn adjust(seen: &[Seen], motions: &[PoseWithCovariance], start: &[Se3], anchor: usize) -> Constellation {
    let mut problem = Problem::new(seen, motions, start, anchor);
    problem.screen();
    for round in 0..ROUNDS {
        problem.solve();
        if round + 1 == ROUNDS || !problem.leave_out() {
            break;
        }
    }
    let common = problem.tell_apart();
    let mut landmarks = problem.landmarks(seen);
    landmarks.sort_by_key(|landmark| core::cmp::Reverse(landmark.sightings));
    Constellation { landmarks, common: common.unwrap_or(Constellation::default().common) }
}

/// A landmark while it is sought.
struct Sought {
    at: Vector3<f64>,
    sightings: Vec<Sighting>,
    left_out: usize,
    /// Of its place with all bodies as they are, once solved.
    covariance: Matrix3<f64>,
}

struct Problem<'a> {
    motions: &'a [PoseWithCovariance],
    anchor: usize,
    bodies: Vec<Se3>,
    sought: Vec<Sought>,
}

/// A landmark's part of the normal equations: with the keyframes that see it, its own block inverted.
struct Parts {
    seers: Vec<(usize, Matrix3x6<f64>)>,
    inverse: Matrix3<f64>,
    gradient: Vector3<f64>,
}

impl<'a> Problem<'a> {
    fn new(seen: &[Seen], motions: &'a [PoseWithCovariance], start: &[Se3], anchor: usize) -> Self {
        let sought = |seen: &Seen| {
            let mut all = seen.sightings.clone();
            all.retain(|s| usize::from(s.keyframe) < start.len());
            Sought { at: median_place(&all, start), sightings: all, left_out: 0, covariance: Matrix3::zeros() }
        };
        Self { motions, anchor, bodies: start.to_vec(), sought: seen.iter().map(sought).collect() }
    }

    fn adjusts(&self) -> bool {
        (2..=KEYFRAMES_MAX).contains(&self.bodies.len()) && self.motions.len() + 1 == self.bodies.len()
    }

    /// Leaves out what contradicts the middle place of its landmark however the body may have drifted, before it bends
    /// the solution. A landmark of which that is much loses all.
    fn screen(&mut self) {
        let (Some(drifts), bodies) = (self.drifts(), &self.bodies) else { return };
        for sought in &mut self.sought {
            let all = sought.sightings.len();
            let middle = sought.at;
            sought.sightings.retain(|s| {
                let k = usize::from(s.keyframe);
                let off = bodies[k].inverse() * middle - s.at;
                let mut j = Matrix3x6::zeros();
                j.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
                j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-hat(&s.at));
                // The middle place is no surer than one sighting.
                let covariance = s.covariance * 2.0 + j * drifts[k] * j.transpose();
                covariance.cholesky().is_some_and(|c| off.dot(&c.solve(&off)) <= CHI2_MAX)
            });
            sought.left_out = all - sought.sightings.len();
            if sought.left_out as f64 > CONTRADICTED_MAX * all as f64 {
                sought.sightings.clear();
            }
        }
    }

    /// Covariance of each body about the anchor, by the motions alone; `None` where they do not fit the bodies.
    fn drifts(&self) -> Option<Vec<Matrix6<f64>>> {
        if self.motions.len() + 1 != self.bodies.len() {
            return None;
        }
        let mut drifts = vec![Matrix6::zeros(); self.bodies.len()];
        for k in self.anchor..self.motions.len() {
            let ad = self.motions[k].pose.inverse().adjoint();
            drifts[k + 1] = ad * drifts[k] * ad.transpose() + self.motions[k].covariance.matrix();
        }
        for k in (0..self.anchor).rev() {
            let ad = self.motions[k].pose.adjoint();
            drifts[k] = ad * (drifts[k + 1] + self.motions[k].covariance.matrix()) * ad.transpose();
        }
        Some(drifts)
    }

    /// Splits the landmarks' covariances into what they have in common, which is returned, and what is each one's own,
    /// which stays. With e the errors and J δ the rigid motion that explains them best: the covariances of δ and of e −
    /// J δ.
    fn tell_apart(&mut self) -> Option<Covariance<6>> {
        let parts: Vec<Option<Parts>> = self.sought.iter().map(|s| self.parts(s)).collect();
        let inverse = if self.adjusts() { Some(self.adjust(&parts)?.0) } else { None };
        let n = 6 * self.bodies.len();
        let (mut normal, mut own, mut bodies) = (Matrix6::zeros(), Matrix6::zeros(), DMatrix::<f64>::zeros(6, n));
        let used = || self.sought.iter().zip(&parts).filter_map(|(s, p)| Some((s, p.as_ref()?)));
        for (sought, parts) in used() {
            let (j, w) = (rigid(&sought.at), 1.0 / sought.covariance.trace());
            normal += j.transpose() * j * w;
            own += j.transpose() * parts.inverse * j * (w * w);
            for (k, cross) in &parts.seers {
                let mut view = bodies.fixed_view_mut::<6, 6>(0, 6 * k);
                view += j.transpose() * parts.inverse * cross * w;
            }
        }
        // Landmarks on a line leave a turn about it open: nothing is told apart then.
        let values = normal.symmetric_eigenvalues();
        let solved = normal.try_inverse().filter(|_| values.min() > RANK * values.max())?;
        // Z Sb of every body, and Z Sb Zᵀ.
        let mut carried = DMatrix::<f64>::zeros(6, n);
        let mut shared = Matrix6::zeros();
        if let Some(inverse) = &inverse {
            for k in 0..self.bodies.len() {
                let mut sum = Matrix6::zeros();
                for l in 0..self.bodies.len() {
                    sum += bodies.fixed_view::<6, 6>(0, 6 * l) * inverse.fixed_view::<6, 6>(6 * l, 6 * k);
                }
                carried.fixed_view_mut::<6, 6>(0, 6 * k).copy_from(&sum);
                shared += sum * bodies.fixed_view::<6, 6>(0, 6 * k).transpose();
            }
        }
        let common = solved * (own + shared) * solved;
        for (sought, parts) in self.sought.iter_mut().zip(&parts) {
            let Some(parts) = parts else { continue };
            let (j, w) = (rigid(&sought.at), 1.0 / sought.covariance.trace());
            // Covariance of δ with this landmark's error.
            let mut with: Matrix6x3<f64> = j.transpose() * parts.inverse * w;
            for (k, cross) in &parts.seers {
                with += carried.fixed_view::<6, 6>(0, 6 * k) * (parts.inverse * cross).transpose();
            }
            let both = j * solved * with;
            let left = sought.covariance - both - both.transpose() + j * common * j.transpose();
            sought.covariance = left + parts.inverse * OWN_KEPT;
        }
        Covariance::new(common).ok()
    }

    fn solve(&mut self) {
        for _ in 0..STEPS {
            if self.step().is_none() {
                break;
            }
        }
    }

    /// One Gauss–Newton step; the landmarks' covariances are those before it. `None` if it cannot be taken.
    fn step(&mut self) -> Option<()> {
        let parts: Vec<Option<Parts>> = self.sought.iter().map(|s| self.parts(s)).collect();
        let inverse = if self.adjusts() { Some(self.adjust(&parts)?) } else { None };
        for (sought, parts) in self.sought.iter_mut().zip(&parts) {
            let Some(parts) = parts else { continue };
            let mut pull = parts.gradient;
            let mut spread = Matrix3::zeros();
            if let Some((bodies, step)) = &inverse {
                for (k, cross) in &parts.seers {
                    pull += cross * step.fixed_rows::<6>(6 * k);
                    for (l, other) in &parts.seers {
                        spread += cross * bodies.fixed_view::<6, 6>(6 * k, 6 * l) * other.transpose();
                    }
                }
            }
            sought.at -= parts.inverse * pull;
            sought.covariance = parts.inverse + parts.inverse * spread * parts.inverse;
        }
        if let Some((_, step)) = inverse {
            for (k, body) in self.bodies.iter_mut().enumerate().filter(|(k, _)| *k != self.anchor) {
                *body = body.retract(&step.fixed_rows::<6>(6 * k).into_owned());
            }
        }
        Some(())
    }

    /// The inverse of the reduced system of the bodies, and the step of them that it asks for.
    fn adjust(&self, parts: &[Option<Parts>]) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let n = 6 * self.bodies.len();
        let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
        let mut add = |r: usize, c: usize, block: &Matrix6<f64>| {
            let mut view = h.fixed_view_mut::<6, 6>(6 * r, 6 * c);
            view += block;
        };
        add(self.anchor, self.anchor, &Matrix6::from_diagonal_element(FIXED));
        for (k, motion) in self.motions.iter().enumerate() {
            let between = self.bodies[k].inverse() * self.bodies[k + 1];
            let error = motion.pose.local(&between);
            let information = motion.covariance.information();
            let j = -between.inverse().adjoint();
            add(k, k, &(j.transpose() * information * j));
            add(k, k + 1, &(j.transpose() * information));
            add(k + 1, k, &(information * j));
            add(k + 1, k + 1, &information);
            let (a, b): (Vector6<f64>, Vector6<f64>) = (j.transpose() * information * error, information * error);
            let mut rows = g.fixed_rows_mut::<6>(6 * k);
            rows += a;
            let mut rows = g.fixed_rows_mut::<6>(6 * (k + 1));
            rows += b;
        }
        for (sought, parts) in self.sought.iter().zip(parts) {
            let Some(parts) = parts else { continue };
            for sighting in &sought.sightings {
                let k = usize::from(sighting.keyframe);
                let Some((j, information, error)) = self.sighting(sought, sighting) else { continue };
                add(k, k, &(j.transpose() * information * j));
                let pull: Vector6<f64> = j.transpose() * information * error;
                let mut rows = g.fixed_rows_mut::<6>(6 * k);
                rows += pull;
            }
            for (k, cross) in &parts.seers {
                let carried = cross.transpose() * parts.inverse;
                for (l, other) in &parts.seers {
                    add(*k, *l, &-(carried * other));
                }
                let pull: Vector6<f64> = carried * parts.gradient;
                let mut rows = g.fixed_rows_mut::<6>(6 * k);
                rows -= pull;
            }
        }
        let solver = h.cholesky()?;
        let step = -solver.solve(&g);
        step.iter().all(|x| x.is_finite()).then(|| (solver.inverse(), step))
    }

    /// Jacobian of a sighting's error about its body's local perturbation, information, and the error. About the
    /// landmark it is the body's rotation, transposed.
    fn sighting(&self, sought: &Sought, sighting: &Sighting) -> Option<(Matrix3x6<f64>, Matrix3<f64>, Vector3<f64>)> {
        let at = self.bodies[usize::from(sighting.keyframe)].inverse() * sought.at;
        let mut j = Matrix3x6::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-Matrix3::identity());
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&hat(&at));
        Some((j, sighting.covariance.try_inverse()?, at - sighting.at))
    }

    fn parts(&self, sought: &Sought) -> Option<Parts> {
        let (mut h, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        let mut seers: Vec<(usize, Matrix3x6<f64>)> = Vec::new();
        for sighting in &sought.sightings {
            let (j, information, error) = self.sighting(sought, sighting)?;
            let k = usize::from(sighting.keyframe);
            let turn = self.bodies[k].rotation.matrix();
            h += turn * information * turn.transpose();
            gradient += turn * information * error;
            let cross = turn * information * j;
            match seers.last_mut().filter(|(last, _)| *last == k) {
                Some((_, sum)) => *sum += cross,
                None => seers.push((k, cross)),
            }
        }
        Some(Parts { seers, inverse: h.try_inverse()?, gradient })
    }

    /// Leaves out of each landmark the sighting that contradicts the others most; whether there was any.
    fn leave_out(&mut self) -> bool {
        let worst = |sought: &Sought| -> Option<usize> {
            let off = |(k, sighting): (usize, &Sighting)| {
                let (_, information, error) = self.sighting(sought, sighting)?;
                Some((error.dot(&(information * error)), k))
            };
            let worst = sought.sightings.iter().enumerate().filter_map(off).max_by(|a, b| a.0.total_cmp(&b.0))?;
            (worst.0 > CHI2_MAX).then_some(worst.1)
        };
        let all: Vec<Option<usize>> = self.sought.iter().map(worst).collect();
        for (sought, worst) in self.sought.iter_mut().zip(&all) {
            if let Some(k) = *worst {
                sought.sightings.remove(k);
                sought.left_out += 1;
            }
        }
        all.iter().any(Option::is_some)
    }

    fn landmarks(&self, seen: &[Seen]) -> Vec<Landmark> {
        let landmark = |(sought, seen): (&Sought, &Seen)| {
            let kept = sought.sightings.len();
            let lies = sought.left_out as f64 > CONTRADICTED_MAX * (kept + sought.left_out) as f64;
            let still = sought.sightings.iter().any(|s| {
                self.sighting(sought, s).is_none_or(|(_, information, e)| e.dot(&(information * e)) > 4.0 * CHI2_MAX)
            });
            if kept == 0 || lies || still || !sought.at.iter().all(|x| x.is_finite()) {
                return None;
            }
            let covariance = Covariance::new(sought.covariance).ok()?;
            if !covariance.sigmas().iter().all(|sigma| SIGMA_RANGE.contains(sigma)) {
                return None;
            }
            let mark = Mark { covariance, label: seen.label, descriptor: seen.descriptor };
            Some(Landmark { at: sought.at, mark, sightings: seen.count })
        };
        self.sought.iter().zip(seen).filter_map(landmark).collect()
    }
}

/// How a place moves with the whole: exp(δ) moves it by this times δ.
fn rigid(at: &Vector3<f64>) -> Matrix3x6<f64> {
    let mut j = Matrix3x6::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-hat(at));
    j
}

/// The middle one of the places that the sightings name, axis by axis: a few wrong ones do not move it.
fn median_place(sightings: &[Sighting], bodies: &[Se3]) -> Vector3<f64> {
    let places: Vec<Vector3<f64>> = sightings.iter().map(|s| bodies[usize::from(s.keyframe)] * s.at).collect();
    Vector3::from_fn(|axis, _| {
        let mut values: Vec<f64> = places.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    })
}
