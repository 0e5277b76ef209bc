//! Furnishing a world: an outer wall with niches, inner walls in one-metre panels, boxes (single, stacked, leaning) and
//! pillars. What would stand in a robot's way is left out.

use super::WorldOptions;
use super::path::Path;
use super::shape::Shape;
use super::streets;
use crate::dice::Dice;
use core::f64::consts::{FRAC_PI_2, PI, TAU};
use libm::{cos, sin};

/// Length of one wall panel, m.
const PANEL_M: f64 = 1.2;
/// Height of a room's walls, m.
const ROOM_HEIGHT_M: f64 = 3.0;

/// All solids of a world.
pub fn shapes(options: &WorldOptions, paths: &[Path], dice: &mut Dice) -> Vec<Shape> {
    let is_clear = |shape: &Shape| is_clear(shape, paths, options.clearance_m);
    if options.streets {
        return streets::shapes(paths, dice).into_iter().filter(is_clear).collect();
    }
    let area = Area::around(paths, options.margin_m);
    if options.aisles {
        return lattice(&aisle_cell(options, dice), options.cell_m, &area);
    }
    let mut shapes = outer_wall(&area, dice);
    let furniture = if options.aliased { repeated(options, &area, dice) } else { unique(options, &area, dice) };
    shapes.extend(furniture.into_iter().filter(is_clear));
    shapes
}

/// The rectangle that robots and furniture keep to.
struct Area {
    low: [f64; 2],
    high: [f64; 2],
}

impl Area {
    fn cell(edge: f64) -> Self {
        Self { low: [0.0; 2], high: [edge; 2] }
    }

    fn around(paths: &[Path], margin: f64) -> Self {
        let (mut low, mut high) = ([0.0f64; 2], [0.0f64; 2]);
        for b in paths.iter().map(Path::bounds) {
            low = [low[0].min(b[0] - margin), low[1].min(b[1] - margin)];
            high = [high[0].max(b[2] + margin), high[1].max(b[3] + margin)];
        }
        Self { low, high }
    }

    fn hundred_m2(&self) -> f64 {
        (self.high[0] - self.low[0]) * (self.high[1] - self.low[1]) / 100.0
    }

    fn any(&self, dice: &mut Dice) -> [f64; 2] {
        [dice.range(self.low[0], self.high[0]), dice.range(self.low[1], self.high[1])]
    }
}

fn unique(options: &WorldOptions, area: &Area, dice: &mut Dice) -> Vec<Shape> {
    let count = |per_100m2: f64| (per_100m2 * area.hundred_m2()).round() as usize;
    let mut shapes = Vec::new();
    for _ in 0..count(options.walls_per_100m2) {
        inner_wall(area.any(dice), dice, &mut shapes);
    }
    for _ in 0..count(options.boxes_per_100m2) {
        boxes(area.any(dice), dice, &mut shapes);
    }
    for _ in 0..count(options.pillars_per_100m2) {
        let [radius, height] = [dice.range(0.08, 0.5), dice.range(0.8, 4.0)];
        shapes.push(Shape::Pillar { centre: area.any(dice), radius, height });
    }
    shapes
}

/// One furnished cell, copied to every place of the lattice.
fn repeated(options: &WorldOptions, area: &Area, dice: &mut Dice) -> Vec<Shape> {
    lattice(&unique(options, &Area::cell(options.cell_m), dice), options.cell_m, area)
}

/// A furnished cell with an aisle through its middle, and walls and doors if it is a room.
fn aisle_cell(options: &WorldOptions, dice: &mut Dice) -> Vec<Shape> {
    let edge = options.cell_m;
    let mut shapes = unique(options, &Area::cell(edge), dice);
    if options.rooms {
        let panels = (edge / PANEL_M).ceil();
        let length = edge / panels;
        let middles = (0..panels as usize).map(|k| length * (k as f64 + 0.5));
        shapes.extend(middles.flat_map(|along| {
            let wall = |at, yaw| Shape::block(at, 0.0, [length, 0.15, ROOM_HEIGHT_M], yaw, 0.0);
            [wall([along, 0.0], 0.0), wall([0.0, along], FRAC_PI_2)]
        }));
    }
    // As wide as if the aisle went on: what reaches in from the next cell leaves it free as well.
    let aisle = Path::along(&[[-edge, edge / 2.0], [2.0 * edge, edge / 2.0]]);
    shapes.retain(|shape| is_clear(shape, std::slice::from_ref(&aisle), options.clearance_m));
    shapes
}

