//! Start times: of a robot's servant, of the node alone and of the container alone, in turns.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Target, Times, is_full_run};
use serde_json::json;
use servant::container::ContainerSpec;
use support::robot::Robot;
use tokio::runtime::Handle;

use crate::bare;
use crate::engine::BenchEngine;
use crate::image::ServiceImage;
use crate::native::NativeNode;
use crate::peers::PeerRuntime;
use crate::upgrade;

/// Returns the nodes that rosapi reports; the call is answered once the servant is ready.
pub(crate) fn list_nodes(robot: &mut Robot) -> Result<Vec<String>> {
    let answer = robot.call("/rosapi/nodes", json!({}))?;
    let nodes = answer["values"]["nodes"].as_array();
    let nodes = nodes.with_context(|| format!("nodes in {answer}"))?;
    Ok(nodes.iter().filter_map(|node| Some(node.as_str()?.to_owned())).collect())
}

/// Measures from a robot's connection until rosapi reports its node. Then the robot leaves, and its servant ends.
pub(crate) fn time_robot_start(daemon: &BenchDaemon, image: &ServiceImage) -> Result<Duration> {
    let before = daemon.servants()?.len();
    let begun = Instant::now();
    let mut robot = daemon.robot(&image.service)?;
    let nodes = list_nodes(&mut robot)?;
    let took = begun.elapsed();
    let node = &image.node()?.name;
    ensure!(nodes.contains(node), "the servant was there without {node}: {nodes:?}");
    robot.leave()?;
    daemon.wait_for_servants(before)?;
    Ok(took)
}

/// Waits until the nodes run in a container of the warm pool; they have registered long before the next turn.
fn wait_until_warm(daemon: &BenchDaemon) -> Result<()> {
    daemon.wait_for("/api/v1/status", "nodes that run ahead", |status| (status["warm_nodes"] != 0).then_some(()))?;
    std::thread::sleep(SETTLES);
    Ok(())
}

/// Time for nodes that were started just now to register.
const SETTLES: Duration = Duration::from_millis(500);
/// Pause between two contestants, for work that the previous one has left to the kernel.
const PAUSE: Duration = Duration::from_millis(100);

/// A function that starts something once, measures the time, and stops it.
type Start<'a> = Box<dyn Fn(&ContainerSpec) -> Result<Duration> + 'a>;

/// One way to start something.
struct Contestant<'a> {
    name: &'static str,
    /// True if a failure on this host is reported and skipped; our own starts must succeed.
    optional: bool,
    start: Start<'a>,
    times: Vec<Duration>,
}

impl<'a> Contestant<'a> {
    fn ours(name: &'static str, start: impl Fn(&ContainerSpec) -> Result<Duration> + 'a) -> Self {
        Self { name, optional: false, start: Box::new(start), times: Vec::new() }
    }

    fn peer(name: &'static str, start: impl Fn(&ContainerSpec) -> Result<Duration> + 'a) -> Self {
        Self { optional: true, ..Self::ours(name, start) }
    }
}

const ROBOT: &str = "robot";
const COLD: &str = "robot, no container made ahead";
const READY: &str = "robot, nodes running already";
const UPGRADE: &str = "plain WebSocket upgrade";
const NODE: &str = "node alone";
const ENGINE: &str = "engine";
const LIMITED: &str = "libcontainer alone, the same spec";
const UNLIMITED: &str = "libcontainer alone, without cgroups";

