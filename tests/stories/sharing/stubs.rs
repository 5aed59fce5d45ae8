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
    ActionClient, Bus, BusError, GoalEnd, GoalEvents, Graph, Outcome, RosVersion, Subscription,
};
use ros::codec::{from_json, to_json};
use ros::schema::{MessageType, Registry};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::run;
use support::patience::{patience, scale, tell_patience, wait_for};
use support::site::{Running, Site, registered};
use support::{Verdict, binaries};
use tokio::sync::mpsc;

use super::{OF_TWO, Sharer, fails, ready, sends_goal};

/// A call of ROS 2 that fails is not answered; so long one is waited for that may be such, where nothing else runs.
const UNANSWERED: Duration = Duration::from_secs(10);

fn serialized(of: &MessageType, values: &Value) -> anyhow::Result<Bytes> {
    let mut out = Vec::new();
    let text = values.to_string();
    from_json(of, text.as_bytes(), &mut out, &Default::default())?;
    Ok(out.into())
}

fn values(of: &MessageType, bytes: &[u8]) -> anyhow::Result<Value> {
    let mut out = Vec::new();
    to_json(of, bytes, &mut out, &Default::default())?;
    Ok(serde_json::from_slice(&out)?)
}

/// A robot with a stub of the service, and an application of its own.
struct Linked {
    sharer: Sharer,
    registry: Registry,
    name: &'static str,
    /// As the robot has them: the node, its service, its action.
    node: &'static str,
    work: &'static str,
    count: &'static str,
    site: Site,
    app: Arc<dyn Bus>,
    stub: Running,
}

impl Linked {
    fn new(
        daemon: &Daemon,
        sharer: Sharer,
        name: &'static str,
        argv: &[&str],
        [node, work, count]: [&'static str; 3],
    ) -> anyhow::Result<Linked> {
        let site = Site::of(sharer.ros)?;
        let app = site.joins("/app")?;
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{name}\"\nlocal = \"none\"\ndesire = 30.0\nmax = 60.0\n",
            daemon.address, sharer.service
        );
        let stub = site.stub_with(&toml, sharer.service, "sharer", argv)?;
        let all = |graph: &Graph| has(sharer.ros, graph, node).len() >= 6;
        site.until(&app, "what the node serves", all)
            .with_context(|| format!("the stub said:\n{}", stub.said()))?;
        Ok(Linked {
            sharer,
            registry: sharer.registry()?,
            name,
            node,
            work,
            count,
            site,
            app,
            stub,
        })
    }

    /// What the node of the original would have.
    fn expected(&self) -> BTreeSet<String> {
        let Linked { work, count, .. } = self;
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
                format!(
                    "publishes {count}/_action/feedback [sharer_msgs/action/Count_FeedbackMessage]"
                ),
                format!("publishes {count}/_action/status [action_msgs/msg/GoalStatusArray]"),
                format!("serves {work} [sharer_msgs/srv/Work]"),
                format!("serves {count}/_action/send_goal [sharer_msgs/action/Count_SendGoal]"),
                format!("serves {count}/_action/cancel_goal [action_msgs/srv/CancelGoal]"),
                format!("serves {count}/_action/get_result [sharer_msgs/action/Count_GetResult]"),
            ],
        };
        lines.into()
    }

    /// The request to work.
    fn request(&self, who: &str, seconds: f64) -> anyhow::Result<Bytes> {
        let of = self.registry.service(self.sharer.work)?;
        serialized(&of.request, &json!({"who": who, "seconds": seconds}))
    }

    /// Who was answered, and by which servant; nobody where it was not.
    fn works(&self, who: &str, seconds: f64) -> anyhow::Result<Option<(String, String)>> {
        let request = self.request(who, seconds)?;
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
        let answer = values(&of.response, &answer)?;
        let word = |name: &str| answer[name].as_str().unwrap_or_default().to_owned();
        Ok(Some((word("who"), word("where"))))
    }

    /// Feedback, as it comes on the robot.
    fn hears_feedback(&self) -> anyhow::Result<Subscription> {
        let topic = match self.sharer.ros {
            RosVersion::One => format!("{}/feedback", self.count),
            RosVersion::Two => format!("{}/_action/feedback", self.count),
        };
        let heard = self.site.hears(&self.app, &topic)?;
        self.site.fed(&heard, 1)?;
        Ok(heard)
    }

    /// Sends a goal to count.
    fn counts(&self, id: &str, to: i32) -> anyhow::Result<Counting> {
        let of = self.registry.action(self.sharer.count)?;
        let goal = serialized(&of.goal, &json!({"who": self.name, "to": to}))?;
        let (told, events) = mpsc::unbounded_channel();
        let _runtime = self.site.runtime.enter();
        let client = self.app.action_client(self.count, &of)?;
        self.site.runtime.block_on(client.ready(patience()))?;
        client.send(id, goal, Arc::new(Ear(told)));
        Ok(Counting { client, events })
    }

    /// The end of a goal, and its result.
    fn end(&self, counting: &mut Counting) -> anyhow::Result<(Outcome, Value)> {
        let ended = wait_for(counting.events.recv());
        let ended = self.site.runtime.block_on(ended).context("a result")?;
        let end = ended.context("an end")?.map_err(anyhow::Error::msg)?;
        let of = self.registry.action(self.sharer.count)?;
        Ok((end.outcome, values(&of.result, &end.result)?))
    }
}

