//! Round-trip times of a String to another participant and back, of a call, and of an action's goal; one at a time,
//! directly, through the portal, and through other rosbridge servers.

use std::time::Duration;

use anyhow::{Result, ensure};
use bench_report::{BenchReport, Target, is_full_run};
use serde_json::Value;

use crate::awake::AwakeCores;
use crate::rivals::Rival;
use crate::world::{BenchNetwork, BenchProgram, Host, Transport, json_number};

/// Exchanges per turn. An rclpy server publishes the status of all goals of the last fifteen minutes whenever one
/// changes, so there are fewer goals.
const TRIPS: &str = "2000";
const GOALS: &str = "200";
/// Maximum duration of a turn, which takes seconds.
const PATIENCE: Duration = Duration::from_secs(60);
/// Limit for the portal, relative to the direct path to the same node.
const THROUGH: Target = Target::RatioAtMost(1.5);

/// Client and server of a measurement.
#[derive(Debug, Clone, PartialEq, Eq)]
enum TripPath {
    /// A client of the portal and the bus of `Bus`.
    Portal,
    /// A client of the portal and a node.
    PortalToRclpy,
    /// A client of another server and the bus of `Bus`.
    ByRival(Rival),
    /// A client of another server and a node.
    ByRivalToRclpy(Rival),
    /// Our participants on both sides.
    Ours,
    /// Buses on both sides: the direct path to the node that clients of the portal call.
    Bus,
    /// A bus and a node.
    BusToRclpy,
    /// A node and a bus.
    RclpyToBus,
    /// Nodes on both sides, by UDP.
    Rclpy,
    /// Nodes on both sides, with default settings.
    Stock,
    /// Plain sockets.
    Datagrams,
    /// Plain sockets with a process in between that copies the bytes.
    Hop,
}

impl TripPath {
    fn name(&self) -> String {
        let name = match self {
            Self::Portal => "portal to bus",
            Self::PortalToRclpy => "portal to rclpy",
            Self::ByRival(rival) => return format!("{rival} to bus"),
            Self::ByRivalToRclpy(rival) => return format!("{rival} to rclpy"),
            Self::Ours => "ours to ours",
            Self::Bus => "bus to bus",
            Self::BusToRclpy => "bus to rclpy",
            Self::RclpyToBus => "rclpy to bus",
            Self::Rclpy => "rclpy to rclpy by UDP",
            Self::Stock => "rclpy to rclpy by shared memory",
            Self::Datagrams => "datagrams alone",
            Self::Hop => "datagrams behind a byte relay",
        };
        name.to_owned()
    }

    /// Starts the server between client and answerer, if there is one.
    fn start_server(&self, world: &BenchNetwork) -> Result<Option<BenchProgram>> {
        match self {
            Self::Portal | Self::PortalToRclpy => world.start_role(&["portal", "kept"]).map(Some),
            Self::ByRival(rival) | Self::ByRivalToRclpy(rival) => rival.start(world).map(Some),
            Self::Hop => world.start_role(&["hop"]).map(Some),
            _ => Ok(None),
        }
    }

    fn start_answerer(&self, world: &BenchNetwork) -> Result<BenchProgram> {
        match self {
            Self::Ours => world.start_role(&["relay"]),
            Self::Bus | Self::RclpyToBus | Self::Portal | Self::ByRival(_) => world.start_role(&["bus", "relay"]),
            Self::BusToRclpy | Self::Rclpy => world.start_rclpy(Transport::Udp, &["relay"]),
            // Nodes with default settings, because another server may reach them through shared memory.
            Self::Stock | Self::PortalToRclpy | Self::ByRivalToRclpy(_) => {
                world.start_rclpy(Transport::Stock, &["relay"])
            }
            Self::Datagrams | Self::Hop => world.start_role(&["datagrams"]),
        }
    }

    fn start_asker(&self, world: &BenchNetwork, role: &str) -> Result<BenchProgram> {
        let count = if role == "goals" { GOALS } else { TRIPS };
        match self {
            Self::Ours => world.start_role(&[role, count]),
            Self::Bus | Self::BusToRclpy => world.start_role(&["bus", role, count]),
            Self::Portal | Self::PortalToRclpy | Self::ByRival(_) | Self::ByRivalToRclpy(_) => {
                world.start_role(&["client", role, count])
            }
            Self::RclpyToBus | Self::Rclpy => world.start_rclpy(Transport::Udp, &[role, count]),
            Self::Stock => world.start_rclpy(Transport::Stock, &[role, count]),
            Self::Datagrams => world.start_role(&["datagram-trips", TRIPS]),
            Self::Hop => world.start_role(&["hop-trips", TRIPS]),
        }
    }

