//! A robot of one ROS uses a service of the other by a stub, as if both were of the same. The servant's node, the
//! robot's nodes and its original are real ones of their ROS.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use bytes::Bytes;
use ros::bus::{
    ActionHandler, ActionServer, Bus, FailureReason, GoalEnd, GoalOutcome, ParamValue, Publisher, RosVersion,
};
use support::Verdict;
use support::cable::Cable;
use support::daemon::Daemon;
use support::layout::MessageLayout;
use support::patience::{Deadline, wait_for};
use support::ros_system::HasBus;
use support::site::{NodeProcess, Site, string_text};
use support::twins::{Twin, call_trigger};
use support::world::{PEOPLE, world};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use crate::calls::{TriggerService, serve_trigger};
use crate::crossing::{self, MessageBytes, advertise, find_type, is_same, point_message, wait_for_answer, with_log};
use crate::fallback::{MapRobot, SILENT, localiser, wait_for_log};
use crate::goals::{GoalApplication, action_type, last_number};

const NODE: &str = "/crossing";

/// Returns a robot's name that is unique for its ROS.
fn robot_name(ros: RosVersion, name: &str) -> String {
    format!("mixed-{name}-{}", ros.number())
}

/// Starts a stub of the crossing node of the other ROS, with these further words on its command line.
fn start_crossing(site: &Site, daemon: &Daemon, name: &str, more: &[&str]) -> anyhow::Result<NodeProcess> {
    let robot = site.system.version();
    let (service, executable) = crossing::service(robot.other());
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{}\"\nlocal = \"none\"\n",
        daemon.address,
        service.name,
        robot_name(robot, name)
    );
    let named: &[&str] = match robot {
        RosVersion::One => &["__name:=crossing"],
        RosVersion::Two => &["--ros-args", "-r", "__node:=crossing"],
    };
    site.start_stub_with_config(&toml, service.name, executable, &[named, more].concat())
}

/// Waits until the stub has registered what the node has, in the robot's ROS.
fn wait_until_ready(site: &Site, app: &(impl HasBus + ?Sized), stub: &NodeProcess) -> Verdict {
    let frames = format!("{NODE}/frames");
    let now = format!("{NODE}/now");
    let ready = site.wait_for_graph(app, "the node of the other ROS", |graph| match site.system.version() {
        RosVersion::One => graph.publishes(NODE, &frames) && graph.services.contains_key(&now),
        RosVersion::Two => graph.ends.get(NODE).is_some_and(|ends| {
            ends.publishers.contains_key(&frames)
                && ends.subscribers.contains_key("/tf_static")
                && ends.services.contains_key(&now)
        }),
    });
    with_log(ready.map(drop), stub)
}

/// Serializes a tf2_msgs/TFMessage with one transform, which has the current time.
fn transform(ros: RosVersion, child: &str) -> bytes::Bytes {
    let mut out = MessageLayout::new(ros);
    out.u32(1).header_at(link::clock::now(), "map").text(child);
    for _ in 0..7 {
        out.f64(0.0);
    }
    out.finish()
}

pub fn stamps_transforms_and_calls_cross(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(crossing::service(ros.other()).0)?;
    let site = Site::with_ros(ros)?;
    let transforms = find_type(ros, "tf2_msgs/TFMessage")?;
    // Latched by two publishers before the node exists.
    let mut fixed = Vec::new();
    for name in ["base", "laser"] {
        let node = site.join(&format!("/{name}"))?;
        let publisher = advertise(&site, &node, "/tf_static", &transforms, true)?;
        publisher.publish(transform(ros, name));
        fixed.push((node, publisher));
    }
    let app = site.join("/app")?;
    let stub = start_crossing(&site, &daemon, "all", &[])?;
    wait_until_ready(&site, &app, &stub)?;
    // A request and its answer, which has the request's stamp.
    let stamped = find_type(ros, "geometry_msgs/PointStamped")?;
    let points = advertise(&site, &app, "/crossing/point", &stamped, false)?;
    with_log(site.wait_for_subscribers(&*points, 1), &stub)?;
    let mut seen = site.subscribe(&app, "/crossing/seen")?;
    let sent = point_message(ros, link::clock::now());
    let answer = with_log(wait_for_answer(&site, || points.publish(sent.clone()), &mut seen), &stub)?;
    ensure!(is_same(&answer.bytes, &sent), "{answer:?} is not {sent:?}\n{}", stub.output());
    let (success, now) = with_log(call_trigger(&site, &app, "/crossing/now"), &stub)?;
    ensure!(success && now.parse::<u64>().is_ok(), "{now}");
    // Its answer is latched, and reaches whoever subscribes late.
    let moving = advertise(&site, &app, "/tf", &transforms, false)?;
    with_log(site.wait_for_subscribers(&*moving, 1), &stub)?;
    let wanted = "fixed:base fixed:laser moving:odometry";
    let mut frames = site.subscribe_latched(&app, "/crossing/frames")?;
    let say = || {
        moving.publish(transform(ros, "odometry"));
        Ok(())
    };
    let told = site.ask_until(&mut frames, say, |told| Ok(string_text(ros, &told.bytes, 0)? == wanted));
    with_log(told.map(drop), &stub)?;
    let newcomer = site.join("/newcomer")?;
    let mut late = site.subscribe_latched(&newcomer, "/crossing/frames")?;
    let told = with_log(site.next_message(&mut late), &stub)?;
    ensure!(string_text(ros, &told.bytes, 0)? == wanted, "{told:?}");
    Ok(())
}

