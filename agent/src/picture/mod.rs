//! Pictures of a merge: SVG text written by hand, PNG rendered from it. The font is compiled in, so the picture is the
//! same on every machine.

mod merge;
mod plan;
mod svg;

pub use merge::{Robot, Scene, draw};

use resvg::{tiny_skia, usvg};
use std::sync::Arc;
use thiserror::Error;

/// Pixels of a PNG's side at most.
const SIDE_MAX: u32 = 8192;
/// Family name of the compiled-in font.
const FONT: &str = "Ubuntu";

/// Why an SVG did not become a PNG.
#[derive(Debug, Error)]
pub enum PictureError {
    /// The SVG is not one.
    #[error("the picture is no SVG: {0}")]
    Svg(#[from] usvg::Error),
    /// The size is nothing that can be rendered.
    #[error("a picture of {0}×{1} pixels cannot be rendered; its sides may have 1 to {SIDE_MAX}")]
    Size(u32, u32),
    /// The PNG could not be encoded.
    #[error("the picture cannot be written as PNG: {0}")]
    Png(String),
}

/// Renders an SVG as PNG, `zoom` pixels per unit.
///
/// # Errors
/// [`PictureError`].
pub fn png(svg: &str, zoom: f32) -> Result<Vec<u8>, PictureError> {
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
    fonts.set_sans_serif_family(FONT);
    let options = usvg::Options { fontdb: Arc::new(fonts), font_family: FONT.into(), ..usvg::Options::default() };
    let tree = usvg::Tree::from_str(svg, &options)?;
    let (width, height) = ((tree.size().width() * zoom) as u32, (tree.size().height() * zoom) as u32);
    let good = |side| (1..=SIDE_MAX).contains(&side);
    let pixels = (good(width) && good(height)).then(|| tiny_skia::Pixmap::new(width, height)).flatten();
    let mut pixels = pixels.ok_or(PictureError::Size(width, height))?;
    resvg::render(&tree, tiny_skia::Transform::from_scale(zoom, zoom), &mut pixels.as_mut());
    pixels.encode_png().map_err(|error| PictureError::Png(error.to_string()))
}
