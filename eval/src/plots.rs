//! SVG plots: each function turns numbers into the text of one document.
//!
//! Every plot has a white background, so that it is readable on light and dark pages, and colours that colour-blind
//! people can distinguish (Okabe and Ito, "Color Universal Design", 2008); each series also has a marker of its own.
//! Values that are not finite, or that a logarithmic axis cannot show, are omitted; the plot says how many. An empty
//! plot says that nothing was measured.

mod axis;
mod bars;
mod canvas;
mod timeline;

use axis::Axis;
use canvas::{
    BELOW, Drawing, HEIGHT, LegendSymbol, Pixel, Plane, WIDTH, colour, draw_nothing, entries, left_margin,
    omission_note,
};

pub use bars::{Bar, bars};
pub use timeline::{TimelineData, timeline};

/// Up to this number of points all points of a line have markers; a longer line has about [`MARKERS`].
const FEW: usize = 30;
const MARKERS: usize = 10;
/// Minimum and maximum height of a map's plot.
const MAP_HEIGHT: (f64, f64) = (220.0, 640.0);

/// A series of points.
#[derive(Debug, Clone)]
pub struct Series {
    pub name: String,
    /// (x, y), in the units of the axes.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    pub fn new(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points }
    }
}

/// Draws lines through the points in their order; an omitted value interrupts its line. `x` and `y` are the labels of
/// the axes, with units.
pub fn lines(title: &str, x: &str, y: &str, series: &[Series], log_y: bool) -> String {
    curves(title, x, y, series, &[], log_y)
}

pub fn points(title: &str, x: &str, y: &str, series: &[Series], log_y: bool) -> String {
    curves(title, x, y, &[], series, log_y)
}

/// Draws curves, such as those of a model, as lines, and measurements as points.
pub fn curves(title: &str, x: &str, y: &str, curves: &[Series], points: &[Series], log_y: bool) -> String {
    let series = [curves, points].concat();
    let (axes, omitted) = find_axes(&series, log_y);
    let Some((along, upwards)) = axes else {
        return draw_nothing(title, omitted);
    };
    let mut legend = entries(series.iter().map(|one| one.name.as_str()), LegendSymbol::Line);
    for entry in legend.iter_mut().filter(|entry| entry.index >= curves.len()) {
        entry.sign = LegendSymbol::Point;
    }
    let mut drawing = Drawing::new(title, &legend, WIDTH);
    let plane = plane(&drawing, along, upwards, HEIGHT);
    drawing.axes(&plane, Some(x), y);
    for (index, one) in series.iter().enumerate() {
        let pixels: Vec<Option<Pixel>> = one.points.iter().map(|point| plane.place(*point)).collect();
        if index < curves.len() {
            draw_line(&mut drawing, &pixels, index, series.len());
        } else {
            pixels.into_iter().flatten().for_each(|at| drawing.marker(at, index, 3.0));
        }
    }
    drawing.finish(plane.bottom + BELOW, omission_note(omitted).as_deref())
}

/// Draws trajectories as lines, with the same scale for x and y.
pub fn map(title: &str, x: &str, y: &str, series: &[Series]) -> String {
    let (axes, omitted) = find_axes(series, false);
    let Some((along, upwards)) = axes else {
        return draw_nothing(title, omitted);
    };
    let width = WIDTH - left_margin(&upwards) - 24.0;
    let height = width * (upwards.high - upwards.low) / (along.high - along.low);
    let height = height.clamp(MAP_HEIGHT.0, MAP_HEIGHT.1);
    // Metres per pixel in the direction that needs more.
    let metres = ((along.high - along.low) / width).max((upwards.high - upwards.low) / height);
    let around = |axis: &Axis, pixels: f64| {
        let middle = axis.low / 2.0 + axis.high / 2.0;
        Axis::with_bounds(middle - metres * pixels / 2.0, middle + metres * pixels / 2.0)
    };
    let legend = entries(series.iter().map(|one| one.name.as_str()), LegendSymbol::Line);
    let mut drawing = Drawing::new(title, &legend, WIDTH);
    let plane = plane(&drawing, around(&along, width), around(&upwards, height), height);
    drawing.axes(&plane, Some(x), y);
    for (index, one) in series.iter().enumerate() {
        let pixels: Vec<Option<Pixel>> = one.points.iter().map(|point| plane.place(*point)).collect();
        draw_line(&mut drawing, &pixels, index, series.len());
    }
    drawing.finish(plane.bottom + BELOW, omission_note(omitted).as_deref())
}

