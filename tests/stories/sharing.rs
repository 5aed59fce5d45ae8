//! Services shared by robots: requests are distributed among servants, and no robot sees those of another.

#[path = "sharing/stubs.rs"]
mod stubs;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ros::bus::RosVersion;
use ros::schema::Registry;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::patience::Deadline;
use support::robot::Robot;
use support::world::world;

pub use stubs::{
    an_application_of_rclpy_shares_one_servant_with_another_robot,
    stubs_of_three_robots_use_two_servants_and_one_of_these_is_killed,
};

/// The shared node for one version of ROS: it works and counts.
#[derive(Clone, Copy)]
struct SharerNode {
    ros: RosVersion,
    /// Name of the service and of its package.
    service: &'static str,
    arguments: &'static [&'static str],
    work: &'static str,
    count: &'static str,
}

const OF_ONE: SharerNode = SharerNode {
    ros: RosVersion::One,
    service: "sharer_cpp",
    arguments: &["--node", "sharer"],
    work: "sharer_cpp/srv/Work",
    count: "sharer_cpp/action/Count",
};

const OF_TWO: SharerNode = SharerNode {
    ros: RosVersion::Two,
    service: "sharer_ros2",
    arguments: &["--name", "sharer_ros2", "--node", "sharer_ros2/sharer"],
    work: "sharer_msgs/srv/Work",
    count: "sharer_msgs/action/Count",
};

impl SharerNode {
    fn for_ros(ros: RosVersion) -> SharerNode {
        match ros {
            RosVersion::One => OF_ONE,
            RosVersion::Two => OF_TWO,
        }
    }

    fn start_daemon(self, home: &str, config: &str, arguments: &[&str]) -> anyhow::Result<Daemon> {
        let home = format!("{home}-{}", self.ros.number());
        let daemon = world().setup(&home).config(config).start()?;
        let arguments = [self.arguments, &["--shared"], arguments].concat();
        let push = daemon.deployer().push(self.service, &arguments)?;
        push.expect_success()?;
        Ok(daemon)
    }

    fn connect(self, daemon: &Daemon, name: &str) -> anyhow::Result<Robot> {
        daemon.robot(&format!("{}?robot={name}", self.service))
    }

    fn service_path(self) -> String {
        format!("/api/v1/services/{}", self.service)
    }

    /// Waits until the group of servants satisfies `is`, and returns it.
    fn wait_for_group(self, daemon: &Daemon, what: &str, is: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
        daemon.wait_for(&self.service_path(), what, |service| {
            let groups = service["groups"].as_array()?;
            groups.iter().find(|group| is(group)).cloned()
        })
    }

    /// Waits until a servant has work, and returns it.
    fn wait_for_busy_servant(self, daemon: &Daemon) -> anyhow::Result<String> {
        daemon.wait_for(&self.service_path(), "the servant that has it", |service| {
            let servants = service["groups"][0]["servants"].as_array()?;
            let busy = servants.iter().find(|one| one["under_way"] == 1)?;
            Some(busy["id"].as_str()?.to_owned())
        })
    }

    /// Returns a registry of its definitions.
    fn registry(self) -> anyhow::Result<Registry> {
        let registry = Registry::for_version(self.ros);
        let work = include_str!("../packages/sharer_cpp/srv/Work.srv");
        let count = include_str!("../packages/sharer_cpp/action/Count.action");
        registry.insert(self.work, work)?;
        registry.insert(self.count, count)?;
        Ok(registry)
    }
}

fn ready_count(group: &Value) -> usize {
    let servants = group["servants"].as_array();
    servants.map_or(0, |all| all.iter().filter(|one| one["ready"] == true).count())
}

/// Kills a servant, as a failing machine would.
fn kill_shim(daemon: &Daemon, id: &str) -> Verdict {
    let runtime = daemon.home.join("servants").join(id).join("runtime.json");
    let runtime: Value = serde_json::from_slice(&std::fs::read(runtime)?)?;
    let shim = runtime["shim"]["pid"].as_i64().context("the shim's pid")?;
    Ok(kill(Pid::from_raw(shim as i32), Signal::SIGKILL)?)
}

