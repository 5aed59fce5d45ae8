//! SVG plots, drawn with the crate plotters: each function turns numbers into the text of one document.
//!
//! Every plot has a white background, so that it is readable on light and dark pages, and colours that colour-blind
//! people can distinguish (Okabe and Ito, "Color Universal Design", 2008); each series also has a marker of its own.
//! Values that are not finite, or that a logarithmic axis cannot show, are omitted; the plot says how many. An empty
//! plot says that nothing was measured.

mod axis;
mod bars;
mod canvas;
mod series;
mod timeline;

pub use bars::bars;
pub use series::{curves, distribution, lines, map, points};
pub use timeline::timeline;

/// A series of points.
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// (x, y), in the units of the axes.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// Creates a series.
    pub fn new(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points }
    }
}

/// A bar of a bar chart.
#[derive(Debug, Clone)]
pub struct Bar {
    /// Group of adjacent bars; groups are ordered by first occurrence.
    pub group: String,
    /// Name in the legend; each name has one colour.
    pub name: String,
    /// Height, in the unit of the axis.
    pub value: f64,
    /// Ends of the whisker, in the same unit.
    pub spread: Option<(f64, f64)>,
}

/// Data of [`timeline`].
#[derive(Debug, Clone, Default)]
pub struct TimelineData {
    /// (x, y, class), in the units of the axes; the class is an index into `classes`.
    pub points: Vec<(f64, f64, usize)>,
    /// Names of the classes in the legend.
    pub classes: Vec<String>,
    /// Ranges of x to shade.
    pub bad: Vec<(f64, f64)>,
    /// Horizontal lines and their labels.
    pub levels: Vec<(f64, String)>,
    /// (x, Q), drawn in a strip below the plot; without values there is no strip.
    pub q: Vec<(f64, f64)>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::words::assert_tells;

    fn count(text: &str, what: &str) -> usize {
        text.matches(what).count()
    }

    fn series(points: &[(f64, f64)]) -> Vec<Series> {
        vec![Series::new("one", points.to_vec())]
    }

