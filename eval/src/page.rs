//! The report as a single HTML file that loads nothing and runs nothing, so that it can be sent as it is.

mod style;

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::section::{Figure, FigureImage, MissingMeasurement, Section, Table};
use style::STYLE;

/// Renders the page. `machine` describes where it was measured, `made` is the date; `reproduced` lists what could not
/// be reproduced here: the published thing, the substitute, and the reason.
pub fn render(sections: &[Section], machine: &str, made: &str, reproduced: &[[&str; 3]]) -> String {
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <title>Cloudroid: the published experiments on one machine</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<header>\n\
         <h1>Cloudroid: the published experiments on one machine</h1>\n\
         <p>Measured on {}.<br>Made on {}.</p>\n<p>Figures are medians of the runs of one measurement, with the \
         lowest and the highest in brackets.</p>\n</header>\n",
        escape(machine),
        escape(made)
    );
    render_contents(&mut page, sections, !reproduced.is_empty());
    page.push_str("<main>\n");
    for section in sections {
        render_section(&mut page, section);
    }
    if sections.is_empty() {
        page.push_str("<p>Nothing was measured.</p>\n");
    }
    if !reproduced.is_empty() {
        page.push_str("<section id=\"reproduced\">\n<h2>What could not be reproduced here</h2>\n");
        let head = "published | stand-in | reason";
        let mut table = Table::new("What the publication used, and what stands for it", head);
        reproduced.iter().for_each(|row| table.push(*row));
        render_table(&mut page, &table);
        page.push_str("</section>\n");
    }
    page.push_str("</main>\n</body>\n</html>\n");
    page
}

fn append(page: &mut String, text: std::fmt::Arguments) {
    // Writing to a String cannot fail.
    let _ = page.write_fmt(text);
}

/// Escapes text for an element or a quoted attribute.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // HTML cannot represent control characters.
            other if other.is_control() && !other.is_whitespace() => out.push('\u{fffd}'),
            other => out.push(other),
        }
    }
    out
}

/// Returns the anchor of a section or figure: letters, digits and dashes.
fn anchor(kind: &str, id: &str) -> String {
    let id = id.to_ascii_lowercase();
    format!("{kind}-{}", id.replace(|character: char| !character.is_ascii_alphanumeric(), "-"))
}

fn render_contents(page: &mut String, sections: &[Section], is_reproduced: bool) {
    page.push_str("<nav aria-label=\"Contents\">\n<h2>Contents</h2>\n<ul>\n");
    for Section { id, number, title, missing, .. } in sections {
        let missing = match missing.len() {
            0 => String::new(),
            1 => " <small>(1 thing was not measured)</small>".to_owned(),
            more => format!(" <small>({more} things were not measured)</small>"),
        };
        let (anchor, title) = (anchor("section", id), escape(title));
        append(page, format_args!("<li><a href=\"#{anchor}\">{number}. {title}</a>{missing}</li>\n"));
    }
    if is_reproduced {
        page.push_str("<li><a href=\"#reproduced\">What could not be reproduced here</a></li>\n");
    }
    page.push_str("</ul>\n</nav>\n");
}

fn render_section(page: &mut String, section: &Section) {
    let (anchor, number, title) = (anchor("section", &section.id), section.number, escape(&section.title));
    append(
        page,
        format_args!(
            "<section id=\"{anchor}\" aria-labelledby=\"{anchor}-title\">\n<h2 id=\"{anchor}-title\">{number}. \
             {title}</h2>\n"
        ),
    );
    if !section.published.is_empty() {
        append(page, format_args!("<h3>Published</h3>\n<p>{}</p>\n", escape(&section.published)));
    }
    render_sentences(page, "What is different here", &section.differs);
    let is_measured = !(section.tables.is_empty() && section.figures.is_empty());
    if is_measured {
        page.push_str("<h3>Measured</h3>\n");
    }
    section.tables.iter().for_each(|table| render_table(page, table));
    section.figures.iter().for_each(|figure| render_figure(page, figure));
    render_sentences(page, "Findings", &section.findings);
    render_missing(page, &section.missing);
    if !is_measured && section.findings.is_empty() && section.missing.is_empty() {
        page.push_str("<p>Nothing was measured.</p>\n");
    }
    page.push_str("</section>\n");
}

