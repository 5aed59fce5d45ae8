//! A drawing as SVG: title and legend first, then axes and shapes below them.

use std::fmt::Write;

use super::axis::Axis;
use crate::page::escape;

/// Width of a drawing, and height of the area between the axes, in pixels.
pub(super) const WIDTH: f64 = 860.0;
pub(super) const HEIGHT: f64 = 320.0;
/// Space below an area for the labels and the name of its horizontal axis.
pub(super) const BELOW: f64 = 52.0;
/// Default font size.
pub(super) const TEXT: f64 = 12.0;
pub(super) const INK: &str = "#222";
pub(super) const SHADE: &str = "#ececec";
const TITLE: f64 = 15.0;
const GREY: &str = "#555";
const LEGEND_ROW: f64 = 20.0;

/// Palette of Okabe and Ito; yellow comes last because it is hard to see on white.
const PALETTE: [&str; 8] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#f0e442"];
/// Outlines of the markers, one unit in radius: circle, triangles, square, diamond, crosses, ring.
const MARKERS: [&str; 8] = [
    "M-.9 0a.9 .9 0 1 0 1.8 0a.9 .9 0 1 0-1.8 0z",
    "M0-1L1 .8H-1z",
    "M-.8-.8H.8V.8H-.8z",
    "M0-1.2L1 0L0 1.2L-1 0z",
    "M-.8-1L0-.2L.8-1L1-.8L.2 0L1 .8L.8 1L0 .2L-.8 1L-1 .8L-.2 0L-1-.8z",
    "M0 1L1-.8H-1z",
    "M-.2-1H.2V-.2H1V.2H.2V1H-.2V.2H-1V-.2H-.2z",
    "M-.9 0a.9 .9 0 1 0 1.8 0a.9 .9 0 1 0-1.8 0zM-.5 0a.5 .5 0 1 0 1 0a.5 .5 0 1 0-1 0z",
];

/// A point of the drawing, in pixels from its upper left corner.
pub(super) type Pixel = (f64, f64);

/// Symbol of a series in the legend.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum LegendSymbol {
    Line,
    Point,
    Patch,
    Shade,
}

/// An entry of the legend; the index of the series determines colour and marker.
pub(super) struct LegendEntry<'a> {
    pub index: usize,
    pub name: &'a str,
    pub sign: LegendSymbol,
}

/// Returns legend entries for series in their order; a series without a name has none.
pub(super) fn entries<'a>(names: impl IntoIterator<Item = &'a str>, sign: LegendSymbol) -> Vec<LegendEntry<'a>> {
    let numbered = names.into_iter().enumerate().filter(|(_, name)| !name.is_empty());
    numbered.map(|(index, name)| LegendEntry { index, name, sign }).collect()
}

pub(super) fn colour(index: usize) -> &'static str {
    PALETTE[index % PALETTE.len()]
}

pub(super) fn text_width(letters: usize, size: f64) -> f64 {
    letters as f64 * size * 0.58
}

