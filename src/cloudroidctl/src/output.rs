//! Output: tables for people, JSON for programs.

use std::borrow::Cow;
use std::io::{IsTerminal, Write};
use std::time::{SystemTime, UNIX_EPOCH};

use api::{Limits, Millis, Servant};
use foreign::terminal;
use serde::Serialize;

/// Output format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum OutputFormat {
    /// Aligned columns, for people.
    Table,
    /// JSON, for programs; streams as one value per line.
    Json,
}

/// Prints a value as indented JSON.
pub fn json(value: &impl Serialize) -> anyhow::Result<()> {
    write_line(&terminal::escape_json(&serde_json::to_string_pretty(value)?))
}

/// Prints a value as one line of JSON.
pub fn json_line(value: &impl Serialize) -> anyhow::Result<()> {
    write_line(&terminal::escape_json(&serde_json::to_string(value)?))
}

/// Prints a line without control sequences, and flushes it.
pub fn line(text: &str) -> anyhow::Result<()> {
    write_line(&terminal::escape(text, std::io::stdout().is_terminal()))
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
    let shown = terminal::escape(text, std::io::stderr().is_terminal());
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
}

impl Table {
    /// Creates a table with these headings.
    pub fn new(headings: &[&str]) -> Table {
        Table { rows: vec![headings.iter().map(|heading| (*heading).to_owned()).collect()] }
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
        for text in self.lines() {
            line(&text)?;
        }
        Ok(())
    }

    /// Returns the lines of the table, with aligned columns.
    pub fn lines(&self) -> Vec<String> {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns)
            .map(|column| {
                self.rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max().unwrap_or(0)
            })
            .collect();
        let pad = |cell: &String, width: &usize| format!("{cell}{}", " ".repeat(width - cell.chars().count()));
        self.rows
            .iter()
            .map(|row| row.iter().zip(&widths).map(|(cell, width)| pad(cell, width)).collect::<Vec<_>>().join("  "))
            .map(|text| text.trim_end().to_owned())
            .collect()
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
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.is_ok_and(|now| now.as_millis() as Millis >= time)
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
            "memory-high" => Some(format!("high {value}")),
            "io-read" => Some(format!("read {value}/s")),
            "io-write" => Some(format!("write {value}/s")),
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
    fn spans_are_rounded_down() {
        let spans: Vec<String> = [0, 119_999, 120_000, 7_200_000, 172_800_000].into_iter().map(span).collect();
        assert_eq!(spans, ["0 s", "119 s", "2 min", "2 h", "2 d"]);
        assert_eq!(clock(86_400_000 + 3_723_004), "01:02:03.004");
    }
}