/// A goal of an application.
struct Counting {
    client: Box<dyn ActionClient>,
    events: mpsc::UnboundedReceiver<Result<GoalEnd, String>>,
}

/// Tells of the end of a goal.
struct Ear(mpsc::UnboundedSender<Result<GoalEnd, String>>);

impl GoalEvents for Ear {
    fn feedback(&self, _feedback: Bytes) {}

    fn ended(&self, end: Result<GoalEnd, String>) {
        let _ = self.0.send(end);
    }
}

/// What a node has, as lines that can be compared.
fn has(ros: RosVersion, graph: &Graph, node: &str) -> BTreeSet<String> {
    if ros == RosVersion::One {
        return registered(graph, node);
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

pub fn stubs_of_three_robots_use_two_servants_and_one_of_these_is_killed(
    ros: RosVersion,
) -> Verdict {
    let sharer = Sharer::of(ros);
    let daemon = sharer.pushed("sharing-stubs", "", &["--min", "2", "--max", "2"])?;
    let (front, other): (&[&str], &[&str]) = match ros {
        RosVersion::One => (
            &["__ns:=/front", "__name:=hands"],
            &["work:=/plan", "count:=tally", "_speed:=3"],
        ),
        RosVersion::Two => (
            &["--ros-args", "-r", "__ns:=/front", "-r", "__node:=hands"],
            // Whose speed the deployer has set. An action of ROS 2 is not remapped.
            &[
                "--ros-args",
                "-r",
                "work:=/plan",
                "-r",
                "count:=tally",
                "-p",
                "speed:=3.0",
            ],
        ),
    };
    let tally = match ros {
        RosVersion::One => "/tally",
        RosVersion::Two => "/count",
    };
    let linked = |name, argv: &[&str], names| Linked::new(&daemon, sharer, name, argv, names);
    let mut plain = linked("plain", &[], ["/sharer", "/work", "/count"])?;
    let front = linked(
        "front",
        front,
        ["/front/hands", "/front/work", "/front/count"],
    )?;
    let other = linked("other", other, ["/sharer", "/plan", tally])?;
    // The names of the original, and its types.
    for robot in [&plain, &front, &other] {
        let graph = robot.app.graph().borrow().clone();
        let found = has(ros, &graph, robot.node);
        ensure!(found == robot.expected(), "{}: {found:#?}", robot.name);
    }
    // What would change the node for all is not heeded, and that is said.
    other.stub.says("is not heeded")?;
    other.stub.says("speed")?;
    let before = sharer.group(&daemon, "two servants", |group| ready(group) == 2)?;
    ensure!(before["robots"] == 3, "{before:#}");

    // Goals do not meet: each robot hears of its own alone.
    for robot in [&plain, &front] {
        let mut feedback = robot.hears_feedback()?;
        let mut goals = [&plain, &front].map(|robot| robot.counts("mine", 5));
        for (robot, goal) in [&plain, &front].into_iter().zip(&mut goals) {
            let goal = goal
                .as_mut()
                .map_err(|error| anyhow::anyhow!("{error:#}"))?;
            let end = robot.end(goal)?;
            let result = json!({"who": robot.name, "all": [1, 2, 3, 4, 5]});
            ensure!(end == (Outcome::Succeeded, result), "{end:?}");
        }
        let first = robot.site.next(&mut feedback)?;
        let mut all = vec![first];
        all.extend(std::iter::from_fn(|| feedback.messages.try_recv()));
        let foreign = all.iter().find(|it| !contains(&it.bytes, robot.name));
        ensure!(foreign.is_none(), "{}: {foreign:?}", robot.name);
    }
    let mut endless = front.counts("endless", 100_000)?;
    sharer.busy(&daemon)?;
    endless.client.cancel("endless");
    let end = front.end(&mut endless)?;
    ensure!(end.0 == Outcome::Canceled, "{end:?}");

    // One has a call that its servant will not end.
    let request = plain.request("plain", 3600.0)?;
    let long = {
        let app = Arc::clone(&plain.app);
        let call = async move { app.call("/work", request, patience()).await };
        plain.site.runtime.spawn(call)
    };
    let victim = sharer.busy(&daemon)?;
    let killed = Arc::new(AtomicBool::new(false));
    let working: Vec<_> = [front, other]
        .into_iter()
        .map(|robot| {
            let killed = Arc::clone(&killed);
            thread::spawn(move || -> anyhow::Result<(Linked, usize)> {
                let (mut answered, mut after) = (0, 0);
                while after < 5 {
                    after += usize::from(killed.load(Ordering::SeqCst));
                    let who = format!("{} {answered}", robot.name);
                    if let Some((said, _)) = robot.works(&who, 0.01)? {
                        ensure!(said == who, "not its own: {said}");
                        answered += 1;
                    }
                }
                Ok((robot, answered))
            })
        })
        .collect();
    sharer.group(&daemon, "answers of both", |group| {
        group["answered"].as_u64() > Some(20)
    })?;
    fails(&daemon, &victim)?;
    sharer.group(&daemon, "another in its place", |group| {
        ready(group) == 2 && !group["servants"].to_string().contains(&victim)
    })?;
    killed.store(true, Ordering::SeqCst);
    match ros {
        RosVersion::One => {
            let refused = plain.site.runtime.block_on(long)?;
            let words = refused.err().map(|error| error.to_string());
            let words = words.context("a lost call was answered")?;
            ensure!(
                words.contains(&victim) && words.contains("--idempotent"),
                "{words}"
            );
        }
        // A service of ROS 2 cannot answer that it failed: the robot's log says it.
        RosVersion::Two => {
            plain.stub.says("--idempotent")?;
            plain.stub.says(&victim)?;
            long.abort();
        }
    }
    for robot in working {
        let (robot, answered) = robot
            .join()
            .map_err(|_| anyhow::anyhow!("a robot panicked"))??;
        ensure!(answered > 0, "{} was never answered", robot.name);
    }
    let still = plain.works("still", 0.0)?;
    let answers = |(said, place): &(String, String)| said == "still" && *place != victim;
    ensure!(still.as_ref().is_some_and(answers), "{still:?}");
    // A launcher's way to end it.
    plain.stub.signal(Signal::SIGINT)?;
    let status = plain.stub.ends()?;
    ensure!(status.code() == Some(0), "{status}: {}", plain.stub.said());
    plain.site.until(&plain.app, "an empty graph", |graph| {
        has(ros, graph, plain.node).is_empty()
    })?;
    sharer.group(&daemon, "two servants still", |group| ready(group) == 2)?;
    Ok(())
}

fn contains(message: &[u8], text: &str) -> bool {
    String::from_utf8_lossy(message).contains(text)
}

/// The rclpy application of a robot; what it tells.
fn application(linked: &Linked, daemon: &Daemon, what: &str) -> anyhow::Result<Value> {
    let (site, sharer) = (&linked.site, linked.sharer);
    // It needs the image's messages.
    let python = ("application", "application");
    let prefix = site.installs_original(daemon, sharer.service, python, "python3")?;
    let text = std::fs::read_to_string(binaries::checkout().join("tests/robots/shares_ros2.py"))?;
    let mut command = Command::new(prefix.join("lib/application/application"));
    command.args(["-c", &text, what]);
    site.system.is_of(&mut command);
    let told = run(tell_patience(&mut command))?.succeeded();
    let told = told.with_context(|| format!("the stub said:\n{}", linked.stub.said()))?;
    serde_json::from_str(&told.stdout).context(told.stdout)
}

pub fn an_application_of_rclpy_shares_one_servant_with_another_robot() -> Verdict {
    let sharer = OF_TWO;
    let daemon = sharer.pushed("sharing-rclpy", "", &["--max", "1"])?;
    let names = ["/sharer", "/work", "/count"];
    let linked = Linked::new(&daemon, sharer, "linked", &[], names)?;
    // Another robot's goal is at the only servant.
    let mut two = sharer.robot(&daemon, "two")?;
    sends_goal(
        &mut two,
        sharer,
        "long",
        json!({"who": "two", "to": 100_000}),
    )?;
    two.hears("feedback", |value| value["op"] == "action_feedback")?;
    let told = application(&linked, &daemon, "waiting")?;
    // It is accepted to wait for its turn, as its status says, and can be cancelled meanwhile.
    let expected = json!({
        "work": "rclpy", "accepted": true, "status": "ACCEPTED",
        "canceled": {"canceling": 1, "code": 0}, "end": "CANCELED",
    });
    ensure!(told == expected, "{told:#}");
    two.says(json!({"op": "cancel_action_goal", "id": "long", "action": "/count"}))?;
    two.hears("its end", |value| value["op"] == "action_result")?;
    let told = application(&linked, &daemon, "free")?;
    // What the node refuses is refused: a goal, a wish that one should end.
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
