//! The curve of a calibration, as SVG: response time over cores, both logarithmic; the span from the median to the 95th
//! percentile shaded, proposed rows ringed.

use std::fmt::Write;

use api::Calibration;
use api::calibration::{Point, TimeSpread};

pub(crate) const WIDTH: f64 = 640.0;
pub(crate) const HEIGHT: f64 = 360.0;
/// Around the panel: left, top, and what is left for labels on the right and below.
pub(crate) const LEFT: f64 = 70.0;
pub(crate) const TOP: f64 = 50.0;
pub(crate) const RIGHT: f64 = 30.0;
pub(crate) const BOTTOM: f64 = 50.0;
pub(crate) const BLUE: &str = "#0a6ebd";

/// A logarithmic axis from one value to another, over a stretch of the picture.
pub(crate) struct Axis {
    from: f64,
    to: f64,
    start: f64,
    end: f64,
}

impl Axis {
    /// That shows all `values`, with some room around.
    pub(crate) fn around(values: impl Iterator<Item = f64>, start: f64, end: f64) -> Axis {
        let positive = values.filter(|value| value.is_finite() && *value > 0.0);
        let (least, most) = positive.fold((f64::INFINITY, 0.0f64), |(least, most), value| {
            (least.min(value), most.max(value))
        });
        let (least, most) = if least <= most {
            (least, most)
        } else {
            (1.0, 1.0)
        };
        Axis {
            from: least / 1.3,
            to: most * 1.3,
            start,
            end,
        }
    }

    /// Where a value stands.
    pub(crate) fn at(&self, value: f64) -> f64 {
        let share = (value.max(self.from) / self.from).ln() / (self.to / self.from).ln();
        self.start + (self.end - self.start) * share
    }

    /// 1, 2 and 5 times the powers of ten that it shows.
    pub(crate) fn ticks(&self) -> Vec<f64> {
        let powers = self.from.log10().floor() as i32..=self.to.log10().ceil() as i32;
        powers
            .flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10f64.powi(power)))
            .filter(|tick| (self.from..=self.to).contains(tick))
            .collect()
    }
}

impl Axis {
    /// Its ticks; where these are fewer than four, multiples of a round step.
    pub(crate) fn fine_ticks(&self) -> Vec<f64> {
        let ticks = self.ticks();
        let span = self.to - self.from;
        if ticks.len() >= 4 || span <= 0.0 {
            return ticks;
        }
        let power = 10f64.powf((span / 4.0).log10().floor());
        let steps = [5.0, 2.0, 1.0].map(|digit| digit * power);
        let step = steps.into_iter().find(|step| span / step >= 4.0);
        let step = step.unwrap_or(power);
        let (first, last) = ((self.from / step).ceil(), (self.to / step).floor());
        (first as i64..=last as i64)
            .map(|number| number as f64 * step)
            .collect()
    }
}

/// The whole picture.
pub fn draw(calibration: &Calibration) -> String {
    let measured: Vec<(&Point, TimeSpread)> = calibration
        .points
        .iter()
        .filter_map(|point| Some((point, with(point.compute?, calibration.network))))
        .collect();
    let x = Axis::around(
        calibration.points.iter().map(|point| point.cpus),
        LEFT,
        LEFT + WIDTH,
    );
    let times = measured.iter().flat_map(|(_, time)| [time.p50, time.p95]);
    let y = Axis::around(times, TOP + HEIGHT, TOP);
    let mut out = String::new();
    let (width, height) = (LEFT + WIDTH + RIGHT, TOP + HEIGHT + BOTTOM);
    put(
        &mut out,
        format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" font-family=\"sans-serif\" \
             font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>"
        ),
    );
    let title = format!(
        "{}, revision {}: response time over cores",
        calibration.service, calibration.revision
    );
    text(&mut out, (LEFT, 20.0), "start", &title);
    grid(&mut out, &x, &y);
    band(&mut out, &x, &y, &measured);
    for (point, time) in &measured {
        let (cx, cy) = (x.at(point.cpus), y.at(time.p95));
        put(
            &mut out,
            format_args!(
                "<circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"3\" fill=\"{BLUE}\"><title>{} cores: {:.1} ms (median), {:.1} ms \
                 (95 %), {} of {} answered</title></circle>",
                point.cpus, time.p50, time.p95, point.answered, point.requests
            ),
        );
    }
    for row in &calibration.rows {
        let p95 = row.spread.map_or(row.value, |spread| spread.p95);
        let (cx, cy) = (x.at(row.limits.cpus.unwrap_or(0.0)), y.at(p95 * 1000.0));
        put(
            &mut out,
            format_args!(
                "<circle class=\"row\" cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"7\" fill=\"none\" stroke=\"#2a9d4a\" stroke-width=\"2\"/>"
            ),
        );
        text(
            &mut out,
            (cx + 9.0, cy - 6.0),
            "start",
            &row.measure.print(row.value),
        );
    }
    let legend = "line: 95th percentile; shaded: down to the median; ringed: proposed rows";
    text(&mut out, (LEFT, 38.0), "start", legend);
    text(
        &mut out,
        (LEFT + WIDTH / 2.0, height - 12.0),
        "middle",
        "cores",
    );
    text(&mut out, (8.0, TOP - 8.0), "start", "ms");
    out + "</svg>\n"
}

