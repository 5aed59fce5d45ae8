//! Round-trip times of a String to another participant and back, of a call, and of an action's goal; one at a time,
//! directly, through the portal, and through other rosbridge servers.

use std::fmt;
use std::time::Duration;

use anyhow::{Result, ensure};
use bench_report::{BenchReport, Target, is_full_run};

use crate::rivals::{Rival, Server};
use crate::turns::measure_in_turns;
use crate::world::{BenchNetwork, Host, Transport, json_number};

/// Exchanges per turn; fewer goals, because an rclpy server publishes the status of all of the last fifteen minutes.
const TRIPS: &str = "2000";
const GOALS: &str = "200";
/// Maximum duration of a turn, which takes seconds.
const PATIENCE: Duration = Duration::from_secs(60);
/// Limit for the portal, relative to the direct path to the same node.
const THROUGH: Target = Target::RatioAtMost(1.5);

/// A program at an end of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// A node of ours.
    Bus,
    Rclpy(Transport),
    /// A plain socket.
    Datagrams,
}

const UDP: End = End::Rclpy(Transport::Udp);
/// Nodes with default settings, because another server may reach them through shared memory.
const STOCK: End = End::Rclpy(Transport::Stock);

/// Client and server of a measurement.
#[derive(Debug, Clone, PartialEq, Eq)]
enum TripPath {
    Direct(End, End),
    /// From a client of this server.
    Through(Server, End),
}

use TripPath::{Direct, Through};

impl fmt::Display for End {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Bus => "bus",
            Self::Rclpy(_) => "rclpy",
            Self::Datagrams => "datagrams",
        })
    }
}

impl fmt::Display for TripPath {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Direct(End::Datagrams, _) => out.write_str("datagrams alone"),
            Through(Server::Hop, _) => out.write_str("datagrams behind a byte relay"),
            Through(server, to) => write!(out, "{server} to {to}"),
            Direct(End::Rclpy(by), End::Rclpy(_)) => write!(out, "rclpy to rclpy by {by}"),
            Direct(from, to) => write!(out, "{from} to {to}"),
        }
    }
}

impl TripPath {
    fn server(&self) -> Option<&Server> {
        if let Through(server, _) = self { Some(server) } else { None }
    }

    /// Returns p50 and p99 of one turn, in microseconds.
    fn measure_turn(&self, role: &str) -> Result<[f64; 2]> {
        let mut world = BenchNetwork::new()?;
        world.pin_to(Host::Server)?;
        let (Direct(_, to) | Through(_, to)) = self;
        let _answers = match to {
            End::Bus => world.start_role(&["relay"])?,
            End::Rclpy(transport) => world.start_rclpy(*transport, &["relay"])?,
            End::Datagrams => world.start_role(&["datagrams"])?,
        };
        let _server = self.server().map(|server| server.start(&world)).transpose()?;
        world.pin_to(Host::Robot)?;
        let count = if role == "goals" { GOALS } else { TRIPS };
        let mut asker = match self {
            Direct(End::Bus, _) => world.start_role(&[role, count])?,
            Direct(End::Rclpy(transport), _) => world.start_rclpy(*transport, &[role, count])?,
            Direct(End::Datagrams, _) => world.start_role(&["datagram-trips", TRIPS])?,
            Through(Server::Hop, _) => world.start_role(&["hop-trips", TRIPS])?,
            Through(..) => world.start_role(&["client", role, count])?,
        };
        let found = asker.answer_within(PATIENCE)?;
        let times = [json_number(&found, "p50")?, json_number(&found, "p99")?];
        ensure!(times.iter().all(|time| time.is_finite()), "{self}: {found}");
        Ok(times)
    }
}

/// A path, and one with which it is compared.
type PathPair = (TripPath, TripPath);

