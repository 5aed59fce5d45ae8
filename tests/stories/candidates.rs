//! A revision is compared with the one that a robot uses, with the robot's own requests, without affecting the robot.

use std::cell::RefCell;
use std::io::{BufRead, BufReader, Lines};
use std::process::{Child, ChildStdout, Command, Stdio};

use anyhow::{Context, bail, ensure};
use ros::bus::SerializedMessage;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::Site;
use support::world::world;

/// A running `cloudroidctl shadow`.
struct Comparison {
    ctl: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Comparison {
    /// Starts a comparison; returns once the candidate receives the robot's requests.
    fn start(daemon: &Daemon, arguments: &[&str]) -> anyhow::Result<Comparison> {
        let mut ctl = Command::new(support::binaries::path("cloudroidctl"))
            .env("CLOUDROID_HOME", &daemon.home)
            .env_remove("CLOUDROID_SERVER")
            .args(["--format", "json", "shadow"])
            .args(arguments)
            .stdout(Stdio::piped())
            .spawn()?;
        let stdout = ctl.stdout.take().context("its standard output")?;
        let mut comparing = Comparison { ctl, lines: BufReader::new(stdout).lines() };
        while let Some(line) = comparing.lines.next() {
            let event: Value = serde_json::from_str(&line?)?;
            let title = event["title"].as_str().unwrap_or_default();
            if title.starts_with("comparing") {
                return Ok(comparing);
            }
        }
        bail!("{arguments:?} ended before it compared: {}", comparing.ctl.wait()?)
    }

    /// Waits for the end and returns the result.
    fn finish(mut self) -> anyhow::Result<Value> {
        let mut last = String::new();
        for line in self.lines.by_ref() {
            last = line?;
        }
        ensure!(self.ctl.wait()?.success(), "it failed: {last}");
        serde_json::from_str(&last).with_context(|| last.clone())
    }
}

impl Drop for Comparison {
    fn drop(&mut self) {
        let _ = self.ctl.kill();
        let _ = self.ctl.wait();
    }
}

/// Returns the result for a topic, service or action.
fn find_row(found: &Value, name: &str) -> anyhow::Result<Value> {
    let rows = found["compared"].as_array().context("what was compared")?;
    let row = rows.iter().find(|row| row["name"] == name);
    row.cloned().with_context(|| format!("{name} in {found:#}"))
}

fn wait_until_none_left(daemon: &Daemon, service: &str) -> Verdict {
    support::wait_until("the candidate's end", || {
        let servants = daemon.servants_of(service)?;
        let is_candidate = |servant: &Value| {
            let robot = servant["robot"].as_str().unwrap_or_default();
            robot.starts_with("~shadow-")
        };
        Ok(match servants.iter().find(|one| is_candidate(one)) {
            Some(left) => Err(format!("{left:#}")),
            None => Ok(()),
        })
    })
}

fn push(daemon: &Daemon, more: &[&str]) -> Verdict {
    let arguments = [["--node", "adder.py"].as_slice(), more].concat();
    let pushed = daemon.deployer().push("adder_py", &arguments)?;
    pushed.expect_success().map(|_| ())
}

/// Connects a robot that receives the sums published by its node.
fn connect_listener(daemon: &Daemon, name: &str) -> anyhow::Result<Robot> {
    let mut robot = daemon.robot(&format!("adder_py?robot={name}"))?;
    robot.subscribe("/sums")?;
    // Earlier messages are lost until the node has connected; those received by then are ignored.
    support::wait_until("its subscription", || {
        robot.call("/add_two", json!({"a": 1, "b": 1}))?;
        let hears_nothing = robot.has_not_heard(|value| value["topic"] == "/sums")?;
        Ok((!hears_nothing).then_some(()).ok_or_else(|| "it hears nothing yet".to_owned()))
    })?;
    robot.call("/add_two", json!({"a": 1, "b": -1}))?;
    while robot.next_message_on("/sums")?["data"] != "0" {}
    Ok(robot)
}

/// Checks that each answer is from the robot's own servant and arrives once.
fn expect_sums(robot: &mut Robot, times: usize) -> Verdict {
    for _ in 0..times {
        let answer = robot.call("/add_two", json!({"a": 1, "b": 1}))?;
        ensure!(answer["values"]["sum"] == 2, "{answer}");
        let said = robot.next_message_on("/sums")?;
        ensure!(said["data"] == "2", "{said}");
    }
    Ok(())
}

pub fn a_candidate_that_adds_otherwise_is_told_and_its_robot_hears_none_of_it() -> Verdict {
    let daemon = world().setup("candidates").start()?;
    push(&daemon, &[])?;
    let mut robot = connect_listener(&daemon, "r1")?;
    expect_sums(&mut robot, 1)?;
    push(&daemon, &["--param", "offset=100"])?;
    push(&daemon, &["--param", "offset=oops"])?;

    let requests = ["--requests", "5"];
    let comparing = Comparison::start(&daemon, &[&["adder_py", "2"], &requests[..]].concat())?;
    expect_sums(&mut robot, 5)?;
    let found = comparing.finish()?;
    ensure!(found["verdict"] == "different", "{found:#}");
    ensure!(found["robot"] == "r1" && found["revision"] == 1 && found["candidate"] == 2, "{found:#}");
    let (service, topic) = (find_row(&found, "/add_two")?, find_row(&found, "/sums")?);
    for (row, field, present, candidate) in [(&service, "sum", "2", "102"), (&topic, "data", "\"2\"", "\"102\"")] {
        let expected = json!([
            {"field": field, "answers": 5, "present": present, "candidate": candidate}
        ]);
        ensure!(row["fields"] == expected, "{found:#}");
        ensure!(row["different"] == 5 && row["missing"] == 0 && row["surplus"] == 0, "{found:#}");
        for times in ["present", "candidate"] {
            ensure!(row[times]["p50"].as_f64() > Some(0.0), "{found:#}");
        }
    }

    // Permitted differences do not count.
    let may = ["--tolerance", "100", "--ignore", "data", "--bound", "1000"];
    let arguments = [&["adder_py", "2"], &may[..], &requests].concat();
    let comparing = Comparison::start(&daemon, &arguments)?;
    expect_sums(&mut robot, 5)?;
    let found = comparing.finish()?;
    ensure!(found["verdict"] == "equal", "{found:#}");

    // Without permitted differences the answers differ.
    let comparing = Comparison::start(&daemon, &["adder_py", "3", "--requests", "2"])?;
    expect_sums(&mut robot, 2)?;
    let found = comparing.finish()?;
    let refused = &find_row(&found, "/add_two")?["fields"][0];
    let words = refused["candidate"].as_str().unwrap_or_default();
    ensure!(refused["field"] == "" && words.starts_with("failed: "), "{found:#}");
    wait_until_none_left(&daemon, "adder_py")?;

    let nothing = robot.has_not_heard(|value| {
        let other = |field: &Value, own: Value| !field.is_null() && *field != own;
        other(&value["values"]["sum"], json!(2)) || other(&value["msg"]["data"], json!("2"))
    })?;
    ensure!(nothing, "the robot heard a candidate");
    let refusals: [(&[&str], &str); 3] = [
        (&["9"], "adder_py has no revision 9"),
        (&["1"], "robot r1 already uses revision 1 of adder_py"),
        (&["2", "--robot", "nobody", "--seconds", "0.3"], "robot nobody did not use adder_py within 0.3 s"),
    ];
    for (arguments, words) in refusals {
        let arguments = [&["shadow", "adder_py"], arguments].concat();
        daemon.deployer().run(&arguments)?.expect_failure(&[words])?;
    }
    Ok(())
}

pub fn what_a_robot_says_is_said_to_a_candidate_too() -> Verdict {
    let daemon = world().setup("candidates-topics").start()?;
    let arguments = ["--node", "teller.py"];
    daemon.deployer().push("teller_py", &arguments)?.expect_success()?;
    let mut robot = daemon.robot("teller_py?robot=talker")?;
    robot.send(json!({"op": "advertise", "topic": "/teller/say", "type": "std_msgs/String"}))?;
    robot.subscribe("/teller/said")?;
    robot.subscribe("/teller/told")?;
    robot.next_message_on("/teller/told")?;
    robot.wait_for_subscriber("/teller/say")?;
    let says = |robot: &mut Robot, word: &str| -> Verdict {
        robot.send(json!({"op": "publish", "topic": "/teller/say", "msg": {"data": word}}))?;
        let said = robot.next_message_on("/teller/said")?;
        ensure!(said["data"] == word, "{said}");
        Ok(())
    };
    let before = json!({"op": "publish", "topic": "/teller/say", "msg": {"data": "before"}});
    robot.send_until(&before, "what the node says", |message| message["topic"] == "/teller/said")?;
    robot.send(json!({"op": "publish", "topic": "/teller/say", "msg": {"data": "heard"}}))?;
    while robot.next_message_on("/teller/said")?["data"] != "heard" {}
    let changed = [&arguments[..], &["--param", "word=another"]].concat();
    daemon.deployer().push("teller_py", &changed)?.expect_success()?;
    let arguments = ["teller_py", "2", "--requests", "6", "--bound", "1000"];
    let comparing = Comparison::start(&daemon, &arguments)?;
    for number in 0..6 {
        says(&mut robot, &format!("word {number}"))?;
    }
    let found = comparing.finish()?;
    // The message published at startup is latched, and compared as well.
    let (said, told) = (find_row(&found, "/teller/said")?, find_row(&found, "/teller/told")?);
    ensure!(said["equal"] == 6, "{found:#}");
    ensure!(said["present"]["p50"].as_f64() > Some(0.0), "{found:#}");
    ensure!(said["candidate"]["p50"].as_f64() > Some(0.0), "{found:#}");
    ensure!(told["different"] == 1, "{found:#}");
    let words = told["fields"][0].to_string();
    ensure!(words.contains("data"), "{found:#}");
    ensure!(found["verdict"] == "different" && found["given"] == 6, "{found:#}");
    wait_until_none_left(&daemon, "teller_py")
}

pub fn calls_and_goals_are_carried_out_by_a_candidate_too() -> Verdict {
    compare_calls_and_goals("candidates-goals", &[])
}

pub fn a_shared_service_is_compared_at_one_robots_calls_and_goals() -> Verdict {
    compare_calls_and_goals("candidates-shared", &["--shared"])
}

fn compare_calls_and_goals(home: &str, more: &[&str]) -> Verdict {
    let daemon = world().setup(home).start()?;
    let arguments = [&["--node", "sharer"], more].concat();
    let pushes = |more: &[&str]| {
        let pushed = daemon.deployer().push("sharer_cpp", &[&arguments, more].concat())?;
        pushed.expect_success()
    };
    pushes(&[])?;
    let mut robot = daemon.robot("sharer_cpp?robot=r1")?;
    let work = json!({"who": "r1", "seconds": 0.0});
    robot.call("/work", work)?;
    // Otherwise it would be unchanged.
    pushes(&["--pids", "500"])?;
    let comparing = Comparison::start(&daemon, &["sharer_cpp", "2", "--requests", "3"])?;
    for number in 0..2 {
        let work = json!({"who": format!("r1 {number}"), "seconds": 0.05});
        let answer = robot.call("/work", work)?;
        ensure!(answer["result"] == true, "{answer}");
    }
    robot.send(json!({
        "op": "send_action_goal", "id": "goal", "action": "/count", "action_type": "sharer_cpp/Count",
        "args": {"who": "r1", "to": 3},
    }))?;
    let result = robot.wait_for("its result", |value| value["op"] == "action_result")?;
    ensure!(result["values"]["all"] == json!([1, 2, 3]), "{result}");
    let found = comparing.finish()?;
    let (work, count) = (find_row(&found, "/work")?, find_row(&found, "/count")?);
    // The response contains the name of the container.
    ensure!(work["fields"][0]["field"] == "where", "{found:#}");
    ensure!(work["different"] == 2, "{found:#}");
    ensure!(count["kind"] == "action" && count["equal"] == 1, "{found:#}");
    ensure!(count["candidate"]["p50"].as_f64() > Some(200.0), "{found:#}");
    let once = robot.has_not_heard(|value| value["op"] == "action_result" || value["op"] == "service_response")?;
    ensure!(once, "it was answered twice");
    wait_until_none_left(&daemon, "sharer_cpp")
}

pub fn a_candidate_gives_way_to_a_robot_and_what_was_compared_is_told() -> Verdict {
    let daemon =
        world().setup("candidates-room").config("[capacity]\ncpus = 2.0\n[servant]\nwarm_pool = 0\n").start()?;
    push(&daemon, &["--cpus", "1"])?;
    let mut first = connect_listener(&daemon, "first")?;
    expect_sums(&mut first, 1)?;
    push(&daemon, &["--cpus", "1", "--param", "offset=100"])?;
    let comparing = Comparison::start(&daemon, &["adder_py", "2"])?;
    expect_sums(&mut first, 3)?;
    let mut second = daemon.robot("adder_py?robot=second")?;
    let answer = second.call("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(answer["values"]["sum"] == 102, "{answer}");
    let found = comparing.finish()?;
    let ended = found["ended"].as_str().unwrap_or_default();
    ensure!(ended.contains("a robot needs this capacity"), "{found:#}");
    // Requests not answered by then do not count against the revision.
    for row in found["compared"].as_array().into_iter().flatten() {
        ensure!(row["missing"] == 0, "{found:#}");
    }
    expect_sums(&mut first, 1)?;
    wait_until_none_left(&daemon, "adder_py")
}

/// A robot whose stub starts the node, with the robot's names and parameters.
pub fn a_stubs_node_is_started_in_a_candidate_as_it_is_on_its_robot() -> Verdict {
    let daemon = world().setup("candidates-stub").start()?;
    push(&daemon, &[])?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let argv = ["__name:=sum", "/add_two:=/robot/add", "/sums:=/robot/sums", "_offset:=7"];
    let stub = site.start_stub(&daemon, ("adder_py", "adder_py", "adder.py"), "linked", &argv)?;
    let said = || format!("the stub said:\n{}", stub.output());
    site.wait_for_graph(&app, "the service", |graph| graph.services.contains_key("/robot/add")).with_context(said)?;
    let mut sums = site.subscribe(&app, "/robot/sums")?;
    let mut sum = 7i64;
    let mut asks = || -> anyhow::Result<String> {
        sum += 1;
        let request: Vec<u8> = [sum - 7, 0].iter().flat_map(|n| n.to_le_bytes()).collect();
        let answer = site.call_service(&app, "/robot/add", &request)?;
        ensure!(*answer == sum.to_le_bytes(), "{answer:?}");
        Ok(sum.to_string())
    };
    // As in every ROS, messages are lost until both sides are connected.
    let last = RefCell::new(String::new());
    let ask = || {
        *last.borrow_mut() = asks()?;
        Ok(())
    };
    let is_last = |said: &SerializedMessage| Ok(said.bytes.ends_with(last.borrow().as_bytes()));
    site.ask_until(&mut sums, ask, is_last).with_context(said)?;
    let mut adds = || -> Verdict {
        let sum = asks()?;
        let said = site.next_message(&mut sums)?;
        ensure!(said.bytes.ends_with(sum.as_bytes()), "{said:?}");
        Ok(())
    };
    // Another revision that adds in the same way.
    push(&daemon, &["--cpus", "1"])?;
    let arguments = ["adder_py", "2", "--requests", "5", "--bound", "1000"];
    let comparing = Comparison::start(&daemon, &arguments)?;
    for _ in 0..5 {
        adds().with_context(said)?;
    }
    let found = comparing.finish()?;
    ensure!(found["verdict"] == "equal" && found["given"] == 5, "{found:#}");
    for name in ["/robot/add", "/robot/sums"] {
        // The last answer may still be in flight after all requests have been passed on.
        let owed = found["not_compared"].as_array().context("what was not")?;
        let owed = owed.iter().filter(|one| one["what"] == name);
        let owed: u64 = owed.filter_map(|one| one["count"].as_u64()).sum();
        let equal = find_row(&found, name)?["equal"].as_u64().unwrap_or_default();
        ensure!(equal + owed == 5 && owed <= 1, "{found:#}");
    }
    wait_until_none_left(&daemon, "adder_py")
}
