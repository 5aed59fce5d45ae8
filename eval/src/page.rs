//! The report as a single HTML file that loads nothing and runs nothing, so that it can be sent as it is.

mod figures;
mod style;
mod tables;

use std::fmt::Write;

use crate::section::{MissingMeasurement, Section, Table};
use figures::render_figure;
use style::STYLE;
use tables::render_table;

/// Renders the page. `machine` describes where it was measured, `made` is the date; `reproduced` lists what could not
/// be reproduced here, the substitute, and the reason.
pub fn render(sections: &[Section], machine: &str, made: &str, reproduced: &[(String, String, String)]) -> String {
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <title>Cloudroid: the published experiments on one machine</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<header>\n\
         <h1>Cloudroid: the published experiments on one machine</h1>\n\
         <p>Measured on {}.<br>Made on {}.</p>\n\
         <p>Measured numbers are computed from what the experiments recorded. Ratios are those of this \
         machine.</p>\n</header>\n",
        escape(machine),
        escape(made)
    );
    render_contents(&mut page, sections, reproduced);
    page.push_str("<main>\n");
    for section in sections {
        render_section(&mut page, section);
    }
    if sections.is_empty() {
        page.push_str("<p>Nothing was measured.</p>\n");
    }
    if !reproduced.is_empty() {
        page.push_str("<section id=\"reproduced\">\n<h2>What could not be reproduced here</h2>\n");
        let mut table =
            Table::new("What the publication used, and what stands for it", "published | stand-in | reason");
        for (what, instead, why) in reproduced {
            table.push([what, instead, why]);
        }
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
fn escape(text: &str) -> String {
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
    let plain = id.chars().map(
        |character| {
            if character.is_ascii_alphanumeric() { character.to_ascii_lowercase() } else { '-' }
        },
    );
    format!("{kind}-{}", plain.collect::<String>())
}

fn render_contents(page: &mut String, sections: &[Section], reproduced: &[(String, String, String)]) {
    page.push_str("<nav aria-label=\"Contents\">\n<h2>Contents</h2>\n<ul>\n");
    for section in sections {
        let missing = match section.missing.len() {
            0 => String::new(),
            1 => " <small>(1 thing was not measured)</small>".to_owned(),
            more => format!(" <small>({more} things were not measured)</small>"),
        };
        append(
            page,
            format_args!(
                "<li><a href=\"#{}\">{}. {}</a>{missing}</li>\n",
                anchor("section", &section.id),
                section.number,
                escape(&section.title)
            ),
        );
    }
    if !reproduced.is_empty() {
        page.push_str("<li><a href=\"#reproduced\">What could not be reproduced here</a></li>\n");
    }
    page.push_str("</ul>\n</nav>\n");
}

fn render_section(page: &mut String, section: &Section) {
    let anchor = anchor("section", &section.id);
    append(
        page,
        format_args!(
            "<section id=\"{anchor}\" aria-labelledby=\"{anchor}-title\">\n<h2 id=\"{anchor}-title\">{}. {}</h2>\n",
            section.number,
            escape(&section.title)
        ),
    );
    if !section.published.is_empty() {
        append(page, format_args!("<h3>Published</h3>\n<p>{}</p>\n", escape(&section.published)));
    }
    render_sentences(page, "What is different here", &section.differs);
    let measured = !(section.tables.is_empty() && section.figures.is_empty());
    if measured {
        page.push_str("<h3>Measured</h3>\n");
    }
    for table in &section.tables {
        render_table(page, table);
    }
    for figure in &section.figures {
        render_figure(page, figure);
    }
    render_sentences(page, "Findings", &section.findings);
    render_missing(page, &section.missing);
    if !measured && section.findings.is_empty() && section.missing.is_empty() {
        page.push_str("<p>Nothing was measured.</p>\n");
    }
    page.push_str("</section>\n");
}

fn render_sentences(page: &mut String, heading: &str, sentences: &[String]) {
    if sentences.is_empty() {
        return;
    }
    append(page, format_args!("<h3>{heading}</h3>\n<ul>\n"));
    for sentence in sentences {
        append(page, format_args!("<li>{}</li>\n", escape(sentence)));
    }
    page.push_str("</ul>\n");
}

fn render_missing(page: &mut String, missing: &[MissingMeasurement]) {
    if missing.is_empty() {
        return;
    }
    page.push_str("<div class=\"missing\">\n<h3>What was not measured</h3>\n<ul>\n");
    for MissingMeasurement { what, why, next } in missing {
        append(
            page,
            format_args!(
                "<li><strong>{}</strong><br>Why: {}<br>Next step: {}</li>\n",
                escape(what),
                escape(why),
                escape(next)
            ),
        );
    }
    page.push_str("</ul>\n</div>\n");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::section::Figure;
    use crate::words::assert_tells;

    const EVIL: &str = "<script>alert(\"1\")</script> & 'x'\u{0}";

    fn hostile_section() -> Section {
        let mut section = Section::new(3, EVIL, EVIL);
        section.published = EVIL.into();
        section.differs.push(EVIL.into());
        section.findings.push(EVIL.into());
        section.tables.push(Table::new(EVIL, &format!("{EVIL} | {EVIL}")).row([EVIL, EVIL]));
        section.figures.push(Figure::png(EVIL, EVIL, vec![1, 2, 3]));
        section.missing.push(MissingMeasurement::new(EVIL, EVIL, EVIL));
        section
    }

    #[test]
    fn everything_is_escaped() {
        let row = (EVIL.to_owned(), EVIL.to_owned(), EVIL.to_owned());
        let page = render(&[hostile_section()], EVIL, EVIL, &[row]);
        assert!(!page.contains("<script"), "{page}");
        assert!(!page.contains('\u{0}') && !page.contains("& '"), "{page}");
        assert!(page.contains("&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt; &amp; &#39;x&#39;"));
    }

    #[test]
    fn nothing_is_fetched() {
        let page = render(&[hostile_section()], "m", "d", &[]);
        let sources = page.matches("src=").count();
        assert_eq!(page.matches("src=\"data:").count(), sources);
        for word in ["<link", "@import", "url("] {
            assert!(!page.contains(word), "{word}");
        }
    }

    #[test]
    fn a_plot_is_inline() {
        let plot = crate::plots::lines(
            "t",
            "x",
            "y < z",
            &[crate::plots::Series::new("one", vec![(0.0, 1.0), (1.0, 2.0)])],
            false,
        )
        .expect("it is drawn");
        let mut section = Section::new(2, "rrt", "RRT");
        section.figures.push(Figure::svg("fig-5", "by request", plot));
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
        section.tables.push(Table::new("RRT", "set-up | RRT (s) | note").row(["none", "0.20", "n"]));
        section.missing.push(MissingMeasurement::new("8 neighbours", "out of memory", "more memory"));
        let row = ("GPU".into(), "CPU".into(), "there is none".into());
        let page = render(&[section], "2 × some processor", "2026-11-25", &[row]);
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
        let page = render(std::slice::from_ref(&section), "m", "d", &[]);
        assert!(page.contains("Nothing was measured."));
        section.tables.push(Table::new("t", "a | b"));
        let page = render(&[section], "m", "d", &[]);
        assert!(page.contains("<td colspan=\"2\">nothing was measured</td>"));
    }
}
