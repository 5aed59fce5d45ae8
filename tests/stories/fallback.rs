//! A stub with default settings: while the server is unavailable the original takes over, with everything that it
//! needs.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{Bus, Publisher, QosProfile, RosVersion, SerializedMessage, Subscription, WireType};
use support::Verdict;
use support::cable::{Cable, NetworkImpairment};
use support::cutter::Cutter;
use support::daemon::Daemon;
use support::layout::MessageLayout;
use support::patience::Deadline;
use support::people;
use support::site::{NodeProcess, Site};
use support::world::{LOCALISER, LOCALISER_TWO, StoryService, world};

/// Duration of a link failure that is over before the original would take over: not a time limit, and so not scaled
/// with the load.
const BLIP: Duration = Duration::from_millis(50);
pub const SILENT: NetworkImpairment = NetworkImpairment { rate: 100_000, delay: 1, jitter: 0, loss: 1.0, limit: 1000 };

/// Map of a hall with an interior wall: `#` is a wall.
const HALL: [&str; 8] =
    ["##########", "#........#", "#........#", "#....#####", "#........#", "#........#", "#........#", "##########"];
const RESOLUTION: f32 = 0.5;

/// A robot with a map server and a laser, and a subscriber to its position.
pub struct MapRobot {
    // Fields are in the order in which they must be dropped.
    poses: Subscription,
    scan: Box<dyn Publisher>,
    _map: Box<dyn Publisher>,
    _server: Arc<dyn Bus>,
    node: Arc<dyn Bus>,
    pub site: Site,
    sent: u32,
}

/// Serializes the nav_msgs/OccupancyGrid.
fn map_message(ros: RosVersion) -> Bytes {
    let mut out = MessageLayout::new(ros);
    out.header(1, "map").u32(0).u32(0);
    out.f32(RESOLUTION).u32(10).u32(8);
    for number in [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] {
        out.f64(number);
    }
    let cells = HALL.concat();
    let cells = cells.bytes().map(|cell| if cell == b'#' { 100 } else { 0 });
    out.bytes(&cells.collect::<Vec<u8>>()).finish()
}