/// Copies of a cell all over an area.
fn lattice(model: &[Shape], cell_m: f64, area: &Area) -> Vec<Shape> {
    let cells = |axis: usize| {
        let low = (area.low[axis] / cell_m).floor() as i64;
        let high = (area.high[axis] / cell_m).ceil() as i64;
        low..high
    };
    let mut shapes = Vec::new();
    for x in cells(0) {
        for y in cells(1) {
            let shift = [x as f64 * cell_m, y as f64 * cell_m];
            shapes.extend(model.iter().map(|shape| moved(shape, shift)));
        }
    }
    shapes
}

fn moved(shape: &Shape, [dx, dy]: [f64; 2]) -> Shape {
    match shape.clone() {
        Shape::Block { mut centre, axes, half } => {
            centre.x += dx;
            centre.y += dy;
            Shape::Block { centre, axes, half }
        }
        Shape::Pillar { centre: [x, y], radius, height } => Shape::Pillar { centre: [x + dx, y + dy], radius, height },
    }
}

/// Panels along the rectangle, some set back, of different heights.
fn outer_wall(area: &Area, dice: &mut Dice) -> Vec<Shape> {
    let [x0, y0] = area.low;
    let [x1, y1] = area.high;
    let mut shapes = Vec::new();
    for (from, to) in [([x0, y0], [x1, y0]), ([x1, y0], [x1, y1]), ([x1, y1], [x0, y1]), ([x0, y1], [x0, y0])] {
        let length = libm::hypot(to[0] - from[0], to[1] - from[1]);
        let along = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
        let mut done = 0.0;
        while done < length {
            let panel = dice.range(1.0, 4.0);
            let back = dice.range(0.0, 1.0);
            let middle = done + panel / 2.0;
            let at = [from[0] + along[0] * middle + along[1] * back, from[1] + along[1] * middle - along[0] * back];
            let edges = [panel, dice.range(0.2, 0.6), dice.range(1.5, 4.5)];
            shapes.push(Shape::block(at, 0.0, edges, libm::atan2(along[1], along[0]) + dice.range(-0.1, 0.1), 0.0));
            done += panel;
        }
    }
    shapes
}

fn inner_wall(start: [f64; 2], dice: &mut Dice, shapes: &mut Vec<Shape>) {
    let heading = dice.range(0.0, TAU);
    let height = dice.range(1.5, 3.5);
    let panels = dice.range(2.0, 7.0) as usize;
    for k in 0..panels {
        let along = PANEL_M * (k as f64 + 0.5);
        let at = [start[0] + along * cos(heading), start[1] + along * sin(heading)];
        shapes.push(Shape::block(at, 0.0, [PANEL_M, 0.15, height], heading, 0.0));
    }
}

/// A box, perhaps leaning, perhaps with a smaller one on top.
fn boxes(at: [f64; 2], dice: &mut Dice, shapes: &mut Vec<Shape>) {
    let edges = [dice.range(0.2, 1.6), dice.range(0.2, 1.6), dice.range(0.2, 2.2)];
    let yaw = dice.range(0.0, PI);
    let lean = if dice.chance(0.3) { dice.range(-0.6, 0.6) } else { 0.0 };
    shapes.push(Shape::block(at, 0.0, edges, yaw, lean));
    if dice.chance(0.35) && lean == 0.0 {
        let small = [edges[0] * dice.range(0.4, 0.9), edges[1] * dice.range(0.4, 0.9), dice.range(0.2, 1.0)];
        shapes.push(Shape::block(at, edges[2], small, yaw + dice.range(-0.6, 0.6), 0.0));
    }
}

fn is_clear(shape: &Shape, paths: &[Path], clearance: f64) -> bool {
    let [x0, y0, x1, y1] = shape.bounds();
    let centre = [(x0 + x1) / 2.0, (y0 + y1) / 2.0];
    let reach = libm::hypot(x1 - x0, y1 - y0) / 2.0;
    paths.iter().all(|path| path.clearance(centre) > clearance + reach)
}
