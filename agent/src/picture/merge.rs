//! The picture of a merge. Left, before: every robot's map in its own frame, drawn on top of one another as if the
//! frames were the same. Right, after: one map, with true paths, alignments and the 95 % ellipses of the anchors'
//! positions.

use super::plan::plan;
use super::svg::{Anchor, Svg};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};
use std::collections::BTreeMap;

const SIZE: [f64; 2] = [1600.0, 860.0];
const MARGIN: f64 = 28.0;
const HEAD: f64 = 84.0;
const FOOT: f64 = 74.0;
const PAPER: &str = "#ffffff";
const PANEL: &str = "#f7f8fa";
const INK: &str = "#1d2733";
const FAINT: &str = "#6b7785";
const TRUE_PATH: &str = "#8a929c";
/// Pixels of a map cell.
const CELL: f64 = 2.0;
/// Opacities of map cells, by how full they are.
const SHADES: [f64; 5] = [0.10, 0.20, 0.34, 0.55, 0.85];
/// χ²₂ at 95 %.
const CHI2_2_95: f64 = 5.991_464_547_107_98;
/// Ellipses are enlarged until the largest has this half axis, pixels.
const ELLIPSE_PIXELS_MIN: f64 = 10.0;
/// By which factors they may be.
const ENLARGE: [f64; 6] = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0];

/// One robot of the picture; positions in m, or in units where nobody knows the metre ([`Scene::in_metres`]).
#[derive(Clone, Debug, Default)]
pub struct Robot {
    /// Its name.
    pub name: String,
    /// `#rrggbb`.
    pub colour: String,
    /// Map and path in its own frame, by odometry alone.
    pub alone: (Vec<Vector3<f64>>, Vec<Vector3<f64>>),
    /// Map and path in the common frame; empty if the robot did not merge.
    pub merged: (Vec<Vector3<f64>>, Vec<Vector3<f64>>),
    /// The true path in the common frame; empty if unknown.
    pub truth: Vec<Vector3<f64>>,
    /// Positions of its anchors in the common frame, with covariance (m²).
    pub anchors: Vec<(Vector3<f64>, Matrix3<f64>)>,
}

/// What the picture shows.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// The heading.
    pub title: String,
    /// One line below it.
    pub subtitle: String,
    /// Usual direction of "up" in the common frame.
    pub up: Vector3<f64>,
    /// The robots.
    pub robots: Vec<Robot>,
    /// Alignments used: the positions of both anchors in the common frame.
    pub alignments: Vec<[Vector3<f64>; 2]>,
    /// Lengths are metres, not units that nobody knows.
    pub in_metres: bool,
}

/// Draws the picture as SVG.
pub fn draw(scene: &Scene) -> String {
    let mut svg = Svg::new(SIZE[0], SIZE[1], PAPER);
    svg.text([MARGIN, 42.0], 26.0, INK, Anchor::Start, &scene.title);
    svg.text([MARGIN, 68.0], 16.0, FAINT, Anchor::Start, &scene.subtitle);
    let width = (SIZE[0] - 3.0 * MARGIN) / 2.0;
    let height = SIZE[1] - HEAD - FOOT;
    let panels = [0.0, 1.0].map(|i| [MARGIN + i * (width + MARGIN), HEAD, width, height]);
    let merged: Vec<Vector3<f64>> = scene.robots.iter().flat_map(|robot| &robot.merged.0).copied().collect();
    let plan = plan(&merged, &scene.up);
    let sides: [Side; 2] = [|r| &r.alone, |r| &r.merged];
    let boxes = sides.map(|side| bounds(scene, &plan, side));
    let fit = |b: &[[f64; 2]; 2]| ((width - 40.0) / (b[1][0] - b[0][0])).min((height - 80.0) / (b[1][1] - b[0][1]));
    let scales = boxes.map(|corners| fit(&corners).clamp(1e-6, 1e6));
    let captions = ["before: each robot in its own frame, drawn on top of one another", "after: one frame, one map"];
    for (index, side) in sides.iter().enumerate() {
        let view = View { plan, scale: scales[index], centre: middle(&boxes[index]), panel: panels[index] };
        svg.rect(panels[index], PANEL, "rx=\"6\"");
        svg.begin_clip(&format!("panel{index}"), panels[index]);
        maps(&mut svg, scene, &view, *side);
        if index == 1 {
            truths_and_alignments(&mut svg, scene, &view);
        }
        paths(&mut svg, scene, &view, *side);
        if index == 1 {
            ellipses(&mut svg, scene, &view);
        }
        svg.end_group();
        let [x, y, ..] = panels[index];
        let width = 7.6 * captions[index].len() as f64 + 20.0;
        svg.rect([x + 6.0, y + 6.0, width, 32.0], PANEL, "rx=\"4\" fill-opacity=\"0.85\"");
        svg.text([x + 16.0, y + 28.0], 17.0, INK, Anchor::Start, captions[index]);
        scale_bar(&mut svg, &view, scene.in_metres);
    }
    legend(&mut svg, scene, enlargement(scene, &plan, scales[1]));
    svg.finish()
}