pub fn twenty_robots_share_two_servants_and_one_of_these_is_killed(ros: RosVersion) -> Verdict {
    let sharer = SharerNode::for_ros(ros);
    let daemon = Arc::new(sharer.start_daemon("sharing", "", &["--min", "2", "--max", "2"])?);
    let mut long = sharer.connect(&daemon, "r0")?;
    let mut robots = Vec::new();
    for number in 1..20 {
        let name = format!("r{number}");
        robots.push((name.clone(), sharer.connect(&daemon, &name)?));
    }
    let before = sharer.wait_for_group(&daemon, "two servants", |group| ready_count(group) == 2)?;
    ensure!(before["robots"] == 20, "{before:#}");
    // Both servants have answered before; then one of them gets a call that does not end.
    for (name, robot) in &mut robots {
        let answer = robot.call("/work", json!({"who": name, "seconds": 0.0}))?;
        ensure!(answer["result"] == true, "{answer}");
    }
    long.send(json!({
        "op": "call_service", "id": "long", "service": "/work", "args": {"who": "r0", "seconds": 3600.0},
    }))?;
    let victim = sharer.wait_for_busy_servant(&daemon)?;
    let killed = Arc::new(AtomicBool::new(false));
    let working: Vec<_> = robots
        .into_iter()
        .map(|(name, mut robot)| {
            let killed = Arc::clone(&killed);
            thread::spawn(move || -> anyhow::Result<Vec<Value>> {
                let mut answers = Vec::new();
                let mut after = 0;
                // Until well after the end of that servant.
                while after < 5 {
                    after += usize::from(killed.load(Ordering::SeqCst));
                    let who = format!("{name} {}", answers.len());
                    let answer = robot.call("/work", json!({"who": who, "seconds": 0.01}))?;
                    if answer["result"] == true {
                        ensure!(answer["values"]["who"] == who.as_str(), "not its own: {answer}");
                    }
                    answers.push(answer);
                }
                // No answer arrives twice, and no answer is for another robot.
                let more = robot.has_not_heard(|value| value["op"] == "service_response")?;
                ensure!(more, "{name} was answered twice");
                Ok(answers)
            })
        })
        .collect();
    sharer.wait_for_group(&daemon, "many answers of the other", |group| group["answered"].as_u64() > Some(100))?;
    kill_shim(&daemon, &victim)?;
    sharer.wait_for_group(&daemon, "another in its place", |group| {
        ready_count(group) == 2 && !group["servants"].to_string().contains(&victim)
    })?;
    killed.store(true, Ordering::SeqCst);
    let answer = long.wait_for("the end of its call", |value| value["id"] == "long")?;
    let words = answer["values"].as_str().unwrap_or_default();
    let told = words.contains(&victim) && words.contains("--idempotent");
    ensure!(answer["result"] == false && told, "{answer}");
    let mut by: BTreeMap<String, usize> = BTreeMap::new();
    for robot in working {
        for answer in robot.join().map_err(|_| anyhow::anyhow!("a robot panicked"))?? {
            let place = if answer["result"] == true {
                answer["values"]["where"].as_str()
            } else {
                let words = answer["values"].as_str().unwrap_or_default();
                ensure!(words.contains(&victim) && words.contains("--idempotent"), "{answer}");
                Some("failed")
            };
            *by.entry(place.unwrap_or_default().to_owned()).or_default() += 1;
        }
    }
    let failed = by.remove("failed").unwrap_or_default();
    ensure!(!by.contains_key(&victim), "its node was busy: {by:?}");
    let what = format!("{} requests that failed", failed + 1);
    sharer.wait_for_group(&daemon, &what, |group| group["failed"] == failed + 1)?;
    Ok(())
}

