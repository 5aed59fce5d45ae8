//! Output: tables for people, JSON and YAML for programs.

use std::borrow::Cow;
use std::io::{IsTerminal, Write};
use std::time::{SystemTime, UNIX_EPOCH};

pub use api::count;
use api::{Limits, Millis, Servant};
use foreign::terminal;
use serde::Serialize;

pub use crate::choice::{OutputChoice, OutputFormat};
use crate::colour::{Colour, colour_of_state, has_colours, paint};
use crate::wrap::fold;

/// Heading of the column that is coloured by what it says.
const STATE: &str = "STATE";
/// Smallest width to which a column is folded on a terminal.
const NARROWEST: usize = 12;

/// Prints a value for programs, as indented JSON or as YAML.
pub fn json(value: &impl Serialize) -> anyhow::Result<()> {
    match OutputChoice::current() {
        OutputChoice::Yaml => write_line(&to_yaml(value)?),
        _ => write_line(&terminal::escape_json(&serde_json::to_string_pretty(value)?)),
    }
}

/// Prints a value of a stream for programs, as one line of JSON or as one document of YAML.
pub fn json_line(value: &impl Serialize) -> anyhow::Result<()> {
    match OutputChoice::current() {
        OutputChoice::Yaml => write_line(&format!("---\n{}", to_yaml(value)?)),
        _ => write_line(&terminal::escape_json(&serde_json::to_string(value)?)),
    }
}

/// Returns a value as YAML without its last line end: the same mappings and names as in JSON.
fn to_yaml(value: &impl Serialize) -> anyhow::Result<String> {
    // By way of JSON: YAML would write the variants of enums as tags.
    let value = serde_json::to_value(value)?;
    let text = serde_norway::to_string(&value)?;
    Ok(terminal::escape(text.trim_end(), false).into_owned())
}

/// Prints a line without control sequences, and flushes it.
pub fn line(text: &str) -> anyhow::Result<()> {
    write_line(&terminal::escape(text, has_colours(&std::io::stdout())))
}

/// Returns the text in a colour, if standard output has colours.
pub fn colour_text(text: &str, colour: Option<Colour>) -> String {
    match colour.filter(|_| has_colours(&std::io::stdout())) {
        Some(colour) => paint(text, colour),
        None => text.to_owned(),
    }
}

/// Returns the number of columns of the terminal at standard output; `None` if it is none, or does not tell.
pub fn terminal_width() -> Option<usize> {
    if !std::io::stdout().is_terminal() {
        return None;
    }
    let (columns, _) = crossterm::terminal::size().ok()?;
    Some(usize::from(columns)).filter(|columns| *columns > 0)
}

/// Removes control sequences from a line that is drawn on a screen.
pub fn sanitize(text: &str) -> Cow<'_, str> {
    terminal::escape(text, false)
}

/// Writes bytes unchanged.
pub fn raw(bytes: &[u8]) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    out.write_all(bytes)?;
    Ok(out.flush()?)
}

/// Prints a line to standard error, without control sequences.
pub fn eprint_line(text: &str) {
    let shown = terminal::escape(text, has_colours(&std::io::stderr()));
    // If standard error fails, the message cannot be shown anywhere else.
    let _ = writeln!(std::io::stderr().lock(), "{shown}");
}

fn write_line(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}")?;
    out.flush()?;
    Ok(())
}

/// Returns whether printing failed because the reader (`head`, for example) has closed the pipe.
pub fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}

/// A table with aligned columns.
#[derive(Debug, Default)]
pub struct Table {
    rows: Vec<Vec<String>>,
    /// Headings of columns that only `-o wide` shows.
    wide: Vec<&'static str>,
}

impl Table {
    /// Creates a table with these headings.
    pub fn new(headings: &[&str]) -> Table {
        let headings = headings.iter().map(|heading| (*heading).to_owned()).collect();
        Table { rows: vec![headings], wide: Vec::new() }
    }

    /// Shows the columns with these headings only with `-o wide`, so that the others fit a terminal.
    pub fn hide_unless_wide(mut self, headings: &[&'static str]) -> Table {
        self.wide = headings.to_vec();
        self
    }

    /// Adds a row.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows.push(cells.into_iter().collect());
    }

    /// Returns whether the table has no rows besides its headings.
    pub fn is_empty(&self) -> bool {
        self.rows.len() <= 1
    }

