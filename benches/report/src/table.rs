//! The table that is printed for readers.

use crate::{BenchReport, Figure};
use std::fmt::Write as _;

/// Formats with three digits, or all digits before the point.
pub fn format_number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}

/// Formats the value of a figure; percentages get two decimals, because those near a hundred differ only there.
fn format_value(figure: &Figure) -> String {
    if figure.unit == "%" { format!("{:.2}", figure.value) } else { format_number(figure.value) }
}

fn verdict(figure: &Figure) -> &'static str {
    match figure.met {
        Some(true) => "met",
        Some(false) => "NOT MET",
        None => "",
    }
}

pub(crate) fn render(report: &BenchReport) -> String {
    let machine = &report.machine;
    let mut text = format!(
        "{}: {} × {}, {} GiB, {}, Linux {}, load {}\n",
        report.bench,
        machine.processors,
        machine.processor,
        machine.memory_gib,
        machine.system,
        machine.kernel,
        machine.load
    );
    let rows: Vec<[String; 7]> = report
        .figures
        .iter()
        .map(|figure| {
            let floor = match (figure.floor, &figure.peer) {
                (Some(floor), Some(peer)) => format!("{} {peer}", format_number(floor)),
                _ => String::new(),
            };
            [
                figure.figure.clone(),
                format!("{} {}", format_value(figure), figure.unit),
                floor,
                figure.ratio.map(|ratio| format!("{ratio:.2}x")).unwrap_or_default(),
                figure.to_reach.clone().unwrap_or_default(),
                verdict(figure).to_owned(),
                figure.note.clone().unwrap_or_default(),
            ]
        })
        .collect();
    let titles = ["figure", "value", "beside", "ratio", "to reach", "", ""].map(str::to_owned);
    let width = |column: usize| rows.iter().chain([&titles]).map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; 7] = std::array::from_fn(width);
    for row in [&titles].into_iter().chain(&rows) {
        let mut line = String::new();
        for (column, cell) in row.iter().enumerate() {
            let pad = widths[column] - cell.chars().count();
            let _ = match column {
                0 | 5 | 6 => write!(line, "{cell}{:pad$}  ", ""),
                _ => write!(line, "{:pad$}{cell}  ", ""),
            };
        }
        let _ = writeln!(text, "{}", line.trim_end());
    }
    for one in &report.left_out {
        let _ = writeln!(text, "{} is left out: {}", one.what, one.why);
    }
    text
}
