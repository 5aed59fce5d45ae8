//! Packages of ROS 2 through rosbridge and through stubs. Bad links of stubs are covered in [`crate::failover`] and
//! [`crate::fallback`], for both versions of ROS.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use bytes::Bytes;
use nix::sys::signal::Signal;
use parking_lot::Mutex;
use ros::bus::{
    Bus, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome, Graph, NodeEntities, ParamValue, RosVersion, WireFormat,
};
use ros::schema::{ActionDef, Registry};
use serde_json::{Value, json};
use support::cable::{Cable, NetworkImpairment};
use support::daemon::Daemon;
use support::layout::MessageLayout;
use support::patience::{Deadline, scale, tell_patience, wait_for};
use support::people::{self, PeopleCamera};
use support::site::{NodeProcess, Site, string_in};
use support::world::{HERALD, SEER, world};
use support::{Verdict, binaries};
use tokio::sync::Notify;

use crate::crossing::{SETTLED, TRIED};
use crate::push::extract_install_space;

/// Maximum time for an answer that may never arrive; on an idle machine.
const MEANWHILE: Duration = Duration::from_secs(5);
const THE_HERALD: (&str, &str, &str) = ("herald", "herald", "herald");

fn has_service(service: &str) -> impl Fn(&Graph) -> bool {
    let service = service.to_owned();
    move |graph| graph.services.contains_key(&service)
}

/// Adds the node's output to an error.
fn with_log<T>(outcome: anyhow::Result<T>, node: &NodeProcess) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", node.output()))
}

fn contains(message: &[u8], text: &str) -> bool {
    String::from_utf8_lossy(message).contains(text)
}

pub fn a_workspace_is_pushed_and_asked_by_rosbridge() -> Verdict {
    let daemon = world().daemon_with(HERALD)?;
    let service = daemon.get_json("/api/v1/services/herald")?;
    let names = |what: &str| -> anyhow::Result<Vec<String>> {
        let all = service["interface"][what].as_array().context("a list")?;
        let names = all.iter().filter_map(|one| one["name"].as_str());
        Ok(names.map(str::to_owned).collect())
    };
    // Registrations that every node has are not part of a service's interface.
    ensure!(names("topics")? == ["/greeting", "/name"] && names("services")? == ["/greet"], "{service:#}");
    ensure!(names("actions")? == ["/count"], "{service:#}");
    ask_herald(&daemon, "herald")
}

/// A base of another distribution: other wheels for compiling interfaces and for running, and another Fast DDS.
pub fn a_workspace_runs_on_kilted_as_on_jazzy() -> Verdict {
    const BASE: &str = "bookworm-kilted-wheels";
    let daemon = world().ensure_shared()?;
    let arguments = ["--base", BASE, "--name", "kilted-herald", "--node", "herald/herald"];
    daemon.deployer().push("herald_ros2", &arguments)?.expect_success()?;
    let base = daemon.deployer().run_json(&["bases", "show", BASE])?;
    ensure!(base["ros_packages"]["rclpy"].as_str().is_some_and(|version| version.starts_with("9.")), "{base:#}");
    ask_herald(&daemon, "kilted-herald")
}

/// Calls a herald's service, hears its topic and sends it a goal, as a robot does by rosbridge.
fn ask_herald(daemon: &Daemon, service: &str) -> Verdict {
    let mut robot = daemon.robot(&format!("{service}?robot={service}-asked"))?;
    let greeted = robot.call("/greet", json!({"name": "robot"}))?;
    let greeting = &greeted["values"]["greeting"];
    ensure!(greeting["text"] == "Hello, robot" && greeting["wide"] == "HELLO, ROBOT", "{greeted}");
    robot.send(json!({"op": "subscribe", "topic": "/greeting", "qos": {"reliability": "reliable", "depth": 5}}))?;
    robot.send(json!({"op": "advertise", "topic": "/name", "type": "std_msgs/msg/String"}))?;
    let crowd = json!({"op": "publish", "topic": "/name", "msg": {"data": "crowd"}});
    let greeted = robot.send_until(&crowd, "a greeting", |told| told["topic"] == "/greeting")?;
    ensure!(greeted["msg"]["text"] == "Hello, crowd", "{greeted}");
    robot.send(json!({"op": "send_action_goal", "id": "goal", "action": "/count",
        "action_type": "herald_msgs/action/Count", "args": {"to": 3}, "feedback": true}))?;
    for at in 1..=3 {
        let told = robot.wait_for("feedback", |told| told["op"] == "action_feedback")?;
        ensure!(told["values"]["at"] == at, "{told}");
    }
    let told = robot.wait_for("a result", |told| told["op"] == "action_result")?;
    ensure!(told["values"]["counted"] == json!([1, 2, 3]) && told["result"] == true, "{told}");
    robot.leave()
}