pub fn an_action_is_carried_out_in_the_other_ros(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(crossing::service(ros.other()).0)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let stub = start_crossing(&site, &daemon, "action", &[])?;
    wait_until_ready(&site, &app, &stub)?;
    let sender = GoalApplication::for_node_of(ros.other(), &site, &app, &stub)?;
    sender.send_until_all_steps("three", 3)?;
    // A goal that never ends is cancelled while it is in progress.
    let long = sender.send("long", 1_000_000);
    sender.wait_for_steps(&long, 1)?;
    sender.client.cancel_goal("long");
    let (outcome, steps) = sender.wait_for_end(&long)?;
    ensure!(outcome == GoalOutcome::Canceled && steps < 0, "{outcome:?} {steps}\n{}", stub.output());
    // A simple action server of ROS 1 preempts a goal for a newer one; that of ROS 2 leaves it to its client.
    let older = sender.send("older", 1_000_000);
    sender.wait_for_steps(&older, 1)?;
    let newer = sender.send("newer", 2);
    if ros.other() == RosVersion::Two {
        sender.client.cancel_goal("older");
    }
    let (outcome, _) = sender.wait_for_end(&older)?;
    ensure!(outcome == GoalOutcome::Canceled, "{outcome:?}\n{}", stub.output());
    let end = sender.wait_for_end(&newer)?;
    ensure!(end == (GoalOutcome::Succeeded, 2), "{end:?}\n{}", stub.output());
    Ok(())
}

pub fn a_node_calls_a_robot_of_the_other_ros(ros: RosVersion) -> Verdict {
    let (here, there) = (Twin::caller(ros), Twin::caller(ros.other()));
    let daemon = world().daemon_with(there.service)?;
    let site = Site::with_ros(ros)?;
    let (app, server) = (site.join("/app")?, site.join("/server")?);
    let secret = TriggerService::new(ros, "42");
    let _serving = serve_trigger(&site, &server, "/robot/secret", secret)?;
    let robot = robot_name(ros, "caller");
    let stub = there.stub(&site, (&daemon.address, &robot), "", &here.argv("crossing", &[]))?;
    let ask = format!("{NODE}/ask");
    let ready = site.wait_for_graph(&app, "the node's service", |graph| graph.serves(&ask));
    with_log(ready.map(drop), &stub)?;
    let (success, said) = with_log(call_trigger(&site, &app, &ask), &stub)?;
    ensure!(success && said == "the robot says 42", "{said}\n{}", stub.output());
    Ok(())
}

/// A goal with its number of steps, or a cancel, without one.
type AskedGoal = (String, Option<i32>);

/// Passes goals on to the arm.
struct GoalQueue(mpsc::UnboundedSender<AskedGoal>);

impl ActionHandler for GoalQueue {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let steps = last_number(&goal).ok_or_else(|| FailureReason::new("it has no number"))?;
        let _ = self.0.send((id.to_owned(), Some(steps)));
        Ok(())
    }

    fn on_cancel(&self, id: &str) {
        let _ = self.0.send((id.to_owned(), None));
    }

    fn on_failed(&self, _reason: &str) {}
}

/// A server on the robot of the action that nodes of the other ROS look for.
struct Arm {
    ros: RosVersion,
    server: Box<dyn ActionServer>,
    asked: mpsc::UnboundedReceiver<AskedGoal>,
}

