//! The solids a world is made of, and where a ray meets them: analytic, no meshes.

use libm::{cos, sin};
use nalgebra::{Matrix3, Vector3};

/// Directions shorter than this along an axis count as parallel to its slab.
const PARALLEL: f64 = 1e-12;

/// A half-line.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Start, m, world frame.
    pub origin: Vector3<f64>,
    /// Unit direction.
    pub direction: Vector3<f64>,
}

/// A solid, world frame, m.
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// A box in any orientation.
    Block {
        /// Its middle.
        centre: Vector3<f64>,
        /// World to box: the rows are the box's axes.
        axes: Matrix3<f64>,
        /// Half its edges.
        half: Vector3<f64>,
    },
    /// An upright cylinder that stands on the ground.
    Pillar {
        /// Its axis.
        centre: [f64; 2],
        /// Its radius.
        radius: f64,
        /// Its height.
        height: f64,
    },
}

impl Shape {
    /// A box that stands on the ground, turned by `yaw`, then leaned by `lean` rad about its own first axis.
    pub fn block(centre: [f64; 2], bottom: f64, edges: [f64; 3], yaw: f64, lean: f64) -> Self {
        let half = Vector3::from(edges) * 0.5;
        let (s, c) = (sin(yaw), cos(yaw));
        let (sl, cl) = (sin(lean), cos(lean));
        let turn = Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
        let leaned = Matrix3::new(1.0, 0.0, 0.0, 0.0, cl, -sl, 0.0, sl, cl);
        let centre = Vector3::new(centre[0], centre[1], bottom + half.z);
        Self::Block { centre, axes: (turn * leaned).transpose(), half }
    }

    /// Distance along the ray to the surface; `None` if it misses or starts inside.
    pub fn hit(&self, ray: &Ray) -> Option<f64> {
        match self {
            Self::Block { centre, axes, half } => {
                hit_block(&(axes * (ray.origin - centre)), &(axes * ray.direction), half)
            }
            Self::Pillar { centre, radius, height } => hit_pillar(ray, *centre, *radius, *height),
        }
    }

    /// Bounding box on the ground, `[x0, y0, x1, y1]`.
    pub fn bounds(&self) -> [f64; 4] {
        match self {
            Self::Block { centre, axes, half } => {
                let reach = axes.transpose().abs() * half;
                [centre.x - reach.x, centre.y - reach.y, centre.x + reach.x, centre.y + reach.y]
            }
            Self::Pillar { centre: [x, y], radius, .. } => [x - radius, y - radius, x + radius, y + radius],
        }
    }
}

/// The slab method, in the box's own axes.
fn hit_block(origin: &Vector3<f64>, direction: &Vector3<f64>, half: &Vector3<f64>) -> Option<f64> {
    let (mut near, mut far) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..3 {
        let (o, d, h) = (origin[axis], direction[axis], half[axis]);
        if d.abs() < PARALLEL {
            if o.abs() > h {
                return None;
            }
            continue;
        }
        let (a, b) = ((-h - o) / d, (h - o) / d);
        near = near.max(a.min(b));
        far = far.min(a.max(b));
    }
    (near <= far && near > 0.0).then_some(near)
}

fn hit_pillar(ray: &Ray, centre: [f64; 2], radius: f64, height: f64) -> Option<f64> {
    let (o, d) = (&ray.origin, &ray.direction);
    let (x, y) = (o.x - centre[0], o.y - centre[1]);
    let a = d.x * d.x + d.y * d.y;
    let c = x * x + y * y - radius * radius;
    let side = (a > PARALLEL && c > 0.0)
        .then(|| {
            let b = x * d.x + y * d.y;
            let discriminant = b * b - a * c;
            (discriminant >= 0.0).then(|| (-b - discriminant.sqrt()) / a)
        })
        .flatten()
        .filter(|&t| t > 0.0 && (0.0..=height).contains(&(o.z + t * d.z)));
    let top = (d.z < -PARALLEL && o.z > height)
        .then(|| (height - o.z) / d.z)
        .filter(|&t| (x + t * d.x) * (x + t * d.x) + (y + t * d.y) * (y + t * d.y) <= radius * radius);
    match (side, top) {
        (Some(s), Some(t)) => Some(s.min(t)),
        (s, t) => s.or(t),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f64; 3], direction: [f64; 3]) -> Ray {
        Ray { origin: origin.into(), direction: Vector3::from(direction).normalize() }
    }

    #[test]
    fn a_block_is_hit_where_geometry_says() {
        let block = Shape::block([5.0, 0.0], 0.0, [2.0, 4.0, 1.0], 0.0, 0.0);
        assert_eq!(block.hit(&ray([0.0, 0.0, 0.5], [1.0, 0.0, 0.0])), Some(4.0));
        assert_eq!(block.hit(&ray([0.0, 0.0, 0.5], [-1.0, 0.0, 0.0])), None);
        assert_eq!(block.hit(&ray([0.0, 0.0, 1.01], [1.0, 0.0, 0.0])), None);
        assert_eq!(block.hit(&ray([5.0, 0.0, 3.0], [0.0, 0.0, -1.0])), Some(2.0));
        assert_eq!(block.hit(&ray([5.0, 0.0, 0.5], [1.0, 0.0, 0.0])), None, "from inside");
    }

    #[test]
    fn a_turned_block_shows_its_corner() {
        let block = Shape::block([5.0, 0.0], 0.0, [2.0, 2.0, 2.0], core::f64::consts::FRAC_PI_4, 0.0);
        let hit = block.hit(&ray([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])).unwrap();
        assert!((hit - (5.0 - 2f64.sqrt())).abs() < 1e-12);
        let [x0, _, x1, y1] = block.bounds();
        assert!((x1 - x0 - 8f64.sqrt()).abs() < 1e-12 && (y1 - 2f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn a_pillar_is_hit_on_its_side_and_its_top() {
        let pillar = Shape::Pillar { centre: [3.0, 0.0], radius: 0.5, height: 2.0 };
        assert_eq!(pillar.hit(&ray([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])), Some(2.5));
        assert_eq!(pillar.hit(&ray([0.0, 0.51, 1.0], [1.0, 0.0, 0.0])), None);
        assert_eq!(pillar.hit(&ray([0.0, 0.0, 2.1], [1.0, 0.0, 0.0])), None);
        assert_eq!(pillar.hit(&ray([3.1, 0.0, 4.0], [0.0, 0.0, -1.0])), Some(2.0));
    }
}
