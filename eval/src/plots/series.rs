//! Plots of series: lines, points, trajectories and distributions.

use super::Series;
use super::axis::Axis;
use super::canvas::{
    Area, Chart, HEIGHT, LegendEntry, LegendSymbol, PlotHeader, PlotMargins, WIDTH, chart, colour,
    document, draw_line, draw_marker, empty_plot, entries, omission_note,
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

#[derive(Clone, Copy, PartialEq)]
enum SeriesShape {
    Lines,
    Points,
    /// This number of lines, then points.
    Curves(usize),
}

impl SeriesShape {
    /// Returns the shape of a single series.
    fn for_series(self, index: usize) -> Self {
        match self {
            Self::Curves(lines) if index < lines => Self::Lines,
            Self::Curves(_) => Self::Points,
            same => same,
        }
    }
}

/// Positions on both axes; `None` for points that cannot be shown.
type AxisPositions = Vec<Option<(f64, f64)>>;

pub(super) fn lines(
    title: &str,
    names: (&str, &str),
    series: &[Series],
    log: bool,
) -> Result<String> {
    plot(title, names, series, log, SeriesShape::Lines)
}

pub(super) fn points(
    title: &str,
    names: (&str, &str),
    series: &[Series],
    log: bool,
) -> Result<String> {
    plot(title, names, series, log, SeriesShape::Points)
}

/// Draws the first `curves` series as lines, the others as points.
pub(super) fn curves(
    title: &str,
    names: (&str, &str),
    series: &[Series],
    curves: usize,
    log: bool,
) -> Result<String> {
    plot(title, names, series, log, SeriesShape::Curves(curves))
}

fn plot(
    title: &str,
    names: (&str, &str),
    series: &[Series],
    log: bool,
    shape: SeriesShape,
) -> Result<String> {
    let usable = usable_points(series, log);
    let x = Axis::for_values(usable.iter().map(|point| point.0), false);
    let y = Axis::for_values(usable.iter().map(|point| point.1), log);
    let omitted = count(series) - usable.len();
    let (Some(x), Some(y)) = (x, y) else {
        return empty_plot(title, omitted);
    };
    let placed: Vec<AxisPositions> = series
        .iter()
        .map(|one| to_positions(&one.points, &x, &y))
        .collect();
    let mut legend = legend(series, LegendSymbol::Line);
    for entry in &mut legend {
        entry.sign = match shape.for_series(entry.index) {
            SeriesShape::Points => LegendSymbol::Point,
            _ => LegendSymbol::Line,
        };
    }
    let head = PlotHeader::new(title, legend, WIDTH);
    document(&head, (WIDTH, HEIGHT), omission_note(omitted), |area| {
        let rows = (head.height, head.height + HEIGHT - 12);
        let chart = chart(
            area,
            rows,
            &PlotMargins::for_axis(&y),
            (&x, names.0),
            (&y, names.1),
        )?;
        draw(area, &chart, &placed, shape)
    })
}

pub(super) fn map(title: &str, names: (&str, &str), series: &[Series]) -> Result<String> {
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
        Axis::with_bounds(
            middle - metres * pixels / 2.0,
            middle + metres * pixels / 2.0,
        )
    };
    let (x, y) = (around(&x, width), around(&y, height));
    let placed: Vec<AxisPositions> = series
        .iter()
        .map(|one| to_positions(&one.points, &x, &y))
        .collect();
    let head = PlotHeader::new(title, legend(series, LegendSymbol::Line), WIDTH);
    let plot = (height + AXIS) as u32;
    document(&head, (WIDTH, plot + 12), omission_note(omitted), |area| {
        let rows = (head.height, head.height + plot);
        let chart = chart(area, rows, &sides, (&x, names.0), (&y, names.1))?;
        draw(area, &chart, &placed, SeriesShape::Lines)
    })
}

pub(super) fn distribution(
    title: &str,
    name: &str,
    series: &[(String, Vec<f64>)],
    log: bool,
) -> Result<String> {
    let values = || series.iter().flat_map(|one| one.1.iter().copied());
    let y = Axis::with_bounds(0.0, 102.0);
    let Some(x) = Axis::for_values(values(), log) else {
        return empty_plot(title, values().count());
    };
    let omitted = values().filter(|value| x.position(*value).is_none());
    let omitted = omitted.count();
    let unknown = values().filter(|value| value.is_nan()).count();
    let note = omission_note(unknown).or((omitted > 0).then(|| {
        format!("{omitted} of the values have no place on the axis, but count in the shares")
    }));
    let placed: Vec<AxisPositions> = series.iter().map(|one| steps(&one.1, &x)).collect();
    let names = series.iter().map(|one| one.0.as_str());
    let head = PlotHeader::new(title, entries(names, LegendSymbol::Line), WIDTH);
    document(&head, (WIDTH, HEIGHT), note, |area| {
        let rows = (head.height, head.height + HEIGHT - 12);
        let vertical = (&y, "share of values at most as large (%)");
        let chart = chart(area, rows, &PlotMargins::for_axis(&y), (&x, name), vertical)?;
        draw(area, &chart, &placed, SeriesShape::Lines)
    })
}

/// Returns each finite value once, with the percentage of all numbers that is at most as large.
pub(super) fn cumulative_shares(values: &[f64]) -> Vec<(f64, f64)> {
    let mut sorted: Vec<f64> = values
        .iter()
        .copied()
        .filter(|value| !value.is_nan())
        .collect();
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
fn legend(series: &[Series], sign: LegendSymbol) -> Vec<LegendEntry<'_>> {
    let mut entries = entries(series.iter().map(|one| one.name.as_str()), sign);
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

fn to_positions(points: &[(f64, f64)], x: &Axis, y: &Axis) -> AxisPositions {
    points
        .iter()
        .map(|point| Some((x.position(point.0)?, y.position(point.1)?)))
        .collect()
}

fn draw(area: &Area, chart: &Chart, placed: &[AxisPositions], shape: SeriesShape) -> Result<()> {
    for (index, points) in placed.iter().enumerate() {
        let pixels: Vec<Option<(i32, i32)>> = points
            .iter()
            .map(|point| point.map(|at| chart.backend_coord(&at)))
            .collect();
        match shape.for_series(index) {
            SeriesShape::Lines | SeriesShape::Curves(_) => {
                draw_series_line(area, &pixels, index, placed.len())?
            }
            SeriesShape::Points => {
                let mut drawn = HashSet::new();
                for at in pixels.into_iter().flatten() {
                    if drawn.insert(at) {
                        draw_marker(area, at, index, 3)?;
                    }
                }
            }
        }
    }
    Ok(())
}

fn draw_series_line(
    area: &Area,
    pixels: &[Option<(i32, i32)>],
    index: usize,
    of: usize,
) -> Result<()> {
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