impl Arm {
    /// Starts to serve the action.
    fn start(site: &Site, node: &Arc<dyn Bus>) -> anyhow::Result<JoinHandle<()>> {
        let ros = site.system.version();
        let (asks, asked) = mpsc::unbounded_channel();
        let _runtime = site.runtime.enter();
        let of = action_type(ros, ros.other())?;
        let server = node.serve_action("/robot/act", &of, Arc::new(GoalQueue(asks)))?;
        Ok(site.runtime.spawn(Self { ros, server, asked }.work()))
    }

    /// Carries out goals of a few steps at once, and works on the others until they are cancelled.
    async fn work(mut self) {
        let mut working = None;
        let mut period = tokio::time::interval(Duration::from_millis(20));
        loop {
            tokio::select! {
                asked = self.asked.recv() => match asked {
                    Some((id, Some(steps))) if steps < 10 => self.end(&id, GoalOutcome::Succeeded, steps),
                    Some((id, Some(_))) => working = Some(id),
                    Some((id, None)) => {
                        working = None;
                        self.end(&id, GoalOutcome::Canceled, -1);
                    }
                    None => return,
                },
                _ = period.tick() => {
                    if let Some(id) = &working {
                        self.server.publish_feedback(id, self.message(1));
                    }
                }
            }
        }
    }

    /// Returns a result or feedback with one number, which is in a list in the actions of ROS 2.
    fn message(&self, number: i32) -> Bytes {
        let mut out = MessageLayout::new(self.ros);
        if self.ros == RosVersion::One {
            out.u32(1);
        }
        out.u32(u32::from_le_bytes(number.to_le_bytes())).finish()
    }

    fn end(&self, id: &str, outcome: GoalOutcome, number: i32) {
        self.server.end_goal(id, GoalEnd { outcome, text: String::new(), result: self.message(number) });
    }
}

pub fn a_node_sends_goals_to_a_robot_of_the_other_ros(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(crossing::service(ros.other()).0)?;
    let site = Site::with_ros(ros)?;
    let (app, arm) = (site.join("/app")?, site.join("/arm")?);
    let working = Arm::start(&site, &arm)?;
    let stub = start_crossing(&site, &daemon, "goals", &[])?;
    wait_until_ready(&site, &app, &stub)?;
    for (service, wanted) in [("/crossing/send", "3"), ("/crossing/stop", "-1")] {
        let ready = site.wait_for_graph(&app, "the node's service", |graph| graph.serves(service));
        with_log(ready.map(drop), &stub)?;
        let (success, said) = with_log(call_trigger(&site, &app, service), &stub)?;
        ensure!(success && said == wanted, "{service}: {said}\n{}", stub.output());
    }
    ensure!(!working.is_finished(), "the robot's server has ended\n{}", stub.output());
    working.abort();
    Ok(())
}

pub fn simulated_time_is_the_robots(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(crossing::service(ros.other()).0)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    // In ROS 1 one parameter applies to all nodes, in ROS 2 each node has its own.
    let argv: &[&str] = match ros {
        RosVersion::One => {
            let parameters = app.parameters()?;
            site.runtime.block_on(parameters.set("/use_sim_time", ParamValue::Bool(true)))?;
            &[]
        }
        RosVersion::Two => &["-p", "use_sim_time:=true"],
    };
    let clock = find_type(ros, "rosgraph_msgs/Clock")?;
    let clock = advertise(&site, &app, "/clock", &clock, true)?;
    let simulated = 1_000_000 * 1_000_000_000 + 5;
    let tick = |clock: &dyn Publisher| clock.publish(MessageLayout::new(ros).time(simulated).finish());
    tick(&*clock);
    let stub = start_crossing(&site, &daemon, "simulated", argv)?;
    wait_until_ready(&site, &app, &stub)?;
    let deadline = Deadline::begin();
    loop {
        let (_, now) = with_log(call_trigger(&site, &app, "/crossing/now"), &stub)?;
        if now == simulated.to_string() {
            return Ok(());
        }
        let late = || format!("it is {now} in the cloud, and should be {simulated}");
        with_log(deadline.check(late), &stub)?;
        tick(&*clock);
    }
}

/// Waits until the node says that this is its label.
fn wait_for_label(site: &Site, app: &(impl HasBus + ?Sized), stub: &NodeProcess, wanted: &str) -> Verdict {
    let deadline = Deadline::begin();
    loop {
        let (_, label) = with_log(call_trigger(site, app, "/crossing/label"), stub)?;
        if label == wanted {
            return Ok(());
        }
        with_log(deadline.check(|| format!("the label is {label}, and should be {wanted}")), stub)?;
    }
}

