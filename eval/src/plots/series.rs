//! Plots of series: lines, points, trajectories and distributions.

use super::Series;
use super::axis::Axis;
use super::canvas::{
    Area, Chart, HEIGHT, LegendEntry, LegendSymbol, PlotHeader, PlotMargins, WIDTH, chart, colour, document, draw_line,
    draw_marker, empty_plot, entries, omission_note,
};
use anyhow::Result;
use std::collections::HashSet;

/// Up to this number of points all points of a line have markers.
const FEW: usize = 30;
/// Number of markers on a longer line.
const MARKERS: usize = 10;
/// Shown pixels below the plot that [`chart`] uses for the horizontal axis.
const AXIS: f64 = 48.0;
/// Minimum and maximum height of a map's plot, in shown pixels.
const MAP_HEIGHT: (f64, f64) = (220.0, 640.0);

/// Positions on both axes; `None` for points that cannot be shown.
type AxisPositions = Vec<Option<(f64, f64)>>;

/// Draws lines through the points in their order; an omitted value interrupts its line. `x` and `y` are the labels of
/// the axes, with units.
pub fn lines(title: &str, x: &str, y: &str, series: &[Series], log_y: bool) -> Result<String> {
    curves(title, x, y, series, &[], log_y)
}

/// Draws points without lines.
pub fn points(title: &str, x: &str, y: &str, series: &[Series], log_y: bool) -> Result<String> {
    curves(title, x, y, &[], series, log_y)
}

/// Draws curves, such as those of a model, as lines, and measurements as points.
pub fn curves(
    title: &str,
    x_name: &str,
    y_name: &str,
    curves: &[Series],
    points: &[Series],
    log_y: bool,
) -> Result<String> {
    let series = [curves, points].concat();
    let usable = usable_points(&series, log_y);
    let x = Axis::for_values(usable.iter().map(|point| point.0), false);
    let y = Axis::for_values(usable.iter().map(|point| point.1), log_y);
    let omitted = count(&series) - usable.len();
    let (Some(x), Some(y)) = (x, y) else {
        return empty_plot(title, omitted);
    };
    let placed = to_positions(&series, &x, &y);
    let mut legend = legend(&series);
    for entry in legend.iter_mut().filter(|entry| entry.index >= curves.len()) {
        entry.sign = LegendSymbol::Point;
    }
    let head = PlotHeader::new(title, legend, WIDTH);
    document(&head, (WIDTH, HEIGHT), omission_note(omitted), |area| {
        let rows = (head.height, head.height + HEIGHT - 12);
        let margins = PlotMargins::for_axis(&y);
        let chart = chart(area, rows, &margins, (&x, x_name), (&y, y_name))?;
        draw(area, &chart, &placed, curves.len())
    })
}

/// Draws trajectories as lines, with the same scale for x and y.
pub fn map(title: &str, x_name: &str, y_name: &str, series: &[Series]) -> Result<String> {
    let usable = usable_points(series, false);
    let x = Axis::for_values(usable.iter().map(|point| point.0), false);
    let y = Axis::for_values(usable.iter().map(|point| point.1), false);
    let omitted = count(series) - usable.len();
    let (Some(x), Some(y)) = (x, y) else {
        return empty_plot(title, omitted);
    };
    let sides = PlotMargins::for_axis(&y);
    let width = f64::from(WIDTH - sides.left - sides.right);
    let height = (width * (y.high - y.low) / (x.high - x.low)).clamp(MAP_HEIGHT.0, MAP_HEIGHT.1);
    // Metres per pixel in the direction that needs more.
    let metres = ((x.high - x.low) / width).max((y.high - y.low) / height);
    let around = |axis: &Axis, pixels: f64| {
        let middle = axis.low / 2.0 + axis.high / 2.0;
        Axis::with_bounds(middle - metres * pixels / 2.0, middle + metres * pixels / 2.0)
    };
    let (x, y) = (around(&x, width), around(&y, height));
    let placed = to_positions(series, &x, &y);
    let head = PlotHeader::new(title, legend(series), WIDTH);
    let plot = (height + AXIS) as u32;
    document(&head, (WIDTH, plot + 12), omission_note(omitted), |area| {
        let rows = (head.height, head.height + plot);
        let chart = chart(area, rows, &sides, (&x, x_name), (&y, y_name))?;
        draw(area, &chart, &placed, placed.len())
    })
}

