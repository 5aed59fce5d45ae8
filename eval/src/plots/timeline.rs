//! Classified points over time, with horizontal levels, shaded degraded phases, and Q below.

use super::TimelineData;
use super::axis::Axis;
use super::canvas::{
    Anchor, Area, HEIGHT, LegendEntry, LegendSymbol, PlotHeader, PlotMargins, SCALE, TEXT, WIDTH, chart, document,
    draw_line, draw_marker, empty_plot, entries, omission_note, shade, text_width, write_text,
};
use anyhow::Result;
use plotters::prelude::*;

/// Height of the strip for Q with its axis, in shown pixels.
const STRIP: u32 = 140;
const LEVEL: RGBColor = RGBColor(0x33, 0x33, 0x33);
/// Minimum distance between the labels of two levels, in shown pixels.
const APART: i32 = TEXT + 2;

/// Draws classified points over shaded ranges, on a logarithmic axis, with horizontal levels and Q below. `x_name` and
/// `y_name` are the labels of the axes, with units.
pub fn timeline(title: &str, x_name: &str, y_name: &str, given: &TimelineData) -> Result<String> {
    let fits = |value: f64, log| Axis::for_values([value], log).is_some();
    let mut points = given.points.clone();
    points.retain(|point| fits(point.0, false) && fits(point.1, true));
    let mut q = given.q.clone();
    q.retain(|point| fits(point.0, false) && fits(point.1, false));
    let omitted = given.points.len() - points.len() + given.q.len() - q.len();

    let along = points.iter().map(|point| point.0);
    let x = Axis::for_values(along.chain(q.iter().map(|point| point.0)), false);
    let across = points.iter().map(|point| point.1);
    let levels = given.levels.iter().map(|level| level.0);
    let (Some(x), Some(y), false) = (x, Axis::for_values(across.chain(levels), true), points.is_empty()) else {
        return empty_plot(title, omitted);
    };
    let q_axis = Axis::for_values(q.iter().map(|point| point.1), false).map(|axis| axis.with_zero().sparse());

    let mut sides = PlotMargins::for_axis(&y);
    if let Some(axis) = &q_axis {
        sides.left = sides.left.max(PlotMargins::for_axis(axis).left);
    }
    let longest = given.levels.iter().map(|level| level.1.chars().count());
    sides.right += text_width(longest.max().unwrap_or(0), TEXT) as u32;
    sides.below = q_axis.is_none();

    let mut legend = entries(given.classes.iter().map(String::as_str), LegendSymbol::Point);
    if !given.bad.is_empty() {
        legend.push(LegendEntry { index: 0, name: "disturbed", sign: LegendSymbol::Shade });
    }
    let head = PlotHeader::new(title, legend, WIDTH);
    let strip = if q_axis.is_some() { STRIP } else { 0 };
    document(&head, (WIDTH, HEIGHT + strip), omission_note(omitted), |area| {
        let top = head.height;
        let end = top + HEIGHT + strip - 12;
        // Drawn first, so that grid and points are above it; it covers the area of the charts.
        let upper = (top, end - strip);
        draw_shading(area, given, &sides, &x, (top, end))?;
        let plot = chart(area, upper, &sides, (&x, x_name), (&y, y_name))?;
        let edge = plot.backend_coord(&(x.high, y.low)).0;
        let begin = plot.backend_coord(&(x.low, y.low)).0;
        let mut lines: Vec<(i32, &str)> = given
            .levels
            .iter()
            .filter_map(|(value, name)| {
                let position = y.position(*value)?;
                Some((plot.backend_coord(&(x.low, position)).1, name.as_str()))
            })
            .collect();
        lines.sort();
        let mut last = i32::MIN;
        for (at, name) in lines {
            draw_line(area, &[(begin, at), (edge, at)], LEVEL, 1)?;
            let beside = at.max(last.saturating_add(APART * SCALE));
            write_text(area, name, (edge + 6 * SCALE, beside), TEXT, Anchor::Left)?;
            last = beside;
        }
        for (along, value, class) in &points {
            if let (Some(along), Some(value)) = (x.position(*along), y.position(*value)) {
                draw_marker(area, plot.backend_coord(&(along, value)), *class, 3)?;
            }
        }
        if let Some(axis) = &q_axis {
            let sides = PlotMargins { below: true, ..sides };
            let rows = (end - strip + 6, end);
            let plot = chart(area, rows, &sides, (&x, x_name), (axis, "Q"))?;
            let path: Vec<(i32, i32)> = q.iter().map(|at| plot.backend_coord(at)).collect();
            draw_line(area, &path, LEVEL, 2)?;
        }
        Ok(())
    })
}

/// Shades the degraded ranges from the top of the plot to the bottom of the strip for Q.
fn draw_shading(
    area: &Area,
    given: &TimelineData,
    sides: &PlotMargins,
    x: &Axis,
    (top, end): (u32, u32),
) -> Result<()> {
    let left = f64::from(sides.left);
    let width = f64::from(WIDTH - sides.left - sides.right);
    let place = |value: f64| {
        let share = (value.clamp(x.low, x.high) - x.low) / (x.high - x.low);
        ((left + width * share) * f64::from(SCALE)) as i32
    };
    // Ends above the labels of the lowest axis.
    let bottom = (end as i32 - 48) * SCALE;
    for (from, to) in &given.bad {
        let outside = from.is_nan() || to.is_nan() || from.max(*to) < x.low || from.min(*to) > x.high;
        if !outside {
            let corners = [(place(*from), top as i32 * SCALE), (place(*to), bottom)];
            area.draw(&Rectangle::new(corners, shade().filled()))?;
        }
    }
    Ok(())
}
