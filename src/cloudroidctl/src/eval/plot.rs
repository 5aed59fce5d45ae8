//! The distributions of response times, native and outsourced, as SVG: the share of requests that were answered within
//! a time, on a logarithmic time axis.

use std::path::Path;

use crate::calibrate::curve::{
    Axis, BLUE, BOTTOM, HEIGHT, LEFT, WIDTH, begin_svg, format_number, push_line, push_text,
};
use crate::eval::side::SideResult;
use crate::eval::verdict::Evaluation;

const ORANGE: &str = "#d95f02";
/// Top margin of the panel: two lines of title and one for each side.
const TOP: f64 = 95.0;
/// Longest part of a title in characters; the rest is cut.
const LONGEST: usize = 60;

/// Draws the evaluation as an SVG document.
pub fn draw(of: &Evaluation) -> String {
    let times = of.native.times.iter().chain(&of.outsourced.times);
    let x = Axis::from_values(times.copied(), LEFT, LEFT + WIDTH);
    let height = TOP + HEIGHT + BOTTOM;
    let mut out = begin_svg(height);
    let title = format!("{}, revision {}: fraction of requests answered within a time", of.service, of.revision);
    push_text(&mut out, (LEFT, 20.0), "start", &title);
    push_text(&mut out, (LEFT, 38.0), "start", &conditions(of));
    draw_grid(&mut out, &x);
    for (side, colour, class, legend) in
        [(&of.native, ORANGE, "native", 60.0), (&of.outsourced, BLUE, "outsourced", 78.0)]
    {
        draw_distribution(&mut out, &x, side, colour, class);
        push_line(
            &mut out,
            format_args!(
                "<rect x=\"{LEFT:.1}\" y=\"{:.1}\" width=\"10\" height=\"10\" fill=\"{colour}\"/>",
                legend - 9.0
            ),
        );
        push_text(&mut out, (LEFT + 15.0, legend), "start", &legend_text(class, side));
    }
    let (middle, below) = (LEFT + WIDTH / 2.0, height - 12.0);
    push_text(&mut out, (middle, below), "middle", "response time, ms");
    out + "</svg>\n"
}

/// Returns the conditions of the measurement, for the title.
fn conditions(of: &Evaluation) -> String {
    let bag = Path::new(&of.bag).file_name();
    let bag: String = bag.map_or(String::new(), |name| name.to_string_lossy().chars().take(LONGEST).collect());
    let robot = of.robot.map(|robot| format!("{robot}; ")).unwrap_or_default();
    let network = match of.network.filter(|network| network.has_effect()) {
        Some(network) => format!("added network: {network}"),
        None => "no network added".to_owned(),
    };
    let requests = of.native.requests.max(of.outsourced.requests);
    format!("{robot}{bag}, {requests} requests; {network}")
}

fn legend_text(name: &str, side: &SideResult) -> String {
    match (&side.out_of_memory, side.rrt) {
        (Some(_), _) => format!("{name}: out of memory"),
        (None, None) => format!("{name}: none of {} answered", side.requests),
        (None, Some(rrt)) => format!("{name}, {} cores: p50 {:.1} ms, p95 {:.1} ms", side.cpus, rrt.p50, rrt.p95),
    }
}

/// Returns the y coordinate of a share of all requests.
fn share_to_y(share: f64) -> f64 {
    TOP + HEIGHT * (1.0 - share)
}