    /// Prints the table.
    pub fn print(&self) -> anyhow::Result<()> {
        let is_wide = OutputChoice::current() == OutputChoice::Wide;
        for text in self.lines_within(terminal_width(), is_wide, has_colours(&std::io::stdout())) {
            line(&text)?;
        }
        Ok(())
    }

    /// Prints the table as a list: with `-o name` only its first column, and the message if it is empty otherwise.
    pub fn print_list(&self, empty: &str) -> anyhow::Result<()> {
        match OutputChoice::current() {
            OutputChoice::Name => self.names().try_for_each(line),
            _ if self.is_empty() => line(empty),
            _ => self.print(),
        }
    }

    /// Returns the first cells of the rows: what they are about.
    fn names(&self) -> impl Iterator<Item = &str> {
        self.rows.iter().skip(1).filter_map(|row| row.first()).map(String::as_str)
    }

    /// Returns the lines of the table, with aligned columns.
    pub fn lines(&self) -> Vec<String> {
        self.lines_within(None, false, false)
    }

    /// Returns the lines of the table. If it is wider than `width`, the widest columns are folded.
    fn lines_within(&self, width: Option<usize>, is_wide: bool, has_colours: bool) -> Vec<String> {
        let Some(headings) = self.rows.first() else {
            return Vec::new();
        };
        let is_shown: Vec<bool> =
            headings.iter().map(|heading| is_wide || !self.wide.contains(&heading.as_str())).collect();
        let state = headings.iter().position(|heading| heading == STATE).filter(|_| has_colours);
        let shown = |row: &Vec<String>| -> Vec<(usize, String)> {
            let cells = row.iter().enumerate();
            let cells = cells.filter(|(column, _)| is_shown.get(*column).copied().unwrap_or(true));
            cells.map(|(column, cell)| (column, cell.clone())).collect()
        };
        let rows: Vec<Vec<(usize, String)>> = self.rows.iter().map(shown).collect();
        let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
        let longest = |at: usize| {
            rows.iter().filter_map(|row| row.get(at)).map(|(_, cell)| cell.chars().count()).max().unwrap_or(0)
        };
        let mut widths: Vec<usize> = (0..columns).map(longest).collect();
        if let Some(width) = width {
            shrink(&mut widths, width);
        }
        let mut lines = Vec::new();
        for (number, row) in rows.iter().enumerate() {
            let folded: Vec<Vec<String>> =
                row.iter().zip(&widths).map(|((_, cell), width)| fold(cell, *width)).collect();
            let colour_of = |at: usize| {
                let (column, cell) = &row[at];
                (number > 0 && state == Some(*column)).then(|| colour_of_state(cell)).flatten()
            };
            for part in 0..folded.iter().map(Vec::len).max().unwrap_or(0) {
                let cells = folded.iter().zip(&widths).enumerate().map(|(at, (parts, width))| {
                    let text = parts.get(part).map_or("", String::as_str);
                    let padding = " ".repeat(width.saturating_sub(text.chars().count()));
                    let text = colour_of(at).map_or_else(|| text.to_owned(), |colour| paint(text, colour));
                    format!("{text}{padding}")
                });
                lines.push(cells.collect::<Vec<_>>().join("  ").trim_end().to_owned());
            }
        }
        lines
    }
}

/// Makes the widest columns narrower until they all fit `width` with two spaces between them, or none can be folded
/// further.
fn shrink(widths: &mut [usize], width: usize) {
    loop {
        let needed = widths.iter().sum::<usize>() + 2 * widths.len().saturating_sub(1);
        let Some(widest) = widths.iter_mut().max().filter(|widest| **widest > NARROWEST) else {
            return;
        };
        if needed <= width {
            return;
        }
        *widest = widest.saturating_sub(needed - width).max(NARROWEST);
    }
}

/// Returns the clock of this machine.
fn now() -> Millis {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

/// Returns the time since `then`, rounded down to its largest unit.
pub fn age(then: Millis) -> String {
    span(now().saturating_sub(then))
}

/// Formats the time of the last use, for a table cell.
pub fn last_use(at: Option<Millis>) -> String {
    at.map_or_else(|| "never".into(), |at| format!("{} ago", age(at)))
}

/// Formats patterns, for a table cell.
pub fn patterns(patterns: &[access::Glob]) -> String {
    if patterns.is_empty() {
        return "-".to_owned();
    }
    let texts: Vec<String> = patterns.iter().map(ToString::to_string).collect();
    texts.join(",")
}

/// Returns the time until `then`, rounded down to its largest unit.
pub fn time_until(then: Millis) -> String {
    span(then.saturating_sub(now()).next_multiple_of(1000))
}

fn span(millis: u64) -> String {
    let seconds = millis / 1000;
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        7200..172_800 => format!("{} h", seconds / 3600),
        _ => format!("{} d", seconds / 86_400),
    }
}

