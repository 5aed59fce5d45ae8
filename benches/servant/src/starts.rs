//! How long a start takes: a robot's, the node's alone, the container's alone, in turns.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target, Times};
use bench_servant::{Daemon, full};
use servant::container::ContainerSpec;
use tokio::runtime::Handle;

use crate::bare;
use crate::engine::Ours;
use crate::image::Image;
use crate::native::Native;
use crate::peers::Peer;
use crate::robot::Robot;
use crate::upgrade;

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

/// Waits until the nodes run in a container of the warm pool. They have registered long before the next turn.
fn until_warm(daemon: &Daemon) -> Result<()> {
    let deadline = Instant::now() + Duration::from_secs(60);
    while daemon.get("/api/v1/status")?["warm_nodes"] == 0 {
        ensure!(Instant::now() < deadline, "no nodes run ahead");
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(SETTLES);
    Ok(())
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

/// For nodes that were started just now to register.
const SETTLES: Duration = Duration::from_millis(500);
/// Between two contestants, for what the one before left running in the kernel.
const PAUSE: Duration = Duration::from_millis(100);

/// Starts something once, and ends it.
type Start<'a> = Box<dyn Fn(&ContainerSpec) -> Result<Duration> + 'a>;

/// One way to start something.
struct Contestant<'a> {
    name: &'static str,
    /// One that does not work on this host is told and left out; ours must.
    optional: bool,
    start: Start<'a>,
    times: Vec<Duration>,
}

impl<'a> Contestant<'a> {
    fn ours(name: &'static str, start: impl Fn(&ContainerSpec) -> Result<Duration> + 'a) -> Self {
        Self {
            name,
            optional: false,
            start: Box::new(start),
            times: Vec::new(),
        }
    }

    fn peer(name: &'static str, start: impl Fn(&ContainerSpec) -> Result<Duration> + 'a) -> Self {
        Self {
            optional: true,
            ..Self::ours(name, start)
        }
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

/// All starts in turns, so that what disturbs one disturbs all.
pub(crate) fn measure(
    report: &mut Report,
    daemon: &Daemon,
    without_warm_pool: &Daemon,
    warm_nodes: &Daemon,
    image: &Image,
    runtime: &Handle,
) -> Result<()> {
    let rounds = if full() { 40 } else { 15 };
    let place = daemon.place().join("starts");
    std::fs::create_dir_all(&place)?;
    let native = Native::prepare(&place, image, runtime)?;
    let ours = Ours::prepare(&place, runtime)?;
    let plain = upgrade::server()?;
    let bundle = place.join("bundle");
    let mut contestants = vec![
        Contestant::ours(ROBOT, |_| robot(daemon, image)),
        Contestant::ours(COLD, |_| robot(without_warm_pool, image)),
        Contestant::ours(READY, |_| {
            until_warm(warm_nodes)?;
            robot(warm_nodes, image)
        }),
        Contestant::ours(UPGRADE, |_| upgrade::time(&plain)),
        Contestant::ours(NODE, |_| native.time()),
        Contestant::ours(ENGINE, |spec| ours.time(spec.clone())),
        Contestant::peer(LIMITED, |spec| bare::limited(&bundle, spec)),
        Contestant::ours(UNLIMITED, |spec| bare::unlimited(&bundle, spec)),
    ];
    for (peer, there) in Peer::looked_for()? {
        if let Err(why) = there {
            report.left_out(peer.name, format!("{why:#}"));
            continue;
        }
        let bundle = place.join(peer.name);
        contestants.push(Contestant::peer(peer.name, move |spec| {
            peer.time(&bundle, spec)
        }));
    }
    // The first round warms up.
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
                    report.left_out(one.name, format!("{error:#}"));
                    contestants.remove(index);
                }
                Err(error) => return Err(error.context(one.name)),
            }
        }
    }
    let all: Vec<Times> = contestants
        .into_iter()
        .map(|one| times(one.name, one.times))
        .collect();
    tell(report, &all, rounds)
}

fn tell(report: &mut Report, all: &[Times], rounds: usize) -> Result<()> {
    let of = |name: &str| all.iter().find(|times| times.name == name);
    let needed = |name: &str| of(name).with_context(|| name.to_owned());
    let (robots, node) = (needed(ROBOT)?, median(needed(NODE)?));
    let engine = median(needed(ENGINE)?);
    let unlimited = needed(UNLIMITED)?;
    // Where libcontainer cannot set limits the container without them stands for it.
    let bare = of(LIMITED).unwrap_or(unlimited);
    report
        .figure(
            "robot connects → node registered, bridged",
            "ms",
            median(robots),
        )
        .beside(
            "node alone + 1.5 × libcontainer alone",
            node + 1.5 * median(bare),
        )
        .reach(Target::RatioAtMost(1.0))
        .note(format!(
            "medians of {rounds}, in turns; best {:.1} ms",
            robots.best().as_secs_f64() * 1e3
        ));
    report
        .figure(
            "robot connects → node registered, bridged, without a container made ahead",
            "ms",
            median(needed(COLD)?),
        )
        .beside(
            "node alone + 1.5 × libcontainer alone",
            node + 1.5 * median(bare),
        )
        .note("the first robot of a service, and robots that come faster than containers are made");
    report
        .figure(
            "robot connects → node registered, bridged, in a container made ahead",
            "ms",
            median(robots),
        )
        .beside("node alone", node)
        .reach(Target::RatioAtMost(1.2));
    let ready = needed(READY)?;
    report
        .figure(
            "robot connects → first answer, nodes running already",
            "ms",
            median(ready),
        )
        .beside(UPGRADE, median(needed(UPGRADE)?))
        .reach(Target::RatioAtMost(10.0))
        .note(format!(
            "warm_nodes = 1; the answer names the node; best {:.2} ms",
            ready.best().as_secs_f64() * 1e3
        ));
    report
        .figure("node alone: exec → registered", "ms", node)
        .note("in a chroot of the same layers, namespaces ready, the same Master");
    report
        .figure("create → running", "ms", engine)
        .beside(bare.name.clone(), median(bare))
        .reach(Target::RatioAtMost(1.5))
        .note("ours with limits read back, shim, Master and init");
    for other in all
        .iter()
        .filter(|times| ![ROBOT, COLD, READY, UPGRADE, NODE, ENGINE].contains(&times.name.as_str()))
    {
        if other.name != bare.name {
            report
                .figure("create → running", "ms", engine)
                .beside(other.name.clone(), median(other));
        }
    }
    Ok(())
}
