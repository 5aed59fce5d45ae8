//! The curve of a calibration, as SVG: response time over cores, both logarithmic; the range from the median to the
//! 95th percentile is shaded, and proposed rows are circled.

use std::fmt::Write;

use api::Calibration;
use api::calibration::{Point, TimeSpread};

pub(crate) const WIDTH: f64 = 640.0;
pub(crate) const HEIGHT: f64 = 360.0;
/// Margins around the panel, for the title and the labels.
pub(crate) const LEFT: f64 = 70.0;
pub(crate) const TOP: f64 = 50.0;
pub(crate) const RIGHT: f64 = 30.0;
pub(crate) const BOTTOM: f64 = 50.0;
pub(crate) const BLUE: &str = "#0a6ebd";

/// A logarithmic axis that maps a range of values to a range of coordinates.
pub(crate) struct Axis {
    from: f64,
    to: f64,
    start: f64,
    end: f64,
}

impl Axis {
    /// Creates an axis that covers all positive `values` with some margin.
    pub(crate) fn from_values(values: impl Iterator<Item = f64>, start: f64, end: f64) -> Axis {
        let positive = values.filter(|value| value.is_finite() && *value > 0.0);
        let (least, most) =
            positive.fold((f64::INFINITY, 0.0f64), |(least, most), value| (least.min(value), most.max(value)));
        let (least, most) = if least <= most { (least, most) } else { (1.0, 1.0) };
        Axis { from: least / 1.3, to: most * 1.3, start, end }
    }

    /// Returns the coordinate of a value.
    pub(crate) fn position(&self, value: f64) -> f64 {
        let share = (value.max(self.from) / self.from).ln() / (self.to / self.from).ln();
        self.start + (self.end - self.start) * share
    }

    /// Returns the ticks within the range: 1, 2 and 5 times powers of ten.
    pub(crate) fn ticks(&self) -> Vec<f64> {
        let powers = self.from.log10().floor() as i32..=self.to.log10().ceil() as i32;
        powers
            .flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10f64.powi(power)))
            .filter(|tick| (self.from..=self.to).contains(tick))
            .collect()
    }
}

impl Axis {
    /// Returns the ticks, or multiples of a round step if there are fewer than four.
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
        (first as i64..=last as i64).map(|number| number as f64 * step).collect()
    }
}

/// Begins a white document of this height.
pub(crate) fn begin_svg(height: f64) -> String {
    let width = LEFT + WIDTH + RIGHT;
    let mut out = String::new();
    push_line(
        &mut out,
        format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             font-family=\"sans-serif\" \
             font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>"
        ),
    );
    out
}

/// Draws the calibration as an SVG document.
pub fn draw(calibration: &Calibration) -> String {
    let measured: Vec<(&Point, TimeSpread)> = calibration
        .points
        .iter()
        .filter_map(|point| Some((point, add_network(point.compute?, calibration.network))))
        .collect();
    let x = Axis::from_values(calibration.points.iter().map(|point| point.cpus), LEFT, LEFT + WIDTH);
    let times = measured.iter().flat_map(|(_, time)| [time.p50, time.p95]);
    let y = Axis::from_values(times, TOP + HEIGHT, TOP);
    let height = TOP + HEIGHT + BOTTOM;
    let mut out = begin_svg(height);
    let title = format!("{}, revision {}: response time by CPU cores", calibration.service, calibration.revision);
    push_text(&mut out, (LEFT, 20.0), "start", &title);
    draw_grid(&mut out, &x, &y);
    draw_band(&mut out, &x, &y, &measured);
    for (point, time) in &measured {
        let (cx, cy) = (x.position(point.cpus), y.position(time.p95));
        push_line(
            &mut out,
            format_args!(
                "<circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"3\" fill=\"{BLUE}\"><title>{} cores: p50 {:.1} ms, p95 \
                    {:.1} ms, {} of {} answered</title></circle>",
                point.cpus, time.p50, time.p95, point.answered, point.requests
            ),
        );
    }
    for row in &calibration.rows {
        let p95 = row.spread.map_or(row.value, |spread| spread.p95);
        let (cx, cy) = (x.position(row.limits.cpus.unwrap_or(0.0)), y.position(p95 * 1000.0));
        push_line(
            &mut out,
            format_args!(
                "<circle class=\"row\" cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"7\" fill=\"none\" stroke=\"#2a9d4a\" \
                 stroke-width=\"2\"/>"
            ),
        );
        push_text(&mut out, (cx + 9.0, cy - 6.0), "start", &row.measure.format_value(row.value));
    }
    let legend = "line: p95; shaded: p50 to p95; ringed: proposed entries";
    push_text(&mut out, (LEFT, 38.0), "start", legend);
    push_text(&mut out, (LEFT + WIDTH / 2.0, height - 12.0), "middle", "cores");
    push_text(&mut out, (8.0, TOP - 8.0), "start", "ms");
    out + "</svg>\n"
}