pub fn parameters_of_the_node_are_the_robots(ros: RosVersion) -> Verdict {
    let daemon = world().daemon_with(crossing::service(ros.other()).0)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let label = |text: &str| ParamValue::String(text.to_owned());
    // In ROS 1 they stand at the Master, in ROS 2 on the command line.
    let argv: &[&str] = match ros {
        RosVersion::One => {
            site.runtime.block_on(app.parameters()?.set("/crossing/label", label("front")))?;
            &[]
        }
        RosVersion::Two => &["-p", "label:=front"],
    };
    let stub = start_crossing(&site, &daemon, "labelled", argv)?;
    wait_until_ready(&site, &app, &stub)?;
    let served = site.wait_for_graph(&app, "the node's services", |graph| graph.serves("/crossing/label"));
    with_log(served.map(drop), &stub)?;
    wait_for_label(&site, &app, &stub, "front")?;
    // A change while it runs, as `rosparam set` and `ros2 param set` make it.
    match ros {
        RosVersion::One => site.runtime.block_on(app.parameters()?.set("/crossing/label", label("rear")))?,
        RosVersion::Two => {
            let served = site.wait_for_graph(&app, "the services about parameters", |graph| {
                graph.serves("/crossing/set_parameters") && graph.serves("/crossing/get_parameter_types")
            });
            with_log(served.map(drop), &stub)?;
            // The node's events are on the robot, as in ROS 2 any node's.
            let heard = site.runtime.block_on(app.node_parameters()?.watch(Some(NODE)));
            let mut heard = with_log(heard.map_err(Into::into), &stub)?;
            let change = vec![("label".to_owned(), Some(label("rear")))];
            let set = site.runtime.block_on(app.node_parameters()?.set(NODE, change));
            let set = with_log(set.map_err(Into::into), &stub)?;
            ensure!(set.iter().all(Result::is_ok), "{set:?}");
            let event = with_log(site.runtime.block_on(wait_for(heard.next())), &stub)?;
            let changed = event.context("the events ended")?.changed;
            ensure!(changed == [("label".to_owned(), label("rear"))], "{changed:?}");
        }
    }
    wait_for_label(&site, &app, &stub, "rear")
}

pub fn a_node_of_ros_2_is_reconfigured_by_a_robot_of_ros_1() -> Verdict {
    let daemon = world().daemon_with(crossing::service(RosVersion::Two).0)?;
    let site = Site::new()?;
    let app = site.join("/app")?;
    let stub = start_crossing(&site, &daemon, "reconfigured", &["_label:=front"])?;
    wait_until_ready(&site, &app, &stub)?;
    let there = site.wait_for_graph(&app, "dynamic_reconfigure", |graph| {
        graph.serves("/crossing/set_parameters") && graph.publishes(NODE, "/crossing/parameter_descriptions")
    });
    with_log(there.map(drop), &stub)?;
    // As rqt_reconfigure does: what there is, what is so, and a change.
    let mut descriptions = site.subscribe(&app, "/crossing/parameter_descriptions")?;
    let described = with_log(site.next_message(&mut descriptions), &stub)?;
    ensure!(described.wire_type.name == "dynamic_reconfigure/ConfigDescription", "{:?}", described.wire_type);
    let label = MessageBytes::default().text("label").text("str").0;
    ensure!(holds(&described.bytes, &label), "{described:?}");
    let mut updates = site.subscribe(&app, "/crossing/parameter_updates")?;
    let is_so = |text: &str| MessageBytes::default().text("label").text(text).0;
    let now = with_log(site.next_message(&mut updates), &stub)?;
    ensure!(holds(&now.bytes, &is_so("front")), "{now:?}");
    // dynamic_reconfigure/Config: bools · ints · strs { name, value } · doubles · groups
    let request = MessageBytes::default().word(0).word(0).word(1).text("label").text("left").word(0).word(0).0;
    let response = with_log(site.call_service(&app, "/crossing/set_parameters", &request), &stub)?;
    ensure!(holds(&response, &is_so("left")), "{response:?}");
    wait_for_label(&site, &app, &stub, "left")?;
    while !holds(&with_log(site.next_message(&mut updates), &stub)?.bytes, &is_so("left")) {}
    // It stands at the robot's Master, too.
    let told = support::wait_until("the label at the robot's Master", || {
        let value = site.runtime.block_on(app.parameter("/crossing/label")).ok();
        let is = value == Some(ParamValue::String("left".to_owned()));
        Ok(is.then_some(()).ok_or_else(|| format!("{value:?}")))
    });
    with_log(told, &stub)
}

