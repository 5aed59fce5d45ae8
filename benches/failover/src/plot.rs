//! Plots response times over requests as SVG: one panel per run, degraded phases shaded, answers coloured by who gave
//! them, Q below.

use std::fmt::Write;

use crate::BAD;
use crate::robot::{FailoverResult, FailoverSample};

const WIDTH: f64 = 900.0;
const HEIGHT: f64 = 170.0;
/// Height of the strip for Q; it shows values from 0 to `Q_MAX` and the threshold `Q_T`.
const Q_HEIGHT: f64 = 40.0;
const Q_MAX: f64 = 16.0;
const Q_T: f64 = 4.0;
const LEFT: f64 = 44.0;
/// Space for the labels of T_desire and T_max to the right of the panels.
const RIGHT: f64 = 60.0;
/// Where these labels start.
const BESIDE: f64 = LEFT + WIDTH + 6.0;
const STEP: f64 = HEIGHT + Q_HEIGHT + 56.0;
/// Range of the logarithmic axis, in seconds.
const RANGE: (f64, f64) = (0.05, 12.0);
const COLOURS: [(&str, &str); 3] = [
    ("#0a6ebd", "answered by the cloud"),
    ("#e08a00", "answered by the local original"),
    ("#c1121f", "later than T_max, or never (at the top)"),
];

/// Draws one panel per run.
pub fn draw(runs: &[(String, FailoverResult)]) -> String {
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{}\" height=\"{}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        LEFT + WIDTH + RIGHT,
        STEP * runs.len() as f64 + 40.0
    );
    for (index, (colour, what)) in COLOURS.iter().enumerate() {
        let x = LEFT + 250.0 * index as f64;
        write_line(
            &mut out,
            format_args!(
                "<circle cx=\"{x}\" cy=\"16\" r=\"4\" fill=\"{colour}\"/><text x=\"{}\" y=\"20\">{what}</text>",
                x + 10.0
            ),
        );
    }
    for (index, (name, outcome)) in runs.iter().enumerate() {
        draw_panel(&mut out, 56.0 + STEP * index as f64, name, outcome);
    }
    out + "</svg>\n"
}

fn write_line(out: &mut String, line: std::fmt::Arguments) {
    // Writing to a String cannot fail.
    let _ = writeln!(out, "{line}");
}

fn draw_panel(out: &mut String, top: f64, name: &str, outcome: &FailoverResult) {
    let count = outcome.answers.len() as f64;
    let x = |number: f64| LEFT + WIDTH * number / (count + 1.0);
    let y = |seconds: f64| {
        let share = (seconds / RANGE.0).ln() / (RANGE.1 / RANGE.0).ln();
        top + HEIGHT * (1.0 - share.clamp(0.0, 1.0))
    };
    let within = 100.0 * outcome.count_in_time() as f64 / count;
    write_line(
        out,
        format_args!(
            "<text x=\"{LEFT}\" y=\"{}\" font-weight=\"bold\">{name}: {within:.1} % within T_max</text>",
            top - 8.0
        ),
    );
    for (first, last) in BAD {
        let (from, to) = (x(first as f64 - 0.5), x(last as f64 + 0.5));
        write_line(
            out,
            format_args!(
                "<rect x=\"{from:.1}\" y=\"{top}\" width=\"{:.1}\" height=\"{}\" fill=\"#eee\"/>",
                to - from,
                HEIGHT + Q_HEIGHT + 8.0
            ),
        );
    }
    for (seconds, label) in [(0.1, "0.1 s"), (1.0, "1 s"), (10.0, "10 s")] {
        draw_line(out, y(seconds), (4.0, label), "#ccc");
    }
    for (seconds, label, colour) in [
        (outcome.times.0, "T_desire", "#2a9d4a"),
        (outcome.times.1, "T_max", "#c1121f"),
    ] {
        draw_line(out, y(seconds), (BESIDE, label), colour);
    }
    for (index, answer) in outcome.answers.iter().enumerate() {
        let at = answer.after.map_or(top, y);
        let colour = colour(outcome, answer);
        write_line(
            out,
            format_args!(
                "<circle cx=\"{:.1}\" cy=\"{at:.1}\" r=\"2.6\" fill=\"{colour}\"/>",
                x(index as f64 + 1.0)
            ),
        );
    }
    draw_satisfaction(out, top + HEIGHT + 8.0, &x, outcome);
}

/// Draws Q after each request, and its threshold.
fn draw_satisfaction(out: &mut String, top: f64, x: &dyn Fn(f64) -> f64, outcome: &FailoverResult) {
    let y = |q: f64| top + Q_HEIGHT * (1.0 - q / Q_MAX);
    let known = outcome.answers.iter().enumerate();
    let points: Vec<String> = known
        .filter_map(|(index, answer)| Some((index, answer.q?)))
        .map(|(index, q)| format!("{:.1},{:.1}", x(index as f64 + 1.0), y(q)))
        .collect();
    if points.is_empty() {
        return;
    }
    draw_line(out, y(Q_T), (BESIDE, "Q_t"), "#999");
    draw_line(out, y(0.0), (4.0, "Q = 0"), "#ccc");
    write_line(
        out,
        format_args!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"#444\"/>",
            points.join(" ")
        ),
    );
}

/// Draws a horizontal line across the panel, with a label that starts at its x.
fn draw_line(out: &mut String, at: f64, (x, label): (f64, &str), colour: &str) {
    write_line(
        out,
        format_args!(
            "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"{colour}\"/><text x=\"{x}\" \
             y=\"{:.1}\">{label}</text>",
            LEFT + WIDTH,
            at + 4.0
        ),
    );
}

fn colour(outcome: &FailoverResult, answer: &FailoverSample) -> &'static str {
    match (outcome.is_late(answer), answer.local) {
        (true, _) => COLOURS[2].0,
        (false, true) => COLOURS[1].0,
        (false, false) => COLOURS[0].0,
    }
}
