//! Pictures of a maze: walls, rewarded cells and the agent.

use std::fmt::Write as _;

use super::layout::Layout;

/// Longest side of a picture in pixels; cells shrink to keep to it.
const MAX_SIDE: u32 = 1600;
/// Side of a cell in pixels, where the grid is small enough.
const CELL: u32 = 48;

/// Rows of `#` (wall), `.` (free), `$` (rewarded), `-` (negative reward) and `@` (the agent).
pub(super) fn text(layout: &Layout, state: u32) -> String {
    let width = layout.columns as usize + 1;
    let mut text = vec![b'#'; width * layout.rows as usize];
    for row in text.chunks_exact_mut(width) {
        row[width - 1] = b'\n';
    }
    for (index, (row, column)) in layout.positions().enumerate() {
        let reward = layout.rewards[index];
        text[row as usize * width + column as usize] = match reward {
            _ if index == state as usize => b'@',
            reward if reward > 0.0 => b'$',
            reward if reward < 0.0 => b'-',
            _ => b'.',
        };
    }
    String::from_utf8_lossy(&text).into_owned()
}

/// An SVG document: dark walls, light floor, gold or red rewards, a blue agent.
pub(super) fn svg(layout: &Layout, state: u32) -> String {
    let cell = (MAX_SIDE / layout.rows.max(layout.columns)).clamp(1, CELL);
    let margin = cell / 4;
    let (width, height) = (layout.columns * cell + 2 * margin, layout.rows * cell + 2 * margin);
    let mut svg = format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}"><rect width="{width}" height="{height}" fill="#2f3640"/><g transform="translate({margin} {margin})">"##
    );
    let side = f64::from(cell);
    let gap = if cell >= 12 { 1.0 } else { 0.0 };
    let most = layout.rewards.iter().fold(0.0_f64, |most, reward| most.max(reward.abs()));
    for (index, (row, column)) in layout.positions().enumerate() {
        let (x, y) = (f64::from(column) * side, f64::from(row) * side);
        let inner = side - gap;
        let _ = write!(svg, r##"<rect x="{x}" y="{y}" width="{inner}" height="{inner}" fill="#f4f1ea"/>"##);
        let reward = layout.rewards[index];
        if reward != 0.0 {
            let colour = if reward > 0.0 { "#f2b632" } else { "#d1495b" };
            let opacity = 0.35 + 0.65 * reward.abs() / most;
            let (x, y, inner, round) = (x + 0.08 * side, y + 0.08 * side, 0.84 * side - gap, 0.12 * side);
            let _ = write!(
                svg,
                r#"<rect x="{x:.2}" y="{y:.2}" width="{inner:.2}" height="{inner:.2}" rx="{round:.2}" fill="{colour}" fill-opacity="{opacity:.3}"/>"#
            );
            if cell >= 24 {
                let (x, y, size) = (x + inner / 2.0, y + inner / 2.0 + 0.13 * side, 0.36 * side);
                let label = format!("{reward:+}");
                let label = if label.len() > 5 { format!("{reward:+.0e}") } else { label };
                let _ = write!(
                    svg,
                    r##"<text x="{x:.2}" y="{y:.2}" font-family="Ubuntu, sans-serif" font-size="{size:.2}" text-anchor="middle" fill="#4a3200">{label}</text>"##
                );
            }
        }
    }
    let (row, column) = layout.position(state);
    let (x, y) = ((f64::from(column) + 0.5) * side - gap / 2.0, (f64::from(row) + 0.5) * side - gap / 2.0);
    let (radius, stroke, eye) = (0.32 * side, 0.05 * side, 0.055 * side);
    let _ = write!(
        svg,
        r##"<circle cx="{x:.2}" cy="{y:.2}" r="{radius:.2}" fill="#1f6feb" stroke="#ffffff" stroke-width="{stroke:.2}"/>"##
    );
    for side_of in [-1.0, 1.0] {
        let (x, y) = (x + side_of * 0.12 * side, y - 0.06 * side);
        let _ = write!(svg, r##"<circle cx="{x:.2}" cy="{y:.2}" r="{eye:.2}" fill="#ffffff"/>"##);
    }
    svg.push_str("</g></svg>");
    svg
}
