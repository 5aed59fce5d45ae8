//! Robots with stubs of a service that they share.

use std::collections::BTreeSet;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::{Context, ensure};
use bytes::Bytes;
use nix::sys::signal::Signal;
use ros::bus::{
    ActionClient, Bus, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome, Graph, RosVersion, Subscription,
};
use ros::codec::{from_json, to_json};
use ros::schema::{MessageType, Registry};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::run;
use support::patience::{patience, scale, tell_patience, wait_for};
use support::site::{NodeProcess, Site, registrations};
use support::{Verdict, binaries};
use tokio::sync::mpsc;

use super::{OF_TWO, SharerNode, kill_shim, ready_count, send_goal};

/// Time to wait for a call of ROS 2 that may have failed, because failed calls are not answered; on an idle machine.
const UNANSWERED: Duration = Duration::from_secs(10);

fn serialize(of: &MessageType, values: &Value) -> anyhow::Result<Bytes> {
    let mut out = Vec::new();
    let text = values.to_string();
    from_json(of, text.as_bytes(), &mut out, &Default::default())?;
    Ok(out.into())
}

fn deserialize(of: &MessageType, bytes: &[u8]) -> anyhow::Result<Value> {
    let mut out = Vec::new();
    to_json(of, bytes, &mut out, &Default::default())?;
    Ok(serde_json::from_slice(&out)?)
}

/// A robot with a stub of the service, and an application.
struct StubbedRobot {
    sharer: SharerNode,
    registry: Registry,
    name: &'static str,
    /// Names on the robot: the node, its service, its action.
    node: &'static str,
    work: &'static str,
    count: &'static str,
    site: Site,
    app: Arc<dyn Bus>,
    stub: NodeProcess,
}

impl StubbedRobot {
    fn new(
        daemon: &Daemon,
        sharer: SharerNode,
        name: &'static str,
        argv: &[&str],
        [node, work, count]: [&'static str; 3],
    ) -> anyhow::Result<StubbedRobot> {
        let site = Site::with_ros(sharer.ros)?;
        let app = site.join("/app")?;
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{name}\"\nlocal = \"none\"\ndesire = 30.0\nmax = 60.0\n",
            daemon.address, sharer.service
        );
        let stub = site.start_stub_with_config(&toml, sharer.service, "sharer", argv)?;
        let all = |graph: &Graph| registrations_in(sharer.ros, graph, node).len() >= 6;
        site.wait_for_graph(&app, "what the node serves", all)
            .with_context(|| format!("the stub said:\n{}", stub.output()))?;
        Ok(StubbedRobot { sharer, registry: sharer.registry()?, name, node, work, count, site, app, stub })
    }

    /// Returns the registrations that the original's node would have.
    fn expected_registrations(&self) -> BTreeSet<String> {
        let StubbedRobot { work, count, .. } = self;
        let lines = match self.sharer.ros {
            RosVersion::One => [
                format!("publishes {count}/feedback [sharer_cpp/CountActionFeedback]"),
                format!("publishes {count}/result [sharer_cpp/CountActionResult]"),
                format!("publishes {count}/status [actionlib_msgs/GoalStatusArray]"),
                format!("serves {work}"),
                format!("subscribes {count}/cancel [actionlib_msgs/GoalID]"),
                format!("subscribes {count}/goal [sharer_cpp/CountActionGoal]"),
            ],
            RosVersion::Two => [
                format!("publishes {count}/_action/feedback [sharer_msgs/action/Count_FeedbackMessage]"),
                format!("publishes {count}/_action/status [action_msgs/msg/GoalStatusArray]"),
                format!("serves {work} [sharer_msgs/srv/Work]"),
                format!("serves {count}/_action/send_goal [sharer_msgs/action/Count_SendGoal]"),
                format!("serves {count}/_action/cancel_goal [action_msgs/srv/CancelGoal]"),
                format!("serves {count}/_action/get_result [sharer_msgs/action/Count_GetResult]"),
            ],
        };
        lines.into()
    }

    /// Serializes a request to work.
    fn work_request(&self, who: &str, seconds: f64) -> anyhow::Result<Bytes> {
        let of = self.registry.service(self.sharer.work)?;
        serialize(&of.request, &json!({"who": who, "seconds": seconds}))
    }