pub fn a_shared_service_grows_under_load_and_shrinks_after_it() -> Verdict {
    let sharer = OF_ONE;
    let daemon =
        sharer.start_daemon("sharing-scale", "[servant]\ngrace = \"3s\"\n", &["--max", "2", "--cpus", "0.2"])?;
    let mut busy =
        (0..6).map(|number| sharer.connect(&daemon, &format!("r{number}"))).collect::<anyhow::Result<Vec<_>>>()?;
    let deadline = Deadline::begin();
    loop {
        for robot in &mut busy {
            robot.send(json!({"op": "call_service", "service": "/work", "args": {"seconds": 0.2}}))?;
        }
        for robot in &mut busy {
            let answer = robot.wait_for("its answer", |value| value["op"] == "service_response")?;
            ensure!(answer["result"] == true, "{answer}");
        }
        let service = daemon.api(&sharer.service_path())?;
        if ready_count(&service["groups"][0]) == 2 {
            break;
        }
        deadline.check(|| format!("{service:#}"))?;
    }
    let few = sharer.wait_for_group(&daemon, "one servant again", |group| {
        group["servants"].as_array().is_some_and(|all| all.len() == 1)
    })?;
    ensure!(few["failed"] == 0, "{few:#}");
    let answer = busy[0].call("/work", json!({"who": "still", "seconds": 0.0}))?;
    ensure!(answer["values"]["who"] == "still", "{answer}");
    for reason in ["concurrent requests are many for 1 servants", "are few for 2 servants"] {
        daemon.wait_for_event(reason, |event| event["message"].to_string().contains(reason))?;
    }
    Ok(())
}

/// Sends a goal with the action operations.
fn send_goal(robot: &mut Robot, sharer: SharerNode, id: &str, goal: Value) -> Verdict {
    robot.send(json!({
        "op": "send_action_goal", "id": id, "action": "/count", "action_type": sharer.count, "args": goal,
            "feedback": true,
    }))
}

pub fn goals_of_robots_do_not_meet(ros: RosVersion) -> Verdict {
    let sharer = SharerNode::for_ros(ros);
    let daemon = sharer.start_daemon("sharing-goals", "", &["--max", "1"])?;
    let mut one = sharer.connect(&daemon, "one")?;
    let mut two = sharer.connect(&daemon, "two")?;
    send_goal(&mut one, sharer, "mine", json!({"who": "one", "to": 5}))?;
    let feedback = one.wait_for("feedback", |value| value["op"] == "action_feedback")?;
    ensure!(feedback["values"]["who"] == "one", "{feedback}");
    let goal = json!({"who": "two", "to": 3});
    match ros {
        // With actionlib's topics, as clients of ROS 1 do.
        RosVersion::One => {
            for topic in ["feedback", "result", "status"] {
                two.subscribe(&format!("/count/{topic}"))?;
            }
            two.send(json!({
                "op": "advertise", "topic": "/count/goal", "type": "sharer_cpp/CountActionGoal",
            }))?;
            two.send(json!({
                "op": "publish", "topic": "/count/goal", "msg": {"goal_id": {"id": "mine"}, "goal": goal},
            }))?;
        }
        RosVersion::Two => send_goal(&mut two, sharer, "mine", goal)?,
    }
    let result = one.wait_for("its result", |value| value["op"] == "action_result")?;
    ensure!(result["values"] == json!({"who": "one", "all": [1, 2, 3, 4, 5]}), "{result}");
    let result = match ros {
        RosVersion::One => {
            let result = two.next_message_on("/count/result")?;
            ensure!(result["status"]["goal_id"]["id"] == "mine", "{result}");
            result["result"].clone()
        }
        RosVersion::Two => {
            let result = two.wait_for("its result", |value| value["op"] == "action_result")?;
            ensure!(result["id"] == "mine", "{result}");
            result["values"].clone()
        }
    };
    ensure!(result == json!({"who": "two", "all": [1, 2, 3]}), "{result}");
    let foreign = |value: &Value| {
        let feedback = match ros {
            RosVersion::One => value["topic"] == "/count/feedback" && value["msg"]["feedback"]["who"] != "two",
            RosVersion::Two => value["op"] == "action_feedback" && value["values"]["who"] != "two",
        };
        feedback || value["topic"] == "/count/status" && value.to_string().contains("one")
    };
    ensure!(two.has_not_heard(foreign)?, "two heard of one's goal");
    let of_two = |value: &Value| value["op"] == "publish" || value["values"]["who"] == "two";
    ensure!(one.has_not_heard(of_two)?, "one heard of two's goal");
    // Neither of them gets the messages that the node publishes for everyone.
    let log = match ros {
        RosVersion::One => "rosgraph_msgs/Log",
        RosVersion::Two => "rcl_interfaces/msg/Log",
    };
    two.send(json!({"op": "subscribe", "topic": "/rosout", "type": log}))?;
    let refused = two.wait_for_status("/rosout")?;
    ensure!(refused["msg"].as_str().is_some_and(|words| words.contains("robots share")), "{refused}");
    // They may not change the node either.
    if ros == RosVersion::Two {
        let set = json!({"parameters": [{"name": "speed", "value": {"type": 3, "double_value": 100.0}}]});
        let refused = two.call("/sharer/set_parameters", set)?;
        ensure!(refused["result"] == false, "{refused}");
        let refused = two.call("/rosapi/set_param", json!({"name": "/sharer:speed", "value": "100.0"}))?;
        let words = refused.to_string();
        ensure!(words.contains("robots share"), "{refused}");
    }
    Ok(())
}