/// How plan coordinates become pixels of a panel.
struct View {
    plan: Matrix2x3<f64>,
    scale: f64,
    centre: [f64; 2],
    panel: [f64; 4],
}

impl View {
    fn pixel(&self, p: &Vector3<f64>) -> [f64; 2] {
        let flat = self.plan * p;
        let [x, y, w, h] = self.panel;
        [
            x + w / 2.0 + (flat.x - self.centre[0]) * self.scale,
            y + h / 2.0 + 14.0 - (flat.y - self.centre[1]) * self.scale,
        ]
    }

    fn pixels(&self, points: &[Vector3<f64>]) -> Vec<[f64; 2]> {
        points.iter().map(|p| self.pixel(p)).collect()
    }
}

type Side = fn(&Robot) -> &(Vec<Vector3<f64>>, Vec<Vector3<f64>>);

/// Corners of what a panel shows: all paths, and the map without its outer hundredths.
fn bounds(scene: &Scene, plan: &Matrix2x3<f64>, side: Side) -> [[f64; 2]; 2] {
    let spans = [0, 1].map(|axis| span(scene, plan, side, axis));
    [spans.map(|(low, _)| low), spans.map(|(_, high)| high)]
}

/// Least and greatest plan coordinate along one axis.
fn span(scene: &Scene, plan: &Matrix2x3<f64>, side: Side, axis: usize) -> (f64, f64) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for (map, path) in scene.robots.iter().map(side) {
        let mut along: Vec<f64> = map.iter().map(|p| (plan * p)[axis]).collect();
        along.sort_by(f64::total_cmp);
        let cut = along.len() / 100;
        let kept = along.get(cut..along.len() - cut).unwrap_or_default();
        let ends = kept.first().into_iter().chain(kept.last()).copied();
        for value in ends.chain(path.iter().map(|p| (plan * p)[axis])) {
            (low, high) = (low.min(value), high.max(value));
        }
    }
    // Nothing to show, or a single point: a metre around it.
    match high - low {
        width if !width.is_finite() => (-1.0, 1.0),
        width if width < 1e-3 => (low - 1.0, high + 1.0),
        _ => (low, high),
    }
}

fn middle(corners: &[[f64; 2]; 2]) -> [f64; 2] {
    [0, 1].map(|axis| 0.5 * (corners[0][axis] + corners[1][axis]))
}

/// The maps as cells, darker where more points fall on one cell: walls stand out from floors.
fn maps(svg: &mut Svg, scene: &Scene, view: &View, side: Side) {
    for robot in &scene.robots {
        let mut counts: BTreeMap<(i32, i32), u32> = BTreeMap::new();
        for [x, y] in view.pixels(&side(robot).0) {
            *counts.entry(((x / CELL).floor() as i32, (y / CELL).floor() as i32)).or_default() += 1;
        }
        let mut sorted: Vec<u32> = counts.values().copied().collect();
        sorted.sort_unstable();
        let full = sorted.get(sorted.len() * 95 / 100).copied().unwrap_or(1).max(2);
        for (shade, opacity) in SHADES.iter().enumerate() {
            let of_shade = |n: u32| {
                let share = (f64::from(n) / f64::from(full)).min(1.0).sqrt();
                ((share * SHADES.len() as f64).ceil() as usize).clamp(1, SHADES.len()) - 1 == shade
            };
            let cells = counts.iter().filter(|(_, n)| of_shade(**n));
            let corners = cells.map(|((x, y), _)| [f64::from(*x) * CELL, f64::from(*y) * CELL]);
            svg.squares(corners, CELL, &robot.colour, *opacity);
        }
    }
}