pub fn a_prebuilt_space_is_served_with_its_interfaces() -> Verdict {
    let daemon = world().daemon_with(HERALD)?;
    let place = tempfile::tempdir()?;
    let space = extract_install_space(&daemon, "herald", place.path())?;
    let space = space.to_string_lossy();
    let words = ["push", &*space, "--name", "prebuilt-herald", "--node", "herald/herald"];
    daemon.deployer().run(&words)?.expect_success()?;
    let mut robot = daemon.robot("prebuilt-herald?robot=herald-of-a-space")?;
    let greeted = robot.call("/greet", json!({"name": "robot"}))?;
    let text = &greeted["values"]["greeting"]["text"];
    ensure!(text == "Hello, robot", "{greeted}");
    robot.leave()
}

pub fn two_programs_of_several_nodes_have_nodes_of_their_own_names() -> Verdict {
    let daemon = world().ensure_shared()?;
    let arguments = ["--name", "duets", "--node", "duet", "--node", "duet"];
    daemon.deployer().push("duet_ros2", &arguments)?.expect_success()?;
    let service = daemon.get_json("/api/v1/services/duets")?;
    let topics = service["interface"]["topics"].as_array();
    let topics = topics.context("a list")?.iter();
    let mut topics: Vec<&str> = topics.filter_map(|one| one["name"].as_str()).collect();
    topics.sort();
    let songs = ["/alto/song", "/alto_2/song", "/tenor/song", "/tenor_2/song"];
    ensure!(topics == songs, "{service:#}");
    let mut robot = daemon.robot("duets?robot=listener")?;
    robot.subscribe("/tenor_2/song")?;
    let heard = robot.next_message_on("/tenor_2/song")?;
    ensure!(heard["data"] == "tenor_2", "{heard}");
    robot.leave()?;
    // On a robot each of them is a node with the name that its program gives, unless a remapping rule for that node
    // sets another one.
    let site = Site::with_ros(RosVersion::Two)?;
    let app = site.join("/app")?;
    let overlay = site.install_stub(&daemon, "duets", "local = \"none\"\n")?;
    let server = format!("ws://{}", daemon.address);
    let environment = [("CLOUDROID_SERVER", &*server), ("CLOUDROID_ROBOT", "choir")];
    for (argv, second) in [(&[][..], "tenor"), (&["--ros-args", "-r", "tenor:__node:=bass"], "bass")] {
        let mut stub = site.start_installed_with_environment(&environment, &overlay, "duet_ros2", "duet", argv)?;
        for name in ["alto", second] {
            let node = format!("/{name}");
            let mut songs = site.subscribe(&app, &format!("{node}/song"))?;
            let song = with_log(site.next_message(&mut songs), &stub)?;
            ensure!(contains(&song.bytes, name) && song.publisher.node() == node, "{song:?}\n{}", stub.output());
            let parameters = format!("{node}/get_parameters");
            let graph = with_log(site.wait_for_graph(&*app, &parameters, has_service(&parameters)), &stub)?;
            ensure!(graph.services[&parameters] == node, "{graph:#?}");
            let asked = ["use_sim_time".to_owned()];
            let held = app.node_parameters()?.get(&node, &asked);
            let held = with_log(site.runtime.block_on(held).map_err(Into::into), &stub)?;
            ensure!(held == [Some(ParamValue::Bool(false))], "{node}: {held:?}");
        }
        stub.signal(Signal::SIGINT)?;
        stub.wait_for_exit()?;
    }
    Ok(())
}