/// Measures all starts in turns, so that disturbances affect all of them.
pub(crate) fn measure(
    report: &mut BenchReport,
    daemon: &BenchDaemon,
    without_warm_pool: &BenchDaemon,
    warm_nodes: &BenchDaemon,
    image: &ServiceImage,
    runtime: &Handle,
) -> Result<()> {
    let rounds = if is_full_run() { 40 } else { 15 };
    let place = daemon.directory().join("starts");
    std::fs::create_dir_all(&place)?;
    let native = NativeNode::prepare(&place, image, runtime)?;
    let ours = BenchEngine::prepare(&place, runtime)?;
    let plain = upgrade::start_server()?;
    let bundle = place.join("bundle");
    let mut contestants = vec![
        Contestant::ours(ROBOT, |_| time_robot_start(daemon, image)),
        Contestant::ours(COLD, |_| time_robot_start(without_warm_pool, image)),
        Contestant::ours(READY, |_| {
            wait_until_warm(warm_nodes)?;
            time_robot_start(warm_nodes, image)
        }),
        Contestant::ours(UPGRADE, |_| upgrade::time_upgrade(&plain)),
        Contestant::ours(NODE, |_| native.time_start()),
        Contestant::ours(ENGINE, |spec| ours.time_start(spec.clone())),
        Contestant::peer(LIMITED, |spec| bare::time_limited(&bundle, spec)),
        Contestant::ours(UNLIMITED, |spec| bare::time_unlimited(&bundle, spec)),
    ];
    for (peer, there) in PeerRuntime::find_peers()? {
        if let Err(why) = there {
            report.skip(peer.name, format!("{why:#}"));
            continue;
        }
        let bundle = place.join(peer.name);
        contestants.push(Contestant::peer(peer.name, move |spec| peer.time_container(&bundle, spec)));
    }
    // The first round is a warm-up.
    for round in 0..=rounds {
        eprintln!("starts: round {round} of {rounds}");
        for index in (0..contestants.len()).rev() {
            let one = &mut contestants[index];
            let spec = ContainerSpec {
                id: format!("bench-{}-{round}-{index}", std::process::id()),
                nodes: Vec::new(),
                ..image.spec.clone()
            };
            std::thread::sleep(PAUSE);
            match (one.start)(&spec) {
                Ok(time) => one.times.extend((round > 0).then_some(time)),
                Err(error) if one.optional => {
                    report.skip(one.name, format!("{error:#}"));
                    contestants.remove(index);
                }
                Err(error) => return Err(error.context(one.name)),
            }
        }
    }
    let all: Vec<Times> = contestants
        .into_iter()
        .map(|mut one| {
            one.times.sort_unstable();
            Times { name: one.name.to_owned(), sorted: one.times }
        })
        .collect();
    report_starts(report, &all, rounds)
}

fn report_starts(report: &mut BenchReport, all: &[Times], rounds: usize) -> Result<()> {
    let of = |name: &str| all.iter().find(|times| times.name == name);
    let needed = |name: &str| of(name).with_context(|| name.to_owned());
    let (robots, node) = (needed(ROBOT)?, needed(NODE)?.median_milliseconds());
    let engine = needed(ENGINE)?.median_milliseconds();
    let unlimited = needed(UNLIMITED)?;
    // If libcontainer cannot set limits, the container without limits is the reference.
    let bare = of(LIMITED).unwrap_or(unlimited);
    let figure = report.figure("robot connects → node registered, bridged", "ms", robots.median_milliseconds());
    figure.relative_to("node alone + 1.5 × libcontainer alone", node + 1.5 * bare.median_milliseconds());
    figure.require(Target::RatioAtMost(1.0));
    figure.note(format!("medians of {rounds}, in turns; best {:.1} ms", robots.best().as_secs_f64() * 1e3));
    let figure = report.figure(
        "robot connects → node registered, bridged, without a container made ahead",
        "ms",
        needed(COLD)?.median_milliseconds(),
    );
    figure.relative_to("node alone + 1.5 × libcontainer alone", node + 1.5 * bare.median_milliseconds());
    figure.note("the first robot of a service, and robots that come faster than containers are made");
    let figure = report.figure(
        "robot connects → node registered, bridged, in a container made ahead",
        "ms",
        robots.median_milliseconds(),
    );
    figure.relative_to("node alone", node).require(Target::RatioAtMost(1.2));
    let ready = needed(READY)?;
    let figure =
        report.figure("robot connects → first answer, nodes running already", "ms", ready.median_milliseconds());
    figure.relative_to(UPGRADE, needed(UPGRADE)?.median_milliseconds()).require(Target::RatioAtMost(10.0));
    figure.note(format!("warm_nodes = 1; the answer names the node; best {:.2} ms", ready.best().as_secs_f64() * 1e3));
    let figure = report.figure("node alone: exec → registered", "ms", node);
    figure.note("in a chroot of the same layers, namespaces ready, the same Master");
    let figure = report.figure("create → running", "ms", engine);
    figure.relative_to(bare.name.clone(), bare.median_milliseconds()).require(Target::RatioAtMost(1.5));
    figure.note("ours with limits read back, shim, Master and init");
    for other in all.iter().filter(|times| ![ROBOT, COLD, READY, UPGRADE, NODE, ENGINE].contains(&times.name.as_str()))
    {
        if other.name != bare.name {
            let figure = report.figure("create → running", "ms", engine);
            figure.relative_to(other.name.clone(), other.median_milliseconds());
        }
    }
    Ok(())
}
