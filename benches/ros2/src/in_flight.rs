//! Our portal beside other rosbridge servers by the method of rosbridge-server-rs: a client keeps 32 messages in flight
//! for two seconds, in JSON, reliable, and subscribes to what it publishes. Our bridge gives clients' messages to
//! clients while it sends them to the nodes, so the path to a node and back is measured as well.

use std::time::Duration;

use anyhow::Result;
use bench_report::{BenchReport, Process, Target, is_full_run, median};

use crate::echoes::{DEPTH, EchoPath, IN_FLIGHT};
use crate::rivals::{Rival, Server};
use crate::turns::measure_in_turns;
use crate::world::{BenchNetwork, Host, json_number};

/// Duration of a turn's measurement.
const SECONDS: &str = "2";
/// Maximum duration of a turn.
const PATIENCE: Duration = Duration::from_secs(60);
/// Sizes in bytes, their names, and how many times the messages of rosbridge-server-rs are to be reached.
const SIZES: [(usize, &str, f64); 3] = [(64, "64 B", 1.5), (1 << 10, "1 KiB", 1.5), (64 << 10, "64 KiB", 3.0)];
/// Numbers of a client's answer, with the title and unit of their figures; the server's memory comes after them.
const NUMBERS: [(&str, &str, &str); 4] = [
    ("rate", "messages", "/s"),
    ("p50", "round trip, p50", "ms"),
    ("p95", "round trip, p95", "ms"),
    ("p99", "round trip, p99", "ms"),
];

/// Returns the numbers of one turn and the server's memory in megabytes.
fn measure_turn(server: &Server, path: EchoPath, size: usize) -> Result<Vec<f64>> {
    let mut world = BenchNetwork::new()?;
    world.pin_to(Host::Server)?;
    let _node = match path {
        EchoPath::Itself => None,
        EchoPath::Node => Some(world.start_role(&["relay", DEPTH])?),
    };
    let server = server.start(&world)?;
    world.pin_to(Host::Robot)?;
    let [there, back] = path.topics();
    let mut client = world.start_role(&["client", "echoes", there, back, &size.to_string(), SECONDS])?;
    let answer = client.answer_within(PATIENCE)?;
    let mut numbers = NUMBERS.iter().map(|(name, ..)| json_number(&answer, name)).collect::<Result<Vec<_>>>()?;
    numbers.push(Process::from_pid(server.pid()).resident()?);
    Ok(numbers)
}

/// Measures all sizes on both paths.
pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let mut servers = vec![Server::Portal];
    servers.extend(Rival::find_available(report).into_iter().map(Server::Rival));
    let rounds = if is_full_run() { 9 } else { 3 };
    for (path, suffix) in [(EchoPath::Itself, ""), (EchoPath::Node, ", through a node")] {
        for (size, name, times) in SIZES {
            let what = format!("{IN_FLIGHT} of {name} in flight{suffix}");
            let turn = |server: &Server| measure_turn(server, path, size);
            let found = measure_in_turns(report, &what, rounds, &servers, |server| Some(server), turn)?;
            let middle = |turns: &[Vec<f64>], at: usize| {
                median(&turns.iter().map(|turn| turn[at]).collect::<Vec<_>>()).unwrap_or(f64::NAN)
            };
            for (server, theirs) in servers.iter().zip(&found).skip(1) {
                let (Some(ours), Some(theirs)) = (&found[0], theirs) else { continue };
                let is_own_method = path == EchoPath::Itself && matches!(server, Server::Rival(Rival::ServerRs(_)));
                let titles = NUMBERS.iter().map(|(_, title, unit)| (*title, *unit));
                for (at, (title, unit)) in titles.chain([("memory of the server", "MB")]).enumerate() {
                    let figure = report.figure(format!("{what}: {title}"), unit, middle(ours, at));
                    figure.relative_to(server.to_string(), middle(theirs, at));
                    match NUMBERS.get(at) {
                        Some(("rate", ..)) if is_own_method => drop(figure.require(Target::RatioAtLeast(times))),
                        Some(("p95", ..)) if is_own_method => drop(figure.require(Target::BelowFloor)),
                        _ => {}
                    }
                }
            }
        }
    }
    Ok(())
}