/// Breaks a text into lines of at most `letters` characters; a longer word gets a line of its own.
pub(super) fn wrap(text: &str, letters: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= letters => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// The area of a plot between its axes.
pub(super) struct Plane {
    pub x: Axis,
    pub y: Axis,
    pub left: f64,
    pub right: f64,
    pub top: f64,
    pub bottom: f64,
}

impl Plane {
    pub fn pixel(&self, x: f64, y: f64) -> Pixel {
        let across = self.left + (self.right - self.left) * self.x.share(x);
        (across, self.bottom - (self.bottom - self.top) * self.y.share(y))
    }

    /// Returns the pixel of a point; `None` if an axis cannot show it.
    pub fn place(&self, (x, y): (f64, f64)) -> Option<Pixel> {
        Some(self.pixel(self.x.position(x)?, self.y.position(y)?))
    }
}

/// Space to the left of an area for the labels and the name of its vertical axis.
pub(super) fn left_margin(y: &Axis) -> f64 {
    text_width(y.longest_label(), TEXT) + 44.0
}

/// A document being drawn.
pub(super) struct Drawing {
    body: String,
    width: f64,
    pub top: f64,
}

impl Drawing {
    pub fn new(title: &str, legend: &[LegendEntry], width: f64) -> Self {
        let mut drawing = Self { body: String::new(), width, top: 8.0 };
        for line in wrap(title, (width / (TITLE * 0.6)) as usize) {
            drawing.top += TITLE + 6.0;
            let at = drawing.top - 4.0;
            drawing.push(format_args!(
                "<text x=\"14\" y=\"{at}\" font-size=\"{TITLE}\" font-weight=\"bold\">{}</text>",
                escape(&line)
            ));
        }
        let mut x = f64::INFINITY;
        for entry in legend {
            let wide = text_width(entry.name.chars().count(), TEXT) + 46.0;
            if x + wide > width {
                (x, drawing.top) = (16.0, drawing.top + LEGEND_ROW);
            }
            let y = drawing.top - 6.0;
            drawing.draw_symbol((x, y), entry);
            drawing.text((x + 28.0, y + 4.0), "start", TEXT, entry.name);
            x += wide;
        }
        drawing.top += 10.0;
        drawing
    }

    fn push(&mut self, element: std::fmt::Arguments) {
        // Writing to a String cannot fail.
        let _ = writeln!(self.body, "{element}");
    }

    /// Writes a text; `anchor` is SVG's text-anchor.
    pub fn text(&mut self, (x, y): Pixel, anchor: &str, size: f64, words: &str) {
        let words = escape(words);
        self.push(format_args!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" font-size=\"{size}\">{words}</text>"
        ));
    }

    pub fn line(&mut self, path: &[Pixel], colour: &str, width: f64) {
        if path.len() > 1 {
            let points: Vec<String> = path.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            self.push(format_args!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>",
                points.join(" ")
            ));
        }
    }

    pub fn rectangle(&mut self, one: Pixel, other: Pixel, colour: &str) {
        let (x, y) = (one.0.min(other.0), one.1.min(other.1));
        let (width, height) = ((one.0 - other.0).abs(), (one.1 - other.1).abs());
        self.push(format_args!(
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill=\"{colour}\"/>"
        ));
    }

    /// Draws the marker of a series; when colours repeat, the markers differ.
    pub fn marker(&mut self, (x, y): Pixel, index: usize, radius: f64) {
        let shape = MARKERS[(index + index / PALETTE.len()) % MARKERS.len()];
        self.push(format_args!(
            "<path transform=\"translate({x:.1},{y:.1}) scale({radius})\" d=\"{shape}\" fill-rule=\"evenodd\" \
             fill=\"{}\"/>",
            colour(index)
        ));
    }

    fn draw_symbol(&mut self, (x, y): Pixel, entry: &LegendEntry) {
        match entry.sign {
            LegendSymbol::Line => self.line(&[(x, y), (x + 22.0, y)], colour(entry.index), 2.0),
            LegendSymbol::Patch => self.rectangle((x + 4.0, y - 6.0), (x + 20.0, y + 6.0), colour(entry.index)),
            LegendSymbol::Shade => self.rectangle((x + 4.0, y - 6.0), (x + 20.0, y + 6.0), SHADE),
            LegendSymbol::Point => {}
        }
        if matches!(entry.sign, LegendSymbol::Line | LegendSymbol::Point) {
            self.marker((x + 11.0, y), entry.index, 4.0);
        }
    }

    /// Draws grid, axes and labels; without a name the horizontal axis has no labels.
    pub fn axes(&mut self, plane: &Plane, x_name: Option<&str>, y_name: &str) {
        let Plane { left, right, top, bottom, .. } = *plane;
        for mark in &plane.y.marks {
            let (_, y) = plane.pixel(plane.x.low, *mark);
            self.line(&[(left, y), (right, y)], "#ddd", 1.0);
            self.text((left - 6.0, y + 4.0), "end", TEXT - 1.0, &plane.y.label(*mark));
        }
        for mark in &plane.x.marks {
            let (x, _) = plane.pixel(*mark, plane.y.low);
            self.line(&[(x, top), (x, bottom)], "#ddd", 1.0);
            if x_name.is_some() {
                self.text((x, bottom + 16.0), "middle", TEXT - 1.0, &plane.x.label(*mark));
            }
        }
        self.line(&[(left, top), (left, bottom), (right, bottom)], GREY, 1.0);
        if let Some(name) = x_name {
            self.text(((left + right) / 2.0, bottom + 38.0), "middle", TEXT, name);
        }
        let (middle, name) = ((top + bottom) / 2.0, escape(y_name));
        self.push(format_args!(
            "<text transform=\"translate(18,{middle:.1}) rotate(-90)\" text-anchor=\"middle\" \
             font-size=\"{TEXT}\">{name}</text>"
        ));
    }

    /// Ends the document below `bottom`, with a note in the corner.
    pub fn finish(mut self, bottom: f64, note: Option<&str>) -> String {
        let height = bottom + if note.is_some() { 26.0 } else { 12.0 };
        if let Some(note) = note {
            self.text((self.width - 8.0, height - 6.0), "end", TEXT - 2.0, note);
        }
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" viewBox=\"0 0 \
             {width:.0} {height:.0}\" font-family=\"sans-serif\" fill=\"{INK}\">\n<rect width=\"100%\" \
             height=\"100%\" fill=\"white\"/>\n{}</svg>\n",
            self.body,
            width = self.width
        )
    }
}

pub(super) fn omission_note(count: usize) -> Option<String> {
    let are = if count == 1 { "value is" } else { "values are" };
    (count > 0).then(|| format!("{count} {are} left out: not finite, or no place on the axis"))
}

/// Creates a document that says that nothing was measured.
pub(super) fn draw_nothing(title: &str, omitted: usize) -> String {
    let mut drawing = Drawing::new(title, &[], WIDTH);
    let bottom = drawing.top + 60.0;
    drawing.text((WIDTH / 2.0, bottom - 20.0), "middle", TITLE, "nothing was measured");
    drawing.finish(bottom, omission_note(omitted).as_deref())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_wrapped() {
        assert_eq!(wrap("one two three", 7), ["one two", "three"]);
        assert_eq!(wrap("incomprehensible", 4), ["incomprehensible"]);
        assert!(wrap("  ", 4).is_empty());
    }
}
