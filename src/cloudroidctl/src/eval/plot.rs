//! The distribution of response times, native against outsourced, as SVG: the share of requests that were answered within a time, which
//! is logarithmic.

use std::path::Path;

use crate::calibrate::curve::{Axis, BLUE, BOTTOM, HEIGHT, LEFT, RIGHT, WIDTH, number, put, text};
use crate::eval::side::Side;
use crate::eval::verdict::Evaluation;

const ORANGE: &str = "#d95f02";
/// Above the panel: two lines of a title, and one for each side.
const TOP: f64 = 95.0;
/// Longer words of a title are cut.
const LONGEST: usize = 60;

/// The whole picture.
pub fn draw(of: &Evaluation) -> String {
    let times = of.native.times.iter().chain(&of.outsourced.times);
    let x = Axis::around(times.copied(), LEFT, LEFT + WIDTH);
    let (width, height) = (LEFT + WIDTH + RIGHT, TOP + HEIGHT + BOTTOM);
    let mut out = String::new();
    put(
        &mut out,
        format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" font-family=\"sans-serif\" \
             font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>"
        ),
    );
    let title = format!(
        "{}, revision {}: share of requests answered within a time",
        of.service, of.revision
    );
    text(&mut out, (LEFT, 20.0), "start", &title);
    text(&mut out, (LEFT, 38.0), "start", &conditions(of));
    grid(&mut out, &x);
    for (side, colour, class, legend) in [
        (&of.native, ORANGE, "native", 60.0),
        (&of.outsourced, BLUE, "outsourced", 78.0),
    ] {
        distribution(&mut out, &x, side, colour, class);
        put(
            &mut out,
            format_args!(
                "<rect x=\"{LEFT:.1}\" y=\"{:.1}\" width=\"10\" height=\"10\" fill=\"{colour}\"/>",
                legend - 9.0
            ),
        );
        text(&mut out, (LEFT + 15.0, legend), "start", &told(class, side));
    }
    let (middle, below) = (LEFT + WIDTH / 2.0, height - 12.0);
    text(&mut out, (middle, below), "middle", "response time, ms");
    out + "</svg>\n"
}

/// What was measured with what.
fn conditions(of: &Evaluation) -> String {
    let bag = Path::new(&of.bag).file_name();
    let bag: String = bag.map_or(String::new(), |name| {
        name.to_string_lossy().chars().take(LONGEST).collect()
    });
    let robot = of
        .robot
        .map(|robot| format!("{robot}; "))
        .unwrap_or_default();
    let network = match of.network.filter(|network| network.adds()) {
        Some(network) => format!("added network: {network}"),
        None => "no network added".to_owned(),
    };
    let requests = of.native.requests.max(of.outsourced.requests);
    format!("{robot}{bag}, {requests} requests; {network}")
}

fn told(name: &str, side: &Side) -> String {
    match (&side.out_of_memory, side.rrt) {
        (Some(_), _) => format!("{name}: out of memory"),
        (None, None) => format!("{name}: none of {} answered", side.requests),
        (None, Some(rrt)) => format!(
            "{name}, {} cores: {:.1} ms (median), {:.1} ms (95 %)",
            side.cpus, rrt.p50, rrt.p95
        ),
    }
}

/// Where a share of all requests stands.
fn height(share: f64) -> f64 {
    TOP + HEIGHT * (1.0 - share)
}

fn grid(out: &mut String, x: &Axis) {
    let mut line = |x1: f64, y1: f64, x2: f64, y2: f64| {
        put(
            out,
            format_args!(
                "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"#ddd\"/>"
            ),
        );
    };
    let shares = [0.0, 0.25, 0.5, 0.75, 0.95, 1.0];
    for tick in x.fine_ticks() {
        line(x.at(tick), TOP, x.at(tick), TOP + HEIGHT);
    }
    for share in shares {
        line(LEFT, height(share), LEFT + WIDTH, height(share));
    }
    for tick in x.fine_ticks() {
        let at = (x.at(tick), TOP + HEIGHT + 16.0);
        text(out, at, "middle", &number(tick));
    }
    for share in shares {
        let at = (LEFT - 6.0, height(share) + 4.0);
        text(out, at, "end", &format!("{:.0} %", share * 100.0));
    }
}

