//! Whether the views of a submap fit together where the SLAM put them. They do not where the intrinsics are of another
//! lens, the unit or the extrinsics are wrong, or the odometry is: then no alignment can mend what the submaps are, and
//! the user had better know. Of each submap the third keyframe is laid over the first: how far off do its points lie of
//! the planes that the first shows there? The median of [`WINDOW`] submaps decides.
//!
//! Measured on 7-Scenes (voxel 0.05 m, a third of a second between keyframes, drift of 0.1° and 3 mm at each): with the
//! right focal length such medians lie at 0.12 to 0.13 voxels, with five times the drift at 0.27 to 0.44, with half the
//! focal length at 0.77 to 1.80, with twice the unit at 0.44 to 1.35, with y upside down at 0.68 to 2.2.

use super::surface::least_axis;
use crate::geometry::Se3;
use nalgebra::Vector3;
use std::collections::VecDeque;

/// Points of the first view that are kept, at most.
const SURFACE_MAX: usize = 4096;
/// Points of the third view that are laid over it, at most.
const PROBES_MAX: usize = 256;
/// A probe farther off saw something else, voxels.
const REACH: f64 = 4.0;
/// Radius of the neighbourhood that a plane is fitted to, voxels.
const PLANE_RADIUS: f64 = 3.0;
/// Points that a plane needs.
const PLANE_POINTS_MIN: f64 = 6.0;
/// A plane is so wide for its length at least, and so thick for its width at most (ratios of variances).
const WIDTH_MIN: f64 = 0.04;
const THICKNESS_MAX: f64 = 0.1;
/// Fewer probes on planes say nothing.
const PLANES_MIN: usize = 32;
/// Submaps that are judged together.
pub const WINDOW: usize = 5;
/// The median misfit beyond which views do not fit together, voxels.
pub const MISFIT_MAX: f64 = 0.5;

/// The first view of an open submap, and how the third lies over it.
#[derive(Clone, Debug, Default)]
pub struct Views {
    first: Vec<[f32; 3]>,
    misfit: Option<f64>,
}

impl Views {
    /// Takes the `position`-th view: its points in the body frame, lengths in frame units.
    pub fn add(&mut self, position: usize, t_first_body: &Se3, points: &[[f32; 3]], voxel: f64) {
        match position {
            0 => self.first = at_most(points, SURFACE_MAX).copied().collect(),
            2 => {
                let first = std::mem::take(&mut self.first);
                self.misfit = misfit(&first, t_first_body, points, voxel);
            }
            _ => {}
        }
    }

    /// The misfit in voxels, if one could be measured.
    pub fn misfit(&self) -> Option<f64> {
        self.misfit
    }
}

/// The misfits of the last submaps.
#[derive(Clone, Debug, Default)]
pub struct Misfits {
    recent: VecDeque<f64>,
    told: bool,
}

impl Misfits {
    /// Takes the misfit of a finished submap. The median of the last ones, once, when it is too large.
    pub fn take(&mut self, misfit: Option<f64>) -> Option<f64> {
        if self.told {
            return None;
        }
        self.recent.extend(misfit);
        if self.recent.len() < WINDOW {
            return None;
        }
        while self.recent.len() > WINDOW {
            self.recent.pop_front();
        }
        let median = median(self.recent.iter().copied().collect())?;
        self.told = median > MISFIT_MAX;
        self.told.then_some(median)
    }
}

/// How far points lie off the planes of another view, in voxels: the median.
fn misfit(surface: &[[f32; 3]], t_surface_body: &Se3, points: &[[f32; 3]], voxel: f64) -> Option<f64> {
    let in_voxels = |p: Vector3<f64>| p / voxel;
    let surface: Vec<Vector3<f64>> = surface.iter().map(|p| in_voxels(Vector3::from(p.map(f64::from)))).collect();
    let off = |point: &[f32; 3]| {
        let at = in_voxels(*t_surface_body * Vector3::from(point.map(f64::from)));
        let squared = |p: &Vector3<f64>| (p - at).norm_squared();
        let nearest = surface.iter().min_by(|a, b| squared(a).total_cmp(&squared(b)))?;
        (squared(nearest) <= REACH * REACH).then(|| off_plane(&surface, nearest, &at))?
    };
    let offs: Vec<f64> = at_most(points, PROBES_MAX).filter_map(off).collect();
    if offs.len() < PLANES_MIN { None } else { median(offs) }
}

