//! Classified points over time, with horizontal levels, shaded degraded phases, and Q below.

use super::axis::Axis;
use super::canvas::{
    BELOW, Drawing, HEIGHT, LegendEntry, LegendSymbol, Plane, SHADE, TEXT, WIDTH, draw_nothing, entries, left_margin,
    omission_note, text_width,
};

/// Height of the strip for Q, and the space above it.
const STRIP: f64 = 90.0;
const GAP: f64 = 12.0;
const LEVEL: &str = "#333";

/// Data of [`timeline`].
#[derive(Debug, Clone, Default)]
pub struct TimelineData {
    /// (x, y, class), in the units of the axes; the class is an index into `classes`.
    pub points: Vec<(f64, f64, usize)>,
    pub classes: Vec<String>,
    pub bad: Vec<(f64, f64)>,
    pub levels: Vec<(f64, String)>,
    /// (x, Q), drawn in a strip below the plot; without values there is no strip.
    pub q: Vec<(f64, f64)>,
}

/// Draws classified points over shaded ranges, on a logarithmic axis, with horizontal levels and Q below. `x_name` and
/// `y_name` are the labels of the axes, with units.
pub fn timeline(title: &str, x_name: &str, y_name: &str, given: &TimelineData) -> String {
    let is_shown = |value: f64, log| Axis::for_values([value], log).is_some();
    let mut points = given.points.clone();
    points.retain(|point| is_shown(point.0, false) && is_shown(point.1, true));
    let mut q = given.q.clone();
    q.retain(|point| is_shown(point.0, false) && is_shown(point.1, false));
    let omitted = given.points.len() - points.len() + given.q.len() - q.len();

    let x = Axis::for_values(points.iter().map(|point| point.0).chain(q.iter().map(|point| point.0)), false);
    let levels = given.levels.iter().map(|level| level.0);
    let y = Axis::for_values(points.iter().map(|point| point.1).chain(levels), true);
    let (Some(x), Some(y), false) = (x, y, points.is_empty()) else {
        return draw_nothing(title, omitted);
    };
    let q_axis = Axis::for_values(q.iter().map(|point| point.1), false).map(Axis::with_zero);

    let left = q_axis.iter().map(left_margin).fold(left_margin(&y), f64::max);
    let longest = given.levels.iter().map(|level| level.1.chars().count()).max();
    let right = WIDTH - 24.0 - text_width(longest.unwrap_or(0), TEXT);
    let mut legend = entries(given.classes.iter().map(String::as_str), LegendSymbol::Point);
    if !given.bad.is_empty() {
        legend.push(LegendEntry { index: 0, name: "disturbed", sign: LegendSymbol::Shade });
    }
    let mut drawing = Drawing::new(title, &legend, WIDTH);
    let plane = Plane { x: x.clone(), y, left, right, top: drawing.top, bottom: drawing.top + HEIGHT };
    let bottom = if q_axis.is_some() { plane.bottom + GAP + STRIP } else { plane.bottom };
    for (from, to) in &given.bad {
        let ends = [*from, *to].map(|end| plane.pixel(end.clamp(x.low, x.high), plane.y.low).0);
        if ends[0] != ends[1] {
            drawing.rectangle((ends[0], plane.top), (ends[1], bottom), SHADE);
        }
    }
    drawing.axes(&plane, q_axis.is_none().then_some(x_name), y_name);
    draw_levels(&mut drawing, &plane, &given.levels);
    for (along, value, class) in &points {
        plane.place((*along, *value)).into_iter().for_each(|at| drawing.marker(at, *class, 3.0));
    }
    if let Some(axis) = q_axis {
        let strip = Plane { x, y: axis, left, right, top: bottom - STRIP, bottom };
        drawing.axes(&strip, Some(x_name), "Q");
        let path: Vec<(f64, f64)> = q.iter().filter_map(|point| strip.place(*point)).collect();
        drawing.line(&path, LEVEL, 2.0);
    }
    drawing.finish(bottom + BELOW, omission_note(omitted).as_deref())
}

/// Draws the levels, with labels beside the plot that do not cover each other.
fn draw_levels(drawing: &mut Drawing, plane: &Plane, levels: &[(f64, String)]) {
    let place = |(value, name): &(f64, String)| Some((plane.place((plane.x.low, *value))?.1, name.clone()));
    let mut lines: Vec<(f64, String)> = levels.iter().filter_map(place).collect();
    lines.sort_by(|one, other| one.0.total_cmp(&other.0));
    let mut last = f64::NEG_INFINITY;
    for (y, name) in lines {
        drawing.line(&[(plane.left, y), (plane.right, y)], LEVEL, 1.0);
        last = y.max(last + TEXT + 2.0);
        drawing.text((plane.right + 6.0, last + 4.0), "start", TEXT, &name);
    }
}