/// Draws the empirical cumulative distribution of each series: for each value, the percentage of the series that is at
/// most as large. `x` is the label of the axis, with its unit. Values that the axis cannot show, such as infinite ones,
/// still count in the percentages; NaN does not.
pub fn distribution(title: &str, x: &str, series: &[(String, Vec<f64>)], log_x: bool) -> String {
    let values = || series.iter().flat_map(|one| one.1.iter().copied());
    let Some(along) = Axis::for_values(values(), log_x) else {
        return draw_nothing(title, values().count());
    };
    let omitted = values().filter(|value| along.position(*value).is_none()).count();
    let mut drawing = Drawing::new(title, &entries(series.iter().map(|one| one.0.as_str()), LegendSymbol::Line), WIDTH);
    let plane = plane(&drawing, along, Axis::with_bounds(0.0, 102.0), HEIGHT);
    drawing.axes(&plane, Some(x), "share of values at most as large (%)");
    for (index, (_, values)) in series.iter().enumerate() {
        let mut below = 0.0;
        let mut steps = Vec::new();
        for (value, share) in cumulative_shares(values) {
            steps.extend([plane.place((value, below)), plane.place((value, share))]);
            below = share;
        }
        draw_line(&mut drawing, &steps, index, series.len());
    }
    let note = (omitted > 0).then(|| format!("{omitted} of the values have no place on the axis"));
    drawing.finish(plane.bottom + BELOW, note.as_deref())
}

