//! What my sensor looked through, from each of my keyframes: the six faces of a cube around it, in pixels of about one
//! degree that hold the nearest range. The same question as [`contradiction`](super::contradiction) asks, for many
//! poses: no trigonometry, no search. Lengths are in voxels.

use super::features::Features;
use core::ops::RangeInclusive;
use nalgebra::Vector3;

/// Pixels along an edge of a face.
const PIXELS: usize = 96;
/// Keyframes that are asked at most.
const VIEWS_MAX: usize = 16;
/// I looked through a place if all that I saw in its direction lies this far behind it...
const BEHIND: f32 = 4.0;
/// ...and nothing nearer passes by the line of sight at less than this.
const SHADOW: f32 = 1.5;
/// Half width, in pixels, of the window about the line of sight at most: what stands nearer to the sensor is not
/// judged.
const WINDOW_MAX: usize = 8;

/// All views of a submap.
pub struct Views(Vec<View>);

struct View {
    from: Vector3<f64>,
    /// The nearest range in each pixel of each face; infinite where nothing was seen.
    nearest: Vec<f32>,
    /// Whether this keyframe itself saw something there or in a pixel beside it.
    seen: Vec<bool>,
}

impl Views {
    /// From one's own features, which lie at `points`.
    pub fn new(mine: &Features, points: &[[f32; 3]]) -> Self {
        let viewpoints = mine.viewpoints();
        let view = |(k, from): (usize, &Vector3<f64>)| {
            let mut view = View {
                from: from / mine.voxel(),
                nearest: vec![f32::INFINITY; 6 * PIXELS * PIXELS],
                seen: vec![false; 6 * PIXELS * PIXELS],
            };
            let mut seen = vec![false; view.seen.len()];
            for (p, &by) in points.iter().zip(mine.seen_from()) {
                let offset = Vector3::from(p.map(f64::from)) - view.from;
                let Some((face, u, v)) = pixel(&offset) else { continue };
                let (at, range) = (position(face, u, v), offset.norm() as f32);
                view.nearest[at] = view.nearest[at].min(range);
                if usize::from(by) == k && !seen[at] {
                    seen[at] = true;
                    for u in around(u, 1) {
                        view.seen[position(face, u, 0)..][around(v, 1)].fill(true);
                    }
                }
            }
            view
        };
        Self(viewpoints.iter().take(VIEWS_MAX).enumerate().map(view).collect())
    }

    /// Whether some keyframe looked through the place.
    pub fn looked_through(&self, at: &Vector3<f64>) -> bool {
        self.0.iter().any(|view| view.looked_through(at))
    }
}

impl View {
    fn looked_through(&self, at: &Vector3<f64>) -> bool {
        let offset = at - self.from;
        let Some((face, u, v)) = pixel(&offset) else { return false };
        // Most places lie where this keyframe saw nothing, or something nearer.
        let middle = position(face, u, v);
        if !self.seen[middle] {
            return false;
        }
        let range = offset.norm() as f32;
        let behind = range + BEHIND;
        if self.nearest[middle] < behind {
            return false;
        }
        // A pixel in the middle of a face is 2 / PIXELS wide at unit distance.
        let window = (SHADOW / range * PIXELS as f32 / 2.0).ceil() as usize;
        if window > WINDOW_MAX {
            return false;
        }
        let free = |row: &[f32]| row.iter().fold(true, |free, nearest| free & (*nearest >= behind));
        around(u, window).all(|u| free(&self.nearest[position(face, u, 0)..][around(v, window)]))
    }
}

/// Face and pixel of a place, as seen from the viewpoint; `None` at the viewpoint itself.
fn pixel(offset: &Vector3<f64>) -> Option<(usize, usize, usize)> {
    let axis = offset.iamax();
    let depth = offset[axis].abs();
    if depth.is_nan() || depth <= 1e-6 {
        return None;
    }
    let face = 2 * axis + usize::from(offset[axis] < 0.0);
    let along = |x: f64| ((((x / depth + 1.0) / 2.0) * PIXELS as f64) as usize).min(PIXELS - 1);
    Some((face, along(offset[(axis + 1) % 3]), along(offset[(axis + 2) % 3])))
}

/// Pixels at most `by` from `c`, within the face.
fn around(c: usize, by: usize) -> RangeInclusive<usize> {
    c.saturating_sub(by)..=(c + by).min(PIXELS - 1)
}

fn position(face: usize, u: usize, v: usize) -> usize {
    (face * PIXELS + u) * PIXELS + v
}

#[cfg(test)]
mod tests {
    use super::super::SubmapBuilder;
    use super::super::describe;
    use super::super::features::in_voxels;
    use super::super::testing::{config, keyframe};
    use super::*;
    use crate::geometry::Se3;

    #[test]
    fn what_stands_before_a_wall_i_saw_was_looked_through() {
        let at = |k: i32| Vector3::new(4.0, f64::from(k % 80) * 0.05 - 2.0, f64::from(k / 80) * 0.05 - 2.0);
        let wall: Vec<_> = (0..6400).map(at).collect();
        let mut builder = SubmapBuilder::new(config());
        builder.push(keyframe(1, Se3::identity(), &wall)).unwrap();
        let features = describe(&builder.flush().unwrap(), &config()).features;
        let points = in_voxels(&features.block).0;
        let views = Views::new(&features, &points);
        let looked = |x: f64, y: f64| views.looked_through(&(Vector3::new(x, y, 0.1) / features.voxel()));
        assert!(looked(2.0, 0.0) && looked(3.0, 1.0));
        // On the wall, behind it, beside it, behind me, and too near to tell.
        assert!(
            !looked(3.9, 0.0) && !looked(5.0, 0.0) && !looked(3.0, 3.5) && !looked(-2.0, 0.0) && !looked(0.05, 0.0)
        );
        // Another keyframe's points hide, but prove nothing.
        let mut others = features.clone();
        others.seen_from.fill(super::super::features::UNSEEN);
        let views = Views::new(&others, &points);
        assert!(!views.looked_through(&(Vector3::new(2.0, 0.0, 0.1) / features.voxel())));
    }
}