fn add_network(compute: TimeSpread, network: Option<TimeSpread>) -> TimeSpread {
    let network = network.unwrap_or_default();
    TimeSpread { p50: compute.p50 + network.p50, p95: compute.p95 + network.p95, max: compute.max + network.max }
}

fn draw_grid(out: &mut String, x: &Axis, y: &Axis) {
    let line = |out: &mut String, from: (f64, f64), to: (f64, f64)| {
        push_line(
            out,
            format_args!(
                "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"#ddd\"/>",
                from.0, from.1, to.0, to.1
            ),
        );
    };
    for tick in x.ticks() {
        let at = x.position(tick);
        line(out, (at, TOP), (at, TOP + HEIGHT));
        push_text(out, (at, TOP + HEIGHT + 16.0), "middle", &format_number(tick));
    }
    for tick in y.ticks() {
        let at = y.position(tick);
        line(out, (LEFT, at), (LEFT + WIDTH, at));
        push_text(out, (LEFT - 6.0, at + 4.0), "end", &format_number(tick));
    }
}

/// Draws the range from the median to the 95th percentile, and the line of the latter.
fn draw_band(out: &mut String, x: &Axis, y: &Axis, measured: &[(&Point, TimeSpread)]) {
    let at = |cpus: f64, time: f64| format!("{:.1},{:.1}", x.position(cpus), y.position(time));
    let above: Vec<String> = measured.iter().map(|(point, time)| at(point.cpus, time.p95)).collect();
    let below = measured.iter().rev();
    let below: Vec<String> = below.map(|(point, time)| at(point.cpus, time.p50)).collect();
    push_line(
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

/// Formats a number without floating-point noise.
pub(crate) fn format_number(value: f64) -> String {
    ((value * 1e6).round() / 1e6).to_string()
}

/// Adds a text at a position; `anchor` is a value of SVG's text-anchor.
pub(crate) fn push_text(out: &mut String, (x, y): (f64, f64), anchor: &str, words: &str) {
    let words = words.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    push_line(out, format_args!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{words}</text>"));
}

/// Adds a line to the document.
pub(crate) fn push_line(out: &mut String, line: std::fmt::Arguments) {
    // Writing to a String cannot fail.
    let _ = writeln!(out, "{line}");
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use api::dictionary::Row;
    use api::{Limits, Measure};

    use super::*;

    fn calibration() -> Calibration {
        let point =
            |cpus, p50, p95| Point { cpus, compute: Some(TimeSpread { p50, p95, max: p95 }), ..Point::default() };
        Calibration {
            service: "<people> & dogs".into(),
            points: vec![
                Point { cpus: 0.1, ..Point::default() },
                point(0.25, 400.0, 480.0),
                point(0.5, 200.0, 230.0),
                point(1.0, 100.0, 110.0),
            ],
            rows: vec![Row {
                id: 0,
                measure: Measure::Rrt,
                value: 0.11,
                aux: BTreeMap::new(),
                limits: Limits { cpus: Some(1.0), ..Limits::default() },
                spread: None,
                revision: None,
                written: 0,
            }],
            ..Calibration::default()
        }
    }

    /// Returns the values of an attribute in document order.
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
        // Three points that were answered, and one circle around the last of them.
        assert_eq!((x.len(), y.len()), (4, 4), "{svg}");
        assert!(x[..3].is_sorted() && y[..3].is_sorted(), "{x:?} {y:?}");
        assert_eq!((x[2], y[2]), (x[3], y[3]));
        let within = |values: &[f64], from: f64, to: f64| values.iter().all(|at| (from..=to).contains(at));
        assert!(within(&x, LEFT, LEFT + WIDTH), "{x:?}");
        assert!(within(&y, TOP, TOP + HEIGHT), "{y:?}");
        for label in [">0.1<", ">0.5<", ">100<", ">500<", ">110ms<"] {
            assert!(svg.contains(label), "{label}: {svg}");
        }
    }

    #[test]
    fn a_network_lifts_the_curve() {
        let lifted = Calibration { network: Some(TimeSpread { p50: 50.0, p95: 90.0, max: 900.0 }), ..calibration() };
        let svg = draw(&lifted);
        assert!(svg.contains("p50 150.0 ms, p95 200.0 ms"), "{svg}");
    }

    #[test]
    fn nothing_that_was_measured_is_a_curve_too() {
        let svg = draw(&Calibration::default());
        assert!(svg.ends_with("</svg>\n") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