fn draw_grid(out: &mut String, x: &Axis) {
    let mut line = |x1: f64, y1: f64, x2: f64, y2: f64| {
        push_line(
            out,
            format_args!("<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"#ddd\"/>"),
        );
    };
    let shares = [0.0, 0.25, 0.5, 0.75, 0.95, 1.0];
    for tick in x.fine_ticks() {
        line(x.position(tick), TOP, x.position(tick), TOP + HEIGHT);
    }
    for share in shares {
        line(LEFT, share_to_y(share), LEFT + WIDTH, share_to_y(share));
    }
    for tick in x.fine_ticks() {
        let at = (x.position(tick), TOP + HEIGHT + 16.0);
        push_text(out, at, "middle", &format_number(tick));
    }
    for share in shares {
        let at = (LEFT - 6.0, share_to_y(share) + 4.0);
        push_text(out, at, "end", &format!("{:.0} %", share * 100.0));
    }
}

/// Draws one step up at each response time. Requests without an answer keep the line below 100 %.
fn draw_distribution(out: &mut String, x: &Axis, side: &SideResult, colour: &str, class: &str) {
    let mut times = side.times.clone();
    times.sort_by(f64::total_cmp);
    let all = side.requests.max(times.len()) as f64;
    let mut points = Vec::new();
    for (below, time) in times.iter().enumerate() {
        for answered in [below, below + 1] {
            let share = answered as f64 / all;
            points.push(format!("{:.1},{:.1}", x.position(*time), share_to_y(share)));
        }
    }
    if points.is_empty() {
        return;
    }
    push_line(
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

    fn side(times: &[f64], requests: usize) -> SideResult {
        SideResult {
            cpus: 0.25,
            requests,
            answered: times.len(),
            rrt: api::calibration::TimeSpread::from_samples(times.to_vec()),
            times: times.to_vec(),
            ..SideResult::default()
        }
    }

    fn points(svg: &str, class: &str) -> Vec<(f64, f64)> {
        let line = svg.lines().find(|line| line.contains(&format!("class=\"{class}\""))).expect("a line");
        let points = line.split("points=\"").nth(1).expect("points");
        let points = points.split('"').next().expect("points");
        let pairs = points.split(' ').filter_map(|pair| pair.split_once(','));
        pairs.map(|(x, y)| (x.parse().expect("x"), y.parse().expect("y"))).collect()
    }

    #[test]
    fn both_rise_to_the_right_and_what_was_not_answered_is_missing_at_the_top() {
        let svg = draw(&Evaluation {
            service: "<people>".into(),
            native: side(&[900.0, 400.0, 500.0], 4),
            outsourced: side(&[40.0, 50.0], 2),
            ..Evaluation::default()
        });
        assert!(svg.contains("&lt;people&gt;") && svg.ends_with("</svg>\n"), "{svg}");
        let (native, outsourced) = (points(&svg, "native"), points(&svg, "outsourced"));
        assert_eq!((native.len(), outsourced.len()), (6, 4));
        for line in [&native, &outsourced] {
            assert!(line.windows(2).all(|pair| pair[0].0 <= pair[1].0 && pair[0].1 >= pair[1].1));
        }
        assert!(outsourced[3].0 < native[0].0, "it is faster: {svg}");
        // Three of four requests, and all of them.
        assert_eq!(native[5].1, TOP + HEIGHT / 4.0);
        assert_eq!(outsourced[3].1, TOP);
        assert!(svg.contains("native, 0.25 cores: p50 500.0 ms"), "{svg}");
    }

    /// Returns the position of the text that contains these words.
    fn text_position(svg: &str, words: &str) -> (f64, f64) {
        let line = svg.lines().find(|line| line.contains(words));
        let line = line.unwrap_or_else(|| panic!("{words}: {svg}"));
        let part = |name: &str| {
            let value = line.split(name).nth(1).and_then(|rest| rest.split('"').next());
            value.and_then(|value| value.parse().ok()).expect("a number")
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
        let (native, outsourced) = (text_position(&svg, ">native, "), text_position(&svg, ">outsourced, "));
        assert!(native.0 == outsourced.0 && native.1 + 12.0 <= outsourced.1, "{svg}");
        assert!(outsourced.1 < TOP, "above the panel: {svg}");
        for words in ["a robot with 0.25 cores and 1G", "corridor.bag, 2 requests", "1 ms each way"] {
            assert!(svg.contains(words), "{words}: {svg}");
        }
        let ticks =
            svg.lines().filter(|line| line.contains("text-anchor=\"middle\"") && !line.contains("response time"));
        assert!(ticks.count() >= 4, "{svg}");
    }

    #[test]
    fn a_side_without_answers_is_told_and_not_drawn() {
        let svg = draw(&Evaluation {
            native: SideResult { out_of_memory: Some("x".into()), ..SideResult::default() },
            outsourced: side(&[], 3),
            ..Evaluation::default()
        });
        assert!(svg.contains("native: out of memory"), "{svg}");
        assert!(svg.contains("outsourced: none of 3 answered"), "{svg}");
        assert!(!svg.contains("<polyline") && !svg.contains("NaN"), "{svg}");
    }
}
