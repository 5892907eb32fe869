//! Numbers and names as people read them. A number that is not finite reads `–`.

use super::{DriverMetrics, Interval, Report};
use crate::irl::Stopped;

/// What stands for a missing number.
pub(crate) const MISSING: &str = "–";

/// One of the numbers that drivers are compared by.
pub(crate) struct Metric {
    /// Heading of its column.
    pub(crate) name: &'static str,
    /// Where it stands.
    pub(crate) of: fn(&DriverMetrics) -> &Interval,
    /// Whether it counts events a step, and so starts at zero.
    pub(crate) rate: bool,
}

impl Metric {
    /// Decimals with which all drivers' numbers are written: as many as the narrowest interval needs.
    pub(crate) fn decimals(&self, drivers: &[&DriverMetrics]) -> usize {
        let (least, most) = if self.rate { (3, 5) } else { (2, 3) };
        decimals(drivers.iter().map(|&driver| (self.of)(driver)), least, most)
    }
}

/// The columns of the drivers' table.
pub(crate) const METRICS: [Metric; 4] = [
    Metric { name: "mean speed, m/s", of: |m| &m.speed_mps, rate: false },
    Metric { name: "collisions a step", of: |m| &m.collisions, rate: true },
    Metric { name: "overtakes left, a step", of: |m| &m.overtakes_left, rate: true },
    Metric { name: "overtakes right, a step", of: |m| &m.overtakes_right, rate: true },
];

/// A number with a fixed count of decimals.
pub(crate) fn fixed(value: f64, decimals: usize) -> String {
    if !value.is_finite() {
        return MISSING.to_owned();
    }
    let text = format!("{value:.decimals$}");
    // A rounded -0.00 reads as if there were a sign.
    match text.strip_prefix('-') {
        Some(rest) if rest.bytes().all(|byte| matches!(byte, b'0' | b'.')) => rest.to_owned(),
        Some(rest) => format!("−{rest}"),
        None => text,
    }
}

/// About three significant digits, in as few characters as it takes: `0.0213`, `4.21`, `318`, `1.2e6`.
pub(crate) fn brief(value: f64) -> String {
    let size = value.abs();
    match size {
        _ if !value.is_finite() => MISSING.to_owned(),
        0.0 => "0".to_owned(),
        _ if !(1e-4..1e5).contains(&size) => format!("{value:.1e}").replace('-', "−"),
        _ if size < 10.0 => fixed(value, (2 - size.log10().floor() as i32).clamp(0, 6) as usize),
        _ if size < 100.0 => fixed(value, 1),
        _ => fixed(value, 0),
    }
}

/// Writes the numbers of a column alike: the largest with three significant digits.
pub(crate) fn alike(column: impl IntoIterator<Item = f64>) -> impl Fn(f64) -> String {
    let most = column.into_iter().filter(|x| x.is_finite()).fold(0.0, |most: f64, x| most.max(x.abs()));
    let decimals = if most > 0.0 { 2 - most.log10().floor() as i32 } else { 2 };
    move |value| if (0..=6).contains(&decimals) { fixed(value, decimals as usize) } else { brief(value) }
}

/// A power of ten in which numbers are short to write, and how to say so; 1 and nothing where they are so already.
pub(crate) fn unit(values: &[f64]) -> (f64, String) {
    let most = values.iter().filter(|x| x.is_finite()).fold(0.0, |most: f64, x| most.max(x.abs()));
    if most == 0.0 || (1e-2..1e4).contains(&most) {
        return (1.0, String::new());
    }
    let power = 3 * (most.log10() / 3.0).floor() as i32;
    (10f64.powi(power), format!(", in 1e{power}").replace('-', "−"))
}

/// A count with thousands apart.
pub(crate) fn count(value: f64) -> String {
    if !value.is_finite() {
        return MISSING.to_owned();
    }
    if value.fract().abs() > 1e-9 {
        return brief(value);
    }
    let digits = format!("{:.0}", value.abs());
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i) % 3 == 0 {
            text.push(',');
        }
        text.push(digit);
    }
    if value < 0.0 { format!("−{text}") } else { text }
}

/// A share as a percentage; never rounds a share below 1 up to 100 %.
pub(crate) fn percent(share: f64) -> String {
    if !share.is_finite() {
        return MISSING.to_owned();
    }
    let shown =
        if share < 1.0 { (share * 1000.0).floor().max((share * 1000.0).round().min(999.0)) } else { 1000.0 * share };
    if shown == 1000.0 { "100 %".to_owned() } else { format!("{} %", fixed(shown / 10.0, 1)) }
}

/// A time span: `0.21 s`, `12.4 s`, `3 min 20 s`.
pub fn duration(secs: f64) -> String {
    match secs {
        _ if !secs.is_finite() || secs < 0.0 => MISSING.to_owned(),
        _ if secs < 0.001 => "< 1 ms".to_owned(),
        _ if secs < 1.0 => format!("{:.0} ms", secs * 1000.0),
        _ if secs < 100.0 => format!("{secs:.1} s"),
        _ => format!("{:.0} min {:.0} s", (secs / 60.0).floor(), secs % 60.0),
    }
}