    /// Calls the service; returns whose request was answered and by which servant, or `None` without an answer.
    fn call_work(&self, who: &str, seconds: f64) -> anyhow::Result<Option<(String, String)>> {
        let request = self.work_request(who, seconds)?;
        let time = match self.sharer.ros {
            RosVersion::One => patience(),
            RosVersion::Two => scale(UNANSWERED),
        };
        let called = self.app.call(self.work, request, time);
        let answer = match (self.sharer.ros, self.site.runtime.block_on(called)) {
            (_, Ok(answer)) => answer,
            (RosVersion::Two, Err(BusError::Timeout { .. })) => return Ok(None),
            (_, Err(error)) => {
                ensure!(error.to_string().contains("--idempotent"), "{error}");
                return Ok(None);
            }
        };
        let of = self.registry.service(self.sharer.work)?;
        let answer = deserialize(&of.response, &answer)?;
        let word = |name: &str| answer[name].as_str().unwrap_or_default().to_owned();
        Ok(Some((word("who"), word("where"))))
    }

    /// Subscribes to the feedback on the robot.
    fn subscribe_to_feedback(&self) -> anyhow::Result<Subscription> {
        let topic = match self.sharer.ros {
            RosVersion::One => format!("{}/feedback", self.count),
            RosVersion::Two => format!("{}/_action/feedback", self.count),
        };
        let heard = self.site.subscribe(&self.app, &topic)?;
        self.site.wait_for_publishers(&heard, 1)?;
        Ok(heard)
    }

    /// Sends a goal to count.
    fn send_count_goal(&self, id: &str, to: i32) -> anyhow::Result<CountGoal> {
        let of = self.registry.action(self.sharer.count)?;
        let goal = serialize(&of.goal, &json!({"who": self.name, "to": to}))?;
        let (told, events) = mpsc::unbounded_channel();
        let _runtime = self.site.runtime.enter();
        let client = self.app.action_client(self.count, &of)?;
        self.site.runtime.block_on(client.wait_for_server(patience()))?;
        client.send_goal(id, goal, Arc::new(GoalEndListener(told)));
        Ok(CountGoal { client, events })
    }

    /// Waits for the end of a goal; returns the outcome and the result.
    fn wait_for_end(&self, counting: &mut CountGoal) -> anyhow::Result<(GoalOutcome, Value)> {
        let ended = wait_for(counting.events.recv());
        let ended = self.site.runtime.block_on(ended).context("a result")?;
        let end = ended.context("an end")??;
        let of = self.registry.action(self.sharer.count)?;
        Ok((end.outcome, deserialize(&of.result, &end.result)?))
    }
}

/// A goal of the application.
struct CountGoal {
    client: Box<dyn ActionClient>,
    events: mpsc::UnboundedReceiver<Result<GoalEnd, GoalError>>,
}

/// Receives the end of a goal.
struct GoalEndListener(mpsc::UnboundedSender<Result<GoalEnd, GoalError>>);

impl GoalEvents for GoalEndListener {
    fn on_feedback(&self, _feedback: Bytes) {}

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let _ = self.0.send(end);
    }
}

/// Returns the registrations of a node as comparable lines.
fn registrations_in(ros: RosVersion, graph: &Graph, node: &str) -> BTreeSet<String> {
    if ros == RosVersion::One {
        return registrations(graph, node);
    }
    let Some(ends) = graph.ends.get(node) else {
        return BTreeSet::new();
    };
    let publishes = ends.publishers.iter();
    let publishes = publishes.map(|(name, (of, _))| format!("publishes {name} [{}]", of.name));
    let subscribes = ends.subscribers.iter();
    let subscribes = subscribes.map(|(name, (of, _))| format!("subscribes {name} [{}]", of.name));
    let serves = ends.services.iter();
    let serves = serves.map(|(name, of)| format!("serves {name} [{}]", of.name));
    publishes.chain(subscribes).chain(serves).collect()
}

