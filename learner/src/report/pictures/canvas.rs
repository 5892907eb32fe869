//! A sheet to draw on in units of a CSS pixel, over plotters' SVG backend.
//!
//! The backend knows whole coordinates only: the sheet is [`UNITS`] times as fine. Text is placed by its middle, and what
//! cannot be drawn is remembered and reported once, at the end.

use super::colour::{HATCH, INK, PAPER};
use crate::report::ReportError;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::cell::RefCell;

/// Coordinates of the backend to a unit of the picture.
const UNITS: f64 = 10.0;
/// The last that is found decides; PNG are drawn with an embedded Ubuntu.
const FONT: &str = "Inter, 'Segoe UI', Roboto, Ubuntu, 'Helvetica Neue', Arial, sans-serif";
/// plotters divides font sizes by this.
const FONT_FACTOR: f64 = 1.24;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// How text is set.
#[derive(Clone, Copy)]
pub(super) struct Type {
    pub(super) size: f64,
    pub(super) colour: RGBColor,
    pub(super) bold: bool,
    pub(super) align: HPos,
    /// Read from bottom to top.
    pub(super) upright: bool,
}

impl Type {
    pub(super) const fn new(size: f64) -> Self {
        Self { size, colour: INK, bold: false, align: HPos::Left, upright: false }
    }

    pub(super) const fn colour(self, colour: RGBColor) -> Self {
        Self { colour, ..self }
    }

    pub(super) const fn bold(self) -> Self {
        Self { bold: true, ..self }
    }

    pub(super) const fn centred(self) -> Self {
        Self { align: HPos::Center, ..self }
    }

    pub(super) const fn right(self) -> Self {
        Self { align: HPos::Right, ..self }
    }

    pub(super) const fn upright(self) -> Self {
        Self { upright: true, ..self }
    }
}

/// A sheet.
pub(super) struct Canvas<'a> {
    area: Area<'a>,
    failure: RefCell<Option<String>>,
}

fn at(x: f64, y: f64) -> (i32, i32) {
    ((x * UNITS).round() as i32, (y * UNITS).round() as i32)
}

