//! Experiment 11: overhead of portal and link over raw TCPROS, and start times of servants compared with runtimes and a
//! container engine of this distribution. Runs the relevant parts of the project's benchmarks.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::BenchReport;
use support::binaries;

use crate::cells::{RunCache, Runs};
use crate::deadline;
use crate::plots::{self, Bar};
use crate::section::{About, Section, Table};
use crate::statistics::Spread;
use crate::words::{digits, ratio, spread};

/// Maximum time for one part of a benchmark, which takes some minutes.
const LONGEST: Duration = Duration::from_secs(900);
/// Start time of a servant in the publication: more than this, in milliseconds.
const PUBLISHED: f64 = 5000.0;
/// Peer that is optional: without it no measurement counts as missing.
const SUITE: &str = "rosbridge_suite";

/// The experiment.
pub const ABOUT: About = About {
    number: 11,
    id: "overhead",
    title: "What the system itself adds",
    published: "Starting a servant took over 5 s in the publication. It has no figure of what its portal adds to a \
        message's way.",
    differs: &[
        "Start times: cloudroid, libcontainer called from a bare program, and what Debian has (crun, runc, podman) \
         start containers of the same root file system with the same limits, in turns in the same run; the peers run \
         /bin/sleep, podman adds a layer that can be written, none has a network. What the publication timed is not \
         said in parts. crun refuses a host that has both versions of cgroups: there version 2 is covered for peers.",
        "Round trips: one String at a time to a roscpp node in a servant and back, on loopback; the best of the turns' \
         medians. The link is measured in a run of its own, from a publisher of the robot's ROS through its stub.",
    ],
};

/// Output of the benchmarks.
pub struct OverheadRuns {
    /// Output of `bench-servant starts`.
    starts: Runs<BenchReport>,
    /// Output of `bench-portal`, restricted to round trips.
    portal: Runs<BenchReport>,
    /// Output of `bench-link strings`.
    link: Runs<BenchReport>,
}

/// Runs the benchmarks, unless there are stored results.
pub fn measure(cells: &RunCache) -> Result<OverheadRuns> {
    let run =
        |bench: &str, part: &str| cells.repeat(&format!("bench {bench} {part}"), &bench, || run_part(bench, part));
    let (starts, portal) = (run("servant", "starts")?, run("portal", TRIP)?);
    Ok(OverheadRuns { starts, portal, link: run("link", "strings")? })
}

/// Runs a part of a benchmark's program and reads its output.
fn run_part(bench: &str, part: &str) -> Result<BenchReport> {
    let program = binaries::path(&format!("bench-{bench}"));
    ensure!(program.exists(), "{} is not built: make eval builds it", program.display());
    let mut child = Command::new(&program).arg(part).spawn()?;
    let status = deadline::wait_for_exit(&mut child, &program.display().to_string(), LONGEST)?;
    ensure!(status.success(), "{} ended with {status}", program.display());
    let file = bench_report::root().join(format!("target/bench/{bench}.json"));
    Ok(serde_json::from_slice(&std::fs::read(&file).with_context(|| file.display().to_string())?)?)
}

pub fn section(runs: &OverheadRuns) -> Section {
    let mut section = ABOUT.section();
    note_output(&mut section, "start times", &runs.starts);
    add_start_times(&mut section, &runs.starts);
    note_output(&mut section, "round trips by the portal", &runs.portal);
    note_output(&mut section, "round trips by the link", &runs.link);
    add_round_trips(&mut section, &runs.portal, &runs.link);
    section
}

/// Reports what is missing in the output of a benchmark, and the targets that it did not meet.
fn note_output(section: &mut Section, what: &str, runs: &Runs<BenchReport>) {
    let Some(first) = runs.require(section, what) else {
        return;
    };
    for one in &first.left_out {
        if one.what == SUITE {
            section.differs.push(format!("{SUITE} was not measured: {}.", one.why));
        } else {
            section.add_missing(&one.what, &one.why, "scripts/deps engines installs it");
        }
    }
    for one in first.figures.iter().filter(|figure| figure.met == Some(false)) {
        let target = one.to_reach.as_deref().unwrap_or_default();
        section.findings.push(format!("{}: {} {}, which is not {target}.", one.figure, digits(one.value), one.unit));
    }
}

fn find_value(runs: &Runs<BenchReport>, figure: &str) -> Option<Spread> {
    runs.figure(|written| {
        let found = written.figures.iter().find(|one| one.figure == figure)?;
        Some(found.value).filter(|value| value.is_finite())
    })
}