/// Returns each finite value once, with the percentage of all numbers that is at most as large.
fn cumulative_shares(values: &[f64]) -> Vec<(f64, f64)> {
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

/// Returns the axes of all points whose coordinates can both be shown, and the number of other points.
fn find_axes(series: &[Series], log_y: bool) -> (Option<(Axis, Axis)>, usize) {
    let is_shown = |value: f64, log| Axis::for_values([value], log).is_some();
    let all = series.iter().flat_map(|one| one.points.iter().copied());
    let (shown, omitted): (Vec<_>, Vec<_>) =
        all.partition(|point| is_shown(point.0, false) && is_shown(point.1, log_y));
    let along = Axis::for_values(shown.iter().map(|point| point.0), false);
    (along.zip(Axis::for_values(shown.iter().map(|point| point.1), log_y)), omitted.len())
}

/// Places an area below the heading, over the whole width.
fn plane(drawing: &Drawing, x: Axis, y: Axis, height: f64) -> Plane {
    let left = left_margin(&y);
    Plane { x, y, left, right: WIDTH - 24.0, top: drawing.top, bottom: drawing.top + height }
}

/// Draws a line of one of `of` series, with markers. Those of different lines are offset, so that coinciding lines
/// remain visible.
fn draw_line(drawing: &mut Drawing, pixels: &[Option<Pixel>], index: usize, of: usize) {
    for part in pixels.split(Option::is_none) {
        drawing.line(&part.iter().copied().flatten().collect::<Vec<_>>(), colour(index), 2.0);
    }
    let known: Vec<Pixel> = pixels.iter().copied().flatten().collect();
    let every = if known.len() > FEW { known.len() / MARKERS } else { 1 };
    if known.len() <= FEW || of > 1 {
        let first = if every > 1 { every * index / of } else { 0 };
        known.into_iter().skip(first).step_by(every).for_each(|at| drawing.marker(at, index, 4.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::words::assert_tells;

    fn series(points: &[(f64, f64)]) -> Vec<Series> {
        vec![Series::new("one", points.to_vec())]
    }

    fn bar(group: &str, name: &str, value: f64, spread: Option<(f64, f64)>) -> Bar {
        Bar { spread, ..Bar::new(group, name, value) }
    }

    fn draw_all(given: &[Series]) -> [String; 4] {
        [
            lines("t", "x", "y", given, false),
            lines("t", "x", "y", given, true),
            points("t", "x", "y", given, true),
            map("t", "x (m)", "y (m)", given),
        ]
    }

    #[test]
    fn nothing_measured_is_said() {
        let unusable = [(f64::NAN, 1.0), (1.0, f64::INFINITY), (f64::NEG_INFINITY, 2.0)];
        let mut drawn: Vec<String> =
            [Vec::new(), series(&[]), series(&unusable)].iter().flat_map(|given| draw_all(given)).collect();
        drawn.push(bars("t", "y", &[], false));
        drawn.push(bars("t", "y", &[bar("g", "n", f64::NAN, Some((f64::NAN, 1.0)))], false));
        drawn.push(distribution("t", "x", &[("a".to_owned(), vec![f64::NAN])], true));
        drawn.push(timeline("t", "x", "y", &TimelineData::default()));
        for text in drawn {
            assert_tells(&text, "nothing was measured");
        }
    }

    /// One point, equal points, huge and tiny numbers: ranges of zero width must not prevent a plot.
    #[test]
    fn degenerate_ranges_are_drawn() {
        for given in [
            vec![(1.0, 1.0)],
            vec![(0.0, 0.0), (0.0, 0.0)],
            vec![(-5.0, -5.0), (-5.0, -5.0)],
            vec![(1e300, 1e-300), (-1e300, 1e300)],
            vec![(f64::MAX, f64::MIN), (f64::MIN, f64::MAX)],
            vec![(f64::MIN_POSITIVE, f64::MIN_POSITIVE), (0.0, 1e-310)],
            vec![(1e15, 1.0), (1e15 + 1.0, 1.0 + f64::EPSILON)],
        ] {
            for text in draw_all(&series(&given)) {
                assert!(text.starts_with("<svg") && !text.contains("NaN"), "{text}");
            }
        }
    }

    #[test]
    fn titles_are_escaped_and_what_is_left_out_is_counted() {
        let given = series(&[(1.0, 2.0), (2.0, f64::NAN), (3.0, 0.0), (4.0, 3.0)]);
        let linear = lines("a < b & \"c\"", "x", "y", &given, false);
        assert_tells(&linear, "a &lt; b &amp; &quot;c&quot;");
        assert_tells(&linear, "1 value is left out");
        assert_tells(&points("t", "x", "y", &given, true), "2 values are left out");
    }

    /// The third of five points is unknown: no line crosses the gap.
    #[test]
    fn a_line_stops_where_a_value_is_left_out() {
        let drawn = |middle: f64| {
            let ys = [1.0, 2.0, middle, 4.0, 5.0];
            let given: Vec<(f64, f64)> = (0..).map(f64::from).zip(ys).collect();
            lines("t", "x", "y", &series(&given), false).matches("stroke=\"#0072b2\" stroke-width=\"2\"").count()
        };
        assert_eq!((drawn(3.0), drawn(f64::NAN)), (2, 3));
    }

    /// A model's curve has the first colour; measurements have no line.
    #[test]
    fn curves_are_lines_and_measurements_are_points() {
        let curve: Vec<(f64, f64)> = (0..50).map(|x| (f64::from(x), f64::from(x * x))).collect();
        let points = [Series::new("held back", vec![(3.0, 9.5), (20.0, 390.0)])];
        let text = curves("t", "x", "y", &[Series::new("model", curve)], &points, false);
        assert!(text.contains("model") && text.contains("held back"), "{text}");
        assert!(text.contains("stroke=\"#0072b2\"") && !text.contains("stroke=\"#d55e00\""), "{text}");
        // The legend's and one for each measurement.
        assert_eq!(text.matches("fill=\"#d55e00\"").count(), 3);
    }

    #[test]
    fn bars_show_their_values_and_groups() {
        let given = [
            bar("Pi", "native", 12.34, Some((11.0, 14.0))),
            bar("Pi", "LAN", 0.5, None),
            bar("ultrabook", "native", 3.0, None),
        ];
        for log in [false, true] {
            let text = bars("t", "RRT (s)", &given, log);
            for wanted in ["12.3", "0.500", "3.00", "Pi", "ultrabook", "native", "LAN"] {
                assert_tells(&text, &format!(">{wanted}<"));
            }
        }
        for values in [[0.0, 0.0], [-1.0, -2.0], [0.0, 5.0], [1e299, -1e-299]] {
            let given = values.map(|value| bar("g", "n", value, Some((value - 1.0, f64::INFINITY))));
            for log in [false, true] {
                let text = bars("t", "y", &given, log);
                assert!(!text.contains("nothing was measured"), "{text}");
                assert!(text.matches("<rect").count() > values.len(), "{text}");
            }
        }
    }

    #[test]
    fn a_timeline_has_a_strip_only_for_q() {
        let mut given = TimelineData {
            points: vec![(1.0, 0.2, 0), (2.0, 5.0, 1), (3.0, 0.3, 9)],
            classes: vec!["cloud".into(), "local".into()],
            bad: vec![(1.5, 2.5)],
            levels: vec![(0.5, "T_desire".into()), (1.0, "T_max".into())],
            q: vec![],
        };
        let without = timeline("t", "request", "RRT (s)", &given);
        assert!(without.contains("T_desire") && !without.contains(">Q<"));
        given.q = vec![(1.0, 10.0), (2.0, 4.0), (3.0, f64::NAN)];
        assert_tells(&timeline("t", "request", "RRT (s)", &given), ">Q<");
    }

    /// Among 1, 2, 2 and 4, three quarters are at most 2; together with an unanswered one, three fifths are.
    #[test]
    fn shares_are_of_all_values() {
        assert_eq!(cumulative_shares(&[4.0, 1.0, 2.0, 2.0]), [(1.0, 25.0), (2.0, 75.0), (4.0, 100.0)]);
        let with_unanswered = [4.0, f64::INFINITY, f64::NAN, 1.0, 2.0, 2.0];
        assert_eq!(cumulative_shares(&with_unanswered), [(1.0, 20.0), (2.0, 60.0), (4.0, 80.0)]);
    }
}