/// Returns whether a time has passed.
pub fn is_past(time: Millis) -> bool {
    now() >= time
}

/// Formats the time of day, UTC.
pub fn clock(time: Millis) -> String {
    let seconds = time / 1000 % 86_400;
    format!("{:02}:{:02}:{:02}.{:03}", seconds / 3600, seconds / 60 % 60, seconds % 60, time % 1000)
}

/// Formats the limits that are set, for a table cell.
pub fn limits(limits: &Limits) -> String {
    let set: Vec<String> = limits
        .flag_values()
        .filter_map(|(name, value)| match name {
            "cpus" | "pids" => Some(format!("{value} {name}")),
            // The weight is always enforced and says little.
            "cpu-weight" => None,
            "cpuset" => Some(format!("on cores {value}")),
            "memory" => Some(value),
            name => Some(format!("{name} {value}")),
        })
        .collect();
    if set.is_empty() { "none".to_owned() } else { set.join(", ") }
}

/// Formats the terms that a servant's robot stated and the rows that apply, for a table cell.
pub fn terms(servant: &Servant) -> String {
    let Some(terms) = &servant.terms else {
        return String::new();
    };
    let mut said = vec![terms.describe_stated()];
    if let Some(class) = &terms.class {
        said.push(format!("class {class}"));
    }
    let rows = terms.rows.iter();
    said.extend(rows.map(|row| format!("entry {} ({row})", row.id)));
    said.retain(|part| !part.is_empty());
    said.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned() {
        let mut table = Table::new(&["NAME", "AGE"]);
        assert!(table.is_empty());
        table.row(["opencv_apps".into(), "3 s".into()]);
        table.row(["ä".into(), String::new()]);
        assert_eq!(table.lines(), ["NAME         AGE", "opencv_apps  3 s", "ä"]);
    }

    #[test]
    fn a_table_fits_its_terminal_and_loses_nothing() {
        let mut table = Table::new(&["NAME", "WHY", "MEMORY"]).hide_unless_wide(&["MEMORY"]);
        table.row(["adder".into(), "it was too slow for its robot".into(), "64M".into()]);
        assert_eq!(table.lines(), ["NAME   WHY", "adder  it was too slow for its robot"]);
        let wide = table.lines_within(None, true, false);
        assert!(wide[0].ends_with("MEMORY") && wide[1].ends_with("64M"), "{wide:?}");
        let narrow = table.lines_within(Some(24), false, false);
        assert_eq!(narrow, ["NAME   WHY", "adder  it was too slow", "       for its robot"]);
        assert_eq!(table.lines_within(Some(3), false, false).len(), 4, "columns have a smallest width");
        assert_eq!(table.names().collect::<Vec<_>>(), ["adder"]);
    }

    #[test]
    fn states_are_coloured_and_aligned_as_before() {
        let mut table = Table::new(&["STATE", "AGE"]);
        table.row(["ready".into(), "3 s".into()]);
        let coloured = table.lines_within(None, false, true);
        assert_eq!(coloured, ["STATE  AGE", "\x1b[32mready\x1b[0m  3 s"]);
    }

    #[test]
    fn yaml_says_the_same_as_json() {
        let value = serde_json::json!({
            "name": "no", "age": 3, "text": "a: b", "number": "007", "none": null, "list": ["x", {"y": 1.5}],
            "lines": "one\ntwo", "control": "\u{1b}[2J",
        });
        let text = to_yaml(&value).expect("YAML");
        assert_eq!(serde_norway::from_str::<serde_json::Value>(&text).expect("readable"), value, "{text}");
        assert!(!text.contains('\u{1b}'), "{text}");
    }

    #[test]
    fn spans_are_rounded_down() {
        let spans: Vec<String> = [0, 119_999, 120_000, 7_200_000, 172_800_000].into_iter().map(span).collect();
        assert_eq!(spans, ["0 s", "119 s", "2 min", "2 h", "2 d"]);
        assert_eq!(clock(86_400_000 + 3_723_004), "01:02:03.004");
    }
}
