//! Parts that pictures share: titles, colour bars and keys.

use super::canvas::{Canvas, Type, fit};
use super::colour::{INK, MUTED, RULE, Scale};
use crate::report::format::{alike, count};

/// Width of a single picture.
pub(super) const WIDTH: f64 = 400.0;
/// Margin on each side.
pub(super) const MARGIN: f64 = 20.0;
/// Height of a title with its line of explanation.
pub(super) const TITLE: f64 = 58.0;
/// Height of a colour bar with its numbers.
pub(super) const BAR: f64 = 46.0;

/// A title and what is shown, at the top of a panel.
pub(super) fn title(canvas: &Canvas<'_>, x: f64, y: f64, width: f64, title: &str, note: &str) {
    canvas.text(x, y + 22.0, &fit(title, 15.5, width), Type::new(15.0).bold());
    canvas.text(x, y + 42.0, &fit(note, 12.0, width), Type::new(12.0).colour(MUTED));
}

/// A colour bar with its ends and its middle, at (x, y); `hatch` adds the key of what was not visited.
pub(super) fn bar(canvas: &Canvas<'_>, x: f64, y: f64, width: f64, scale: &Scale, name: &str, hatch: bool) {
    let key = if hatch { 110.0 } else { 0.0 };
    let length = width - key;
    let steps = 64;
    for i in 0..steps {
        let left = length * f64::from(i) / f64::from(steps);
        // Each step reaches to the end and is painted over by the next: no seam shows at any size.
        canvas.rect(x + left, y + 8.0, length - left, 9.0, scale.at(f64::from(i) / f64::from(steps - 1)));
    }
    canvas.outline(x, y + 8.0, length, 9.0, RULE, 0.7);
    let alike = alike([scale.low, scale.high]);
    let write = |value: f64| if value.fract() == 0.0 { count(value) } else { alike(value) };
    let set = Type::new(11.0).colour(MUTED);
    canvas.text(x, y + 27.0, &write(scale.low), set);
    canvas.text(x + length / 2.0, y + 27.0, &fit(name, 11.0, length - 70.0), set.colour(INK).centred());
    canvas.text(x + length, y + 27.0, &write(scale.high), set.right());
    if hatch {
        not_visited(canvas, x + length + 16.0, y + 12.5);
    }
}

/// The key of hatching, its middle at `y`.
pub(super) fn not_visited(canvas: &Canvas<'_>, x: f64, y: f64) {
    canvas.hatch(x, y - 6.5, 18.0, 13.0);
    canvas.outline(x, y - 6.5, 18.0, 13.0, RULE, 0.8);
    canvas.text(x + 24.0, y, "not visited", Type::new(11.0).colour(MUTED));
}
