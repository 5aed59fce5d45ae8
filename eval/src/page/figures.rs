//! Figures of the page: drawings that consist of shapes stand in it as they are, all others as images.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::{anchor, escaped, put};
use crate::section::{Figure, Image};

pub(super) fn picture(page: &mut String, figure: &Figure) {
    let anchor = anchor("figure", &figure.id);
    let caption = escaped(&figure.caption);
    // Maps stand side by side.
    let class = match figure.image {
        Image::Svg(_) => "",
        Image::Png(_) => " class=\"pixels\"",
    };
    put(page, format_args!("<figure id=\"{anchor}\"{class}>\n"));
    match &figure.image {
        Image::Svg(text) => match drawing(text) {
            Some(svg) => put(
                page,
                format_args!(
                    "<div class=\"drawing\" role=\"img\" aria-label=\"{caption}\">{svg}</div>\n"
                ),
            ),
            None => embed(page, "image/svg+xml", text.as_bytes(), &caption),
        },
        Image::Png(bytes) => embed(page, "image/png", bytes, &caption),
    }
    put(
        page,
        format_args!("<figcaption>{caption}</figcaption>\n</figure>\n"),
    );
}

fn embed(page: &mut String, kind: &str, bytes: &[u8], caption: &str) {
    put(
        page,
        format_args!(
            "<img src=\"data:{kind};base64,{}\" alt=\"{caption}\">\n",
            STANDARD.encode(bytes)
        ),
    );
}

/// The element of an SVG document that consists of shapes and text alone, as ours do. Any other becomes an image, in
/// which a browser runs and fetches nothing.
fn drawing(text: &str) -> Option<&str> {
    const SHAPES: [&str; 11] = [
        "svg", "g", "rect", "circle", "ellipse", "line", "polyline", "polygon", "path", "text",
        "tspan",
    ];
    let svg = text.find("<svg").map(|at| text[at..].trim_end())?;
    if !svg.ends_with("</svg>") && !svg.ends_with("/>") {
        return None;
    }
    let mut depth = 0usize;
    for (number, tag) in svg.split('<').skip(1).enumerate() {
        let tag = tag.split_once('>')?.0;
        let name = tag.trim_matches('/').split_whitespace().next()?;
        let whole = !tag.contains('\'') && tag.matches('"').count() % 2 == 0;
        let outside = number > 0 && depth == 0;
        if !SHAPES.contains(&name) || !whole || outside || tag.split('=').any(acts) {
            return None;
        }
        if tag.starts_with('/') {
            depth = depth.checked_sub(1)?;
        } else if !tag.ends_with('/') {
            depth += 1;
        }
    }
    (depth == 0).then_some(svg)
}

/// Whether what stands before a `=` ends with the name of an attribute that runs or fetches something.
fn acts(before: &str) -> bool {
    let name = before
        .trim_end()
        .rsplit(|character: char| !character.is_ascii_alphanumeric())
        .next()
        .unwrap_or_default()
        .to_ascii_lowercase();
    name.starts_with("on") || name == "href" || name == "style" || before.contains("url(")
}