pub fn nodes_stay_in_the_namespaces_that_their_programs_give_them() -> Verdict {
    let daemon = world().ensure_shared()?;
    let arguments = [
        "--name",
        "spotters",
        "--node",
        "spotter",
        "--node",
        "spotters",
        "--node",
        // As launch sets the name of a node.
        "lookout --ros-args -r __node:=seeker",
        "--param",
        "~what=a cat",
    ];
    let push = daemon.deployer().push("spotter_ros2", &arguments)?;
    push.expect_success()?;
    let service = daemon.get_json("/api/v1/services/spotters")?;
    let topics = service["interface"]["topics"].as_array();
    let topics = topics.context("a list")?.iter();
    let mut topics: Vec<&str> = topics.filter_map(|one| one["name"].as_str()).collect();
    topics.sort();
    let nodes = [("/camera", "detector"), ("/left", "detector"), ("/right", "detector"), ("/tower", "seeker")];
    let all = nodes.map(|(above, _)| [format!("{above}/found"), format!("{above}/image")]);
    ensure!(topics == all.concat(), "{service:#}");
    let mut robot = daemon.robot("spotters?robot=asked")?;
    for (above, name) in nodes {
        let (image, found) = (format!("{above}/image"), format!("{above}/found"));
        robot.subscribe(&found)?;
        robot.send(json!({"op": "advertise", "topic": image, "type": "std_msgs/msg/String"}))?;
        let view = json!({"op": "publish", "topic": image, "msg": {"data": "view"}});
        let heard = robot.send_until(&view, "what it finds", |told| told["topic"] == *found)?;
        let expected = format!("a cat in view by {above}/{name}");
        ensure!(heard["msg"]["data"] == expected, "{heard}");
    }
    robot.leave()?;
    // On a robot each of them is in the namespace of its program, unless a remapping rule sets another one.
    let site = Site::with_ros(RosVersion::Two)?;
    let app = site.join("/app")?;
    let overlay = site.install_stub(&daemon, "spotters", "local = \"none\"\n")?;
    let server = format!("ws://{}", daemon.address);
    let environment = [("CLOUDROID_SERVER", &*server), ("CLOUDROID_ROBOT", "spots")];
    for (argv, above) in [(&[][..], "/camera"), (&["--ros-args", "-r", "__ns:=/front"], "/front")] {
        let mut stub =
            site.start_installed_with_environment(&environment, &overlay, "spotter_ros2", "spotter", argv)?;
        let node = format!("{above}/detector");
        let images = site.advertise_strings(&app, &format!("{above}/image"), false)?;
        let mut finds = site.subscribe(&app, &format!("{above}/found"))?;
        with_log(site.wait_for_subscribers(&*images, 1), &stub)?;
        with_log(site.wait_for_publishers(&finds, 1), &stub)?;
        images.publish(string_in(WireFormat::Cdr, "view"));
        let found = with_log(site.next_message(&mut finds), &stub)?;
        let words = format!("a cat in view by {node}");
        ensure!(contains(&found.bytes, &words) && found.publisher.node() == node, "{found:?}\n{}", stub.output());
        stub.signal(Signal::SIGINT)?;
        stub.wait_for_exit()?;
    }
    Ok(())
}

/// Returns the definition of the herald's action.
fn count_action() -> anyhow::Result<Arc<ActionDef>> {
    let registry = Registry::for_version(RosVersion::Two);
    let text = "uint32 to\n---\nuint32[] counted\n---\nuint32 at\n";
    registry.insert("herald_msgs/action/Count", text)?;
    Ok(registry.action("herald_msgs/action/Count")?)
}

/// Feedback and end of a goal.
#[derive(Default)]
struct GoalEventRecorder {
    feedback: Mutex<usize>,
    end: Mutex<Option<Result<GoalEnd, GoalError>>>,
    ended: Notify,
}

impl GoalEvents for GoalEventRecorder {
    fn on_feedback(&self, _feedback: Bytes) {
        *self.feedback.lock() += 1;
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        *self.end.lock() = Some(end);
        self.ended.notify_one();
    }
}

/// Sends the herald a goal and checks its result.
fn expect_count(site: &Site, app: &dyn Bus, action: &str, to: u32) -> Verdict {
    let events = Arc::new(GoalEventRecorder::default());
    let heard = Arc::clone(&events);
    let _runtime = site.runtime.enter();
    let client = app.action_client(action, &count_action()?)?;
    let goal = MessageLayout::new(RosVersion::Two).u32(to).finish();
    client.send_goal("goal", goal, events);
    site.runtime.block_on(async {
        let ended = wait_for(heard.ended.notified());
        ended.await.context("a result should come")
    })?;
    let end = heard.end.lock().take().context("an end")??;
    let mut expected = MessageLayout::new(RosVersion::Two);
    expected.u32(to);
    for number in 1..=to {
        expected.u32(number);
    }
    ensure!(end.outcome == GoalOutcome::Succeeded && end.result == expected.finish(), "{end:?}");
    ensure!(*heard.feedback.lock() == to as usize);
    Ok(())
}

