//! What all plots share: the ground, title, legend, axes and markers.
//!
//! Everything is drawn at [`SCALE`] times its size, because plotters puts everything on whole pixels.

use super::axis::Axis;
use anyhow::Result;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Drawn pixels for each one shown.
pub(super) const SCALE: i32 = 2;
/// Shown pixels.
pub(super) const WIDTH: u32 = 860;
/// Shown pixels of the part below title and legend.
pub(super) const HEIGHT: u32 = 380;
const TITLE: i32 = 15;
/// Shown pixels of most letters.
pub(super) const TEXT: i32 = 12;
const SMALL: i32 = 11;
const GREY: RGBColor = RGBColor(0x55, 0x55, 0x55);
const GRID: RGBColor = RGBColor(0xdd, 0xdd, 0xdd);
const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
const LEGEND_ROW: i32 = 20;
const LEGEND_LEFT: i32 = 16;
/// Of the note below the plot.
const NOTE: u32 = 14;
/// Left of the vertical axis' name.
const EDGE: u32 = 8;
/// Below the axis: its labels and its name.
const BELOW: i32 = 48;

/// Of Okabe and Ito; yellow, which white hides, comes last.
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

/// How the legend shows a series.
#[derive(Clone, Copy)]
pub(super) enum Sign {
    Line,
    Point,
    Patch,
    /// A shaded range.
    Shade,
}

/// An entry of the legend: the series' index decides on colour and marker.
pub(super) struct Entry<'a> {
    pub index: usize,
    pub name: &'a str,
    pub sign: Sign,
}

/// Legend entries of series in their order.
pub(super) fn entries<'a>(names: impl IntoIterator<Item = &'a str>, sign: Sign) -> Vec<Entry<'a>> {
    let numbered = names.into_iter().enumerate();
    numbered
        .map(|(index, name)| Entry { index, name, sign })
        .collect()
}

pub(super) fn colour(index: usize) -> RGBColor {
    PALETTE[index % PALETTE.len()]
}

/// The colour of shaded ranges.
pub(super) fn shade() -> RGBColor {
    RGBColor(0xec, 0xec, 0xec)
}

/// Shown pixels that so many letters take, about.
pub(super) fn text_width(letters: usize, size: i32) -> i32 {
    (letters as f64 * f64::from(size) * 0.58).ceil() as i32
}

/// Plotters divides the sizes of letters by 1.24.
fn font(size: i32) -> FontDesc<'static> {
    ("sans-serif", f64::from(size * SCALE) * 1.24).into_font()
}

/// Where a text stands at its point.
#[derive(Clone, Copy)]
pub(super) enum Anchor {
    /// The point is left of it.
    Left,
    /// The point is below its middle.
    Above,
    /// The point is above its middle.
    Below,
    /// The point is below it, and it reads upwards.
    Upwards,
}

/// Writes a text at a drawn pixel.
pub(super) fn write(
    area: &Area,
    text: &str,
    at: (i32, i32),
    size: i32,
    anchor: Anchor,
) -> Result<()> {
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

/// Words in lines of at most so many letters; a longer word has a line of its own.
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

/// The parts of a document above the plot, measured before they are drawn.
pub(super) struct Head<'a> {
    title: Vec<String>,
    /// Rows of the legend; each entry with its place, in shown pixels from the left.
    legend: Vec<Vec<(i32, Entry<'a>)>>,
    /// Shown pixels from the top of the document to the plot.
    pub height: u32,
}

impl<'a> Head<'a> {
    pub fn new(title: &str, legend: Vec<Entry<'a>>, width: u32) -> Self {
        let title = wrap(
            title,
            (f64::from(width) / (f64::from(TITLE) * 0.6)) as usize,
        );
        let mut rows: Vec<Vec<(i32, Entry)>> = Vec::new();
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
        Self {
            title,
            legend: rows,
            height: height as u32,
        }
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
                sign(area, (*x * SCALE, y * SCALE), entry)?;
                let beside = ((*x + 28) * SCALE, y * SCALE);
                write(area, entry.name, beside, TEXT, Anchor::Left)?;
            }
            y += LEGEND_ROW;
        }
        Ok(())
    }
}

