//! Experiment 11: overhead of portal and link over raw TCPROS, and start times of servants compared with runtimes and a
//! container engine of this distribution. Runs the relevant parts of the project's benchmarks.

use anyhow::Result;
use bench_report::BenchReport;

use crate::cells::{CachedResult, RunCache};
use crate::plots::{self, Bar};
use crate::section::{AGAIN, MissingMeasurement, Section, Table};
use crate::words::{digits, or_dash, ratio};

use super::benches::{run_part, unmet_targets};

/// Start time of a servant in the publication: more than this, in milliseconds.
const PUBLISHED: f64 = 5000.0;
/// Peer that is optional: without it no measurement counts as missing.
const SUITE: &str = "rosbridge_suite";

/// Output of the benchmarks.
pub struct OverheadRuns {
    /// Output of `bench-servant starts`.
    starts: CachedResult<BenchReport>,
    /// Output of `bench-portal`, restricted to round trips.
    portal: CachedResult<BenchReport>,
    /// Output of `bench-link strings`.
    link: CachedResult<BenchReport>,
}

/// Runs the benchmarks, unless there are stored results.
pub fn measure(cells: &RunCache) -> Result<OverheadRuns> {
    Ok(OverheadRuns {
        starts: run_part(cells, "servant", &["starts"])?,
        portal: run_part(cells, "portal", &["String there and back"])?,
        link: run_part(cells, "link", &["strings"])?,
    })
}

/// Creates the section of the report.
pub fn section(runs: &OverheadRuns) -> Result<Section> {
    let mut section = Section::new(11, "overhead", "What the system itself adds");
    section.published =
        "Starting a servant took over 5 s in the publication. It has no figure of what its portal adds \
        to a message's way."
            .to_owned();
    section.differs = [
        "Start times: cloudroid, libcontainer called from a bare program, and what Debian has (crun, runc, podman) \
         start containers of the same root file system with the same limits, in turns in the same run; the peers run \
         /bin/sleep, podman adds a layer that can be written, none has a network. What the publication timed is not \
         said in parts; its number stands beside the time until a robot's node is registered and bridged.",
        "crun refuses a host that has both versions of cgroups. There, all peers are given a mount namespace in which \
         version 2 is covered.",
        "Round trips: one String at a time to a roscpp node in a servant and back, on loopback; the best of the turns' \
         medians. The client of raw TCPROS has its connections inside the servant's network namespace. The link is \
         measured in a run of its own, from a publisher of the robot's ROS through its stub; its client of the portal \
         writes and reads JSON itself, the other one sends prepared bytes.",
    ]
    .map(str::to_owned)
    .to_vec();
    add_start_times(&mut section, &runs.starts)?;
    add_round_trips(&mut section, &runs.portal, &runs.link);
    Ok(section)
}

/// Returns the output of a benchmark, or reports why it is missing.
fn require_measured<'a>(
    section: &mut Section,
    what: &str,
    measured: &'a CachedResult<BenchReport>,
) -> Option<&'a BenchReport> {
    let written = measured.require(section, what, AGAIN)?;
    for one in written.left_out.iter().filter(|one| one.what != SUITE) {
        section.missing.push(MissingMeasurement::new(&one.what, &one.why, "scripts/deps engines installs it"));
    }
    section.findings.extend(unmet_targets(written));
    Some(written)
}

fn find_value(written: &BenchReport, figure: &str) -> Option<f64> {
    let mut all = written.figures.iter();
    Some(all.find(|one| one.figure == figure)?.value).filter(|value| value.is_finite())
}

/// Returns the peers of a figure with their values.
fn find_floors<'a>(written: &'a BenchReport, figure: &'a str) -> impl Iterator<Item = (&'a str, f64)> + 'a {
    let all = written.figures.iter().filter(move |one| one.figure == figure);
    all.filter_map(|one| Some((one.peer.as_deref()?, one.floor?)))
}

/// Names of the benchmark for the time until a robot is served, and their names in this report.
const SERVED: [(&str, &str); 3] = [
    ("robot connects → node registered, bridged", "cloudroid, a container made ahead"),
    ("robot connects → node registered, bridged, without a container made ahead", "cloudroid, no container made ahead"),
    ("robot connects → first answer, nodes running already", "cloudroid, nodes running already"),
];
const NODE: &str = "node alone: exec → registered";
const RUNNING: &str = "create → running";