pub fn stubs_of_three_robots_use_two_servants_and_one_of_these_is_killed(ros: RosVersion) -> Verdict {
    let sharer = SharerNode::for_ros(ros);
    let daemon = sharer.start_daemon("sharing-stubs", "", &["--min", "2", "--max", "2"])?;
    let (front, other): (&[&str], &[&str]) = match ros {
        RosVersion::One => (&["__ns:=/front", "__name:=hands"], &["work:=/plan", "count:=tally", "_speed:=3"]),
        RosVersion::Two => (
            &["--ros-args", "-r", "__ns:=/front", "-r", "__node:=hands"],
            // The deployer has set its speed. An action of ROS 2 cannot be remapped.
            &["--ros-args", "-r", "work:=/plan", "-r", "count:=tally", "-p", "speed:=3.0"],
        ),
    };
    let tally = match ros {
        RosVersion::One => "/tally",
        RosVersion::Two => "/count",
    };
    let linked = |name, argv: &[&str], names| StubbedRobot::new(&daemon, sharer, name, argv, names);
    let mut plain = linked("plain", &[], ["/sharer", "/work", "/count"])?;
    let front = linked("front", front, ["/front/hands", "/front/work", "/front/count"])?;
    let other = linked("other", other, ["/sharer", "/plan", tally])?;
    // The names and types of the original.
    for robot in [&plain, &front, &other] {
        let graph = robot.app.graph().borrow().clone();
        let found = registrations_in(ros, &graph, robot.node);
        ensure!(found == robot.expected_registrations(), "{}: {found:#?}", robot.name);
    }
    // Settings that would change the node for all robots are ignored, with a warning.
    other.stub.wait_for_output("is ignored")?;
    other.stub.wait_for_output("speed")?;
    let before = sharer.wait_for_group(&daemon, "two servants", |group| ready_count(group) == 2)?;
    ensure!(before["robots"] == 3, "{before:#}");

    // Goals are separate: each robot gets feedback for its own only.
    for robot in [&plain, &front] {
        let mut feedback = robot.subscribe_to_feedback()?;
        // An action server ignores the id of a goal that has just ended.
        let id = format!("mine of {}", robot.name);
        let mut goals = [&plain, &front].map(|robot| robot.send_count_goal(&id, 5));
        for (robot, goal) in [&plain, &front].into_iter().zip(&mut goals) {
            let goal = goal.as_mut().map_err(|error| anyhow::anyhow!("{error:#}"))?;
            let end = robot.wait_for_end(goal)?;
            let result = json!({"who": robot.name, "all": [1, 2, 3, 4, 5]});
            ensure!(end == (GoalOutcome::Succeeded, result), "{end:?}");
        }
        let first = robot.site.next_message(&mut feedback)?;
        let mut all = vec![first];
        all.extend(std::iter::from_fn(|| feedback.messages.try_recv()));
        let foreign = all.iter().find(|it| !contains(&it.bytes, robot.name));
        ensure!(foreign.is_none(), "{}: {foreign:?}", robot.name);
    }
    let mut endless = front.send_count_goal("endless", 100_000)?;
    sharer.wait_for_busy_servant(&daemon)?;
    endless.client.cancel_goal("endless");
    let end = front.wait_for_end(&mut endless)?;
    ensure!(end.0 == GoalOutcome::Canceled, "{end:?}");

    // One of them has a call that its servant does not finish.
    let request = plain.work_request("plain", 3600.0)?;
    let long = {
        let app = Arc::clone(&plain.app);
        let call = async move { app.call("/work", request, patience()).await };
        plain.site.runtime.spawn(call)
    };
    let victim = sharer.wait_for_busy_servant(&daemon)?;
    let killed = Arc::new(AtomicBool::new(false));
    let working: Vec<_> = [front, other]
        .into_iter()
        .map(|robot| {
            let killed = Arc::clone(&killed);
            thread::spawn(move || -> anyhow::Result<(StubbedRobot, usize)> {
                let (mut answered, mut after) = (0, 0);
                while after < 5 {
                    after += usize::from(killed.load(Ordering::SeqCst));
                    let who = format!("{} {answered}", robot.name);
                    if let Some((said, _)) = robot.call_work(&who, 0.01)? {
                        ensure!(said == who, "not its own: {said}");
                        answered += 1;
                    }
                }
                Ok((robot, answered))
            })
        })
        .collect();
    sharer.wait_for_group(&daemon, "answers of both", |group| group["answered"].as_u64() > Some(20))?;
    kill_shim(&daemon, &victim)?;
    sharer.wait_for_group(&daemon, "another in its place", |group| {
        ready_count(group) == 2 && !group["servants"].to_string().contains(&victim)
    })?;
    killed.store(true, Ordering::SeqCst);
    match ros {
        RosVersion::One => {
            let refused = plain.site.runtime.block_on(long)?;
            let words = refused.err().map(|error| error.to_string());
            let words = words.context("a lost call was answered")?;
            ensure!(words.contains(&victim) && words.contains("--idempotent"), "{words}");
        }
        // A service of ROS 2 cannot report a failure; the robot's log does.
        RosVersion::Two => {
            plain.stub.wait_for_output("--idempotent")?;
            plain.stub.wait_for_output(&victim)?;
            long.abort();
        }
    }
    for robot in working {
        let (robot, answered) = robot.join().map_err(|_| anyhow::anyhow!("a robot panicked"))??;
        ensure!(answered > 0, "{} was never answered", robot.name);
    }
    let still = plain.call_work("still", 0.0)?;
    let answers = |(said, place): &(String, String)| said == "still" && *place != victim;
    ensure!(still.as_ref().is_some_and(answers), "{still:?}");
    // The signal with which launchers end nodes.
    plain.stub.signal(Signal::SIGINT)?;
    let status = plain.stub.wait_for_exit()?;
    ensure!(status.code() == Some(0), "{status}: {}", plain.stub.output());
    plain
        .site
        .wait_for_graph(&plain.app, "an empty graph", |graph| registrations_in(ros, graph, plain.node).is_empty())?;
    sharer.wait_for_group(&daemon, "two servants still", |group| ready_count(group) == 2)?;
    Ok(())
}