pub fn a_herald_in_the_cloud_is_a_node_of_the_robot() -> Verdict {
    let daemon = world().daemon_with(HERALD)?;
    let site = Site::with_ros(RosVersion::Two)?;
    let app = site.join("/app")?;
    let argv =
        ["--ros-args", "-r", "__node:=crier", "-r", "__ns:=/front", "-r", "name:=/who", "-p", "salutation:=Good day"];
    let mut stub = site.start_stub(&daemon, THE_HERALD, "ros2-herald", &argv)?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/front/greet")), &stub)?;
    // An input topic, remapped; an output topic; both with the original's names and types.
    let names = site.advertise_strings(&app, "/who", false)?;
    let mut greetings = site.subscribe(&app, "/front/greeting")?;
    site.wait_for_subscribers(&*names, 1)?;
    site.wait_for_publishers(&greetings, 1)?;
    names.publish(string_in(WireFormat::Cdr, "robot"));
    let greeting = with_log(site.next_message(&mut greetings), &stub)?;
    ensure!(contains(&greeting.bytes, "Good day, robot"), "{greeting:?}");
    ensure!(
        greeting.wire_type.name == "herald_msgs/msg/Greeting" && greeting.publisher.node() == "/front/crier",
        "{greeting:?}"
    );
    // A service and a parameter of the node in the cloud.
    let run = |future| site.runtime.block_on(future);
    let parameters = app.node_parameters()?;
    let asked = ["salutation".to_owned()];
    let held = run(parameters.get("/front/crier", &asked))?;
    ensure!(held == [Some(ParamValue::String("Good day".into()))], "{held:?}");
    let change = ("salutation".to_owned(), Some(ParamValue::String("Hi".into())));
    let set = site.runtime.block_on(parameters.set("/front/crier", vec![change]))?;
    ensure!(set == [Ok(())], "{set:?}");
    let request = MessageLayout::new(RosVersion::Two).text("lab").finish();
    let greeted = site.call_service(&app, "/front/greet", &request)?;
    ensure!(contains(&greeted, "Hi, lab"), "{greeted:?}");
    with_log(expect_count(&site, &*app, "/front/count", 4), &stub)?;
    // The signal with which ros2 launch ends nodes.
    stub.signal(Signal::SIGINT)?;
    let status = stub.wait_for_exit()?;
    ensure!(status.code() == Some(0), "{status}: {}", stub.output());
    site.wait_for_graph(&app, "an empty graph", |graph| !graph.nodes.contains_key("/front/crier"))?;
    Ok(())
}

/// Waits until a node has the wanted endpoints; returns all of its endpoints.
fn wait_for_ends(
    site: &Site,
    watcher: &Arc<dyn Bus>,
    node: &str,
    wanted: impl Fn(&NodeEntities) -> bool,
) -> anyhow::Result<NodeEntities> {
    let graph = site.wait_for_graph(watcher, "the node's ends", |graph| graph.ends.get(node).is_some_and(&wanted))?;
    let mut ends = graph.ends[node].clone();
    // The history depth is local to each endpoint, and discovery need not include it.
    for (_, qos) in ends.publishers.values_mut().chain(ends.subscribers.values_mut()) {
        qos.depth = 0;
    }
    Ok(ends)
}

pub fn the_robot_s_graph_is_the_original_s() -> Verdict {
    let daemon = world().daemon_with(HERALD)?;
    let node = "/herald";
    let original = {
        let site = Site::with_ros(RosVersion::Two)?;
        let program = "/opt/cloudroid/install/lib/herald/herald";
        let prefix = site.install_original(&daemon, "herald", ("herald", "herald"), program)?;
        let _original = site.start_installed(&prefix, "herald", "herald", &[])?;
        let watcher = site.join("/watcher")?;
        // The parts of its action are created last.
        wait_for_ends(&site, &watcher, node, |ends| {
            ends.publishers.contains_key("/count/_action/status")
                && ends.services.contains_key("/count/_action/get_result")
                && ends.services.contains_key("/herald/get_parameters")
        })?
    };
    let site = Site::with_ros(RosVersion::Two)?;
    let stub = site.start_stub(&daemon, THE_HERALD, "ros2-graph", &[])?;
    let watcher = site.join("/watcher")?;
    let linked = wait_for_ends(&site, &watcher, node, |ends| {
        ends.publishers.len() >= original.publishers.len()
            && ends.subscribers.len() >= original.subscribers.len()
            && ends.services.len() >= original.services.len()
    });
    let linked = with_log(linked, &stub)?;
    ensure!(
        linked.publishers == original.publishers
            && linked.subscribers == original.subscribers
            && linked.services == original.services,
        "the original has {original:#?}, the stub {linked:#?}"
    );
    Ok(())
}

