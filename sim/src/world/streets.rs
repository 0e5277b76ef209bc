//! A town along the robots' paths: houses with bays and garden walls, parked cars, trees and lamp posts on both sides,
//! plot after plot. A street that is driven twice is built once.

use super::path::Path;
use super::shape::Shape;
use crate::dice::Dice;
use core::f64::consts::FRAC_PI_2;
use libm::{cos, sin};

/// Mean length of a plot along the street, m.
const PLOT_M: f64 = 9.0;
/// A plot nearer than this to an earlier one is the same street driven again, m.
const AGAIN_M: f64 = 0.75 * PLOT_M;

/// What stands along these paths, some of it in the way of other paths.
pub fn shapes(paths: &[Path], dice: &mut Dice) -> Vec<Shape> {
    let mut shapes = Vec::new();
    let mut plots: Vec<[f64; 2]> = Vec::new();
    for path in paths {
        let mut along = 0.0;
        while along < path.length() {
            let (middle, heading) = path.at(along);
            let is_new = plots.iter().all(|p| libm::hypot(p[0] - middle[0], p[1] - middle[1]) >= AGAIN_M);
            if is_new {
                plots.push(middle);
                for side in [1.0, -1.0] {
                    plot(&Plot { middle, heading, side }, dice, &mut shapes);
                }
            }
            along += PLOT_M * dice.range(0.8, 1.2);
        }
    }
    shapes
}

/// One side of the street.
struct Plot {
    middle: [f64; 2],
    heading: f64,
    side: f64,
}

impl Plot {
    /// The place so far along the street and so far from its middle, m.
    fn at(&self, along: f64, away: f64) -> [f64; 2] {
        let (s, c) = (sin(self.heading), cos(self.heading));
        let left = self.side * away;
        [self.middle[0] + along * c - left * s, self.middle[1] + along * s + left * c]
    }

    /// A block whose first edge lies along the street.
    fn block(&self, along: f64, away: f64, edges: [f64; 3], turn: f64) -> Shape {
        Shape::block(self.at(along, away), 0.0, edges, self.heading + turn, 0.0)
    }
}

fn plot(plot: &Plot, dice: &mut Dice, shapes: &mut Vec<Shape>) {
    let front = dice.range(7.0, 13.0);
    if dice.chance(0.8) {
        house(plot, front, dice, shapes);
    }
    if dice.chance(0.45) {
        let edges = [dice.range(2.0, 6.0), dice.range(0.2, 0.8), dice.range(0.7, 1.9)];
        shapes.push(plot.block(dice.range(-3.0, 3.0), front - dice.range(0.5, 1.5), edges, dice.range(-0.1, 0.1)));
    }
    if dice.chance(0.4) {
        let edges = [dice.range(3.6, 4.8), dice.range(1.6, 1.9), dice.range(1.4, 2.0)];
        shapes.push(plot.block(dice.range(-3.0, 3.0), dice.range(4.4, 5.0), edges, dice.range(-0.05, 0.05)));
    }
    for _ in 0..2 {
        let [radius, height] = [dice.range(0.08, 0.35), dice.range(2.5, 7.0)];
        let centre = plot.at(dice.range(-4.5, 4.5), dice.range(4.0, front));
        if dice.chance(0.5) {
            shapes.push(Shape::Pillar { centre, radius, height });
        }
    }
    if dice.chance(0.5) {
        let edges = [dice.range(0.4, 1.5), dice.range(0.4, 1.5), dice.range(0.5, 1.6)];
        shapes.push(plot.block(dice.range(-4.0, 4.0), dice.range(5.0, front), edges, dice.range(0.0, FRAC_PI_2)));
    }
}

/// A house, perhaps with a bay or a porch towards the street.
fn house(plot: &Plot, front: f64, dice: &mut Dice, shapes: &mut Vec<Shape>) {
    let edges = [dice.range(5.0, 9.5), dice.range(5.0, 9.0), dice.range(3.0, 9.0)];
    let [along, turn] = [dice.range(-1.0, 1.0), dice.range(-0.12, 0.12)];
    shapes.push(plot.block(along, front + edges[1] / 2.0, edges, turn));
    let bay = [dice.range(1.0, 2.8), dice.range(0.6, 1.8), edges[2] * dice.range(0.3, 0.9)];
    let beside = along + dice.range(-0.4, 0.4) * edges[0];
    if dice.chance(0.6) {
        shapes.push(plot.block(beside, front - bay[1] / 2.0 + 0.2, bay, turn));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_street_driven_twice_is_built_once() {
        let there: Vec<[f64; 2]> = (0..=100).map(|k| [f64::from(k), 0.0]).collect();
        let back: Vec<[f64; 2]> = there.iter().rev().map(|p| [p[0], 0.5]).collect();
        let once = shapes(&[Path::along(&there)], &mut Dice::new(3, "town"));
        let twice = shapes(&[Path::along(&there), Path::along(&back)], &mut Dice::new(3, "town"));
        assert!((40..140).contains(&once.len()), "{}", once.len());
        assert!(twice.len() < once.len() + once.len() / 4, "{} then {}", once.len(), twice.len());
    }

    #[test]
    fn both_sides_are_built_and_the_road_is_free() {
        let path = Path::along(&[[0.0, 0.0], [0.0, 200.0]]);
        let shapes = shapes(std::slice::from_ref(&path), &mut Dice::new(4, "town"));
        let middles = shapes.iter().map(|shape| {
            let [x0, _, x1, _] = shape.bounds();
            (x0 + x1) / 2.0
        });
        let left = middles.clone().filter(|&x| x < 0.0).count();
        assert!(left > 40 && shapes.len() - left > 40, "{left} of {}", shapes.len());
        assert!(middles.into_iter().all(|x| x.abs() > 3.0));
    }
}