pub fn what_robots_cannot_share_is_refused_with_what_was_found(ros: RosVersion) -> Verdict {
    let daemon = world().setup(&format!("sharing-refused-{}", ros.number())).start()?;
    let (package, arguments) = match ros {
        RosVersion::One => ("greeter_cpp", &["--node", "greeter", "--shared"][..]),
        RosVersion::Two => ("herald_ros2", &["--node", "herald/herald", "--shared"][..]),
    };
    let refused = daemon.deployer().push(package, arguments)?;
    refused.expect_failure(&["robots cannot share it", "it subscribes to", "it publishes", "without --shared"])?;
    let sharer = SharerNode::for_ros(ros);
    let numbers: &[&str] = &["--shared", "--min", "5", "--max", "2"];
    let arguments = [sharer.arguments, numbers].concat();
    let refused = daemon.deployer().push(sharer.service, &arguments)?;
    refused.expect_failure(&["--min 5", "--max 2"])?;
    ensure!(daemon.deployer().run_json(&["services"])? == json!([]), "something was published");
    Ok(())
}

pub fn of_two_replicas_the_first_answers_and_the_cost_is_shown(ros: RosVersion) -> Verdict {
    let sharer = SharerNode::for_ros(ros);
    let daemon = sharer.start_daemon("sharing-replicas", "", &["--replicas", "2", "--max", "2"])?;
    let mut robot = sharer.connect(&daemon, "one")?;
    sharer.wait_for_group(&daemon, "two servants", |group| ready_count(group) == 2)?;
    for number in 0..5 {
        let answer = robot.call("/work", json!({"who": format!("{number}"), "seconds": 0.0}))?;
        ensure!(answer["values"]["who"] == format!("{number}"), "{answer}");
    }
    // The second answer to a request arrives long after the robot got the first.
    let group = sharer
        .wait_for_group(&daemon, "five answers, each twice", |group| group["answered"] == 5 && group["wasted"] == 5)?;
    ensure!(group["failed"] == 0, "{group:#}");
    let shown = daemon.deployer().run(&["services", sharer.service])?.expect_success()?;
    ensure!(shown.stdout.contains("5 of 10 answers unused"), "{}", shown.stdout);
    Ok(())
}