fn render_sentences(page: &mut String, heading: &str, sentences: &[String]) {
    if !sentences.is_empty() {
        let items: String = sentences.iter().map(|sentence| format!("<li>{}</li>\n", escape(sentence))).collect();
        append(page, format_args!("<h3>{heading}</h3>\n<ul>\n{items}</ul>\n"));
    }
}

fn render_missing(page: &mut String, missing: &[MissingMeasurement]) {
    if missing.is_empty() {
        return;
    }
    page.push_str("<div class=\"missing\">\n<h3>What was not measured</h3>\n<ul>\n");
    for MissingMeasurement { what, why, next } in missing {
        let [what, why, next] = [what, why, next].map(|text| escape(text));
        append(page, format_args!("<li><strong>{what}</strong><br>Why: {why}<br>Next step: {next}</li>\n"));
    }
    page.push_str("</ul>\n</div>\n");
}

fn is_number(cell: &str) -> bool {
    let digits = cell.trim_start_matches(['-', '−', '+', '<', '>', '≤', '≥', '~', ' ']);
    digits.starts_with(|first: char| first.is_ascii_digit())
}

/// Renders a table. Its box can receive the focus, so that it can be scrolled by keyboard. A column is right-aligned if
/// all its non-empty cells are numbers.
fn render_table(page: &mut String, table: &Table) {
    let caption = escape(&table.caption);
    append(
        page,
        format_args!(
            "<div class=\"table\" role=\"region\" tabindex=\"0\" \
             aria-label=\"{caption}\">\n<table>\n<caption>{caption}</caption>\n<thead><tr>"
        ),
    );
    let has_numbers = |column: usize| {
        let cells = table.rows.iter().filter_map(|row| row.get(column));
        let mut said = cells.filter(|cell| !matches!(cell.as_str(), "" | "-" | "–" | "—"));
        column > 0 && said.all(|cell| is_number(cell))
    };
    let class = |column: usize| if has_numbers(column) { " class=\"number\"" } else { "" };
    let classes: Vec<&str> = (0..table.head.len()).map(class).collect();
    for (name, class) in table.head.iter().zip(&classes) {
        append(page, format_args!("<th scope=\"col\"{class}>{}</th>", escape(name)));
    }
    page.push_str("</tr></thead>\n<tbody>\n");
    for row in &table.rows {
        let cells = row.iter().zip(&classes).enumerate().map(|(column, (cell, class))| match column {
            0 => format!("<th scope=\"row\">{}</th>", escape(cell)),
            _ => format!("<td{class}>{}</td>", escape(cell)),
        });
        append(page, format_args!("<tr>{}</tr>\n", cells.collect::<String>()));
    }
    if table.rows.is_empty() {
        append(page, format_args!("<tr><td colspan=\"{}\">nothing was measured</td></tr>\n", table.head.len().max(1)));
    }
    page.push_str("</tbody>\n</table>\n</div>\n");
}