/// Up by one step at each time. Requests that were never answered keep it below 100 %.
fn distribution(out: &mut String, x: &Axis, side: &Side, colour: &str, class: &str) {
    let mut times = side.times.clone();
    times.sort_by(f64::total_cmp);
    let all = side.requests.max(times.len()) as f64;
    let mut points = Vec::new();
    for (below, time) in times.iter().enumerate() {
        for answered in [below, below + 1] {
            let share = answered as f64 / all;
            points.push(format!("{:.1},{:.1}", x.at(*time), height(share)));
        }
    }
    if points.is_empty() {
        return;
    }
    put(
        out,
        format_args!(
            "<polyline class=\"{class}\" points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>",
            points.join(" ")
        ),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn side(times: &[f64], requests: usize) -> Side {
        Side {
            cpus: 0.25,
            requests,
            answered: times.len(),
            rrt: api::calibration::TimeSpread::of(times.to_vec()),
            times: times.to_vec(),
            ..Side::default()
        }
    }

    fn points(svg: &str, class: &str) -> Vec<(f64, f64)> {
        let line = svg
            .lines()
            .find(|line| line.contains(&format!("class=\"{class}\"")))
            .expect("a line");
        let points = line.split("points=\"").nth(1).expect("points");
        let points = points.split('"').next().expect("points");
        let pairs = points.split(' ').filter_map(|pair| pair.split_once(','));
        pairs
            .map(|(x, y)| (x.parse().expect("x"), y.parse().expect("y")))
            .collect()
    }

    #[test]
    fn both_rise_to_the_right_and_what_was_not_answered_is_missing_at_the_top() {
        let svg = draw(&Evaluation {
            service: "<people>".into(),
            native: side(&[900.0, 400.0, 500.0], 4),
            outsourced: side(&[40.0, 50.0], 2),
            ..Evaluation::default()
        });
        assert!(
            svg.contains("&lt;people&gt;") && svg.ends_with("</svg>\n"),
            "{svg}"
        );
        let (native, outsourced) = (points(&svg, "native"), points(&svg, "outsourced"));
        assert_eq!((native.len(), outsourced.len()), (6, 4));
        for line in [&native, &outsourced] {
            assert!(
                line.windows(2)
                    .all(|pair| pair[0].0 <= pair[1].0 && pair[0].1 >= pair[1].1)
            );
        }
        assert!(outsourced[3].0 < native[0].0, "it is faster: {svg}");
        // Three of four, and all.
        assert_eq!(native[5].1, TOP + HEIGHT / 4.0);
        assert_eq!(outsourced[3].1, TOP);
        assert!(
            svg.contains("native, 0.25 cores: 500.0 ms (median)"),
            "{svg}"
        );
    }

    /// Places of words, by what they contain.
    fn place(svg: &str, words: &str) -> (f64, f64) {
        let line = svg.lines().find(|line| line.contains(words));
        let line = line.unwrap_or_else(|| panic!("{words}: {svg}"));
        let part = |name: &str| {
            let value = line
                .split(name)
                .nth(1)
                .and_then(|rest| rest.split('"').next());
            value
                .and_then(|value| value.parse().ok())
                .expect("a number")
        };
        (part(" x=\""), part(" y=\""))
    }

    #[test]
    fn each_side_has_a_line_of_its_own_and_the_title_says_what_was_measured() {
        let svg = draw(&Evaluation {
            service: "people".into(),
            bag: "/somewhere/corridor.bag".into(),
            robot: Some(crate::eval::side::tests::robot()),
            network: "lan".parse().ok(),
            native: side(&[193.6, 204.1], 2),
            outsourced: side(&[193.0, 201.0], 2),
            ..Evaluation::default()
        });
        let (native, outsourced) = (place(&svg, ">native, "), place(&svg, ">outsourced, "));
        assert!(
            native.0 == outsourced.0 && native.1 + 12.0 <= outsourced.1,
            "{svg}"
        );
        assert!(outsourced.1 < TOP, "above the panel: {svg}");
        for words in [
            "a robot with 0.25 cores and 1G",
            "corridor.bag, 2 requests",
            "1 ms each way",
        ] {
            assert!(svg.contains(words), "{words}: {svg}");
        }
        let ticks = svg.lines().filter(|line| {
            line.contains("text-anchor=\"middle\"") && !line.contains("response time")
        });
        assert!(ticks.count() >= 4, "{svg}");
    }

    #[test]
    fn a_side_without_answers_is_told_and_not_drawn() {
        let svg = draw(&Evaluation {
            native: Side {
                out_of_memory: Some("x".into()),
                ..Side::default()
            },
            outsourced: side(&[], 3),
            ..Evaluation::default()
        });
        assert!(svg.contains("native: out of memory"), "{svg}");
        assert!(svg.contains("outsourced: none of 3 answered"), "{svg}");
        assert!(!svg.contains("<polyline") && !svg.contains("NaN"), "{svg}");
    }
}
