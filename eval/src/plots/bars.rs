//! Grouped bar charts.

use super::axis::{Axis, three_digits};
use super::canvas::{
    Drawing, HEIGHT, INK, LegendSymbol, Plane, TEXT, WIDTH, colour, draw_nothing, entries, left_margin, omission_note,
    text_width, wrap,
};

/// Fraction of a group's width that its bars fill.
const FILLED: f64 = 0.84;
/// Font size of the value above a bar.
const VALUE: f64 = 11.0;
/// Minimum width of a bar, which its value fits, and maximum width.
const NARROW: f64 = 38.0;
const WIDE: f64 = 72.0;

/// A bar of a bar chart.
#[derive(Debug, Clone)]
pub struct Bar {
    /// Group of adjacent bars; groups are ordered by first occurrence.
    pub group: String,
    /// Name in the legend; each name has one colour.
    pub name: String,
    pub value: f64,
    pub spread: Option<(f64, f64)>,
}

impl Bar {
    pub fn new(group: impl Into<String>, name: impl Into<String>, value: f64) -> Self {
        Self { group: group.into(), name: name.into(), value, spread: None }
    }
}

/// Draws grouped bars with whiskers and values. `name` is the label of the axis, with its unit.
pub fn bars(title: &str, name: &str, bars: &[Bar], log: bool) -> String {
    // A zero has no height on a logarithmic axis, but its value is known and written.
    let known: Vec<&Bar> = bars.iter().filter(|bar| Axis::for_values([bar.value], false).is_some()).collect();
    let omitted = bars.len() - known.len();
    let log = log && known.iter().any(|bar| bar.value > 0.0);
    let ends = known.iter().flat_map(|bar| {
        let spread = bar.spread.unwrap_or((bar.value, bar.value));
        [bar.value, spread.0, spread.1]
    });
    let Some(y) = Axis::for_values(ends, log) else {
        return draw_nothing(title, omitted);
    };
    let names = find_distinct(known.iter().map(|bar| bar.name.as_str()));
    let groups = find_distinct(known.iter().map(|bar| bar.group.as_str()));
    let bars_of = |group: &str| known.iter().filter(|bar| bar.group == group).copied().collect::<Vec<&Bar>>();
    let most = groups.iter().map(|group| bars_of(group).len()).max().unwrap_or(1) as f64;
    let words = groups.iter().flat_map(|group| group.split_whitespace()).map(|word| word.chars().count());
    let least = (text_width(words.max().unwrap_or(0), TEXT) + 10.0).max(NARROW * most / FILLED);
    let left = left_margin(&y);
    let width = WIDTH.max(least * groups.len() as f64 + left + 24.0);
    let group_width = (width - left - 24.0) / groups.len() as f64;
    let bar_width = (group_width * FILLED / most).min(WIDE);

    let mut drawing = Drawing::new(title, &entries(names.iter().copied(), LegendSymbol::Patch), width);
    let mut x = Axis::with_bounds(0.0, groups.len() as f64);
    x.marks.clear();
    let (top, bottom) = (drawing.top, drawing.top + HEIGHT);
    let y = y.with_zero().with_room((VALUE + 8.0) / HEIGHT);
    let plane = Plane { x, y, left, right: width - 24.0, top, bottom };
    drawing.axes(&plane, Some(""), name);
    let mut lowest = bottom;
    for (index, group) in groups.iter().enumerate() {
        let (centre, _) = plane.pixel(index as f64 + 0.5, plane.y.low);
        let bars = bars_of(group);
        for (place, bar) in bars.iter().enumerate() {
            let x = centre + (place as f64 + 0.5 - bars.len() as f64 / 2.0) * bar_width;
            let of_name = names.iter().position(|name| *name == bar.name).unwrap_or(0);
            draw_bar(&mut drawing, &plane, bar, (x, bar_width), (log, colour(of_name)));
        }
        for (line, text) in wrap(group, (group_width / text_width(1, TEXT)) as usize).iter().enumerate() {
            let below = bottom + 20.0 + (TEXT + 3.0) * line as f64;
            drawing.text((centre, below), "middle", TEXT, text);
            lowest = lowest.max(below);
        }
    }
    drawing.finish(lowest, omission_note(omitted).as_deref())
}

/// Draws a bar around `x` with its whisker and its value.
fn draw_bar(drawing: &mut Drawing, plane: &Plane, bar: &Bar, (x, width): (f64, f64), (log, colour): (bool, &str)) {
    let pixel = |position: f64| plane.pixel(plane.x.low, position).1;
    let base = if log { plane.y.low } else { 0.0f64.clamp(plane.y.low, plane.y.high) };
    let height = pixel(plane.y.position(bar.value).unwrap_or(base));
    drawing.rectangle((x - width * 0.46, height), (x + width * 0.46, pixel(base)), colour);
    let mut top = height.min(pixel(base));
    if let Some((low, high)) = bar.spread {
        // On a logarithmic axis a whisker down to zero starts at the bottom.
        let low = plane.y.position(low).or((log && low <= 0.0).then_some(plane.y.low));
        if let Some((low, high)) = low.zip(plane.y.position(high)) {
            let (low, high) = (pixel(low), pixel(high));
            drawing.line(&[(x, low), (x, high)], INK, 1.0);
            for end in [low, high] {
                drawing.line(&[(x - width * 0.18, end), (x + width * 0.18, end)], INK, 1.0);
            }
            top = top.min(high);
        }
    }
    drawing.text((x, top - 3.0), "middle", VALUE, &three_digits(bar.value));
}

/// Returns each text once, in the order of first occurrence.
fn find_distinct<'a>(texts: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut found: Vec<&str> = Vec::new();
    for text in texts {
        if !found.contains(&text) {
            found.push(text);
        }
    }
    found
}
