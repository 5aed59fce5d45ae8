//! Tables of the page, whose columns of numbers are aligned to the right.

use super::{escaped, put};
use crate::section::Table;

/// A cell that is read as a number.
fn is_number(cell: &str) -> bool {
    let digits = cell.trim_start_matches(['-', '−', '+', '<', '>', '≤', '≥', '~', ' ']);
    digits.starts_with(|first: char| first.is_ascii_digit())
}

/// The box can be scrolled by keyboard, too, because it can have the focus.
pub(super) fn tabulate(page: &mut String, table: &Table) {
    put(
        page,
        format_args!(
            "<div class=\"table\" role=\"region\" tabindex=\"0\" aria-label=\"{caption}\">\n<table>\n<caption>{caption}</caption>\n<thead><tr>",
            caption = escaped(&table.caption)
        ),
    );
    // A column is aligned to the right if every cell that says something is a number.
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
        put(
            page,
            format_args!("<th scope=\"col\"{}>{}</th>", class(column), escaped(name)),
        );
    }
    page.push_str("</tr></thead>\n<tbody>\n");
    for row in &table.rows {
        page.push_str("<tr>");
        for (column, cell) in row.iter().enumerate() {
            let cell = escaped(cell);
            if column == 0 {
                put(page, format_args!("<th scope=\"row\">{cell}</th>"));
            } else {
                put(page, format_args!("<td{}>{cell}</td>", class(column)));
            }
        }
        page.push_str("</tr>\n");
    }
    if table.rows.is_empty() {
        put(
            page,
            format_args!(
                "<tr><td colspan=\"{}\">nothing was measured</td></tr>\n",
                table.head.len().max(1)
            ),
        );
    }
    page.push_str("</tbody>\n</table>\n</div>\n");
}
