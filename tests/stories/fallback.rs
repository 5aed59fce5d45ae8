//! A stub as it comes, nothing promised: while the server is away the original stands in, and finds what it needs.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{Bus, Message, Publisher, Qos, RosVersion, Subscription, WireType};
use support::Verdict;
use support::cable::{Badness, Cable};
use support::cutter::Cutter;
use support::daemon::Daemon;
use support::layout::Layout;
use support::patience::Deadline;
use support::people;
use support::site::{Running, Site};
use support::world::{LOCALISER, LOCALISER_TWO, Service, world};

/// For how long a link is away that is back before anybody has to stand in: no wait, and so not longer on a busy machine.
const BLIP: Duration = Duration::from_millis(50);
const SILENT: Badness = Badness {
    rate: 100_000,
    delay: 1,
    jitter: 0,
    loss: 1.0,
    limit: 1000,
};

/// A hall with one wall in it, as a map server has read it: `#` is a wall.
const HALL: [&str; 8] = [
    "##########",
    "#........#",
    "#........#",
    "#....#####",
    "#........#",
    "#........#",
    "#........#",
    "##########",
];
const RESOLUTION: f32 = 0.5;

/// A map server and a laser of one robot, and who asks where it is.
struct Robot {
    // In the order in which they end.
    poses: Subscription,
    scan: Box<dyn Publisher>,
    _map: Box<dyn Publisher>,
    _server: Arc<dyn Bus>,
    node: Arc<dyn Bus>,
    site: Site,
    sent: u32,
}

/// A nav_msgs/OccupancyGrid.
fn map(ros: RosVersion) -> Bytes {
    let mut out = Layout::of(ros);
    out.header(1, "map").u32(0).u32(0);
    out.f32(RESOLUTION).u32(10).u32(8);
    for number in [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] {
        out.f64(number);
    }
    let cells = HALL.concat();
    let cells = cells.bytes().map(|cell| if cell == b'#' { 100 } else { 0 });
    out.bytes(&cells.collect::<Vec<u8>>()).finish()
}

/// How far the next wall is in four directions, seen from a cell; metres.
fn ranges((x, y): (usize, usize)) -> [f32; 4] {
    let steps: [(isize, isize); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];
    steps.map(|(dx, dy)| {
        let mut count = 0_u8;
        let (mut x, mut y) = (x, y);
        while HALL[y].as_bytes()[x] != b'#' {
            x = x.saturating_add_signed(dx);
            y = y.saturating_add_signed(dy);
            count += 1;
        }
        f32::from(count) * RESOLUTION
    })
}

/// A sensor_msgs/LaserScan, stamped with its number.
fn scan(ros: RosVersion, number: u32, cell: (usize, usize)) -> Bytes {
    let mut out = Layout::of(ros);
    out.header(number, "laser");
    for number in [0.0, 4.71, 1.57, 0.0, 0.1, 0.0, 10.0] {
        out.f32(number);
    }
    out.u32(4);
    for range in ranges(cell) {
        out.f32(range);
    }
    out.u32(0).finish()
}

/// Where a pose of a geometry_msgs/PoseStamped begins: its position, which is followed by an orientation.
fn x_of(pose: &Message) -> usize {
    pose.bytes.len() - 56
}

impl Robot {
    fn new(ros: RosVersion) -> anyhow::Result<Self> {
        let site = Site::of(ros)?;
        let (server, node) = (site.joins("/map_server")?, site.joins("/laser")?);
        let advertise = |node: &dyn Bus, topic: &str, latch: bool, of: WireType| {
            let qos = Qos::keep_last(10).latching(latch);
            site.runtime.block_on(node.advertise(topic, of, qos))
        };
        let grid = people::type_of(ros, "nav_msgs/OccupancyGrid", &grid(ros))?;
        let map_publisher = advertise(&*server, "/map", true, grid)?;
        // Once, long before anybody asks.
        map_publisher.publish(map(ros));
        let laser = people::type_of(ros, "sensor_msgs/LaserScan", SCAN)?;
        let scan = advertise(&*node, "/scan", false, laser)?;
        let poses = site.hears_latched(&node, "/localiser/pose")?;
        Ok(Self {
            poses,
            scan,
            _map: map_publisher,
            _server: server,
            node,
            site,
            sent: 0,
        })
    }

