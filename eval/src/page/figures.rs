//! Figures of the page: drawings that consist of shapes are inlined, all others become images.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::{anchor, append, escape};
use crate::section::{Figure, FigureImage};

pub(super) fn render_figure(page: &mut String, figure: &Figure) {
    let anchor = anchor("figure", &figure.id);
    let caption = escape(&figure.caption);
    // Maps are placed side by side.
    let class = match figure.image {
        FigureImage::Svg(_) => "",
        FigureImage::Png(_) => " class=\"pixels\"",
    };
    append(page, format_args!("<figure id=\"{anchor}\"{class}>\n"));
    match &figure.image {
        FigureImage::Svg(text) => match inline_svg(text) {
            Some(svg) => append(
                page,
                format_args!(
                    "<div class=\"drawing\" role=\"img\" aria-label=\"{caption}\">{svg}</div>\n"
                ),
            ),
            None => embed_image(page, "image/svg+xml", text.as_bytes(), &caption),
        },
        FigureImage::Png(bytes) => embed_image(page, "image/png", bytes, &caption),
    }
    append(
        page,
        format_args!("<figcaption>{caption}</figcaption>\n</figure>\n"),
    );
}

fn embed_image(page: &mut String, kind: &str, bytes: &[u8], caption: &str) {
    append(
        page,
        format_args!(
            "<img src=\"data:{kind};base64,{}\" alt=\"{caption}\">\n",
            STANDARD.encode(bytes)
        ),
    );
}

/// Returns the `svg` element of a document that consists of shapes and text only, as ours do. Any other document
/// becomes an image, in which a browser neither runs nor loads anything.
fn inline_svg(text: &str) -> Option<&str> {
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
        if !SHAPES.contains(&name) || !whole || outside || tag.split('=').any(is_active_attribute) {
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

/// Returns whether the text before a `=` ends with the name of an attribute that runs or loads something.
fn is_active_attribute(before: &str) -> bool {
    let name = before
        .trim_end()
        .rsplit(|character: char| !character.is_ascii_alphanumeric())
        .next()
        .unwrap_or_default()
        .to_ascii_lowercase();
    name.starts_with("on") || name == "href" || name == "style" || before.contains("url(")
}
