//! Common parts of all plots: background, title, legend, axes and markers.
//!
//! Everything is drawn at [`SCALE`] times its size, because plotters rounds to whole pixels.

use super::axis::Axis;
use anyhow::Result;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Drawn pixels per shown pixel.
pub(super) const SCALE: i32 = 2;
/// Width in shown pixels.
pub(super) const WIDTH: u32 = 860;
/// Height in shown pixels below title and legend.
pub(super) const HEIGHT: u32 = 380;
const TITLE: i32 = 15;
/// Default font size in shown pixels.
pub(super) const TEXT: i32 = 12;
const SMALL: i32 = 11;
const GREY: RGBColor = RGBColor(0x55, 0x55, 0x55);
const GRID: RGBColor = RGBColor(0xdd, 0xdd, 0xdd);
const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
const LEGEND_ROW: i32 = 20;
const LEGEND_LEFT: i32 = 16;
/// Height of the note below the plot.
const NOTE: u32 = 14;
/// Space to the left of the vertical axis' name.
const EDGE: u32 = 8;
/// Space below the axis for its labels and name.
const BELOW: i32 = 48;

/// Palette of Okabe and Ito; yellow comes last because it is hard to see on white.
const PALETTE: [RGBColor; 8] = [
    RGBColor(0x00, 0x72, 0xb2),
    RGBColor(0xd5, 0x5e, 0x00),
    RGBColor(0x00, 0x9e, 0x73),
    RGBColor(0xcc, 0x79, 0xa7),
    RGBColor(0xe6, 0x9f, 0x00),
    RGBColor(0x56, 0xb4, 0xe9),
    RGBColor(0x00, 0x00, 0x00),
    RGBColor(0xf0, 0xe4, 0x42),
];

pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub(super) type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<Axis, Axis>>;

/// Symbol of a series in the legend.
#[derive(Clone, Copy)]
pub(super) enum LegendSymbol {
    Line,
    Point,
    Patch,
    /// A shaded range.
    Shade,
}

/// An entry of the legend; the index of the series determines colour and marker.
pub(super) struct LegendEntry<'a> {
    pub index: usize,
    pub name: &'a str,
    pub sign: LegendSymbol,
}

/// Returns legend entries for series in their order.
pub(super) fn entries<'a>(names: impl IntoIterator<Item = &'a str>, sign: LegendSymbol) -> Vec<LegendEntry<'a>> {
    let numbered = names.into_iter().enumerate();
    numbered.map(|(index, name)| LegendEntry { index, name, sign }).collect()
}

pub(super) fn colour(index: usize) -> RGBColor {
    PALETTE[index % PALETTE.len()]
}

/// Colour of shaded ranges.
pub(super) fn shade() -> RGBColor {
    RGBColor(0xec, 0xec, 0xec)
}

/// Estimates the width of a text in shown pixels.
pub(super) fn text_width(letters: usize, size: i32) -> i32 {
    (letters as f64 * f64::from(size) * 0.58).ceil() as i32
}

/// plotters divides font sizes by 1.24.
fn font(size: i32) -> FontDesc<'static> {
    ("sans-serif", f64::from(size * SCALE) * 1.24).into_font()
}

/// Placement of a text relative to its point.
#[derive(Clone, Copy)]
pub(super) enum Anchor {
    /// To the right of the point.
    Left,
    /// Centred above the point.
    Above,
    /// Centred below the point.
    Below,
    /// Above the point, reading upwards.
    Upwards,
}

