//! How long a String is under way to another participant and back, a call, and an action's goal; one at a time, without the portal.

use std::time::Duration;

use anyhow::{Result, ensure};
use bench_report::Report;
use serde_json::Value;

use crate::world::{Program, Transport, World, number};

/// Per turn. A server of rclpy tells of all goals of the last fifteen minutes whenever one changes: of few there is little to tell.
const TRIPS: &str = "2000";
const GOALS: &str = "200";
/// A turn takes seconds.
const PATIENCE: Duration = Duration::from_secs(60);

/// Who asks, and who answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    /// Ours, both.
    Ours,
    /// Buses over them, both.
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
}

impl Way {
    fn name(self) -> &'static str {
        match self {
            Self::Ours => "ours to ours",
            Self::Bus => "bus to bus",
            Self::BusToRclpy => "bus to rclpy",
            Self::RclpyToBus => "rclpy to bus",
            Self::Rclpy => "rclpy to rclpy by UDP",
            Self::Stock => "rclpy to rclpy by shared memory",
            Self::Datagrams => "datagrams alone",
        }
    }

    fn answers(self, world: &World) -> Result<Program> {
        match self {
            Self::Ours => world.ours(&["relay"]),
            Self::Bus | Self::RclpyToBus => world.ours(&["bus", "relay"]),
            Self::BusToRclpy | Self::Rclpy => world.rclpy(Transport::Udp, &["relay"]),
            Self::Stock => world.rclpy(Transport::Stock, &["relay"]),
            Self::Datagrams => world.ours(&["datagrams"]),
        }
    }

    fn asks(self, world: &World, role: &str) -> Result<Program> {
        let count = if role == "goals" { GOALS } else { TRIPS };
        match self {
            Self::Ours => world.ours(&[role, count]),
            Self::Bus | Self::BusToRclpy => world.ours(&["bus", role, count]),
            Self::RclpyToBus | Self::Rclpy => world.rclpy(Transport::Udp, &[role, count]),
            Self::Stock => world.rclpy(Transport::Stock, &[role, count]),
            Self::Datagrams => world.ours(&["datagram-trips", TRIPS]),
        }
    }

    /// p50 and p99 of one turn, in microseconds.
    fn turn(self, role: &str) -> Result<[f64; 2]> {
        let world = World::new()?;
        let _answers = self.answers(&world)?;
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

/// The best p50 and the best p99 of each way's turns, which alternate.
fn race(what: &str, role: &str, ways: &[Way]) -> Result<Vec<[f64; 2]>> {
    let rounds = if crate::full() { 15 } else { 5 };
    let mut best = vec![[f64::INFINITY; 2]; ways.len()];
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, best) in ways.iter().zip(&mut best) {
            for (best, found) in best.iter_mut().zip(way.turn(role)?) {
                *best = best.min(found);
            }
        }
    }
    Ok(best)
}

/// What is asked, the role that asks it, and what each way stands beside.
type Course = (&'static str, &'static str, &'static [(Way, &'static [Way])]);

const COURSES: [Course; 3] = [
    (
        "String there and back",
        "trips",
        &[
            (Way::Ours, &[Way::Datagrams, Way::Rclpy, Way::Stock]),
            (Way::Bus, &[Way::Ours]),
            (Way::BusToRclpy, &[Way::Rclpy]),
            (Way::RclpyToBus, &[Way::Rclpy]),
        ],
    ),
    (
        "service call",
        "calls",
        &[
            (Way::Ours, &[Way::Rclpy, Way::Stock]),
            (Way::Bus, &[Way::Ours]),
            (Way::BusToRclpy, &[Way::Rclpy]),
            (Way::RclpyToBus, &[Way::Rclpy]),
        ],
    ),
    (
        "goal of an action until its result",
        "goals",
        &[
            (Way::Bus, &[Way::Rclpy, Way::Stock]),
            (Way::BusToRclpy, &[Way::Rclpy]),
            (Way::RclpyToBus, &[Way::Rclpy]),
        ],
    ),
];

/// Strings, calls and goals.
pub(crate) fn measure(report: &mut Report) -> Result<()> {
    for (what, role, beside) in COURSES {
        let mut ways: Vec<Way> = Vec::new();
        for way in beside
            .iter()
            .flat_map(|(way, floors)| [&[*way], *floors].concat())
        {
            if !ways.contains(&way) {
                ways.push(way);
            }
        }
        let found = race(what, role, &ways)?;
        let of = |way: &Way| {
            let at = ways.iter().position(|other| other == way);
            at.map_or([f64::NAN; 2], |at| found[at])
        };
        for (way, floors) in beside {
            for floor in *floors {
                for (at, name) in ["p50", "p99"].into_iter().enumerate() {
                    report
                        .figure(format!("{what}, {}: {name}", way.name()), "µs", of(way)[at])
                        .beside(floor.name(), of(floor)[at]);
                }
            }
        }
    }
    Ok(())
}
