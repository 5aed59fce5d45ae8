//! Time from joining a running node until its messages arrive, and until ours have been returned.

use anyhow::Result;
use bench_report::{BenchReport, Target, is_full_run, quantile};

use crate::world::{BenchNetwork, BenchProgram, Transport, json_number};

/// Limit in milliseconds.
const JOINED: f64 = 150.0;
/// Messages of the node per second: many, so that the wait for the next one hardly counts.
const BEATS: &str = "200";

/// Participant that joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Newcomer {
    Ours,
    Rclpy,
    /// A robot for which the portal is created; measured from its connection.
    Robot,
    /// A robot that follows another one, for which the portal exists already.
    AnotherRobot,
}

impl Newcomer {
    /// Returns the milliseconds until the first beat, and until the first pong if the newcomer sends pings.
    fn time_join(self, world: &BenchNetwork) -> Result<(f64, Option<f64>)> {
        let portal = match self {
            Self::Robot => Some(world.start_role(&["portal", "fresh"])?),
            Self::AnotherRobot => Some(world.start_role(&["portal", "kept"])?),
            Self::Ours | Self::Rclpy => None,
        };
        if self == Self::AnotherRobot {
            world.start_role(&["client", "joins"])?.answer()?;
        }
        let mut newcomer: BenchProgram = match self {
            Self::Ours => world.start_role(&["joins"])?,
            Self::Rclpy => world.start_rclpy(Transport::Udp, &["joins"])?,
            Self::Robot | Self::AnotherRobot => world.start_role(&["client", "joins"])?,
        };
        let found = newcomer.answer()?;
        // The client is dropped before the portal.
        drop((newcomer, portal));
        Ok((json_number(&found, "beat")?, found["pong"].as_f64()))
    }
}

/// Reports the medians of the first beat and of the first pong; the node stays, newcomers come and go.
pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let rounds = if is_full_run() { 31 } else { 9 };
    eprintln!("joining: {rounds} times each");
    let world = BenchNetwork::new()?;
    let _node = world.start_rclpy(Transport::Udp, &["relay", BEATS])?;
    let newcomers = [Newcomer::Ours, Newcomer::Robot, Newcomer::AnotherRobot, Newcomer::Rclpy];
    let mut found = newcomers.map(|_| (Vec::new(), Vec::new()));
    for _ in 0..rounds {
        for (newcomer, (beats, pongs)) in newcomers.iter().zip(&mut found) {
            let (beat, pong) = newcomer.time_join(&world)?;
            beats.push(beat);
            pongs.extend(pong);
        }
    }
    let [ours, robot, another, theirs] = &found;
    let connecting = "a robot's connecting to the first message of a running node, before which the portal is";
    for (what, times, floor) in [
        ("joining a running node to its first message".to_owned(), &ours.0, &theirs.0),
        ("joining it to an answer of its".to_owned(), &ours.1, &theirs.1),
        (format!("{connecting} not"), &robot.0, &theirs.0),
        (connecting.to_owned(), &another.0, &theirs.0),
    ] {
        let of = |times: &[f64], share| quantile(times, share).unwrap_or(f64::NAN);
        let figure = report.figure(what, "ms", of(times, 0.5));
        figure.relative_to("a participant of rclpy that joins", of(floor, 0.5)).require(Target::AtMost(JOINED));
        figure.note(format!("median of {rounds}, at most {:.0}; rclpy is imported already", of(times, 1.0)));
    }
    Ok(())
}