/// How far `at` lies off the plane of the surface about `nearest`, if it is one.
fn off_plane(surface: &[Vector3<f64>], nearest: &Vector3<f64>, at: &Vector3<f64>) -> Option<f64> {
    let (mut count, mut sum, mut products) = (0.0, Vector3::zeros(), [0.0; 6]);
    for d in surface.iter().map(|p| p - nearest).filter(|d| d.norm_squared() <= PLANE_RADIUS * PLANE_RADIUS) {
        count += 1.0;
        sum += d;
        let terms = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
        products.iter_mut().zip(terms).for_each(|(product, term)| *product += term);
    }
    if count < PLANE_POINTS_MIN {
        return None;
    }
    let m = sum / count;
    let squares = [m.x * m.x, m.x * m.y, m.x * m.z, m.y * m.y, m.y * m.z, m.z * m.z];
    let spread: [f64; 6] = std::array::from_fn(|k| products[k] / count - squares[k]);
    let (normal, [thickness, width, length]) = least_axis(&spread)?;
    let is_plane = width > WIDTH_MIN * length && thickness <= THICKNESS_MAX * width;
    is_plane.then(|| normal.dot(&(at - nearest - m)).abs())
}

/// At most so many of the points, evenly.
fn at_most(points: &[[f32; 3]], count: usize) -> impl Iterator<Item = &[f32; 3]> {
    points.iter().step_by(points.len().div_ceil(count).max(1))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::super::testing::room_points;
    use super::*;
    use crate::geometry::So3;

    /// What a camera at `t_room_camera` sees of a room, with lateral coordinates `scale` times too large.
    fn view(t_room_camera: &Se3, scale: f64) -> Vec<[f32; 3]> {
        let t_camera_room = t_room_camera.inverse();
        let seen = room_points(1).into_iter().map(|p| t_camera_room * p).filter(|p| {
            p.z > 0.2 && p.x.abs() < 0.55 * p.z && p.y.abs() < 0.41 * p.z // 58° by 45°
        });
        seen.map(|p| [(scale * p.x) as f32, (scale * p.y) as f32, p.z as f32]).collect()
    }

    /// The misfits of five submaps, of a camera that turns by `step` at each keyframe.
    fn turned(scale: f64, step: f64) -> Vec<Option<f64>> {
        let submap = |k: u32| {
            let pose = |n: f64| Se3::new(So3::exp(&Vector3::new(0.0, f64::from(k) + n * step, 0.0)), Vector3::zeros());
            let mut views = Views::default();
            for position in 0..3 {
                let t_first_body = pose(0.0).inverse() * pose(position as f64);
                views.add(position, &t_first_body, &view(&pose(position as f64), scale), 0.1);
            }
            assert!(views.first.is_empty(), "kept no longer than needed");
            views.misfit()
        };
        (0..5).map(submap).collect()
    }

    #[test]
    fn a_wrong_focal_length_is_told_once_and_a_right_one_is_not() {
        let told = |scale: f64| {
            let mut misfits = Misfits::default();
            turned(scale, 0.12)
                .into_iter()
                .cycle()
                .take(12)
                .filter_map(|misfit| misfits.take(misfit))
                .collect::<Vec<_>>()
        };
        assert_eq!(told(1.0), Vec::<f64>::new(), "{:?}", turned(1.0, 0.12));
        let half = told(585.0 / 300.0);
        assert!(half.len() == 1 && half[0] > MISFIT_MAX, "{half:?} of {:?}", turned(585.0 / 300.0, 0.12));
    }

    #[test]
    fn what_does_not_overlap_or_is_not_there_says_nothing() {
        assert!(turned(1.0, 0.8).iter().all(Option::is_none), "{:?}", turned(1.0, 0.8));
        assert_eq!(misfit(&[], &Se3::identity(), &[[1.0; 3]; 100], 0.1), None);
        assert_eq!(misfit(&[[1.0; 3]; 100], &Se3::identity(), &[[1.0; 3]; 100], 0.1), None, "one place is no plane");
        assert_eq!(misfit(&[[1.0; 3]; 100], &Se3::identity(), &[], 0.1), None);
    }

    #[test]
    fn it_takes_a_full_window_and_its_median() {
        let mut misfits = Misfits::default();
        assert!([Some(9.0), None, Some(9.0), Some(9.0), Some(9.0)].into_iter().all(|m| misfits.take(m).is_none()));
        assert_eq!(misfits.take(Some(0.0)), Some(9.0));
        assert_eq!(misfits.take(Some(9.0)), None, "once");
        let mut misfits = Misfits::default();
        let mixed = [MISFIT_MAX, 9.0, MISFIT_MAX, 9.0, MISFIT_MAX];
        assert!(mixed.into_iter().all(|m| misfits.take(Some(m)).is_none()), "at the bound is within it");
    }
}
