//! The world robots drive through: a ground plane, walls with gaps, pillars and boxes of many sizes and orientations,
//! all drawn from a seed, and a ray-cast range sensor in it. By default no two places look alike; with `aliased`, the
//! same furnished cell repeats on a lattice, so that one place looks like another, with `aisles` exactly; with
//! `streets`, a town stands along the robots' paths.

pub mod drive;
mod generate;
mod grid;
pub mod landmarks;
pub mod path;
pub mod places;
pub mod sensor;
pub mod shape;
mod streets;
pub mod trajectory;

use crate::dice::Dice;
use grid::Grid;
use path::Path;
use serde::{Deserialize, Serialize};
use shape::{Ray, Shape};

/// What the world is like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldOptions {
    /// Mean radius of a robot's loop, m.
    pub loop_radius_m: f64,
    /// Distance between the middles of neighbouring loops, about, m. Well below the radius, so that robots see the same
    /// places.
    pub loop_spread_m: f64,
    /// From the outermost loop to the outer wall, m.
    pub margin_m: f64,
    /// Nothing stands closer than this to a robot's path, m.
    pub clearance_m: f64,
    /// Boxes per 100 m².
    pub boxes_per_100m2: f64,
    /// Pillars per 100 m².
    pub pillars_per_100m2: f64,
    /// Inner walls per 100 m².
    pub walls_per_100m2: f64,
    /// The same furnished cell everywhere.
    pub aliased: bool,
    /// Edge of that cell, m.
    pub cell_m: f64,
    /// Where the same cell is everywhere: robots drive straight along aisles through cells without end, and nothing
    /// that they see, where they drive or at the edge, tells one cell from the next.
    pub aisles: bool,
    /// Where there are aisles: every cell is a room, with doors where they pass.
    pub rooms: bool,
    /// Houses, cars and trees along the robots' paths, and nothing else: no hall, none of the above.
    pub streets: bool,
}

impl Default for WorldOptions {
    fn default() -> Self {
        Self {
            loop_radius_m: 5.0,
            loop_spread_m: 2.5,
            margin_m: 5.0,
            clearance_m: 0.8,
            boxes_per_100m2: 22.0,
            pillars_per_100m2: 4.0,
            walls_per_100m2: 1.2,
            aliased: false,
            cell_m: 8.0,
            aisles: false,
            rooms: false,
            streets: false,
        }
    }
}

/// A generated world.
#[derive(Clone, Debug)]
pub struct World {
    shapes: Vec<Shape>,
    grid: Grid,
}

impl World {
    /// The world of this seed, with free space along these paths.
    pub fn generate(options: &WorldOptions, paths: &[Path], seed: u64) -> Self {
        Self::of(generate::shapes(options, paths, &mut Dice::new(seed, "world")))
    }

    /// A world of these solids on a ground plane at z = 0.
    pub fn of(shapes: Vec<Shape>) -> Self {
        let grid = Grid::new(&shapes);
        Self { shapes, grid }
    }

    /// The solids.
    pub fn shapes(&self) -> &[Shape] {
        &self.shapes
    }

    /// Distance along the ray to the first surface within `range` m.
    pub fn cast(&self, ray: &Ray, range: f64) -> Option<f64> {
        let ground = ground(ray).filter(|&t| t <= range);
        self.grid.cast(&self.shapes, ray, ground.unwrap_or(range)).or(ground)
    }
}

fn ground(ray: &Ray) -> Option<f64> {
    (ray.direction.z < 0.0 && ray.origin.z > 0.0).then(|| -ray.origin.z / ray.direction.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn some_world(aliased: bool) -> (World, Vec<Path>) {
        let options = WorldOptions { aliased, ..WorldOptions::default() };
        let paths: Vec<Path> = (0..3).map(|k| Path::of_robot(k, 5.0, 3.0, &mut Dice::new(1, &k.to_string()))).collect();
        (World::generate(&options, &paths, 1), paths)
    }

    fn brute(world: &World, ray: &Ray, range: f64) -> Option<f64> {
        world.shapes.iter().filter_map(|s| s.hit(ray)).chain(ground(ray)).filter(|&t| t <= range).min_by(f64::total_cmp)
    }

    #[test]
    fn the_grid_finds_what_brute_force_finds() {
        let (world, _) = some_world(false);
        assert!(world.shapes.len() > 60, "{}", world.shapes.len());
        let mut dice = Dice::new(9, "rays");
        let mut hits = [0, 0];
        for _ in 0..20_000 {
            let origin = Vector3::new(dice.range(-30.0, 30.0), dice.range(-30.0, 30.0), dice.range(0.1, 4.0));
            let direction = Vector3::new(dice.normal(), dice.normal(), 0.2 * dice.normal()).normalize();
            let ray = Ray { origin, direction };
            let range = dice.range(1.0, 30.0);
            let got = world.cast(&ray, range);
            assert_eq!(got, brute(&world, &ray, range), "{ray:?} {range}");
            hits[usize::from(got.is_some())] += 1;
        }
        assert!(hits[0] > 1000 && hits[1] > 1000, "both outcomes are tried: {hits:?}");
    }

    #[test]
    fn axis_parallel_rays_agree_too() {
        let (world, _) = some_world(false);
        for (dx, dy, dz) in [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)] {
            for k in 0..200 {
                let at = f64::from(k % 20) - 10.0;
                let origin = Vector3::new(at, f64::from(k / 20) - 5.0, 0.5 + f64::from(k % 3));
                let ray = Ray { origin, direction: Vector3::new(dx, dy, dz) };
                assert_eq!(world.cast(&ray, 25.0), brute(&world, &ray, 25.0), "{ray:?}");
            }
        }
    }

    #[test]
    fn the_ground_is_where_it_should_be() {
        let world = World::of(Vec::new());
        let down = Ray { origin: Vector3::new(0.0, 0.0, 2.0), direction: Vector3::new(0.6, 0.0, -0.8) };
        assert_eq!(world.cast(&down, 10.0), Some(2.5));
        assert_eq!(world.cast(&down, 2.4), None);
    }

    #[test]
    fn paths_are_free_and_seeds_differ() {
        for aliased in [false, true] {
            let (world, paths) = some_world(aliased);
            for path in &paths {
                for k in 0..200 {
                    let ([x, y], _) = path.at(0.2 * f64::from(k));
                    let inside = world.shapes.iter().any(|s| {
                        let origin = Vector3::new(x, y, 10.0);
                        s.hit(&Ray { origin, direction: -Vector3::z() }).is_some()
                    });
                    assert!(!inside, "something stands at {x}, {y}");
                }
            }
        }
        let options = WorldOptions::default();
        let paths = some_world(false).1;
        assert_eq!(World::generate(&options, &paths, 1).shapes, World::generate(&options, &paths, 1).shapes);
        assert_ne!(World::generate(&options, &paths, 1).shapes, World::generate(&options, &paths, 2).shapes);
    }
}
