//! A small SVG writer: just the shapes that our pictures need. Coordinates are pixels, y down, printed with one
//! decimal.

use std::fmt::Write as _;

/// Families that look like the compiled-in font, for viewers that do not have it.
const FAMILIES: &str = "Ubuntu, 'Helvetica Neue', Arial, sans-serif";

/// An SVG being written.
#[derive(Clone, Debug)]
pub(super) struct Svg(String);

/// Where a text's anchor is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

impl Svg {
    pub fn new(width: f64, height: f64, background: &str) -> Self {
        let mut svg = Self(String::new());
        let _ = writeln!(
            svg.0,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"{FAMILIES}\">"
        );
        svg.rect([0.0, 0.0, width, height], background, "");
        svg
    }

    pub fn finish(mut self) -> String {
        self.0.push_str("</svg>\n");
        self.0
    }

    /// A rectangle `[x, y, width, height]`; `more` are further attributes.
    pub fn rect(&mut self, [x, y, w, h]: [f64; 4], fill: &str, more: &str) {
        let _ = writeln!(
            self.0,
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{w:.1}\" height=\"{h:.1}\" fill=\"{fill}\" {more}/>"
        );
    }

    /// An open line through points.
    pub fn line(&mut self, points: &[[f64; 2]], stroke: &str, width: f64, more: &str) {
        if points.len() < 2 {
            return;
        }
        let mut d = String::new();
        for (index, [x, y]) in points.iter().enumerate() {
            let _ = write!(d, "{}{x:.1} {y:.1}", if index == 0 { 'M' } else { 'L' });
        }
        let _ = writeln!(
            self.0,
            "<path d=\"{d}\" fill=\"none\" stroke=\"{stroke}\" stroke-width=\"{width}\" stroke-linejoin=\"round\" \
             stroke-linecap=\"round\" {more}/>"
        );
    }

    /// Squares of one size, given by their corners on a grid.
    pub fn squares(&mut self, corners: impl Iterator<Item = [f64; 2]>, size: f64, fill: &str, opacity: f64) {
        let mut d = String::new();
        for [x, y] in corners {
            let _ = write!(d, "M{x:.1} {y:.1}h{size}v{size}h-{size}z");
        }
        if !d.is_empty() {
            let _ = writeln!(self.0, "<path d=\"{d}\" fill=\"{fill}\" fill-opacity=\"{opacity}\"/>");
        }
    }

    pub fn circle(&mut self, [x, y]: [f64; 2], radius: f64, fill: &str, more: &str) {
        let _ = writeln!(self.0, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius:.1}\" fill=\"{fill}\" {more}/>");
    }

    /// An ellipse with half axes `axes`, the first turned by `degrees` clockwise (y is down).
    pub fn ellipse(&mut self, [x, y]: [f64; 2], axes: [f64; 2], degrees: f64, colour: &str) {
        let _ = writeln!(
            self.0,
            "<ellipse rx=\"{:.2}\" ry=\"{:.2}\" transform=\"translate({x:.1} {y:.1}) rotate({degrees:.1})\" \
             fill=\"{colour}\" fill-opacity=\"0.14\" stroke=\"{colour}\" stroke-width=\"1\"/>",
            axes[0], axes[1]
        );
    }

    pub fn text(&mut self, [x, y]: [f64; 2], size: f64, fill: &str, anchor: Anchor, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
        let _ = writeln!(
            self.0,
            "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{size}\" fill=\"{fill}\" text-anchor=\"{anchor}\">{text}</text>"
        );
    }

    /// Begins a group that is cut off outside `[x, y, width, height]`.
    pub fn begin_clip(&mut self, id: &str, [x, y, w, h]: [f64; 4]) {
        let _ = writeln!(
            self.0,
            "<clipPath id=\"{id}\"><rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{w:.1}\" height=\"{h:.1}\"/></clipPath>\n\
             <g clip-path=\"url(#{id})\">"
        );
    }

    pub fn end_group(&mut self) {
        self.0.push_str("</g>\n");
    }
}