    /// Shows a scan of a cell.
    fn shows(&self, number: u32, cell: (usize, usize)) {
        let ros = self.site.system.version();
        self.scan.publish(scan(ros, number, cell));
    }

    /// Stub and original as they are installed on a robot.
    fn starts(&self, daemon: &Daemon, robot: &str, server: &str) -> anyhow::Result<Running> {
        self.starts_with(daemon, robot, server, "")
    }

    /// With these lines in `stub.toml`.
    fn starts_with(
        &self,
        daemon: &Daemon,
        robot: &str,
        server: &str,
        settings: &str,
    ) -> anyhow::Result<Running> {
        let of = localiser(self.site.system.version());
        let service = of.service.name;
        let overlay = self.site.installs(daemon, service, settings)?;
        let original = (of.package, of.executable);
        let workspace: PathBuf = self
            .site
            .installs_original(daemon, service, original, of.program)?;
        let prefixes = format!("{}:{}", overlay.display(), workspace.display());
        let server = format!("ws://{server}");
        let variables = [
            (of.workspaces, prefixes.as_str()),
            ("CLOUDROID_SERVER", server.as_str()),
            ("CLOUDROID_ROBOT", robot),
            ("NO_COLOR", "1"),
        ];
        self.site
            .runs_among(&variables, &overlay, of.package, of.executable, of.argv)
    }

    /// Shows scans of a cell until one is answered; the answer is right.
    fn is_found(&mut self, cell: (usize, usize), stub: &Running) -> Verdict {
        let wanted = [cell.0, cell.1].map(|at| (at as f64 + 0.5) * f64::from(RESOLUTION));
        let ros = self.site.system.version();
        let (sent, scans) = (&mut self.sent, &self.scan);
        let ask = || {
            *sent += 1;
            scans.publish(scan(ros, *sent, cell));
            Ok(())
        };
        // Of an earlier cell's scans some may still be answered.
        let is_there = |pose: &Message| -> anyhow::Result<bool> {
            let place = x_of(pose);
            let number = |at: usize| {
                let bytes = pose.bytes[place + at..place + at + 8].try_into();
                bytes.map(f64::from_le_bytes)
            };
            Ok([number(0)?, number(8)?] == wanted)
        };
        let found = self.site.asks_until(&mut self.poses, ask, is_there);
        found
            .map(drop)
            .with_context(|| format!("{cell:?} should be found:\n{}", stub.said()))
    }
}

/// Waits until the stub has said this so many times.
fn says(stub: &Running, words: &str, times: usize) -> Verdict {
    stub.says_times(words, times)
}

/// Waits until a topic's message has these words.
fn tells(site: &Site, subscription: &mut Subscription, words: &str) -> Verdict {
    let deadline = Deadline::begin();
    loop {
        let message = site.next(subscription)?;
        let said = String::from_utf8_lossy(&message.bytes).into_owned();
        if said.contains(words) {
            return Ok(());
        }
        deadline.check(|| format!("{words:?}: {said}"))?;
    }
}