/// Paths between a bus and a node, and through the portal, beside the direct path and other servers.
fn node_pairs(rivals: &[Rival]) -> Vec<PathPair> {
    let through = |to| Through(Server::Portal, to);
    let beside = |to| rivals.iter().map(move |rival| (through(to), Through(Server::Rival(rival.clone()), to)));
    let mut pairs = vec![
        (Direct(End::Bus, UDP), Direct(UDP, UDP)),
        (Direct(UDP, End::Bus), Direct(UDP, UDP)),
        (through(End::Bus), Direct(End::Bus, End::Bus)),
    ];
    pairs.extend(beside(End::Bus));
    pairs
        .extend([Direct(End::Bus, UDP), Direct(UDP, UDP), Direct(STOCK, STOCK)].map(|direct| (through(STOCK), direct)));
    pairs.extend(beside(STOCK));
    pairs
}

/// Measures one message in each direction.
fn measure_messages(report: &mut BenchReport, what: &str, role: &str) -> Result<()> {
    let datagrams = Direct(End::Datagrams, End::Datagrams);
    let hop = Through(Server::Hop, End::Datagrams);
    let floors = [datagrams.clone(), Direct(UDP, UDP), Direct(STOCK, STOCK)];
    let mut pairs = floors.map(|floor| (Direct(End::Bus, End::Bus), floor)).to_vec();
    pairs.push((hop.clone(), datagrams));
    pairs.extend(node_pairs(&Rival::find_available(report)));
    pairs.push((Through(Server::Portal, End::Bus), hop));
    measure(report, what, role, &pairs)
}

/// Measures Strings.
pub(crate) fn measure_strings(report: &mut BenchReport) -> Result<()> {
    measure_messages(report, "String there and back", "trips")
}

/// Measures calls.
pub(crate) fn measure_calls(report: &mut BenchReport) -> Result<()> {
    measure_messages(report, "service call", "calls")
}

/// Measures goals.
pub(crate) fn measure_goals(report: &mut BenchReport) -> Result<()> {
    let mut pairs = [UDP, STOCK].map(|end| (Direct(End::Bus, End::Bus), Direct(end, end))).to_vec();
    pairs.extend(node_pairs(&Rival::find_available(report)));
    measure(report, "goal of an action until its result", "goals", &pairs)
}

/// Returns the target of a path relative to another, if there is one.
fn target(way: &TripPath, floor: &TripPath) -> Option<Target> {
    match (way, floor) {
        (Through(Server::Portal, End::Bus), Direct(End::Bus, End::Bus)) => Some(THROUGH),
        (Through(Server::Portal, to), Through(Server::Rival(_), other)) if to == other => Some(Target::BelowFloor),
        _ => None,
    }
}

/// Reports the best p50 and the best p99 of each path's turns.
fn measure(report: &mut BenchReport, what: &str, role: &str, pairs: &[PathPair]) -> Result<()> {
    let mut ways: Vec<TripPath> = Vec::new();
    for way in pairs.iter().flat_map(|(way, floor)| [way, floor]) {
        if !ways.contains(way) {
            ways.push(way.clone());
        }
    }
    let rounds = if is_full_run() { 15 } else { 5 };
    let measure_turn = |way: &TripPath| way.measure_turn(role);
    let found = measure_in_turns(report, what, rounds, &ways, TripPath::server, measure_turn)?;
    let best = |way: &TripPath| {
        let at = ways.iter().position(|other| other == way)?;
        let turns = found[at].as_deref()?;
        Some([0, 1].map(|quantile| turns.iter().map(|turn| turn[quantile]).fold(f64::INFINITY, f64::min)))
    };
    for (way, floor) in pairs {
        let Some((value, beside)) = best(way).zip(best(floor)) else { continue };
        for (at, name) in ["p50", "p99"].into_iter().enumerate() {
            let figure = report.figure(format!("{what}, {way}: {name}"), "µs", value[at]);
            figure.relative_to(floor.to_string(), beside[at]);
            if let Some(target) = target(way, floor).filter(|_| name == "p50") {
                figure.require(target);
            }
        }
    }
    Ok(())
}
