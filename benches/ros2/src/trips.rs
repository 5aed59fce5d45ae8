//! How long a String is under way to another participant and back, a call, and an action's goal; one at a time, without and through the portal,
//! and through other servers of rosbridge.

use std::time::Duration;

use anyhow::{Result, ensure};
use bench_report::{Report, Target};
use serde_json::Value;

use crate::awake::Awake;
use crate::rivals::Rival;
use crate::world::{Host, Program, Transport, World, number};

/// Per turn. A server of rclpy tells of all goals of the last fifteen minutes whenever one changes: of few there is little to tell.
const TRIPS: &str = "2000";
const GOALS: &str = "200";
/// A turn takes seconds.
const PATIENCE: Duration = Duration::from_secs(60);
/// What the portal may add to the way to the same node.
const THROUGH: Target = Target::RatioAtMost(1.5);

/// Who asks, and who answers.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Way {
    /// A client of the portal asks the bus of `Bus`.
    Portal,
    /// A client of the portal asks a node.
    PortalToRclpy,
    /// A client of another server asks the bus of `Bus`.
    ByRival(Rival),
    /// A client of another server asks a node.
    ByRivalToRclpy(Rival),
    /// Ours, both.
    Ours,
    /// Buses over them, both: the direct way to the node that clients of the portal ask.
    Bus,
    /// A bus asks a node.
    BusToRclpy,
    /// A node asks a bus.
    RclpyToBus,
    /// Nodes, both, by UDP.
    Rclpy,
    /// Nodes, both, as they come.
    Stock,
    /// Sockets alone.
    Datagrams,
    /// The same with a process between that moves the bytes.
    Hop,
}

impl Way {
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

    /// The server between asker and answerer.
    fn server(&self, world: &World) -> Result<Option<Program>> {
        match self {
            Self::Portal | Self::PortalToRclpy => world.ours(&["portal", "kept"]).map(Some),
            Self::ByRival(rival) | Self::ByRivalToRclpy(rival) => rival.start(world).map(Some),
            Self::Hop => world.ours(&["hop"]).map(Some),
            _ => Ok(None),
        }
    }

    fn answers(&self, world: &World) -> Result<Program> {
        match self {
            Self::Ours => world.ours(&["relay"]),
            Self::Bus | Self::RclpyToBus | Self::Portal | Self::ByRival(_) => {
                world.ours(&["bus", "relay"])
            }
            Self::BusToRclpy | Self::Rclpy => world.rclpy(Transport::Udp, &["relay"]),
            // As nodes come: another's server may reach it by shared memory.
            Self::Stock | Self::PortalToRclpy | Self::ByRivalToRclpy(_) => {
                world.rclpy(Transport::Stock, &["relay"])
            }
            Self::Datagrams | Self::Hop => world.ours(&["datagrams"]),
        }
    }

    fn asks(&self, world: &World, role: &str) -> Result<Program> {
        let count = if role == "goals" { GOALS } else { TRIPS };
        match self {
            Self::Ours => world.ours(&[role, count]),
            Self::Bus | Self::BusToRclpy => world.ours(&["bus", role, count]),
            Self::Portal | Self::PortalToRclpy | Self::ByRival(_) | Self::ByRivalToRclpy(_) => {
                world.ours(&["client", role, count])
            }
            Self::RclpyToBus | Self::Rclpy => world.rclpy(Transport::Udp, &[role, count]),
            Self::Stock => world.rclpy(Transport::Stock, &[role, count]),
            Self::Datagrams => world.ours(&["datagram-trips", TRIPS]),
            Self::Hop => world.ours(&["hop-trips", TRIPS]),
        }
    }

    /// p50 and p99 of one turn, in microseconds.
    fn turn(&self, role: &str) -> Result<[f64; 2]> {
        let mut world = World::new()?;
        world.place(Host::Server)?;
        let _answers = self.answers(&world)?;
        let _server = self.server(&world)?;
        world.place(Host::Robot)?;
        let found: Value = self.asks(&world, role)?.answer_within(PATIENCE)?;
        let times = [number(&found, "p50")?, number(&found, "p99")?];
        ensure!(
            times.iter().all(|time| time.is_finite()),
            "{}: {found}",
            self.name()
        );
        Ok(times)
    }
}