fn truths_and_alignments(svg: &mut Svg, scene: &Scene, view: &View) {
    for [i, j] in &scene.alignments {
        svg.line(&[view.pixel(i), view.pixel(j)], INK, 1.0, "stroke-opacity=\"0.4\"");
    }
    for robot in &scene.robots {
        svg.line(&view.pixels(&robot.truth), PAPER, 3.4, "stroke-opacity=\"0.8\"");
        svg.line(&view.pixels(&robot.truth), TRUE_PATH, 1.6, "");
    }
}

fn paths(svg: &mut Svg, scene: &Scene, view: &View, side: Side) {
    for robot in &scene.robots {
        let path = view.pixels(&side(robot).1);
        svg.line(&path, PAPER, 5.0, "stroke-opacity=\"0.65\"");
        svg.line(&path, &robot.colour, 2.4, "");
        if let (Some(start), Some(end)) = (path.first(), path.last()) {
            svg.circle(*start, 5.5, PAPER, &format!("stroke=\"{}\" stroke-width=\"2.4\"", robot.colour));
            svg.circle(*end, 5.5, &robot.colour, "");
        }
    }
}

/// Half axes (m) and direction of the 95 % ellipse of a position's shadow.
fn shadow(plan: &Matrix2x3<f64>, covariance: &Matrix3<f64>) -> ([f64; 2], f64) {
    let flat: Matrix2<f64> = plan * covariance * plan.transpose();
    let eigen = flat.symmetric_eigen();
    let major = eigen.eigenvalues.imax();
    let axis: Vector2<f64> = eigen.eigenvectors.column(major).into_owned();
    let half = [major, 1 - major].map(|i| (eigen.eigenvalues[i].max(0.0) * CHI2_2_95).sqrt());
    (half, axis.y.atan2(axis.x).to_degrees())
}

/// By how much ellipses are enlarged so that they can be seen.
fn enlargement(scene: &Scene, plan: &Matrix2x3<f64>, scale: f64) -> f64 {
    let halves = scene.robots.iter().flat_map(|robot| &robot.anchors).map(|(_, c)| shadow(plan, c).0[0] * scale);
    let largest = halves.fold(0.0, f64::max);
    let enough = ENLARGE.iter().find(|factor| largest * **factor >= ELLIPSE_PIXELS_MIN);
    *enough.unwrap_or(&ENLARGE[ENLARGE.len() - 1])
}

fn ellipses(svg: &mut Svg, scene: &Scene, view: &View) {
    let k = enlargement(scene, &view.plan, view.scale) * view.scale;
    for robot in &scene.robots {
        for (position, covariance) in &robot.anchors {
            let (half, degrees) = shadow(&view.plan, covariance);
            // Pixels count y downward.
            svg.ellipse(view.pixel(position), half.map(|h| h * k), -degrees, &robot.colour);
        }
    }
}

/// A bar of 1, 2 or 5 times a power of ten metres (or units), about a sixth of the panel long.
fn scale_bar(svg: &mut Svg, view: &View, in_metres: bool) {
    let [x, y, w, h] = view.panel;
    let wanted = w / 6.0 / view.scale;
    let decade = 10f64.powf(wanted.log10().floor());
    let metres = [5.0, 2.0, 1.0].map(|k| k * decade).into_iter().find(|m| *m <= wanted).unwrap_or(decade);
    let (right, bottom, length) = (x + w - 18.0, y + h - 18.0, metres * view.scale);
    svg.rect([right - length - 9.0, bottom - 27.0, length + 18.0, 36.0], PANEL, "rx=\"4\" fill-opacity=\"0.85\"");
    svg.line(&[[right - length, bottom], [right, bottom]], INK, 2.0, "");
    for end in [right - length, right] {
        svg.line(&[[end, bottom - 4.0], [end, bottom + 4.0]], INK, 2.0, "");
    }
    let label = match in_metres {
        true if metres < 1.0 => format!("{:.0} cm", metres * 100.0),
        true => format!("{metres:.0} m"),
        false if metres == 1.0 => "1 unit".into(),
        false => format!("{metres} units"),
    };
    svg.text([right - length / 2.0, bottom - 9.0], 15.0, INK, Anchor::Middle, &label);
}