/// Decimals at which the narrowest interval of a column still shows its width.
fn decimals<'a>(column: impl IntoIterator<Item = &'a Interval>, least: usize, most: usize) -> usize {
    column
        .into_iter()
        .map(|interval| (interval.high - interval.low) / 2.0)
        .filter(|half| half.is_finite() && *half > 0.0)
        .map(|half| (-half.log10().floor()).max(0.0) as usize)
        .fold(least, usize::max)
        .min(most)
}

/// `0.031 ± 0.004`; the two ends where the interval is far from symmetric.
pub(crate) fn interval(value: &Interval, decimals: usize) -> String {
    let (mean, spread) = interval_parts(value, decimals);
    if spread.is_empty() { mean } else { format!("{mean} {spread}") }
}

/// The mean, and `± 0.004` or `[0.028, 0.039]`; the latter empty where no interval is known.
pub(crate) fn interval_parts(value: &Interval, decimals: usize) -> (String, String) {
    let mean = fixed(value.mean, decimals);
    let (below, above) = (value.mean - value.low, value.high - value.mean);
    if !below.is_finite() || !above.is_finite() {
        return (mean, String::new());
    }
    let spread = if (above - below).abs() > 0.25 * (above + below) && fixed(above, decimals) != fixed(below, decimals) {
        format!("[{}, {}]", fixed(value.low, decimals), fixed(value.high, decimals))
    } else {
        format!("± {}", fixed(f64::midpoint(above, below), decimals))
    };
    (mean, spread)
}

/// How a fit stopped, in words.
pub(crate) fn stopped(stopped: Stopped) -> &'static str {
    match stopped {
        Stopped::Converged => "converged",
        Stopped::MaxIterations => "iterations ran out",
        Stopped::Stalled => "stalled: no further improvement at this precision",
        Stopped::ClosedForm => "closed form",
    }
}

/// An option as it is typed: the serialised name of an enum.
pub(crate) fn option_name(value: impl serde::Serialize) -> String {
    match serde_json::to_value(value) {
        Ok(serde_json::Value::String(name)) => name,
        Ok(other) => other.to_string(),
        Err(_) => MISSING.to_owned(),
    }
}

/// `text` without control characters, cut to `most` characters.
pub(crate) fn clip(text: &str, most: usize) -> String {
    let clean: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if clean.chars().count() <= most {
        return clean;
    }
    clean.chars().take(most.saturating_sub(1)).chain(['…']).collect()
}

/// What the options were, as pairs of a name and a value, leaving out those that the method does not read.
pub(crate) fn options(report: &Report) -> Vec<(&'static str, String)> {
    let options = &report.options;
    let method = report.method.as_str();
    let mut pairs = vec![("method", report.method.clone()), ("discount", options.discount.to_string())];
    if method != "bc" {
        pairs.push(("basis", option_name(options.basis)));
        pairs.push(("planner", option_name(options.planner)));
    }
    if method.starts_with("em") && method != "em-tied" {
        pairs.push(("horizon prior", option_name(options.horizon_prior)));
        pairs.push(("reward step", option_name(options.m_step)));
        pairs.push(("responsibility", option_name(options.responsibility)));
        pairs.push(("reference basis", options.reference_basis.to_string()));
    }
    if method == "em-tied" {
        pairs.push(("penalty", option_name(options.penalty)));
        let strength = options.penalty_strength.map_or_else(|| "the method's own".to_owned(), |s| s.to_string());
        pairs.push(("penalty strength", strength));
        pairs.push(("posterior", option_name(options.posterior)));
    }
    if method == "bc" {
        pairs.push(("smoothing", options.smoothing.to_string()));
    } else {
        pairs.push(("tolerance", format!("{:e}", options.tolerance)));
        pairs.push(("at most", format!("{} iterations", count(f64::from(options.max_iterations)))));
    }
    pairs.push(("seed", report.seed.to_string()));
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_as_people_write_them() {
        assert_eq!(fixed(-0.0001, 2), "0.00");
        assert_eq!(fixed(-1.25, 1), "−1.2");
        assert_eq!(fixed(f64::NAN, 2), "–");
        assert_eq!(brief(0.02131), "0.0213");
        assert_eq!(brief(4.2149), "4.21");
        assert_eq!(brief(318.4), "318");
        assert_eq!(brief(0.0), "0");
        assert_eq!(brief(1.2e6), "1.2e6");
        assert_eq!(count(1_234_567.0), "1,234,567");
        assert_eq!(count(999.0), "999");
        assert_eq!(duration(0.2134), "213 ms");
        assert_eq!(duration(200.0), "3 min 20 s");
    }

    #[test]
    fn a_share_below_one_is_never_shown_as_all() {
        assert_eq!(percent(0.9999), "99.9 %");
        assert_eq!(percent(1.0), "100 %");
        assert_eq!(percent(0.9876), "98.8 %");
        assert_eq!(percent(0.0), "0.0 %");
    }

    #[test]
    fn intervals_keep_their_width_visible() {
        let narrow = Interval { mean: 0.002, low: 0.0016, high: 0.0024 };
        let wide = Interval { mean: 0.031, low: 0.027, high: 0.035 };
        assert_eq!(decimals([&narrow, &wide], 3, 5), 4);
        assert_eq!(interval(&wide, 3), "0.031 ± 0.004");
        assert_eq!(interval(&Interval { mean: 0.002, low: 0.0, high: 0.009 }, 3), "0.002 [0.000, 0.009]");
        assert_eq!(interval(&Interval { mean: 0.002, low: f64::NAN, high: 0.1 }, 3), "0.002");
    }
}
