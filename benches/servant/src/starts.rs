//! How long a start takes: a robot's, the node's alone, the container's alone, in turns.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target, Times};
use bench_servant::{Daemon, full};
use servant::spec::Spec;
use tokio::runtime::Handle;

use crate::bare;
use crate::engine::Ours;
use crate::image::Image;
use crate::native::Native;
use crate::peers::Peer;
use crate::robot::Robot;

/// A robot connects; until rosapi tells it of its node. Then it leaves, and its servant ends.
pub(crate) fn robot(daemon: &Daemon, image: &Image) -> Result<Duration> {
    let before = daemon.servants()?.len();
    let begun = Instant::now();
    let mut robot = Robot::connect(&daemon.address, &image.service)?;
    let nodes = robot.nodes()?;
    let took = begun.elapsed();
    let node = &image.node()?.name;
    ensure!(
        nodes.contains(node),
        "the servant was there without {node}: {nodes:?}"
    );
    robot.leave()?;
    daemon.until_servants(before)?;
    Ok(took)
}

/// Sorted and named.
pub(crate) fn times(name: &str, mut list: Vec<Duration>) -> Times {
    list.sort_unstable();
    Times {
        name: name.to_owned(),
        sorted: list,
    }
}

/// The middle one, in milliseconds.
pub(crate) fn median(times: &Times) -> f64 {
    times.median().as_secs_f64() * 1e3
}

/// All starts in turns, so that what disturbs one disturbs all.
pub(crate) fn measure(
    report: &mut Report,
    daemon: &Daemon,
    image: &Image,
    runtime: &Handle,
) -> Result<()> {
    let rounds = if full() { 40 } else { 15 };
    let place = daemon.place().join("starts");
    std::fs::create_dir_all(&place)?;
    let native = Native::prepare(&place, image, runtime)?;
    let ours = Ours::prepare(&place, runtime)?;
    let mut peers: Vec<(Peer, Vec<Duration>)> = Peer::installed()?
        .into_iter()
        .map(|peer| (peer, Vec::new()))
        .collect();
    let (mut robots, mut nodes, mut engine, mut bares) = (vec![], vec![], vec![], vec![]);
    // The first round warms up.
    for round in 0..=rounds {
        eprintln!("starts: round {round} of {rounds}");
        let spec = |name: &str| Spec {
            id: format!("bench-{name}-{}-{round}", std::process::id()),
            nodes: Vec::new(),
            ..image.spec.clone()
        };
        let robot = robot(daemon, image).context("a robot's start")?;
        let node = native.time().context("the node alone")?;
        let engines = ours.time(spec("engine")).context("the engine alone")?;
        let bare = bare::time(&place.join("bare"), &spec("bare")).context("libcontainer alone")?;
        // One that does not work on this host is told and left out.
        peers.retain_mut(|(peer, times)| {
            match peer.time(&place.join(peer.name), &spec(peer.name)) {
                Ok(time) => {
                    times.extend((round > 0).then_some(time));
                    true
                }
                Err(error) => {
                    eprintln!("{} is left out: {error:#}", peer.name);
                    false
                }
            }
        });
        if round > 0 {
            robots.push(robot);
            nodes.push(node);
            engine.push(engines);
            bares.push(bare);
        }
    }
    let robots = times("robot", robots);
    let (nodes, engine, bares) = (
        times("node", nodes),
        times("engine", engine),
        times("bare", bares),
    );
    let (node, bare) = (median(&nodes), median(&bares));
    report
        .figure(
            "robot connects → node registered, bridged",
            "ms",
            median(&robots),
        )
        .beside("node alone + 1.5 × libcontainer alone", node + 1.5 * bare)
        .reach(Target::RatioAtMost(1.0))
        .note(format!(
            "medians of {rounds}, in turns; best {:.1} ms",
            robots.best().as_secs_f64() * 1e3
        ));
    report
        .figure("node alone: exec → registered", "ms", node)
        .note("in a chroot of the same layers, namespaces ready, the same Master");
    report
        .figure("create → running", "ms", median(&engine))
        .beside("libcontainer alone, bare program, same spec", bare)
        .reach(Target::RatioAtMost(1.5))
        .note("ours with cgroup, limits, shim, Master and init; the bare one without");
    for (peer, list) in peers {
        let name = peer.name;
        report
            .figure(
                format!("create → running, beside {name}"),
                "ms",
                median(&engine),
            )
            .beside(name, median(&times(name, list)));
    }
    Ok(())
}