fn legend(svg: &mut Svg, scene: &Scene, enlarged: f64) {
    let y = SIZE[1] - FOOT / 2.0 + 4.0;
    let mut x = MARGIN + 4.0;
    let mut entry = |svg: &mut Svg, text: &str, sign: &dyn Fn(&mut Svg, f64)| {
        sign(svg, x);
        svg.text([x + 48.0, y + 5.5], 16.0, INK, Anchor::Start, text);
        x += 48.0 + 30.0 + 8.4 * text.chars().count() as f64;
    };
    for robot in &scene.robots {
        entry(svg, &robot.name, &|svg, x| {
            svg.line(&[[x, y], [x + 34.0, y]], &robot.colour, 2.4, "");
            svg.circle([x, y], 4.5, PAPER, &format!("stroke=\"{}\" stroke-width=\"2.2\"", robot.colour));
            svg.circle([x + 34.0, y], 4.5, &robot.colour, "");
        });
    }
    if scene.robots.iter().any(|robot| !robot.truth.is_empty()) {
        entry(svg, "true path", &|svg, x| svg.line(&[[x, y], [x + 34.0, y]], TRUE_PATH, 1.6, ""));
    }
    if !scene.alignments.is_empty() {
        let count = scene.alignments.len();
        let text = if count == 1 { "1 alignment used".into() } else { format!("{count} alignments used") };
        entry(svg, &text, &|svg, x| svg.line(&[[x, y], [x + 34.0, y]], INK, 0.9, "stroke-opacity=\"0.5\""));
    }
    if scene.robots.iter().any(|robot| !robot.anchors.is_empty()) {
        let times = if enlarged > 1.0 { format!(", drawn {enlarged:.0} times larger") } else { String::new() };
        entry(svg, &format!("95 % ellipse of a submap's position{times}"), &|svg, x| {
            svg.ellipse([x + 17.0, y], [16.0, 8.0], 0.0, INK);
        });
    }
    svg.text([SIZE[0] - MARGIN, y + 5.5], 14.0, FAINT, Anchor::End, "merganser demo");
}

#[cfg(test)]
mod tests {
    use super::super::png;
    use super::*;
    use nalgebra::Rotation3;

    /// Two robots in a room of 12 × 7 m, the second one's frame turned and shifted.
    fn scene() -> Scene {
        let wall = |x: f64, y: f64| (0..20).map(move |z| Vector3::new(x, y, 0.1 * f64::from(z)));
        let mut room: Vec<Vector3<f64>> = Vec::new();
        for i in 0..120 {
            let s = 0.1 * f64::from(i);
            room.extend(wall(s, 0.0).chain(wall(s, 7.0)));
            if s < 7.0 {
                room.extend(wall(0.0, s).chain(wall(12.0, s)));
            }
            room.extend(wall(5.0 + (s * 0.6).cos() * 0.5, 3.5 + (s * 0.6).sin() * 0.5));
        }
        let turn = Rotation3::from_euler_angles(0.0, 0.0, 0.7);
        let robot = |name: &str, colour: &str, phase: f64, alone: &dyn Fn(Vector3<f64>) -> Vector3<f64>| {
            let at = |i: i32| {
                let a = f64::from(i) * 0.08 + phase;
                Vector3::new(6.0 + 4.5 * a.cos(), 3.5 + 2.4 * a.sin(), 0.3)
            };
            let path: Vec<_> = (0..40).map(at).collect();
            let map: Vec<_> = room.iter().filter(|p| (*p - path[20]).norm() < 7.0).copied().collect();
            let own = |points: &[Vector3<f64>]| points.iter().map(|p| alone(*p)).collect();
            let covariance = Matrix3::new(4e-3, 2e-3, 0.0, 2e-3, 3e-3, 0.0, 0.0, 0.0, 1e-3);
            Robot {
                name: name.into(),
                colour: colour.into(),
                alone: (own(&map), own(&path)),
                truth: path.iter().map(|p| p + Vector3::new(0.03, -0.05, 0.0)).collect(),
                anchors: path.iter().step_by(8).enumerate().map(|(i, p)| (*p, covariance * i as f64 * 0.3)).collect(),
                merged: (map, path),
            }
        };
        let robots = vec![
            robot("alpha", "#0072b2", 0.0, &|p| p),
            robot("beta", "#d55e00", 2.0, &|p| turn * (p - Vector3::new(2.0, 5.0, 0.0))),
        ];
        let pairs = robots[0].anchors.iter().zip(&robots[1].anchors);
        let alignments = pairs.map(|(a, b)| [a.0, b.0]).collect();
        let (title, subtitle) = ("A test & its <picture>".into(), "nobody drove".into());
        Scene { title, subtitle, up: Vector3::z(), robots, alignments, in_metres: true }
    }