pub fn an_untouched_stub_finds_its_way_when_the_cable_is_cut_and_hands_back(
    ros: RosVersion,
) -> Verdict {
    let daemon = world().with(localiser(ros).service)?;
    let cable = Cable::new(&daemon.address)?;
    let mut robot = Robot::new(ros)?;
    let stub = robot.starts(
        &daemon,
        &named("fallback-cut", ros),
        &cable.server.to_string(),
    )?;
    says(&stub, "linked to", 1)?;
    robot.is_found((2, 4), &stub)?;
    let mut diagnostics = robot.site.hears(&robot.node, "/diagnostics")?;
    let (over, back) = (
        "the local original answers, too why=LinkDown",
        "the cloud answers alone why=LinkUp",
    );
    // Slow machines reach the cloud late: it may have stood in already.
    tells(
        &robot.site,
        &mut diagnostics,
        "the cloud answers (no response time is promised",
    )?;
    let before = stub.said().matches(over).count();
    for round in 1..=2 {
        cable.degrade(SILENT)?;
        says(&stub, over, before + round)?;
        // A process that has just been started: only the latched map tells it where these walls are.
        robot.is_found((6, 2), &stub)?;
        tells(
            &robot.site,
            &mut diagnostics,
            "the link is down, the local original answers",
        )?;
        let words = "where the original is installed on the robot, it stands in after 3.0 s";
        let name = named("fallback-cut", ros);
        let path = format!("/api/v1/robots/{name}/explain");
        daemon.awaits(&path, words, |explained| {
            explained["causes"]
                .to_string()
                .contains(words)
                .then_some(())
        })?;
        let explained = daemon.deployer().types(&["explain", &name])?;
        let explained = explained.succeeded()?.stdout;
        let words = "no time promised, fallback 3.0 s after the link is lost";
        ensure!(explained.contains(words), "{explained}");
        // Who comes now is given what the original has latched, not the cloud's last pose.
        let newcomer = robot.site.joins(&format!("/newcomer{round}"))?;
        let mut late = robot.site.hears_latched(&newcomer, "/localiser/pose")?;
        let pose = robot.site.next(&mut late)?;
        let x = x_of(&pose);
        ensure!(pose.bytes[x..x + 8] == 3.25_f64.to_le_bytes(), "{pose:?}");
        cable.restore()?;
        says(&stub, back, before + round)?;
        robot.is_found((1, 1), &stub)?;
        // The cloud's last pose has taken the place of the original's.
        let newcomer = robot.site.joins(&format!("/later{round}"))?;
        let mut late = robot.site.hears_latched(&newcomer, "/localiser/pose")?;
        let pose = robot.site.next(&mut late)?;
        let x = x_of(&pose);
        ensure!(pose.bytes[x..x + 8] == 0.75_f64.to_le_bytes(), "{pose:?}");
    }
    // Told when the link is back.
    daemon.awaits_event("that its original took over", |event| {
        event["robot"] == *named("fallback-cut", ros) && event["kind"] == "local-takes-over"
    })?;
    Ok(())
}

pub fn a_server_that_was_never_reached_is_stood_in_for_until_it_comes(ros: RosVersion) -> Verdict {
    let daemon = world().with(localiser(ros).service)?;
    let mut robot = Robot::new(ros)?;
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    way.cut(true);
    let stub = robot.starts(
        &daemon,
        &named("fallback-never", ros),
        &way.server.to_string(),
    )?;
    says(&stub, "no link: ", 1)?;
    robot.is_found((6, 6), &stub)?;
    says(&stub, "the local original answers, too why=LinkDown", 1)?;
    ensure!(!stub.said().contains("linked to"), "{}", stub.said());
    way.cut(false);
    says(&stub, "the cloud answers alone why=LinkUp", 1)?;
    says(&stub, "the local original is stopped why=LinkUp", 1)?;
    robot.is_found((1, 1), &stub)
}

pub fn a_promise_holds_without_a_server_too_until_it_comes(ros: RosVersion) -> Verdict {
    let daemon = world().with(localiser(ros).service)?;
    let mut robot = Robot::new(ros)?;
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    way.cut(true);
    // Nobody can ask for anything before somebody has registered what the node listens to.
    let settings = "desire = 20.0\nmax = 20.0\nfallback_after = 1.0\n";
    let server = way.server.to_string();
    let stub = robot.starts_with(&daemon, &named("fallback-promise", ros), &server, settings)?;
    says(&stub, "the local original answers, too why=LinkDown", 1)?;
    robot.is_found((6, 6), &stub)?;
    ensure!(!stub.said().contains("linked to"), "{}", stub.said());
    way.cut(false);
    says(&stub, "linked to", 1)?;
    // What nobody could answer in time has made it doubt the cloud: it is asked until it is trusted.
    let deadline = Deadline::begin();
    while !stub.said().contains("the local original is stopped") {
        robot.is_found((1, 1), &stub)?;
        deadline.check(|| stub.said())?;
    }
    robot.is_found((2, 4), &stub)
}