    /// Returns p50 and p99 of one turn, in microseconds.
    fn measure_turn(&self, role: &str) -> Result<[f64; 2]> {
        let mut world = BenchNetwork::new()?;
        world.pin_to(Host::Server)?;
        let _answers = self.start_answerer(&world)?;
        let _server = self.start_server(&world)?;
        world.pin_to(Host::Robot)?;
        let found: Value = self.start_asker(&world, role)?.answer_within(PATIENCE)?;
        let times = [json_number(&found, "p50")?, json_number(&found, "p99")?];
        ensure!(times.iter().all(|time| time.is_finite()), "{}: {found}", self.name());
        Ok(times)
    }
}

/// Returns the best p50 and the best p99 of each path's turns, which alternate; `None` for another server that fails.
fn measure_in_turns(
    report: &mut BenchReport,
    what: &str,
    role: &str,
    ways: &[TripPath],
) -> Result<Vec<Option<[f64; 2]>>> {
    let rounds = if is_full_run() { 15 } else { 5 };
    let _awake = AwakeCores::start()?;
    let mut best = vec![Some([f64::INFINITY; 2]); ways.len()];
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, best) in ways.iter().zip(&mut best) {
            let Some(times) = best else { continue };
            match (way.measure_turn(role), way) {
                (Ok(found), _) => {
                    for (best, found) in times.iter_mut().zip(found) {
                        *best = best.min(found);
                    }
                }
                (Err(why), TripPath::ByRival(_) | TripPath::ByRivalToRclpy(_)) => {
                    report.skip(format!("{what}, {}", way.name()), format!("{why:#}"));
                    *best = None;
                }
                (Err(why), _) => return Err(why),
            }
        }
    }
    Ok(best)
}

/// A path, and one with which it is compared.
type PathPair = (TripPath, TripPath);

/// Paths between a bus and a node in both directions, and through the portal, compared with the direct path and with
/// other servers.
fn node_pairs(rivals: &[Rival]) -> Vec<PathPair> {
    use TripPath::{Bus, BusToRclpy, Portal, PortalToRclpy, Rclpy, RclpyToBus, Stock};
    let beside = |way: TripPath, rival: fn(Rival) -> TripPath| {
        let rivals = rivals.iter().cloned().map(rival);
        rivals.map(move |rival| (way.clone(), rival))
    };
    let mut pairs = vec![(BusToRclpy, Rclpy), (RclpyToBus, Rclpy), (Portal, Bus)];
    pairs.extend(beside(Portal, TripPath::ByRival));
    pairs.extend([BusToRclpy, Rclpy, Stock].map(|direct| (PortalToRclpy, direct)));
    pairs.extend(beside(PortalToRclpy, TripPath::ByRivalToRclpy));
    pairs
}

/// Measures one message in each direction.
fn measure_messages(report: &mut BenchReport, what: &str, role: &str) -> Result<()> {
    use TripPath::{Bus, Datagrams, Hop, Ours, Portal, Rclpy, Stock};
    let mut pairs = [Datagrams, Rclpy, Stock].map(|floor| (Ours, floor)).to_vec();
    pairs.extend([(Bus, Ours), (Hop, Datagrams)]);
    pairs.extend(node_pairs(&Rival::find_available(report)));
    pairs.push((Portal, Hop));
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
    use TripPath::{Bus, Rclpy, Stock};
    let mut pairs = vec![(Bus, Rclpy), (Bus, Stock)];
    pairs.extend(node_pairs(&Rival::find_available(report)));
    measure(report, "goal of an action until its result", "goals", &pairs)
}

/// Returns the target of a path relative to another, if there is one.
fn target(way: &TripPath, floor: &TripPath) -> Option<Target> {
    match (way, floor) {
        (TripPath::Portal, TripPath::Bus) => Some(THROUGH),
        (TripPath::Portal, TripPath::ByRival(_)) | (TripPath::PortalToRclpy, TripPath::ByRivalToRclpy(_)) => {
            Some(Target::BelowFloor)
        }
        _ => None,
    }
}

fn measure(report: &mut BenchReport, what: &str, role: &str, pairs: &[PathPair]) -> Result<()> {
    let mut ways: Vec<TripPath> = Vec::new();
    for way in pairs.iter().flat_map(|(way, floor)| [way, floor]) {
        if !ways.contains(way) {
            ways.push(way.clone());
        }
    }
    let found = measure_in_turns(report, what, role, &ways)?;
    let of = |way: &TripPath| {
        let at = ways.iter().position(|other| other == way);
        at.and_then(|at| found[at])
    };
    for (way, floor) in pairs {
        let (Some(value), Some(beside)) = (of(way), of(floor)) else {
            continue;
        };
        for (at, name) in ["p50", "p99"].into_iter().enumerate() {
            let what = format!("{what}, {}: {name}", way.name());
            let figure = report.figure(what, "µs", value[at]);
            figure.relative_to(floor.name(), beside[at]);
            if let Some(target) = target(way, floor).filter(|_| name == "p50") {
                figure.require(target);
            }
        }
    }
    Ok(())
}