fn contains(message: &[u8], text: &str) -> bool {
    String::from_utf8_lossy(message).contains(text)
}

/// Runs the rclpy application of a robot and returns its output.
fn run_application(linked: &StubbedRobot, daemon: &Daemon, what: &str) -> anyhow::Result<Value> {
    let (site, sharer) = (&linked.site, linked.sharer);
    // It needs the message types of the image.
    let python = ("application", "application");
    let prefix = site.install_original(daemon, sharer.service, python, "python3")?;
    let text = std::fs::read_to_string(binaries::checkout().join("tests/robots/shares_ros2.py"))?;
    let mut command = Command::new(prefix.join("lib/application/application"));
    command.args(["-c", &text, what]);
    site.system.configure(&mut command);
    let told = run(tell_patience(&mut command))?.expect_success();
    let told = told.with_context(|| format!("the stub said:\n{}", linked.stub.output()))?;
    serde_json::from_str(&told.stdout).context(told.stdout)
}

pub fn an_application_of_rclpy_shares_one_servant_with_another_robot() -> Verdict {
    let sharer = OF_TWO;
    let daemon = sharer.start_daemon("sharing-rclpy", "", &["--max", "1"])?;
    let names = ["/sharer", "/work", "/count"];
    let linked = StubbedRobot::new(&daemon, sharer, "linked", &[], names)?;
    // The only servant executes a goal of another robot.
    let mut two = sharer.connect(&daemon, "two")?;
    send_goal(&mut two, sharer, "long", json!({"who": "two", "to": 100_000}))?;
    two.wait_for("feedback", |value| value["op"] == "action_feedback")?;
    let told = run_application(&linked, &daemon, "waiting")?;
    // It is accepted and waits, as its status says, and can be cancelled meanwhile.
    let expected = json!({
        "work": "rclpy", "accepted": true, "status": "ACCEPTED",
        "canceled": {"canceling": 1, "code": 0}, "end": "CANCELED",
    });
    ensure!(told == expected, "{told:#}");
    two.send(json!({"op": "cancel_action_goal", "id": "long", "action": "/count"}))?;
    two.wait_for("its end", |value| value["op"] == "action_result")?;
    let told = run_application(&linked, &daemon, "free")?;
    // The node rejects a goal, and a request to cancel one.
    let expected = json!({
        "work": "rclpy",
        "counted": {"end": "SUCCEEDED", "all": [1, 2, 3], "at": [1, 2, 3]},
        "refused": true,
        "stubborn": {"canceling": 0, "code": 1, "end": "SUCCEEDED"},
        "canceled": {"canceling": 1, "code": 0, "end": "CANCELED"},
        "parameters": false,
    });
    ensure!(told == expected, "{told:#}");
    Ok(())
}
