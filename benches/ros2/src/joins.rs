//! How long it takes from coming to a node that runs until its messages are heard, and until ours have come back.

use anyhow::Result;
use bench_report::{Report, Target, quantile};

use crate::world::{Program, Transport, World, number};

/// What is to be reached, in milliseconds.
const JOINED: f64 = 150.0;
/// Beats of the node each second: the first is not waited for much longer than it takes to be heard.
const BEATS: &str = "200";

/// Who comes to the node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Newcomer {
    Ours,
    Rclpy,
    /// A robot, with which the portal comes; from its connecting on.
    Robot,
    /// A robot after another, before which the portal is there.
    AnotherRobot,
}

impl Newcomer {
    /// Milliseconds until the first beat, and until the first pong where it sends pings.
    fn joins(self, world: &World) -> Result<(f64, Option<f64>)> {
        let portal = match self {
            Self::Robot => Some(world.ours(&["portal", "fresh"])?),
            Self::AnotherRobot => Some(world.ours(&["portal", "kept"])?),
            Self::Ours | Self::Rclpy => None,
        };
        if self == Self::AnotherRobot {
            world.ours(&["client", "joins"])?.answer()?;
        }
        let mut newcomer: Program = match self {
            Self::Ours => world.ours(&["joins"])?,
            Self::Rclpy => world.rclpy(Transport::Udp, &["joins"])?,
            Self::Robot | Self::AnotherRobot => world.ours(&["client", "joins"])?,
        };
        let found = newcomer.answer()?;
        // It goes before the portal does.
        drop((newcomer, portal));
        Ok((number(&found, "beat")?, found["pong"].as_f64()))
    }
}

/// Medians of the first beat and of the first pong; the node stays, newcomers come and go.
pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let rounds = if crate::full() { 31 } else { 9 };
    eprintln!("joining: {rounds} times each");
    let world = World::new()?;
    let _node = world.rclpy(Transport::Udp, &["relay", BEATS])?;
    let newcomers = [
        Newcomer::Ours,
        Newcomer::Robot,
        Newcomer::AnotherRobot,
        Newcomer::Rclpy,
    ];
    let mut found = vec![(Vec::new(), Vec::new()); newcomers.len()];
    for _ in 0..rounds {
        for (newcomer, (beats, pongs)) in newcomers.iter().zip(&mut found) {
            let (beat, pong) = newcomer.joins(&world)?;
            beats.push(beat);
            pongs.extend(pong);
        }
    }
    let [ours, robot, another, theirs] = found.as_slice() else {
        unreachable!("one for each newcomer");
    };
    for (what, times, floor) in [
        (
            "joining a running node to its first message",
            &ours.0,
            &theirs.0,
        ),
        ("joining it to an answer of its", &ours.1, &theirs.1),
        (
            "a robot's connecting to the first message of a running node, before which the portal is not",
            &robot.0,
            &theirs.0,
        ),
        (
            "a robot's connecting to the first message of a running node, before which the portal is",
            &another.0,
            &theirs.0,
        ),
    ] {
        let of = |share| quantile(times, share).unwrap_or(f64::NAN);
        let figure = report.figure(what, "ms", of(0.5));
        figure
            .beside(
                "a participant of rclpy that joins",
                quantile(floor, 0.5).unwrap_or(f64::NAN),
            )
            .reach(Target::AtMost(JOINED));
        figure.note(format!(
            "median of {rounds}, at most {:.0}; rclpy is imported already",
            of(1.0)
        ));
    }
    Ok(())
}