fn find_floor(runs: &Runs<BenchReport>, figure: &str, peer: &str) -> Option<Spread> {
    runs.figure(|written| {
        let mut all = written.figures.iter().filter(|one| one.figure == figure);
        all.find(|one| one.peer.as_deref() == Some(peer))?.floor
    })
}

fn peers<'a>(runs: &'a Runs<BenchReport>, figure: &str) -> Vec<&'a str> {
    let all = runs.first().into_iter().flat_map(|written| &written.figures);
    all.filter(|one| one.figure == figure).filter_map(|one| one.peer.as_deref()).collect()
}

/// Names of the benchmark for the time until a robot is served, and their names in this report.
const SERVED: [(&str, &str); 3] = [
    ("robot connects → node registered, bridged", "cloudroid, a container made ahead"),
    ("robot connects → node registered, bridged, without a container made ahead", "cloudroid, no container made ahead"),
    ("robot connects → first answer, nodes running already", "cloudroid, nodes running already"),
];
const NODE: (&str, &str) = ("node alone: exec → registered", "the node alone in a chroot, the floor");
const RUNNING: (&str, &str) = ("create → running", "cloudroid's engine: shim, Master, init, limits read back");

fn add_start_times(section: &mut Section, runs: &Runs<BenchReport>) {
    if runs.done.is_empty() {
        return;
    }
    let mut table = Table::new("Start times, medians (milliseconds)", "from, to | what starts | time | published");
    let mut bars: [Vec<Bar>; 2] = [vec![Bar::new("robot served", "published, at least", PUBLISHED)], Vec::new()];
    let mut add = |(plot, from_to, published): (usize, &str, &str), name: &str, time: Option<Spread>| {
        table.push([from_to, name, &spread(time, digits), published]);
        bars[plot].extend(time.map(|time| Bar {
            spread: Some((time.low, time.high)),
            ..Bar::new(["robot served", "container runs"][plot], name, time.median)
        }));
    };
    for (figure, name) in SERVED {
        add((0, "a robot connects, its node is registered and bridged", "> 5000"), name, find_value(runs, figure));
    }
    add((0, "exec, registered", ""), NODE.1, find_value(runs, NODE.0));
    let ours = find_value(runs, RUNNING.0);
    add((1, "create, container runs", ""), RUNNING.1, ours);
    for peer in peers(runs, RUNNING.0) {
        let theirs = find_floor(runs, RUNNING.0, peer);
        add((1, "create, container runs", ""), peer, theirs);
        section.findings.extend(ours.zip(theirs).map(|(ours, theirs)| {
            format!(
                "cloudroid's engine has a container running in {} ms, {} times as long as {peer} ({} ms).",
                spread(Some(ours), digits),
                ratio(Spread::from_values(&[ours.median / theirs.median])),
                spread(Some(theirs), digits)
            )
        }));
    }
    section.tables.push(table);
    for figure in SERVED.map(|one| one.0).into_iter().chain([RUNNING.0]) {
        if find_value(runs, figure).is_none() {
            section.add_missing(figure, "the benchmark did not write it", "look at what it printed");
        }
    }
    // Two figures, because one would need more colours than there are.
    for (id, bars) in ["overhead-served", "overhead-starts"].into_iter().zip(bars) {
        let group = bars.first().map_or_else(String::new, |bar| bar.group.clone());
        let drawing = plots::bars("start times", "start time (ms)", &bars, true);
        section.add_drawing(id, format!("Start times: {group}"), drawing);
    }
}

const TRIP: &str = "String there and back";
const LINK: &str = "String there and back over the link: p50";
const SECURE: &str = "String there and back, TLS and policy";
const DIRECT: &str = "TCPROS, no hop between";

