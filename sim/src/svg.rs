//! A picture of a run: every robot's trajectory as its own odometry has it, all laid on one origin (before), and where
//! the first robot's joint estimate puts them (after), over the true trajectories and the world.

use crate::stage::Stage;
use crate::swarm::Outcome;
use crate::truth::rigid;
use crate::world::shape::Shape;
use core::fmt::Write as _;
use merganser_protocol::geometry::{Se3, Sim3};
use std::collections::BTreeMap;

/// Edge of one of the two panels, in picture units.
const PANEL: f64 = 480.0;
/// Colours that readers with colour blindness can tell apart (Okabe and Ito).
const COLOURS: [&str; 8] = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6BB1", "#000000"];

/// The picture as SVG text.
pub fn picture<C>(outcome: &Outcome<C>) -> String {
    let stage = &outcome.stage;
    let robots = stage.names().len();
    let own = |robot: usize| stage.steps(robot).iter().map(|step| step.t_frame_body);
    let before: Vec<Vec<[f64; 2]>> = (0..robots).map(|robot| own(robot).map(|t| ground(&t)).collect()).collect();
    let after = merged(outcome);
    let truth: Vec<Vec<[f64; 2]>> =
        (0..robots).map(|robot| stage.steps(robot).iter().map(|s| ground(&s.t_world_body)).collect()).collect();
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" font-size=\"14\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        2.0 * PANEL,
        PANEL + 30.0
    );
    let left = View::of(before.iter().flatten(), 0.0);
    let right = View::of(truth.iter().flatten(), PANEL);
    let _ = writeln!(svg, "<text x=\"12\" y=\"20\">before: each robot in its own frame</text>");
    let _ = writeln!(svg, "<text x=\"{}\" y=\"20\">after: merged (grey: truth)</text>", PANEL + 12.0);
    right.world(stage, &mut svg);
    for (robot, line) in before.iter().enumerate() {
        left.line(line, COLOURS[robot % COLOURS.len()], 2.0, &mut svg);
    }
    for line in &truth {
        right.line(line, "#BBBBBB", 4.0, &mut svg);
    }
    for (robot, line) in &after {
        right.line(line, COLOURS[robot % COLOURS.len()], 1.5, &mut svg);
    }
    svg.push_str("</svg>\n");
    svg
}

/// Each robot's submap anchors where the first robot's estimate has them, laid on the truth by that robot's own frame.
fn merged<C>(outcome: &Outcome<C>) -> BTreeMap<usize, Vec<[f64; 2]>> {
    let mut lines: BTreeMap<usize, Vec<[f64; 2]>> = BTreeMap::new();
    let Some(snapshot) = outcome.robots.first().and_then(|robot| robot.snapshot.as_ref()) else { return lines };
    let Some(t_world_own) = outcome.truth.get(&snapshot.frames.own) else { return lines };
    for submap in &snapshot.map.submaps {
        let own = submap.frame == snapshot.frames.own;
        let pose = submap.t_own_anchor.as_ref().map(|t| &t.pose).or(own.then_some(&submap.t_frame_anchor));
        let robot = outcome.stage.names().iter().position(|name| *name == submap.robot);
        if let (Some(t_own_anchor), Some(robot)) = (pose.and_then(rigid), robot) {
            let place = *t_world_own * Sim3::from_se3(&t_own_anchor);
            lines.entry(robot).or_default().push([place.translation.x, place.translation.y]);
        }
    }
    lines
}

fn ground(t: &Se3) -> [f64; 2] {
    [t.translation.x, t.translation.y]
}

/// Metres to picture units within one panel.
struct View {
    centre: [f64; 2],
    scale: f64,
    left: f64,
}

impl View {
    fn of<'a>(points: impl Iterator<Item = &'a [f64; 2]>, left: f64) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in points {
            for axis in 0..2 {
                low[axis] = low[axis].min(p[axis]);
                high[axis] = high[axis].max(p[axis]);
            }
        }
        let span = (high[0] - low[0]).max(high[1] - low[1]).max(1.0) + 4.0;
        Self { centre: [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0], scale: PANEL / span, left }
    }

    fn place(&self, p: [f64; 2]) -> [f64; 2] {
        let x = self.left + PANEL / 2.0 + (p[0] - self.centre[0]) * self.scale;
        [x, 30.0 + PANEL / 2.0 - (p[1] - self.centre[1]) * self.scale]
    }

    fn line(&self, points: &[[f64; 2]], colour: &str, width: f64, svg: &mut String) {
        let _ = write!(svg, "<polyline fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\" points=\"");
        for [x, y] in points.iter().map(|&p| self.place(p)) {
            let _ = write!(svg, "{x:.1},{y:.1} ");
        }
        svg.push_str("\"/>\n");
    }

    /// Footprints of the solids that lie within the panel.
    fn world(&self, stage: &Stage, svg: &mut String) {
        for shape in stage.world().shapes() {
            let [x0, y0, x1, y1] = shape.bounds();
            let [left, bottom] = self.place([x0, y0]);
            let [right, top] = self.place([x1, y1]);
            if left < self.left || right > self.left + PANEL || top < 30.0 || bottom > PANEL + 30.0 {
                continue;
            }
            let round = if matches!(shape, Shape::Pillar { .. }) { (right - left) / 2.0 } else { 0.0 };
            let _ = writeln!(
                svg,
                "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\" rx=\"{round:.1}\" \
                 fill=\"#EFEFEF\"/>",
                right - left,
                bottom - top
            );
        }
    }
}