/// Draws the empirical cumulative distribution of each series: for each value, the percentage of the series that is at
/// most as large. `x` is the label of the axis, with its unit. Values that the axis cannot show, such as infinite ones,
/// still count in the percentages; NaN does not.
pub fn distribution(title: &str, x_name: &str, series: &[(String, Vec<f64>)], log_x: bool) -> Result<String> {
    let values = || series.iter().flat_map(|one| one.1.iter().copied());
    let y = Axis::with_bounds(0.0, 102.0);
    let Some(x) = Axis::for_values(values(), log_x) else {
        return empty_plot(title, values().count());
    };
    let omitted = values().filter(|value| x.position(*value).is_none());
    let omitted = omitted.count();
    let unknown = values().filter(|value| value.is_nan()).count();
    let note = omission_note(unknown)
        .or((omitted > 0)
            .then(|| format!("{omitted} of the values have no place on the axis, but count in the shares")));
    let placed: Vec<AxisPositions> = series.iter().map(|one| steps(&one.1, &x)).collect();
    let names = series.iter().map(|one| one.0.as_str());
    let head = PlotHeader::new(title, entries(names, LegendSymbol::Line), WIDTH);
    document(&head, (WIDTH, HEIGHT), note, |area| {
        let rows = (head.height, head.height + HEIGHT - 12);
        let vertical = (&y, "share of values at most as large (%)");
        let chart = chart(area, rows, &PlotMargins::for_axis(&y), (&x, x_name), vertical)?;
        draw(area, &chart, &placed, placed.len())
    })
}

/// Returns each finite value once, with the percentage of all numbers that is at most as large.
pub(super) fn cumulative_shares(values: &[f64]) -> Vec<(f64, f64)> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|value| !value.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    let all = sorted.len() as f64;
    let mut shares: Vec<(f64, f64)> = Vec::new();
    for (index, value) in sorted.into_iter().enumerate() {
        let share = 100.0 * (index + 1) as f64 / all;
        match shares.last_mut() {
            Some(last) if last.0 == value => last.1 = share,
            _ => shares.push((value, share)),
        }
    }
    shares.retain(|(value, _)| value.is_finite());
    shares
}

/// Returns the distribution as a line that rises at each value.
fn steps(values: &[f64], x: &Axis) -> AxisPositions {
    let mut below = 0.0;
    let mut placed = Vec::new();
    for (value, share) in cumulative_shares(values) {
        if let Some(position) = x.position(value) {
            placed.push(Some((position, below)));
            placed.push(Some((position, share)));
        }
        below = share;
    }
    placed
}

/// Returns the legend; a single series without a name needs none.
fn legend(series: &[Series]) -> Vec<LegendEntry<'_>> {
    let names = series.iter().map(|one| one.name.as_str());
    let mut entries = entries(names, LegendSymbol::Line);
    entries.retain(|entry| !entry.name.is_empty());
    entries
}

fn count(series: &[Series]) -> usize {
    series.iter().map(|one| one.points.len()).sum()
}

/// Returns the points whose coordinates can both be shown.
fn usable_points(series: &[Series], log: bool) -> Vec<(f64, f64)> {
    let fits = |value: f64, log| Axis::for_values([value], log).is_some();
    series
        .iter()
        .flat_map(|one| one.points.iter().copied())
        .filter(|point| fits(point.0, false) && fits(point.1, log))
        .collect()
}

fn to_positions(series: &[Series], x: &Axis, y: &Axis) -> Vec<AxisPositions> {
    let position = |point: &(f64, f64)| Some((x.position(point.0)?, y.position(point.1)?));
    let one = |one: &Series| -> AxisPositions { one.points.iter().map(position).collect() };
    series.iter().map(one).collect()
}

/// Draws the first `lines` series as lines, the others as points.
fn draw(area: &Area, chart: &Chart, placed: &[AxisPositions], lines: usize) -> Result<()> {
    for (index, points) in placed.iter().enumerate() {
        let pixels: Vec<Option<(i32, i32)>> =
            points.iter().map(|point| point.map(|at| chart.backend_coord(&at))).collect();
        if index < lines {
            draw_series_line(area, &pixels, index, placed.len())?;
            continue;
        }
        let mut drawn = HashSet::new();
        for at in pixels.into_iter().flatten() {
            if drawn.insert(at) {
                draw_marker(area, at, index, 3)?;
            }
        }
    }
    Ok(())
}

fn draw_series_line(area: &Area, pixels: &[Option<(i32, i32)>], index: usize, of: usize) -> Result<()> {
    for part in pixels.split(Option::is_none) {
        let mut path: Vec<(i32, i32)> = part.iter().copied().flatten().collect();
        path.dedup();
        draw_line(area, &path, colour(index), 2)?;
    }
    let known: Vec<(i32, i32)> = pixels.iter().copied().flatten().collect();
    let (every, first) = match known.len() {
        // Markers of different lines are offset, so that coinciding lines remain visible.
        count if count > FEW => {
            let every = (count / MARKERS).max(1);
            (every, every * index / of.max(1))
        }
        _ => (1, 0),
    };
    if known.len() <= FEW || of > 1 {
        for at in known.into_iter().skip(first).step_by(every) {
            draw_marker(area, at, index, 4)?;
        }
    }
    Ok(())
}
