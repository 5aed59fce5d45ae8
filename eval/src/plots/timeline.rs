//! Points by class over time, with what was promised across, bad times shaded, and Q below.

use super::Banded;
use super::axis::Axis;
use super::canvas::{
    Anchor, Area, Entry, HEIGHT, Head, SCALE, Sides, Sign, TEXT, WIDTH, chart, document, entries,
    left_out, mark, nothing, shade, stroke, text_width, write,
};
use anyhow::Result;
use plotters::prelude::*;

/// Shown pixels of the strip for Q, with the axis below it.
const STRIP: u32 = 140;
const LEVEL: RGBColor = RGBColor(0x33, 0x33, 0x33);
/// Between the middles of two levels' names, in shown pixels.
const APART: i32 = TEXT + 2;

pub(super) fn draw(title: &str, names: (&str, &str), given: &Banded) -> Result<String> {
    let fits = |value: f64, log| Axis::over([value], log).is_some();
    let mut points = given.points.clone();
    points.retain(|point| fits(point.0, false) && fits(point.1, true));
    let mut q = given.q.clone();
    q.retain(|point| fits(point.0, false) && fits(point.1, false));
    let omitted = given.points.len() - points.len() + given.q.len() - q.len();

    let along = points.iter().map(|point| point.0);
    let x = Axis::over(along.chain(q.iter().map(|point| point.0)), false);
    let across = points.iter().map(|point| point.1);
    let levels = given.levels.iter().map(|level| level.0);
    let (Some(x), Some(y), false) = (x, Axis::over(across.chain(levels), true), points.is_empty())
    else {
        return nothing(title, omitted);
    };
    let q_axis =
        Axis::over(q.iter().map(|point| point.1), false).map(|axis| axis.with_zero().sparse());

    let mut sides = Sides::of(&y);
    if let Some(axis) = &q_axis {
        sides.left = sides.left.max(Sides::of(axis).left);
    }
    let longest = given.levels.iter().map(|level| level.1.chars().count());
    sides.right += text_width(longest.max().unwrap_or(0), TEXT) as u32;
    sides.below = q_axis.is_none();

    let mut legend = entries(given.classes.iter().map(String::as_str), Sign::Point);
    if !given.bad.is_empty() {
        legend.push(Entry {
            index: 0,
            name: "disturbed",
            sign: Sign::Shade,
        });
    }
    let head = Head::new(title, legend, WIDTH);
    let strip = if q_axis.is_some() { STRIP } else { 0 };
    document(&head, (WIDTH, HEIGHT + strip), left_out(omitted), |area| {
        let top = head.height;
        let end = top + HEIGHT + strip - 12;
        // Shading comes first, so that grid and points are above it: its place is that of the charts.
        let upper = (top, end - strip);
        shading(area, given, &sides, &x, (top, end))?;
        let plot = chart(area, upper, &sides, (&x, names.0), (&y, names.1))?;
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
            stroke(area, &[(begin, at), (edge, at)], LEVEL, 1)?;
            let beside = at.max(last.saturating_add(APART * SCALE));
            write(area, name, (edge + 6 * SCALE, beside), TEXT, Anchor::Left)?;
            last = beside;
        }
        for (along, value, class) in &points {
            if let (Some(along), Some(value)) = (x.position(*along), y.position(*value)) {
                mark(area, plot.backend_coord(&(along, value)), *class, 3)?;
            }
        }
        if let Some(axis) = &q_axis {
            let sides = Sides {
                below: true,
                ..sides
            };
            let rows = (end - strip + 6, end);
            let plot = chart(area, rows, &sides, (&x, names.0), (axis, "Q"))?;
            let path: Vec<(i32, i32)> = q.iter().map(|at| plot.backend_coord(at)).collect();
            stroke(area, &path, LEVEL, 2)?;
        }
        Ok(())
    })
}

/// The bad ranges, from the top of the plot to the bottom of the strip for Q.
fn shading(
    area: &Area,
    given: &Banded,
    sides: &Sides,
    x: &Axis,
    (top, end): (u32, u32),
) -> Result<()> {
    let left = f64::from(sides.left);
    let width = f64::from(WIDTH - sides.left - sides.right);
    let place = |value: f64| {
        let share = (value.clamp(x.low, x.high) - x.low) / (x.high - x.low);
        ((left + width * share) * f64::from(SCALE)) as i32
    };
    // Above the labels of the lowest axis.
    let bottom = (end as i32 - 48) * SCALE;
    for (from, to) in &given.bad {
        let outside =
            from.is_nan() || to.is_nan() || from.max(*to) < x.low || from.min(*to) > x.high;
        if !outside {
            let corners = [(place(*from), top as i32 * SCALE), (place(*to), bottom)];
            area.draw(&Rectangle::new(corners, shade().filled()))?;
        }
    }
    Ok(())
}
