//! Pictures as pixels: an SVG document drawn at its own size, with a typeface that is built in, so that every machine draws
//! the same.

use resvg::{
    tiny_skia::{Color, Pixmap, Transform},
    usvg::{Options, Tree, fontdb},
};
use std::sync::{Arc, LazyLock};

/// Pixels along an edge beyond which a picture is refused.
const MAX_PIXELS: u32 = 8192;

static FONTS: LazyLock<Arc<fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = fontdb::Database::new();
    for font in [epaint_default_fonts::UBUNTU_LIGHT, epaint_default_fonts::HACK_REGULAR] {
        fonts.load_font_data(font.to_vec());
    }
    // Serif is what stands in for a typeface that there is not.
    fonts.set_serif_family("Ubuntu");
    fonts.set_sans_serif_family("Ubuntu");
    fonts.set_cursive_family("Ubuntu");
    fonts.set_fantasy_family("Ubuntu");
    fonts.set_monospace_family("Hack");
    Arc::new(fonts)
});

/// How pixels are handed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Raw RGB bytes, shape `(height, width, 3)`.
    Rgb,
    /// A PNG file.
    Png,
}

/// A rasterised picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// As the format says.
    pub content: Vec<u8>,
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
}

/// Why there is no picture: what was drawn is a defect of the simulator's, or too large.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RasterError {
    /// It cannot be read.
    #[error("the drawing is no SVG: {0}")]
    Svg(String),
    /// It has no pixels or too many.
    #[error("expected 1 to 8192 pixels an edge, got {width} by {height}")]
    Size {
        /// Pixels across.
        width: u32,
        /// Pixels down.
        height: u32,
    },
    /// It cannot be written.
    #[error("no PNG: {0}")]
    Png(String),
}

/// Rasterises an SVG document on white, at its own size.
///
/// # Errors
/// It is no SVG, or too large.
pub fn rasterise(svg: &str, format: Format) -> Result<Picture, RasterError> {
    rasterise_within(svg, format, u32::MAX)
}

/// As [`rasterise`], drawn smaller where it is more than `max_width` pixels across.
///
/// # Errors
/// It is no SVG, or too large.
pub fn rasterise_within(svg: &str, format: Format, max_width: u32) -> Result<Picture, RasterError> {
    let options = Options { fontdb: Arc::clone(&FONTS), font_family: "Ubuntu".into(), ..Options::default() };
    let tree = Tree::from_str(svg, &options).map_err(|error| RasterError::Svg(error.to_string()))?;
    let size = tree.size().to_int_size();
    let (mut width, mut height, mut scale) = (size.width(), size.height(), Transform::default());
    if width > max_width.max(1) {
        let factor = max_width.max(1) as f32 / width as f32;
        (width, height) = (max_width.max(1), ((height as f32 * factor).round() as u32).max(1));
        scale = Transform::from_scale(factor, factor);
    }
    let pixels = if width.max(height) <= MAX_PIXELS { Pixmap::new(width, height) } else { None };
    let mut pixels = pixels.ok_or(RasterError::Size { width, height })?;
    pixels.fill(Color::WHITE);
    resvg::render(&tree, scale, &mut pixels.as_mut());
    let content = match format {
        Format::Rgb => pixels.data().as_chunks::<4>().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect(),
        Format::Png => pixels.encode_png().map_err(|error| RasterError::Png(error.to_string()))?,
    };
    Ok(Picture { content, width, height })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: &str = "<svg xmlns='http://www.w3.org/2000/svg' width='3' height='2'><rect width='1' height='2' fill='#ff0000'/></svg>";

    #[test]
    fn pixels_are_rows_of_red_green_and_blue_on_white() {
        let picture = rasterise(SQUARE, Format::Rgb).expect("an SVG");
        let row = [255, 0, 0, 255, 255, 255, 255, 255, 255];
        assert_eq!(picture, Picture { content: [row, row].concat(), width: 3, height: 2 });
    }

    #[test]
    fn what_is_too_wide_is_drawn_smaller() {
        let square = SQUARE
            .replace("width='3' height='2'", "width='300' height='200'")
            .replace("width='1' height='2'", "width='100' height='200'");
        let picture = rasterise_within(&square, Format::Rgb, 3).expect("an SVG");
        assert_eq!(picture, rasterise(SQUARE, Format::Rgb).expect("an SVG"));
        assert_eq!(rasterise_within(SQUARE, Format::Rgb, 3), rasterise(SQUARE, Format::Rgb));
        assert_eq!(rasterise_within(SQUARE, Format::Rgb, 1).map(|p| (p.width, p.height)), Ok((1, 1)));
    }

    #[test]
    fn a_png_says_its_size() {
        let png = rasterise(SQUARE, Format::Png).expect("an SVG").content;
        assert_eq!((&png[..8], &png[16..24]), (&b"\x89PNG\r\n\x1a\n"[..], &[0, 0, 0, 3, 0, 0, 0, 2][..]));
    }

    #[test]
    fn text_is_drawn_with_the_built_in_typefaces() {
        for family in ["sans-serif", "monospace", "No Such Typeface"] {
            let svg = format!(
                "<svg xmlns='http://www.w3.org/2000/svg' width='60' height='20'>\
                 <text x='2' y='15' font-family='{family}' font-size='14'>25 m/s</text></svg>"
            );
            let picture = rasterise(&svg, Format::Rgb).expect("an SVG");
            assert!(picture.content.iter().any(|&value| value < 128), "{family} drew nothing");
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        assert!(matches!(rasterise("<svg", Format::Rgb), Err(RasterError::Svg(_))));
        let huge = "<svg xmlns='http://www.w3.org/2000/svg' width='100000' height='2'/>";
        assert_eq!(rasterise(huge, Format::Rgb), Err(RasterError::Size { width: 100_000, height: 2 }));
    }
}