fn sign(area: &Area, (x, y): (i32, i32), entry: &Entry) -> Result<()> {
    let (middle, end) = (x + 11 * SCALE, x + 22 * SCALE);
    match entry.sign {
        Sign::Line => {
            stroke(area, &[(x, y), (end, y)], colour(entry.index), 2)?;
            mark(area, (middle, y), entry.index, 4)?;
        }
        Sign::Point => mark(area, (middle, y), entry.index, 4)?,
        Sign::Patch | Sign::Shade => {
            let colour = match entry.sign {
                Sign::Shade => shade(),
                _ => colour(entry.index),
            };
            let half = 6 * SCALE;
            let corners = [(x + 4 * SCALE, y - half), (end - 2 * SCALE, y + half)];
            area.draw(&Rectangle::new(corners, colour.filled()))?;
        }
    }
    Ok(())
}

/// A document of a head, what `draw` adds below it, and a note in the lowest corner. The size is that of the part below
/// the head, in shown pixels; `draw` is given the whole document.
pub(super) fn document(
    head: &Head,
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
            let style = TextStyle::from(font(SMALL - 1))
                .color(&GREY)
                .pos(Pos::new(HPos::Right, VPos::Bottom));
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

/// The note on values that are not drawn.
pub(super) fn left_out(count: usize) -> Option<String> {
    match count {
        0 => None,
        1 => Some("1 value is left out: not finite, or no place on the axis".to_owned()),
        more => Some(format!(
            "{more} values are left out: not finite, or no place on the axis"
        )),
    }
}

/// A document that says that nothing was measured.
pub(super) fn nothing(title: &str, omitted: usize) -> Result<String> {
    let head = Head::new(title, Vec::new(), WIDTH);
    document(&head, (WIDTH, 90), left_out(omitted), |area| {
        let (width, height) = area.dim_in_pixel();
        let at = (width as i32 / 2, height as i32 / 2 + 10 * SCALE);
        write(area, "nothing was measured", at, TITLE, Anchor::Above)
    })
}

/// The sides of a plot, in shown pixels.
pub(super) struct Sides {
    pub left: u32,
    pub right: u32,
    /// Whether the horizontal axis has its labels here.
    pub below: bool,
}

impl Sides {
    /// With room for the vertical axis' labels and name.
    pub fn of(y: &Axis) -> Self {
        Self {
            left: (text_width(y.widest(), TEXT) + 36) as u32 + EDGE,
            right: 24,
            below: true,
        }
    }
}

/// Axes and grid on the rows `rows` (shown pixels, from the top of the document) of an area.
pub(super) fn chart<'a, 'b>(
    area: &'a Area<'b>,
    (top, bottom): (u32, u32),
    sides: &Sides,
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

/// A line through drawn pixels; `width` in shown pixels.
pub(super) fn stroke(area: &Area, path: &[(i32, i32)], colour: RGBColor, width: u32) -> Result<()> {
    if path.len() > 1 {
        let style = colour.stroke_width(width * SCALE as u32);
        area.draw(&PathElement::new(path.to_vec(), style))?;
    }
    Ok(())
}

/// The marker of a series at a drawn pixel; `size` is its radius, in shown pixels.
pub(super) fn mark(area: &Area, (x, y): (i32, i32), index: usize, size: i32) -> Result<()> {
    let colour = colour(index);
    let r = size * SCALE;
    let polygon = |points: &[(i32, i32)]| {
        let points: Vec<_> = points.iter().map(|(dx, dy)| (x + dx, y + dy)).collect();
        area.draw(&Polygon::new(points, colour.filled()))
    };
    let cross = |a: (i32, i32), b: (i32, i32)| {
        let style = colour.stroke_width(2 * SCALE as u32);
        area.draw(&PathElement::new(
            vec![(x - a.0, y - a.1), (x + a.0, y + a.1)],
            style,
        ))?;
        area.draw(&PathElement::new(
            vec![(x - b.0, y - b.1), (x + b.0, y + b.1)],
            style,
        ))
    };
    let s = r * 4 / 5;
    // When the colours begin again, their markers are others.
    match (index + index / PALETTE.len()) % 8 {
        0 => area.draw(&Circle::new((x, y), r * 9 / 10, colour.filled()))?,
        1 => polygon(&[(0, -r), (r, s), (-r, s)])?,
        2 => polygon(&[(-s, -s), (s, -s), (s, s), (-s, s)])?,
        3 => polygon(&[(0, -r - SCALE), (r, 0), (0, r + SCALE), (-r, 0)])?,
        4 => cross((s, s), (s, -s))?,
        5 => polygon(&[(0, r), (r, -s), (-r, -s)])?,
        6 => cross((r, 0), (0, r))?,
        _ => area.draw(&Circle::new(
            (x, y),
            s,
            colour.stroke_width(2 * SCALE as u32),
        ))?,
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