fn add_round_trips(section: &mut Section, portal: &Runs<BenchReport>, link: &Runs<BenchReport>) {
    let both = ["p50", "p99"].map(|quantile| format!("{TRIP}, {quantile}"));
    let floors = |peer: &str| [0, 1].map(|index: usize| find_floor(portal, &both[index], peer));
    let [direct, _] = floors(DIRECT);
    let mut table = Table::new(
        "A String there and back (microseconds)",
        "way | p50 | p99 | added to raw TCPROS | times raw TCPROS",
    );
    let mut row = |way: &str, [median, late]: [Option<Spread>; 2]| {
        let with_direct = median.zip(direct).map(|(median, direct)| (median.median, direct.median));
        let added = with_direct.and_then(|(median, direct)| Spread::from_values(&[median - direct]));
        let times = with_direct.and_then(|(median, direct)| Spread::from_values(&[median / direct]));
        let [median, late, added] = [median, late, added].map(|time| spread(time, digits));
        table.push([way.to_owned(), median, late, added, ratio(times)]);
    };
    if !portal.done.is_empty() {
        row("raw TCPROS", floors(DIRECT));
        row("a process that moves bytes, the floor", floors("byte relay"));
        row("a process that converts by trees of values", floors("serde_json::Value"));
        row("portal, JSON", [0, 1].map(|index: usize| find_value(portal, &both[index])));
        let secure = ["p50", "p99"].map(|quantile| find_value(portal, &format!("{SECURE}, {quantile}")));
        row("portal, JSON, TLS, a robot's token and its rights", secure);
        row("rosbridge_suite, JSON", floors(SUITE));
    }
    if !link.done.is_empty() {
        row("stub and link", [find_value(link, LINK), None]);
        for peer in peers(link, LINK) {
            row(&format!("{peer}, in the link's run"), [find_floor(link, LINK, peer), None]);
        }
    }
    section.tables.push(table);
    for (way, time) in
        [("The portal adds", find_value(portal, &both[0])), ("Stub and link add", find_value(link, LINK))]
    {
        section.findings.extend(time.zip(direct).map(|(time, direct)| {
            let [added, direct] = [time.median - direct.median, direct.median].map(digits);
            format!("{way} {added} µs to the {direct} µs of raw TCPROS.")
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::words::assert_tells;

    fn bench_output(report: &BenchReport) -> Runs<BenchReport> {
        let text = serde_json::to_string(report).expect("JSON");
        Runs::from(serde_json::from_str::<BenchReport>(&text).expect("what a benchmark writes"))
    }

    fn test_runs() -> OverheadRuns {
        let mut starts = BenchReport::new("servant");
        for (figure, time) in SERVED.map(|one| one.0).into_iter().zip([10.0, 40.0, 2.0]) {
            starts.figure(figure, "ms", time);
        }
        starts.figure(NODE.0, "ms", 8.0);
        for (peer, time) in [("crun", 20.0), ("podman", 100.0)] {
            starts.figure(RUNNING.0, "ms", 25.0).relative_to(peer, time);
        }
        let mut portal = BenchReport::new("portal");
        for (quantile, time) in [("p50", 60.0), ("p99", 90.0)] {
            let name = format!("{TRIP}, {quantile}");
            portal.figure(&name, "µs", time).relative_to("byte relay", 50.0);
            portal.figure(&name, "µs", time).relative_to(DIRECT, 40.0);
        }
        portal.skip(SUITE, "it is not packaged");
        let mut link = BenchReport::new("link");
        link.figure(LINK, "µs", 80.0).relative_to("a client of the portal, JSON", 64.0);
        OverheadRuns { starts: bench_output(&starts), portal: bench_output(&portal), link: bench_output(&link) }
    }

    #[test]
    fn start_times_stand_beside_the_published_one_and_the_peers() {
        let section = section(&test_runs());
        assert!(section.missing.is_empty(), "{:?}", section.missing);
        let rows = &section.tables[0].rows;
        assert_eq!(rows[0][2..], ["10.0", "> 5000"]);
        assert_eq!(rows[6][1..3], ["podman", "100"]);
        assert_tells(&section.findings[0], "in 25.0 ms, 1.2 times as long as crun (20.0 ms).");
        assert_tells(&section.findings[1], "0.25 times as long as podman (100 ms).");
    }

    #[test]
    fn what_is_added_is_the_difference_to_raw_tcpros() {
        let section = section(&test_runs());
        let rows = &section.tables[1].rows;
        assert_eq!(rows[0], ["raw TCPROS", "40.0", "40.0", "0.00", "1.0"]);
        assert_eq!(rows[3], ["portal, JSON", "60.0", "90.0", "20.0", "1.5"]);
        assert_eq!(rows[5][1..], ["–", "–", "–", "–"]);
        assert_eq!(rows[6], ["stub and link", "80.0", "–", "40.0", "2.0"]);
        let why = section.differs.last().expect("some");
        assert_eq!(why, "rosbridge_suite was not measured: it is not packaged.");
    }

    #[test]
    fn what_did_not_run_or_was_not_reached_is_named() {
        let mut runs = test_runs();
        runs.starts = Runs::from_failure("it is not built");
        runs.portal = bench_output(&BenchReport::new("portal"));
        let mut link = BenchReport::new("link");
        link.skip("a part", "no time");
        link.figure("saved", "%", 50.0).require(bench_report::Target::AtLeast(70.0));
        runs.link = bench_output(&link);
        let section = section(&runs);
        let missing: Vec<&str> = section.missing.iter().map(|one| one.what.as_str()).collect();
        assert_eq!(missing, ["start times", "a part"]);
        assert_eq!(section.findings, ["saved: 50.0 %, which is not ≥ 70."]);
    }
}