    /// Every kind of plot, without values and with values that cannot be drawn.
    #[test]
    fn nothing_measured_is_said() {
        let unusable = [(f64::NAN, 1.0), (1.0, f64::INFINITY), (f64::NEG_INFINITY, 2.0)];
        for given in [Vec::new(), series(&[]), series(&unusable)] {
            for text in [
                lines("t", "x", "y", &given, false),
                lines("t", "x", "y", &given, true),
                points("t", "x", "y", &given, false),
                map("t", "x (m)", "y (m)", &given),
            ] {
                let text = text.expect("it is drawn");
                assert_tells(&text, "nothing was measured");
            }
        }
        let bar = |value| Bar { group: "g".into(), name: "n".into(), value, spread: Some((f64::NAN, 1.0)) };
        for given in [vec![], vec![bar(f64::NAN), bar(f64::INFINITY)]] {
            let text = bars("t", "y", &given, false).expect("it is drawn");
            assert_tells(&text, "nothing was measured");
        }
        for given in [vec![], vec![("a".to_owned(), vec![])], vec![("a".to_owned(), vec![f64::NAN])]] {
            let text = distribution("t", "x", &given, true).expect("it is drawn");
            assert_tells(&text, "nothing was measured");
        }
        let text = timeline("t", "x", "y", &TimelineData::default()).expect("it is drawn");
        assert_tells(&text, "nothing was measured");
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
            let given = series(&given);
            for text in [
                lines("t", "x", "y", &given, false),
                lines("t", "x", "y", &given, true),
                points("t", "x", "y", &given, true),
                map("t", "x (m)", "y (m)", &given),
            ] {
                let text = text.expect("it is drawn");
                assert!(text.starts_with("<svg") && !text.contains("NaN"), "{text}");
            }
        }
    }

    #[test]
    fn titles_and_names_are_escaped() {
        let text = lines("a < b & \"c\"", "x", "y", &series(&[(1.0, 2.0)]), false).expect("drawn");
        assert_tells(&text, "a &lt; b &amp; &quot;c&quot;");
    }

    #[test]
    fn what_is_left_out_is_counted() {
        let given = series(&[(1.0, 2.0), (2.0, f64::NAN), (3.0, 0.0), (4.0, 3.0)]);
        let linear = lines("t", "x", "y", &given, false).expect("it is drawn");
        assert_tells(&linear, "1 value is left out");
        let logarithmic = points("t", "x", "y", &given, true).expect("it is drawn");
        assert_tells(&logarithmic, "2 values are left out");
    }

    /// Three points, the middle one unknown: no line crosses the gap.
    #[test]
    fn a_line_stops_where_a_value_is_left_out() {
        let whole = lines("t", "x", "y", &series(&[(0.0, 1.0), (1.0, 2.0), (2.0, 3.0)]), false).expect("it is drawn");
        let broken =
            lines("t", "x", "y", &series(&[(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)]), false).expect("it is drawn");
        assert!(count(&whole, "stroke=\"#0072B2\"") > count(&broken, "stroke=\"#0072B2\""));
    }

    /// A model's curve has no markers and the first colour; measurements have no line.
    #[test]
    fn curves_are_lines_and_measurements_are_points() {
        let curve: Vec<(f64, f64)> = (0..50).map(|x| (f64::from(x), f64::from(x * x))).collect();
        let points = [Series::new("held back", vec![(3.0, 9.5), (20.0, 390.0)])];
        let text = curves("t", "x", "y", &[Series::new("model", curve)], &points, false).expect("it is drawn");
        let same = lines("t", "x", "y", &points, false).expect("it is drawn");
        assert!(text.contains("model") && text.contains("held back"), "{text}");
        assert!(!text.contains("points=\"\"") && count(&text, "#E69F00") < count(&text, "#0072B2"));
        assert!(count(&same, "<polyline") > 0, "{same}");
    }

    #[test]
    fn bars_show_their_values_and_groups() {
        let bar =
            |group: &str, name: &str, value, spread| Bar { group: group.into(), name: name.into(), value, spread };
        for log in [false, true] {
            let text = bars(
                "t",
                "RRT (s)",
                &[
                    bar("Pi", "native", 12.34, Some((11.0, 14.0))),
                    bar("Pi", "LAN", 0.5, None),
                    bar("ultrabook", "native", 3.0, None),
                ],
                log,
            )
            .expect("it is drawn");
            for wanted in ["12.3", "0.500", "3.00", "Pi", "ultrabook", "native", "LAN"] {
                assert!(text.contains(&format!("\n{wanted}\n")), "{wanted}: {text}");
            }
        }
    }

    #[test]
    fn bars_of_nothing_and_below_nothing_are_drawn() {
        for values in [vec![0.0, 0.0], vec![-1.0, -2.0], vec![0.0, 5.0], vec![1e299, -1e-299]] {
            let given: Vec<Bar> = values
                .iter()
                .map(|value| Bar {
                    group: "g".into(),
                    name: "n".into(),
                    value: *value,
                    spread: Some((value - 1.0, f64::INFINITY)),
                })
                .collect();
            for log in [false, true] {
                let text = bars("t", "y", &given, log).expect("it is drawn");
                assert!(!text.contains("nothing was measured"), "{text}");
                assert!(count(&text, "<rect") > values.len(), "{text}");
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
        let without = timeline("t", "request", "RRT (s)", &given).expect("it is drawn");
        assert!(without.contains("T_desire") && !without.contains("\nQ\n"));
        given.q = vec![(1.0, 10.0), (2.0, 4.0), (3.0, f64::NAN)];
        let with = timeline("t", "request", "RRT (s)", &given).expect("it is drawn");
        assert_tells(&with, "\nQ\n");
    }

    /// Among 1, 2, 2 and 4, three quarters are at most 2; together with an unanswered one, three fifths are.
    #[test]
    fn shares_are_of_all_values() {
        assert_eq!(super::series::cumulative_shares(&[4.0, 1.0, 2.0, 2.0]), [(1.0, 25.0), (2.0, 75.0), (4.0, 100.0)]);
        assert_eq!(
            super::series::cumulative_shares(&[4.0, f64::INFINITY, f64::NAN, 1.0, 2.0, 2.0]),
            [(1.0, 20.0), (2.0, 60.0), (4.0, 80.0)]
        );
    }
}
