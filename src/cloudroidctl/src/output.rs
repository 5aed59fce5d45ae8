//! Printing: tables for people, JSON for programs.

use std::borrow::Cow;
use std::io::{IsTerminal, Write};
use std::time::{SystemTime, UNIX_EPOCH};

use api::{Limits, Millis, Servant};
use foreign::terminal;
use serde::Serialize;

/// How to print.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// Aligned columns.
    Table,
    /// JSON; streams as one value per line.
    Json,
}

/// Prints a value as indented JSON.
pub fn json(value: &impl Serialize) -> anyhow::Result<()> {
    write_line(&terminal::escape_json(&serde_json::to_string_pretty(
        value,
    )?))
}

/// Prints a value as one line of JSON.
pub fn json_line(value: &impl Serialize) -> anyhow::Result<()> {
    write_line(&terminal::escape_json(&serde_json::to_string(value)?))
}

/// Prints a line at once, without control sequences.
pub fn line(text: &str) -> anyhow::Result<()> {
    write_line(&terminal::escape(text, std::io::stdout().is_terminal()))
}

/// A line for a screen that is drawn anew, without control sequences.
pub fn shown(text: &str) -> Cow<'_, str> {
    terminal::escape(text, false)
}

/// Writes what is no text for people as it is.
pub fn raw(bytes: &[u8]) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    out.write_all(bytes)?;
    Ok(out.flush()?)
}

/// Prints a line on standard error, without control sequences.
pub fn complain(text: &str) {
    let shown = terminal::escape(text, std::io::stderr().is_terminal());
    // There is nobody left to tell.
    let _ = writeln!(std::io::stderr().lock(), "{shown}");
}

fn write_line(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}")?;
    out.flush()?;
    Ok(())
}

/// Whether printing failed because the reader (`head`, say) has had enough.
pub fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error
        .downcast_ref::<std::io::Error>()
        .is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
}

/// Columns of one width each.
#[derive(Debug, Default)]
pub struct Table {
    rows: Vec<Vec<String>>,
}

impl Table {
    /// A table with these headings.
    pub fn new(headings: &[&str]) -> Table {
        Table {
            rows: vec![
                headings
                    .iter()
                    .map(|heading| (*heading).to_owned())
                    .collect(),
            ],
        }
    }

    /// One more row.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows.push(cells.into_iter().collect());
    }

    /// Whether there is nothing but headings.
    pub fn is_empty(&self) -> bool {
        self.rows.len() <= 1
    }

    /// Prints the table, its columns aligned.
    pub fn print(&self) -> anyhow::Result<()> {
        for text in self.lines() {
            line(&text)?;
        }
        Ok(())
    }

    /// Its lines, the columns aligned.
    pub fn lines(&self) -> Vec<String> {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns)
            .map(|column| {
                self.rows
                    .iter()
                    .filter_map(|row| row.get(column))
                    .map(|cell| cell.chars().count())
                    .max()
                    .unwrap_or(0)
            })
            .collect();
        let pad = |cell: &String, width: &usize| {
            format!("{cell}{}", " ".repeat(width - cell.chars().count()))
        };
        self.rows
            .iter()
            .map(|row| {
                row.iter()
                    .zip(&widths)
                    .map(|(cell, width)| pad(cell, width))
                    .collect::<Vec<_>>()
                    .join("  ")
            })
            .map(|text| text.trim_end().to_owned())
            .collect()
    }
}

/// How long ago, roughly.
pub fn age(then: Millis) -> String {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as u64);
    span(now.saturating_sub(then))
}

/// How long until then, roughly.
pub fn until(then: Millis) -> String {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as u64);
    span(then.saturating_sub(now).next_multiple_of(1000))
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

/// Whether a time is over.
pub fn is_past(time: Millis) -> bool {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.is_ok_and(|now| now.as_millis() as Millis >= time)
}

/// Time of day, UTC.
pub fn clock(time: Millis) -> String {
    let seconds = time / 1000 % 86_400;
    format!(
        "{:02}:{:02}:{:02}.{:03}",
        seconds / 3600,
        seconds / 60 % 60,
        seconds % 60,
        time % 1000
    )
}

/// Limits in a cell: what is limited.
pub fn limits(limits: &Limits) -> String {
    let set: Vec<String> = limits
        .named()
        .filter_map(|(name, value)| match name {
            "cpus" | "pids" => Some(format!("{value} {name}")),
            // It is always enforced, and says little.
            "cpu-weight" => None,
            "cpuset" => Some(format!("on cores {value}")),
            "memory" => Some(value),
            "memory-high" => Some(format!("high {value}")),
            "io-read" => Some(format!("read {value}/s")),
            "io-write" => Some(format!("write {value}/s")),
            name => Some(format!("{name} {value}")),
        })
        .collect();
    if set.is_empty() {
        "none".to_owned()
    } else {
        set.join(", ")
    }
}

/// What a servant's robot stated, and the rows that were taken for it, in a cell.
pub fn terms(servant: &Servant) -> String {
    let Some(terms) = &servant.terms else {
        return String::new();
    };
    let mut said = vec![terms.stated_in_words()];
    if let Some(class) = &terms.class {
        said.push(format!("class {class}"));
    }
    let rows = terms.rows.iter();
    said.extend(rows.map(|row| format!("row {} ({row})", row.id)));
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
        let spans: Vec<String> = [0, 119_999, 120_000, 7_200_000, 172_800_000]
            .into_iter()
            .map(span)
            .collect();
        assert_eq!(spans, ["0 s", "119 s", "2 min", "2 h", "2 d"]);
        assert_eq!(clock(86_400_000 + 3_723_004), "01:02:03.004");
    }
}
