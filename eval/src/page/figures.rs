//! Figures of the page: drawings are inlined, pixels become images.

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
        // Drawings of ours consist of shapes and text, which is escaped.
        FigureImage::Svg(svg) => append(
            page,
            format_args!("<div class=\"drawing\" role=\"img\" aria-label=\"{caption}\">{}</div>\n", svg.trim()),
        ),
        FigureImage::Png(bytes) => append(
            page,
            format_args!("<img src=\"data:image/png;base64,{}\" alt=\"{caption}\">\n", STANDARD.encode(bytes)),
        ),
    }
    append(page, format_args!("<figcaption>{caption}</figcaption>\n</figure>\n"));
}