/// Writes a text at a drawn pixel.
pub(super) fn write_text(area: &Area, text: &str, at: (i32, i32), size: i32, anchor: Anchor) -> Result<()> {
    let (h, v) = match anchor {
        Anchor::Left | Anchor::Upwards => (HPos::Left, VPos::Center),
        Anchor::Above => (HPos::Center, VPos::Bottom),
        Anchor::Below => (HPos::Center, VPos::Top),
    };
    let mut font = font(size);
    if let Anchor::Upwards = anchor {
        font = font.transform(FontTransform::Rotate270);
    }
    let style = TextStyle::from(font).color(&INK).pos(Pos::new(h, v));
    area.draw(&Text::new(text.to_owned(), at, style))?;
    Ok(())
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

/// Title and legend of a document, measured before they are drawn.
pub(super) struct PlotHeader<'a> {
    title: Vec<String>,
    /// Rows of the legend; each entry with its distance from the left in shown pixels.
    legend: Vec<Vec<(i32, LegendEntry<'a>)>>,
    /// Shown pixels from the top of the document to the plot.
    pub height: u32,
}

impl<'a> PlotHeader<'a> {
    pub fn new(title: &str, legend: Vec<LegendEntry<'a>>, width: u32) -> Self {
        let title = wrap(title, (f64::from(width) / (f64::from(TITLE) * 0.6)) as usize);
        let mut rows: Vec<Vec<(i32, LegendEntry)>> = Vec::new();
        let mut next = LEGEND_LEFT;
        for entry in legend {
            let wide = text_width(entry.name.chars().count(), TEXT) + 46;
            match rows.last_mut() {
                Some(row) if next + wide <= width as i32 => row.push((next, entry)),
                _ => {
                    next = LEGEND_LEFT;
                    rows.push(vec![(next, entry)]);
                }
            }
            next += wide;
        }
        let height = 14 + (TITLE + 6) * title.len() as i32 + LEGEND_ROW * rows.len() as i32;
        Self { title, legend: rows, height: height as u32 }
    }

    fn draw(&self, area: &Area) -> Result<()> {
        let mut y = 8;
        for line in &self.title {
            let style = TextStyle::from(font(TITLE).style(FontStyle::Bold)).color(&INK);
            area.draw(&Text::new(line.clone(), (14 * SCALE, y * SCALE), style))?;
            y += TITLE + 6;
        }
        y += LEGEND_ROW / 2;
        for row in &self.legend {
            for (x, entry) in row {
                draw_symbol(area, (*x * SCALE, y * SCALE), entry)?;
                let beside = ((*x + 28) * SCALE, y * SCALE);
                write_text(area, entry.name, beside, TEXT, Anchor::Left)?;
            }
            y += LEGEND_ROW;
        }
        Ok(())
    }
}

fn draw_symbol(area: &Area, (x, y): (i32, i32), entry: &LegendEntry) -> Result<()> {
    let (middle, end) = (x + 11 * SCALE, x + 22 * SCALE);
    match entry.sign {
        LegendSymbol::Line => {
            draw_line(area, &[(x, y), (end, y)], colour(entry.index), 2)?;
            draw_marker(area, (middle, y), entry.index, 4)?;
        }
        LegendSymbol::Point => draw_marker(area, (middle, y), entry.index, 4)?,
        LegendSymbol::Patch | LegendSymbol::Shade => {
            let colour = match entry.sign {
                LegendSymbol::Shade => shade(),
                _ => colour(entry.index),
            };
            let half = 6 * SCALE;
            let corners = [(x + 4 * SCALE, y - half), (end - 2 * SCALE, y + half)];
            area.draw(&Rectangle::new(corners, colour.filled()))?;
        }
    }
    Ok(())
}

/// Creates a document with title and legend, the drawing of `draw` below them, and a note in the bottom corner. The
/// size is that of the part below the legend, in shown pixels; `draw` gets the whole document.
pub(super) fn document(
    head: &PlotHeader,
    (width, height): (u32, u32),
    note: Option<String>,
    draw: impl FnOnce(&Area) -> Result<()>,
) -> Result<String> {
    let scale = SCALE as u32;
    let height = height + head.height + if note.is_some() { NOTE } else { 0 };
    let mut text = String::new();
    {
        let backend = SVGBackend::with_string(&mut text, (width * scale, height * scale));
        let area = backend.into_drawing_area();
        area.fill(&WHITE)?;
        head.draw(&area)?;
        draw(&area)?;
        if let Some(note) = note {
            let style = TextStyle::from(font(SMALL - 1)).color(&GREY).pos(Pos::new(HPos::Right, VPos::Bottom));
            let at = ((width as i32 - 8) * SCALE, (height as i32 - 4) * SCALE);
            area.draw(&Text::new(note, at, style))?;
        }
        area.present()?;
    }
    Ok(text.replacen(
        &format!("width=\"{}\" height=\"{}\"", width * scale, height * scale),
        &format!("width=\"{width}\" height=\"{height}\""),
        1,
    ))
}

/// Returns the note on omitted values.
pub(super) fn omission_note(count: usize) -> Option<String> {
    match count {
        0 => None,
        1 => Some("1 value is left out: not finite, or no place on the axis".to_owned()),
        more => Some(format!("{more} values are left out: not finite, or no place on the axis")),
    }
}

/// Creates a document that says that nothing was measured.
pub(super) fn empty_plot(title: &str, omitted: usize) -> Result<String> {
    let head = PlotHeader::new(title, Vec::new(), WIDTH);
    document(&head, (WIDTH, 90), omission_note(omitted), |area| {
        let (width, height) = area.dim_in_pixel();
        let at = (width as i32 / 2, height as i32 / 2 + 10 * SCALE);
        write_text(area, "nothing was measured", at, TITLE, Anchor::Above)
    })
}

/// Margins of a plot, in shown pixels.
pub(super) struct PlotMargins {
    pub left: u32,
    pub right: u32,
    /// True if the labels of the horizontal axis are drawn here.
    pub below: bool,
}

impl PlotMargins {
    /// Leaves room for the labels and the name of the vertical axis.
    pub fn for_axis(y: &Axis) -> Self {
        Self { left: (text_width(y.longest_label(), TEXT) + 36) as u32 + EDGE, right: 24, below: true }
    }
}

/// Draws axes and grid between two rows of an area (in shown pixels from the top of the document).
pub(super) fn chart<'a, 'b>(
    area: &'a Area<'b>,
    (top, bottom): (u32, u32),
    sides: &PlotMargins,
    (x, x_name): (&Axis, &str),
    (y, y_name): (&Axis, &str),
) -> Result<Chart<'a, 'b>> {
    let scale = SCALE as u32;
    let (_, height) = area.dim_in_pixel();
    let below = if sides.below { BELOW as u32 } else { 8 };
    let mut chart = ChartBuilder::on(area)
        .margin_top(top * scale)
        .margin_bottom(height - bottom * scale)
        .margin_left(EDGE * scale)
        .margin_right(sides.right * scale)
        .x_label_area_size(below * scale)
        .y_label_area_size((sides.left - EDGE) * scale)
        .build_cartesian_2d(x.clone(), y.clone())?;
    let unwritten = |_: &f64| String::new();
    let labels = TextStyle::from(font(SMALL)).color(&INK);
    let mut mesh = chart.configure_mesh();
    mesh.bold_line_style(GRID.stroke_width(SCALE as u32))
        .light_line_style(TRANSPARENT)
        .axis_style(GREY.stroke_width(SCALE as u32))
        .label_style(labels)
        .axis_desc_style(TextStyle::from(font(TEXT)).color(&INK))
        .set_all_tick_mark_size(4 * SCALE)
        .y_desc(y_name);
    if sides.below {
        mesh.x_desc(x_name);
    } else {
        mesh.x_label_formatter(&unwritten);
    }
    mesh.draw()?;
    Ok(chart)
}

/// Draws a line through drawn pixels; `width` is in shown pixels.
pub(super) fn draw_line(area: &Area, path: &[(i32, i32)], colour: RGBColor, width: u32) -> Result<()> {
    if path.len() > 1 {
        let style = colour.stroke_width(width * SCALE as u32);
        area.draw(&PathElement::new(path.to_vec(), style))?;
    }
    Ok(())
}

/// Draws the marker of a series at a drawn pixel; `size` is its radius in shown pixels.
pub(super) fn draw_marker(area: &Area, (x, y): (i32, i32), index: usize, size: i32) -> Result<()> {
    let colour = colour(index);
    let r = size * SCALE;
    let polygon = |points: &[(i32, i32)]| {
        let points: Vec<_> = points.iter().map(|(dx, dy)| (x + dx, y + dy)).collect();
        area.draw(&Polygon::new(points, colour.filled()))
    };
    let cross = |a: (i32, i32), b: (i32, i32)| {
        let style = colour.stroke_width(2 * SCALE as u32);
        area.draw(&PathElement::new(vec![(x - a.0, y - a.1), (x + a.0, y + a.1)], style))?;
        area.draw(&PathElement::new(vec![(x - b.0, y - b.1), (x + b.0, y + b.1)], style))
    };
    let s = r * 4 / 5;
    // When colours repeat, the markers differ.
    match (index + index / PALETTE.len()) % 8 {
        0 => area.draw(&Circle::new((x, y), r * 9 / 10, colour.filled()))?,
        1 => polygon(&[(0, -r), (r, s), (-r, s)])?,
        2 => polygon(&[(-s, -s), (s, -s), (s, s), (-s, s)])?,
        3 => polygon(&[(0, -r - SCALE), (r, 0), (0, r + SCALE), (-r, 0)])?,
        4 => cross((s, s), (s, -s))?,
        5 => polygon(&[(0, r), (r, -s), (-r, -s)])?,
        6 => cross((r, 0), (0, r))?,
        _ => area.draw(&Circle::new((x, y), s, colour.stroke_width(2 * SCALE as u32)))?,
    }
    Ok(())
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