/// The best p50 and the best p99 of each way's turns, which alternate; none of another's server that does not do it.
fn race(
    report: &mut Report,
    what: &str,
    role: &str,
    ways: &[Way],
) -> Result<Vec<Option<[f64; 2]>>> {
    let rounds = if crate::full() { 15 } else { 5 };
    let _awake = Awake::all()?;
    let mut best = vec![Some([f64::INFINITY; 2]); ways.len()];
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, best) in ways.iter().zip(&mut best) {
            let Some(times) = best else { continue };
            match (way.turn(role), way) {
                (Ok(found), _) => {
                    for (best, found) in times.iter_mut().zip(found) {
                        *best = best.min(found);
                    }
                }
                (Err(why), Way::ByRival(_) | Way::ByRivalToRclpy(_)) => {
                    report.left_out(format!("{what}, {}", way.name()), format!("{why:#}"));
                    *best = None;
                }
                (Err(why), _) => return Err(why),
            }
        }
    }
    Ok(best)
}

/// Ways, and what each stands beside.
type Beside = Vec<(Way, Vec<Way>)>;

/// Through the portal, beside the direct way and beside other servers.
fn through(rivals: &[Rival]) -> Beside {
    let beside = |direct: &[Way], rival: fn(Rival) -> Way| {
        let rivals = rivals.iter().cloned().map(rival);
        direct.iter().cloned().chain(rivals).collect()
    };
    let nodes = [Way::BusToRclpy, Way::Rclpy, Way::Stock];
    vec![
        (Way::Portal, beside(&[Way::Bus], Way::ByRival)),
        (Way::PortalToRclpy, beside(&nodes, Way::ByRivalToRclpy)),
    ]
}

/// Between a bus and a node, in both directions.
fn with_nodes() -> Beside {
    vec![
        (Way::BusToRclpy, vec![Way::Rclpy]),
        (Way::RclpyToBus, vec![Way::Rclpy]),
    ]
}

/// Strings.
pub(crate) fn strings(report: &mut Report) -> Result<()> {
    let mut ways = vec![
        (Way::Ours, vec![Way::Datagrams, Way::Rclpy, Way::Stock]),
        (Way::Bus, vec![Way::Ours]),
        (Way::Hop, vec![Way::Datagrams]),
    ];
    ways.extend(with_nodes());
    ways.extend(through(&Rival::all(report)));
    ways.push((Way::Portal, vec![Way::Hop]));
    measure(report, "String there and back", "trips", &ways)
}

/// Calls.
pub(crate) fn calls(report: &mut Report) -> Result<()> {
    let mut ways = vec![
        (Way::Ours, vec![Way::Datagrams, Way::Rclpy, Way::Stock]),
        (Way::Bus, vec![Way::Ours]),
        (Way::Hop, vec![Way::Datagrams]),
    ];
    ways.extend(with_nodes());
    ways.extend(through(&Rival::all(report)));
    // A call is one message there and one back, as a String is.
    ways.push((Way::Portal, vec![Way::Hop]));
    measure(report, "service call", "calls", &ways)
}

/// Goals.
pub(crate) fn goals(report: &mut Report) -> Result<()> {
    let mut ways = vec![(Way::Bus, vec![Way::Rclpy, Way::Stock])];
    ways.extend(with_nodes());
    ways.extend(through(&Rival::all(report)));
    measure(report, "goal of an action until its result", "goals", &ways)
}

/// What is to be reached, of a way beside another.
fn target(way: &Way, floor: &Way) -> Option<Target> {
    match (way, floor) {
        (Way::Portal, Way::Bus) => Some(THROUGH),
        (Way::Portal, Way::ByRival(_)) | (Way::PortalToRclpy, Way::ByRivalToRclpy(_)) => {
            Some(Target::BelowFloor)
        }
        _ => None,
    }
}

fn measure(report: &mut Report, what: &str, role: &str, beside: &[(Way, Vec<Way>)]) -> Result<()> {
    let mut ways: Vec<Way> = Vec::new();
    for (way, floors) in beside {
        for way in [way].into_iter().chain(floors) {
            if !ways.contains(way) {
                ways.push(way.clone());
            }
        }
    }
    let found = race(report, what, role, &ways)?;
    let of = |way: &Way| {
        let at = ways.iter().position(|other| other == way);
        at.and_then(|at| found[at])
    };
    let pairs = beside
        .iter()
        .flat_map(|(way, floors)| floors.iter().map(move |floor| (way, floor)));
    for (way, floor) in pairs {
        let (Some(value), Some(beside)) = (of(way), of(floor)) else {
            continue;
        };
        for (at, name) in ["p50", "p99"].into_iter().enumerate() {
            let what = format!("{what}, {}: {name}", way.name());
            let figure = report.figure(what, "µs", value[at]);
            figure.beside(floor.name(), beside[at]);
            if let Some(target) = target(way, floor).filter(|_| name == "p50") {
                figure.reach(target);
            }
        }
    }
    Ok(())
}
