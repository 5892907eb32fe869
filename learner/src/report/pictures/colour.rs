//! Colours: one scale for sizes, one for values of either sign, and the few hues of the design.
//!
//! Both scales fall evenly in lightness (as the eye sees it), so that they read alike in grey and to colour-blind eyes.

use plotters::style::RGBColor;

/// Text and outlines.
pub(super) const INK: RGBColor = RGBColor(0x1f, 0x27, 0x33);
/// Secondary text: 5.9 to 1 against white.
pub(super) const MUTED: RGBColor = RGBColor(0x5a, 0x65, 0x75);
/// Rules and empty cells' outlines.
pub(super) const RULE: RGBColor = RGBColor(0xd5, 0xdb, 0xe3);
/// Walls of a grid.
pub(super) const WALL: RGBColor = RGBColor(0x8b, 0x94, 0xa3);
/// The learned, and lines.
pub(super) const ACCENT: RGBColor = RGBColor(0x00, 0x65, 0xa8);
/// What differs.
pub(super) const DIFFERS: RGBColor = RGBColor(0xfb, 0xdf, 0xc4);
/// Hatching of what was not visited.
pub(super) const HATCH: RGBColor = RGBColor(0xb4, 0xbc, 0xc8);
/// Ground of what is missing.
pub(super) const EMPTY: RGBColor = RGBColor(0xf3, 0xf5, 0xf8);
/// Paper, and text on dark ground.
pub(super) const PAPER: RGBColor = RGBColor(0xff, 0xff, 0xff);

/// Light yellow over green to dark blue; perceived lightness 0.975 to 0.32 in even steps.
const RISING: [RGBColor; 9] = [
    RGBColor(246, 249, 229),
    RGBColor(200, 229, 197),
    RGBColor(146, 210, 180),
    RGBColor(84, 188, 175),
    RGBColor(0, 161, 173),
    RGBColor(0, 131, 162),
    RGBColor(0, 101, 151),
    RGBColor(18, 69, 139),
    RGBColor(36, 40, 110),
];

/// Brown over white to blue; perceived lightness 0.5 to 0.975 and back in even steps.
const EITHER_SIGN: [RGBColor; 9] = [
    RGBColor(159, 68, 15),
    RGBColor(183, 115, 74),
    RGBColor(204, 159, 127),
    RGBColor(226, 203, 183),
    RGBColor(247, 247, 247),
    RGBColor(188, 211, 231),
    RGBColor(135, 175, 212),
    RGBColor(85, 137, 194),
    RGBColor(36, 99, 174),
];

/// Maps values to colours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scale {
    pub(super) low: f64,
    pub(super) high: f64,
    stops: &'static [RGBColor; 9],
}

impl Scale {
    /// From zero to the largest value; even about zero where a value is negative.
    pub(super) fn from_zero(values: impl IntoIterator<Item = f64>) -> Self {
        let (low, high) = extent(values);
        if low < -1e-9 * high.abs() {
            let most = high.abs().max(low.abs());
            Self { low: -most, high: most, stops: &EITHER_SIGN }
        } else {
            Self { low: 0.0, high: if high > 0.0 { high } else { 1.0 }, stops: &RISING }
        }
    }

    /// From the smallest to the largest value.
    pub(super) fn over(values: impl IntoIterator<Item = f64>) -> Self {
        let (low, high) = extent(values);
        if high > low { Self { low, high, stops: &RISING } } else { Self { low, high: low + 1.0, stops: &RISING } }
    }

    /// The same scale for values in another unit.
    pub(super) fn divided(self, unit: f64) -> Self {
        Self { low: self.low / unit, high: self.high / unit, ..self }
    }

    /// Where a value lies between the ends, in [0, 1]; `None` for no number.
    fn position(&self, value: f64) -> Option<f64> {
        value.is_finite().then(|| ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0))
    }

    /// Colour of a value; that of something missing where it is no number.
    pub(super) fn colour(&self, value: f64) -> RGBColor {
        self.position(value).map_or(EMPTY, |t| self.at(t))
    }

    /// Colour at a position in [0, 1].
    pub(super) fn at(&self, t: f64) -> RGBColor {
        let place = t * (self.stops.len() - 1) as f64;
        let i = (place.floor() as usize).min(self.stops.len() - 2);
        let (a, b) = (self.stops[i], self.stops[i + 1]);
        let mix = |a: u8, b: u8| (f64::from(a) + (f64::from(b) - f64::from(a)) * (place - i as f64)).round() as u8;
        RGBColor(mix(a.0, b.0), mix(a.1, b.1), mix(a.2, b.2))
    }

    /// Text colour that reads on a value's colour.
    pub(super) fn ink(&self, value: f64) -> RGBColor {
        let ground = luminance(self.colour(value));
        let contrast = |text: RGBColor| {
            let text = luminance(text);
            (text.max(ground) + 0.05) / (text.min(ground) + 0.05)
        };
        if contrast(INK) >= contrast(PAPER) { INK } else { PAPER }
    }
}

/// Smallest and largest finite value; zeros where there is none.
fn extent(values: impl IntoIterator<Item = f64>) -> (f64, f64) {
    let finite = values.into_iter().filter(|x| x.is_finite());
    let (low, high) = finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    if low <= high { (low, high) } else { (0.0, 0.0) }
}

/// Relative luminance, WCAG 2.
fn luminance(colour: RGBColor) -> f64 {
    let linear = |channel: u8| {
        let c = f64::from(channel) / 255.0;
        if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    };
    0.2126 * linear(colour.0) + 0.7152 * linear(colour.1) + 0.0722 * linear(colour.2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_darkens_steadily_and_its_text_can_be_read() {
        let scale = Scale::from_zero([0.0, 1.0]);
        let shades: Vec<f64> = (0..=100).map(|i| luminance(scale.colour(f64::from(i) / 100.0))).collect();
        assert!(shades.windows(2).all(|pair| pair[1] < pair[0]));
        for i in 0..=100 {
            for scale in [scale, Scale::from_zero([-1.0, 1.0])] {
                let value = f64::from(i) / 100.0;
                let (text, ground) = (luminance(scale.ink(value)), luminance(scale.colour(value)));
                let contrast = (text.max(ground) + 0.05) / (text.min(ground) + 0.05);
                assert!(contrast >= 3.8, "{contrast} at {value}");
            }
        }
    }

    #[test]
    fn degenerate_values_have_colours_too() {
        for scale in [Scale::from_zero([]), Scale::over([f64::NAN]), Scale::over([2.0, 2.0]), Scale::from_zero([0.0])] {
            assert!(scale.high > scale.low);
            assert_eq!(scale.colour(f64::NAN), EMPTY);
            let _ = scale.colour(f64::INFINITY);
        }
    }
}