fn add_start_times(section: &mut Section, measured: &CachedResult<BenchReport>) -> Result<()> {
    let Some(written) = require_measured(section, "start times", measured) else {
        return Ok(());
    };
    let mut table =
        Table::new("Start times, medians (milliseconds)", "from, to | what starts | time | published | times as fast");
    let mut bars = Vec::new();
    let mut bar = |group: &str, name: &str, value| {
        bars.push(Bar { group: group.to_owned(), name: name.to_owned(), value, spread: None });
    };
    let served = "a robot connects, its node is registered and bridged";
    for (figure, name) in SERVED {
        let Some(time) = find_value(written, figure) else {
            add_missing_figure(section, figure);
            continue;
        };
        let faster = format!("more than {}", digits(PUBLISHED / time));
        table.push([served, name, &digits(time), "> 5000", &faster]);
        bar("robot served", name, time);
    }
    if let Some(time) = find_value(written, NODE) {
        let floor = "the node alone in a chroot, the floor";
        table.push(["exec, registered", floor, &digits(time), "", ""]);
        bar("robot served", floor, time);
    }
    bar("robot served", "published, at least", PUBLISHED);
    let ours = "cloudroid's engine: shim, Master, init, limits read back";
    match find_value(written, RUNNING) {
        Some(time) => {
            table.push(["create, container runs", ours, &digits(time), "", ""]);
            bar("container runs", "cloudroid's engine", time);
            for (peer, other) in find_floors(written, RUNNING) {
                table.push(["create, container runs", peer, &digits(other), "", ""]);
                bar("container runs", peer, other);
                section.findings.push(comparison_finding(peer, time, other));
            }
        }
        None => add_missing_figure(section, RUNNING),
    }
    section.tables.push(table);
    // Two figures, because one would need more colours than there are.
    for (id, group) in [("overhead-served", "robot served"), ("overhead-starts", "container runs")] {
        let of = bars.iter().filter(|bar| bar.group == group);
        let of: Vec<Bar> = of.cloned().collect();
        section.add_drawing(
            id,
            format!("Start times: {group}"),
            plots::bars("start times", "start time (ms)", &of, true)?,
        );
    }
    Ok(())
}

fn add_missing_figure(section: &mut Section, figure: &str) {
    section.missing.push(MissingMeasurement::new(figure, "the benchmark did not write it", "look at what it printed"));
}

fn comparison_finding(peer: &str, ours: f64, theirs: f64) -> String {
    let times = ratio(Some(ours / theirs));
    let (ours_told, theirs_told) = (digits(ours), digits(theirs));
    let why = if ours > theirs {
        ": it also starts a shim with a ROS Master and an init, and reads the limits back"
    } else {
        ""
    };
    format!(
        "cloudroid's engine has a container running in {ours_told} ms, {times} times as long as {peer} ({theirs_told} \
         ms){why}."
    )
}

const TRIP: &str = "String there and back";
const LINK: &str = "String there and back over the link: p50";
const SECURE: &str = "String there and back, TLS and policy";
const DIRECT: &str = "TCPROS, no hop between";

