//! How long it takes from coming to a node that runs until its messages are heard, and until ours have come back.

use anyhow::Result;
use bench_report::{Report, Target, quantile};

use crate::world::{Program, Transport, World, number};

/// What is to be reached, in milliseconds.
const JOINED: f64 = 150.0;
/// Beats of the node each second: the first is not waited for much longer than it takes to be heard.
const BEATS: &str = "200";

/// Medians of the first beat and of the first pong; the node stays, newcomers come and go.
pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let rounds = if crate::full() { 31 } else { 9 };
    eprintln!("joining: {rounds} times each");
    let world = World::new()?;
    let _node = world.rclpy(Transport::Udp, &["relay", BEATS])?;
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for _ in 0..rounds {
        ours.push(joined(world.ours(&["joins"])?)?);
        theirs.push(joined(world.rclpy(Transport::Udp, &["joins"])?)?);
    }
    for (at, what) in [
        (0, "joining a running node to its first message"),
        (1, "joining it to an answer of its"),
    ] {
        let of = |all: &[[f64; 2]]| {
            let times: Vec<f64> = all.iter().map(|times| times[at]).collect();
            (
                quantile(&times, 0.5).unwrap_or(f64::NAN),
                quantile(&times, 1.0).unwrap_or(f64::NAN),
            )
        };
        let ((median, most), (floor, _)) = (of(&ours), of(&theirs));
        let figure = report.figure(what, "ms", median);
        figure
            .beside("a participant of rclpy that joins", floor)
            .reach(Target::AtMost(JOINED));
        figure.note(format!(
            "median of {rounds}, at most {most:.0}; rclpy is imported already"
        ));
    }
    Ok(())
}

fn joined(mut newcomer: Program) -> Result<[f64; 2]> {
    let found = newcomer.answer()?;
    Ok([number(&found, "beat")?, number(&found, "pong")?])
}
