//! Pictures as pixels: an SVG document drawn at its own size, with a typeface that is built in, so that every machine draws
//! the same.

use resvg::{
    tiny_skia::{Pixmap, Transform},
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
    fonts.set_sans_serif_family("Ubuntu");
    fonts.set_monospace_family("Hack");
    Arc::new(fonts)
});

/// A rasterised picture.
pub struct Picture {
    /// A PNG file, or raw RGB bytes, shape `(height, width, 3)`.
    pub content: Vec<u8>,
    pub width: u32,
    pub height: u32,
}

/// Rasterises an SVG document on white.
pub fn draw(svg: &str, png: bool) -> Result<Picture, String> {
    let options = Options { fontdb: Arc::clone(&FONTS), font_family: "Ubuntu".into(), ..Options::default() };
    let tree = Tree::from_str(svg, &options).map_err(|error| format!("the drawing is no SVG: {error}"))?;
    let size = tree.size().to_int_size();
    let (width, height) = (size.width(), size.height());
    let mut pixels = Some(())
        .filter(|()| width.max(height) <= MAX_PIXELS)
        .and_then(|()| Pixmap::new(width, height))
        .ok_or_else(|| format!("no picture of {width} by {height} pixels"))?;
    pixels.fill(resvg::tiny_skia::Color::WHITE);
    resvg::render(&tree, Transform::default(), &mut pixels.as_mut());
    let content = if png {
        pixels.encode_png().map_err(|error| format!("no PNG: {error}"))?
    } else {
        pixels.data().as_chunks::<4>().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect()
    };
    Ok(Picture { content, width, height })
}