pub fn an_application_of_rclpy_asks_the_cloud() -> Verdict {
    let daemon = world().daemon_with(SEER)?;
    let site = Site::with_ros(RosVersion::Two)?;
    let cable = Cable::new(&daemon.address)?;
    let stub = people::installed_stub(&site, &daemon, &cable, (SEER.name, "ros2-rclpy"), "local = \"none\"")?;
    let mut command = Command::new(binaries::ros2().join("bin/python"));
    command.arg(binaries::checkout().join("tests/robots/application_ros2.py"));
    site.system.configure(&mut command);
    tell_patience(&mut command).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut application = command.spawn()?;
    let mut told = String::new();
    BufReader::new(application.stdout.as_mut().context("piped")?).read_line(&mut told)?;
    let explained = support::wait_until("whom the stub cannot reach", || {
        let told = daemon.get_json("/api/v1/robots/ros2-rclpy/explain")?;
        let causes = told["causes"].to_string();
        Ok(causes.contains("between /application and /people_detect").then_some(causes.clone()).ok_or(causes))
    });
    let ended = application.wait_with_output()?;
    let told =
        with_log(serde_json::from_str::<Value>(&told).with_context(|| format!("{told}{}", ended.status)), &stub)?;
    let explained = explained?;
    ensure!(
        explained.contains(
            "durability: the publisher offers volatile, the subscriber asks for transient_local (publisher: reliable, \
             volatile; subscriber: reliable, transient_local)"
        ),
        "{explained}"
    );
    for number in 1..=3 {
        let left = f64::from(5 * number);
        let corners = json!([[left, 10.0], [left + 7.0, 19.0]]);
        ensure!(told["answers"][number.to_string()] == corners, "{told:#}");
    }
    ensure!(told["before"] == false && told["accepted"] == true, "{told:#}");
    let image = json!(["sensor_msgs/msg/Image"]);
    ensure!(told["subscribes"]["/image"] == image, "{told:#}");
    // The original requests images with this quality of service.
    ensure!(told["reliable"] == json!(["BEST_EFFORT"]), "{told:#}");
    let found = json!(["geometry_msgs/msg/PolygonStamped"]);
    ensure!(told["publishes"]["/people_detect/found"] == found, "{told:#}");
    Ok(())
}

/// Returns whether the herald had greeted this name before: the last field of its response, which CDR pads to four
/// bytes.
fn was_greeted(answer: &[u8]) -> Option<bool> {
    let at = answer.len().checked_sub(4)?;
    answer.get(at).map(|known| *known == 1)
}

fn has_all(now: &NodeEntities, before: &NodeEntities) -> bool {
    fn contains<T: PartialEq>(now: &BTreeMap<String, T>, before: &BTreeMap<String, T>) -> bool {
        before.iter().all(|(name, of)| now.get(name) == Some(of))
    }
    contains(&now.publishers, &before.publishers)
        && contains(&now.subscribers, &before.subscribers)
        && contains(&now.services, &before.services)
        && contains(&now.clients, &before.clients)
}