/// Returns whether a message contains these bytes.
fn holds(message: &[u8], part: &[u8]) -> bool {
    message.windows(part.len()).any(|some| some == part)
}

pub fn a_node_of_ros_1_is_reconfigured_by_a_robot_of_ros_2() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let site = Site::with_ros(RosVersion::Two)?;
    let app = site.join("/app")?;
    let stub = site.start_stub(
        &daemon,
        ("opencv_apps", "opencv_apps", "people_detect"),
        "mixed-reconfigured",
        &["--ros-args", "-r", "__node:=people", "-p", "debug_view:=false"],
    )?;
    let served = site.wait_for_graph(&app, "the services about parameters", |graph| {
        ["set_parameters", "describe_parameters", "get_parameter_types"]
            .iter()
            .all(|service| graph.serves(&format!("/people/{service}")))
    });
    with_log(served.map(drop), &stub)?;
    let parameters = app.node_parameters()?;
    let name = || "padding".to_owned();
    // Its node has to have advertised its parameters in the cloud.
    let described = support::wait_until("the description of a parameter", || {
        let described = site.runtime.block_on(parameters.describe("/people", &[name()]))?;
        let range = described.first().and_then(|described| described.as_ref()?.integer_range);
        Ok(range.ok_or_else(|| format!("{described:?}")))
    });
    let range = with_log(described, &stub)?;
    ensure!(range.from < range.to, "{range:?}");
    let heard = site.runtime.block_on(parameters.watch(Some("/people")));
    let mut heard = with_log(heard.map_err(Into::into), &stub)?;
    let change = |value| vec![(name(), Some(ParamValue::Int(value)))];
    let set = site.runtime.block_on(parameters.set("/people", change(range.to)))?;
    ensure!(set.iter().all(Result::is_ok), "{set:?}\n{}", stub.output());
    // The node has chosen it. Its other parameters, which it writes again, have not changed.
    loop {
        let event = with_log(site.runtime.block_on(wait_for(heard.next())), &stub)?.context("the events ended")?;
        if event.changed == [(name(), ParamValue::Int(range.to))] {
            break;
        }
        ensure!(event.changed.iter().all(|(changed, _)| *changed != name()), "{event:?}");
    }
    let refused = site.runtime.block_on(parameters.set("/people", change(range.to + 1)))?;
    ensure!(refused.iter().all(Result::is_err), "{refused:?}");
    Ok(())
}

pub fn the_robots_own_original_answers_while_the_cable_is_cut(ros: RosVersion) -> Verdict {
    let (own, cloud) = (localiser(ros), localiser(ros.other()));
    // The original comes from an image of the robot's ROS.
    world().daemon_with(own.service)?;
    let daemon = world().daemon_with(cloud.service)?;
    let cable = Cable::new(&daemon.address)?;
    let mut robot = MapRobot::new(ros)?;
    let installed = (cloud.package, cloud.executable);
    let workspace = robot.site.install_original(&daemon, own.service.name, installed, own.program)?;
    let workspace = workspace.to_str().context("UTF-8")?;
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{}\"\nrequest = \"/scan -> /localiser/pose\"\n",
        cable.server,
        cloud.service.name,
        robot_name(ros, "cut")
    );
    let variables = [(own.workspaces, workspace), ("NO_COLOR", "1")];
    let stub = robot.site.start_stub_with_environment(&variables, &toml, cloud.package, cloud.executable, own.argv)?;
    wait_for_log(&stub, "linked to", 1)?;
    // The map was latched before the node of the other ROS existed: without it no scan is answered.
    robot.expect_localised((2, 4), &stub)?;
    let (over, back) = ("the local original answers, too why=LinkDown", "the cloud answers alone why=LinkUp");
    let count = |words| stub.output().matches(words).count();
    let taken_over = count(over);
    cable.degrade(SILENT)?;
    wait_for_log(&stub, over, taken_over + 1)?;
    robot.expect_localised((6, 2), &stub)?;
    let taken_back = count(back);
    cable.restore()?;
    wait_for_log(&stub, back, taken_back + 1)?;
    robot.expect_localised((1, 1), &stub)
}
