//! Plain tables and texts for people: no frame beside a rule under the header, no wider than the terminal.

use comfy_table::{Cell, CellAlignment, ContentArrangement, LineStyle, Table, TableStyle};
use std::{
    io::IsTerminal as _,
    time::{Duration, SystemTime},
};

const RULE: LineStyle = LineStyle::none().fill('─').junction('─');
const STYLE: TableStyle = TableStyle::new().header_separator(RULE);

/// A table with a header. Columns whose name begins with `#` hold numbers and stand to the right.
pub fn table<const N: usize>(header: [&str; N], rows: impl IntoIterator<Item = [String; N]>) -> String {
    let mut table = Table::new();
    table.load_style(STYLE).force_no_tty();
    table.set_header(header.map(|name| Cell::new(name.trim_start_matches('#'))));
    for row in rows {
        table.add_row(row);
    }
    for (i, name) in header.iter().enumerate() {
        if let (true, Some(column)) = (name.starts_with('#'), table.column_mut(i)) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    // Where nobody looks at it, a line is as long as it is: programs cut columns, not people.
    if std::io::stdout().is_terminal() {
        table.set_content_arrangement(ContentArrangement::Dynamic);
    }
    table.trim_fmt()
}

/// Names and values under one another.
pub fn facts(rows: impl IntoIterator<Item = (&'static str, String)>) -> String {
    let rows = rows.into_iter().filter(|(_, value)| !value.is_empty()).collect::<Vec<_>>();
    let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let lines = rows.into_iter().map(|(name, value)| format!("{name:<width$}  {value}\n"));
    lines.collect::<Vec<_>>().concat()
}

/// A time in UTC, to the second.
pub fn time(timestamp: Option<prost_types::Timestamp>) -> String {
    let Some(timestamp) = timestamp else { return String::new() };
    let since = Duration::new(timestamp.seconds.max(0).cast_unsigned(), timestamp.nanos.max(0).cast_unsigned());
    SystemTime::UNIX_EPOCH
        .checked_add(since)
        .map(|t| humantime::format_rfc3339_seconds(t).to_string())
        .unwrap_or_default()
}

/// The beginning of a long id, enough to name it.
pub fn short(id: &str) -> String {
    id.chars().take(12).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_stand_to_the_right() {
        let text = table(["name", "#count"], [["a".into(), "1".into()], ["bcd".into(), "1000".into()]]);
        let lines = text.lines().map(str::trim_end).collect::<Vec<_>>();
        assert_eq!(lines, [" name   count", "──────────────", " a          1", " bcd     1000"]);
    }

    #[test]
    fn facts_that_are_empty_are_left_out() {
        assert_eq!(facts([("a", "1".into()), ("long", String::new()), ("bc", "2".into())]), "a   1\nbc  2\n");
    }

    #[test]
    fn times_are_in_utc() {
        assert_eq!(time(Some(prost_types::Timestamp { seconds: 86_400, nanos: 5 })), "1970-01-02T00:00:00Z");
        assert_eq!(time(None), "");
    }
}