/// Returns the distance to the next wall in four directions from a cell, in metres.
fn wall_distances((x, y): (usize, usize)) -> [f32; 4] {
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

/// Serializes a sensor_msgs/LaserScan whose stamp is its number.
fn scan_message(ros: RosVersion, number: u32, cell: (usize, usize)) -> Bytes {
    let mut out = MessageLayout::new(ros);
    out.header(number, "laser");
    for number in [0.0, 4.71, 1.57, 0.0, 0.1, 0.0, 10.0] {
        out.f32(number);
    }
    out.u32(4);
    for range in wall_distances(cell) {
        out.f32(range);
    }
    out.u32(0).finish()
}

/// Offset of the pose in a geometry_msgs/PoseStamped: a position, followed by an orientation.
fn pose_offset(pose: &SerializedMessage) -> usize {
    pose.bytes.len() - 56
}

impl MapRobot {
    pub fn new(ros: RosVersion) -> anyhow::Result<Self> {
        let site = Site::with_ros(ros)?;
        let (server, node) = (site.join("/map_server")?, site.join("/laser")?);
        let advertise = |node: &dyn Bus, topic: &str, latch: bool, of: WireType| {
            let qos = QosProfile::keep_last(10).latching(latch);
            site.runtime.block_on(node.advertise(topic, of, qos))
        };
        let grid = people::type_of(ros, "nav_msgs/OccupancyGrid", &grid_definition(ros))?;
        let map_publisher = advertise(&*server, "/map", true, grid)?;
        // Once, long before anyone subscribes.
        map_publisher.publish(map_message(ros));
        let laser = people::type_of(ros, "sensor_msgs/LaserScan", SCAN)?;
        let scan = advertise(&*node, "/scan", false, laser)?;
        let poses = site.subscribe_latched(&node, "/localiser/pose")?;
        Ok(Self { poses, scan, _map: map_publisher, _server: server, node, site, sent: 0 })
    }

    /// Publishes a scan from a cell.
    fn publish_scan(&self, number: u32, cell: (usize, usize)) {
        let ros = self.site.system.version();
        self.scan.publish(scan_message(ros, number, cell));
    }

    /// Starts a stub with its original, as installed on a robot.
    fn start_stub(&self, daemon: &Daemon, robot: &str, server: &str) -> anyhow::Result<NodeProcess> {
        self.start_stub_with_config(daemon, robot, server, "")
    }

    /// Starts a stub with these lines in `stub.toml`.
    fn start_stub_with_config(
        &self,
        daemon: &Daemon,
        robot: &str,
        server: &str,
        settings: &str,
    ) -> anyhow::Result<NodeProcess> {
        let of = localiser(self.site.system.version());
        let service = of.service.name;
        let overlay = self.site.install_stub(daemon, service, settings)?;
        let original = (of.package, of.executable);
        let workspace: PathBuf = self.site.install_original(daemon, service, original, of.program)?;
        let prefixes = format!("{}:{}", overlay.display(), workspace.display());
        let server = format!("ws://{server}");
        let variables = [
            (of.workspaces, prefixes.as_str()),
            ("CLOUDROID_SERVER", server.as_str()),
            ("CLOUDROID_ROBOT", robot),
            ("NO_COLOR", "1"),
        ];
        self.site.start_installed_with_environment(&variables, &overlay, of.package, of.executable, of.argv)
    }

    /// Publishes scans from a cell until one is answered, and checks the answer.
    pub fn expect_localised(&mut self, cell: (usize, usize), stub: &NodeProcess) -> Verdict {
        let wanted = [cell.0, cell.1].map(|at| (at as f64 + 0.5) * f64::from(RESOLUTION));
        let ros = self.site.system.version();
        let (sent, scans) = (&mut self.sent, &self.scan);
        let ask = || {
            *sent += 1;
            scans.publish(scan_message(ros, *sent, cell));
            Ok(())
        };
        // Scans from an earlier cell may still be answered.
        let is_there = |pose: &SerializedMessage| -> anyhow::Result<bool> {
            let place = pose_offset(pose);
            let number = |at: usize| {
                let bytes = pose.bytes[place + at..place + at + 8].try_into();
                bytes.map(f64::from_le_bytes)
            };
            Ok([number(0)?, number(8)?] == wanted)
        };
        let found = self.site.ask_until(&mut self.poses, ask, is_there);
        found.map(drop).with_context(|| format!("{cell:?} should be found:\n{}", stub.output()))
    }
}

/// Waits until the stub has logged these words a number of times.
pub fn wait_for_log(stub: &NodeProcess, words: &str, times: usize) -> Verdict {
    stub.wait_for_output_times(words, times)
}

/// Waits until a message of a topic contains these words.
fn wait_for_message_with(site: &Site, subscription: &mut Subscription, words: &str) -> Verdict {
    let deadline = Deadline::begin();
    loop {
        let message = site.next_message(subscription)?;
        let said = String::from_utf8_lossy(&message.bytes).into_owned();
        if said.contains(words) {
            return Ok(());
        }
        deadline.check(|| format!("{words:?}: {said}"))?;
    }
}

pub fn an_untouched_stub_finds_its_way_when_the_cable_is_cut_and_hands_back(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(localiser(ros).service)?;
    let cable = Cable::new(&daemon.address)?;
    let mut robot = MapRobot::new(ros)?;
    let stub = robot.start_stub(&daemon, &robot_name("fallback-cut", ros), &cable.server.to_string())?;
    wait_for_log(&stub, "linked to", 1)?;
    robot.expect_localised((2, 4), &stub)?;
    let mut diagnostics = robot.site.subscribe(&robot.node, "/diagnostics")?;
    let (over, back) = ("the local original answers, too why=LinkDown", "the cloud answers alone why=LinkUp");
    // On a slow machine the original may already have taken over before the first link.
    wait_for_message_with(&robot.site, &mut diagnostics, "the cloud answers (no response time set")?;
    let before = stub.output().matches(over).count();
    for round in 1..=2 {
        cable.degrade(SILENT)?;
        wait_for_log(&stub, over, before + round)?;
        // The original's process has just started: it knows these walls from the latched map only.
        robot.expect_localised((6, 2), &stub)?;
        wait_for_message_with(&robot.site, &mut diagnostics, "the link is down, the local original answers")?;
        let words = "if the original is installed on the robot, it takes over after 3.0 s";
        let name = robot_name("fallback-cut", ros);
        let path = format!("/api/v1/robots/{name}/explain");
        daemon.wait_for(&path, words, |explained| explained["causes"].to_string().contains(words).then_some(()))?;
        let explained = daemon.deployer().run(&["explain", &name])?;
        let explained = explained.expect_success()?.stdout;
        let words = "no response time set, fallback 3.0 s after the link is lost";
        ensure!(explained.contains(words), "{explained}");
        // A late subscriber gets the message latched by the original, not the cloud's last pose.
        let newcomer = robot.site.join(&format!("/newcomer{round}"))?;
        let mut late = robot.site.subscribe_latched(&newcomer, "/localiser/pose")?;
        let pose = robot.site.next_message(&mut late)?;
        let x = pose_offset(&pose);
        ensure!(pose.bytes[x..x + 8] == 3.25_f64.to_le_bytes(), "{pose:?}");
        cable.restore()?;
        wait_for_log(&stub, back, before + round)?;
        robot.expect_localised((1, 1), &stub)?;
        // The cloud's last pose has replaced the original's.
        let newcomer = robot.site.join(&format!("/later{round}"))?;
        let mut late = robot.site.subscribe_latched(&newcomer, "/localiser/pose")?;
        let pose = robot.site.next_message(&mut late)?;
        let x = pose_offset(&pose);
        ensure!(pose.bytes[x..x + 8] == 0.75_f64.to_le_bytes(), "{pose:?}");
    }
    // Reported once the link is back.
    daemon.wait_for_event("that its original took over", |event| {
        event["robot"] == *robot_name("fallback-cut", ros) && event["kind"] == "local-takes-over"
    })?;
    Ok(())
}

pub fn a_server_that_was_never_reached_is_stood_in_for_until_it_comes(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(localiser(ros).service)?;
    let mut robot = MapRobot::new(ros)?;
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    way.cut(true);
    let stub = robot.start_stub(&daemon, &robot_name("fallback-never", ros), &way.server.to_string())?;
    wait_for_log(&stub, "no link: ", 1)?;
    robot.expect_localised((6, 6), &stub)?;
    wait_for_log(&stub, "the local original answers, too why=LinkDown", 1)?;
    ensure!(!stub.output().contains("linked to"), "{}", stub.output());
    way.cut(false);
    wait_for_log(&stub, "the cloud answers alone why=LinkUp", 1)?;
    wait_for_log(&stub, "the local original is stopped why=LinkUp", 1)?;
    robot.expect_localised((1, 1), &stub)
}

pub fn a_promise_holds_without_a_server_too_until_it_comes(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(localiser(ros).service)?;
    let mut robot = MapRobot::new(ros)?;
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    way.cut(true);
    // Requests cannot start before a node has registered the topics.
    let settings = "desire = 20.0\nmax = 20.0\nfallback_after = 1.0\n";
    let server = way.server.to_string();
    let stub = robot.start_stub_with_config(&daemon, &robot_name("fallback-promise", ros), &server, settings)?;
    wait_for_log(&stub, "the local original answers, too why=LinkDown", 1)?;
    robot.expect_localised((6, 6), &stub)?;
    ensure!(!stub.output().contains("linked to"), "{}", stub.output());
    way.cut(false);
    wait_for_log(&stub, "linked to", 1)?;
    // Late answers have lowered the trust in the cloud; requests are made until it is restored.
    let deadline = Deadline::begin();
    while !stub.output().contains("the local original is stopped") {
        robot.expect_localised((1, 1), &stub)?;
        deadline.check(|| stub.output())?;
    }
    robot.expect_localised((2, 4), &stub)
}

pub fn a_blip_of_the_link_starts_nothing_and_loses_nothing(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(localiser(ros).service)?;
    let mut robot = MapRobot::new(ros)?;
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    // One late request would start the original, and nothing is late within five minutes.
    let settings = "desire = 300.0\nmax = 300.0\nfallback_after = 300.0\nthreshold = 4.0\ninitial = 5.0\ncap = 6.0\n";
    let server = way.server.to_string();
    let stub = robot.start_stub_with_config(&daemon, &robot_name("fallback-blip", ros), &server, settings)?;
    wait_for_log(&stub, "linked to", 1)?;
    robot.site.wait_for_subscribers(&*robot.scan, 1)?;
    robot.expect_localised((2, 4), &stub)?;
    for round in 0..20_u32 {
        let number = 1_000_000 + round;
        // In even rounds a request is in progress when the link is lost, in odd rounds it is made while there is no
        // link.
        if round % 2 == 0 {
            robot.publish_scan(number, (1, 1));
        }
        way.cut(true);
        std::thread::sleep(BLIP);
        if round % 2 == 1 {
            robot.publish_scan(number, (1, 1));
        }
        way.cut(false);
        loop {
            let pose = robot.site.next_message(&mut robot.poses);
            let pose = pose.with_context(|| format!("scan {number}:\n{}", stub.output()))?;
            let answered = people::number(&pose).context("a stamp")?;
            if answered == number {
                break;
            }
            // Several scans were published before the first round.
            ensure!(round == 0 && answered < 1_000_000, "{answered} came again");
        }
    }
    let said = stub.output();
    ensure!(said.contains("was lost"), "it was not cut: {said}");
    ensure!(!said.contains("the local original is started"), "{said}");
    let path = format!("/api/v1/robots/{}/explain", robot_name("fallback-blip", ros));
    // All requests were answered; they are counted once the stub has determined which output answers which input.
    let link = daemon.wait_for(&path, "requests that are told", |explained| {
        let link = &explained["servants"][0]["links"][0];
        (link["requests"].as_u64() >= Some(1)).then(|| link.clone())
    })?;
    ensure!(link["late"] == 0 && link["local"] == 0, "{link:#}");
    Ok(())
}

pub fn an_untouched_stub_can_be_told_to_leave_the_original_alone(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(localiser(ros).service)?;
    let robot = MapRobot::new(ros)?;
    let (name, server) = (robot_name("fallback-none", ros), daemon.address.clone());
    let stub = robot.start_stub_with_config(&daemon, &name, &server, "local = \"none\"\n")?;
    wait_for_log(&stub, "linked to", 1)?;
    let explained = daemon.deployer().run_json(&["explain", &name])?;
    let link = &explained["servants"][0]["links"][0];
    ensure!(link["fallback_after"].is_null(), "{explained:#}");
    let graph = robot.node.graph().borrow().clone();
    ensure!(!graph.nodes.contains_key("/localiser_cloudroid"), "{graph:#?}");
    Ok(())
}

/// A localiser for one version of ROS, and its installation on a robot.
pub struct Localiser {
    pub service: StoryService,
    pub package: &'static str,
    pub executable: &'static str,
    pub program: &'static str,
    pub argv: &'static [&'static str],
    /// Environment variable that lists workspaces.
    pub workspaces: &'static str,
}

pub fn localiser(ros: RosVersion) -> Localiser {
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

/// Returns a robot name that is unique for this version of ROS.
fn robot_name(robot: &str, ros: RosVersion) -> String {
    format!("{robot}-{}", ros.number())
}

/// Returns the definition of nav_msgs/OccupancyGrid without that of its header.
fn grid_definition(ros: RosVersion) -> String {
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
