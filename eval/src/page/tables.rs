//! Tables of the page, with columns of numbers aligned to the right.

use super::{append, escape};
use crate::section::Table;

/// Returns whether a cell is a number.
fn is_number(cell: &str) -> bool {
    let digits = cell.trim_start_matches(['-', '−', '+', '<', '>', '≤', '≥', '~', ' ']);
    digits.starts_with(|first: char| first.is_ascii_digit())
}

/// Renders a table. Its box can receive the focus, so that it can be scrolled by keyboard.
pub(super) fn render_table(page: &mut String, table: &Table) {
    append(
        page,
        format_args!(
            "<div class=\"table\" role=\"region\" tabindex=\"0\" \
             aria-label=\"{caption}\">\n<table>\n<caption>{caption}</caption>\n<thead><tr>",
            caption = escape(&table.caption)
        ),
    );
    // A column is right-aligned if all its non-empty cells are numbers.
    let numbers: Vec<bool> = (0..table.head.len())
        .map(|column| {
            let cells = table.rows.iter().filter_map(|row| row.get(column));
            let mut said = cells.filter(|cell| !matches!(cell.as_str(), "" | "-" | "–" | "—"));
            column > 0 && said.all(|cell| is_number(cell))
        })
        .collect();
    let class = |column: usize| match numbers.get(column) {
        Some(true) => " class=\"number\"",
        _ => "",
    };
    for (column, name) in table.head.iter().enumerate() {
        append(page, format_args!("<th scope=\"col\"{}>{}</th>", class(column), escape(name)));
    }
    page.push_str("</tr></thead>\n<tbody>\n");
    for row in &table.rows {
        page.push_str("<tr>");
        for (column, cell) in row.iter().enumerate() {
            let cell = escape(cell);
            if column == 0 {
                append(page, format_args!("<th scope=\"row\">{cell}</th>"));
            } else {
                append(page, format_args!("<td{}>{cell}</td>", class(column)));
            }
        }
        page.push_str("</tr>\n");
    }
    if table.rows.is_empty() {
        append(page, format_args!("<tr><td colspan=\"{}\">nothing was measured</td></tr>\n", table.head.len().max(1)));
    }
    page.push_str("</tbody>\n</table>\n</div>\n");
}