pub fn a_node_lives_on_when_the_daemon_starts_again() -> Verdict {
    let setup = world().setup("ros2-restarted");
    let daemon = setup.start()?;
    let push = daemon.deployer().push("herald_ros2", HERALD.arguments)?;
    push.expect_success()?;
    let address = daemon.address.clone();
    let site = Site::with_ros(RosVersion::Two)?;
    let app = site.join("/app")?;
    let stub = site.start_stub(&daemon, THE_HERALD, "ros2-again", &[])?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/greet")), &stub)?;
    let request = MessageLayout::new(RosVersion::Two).text("lab").finish();
    let first = with_log(site.call_service(&app, "/greet", &request), &stub)?;
    ensure!(was_greeted(&first) == Some(false), "{first:?}");
    let before = app.graph().borrow().ends.get("/herald").cloned();
    let before = before.context("the node")?;
    let participants = |daemon: &Daemon| -> anyhow::Result<BTreeSet<String>> {
        let servant = daemon.servant_of("herald", "ros2-again")?;
        let id = servant["id"].as_str().context("an id")?;
        let left = std::fs::read(daemon.home.join(format!("servants/{id}/daemon.json")))?;
        let left: Value = serde_json::from_slice(&left)?;
        let earlier = left["earlier"].as_array().context("a list")?.iter();
        let own = left["own"].as_object().context("by node")?.values();
        Ok(earlier.chain(own).map(Value::to_string).collect())
    };
    let earlier = participants(&daemon)?;
    daemon.kill()?;
    let daemon = setup.listen(&address).start()?;
    // A call made meanwhile is answered or lost, which DDS cannot report to the caller; the next one is answered.
    let meanwhile = app.call("/greet", request.clone(), scale(MEANWHILE));
    match site.runtime.block_on(meanwhile) {
        Ok(_) | Err(BusError::Timeout { .. }) => {}
        Err(other) => return Err(other.into()),
    }
    let again = with_log(site.call_service(&app, "/greet", &request), &stub)?;
    ensure!(was_greeted(&again) == Some(true), "it has forgotten what it did: {again:?}\n{}", stub.output());
    // The endpoints that had been discovered by then; more may have been discovered since.
    site.wait_for_graph(&app, "all that the node had", |graph| {
        graph.ends.get("/herald").is_some_and(|now| has_all(now, &before))
    })?;
    // The node was told that the participants of the previous daemon are gone, so it can discover the new ones.
    let now = participants(&daemon)?;
    ensure!(!earlier.is_empty() && earlier.is_subset(&now) && earlier != now, "{earlier:?} {now:?}");
    drop(stub);
    daemon.deployer().run(&["stop", "--all"])?;
    daemon.stop()?;
    Ok(())
}

/// Returns the pixels of a wall with a moving shadow as a camera sees it, with two bits of noise. A codec without
/// knowledge of images cannot compress them much.
fn wall_pixels(number: u32, (width, height): (u32, u32)) -> Vec<u8> {
    let mut noise = number;
    let mut pixels = Vec::new();
    for row in 0..height {
        for column in 0..width {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let bits = |shift: u32| (noise >> shift & 3) as u8;
            let shade = (row / 2 + (column + number).abs_diff(width / 2) / 3) as u8;
            pixels.extend([shade + bits(28), shade / 2 + bits(24), 200 - shade / 2 + bits(20)]);
        }
    }
    pixels
}

pub fn pictures_are_made_smaller_where_the_link_is_slow() -> Verdict {
    const SIZE: (u32, u32) = (320, 240);
    let daemon = world().daemon_with(SEER)?;
    for (codec, smaller) in [("auto", true), ("none", false)] {
        let cable = Cable::new(&daemon.address)?;
        cable.degrade(NetworkImpairment::SLOW)?;
        let site = Site::with_ros(RosVersion::Two)?;
        let robot = format!("ros2-pictures-{codec}");
        let settings = format!("local = \"none\"\ncodec = \"{codec}\"");
        let stub = people::stub(&site, &daemon, &cable, (SEER.name, &robot), &settings, &[])?;
        let mut camera = with_log(PeopleCamera::new(&site, 10), &stub)?;
        // The link first measures its rate and tries the codecs.
        let size = u64::from(SIZE.0 * SIZE.1 * 3);
        let mut carried: Vec<u64> = Vec::new();
        let settled = |carried: &[u64]| {
            let last = &carried[carried.len().saturating_sub(SETTLED)..];
            let is = |bytes: &u64| {
                if smaller { *bytes < size * 2 / 5 } else { *bytes >= size }
            };
            last.len() == SETTLED && last.iter().all(is)
        };
        let deadline = Deadline::begin();
        let mut number = 0;
        while number < TRIED || !settled(&carried) {
            deadline.check(|| format!("codec {codec}: pictures of {size} bytes took {carried:?}"))?;
            number += 1;
            let before = cable.transferred_bytes()?.0;
            let pixels = wall_pixels(number, SIZE);
            let picture = people::picture_of(RosVersion::Two, number, SIZE, &pixels);
            camera.image.publish(picture);
            // The node examines every pixel and reports where it is bright.
            let found = with_log(site.next_message(&mut camera.found), &stub)?;
            ensure!(people::number(&found) == Some(number), "{found:?}");
            carried.push(cable.transferred_bytes()?.0 - before);
        }
    }
    Ok(())
}