impl Canvas<'_> {
    /// Draws a picture of a size and returns it as an SVG document; `label` is what a screen reader says.
    pub(super) fn draw(
        picture: &'static str,
        (width, height): (f64, f64),
        label: &str,
        paint: impl FnOnce(&Canvas<'_>),
    ) -> Result<String, ReportError> {
        let mut svg = String::new();
        let (right, bottom) = at(width, height);
        let failure = {
            let area = SVGBackend::with_string(&mut svg, (right as u32, bottom as u32)).into_drawing_area();
            let canvas = Canvas { area, failure: RefCell::new(None) };
            canvas.rect(0.0, 0.0, width, height, PAPER);
            paint(&canvas);
            canvas.note(canvas.area.present());
            canvas.failure.into_inner()
        };
        match failure {
            Some(message) => Err(ReportError::Picture { picture, message }),
            None => Ok(finish(&svg, (width, height), (right, bottom), label)),
        }
    }

    fn note<T, E: std::fmt::Display>(&self, result: Result<T, E>) {
        if let Err(error) = result {
            self.failure.borrow_mut().get_or_insert(error.to_string());
        }
    }

    pub(super) fn rect(&self, x: f64, y: f64, width: f64, height: f64, fill: RGBColor) {
        self.note(self.area.draw(&Rectangle::new([at(x, y), at(x + width, y + height)], fill.filled())));
    }

    pub(super) fn outline(&self, x: f64, y: f64, width: f64, height: f64, colour: RGBColor, stroke: f64) {
        let corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)];
        self.path(&corners, colour, stroke);
    }

    pub(super) fn path(&self, points: &[(f64, f64)], colour: RGBColor, stroke: f64) {
        let points: Vec<_> = points.iter().map(|&(x, y)| at(x, y)).collect();
        let style = colour.stroke_width((stroke * UNITS).round().max(1.0) as u32);
        self.note(self.area.draw(&PathElement::new(points, style)));
    }

    pub(super) fn polygon(&self, points: &[(f64, f64)], fill: RGBAColor) {
        let points: Vec<_> = points.iter().map(|&(x, y)| at(x, y)).collect();
        self.note(self.area.draw(&Polygon::new(points, fill)));
    }

    pub(super) fn disc(&self, x: f64, y: f64, radius: f64, fill: RGBAColor) {
        self.note(self.area.draw(&Circle::new(at(x, y), (radius * UNITS).round() as i32, fill.filled())));
    }

    /// Text whose capitals have their middle at `y`.
    pub(super) fn text(&self, x: f64, y: f64, text: &str, set: Type) {
        let clean = crate::report::format::clip(text, 400);
        if clean.trim().is_empty() {
            return;
        }
        // The backend puts the baseline 0.76 em below y (beside x where the text is upright); capitals are 0.7 em high.
        let lift = 0.41 * set.size;
        let (place, transform) = if set.upright {
            (at(x - lift, y), FontTransform::Rotate270)
        } else {
            (at(x, y - lift), FontTransform::None)
        };
        let style = if set.bold { FontStyle::Bold } else { FontStyle::Normal };
        let font = FontDesc::new(FontFamily::Name(FONT), set.size * UNITS * FONT_FACTOR, style).transform(transform);
        let style = TextStyle::from(font).color(&set.colour).pos(Pos::new(set.align, VPos::Top));
        self.note(self.area.draw_text(&clean, &style, place));
    }

    /// Hatches a rectangle: not visited.
    pub(super) fn hatch(&self, x: f64, y: f64, width: f64, height: f64) {
        let step = if width.min(height) < 16.0 { width.min(height) } else { 6.5 };
        let mut c = -height + step / 2.0;
        while c < width {
            let (from, to) = ((-c).max(0.0), (width - c).min(height));
            if to - from > 1.0 {
                self.path(&[(x + c + from, y + height - from), (x + c + to, y + height - to)], HATCH, 0.8);
            }
            c += step;
        }
    }

    /// An arrow about (x, y): `length` from tail to tip along the unit vector (dx, dy).
    pub(super) fn arrow(&self, (x, y): (f64, f64), (dx, dy): (f64, f64), length: f64, fill: RGBAColor) {
        let (head, half_head, half_shaft) = (0.42 * length, 0.27 * length, 0.085 * length);
        let point = |along: f64, across: f64| (x + dx * along - dy * across, y + dy * along + dx * across);
        let (tail, tip) = (-length / 2.0, length / 2.0);
        let outline = [
            point(tail, -half_shaft),
            point(tip - head, -half_shaft),
            point(tip - head, -half_head),
            point(tip, 0.0),
            point(tip - head, half_head),
            point(tip - head, half_shaft),
            point(tail, half_shaft),
        ];
        self.polygon(&outline, fill);
    }
}

/// Width of a text, a little more than most typefaces take.
pub(super) fn text_width(text: &str, size: f64) -> f64 {
    let em = |c: char| match c {
        'i' | 'j' | 'l' | 'I' | '.' | ',' | ':' | ';' | '|' | '!' | '\'' => 0.3,
        'f' | 'r' | 't' | ' ' | '(' | ')' | '-' | '[' | ']' => 0.4,
        'm' | 'w' | 'M' | 'W' | '%' | '…' => 0.95,
        'A'..='Z' => 0.7,
        _ if c.is_ascii() => 0.59,
        _ => 0.75,
    };
    size * text.chars().map(em).sum::<f64>()
}

/// `text` cut so that it fits into `width`.
pub(super) fn fit(text: &str, size: f64, width: f64) -> String {
    let mut shown = text.to_owned();
    let mut most = text.chars().count();
    while most > 1 && text_width(&shown, size) > width {
        most -= 1;
        shown = crate::report::format::clip(text, most);
    }
    shown
}

/// Gives the document its size in pixels and its label, and takes the line breaks out of text elements.
fn finish(svg: &str, (width, height): (f64, f64), (right, bottom): (i32, i32), label: &str) -> String {
    let body = svg.split_once('\n').map_or("", |(_, body)| body);
    let label = escape(label);
    let mut document = format!(
        "<svg width=\"{width:.0}\" height=\"{height:.0}\" viewBox=\"0 0 {right} {bottom}\" \
         xmlns=\"http://www.w3.org/2000/svg\" role=\"img\" aria-label=\"{label}\">\n<title>{label}</title>\n"
    );
    let mut lines = body.lines();
    while let Some(line) = lines.next() {
        document += line;
        if line.starts_with("<text ") {
            for inner in lines.by_ref() {
                document += inner;
                if inner == "</text>" {
                    break;
                }
            }
        }
        document.push('\n');
    }
    document
}

/// Escapes text for SVG and HTML.
fn escape(text: &str) -> String {
    let clean = crate::report::format::clip(text, 1000);
    clean.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