/// Renders a figure: drawings of ours, whose text is escaped, are inlined; pixels become images, which are placed side
/// by side.
fn render_figure(page: &mut String, figure: &Figure) {
    let (anchor, caption) = (anchor("figure", &figure.id), escape(&figure.caption));
    let (class, image) = match &figure.image {
        FigureImage::Svg(svg) => {
            ("", format!("<div class=\"drawing\" role=\"img\" aria-label=\"{caption}\">{}</div>", svg.trim()))
        }
        FigureImage::Png(bytes) => {
            let data = STANDARD.encode(bytes);
            (" class=\"pixels\"", format!("<img src=\"data:image/png;base64,{data}\" alt=\"{caption}\">"))
        }
    };
    append(
        page,
        format_args!("<figure id=\"{anchor}\"{class}>\n{image}\n<figcaption>{caption}</figcaption>\n</figure>\n"),
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::words::assert_tells;

    const EVIL: &str = "<script>alert(\"1\")</script> & 'x'\u{0}";

    fn hostile_section() -> Section {
        let mut section = Section::new(3, EVIL, EVIL);
        section.published = EVIL.into();
        section.differs.push(EVIL.into());
        section.findings.push(EVIL.into());
        section.tables.push(Table::new(EVIL, &format!("{EVIL} | {EVIL}")));
        section.tables[0].push([EVIL, EVIL]);
        section.figures.push(Figure::png(EVIL, EVIL, vec![1, 2, 3]));
        section.missing.push(MissingMeasurement::new(EVIL, EVIL, EVIL));
        section
    }

    #[test]
    fn everything_is_escaped_and_nothing_is_fetched() {
        let page = render(&[hostile_section()], EVIL, EVIL, &[[EVIL; 3]]);
        assert!(!page.contains("<script"), "{page}");
        assert!(!page.contains('\u{0}') && !page.contains("& '"), "{page}");
        assert!(page.contains("&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt; &amp; &#39;x&#39;"));
        assert_eq!(page.matches("src=\"data:").count(), page.matches("src=").count());
        for word in ["<link", "@import", "url("] {
            assert!(!page.contains(word), "{word}");
        }
    }

    #[test]
    fn a_plot_is_inline() {
        let series = [crate::plots::Series::new("one", vec![(0.0, 1.0), (1.0, 2.0)])];
        let mut section = Section::new(2, "rrt", "RRT");
        section.add_drawing("fig-5", "by request", crate::plots::lines("t", "x", "y < z", &series, false));
        let page = render(&[section], "m", "d", &[]);
        assert_tells(&page, "<figure id=\"figure-fig-5\">");
        assert_tells(&page, "role=\"img\" aria-label=\"by request\"><svg ");
        assert_tells(&page, "<figcaption>by request</figcaption>");
        assert!(!page.contains("data:"), "{page}");
    }

    #[test]
    fn every_part_is_shown() {
        let mut section = Section::new(9, "isolation", "Several robots");
        section.published = "as published".into();
        section.differs.push("two cores".into());
        section.findings.push("worse than hoped, because".into());
        section.tables.push(Table::new("RRT", "set-up | RRT (s) | note"));
        section.tables[0].push(["none", "0.20", "n"]);
        section.missing.push(MissingMeasurement::new("8 neighbours", "out of memory", "more memory"));
        let page = render(&[section], "2 × some processor", "2026-11-25", &[["GPU", "CPU", "there is none"]]);
        for wanted in [
            "<html lang=\"en\">",
            "href=\"#section-isolation\"",
            "id=\"section-isolation\"",
            "(1 thing was not measured)",
            "as published",
            "<li>two cores</li>",
            "<li>worse than hoped, because</li>",
            "<th scope=\"col\" class=\"number\">RRT (s)</th><th scope=\"col\">note</th>",
            "<th scope=\"row\">none</th><td class=\"number\">0.20</td><td>n</td>",
            "<strong>8 neighbours</strong><br>Why: out of memory<br>Next step: more memory",
            "<th scope=\"row\">GPU</th><td>CPU</td><td>there is none</td>",
            "2 × some processor",
            "2026-11-25",
        ] {
            assert_tells(&page, wanted);
        }
    }

    #[test]
    fn what_is_empty_is_said() {
        assert!(render(&[], "m", "d", &[]).contains("Nothing was measured."));
        let mut section = Section::new(1, "a", "A");
        assert!(render(std::slice::from_ref(&section), "m", "d", &[]).contains("Nothing was measured."));
        section.tables.push(Table::new("t", "a | b"));
        assert!(render(&[section], "m", "d", &[]).contains("<td colspan=\"2\">nothing was measured</td>"));
    }
}