pub fn a_blip_of_the_link_starts_nothing_and_loses_nothing(ros: RosVersion) -> Verdict {
    let daemon = world().with(localiser(ros).service)?;
    let mut robot = Robot::new(ros)?;
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    // One late request would start the original, and nothing is late within five minutes.
    let settings = "desire = 300.0\nmax = 300.0\nfallback_after = 300.0\nthreshold = 4.0\ninitial = 5.0\ncap = 6.0\n";
    let server = way.server.to_string();
    let stub = robot.starts_with(&daemon, &named("fallback-blip", ros), &server, settings)?;
    says(&stub, "linked to", 1)?;
    robot.site.connected(&*robot.scan, 1)?;
    robot.is_found((2, 4), &stub)?;
    for round in 0..20_u32 {
        let number = 1_000_000 + round;
        // Now it is on its way when the link is lost, now it is asked while there is none.
        if round % 2 == 0 {
            robot.shows(number, (1, 1));
        }
        way.cut(true);
        std::thread::sleep(BLIP);
        if round % 2 == 1 {
            robot.shows(number, (1, 1));
        }
        way.cut(false);
        loop {
            let pose = robot.site.next(&mut robot.poses);
            let pose = pose.with_context(|| format!("scan {number}:\n{}", stub.said()))?;
            let answered = people::number(&pose).context("a stamp")?;
            if answered == number {
                break;
            }
            // Before the first round several scans were shown.
            ensure!(round == 0 && answered < 1_000_000, "{answered} came again");
        }
    }
    let said = stub.said();
    ensure!(said.contains("was lost"), "it was not cut: {said}");
    ensure!(!said.contains("the local original is started"), "{said}");
    let path = format!("/api/v1/robots/{}/explain", named("fallback-blip", ros));
    // All were answered; they are counted from when the stub has found out which output answers which input.
    let link = daemon.awaits(&path, "requests that are told", |explained| {
        let link = &explained["servants"][0]["links"][0];
        (link["requests"].as_u64() >= Some(1)).then(|| link.clone())
    })?;
    ensure!(link["late"] == 0 && link["local"] == 0, "{link:#}");
    Ok(())
}

pub fn an_untouched_stub_can_be_told_to_leave_the_original_alone(ros: RosVersion) -> Verdict {
    let daemon = world().with(localiser(ros).service)?;
    let robot = Robot::new(ros)?;
    let (name, server) = (named("fallback-none", ros), daemon.address.clone());
    let stub = robot.starts_with(&daemon, &name, &server, "local = \"none\"\n")?;
    says(&stub, "linked to", 1)?;
    let explained = daemon.deployer().asks(&["explain", &name])?;
    let link = &explained["servants"][0]["links"][0];
    ensure!(link["fallback_after"].is_null(), "{explained:#}");
    let graph = robot.node.graph().borrow().clone();
    ensure!(
        !graph.nodes.contains_key("/localiser_cloudroid"),
        "{graph:#?}"
    );
    Ok(())
}

/// A localiser in one ROS, and how it is installed on a robot.
struct Localiser {
    service: Service,
    package: &'static str,
    executable: &'static str,
    program: &'static str,
    argv: &'static [&'static str],
    /// The variable on which workspaces stand.
    workspaces: &'static str,
}

fn localiser(ros: RosVersion) -> Localiser {
    match ros {
        RosVersion::One => Localiser {
            service: LOCALISER,
            package: "localiser_py",
            executable: "localiser.py",
            program: "/opt/cloudroid/install/lib/localiser_py/localiser.py",
            argv: &["__name:=localiser"],
            workspaces: "CMAKE_PREFIX_PATH",
        },
        RosVersion::Two => Localiser {
            service: LOCALISER_TWO,
            package: "localiser_ros2",
            executable: "localiser",
            program: "/opt/cloudroid/install/lib/localiser_ros2/localiser",
            argv: &["--ros-args", "-r", "__node:=localiser"],
            workspaces: "AMENT_PREFIX_PATH",
        },
    }
}

/// A robot's name in the story of this ROS.
fn named(robot: &str, ros: RosVersion) -> String {
    format!("{robot}-{}", ros.number())
}

/// The definition of nav_msgs/OccupancyGrid without its header's.
fn grid(ros: RosVersion) -> String {
    match ros {
        RosVersion::One => GRID.to_owned(),
        RosVersion::Two => GRID.replace("\ntime ", "\nbuiltin_interfaces/Time "),
    }
}

const GRID: &str = "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data\n\
    ================================================================================\n\
    MSG: nav_msgs/MapMetaData\ntime map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n\
    geometry_msgs/Pose origin\n\
    ================================================================================\n\
    MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n\
    ================================================================================\n\
    MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n\
    ================================================================================\n\
    MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n";
const SCAN: &str = "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n\
    float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\n\
    float32[] intensities\n";