fn add_round_trips(section: &mut Section, portal: &CachedResult<BenchReport>, link: &CachedResult<BenchReport>) {
    let portal = require_measured(section, "round trips by the portal", portal);
    let link = require_measured(section, "round trips by the link", link);
    let [p50, p99] = ["p50", "p99"].map(|quantile| format!("{TRIP}, {quantile}"));
    let none = BenchReport::new("portal");
    let written = portal.unwrap_or(&none);
    let other = |figure: &str, way: &str| {
        let mut all = find_floors(written, figure);
        all.find(|(peer, _)| *peer == way).map(|(_, time)| time)
    };
    let direct = other(&p50, DIRECT);
    let mut table = Table::new(
        "A String there and back (microseconds)",
        "way | median | 99 % | added to raw TCPROS | times raw TCPROS",
    );
    let mut row = |way: &str, median: Option<f64>, late: Option<f64>| {
        let told = |time: Option<f64>| or_dash(time, digits);
        let both = median.zip(direct);
        table.push([
            way.to_owned(),
            told(median),
            told(late),
            told(both.map(|(median, direct)| median - direct)),
            ratio(both.map(|(median, direct)| median / direct)),
        ]);
    };
    if portal.is_some() {
        row("raw TCPROS", direct, other(&p99, DIRECT));
        for (way, name) in [
            ("byte relay", "a process that moves bytes, the floor"),
            ("serde_json::Value", "a process that converts by trees of values"),
        ] {
            row(name, other(&p50, way), other(&p99, way));
        }
        row("portal, JSON", find_value(written, &p50), find_value(written, &p99));
        let secure = ["p50", "p99"].map(|quantile| format!("{SECURE}, {quantile}"));
        row(
            "portal, JSON, TLS, a robot's token and its rights",
            find_value(written, &secure[0]),
            find_value(written, &secure[1]),
        );
        row("rosbridge_suite, JSON", other(&p50, SUITE), other(&p99, SUITE));
    }
    if let Some(link) = link {
        row("stub and link", find_value(link, LINK), None);
        for (peer, time) in find_floors(link, LINK) {
            row(&format!("{peer}, in the link's run"), Some(time), None);
        }
    }
    section.tables.push(table);
    for one in written.left_out.iter().filter(|one| one.what == SUITE) {
        section.differs.push(format!("{SUITE} was not measured: {}.", one.why));
    }
    if let Some((ours, direct)) = find_value(written, &p50).zip(direct) {
        let relay = other(&p50, "byte relay").map_or_else(String::new, |relay| {
            format!("; a process that only moves the bytes adds {} µs", digits(relay - direct))
        });
        section.findings.push(format!(
            "The portal adds {} µs to the {} µs of raw TCPROS{relay}.",
            digits(ours - direct),
            digits(direct)
        ));
    }
    if let Some((ours, direct)) = link.and_then(|link| find_value(link, LINK)).zip(direct) {
        section.findings.push(format!(
            "Stub and link add {} µs: two connections more, from the robot's node to the stub and from there to the \
             server.",
            digits(ours - direct)
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bench_output(report: &BenchReport) -> CachedResult<BenchReport> {
        let text = serde_json::to_string(report).expect("JSON");
        CachedResult::Done(serde_json::from_str(&text).expect("what a benchmark writes"))
    }

    fn test_runs() -> OverheadRuns {
        let mut starts = BenchReport::new("servant");
        for (figure, time) in SERVED.map(|one| one.0).into_iter().zip([10.0, 40.0, 2.0]) {
            starts.figure(figure, "ms", time);
        }
        starts.figure(NODE, "ms", 8.0);
        for (peer, time) in [("crun", 20.0), ("podman", 100.0)] {
            starts.figure(RUNNING, "ms", 25.0).relative_to(peer, time);
        }
        let mut portal = BenchReport::new("portal");
        for (quantile, time) in [("p50", 60.0), ("p99", 90.0)] {
            let name = format!("{TRIP}, {quantile}");
            portal.figure(&name, "µs", time).relative_to("byte relay", 50.0);
            portal.figure(&name, "µs", time).relative_to(DIRECT, 40.0);
        }
        portal.skip(SUITE, "it is not packaged");
        let mut link = BenchReport::new("link");
        let portals = "a client of the portal, JSON";
        link.figure(LINK, "µs", 80.0).relative_to(portals, 64.0);
        OverheadRuns { starts: bench_output(&starts), portal: bench_output(&portal), link: bench_output(&link) }
    }

    #[test]
    fn start_times_stand_beside_the_published_one_and_the_peers() {
        let section = section(&test_runs()).expect("it is drawn");
        assert!(section.missing.is_empty(), "{:?}", section.missing);
        let rows = &section.tables[0].rows;
        assert_eq!(rows[0][2..], ["10.0", "> 5000", "more than 500"]);
        assert_eq!(rows[6][1..3], ["podman", "100"]);
        assert!(section.findings[0].contains("in 25.0 ms, 1.2 times as long as crun (20.0 ms): it also"));
        assert!(section.findings[1].contains("0.25 times as long as podman (100 ms)."));
    }

    #[test]
    fn what_is_added_is_the_difference_to_raw_tcpros() {
        let section = section(&test_runs()).expect("it is drawn");
        let rows = &section.tables[1].rows;
        assert_eq!(rows[0], ["raw TCPROS", "40.0", "40.0", "0.00", "1.0"]);
        assert_eq!(rows[3], ["portal, JSON", "60.0", "90.0", "20.0", "1.5"]);
        assert_eq!(rows[5][1..], ["–", "–", "–", "–"]);
        assert_eq!(rows[6], ["stub and link", "80.0", "–", "40.0", "2.0"]);
        let why = section.differs.last().expect("some");
        assert_eq!(why, "rosbridge_suite was not measured: it is not packaged.");
    }

    #[test]
    fn what_did_not_run_is_named() {
        let mut runs = test_runs();
        runs.starts = CachedResult::Missing("it is not built".to_owned());
        runs.portal = bench_output(&BenchReport::new("portal"));
        let mut link = BenchReport::new("link");
        link.skip("a part", "no time");
        runs.link = bench_output(&link);
        let section = section(&runs).expect("it is drawn");
        let missing: Vec<&str> = section.missing.iter().map(|one| one.what.as_str()).collect();
        assert_eq!(missing, ["start times", "a part"]);
    }
}
