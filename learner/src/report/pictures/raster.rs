//! SVG to PNG, with a font of our own: the same picture on a machine without any font.

use resvg::{tiny_skia, usvg};
use std::fmt::Write as _;
use std::sync::{Arc, LazyLock};

/// Pixels to a unit of the picture.
const ZOOM: f32 = 2.0;
/// Longest side of a PNG, pixels.
const LONGEST_PX: f32 = 8000.0;

static FONTS: LazyLock<Arc<usvg::fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
    fonts.load_font_data(epaint_default_fonts::HACK_REGULAR.to_vec());
    fonts.set_sans_serif_family("Ubuntu");
    fonts.set_serif_family("Ubuntu");
    fonts.set_monospace_family("Hack");
    Arc::new(fonts)
});

/// Draws an SVG document at twice its size, on white.
///
/// # Errors
/// Text that is no SVG document, or a picture without an extent.
pub fn png(svg: &str) -> Result<Vec<u8>, String> {
    let options = usvg::Options { fontdb: FONTS.clone(), font_family: "Ubuntu".into(), ..usvg::Options::default() };
    let tree = usvg::Tree::from_str(&embolden(svg), &options).map_err(|error| error.to_string())?;
    let size = tree.size();
    let zoom = ZOOM.min(LONGEST_PX / size.width().max(size.height()));
    let (width, height) = ((size.width() * zoom).ceil() as u32, (size.height() * zoom).ceil() as u32);
    let mut pixels = tiny_skia::Pixmap::new(width.max(1), height.max(1)).ok_or("the picture has no extent")?;
    pixels.fill(tiny_skia::Color::WHITE);
    resvg::render(&tree, tiny_skia::Transform::from_scale(zoom, zoom), &mut pixels.as_mut());
    pixels.encode_png().map_err(|error| error.to_string())
}

/// The embedded font is a light one: a hairline around each letter brings it to the weight that a browser shows.
fn embolden(svg: &str) -> String {
    let mut text = String::with_capacity(svg.len() * 9 / 8);
    for line in svg.split_inclusive('\n') {
        let attribute = |name: &str| {
            let start = line.find(name)? + name.len();
            Some(&line[start..start + line[start..].find('"')?])
        };
        let (Some(rest), Some(fill), Some(size)) = (
            line.strip_prefix("<text "),
            attribute(" fill=\""),
            attribute(" font-size=\"").and_then(|size| size.parse::<f64>().ok()),
        ) else {
            text += line;
            continue;
        };
        let weight = if attribute(" font-weight=\"").is_some() { 0.055 } else { 0.022 };
        let _ = write!(text, "<text stroke=\"{fill}\" stroke-width=\"{:.2}\" {rest}", weight * size);
    }
    text
}
