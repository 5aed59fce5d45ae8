//! The table that is printed for readers.

use crate::{BenchReport, Figure, MachineDescription};
use std::fmt::Write as _;

/// Formats with three digits, or all digits before the point.
pub fn format_number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}

/// Returns the cells of a figure's row; percentages get two decimals, because those near a hundred differ only there.
fn cells(figure: &Figure) -> [String; 7] {
    let Figure { value, unit, .. } = figure;
    let value = if unit == "%" { format!("{value:.2}") } else { format_number(*value) };
    let beside = figure.floor.zip(figure.peer.as_ref());
    [
        figure.figure.clone(),
        format!("{value} {unit}"),
        beside.map(|(floor, peer)| format!("{} {peer}", format_number(floor))).unwrap_or_default(),
        figure.ratio.map(|ratio| format!("{ratio:.2}x")).unwrap_or_default(),
        figure.to_reach.clone().unwrap_or_default(),
        figure.met.map_or("", |met| if met { "met" } else { "NOT MET" }).to_owned(),
        figure.note.clone().unwrap_or_default(),
    ]
}

pub(crate) fn render(report: &BenchReport) -> String {
    let MachineDescription { processor, processors, memory_gib, kernel, system, load } = &report.machine;
    let mut text = format!(
        "{}: {processors} × {processor}, {memory_gib} GiB, {system}, Linux {kernel}, load {load}\n",
        report.bench
    );
    let rows: Vec<[String; 7]> = report.figures.iter().map(cells).collect();
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