fn with(compute: TimeSpread, network: Option<TimeSpread>) -> TimeSpread {
    let network = network.unwrap_or_default();
    TimeSpread {
        p50: compute.p50 + network.p50,
        p95: compute.p95 + network.p95,
        max: compute.max + network.max,
    }
}

fn grid(out: &mut String, x: &Axis, y: &Axis) {
    let line = |out: &mut String, from: (f64, f64), to: (f64, f64)| {
        put(
            out,
            format_args!(
                "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"#ddd\"/>",
                from.0, from.1, to.0, to.1
            ),
        );
    };
    for tick in x.ticks() {
        let at = x.at(tick);
        line(out, (at, TOP), (at, TOP + HEIGHT));
        text(out, (at, TOP + HEIGHT + 16.0), "middle", &number(tick));
    }
    for tick in y.ticks() {
        let at = y.at(tick);
        line(out, (LEFT, at), (LEFT + WIDTH, at));
        text(out, (LEFT - 6.0, at + 4.0), "end", &number(tick));
    }
}

/// From the median to the 95th percentile, and the line of the latter.
fn band(out: &mut String, x: &Axis, y: &Axis, measured: &[(&Point, TimeSpread)]) {
    let at = |cpus: f64, time: f64| format!("{:.1},{:.1}", x.at(cpus), y.at(time));
    let above: Vec<String> = measured
        .iter()
        .map(|(point, time)| at(point.cpus, time.p95))
        .collect();
    let below = measured.iter().rev();
    let below: Vec<String> = below
        .map(|(point, time)| at(point.cpus, time.p50))
        .collect();
    put(
        out,
        format_args!(
            "<polygon points=\"{} {}\" fill=\"{BLUE}\" fill-opacity=\"0.15\"/>\n\
             <polyline points=\"{}\" fill=\"none\" stroke=\"{BLUE}\"/>",
            above.join(" "),
            below.join(" "),
            above.join(" ")
        ),
    );
}

/// Without what powers of ten leave behind the digits.
pub(crate) fn number(value: f64) -> String {
    ((value * 1e6).round() / 1e6).to_string()
}

/// Words at a place; `anchor` as SVG has it.
pub(crate) fn text(out: &mut String, (x, y): (f64, f64), anchor: &str, words: &str) {
    let words = words
        .replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;");
    put(
        out,
        format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{words}</text>"),
    );
}

/// One more line of the picture.
pub(crate) fn put(out: &mut String, line: std::fmt::Arguments) {
    // Writing to a String does not fail.
    let _ = writeln!(out, "{line}");
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use api::dictionary::Row;
    use api::{Limits, Measure};

    use super::*;

    fn calibration() -> Calibration {
        let point = |cpus, p50, p95| Point {
            cpus,
            compute: Some(TimeSpread { p50, p95, max: p95 }),
            ..Point::default()
        };
        Calibration {
            service: "<people> & dogs".into(),
            points: vec![
                Point {
                    cpus: 0.1,
                    ..Point::default()
                },
                point(0.25, 400.0, 480.0),
                point(0.5, 200.0, 230.0),
                point(1.0, 100.0, 110.0),
            ],
            rows: vec![Row {
                id: 0,
                measure: Measure::Rrt,
                value: 0.11,
                aux: BTreeMap::new(),
                limits: Limits {
                    cpus: Some(1.0),
                    ..Limits::default()
                },
                spread: None,
                revision: None,
                written: 0,
            }],
            ..Calibration::default()
        }
    }

    /// Values of an attribute in the order in which they stand.
    fn values(svg: &str, element: &str, attribute: &str) -> Vec<f64> {
        let lines = svg.lines().filter(|line| line.starts_with(element));
        lines
            .filter_map(|line| {
                let behind = line.split_once(&format!(" {attribute}=\""))?.1;
                behind.split_once('"')?.0.parse().ok()
            })
            .collect()
    }

    #[test]
    fn a_curve_falls_to_the_right_within_its_picture() {
        let svg = draw(&calibration());
        assert!(svg.contains("&lt;people&gt; &amp; dogs"), "{svg}");
        let (x, y) = (values(&svg, "<circle", "cx"), values(&svg, "<circle", "cy"));
        // Three that answered, and one ring around the last of them.
        assert_eq!((x.len(), y.len()), (4, 4), "{svg}");
        assert!(x[..3].is_sorted() && y[..3].is_sorted(), "{x:?} {y:?}");
        assert_eq!((x[2], y[2]), (x[3], y[3]));
        let within =
            |values: &[f64], from: f64, to: f64| values.iter().all(|at| (from..=to).contains(at));
        assert!(within(&x, LEFT, LEFT + WIDTH), "{x:?}");
        assert!(within(&y, TOP, TOP + HEIGHT), "{y:?}");
        for label in [">0.1<", ">0.5<", ">100<", ">500<", ">110ms<"] {
            assert!(svg.contains(label), "{label}: {svg}");
        }
    }

    #[test]
    fn a_network_lifts_the_curve() {
        let lifted = Calibration {
            network: Some(TimeSpread {
                p50: 50.0,
                p95: 90.0,
                max: 900.0,
            }),
            ..calibration()
        };
        let svg = draw(&lifted);
        assert!(svg.contains("150.0 ms (median), 200.0 ms"), "{svg}");
    }

    #[test]
    fn nothing_that_was_measured_is_a_curve_too() {
        let svg = draw(&Calibration::default());
        assert!(
            svg.ends_with("</svg>\n") && !svg.contains("NaN") && !svg.contains("inf"),
            "{svg}"
        );
    }
}