    fn pixels(scene: &Scene) -> Vec<u8> {
        let bytes = png(&draw(scene), 1.0).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        pixels
    }

    /// As of map coordinates (UTM), where single precision would blur everything into half a metre.
    #[test]
    fn a_scene_far_from_its_origin_is_the_same_picture() {
        let mut far = scene();
        let offset = Vector3::new(399_512.25, 5_756_190.5, 48.0);
        for robot in &mut far.robots {
            let Robot { alone, merged, truth, anchors, .. } = robot;
            let points = [&mut alone.0, &mut alone.1, &mut merged.0, &mut merged.1, truth].into_iter().flatten();
            points.chain(anchors.iter_mut().map(|(at, _)| at)).for_each(|at| *at += offset);
        }
        far.alignments.iter_mut().flatten().for_each(|at| *at += offset);
        let (near, far) = (pixels(&scene()), pixels(&far));
        let differ = near.iter().zip(&far).filter(|(a, b)| a.abs_diff(**b) > 12).count();
        assert!(near.len() == far.len() && differ * 200 < near.len(), "{differ} of {}", near.len());
    }

    #[test]
    fn a_scene_renders_with_every_colour_and_text() {
        let svg = draw(&scene());
        if let Some(folder) = std::env::var_os("MERGANSER_PICTURES") {
            std::fs::write(std::path::Path::new(&folder).join("scene.png"), png(&svg, 1.0).unwrap()).unwrap();
        }
        let bytes = png(&svg, 1.0).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        let (pixels, _) = pixels.as_chunks::<4>();
        assert_eq!(pixels.len(), 1600 * 860);
        let near = |colour: [u8; 3]| pixels.iter().filter(|p| (0..3).all(|c| p[c].abs_diff(colour[c]) < 12)).count();
        assert!(near([0x00, 0x72, 0xb2]) > 300, "alpha's path");
        assert!(near([0xd5, 0x5e, 0x00]) > 300, "beta's path");
        // Ink is the scale bars and the texts: without a font there would be next to none.
        assert!(near([0x1d, 0x27, 0x33]) > 300, "texts: {}", near([0x1d, 0x27, 0x33]));
        assert!(svg.contains("A test &amp; its &lt;picture&gt;"));
    }

    #[test]
    fn lengths_are_metres_only_where_they_are() {
        let known = draw(&scene());
        let unknown = draw(&Scene { in_metres: false, ..scene() });
        assert!(known.contains(">2 m<") && !known.contains("unit"), "a sixth of the panel is over two metres");
        assert!(unknown.contains(">2 units<") && !unknown.contains(" m<"));
    }

    #[test]
    fn an_empty_scene_is_still_a_picture() {
        let mut scene = Scene { up: Vector3::z(), ..Scene::default() };
        assert!(!png(&draw(&scene), 0.2).unwrap().is_empty());
        scene.robots.push(Robot { name: "alone".into(), colour: "#000000".into(), ..Robot::default() });
        assert!(!png(&draw(&scene), 0.2).unwrap().is_empty());
    }

    #[test]
    fn an_ellipse_has_the_axes_of_its_covariance() {
        let plan = Matrix2x3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0);
        let turn = Rotation3::from_euler_angles(0.0, 0.0, 0.5);
        let covariance =
            turn.matrix() * Matrix3::from_diagonal(&Vector3::new(0.04, 0.01, 0.5)) * turn.matrix().transpose();
        let (half, degrees) = shadow(&plan, &covariance);
        assert!((half[0] - 0.2 * CHI2_2_95.sqrt()).abs() < 1e-12 && (half[1] - 0.1 * CHI2_2_95.sqrt()).abs() < 1e-12);
        let off = (degrees - 0.5f64.to_degrees()).rem_euclid(180.0);
        assert!(off.min(180.0 - off) < 1e-9, "{degrees}");
    }

    #[test]
    fn pictures_beyond_the_limit_are_refused() {
        let svg = draw(&Scene { up: Vector3::z(), ..Scene::default() });
        assert!(png(&svg, 8192.0 / 1600.0).is_ok());
        assert!(png(&svg, 8194.0 / 1600.0).is_err());
        assert!(png("<svg", 1.0).is_err());
    }
}
