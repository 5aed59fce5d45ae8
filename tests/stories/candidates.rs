//! A revision is compared with the one that a robot uses, at the robot's own requests, and the robot notices nothing.

use std::cell::RefCell;
use std::io::{BufRead, BufReader, Lines};
use std::process::{Child, ChildStdout, Command, Stdio};

use anyhow::{Context, bail, ensure};
use ros::bus::Message;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::Site;
use support::world::world;

/// `cloudroidctl shadow`, while it compares.
struct Comparing {
    ctl: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Comparing {
    /// Comes back once the candidate is given what the robot asks.
    fn begins(daemon: &Daemon, arguments: &[&str]) -> anyhow::Result<Comparing> {
        let mut ctl = Command::new(support::binaries::path("cloudroidctl"))
            .env("CLOUDROID_HOME", &daemon.home)
            .env_remove("CLOUDROID_SERVER")
            .args(["--format", "json", "shadow"])
            .args(arguments)
            .stdout(Stdio::piped())
            .spawn()?;
        let stdout = ctl.stdout.take().context("its standard output")?;
        let mut comparing = Comparing {
            ctl,
            lines: BufReader::new(stdout).lines(),
        };
        while let Some(line) = comparing.lines.next() {
            let event: Value = serde_json::from_str(&line?)?;
            let title = event["title"].as_str().unwrap_or_default();
            if title.starts_with("comparing") {
                return Ok(comparing);
            }
        }
        bail!(
            "{arguments:?} ended before it compared: {}",
            comparing.ctl.wait()?
        )
    }

    /// What it found, once it is over.
    fn found(mut self) -> anyhow::Result<Value> {
        let mut last = String::new();
        for line in self.lines.by_ref() {
            last = line?;
        }
        ensure!(self.ctl.wait()?.success(), "it failed: {last}");
        serde_json::from_str(&last).with_context(|| last.clone())
    }
}

impl Drop for Comparing {
    fn drop(&mut self) {
        let _ = self.ctl.kill();
        let _ = self.ctl.wait();
    }
}

/// What was found of a topic, service or action.
fn row(found: &Value, name: &str) -> anyhow::Result<Value> {
    let rows = found["compared"].as_array().context("what was compared")?;
    let row = rows.iter().find(|row| row["name"] == name);
    row.cloned().with_context(|| format!("{name} in {found:#}"))
}

fn none_is_left(daemon: &Daemon, service: &str) -> Verdict {
    support::until("the candidate's end", || {
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

fn pushes(daemon: &Daemon, more: &[&str]) -> Verdict {
    let arguments = [["--node", "adder.py"].as_slice(), more].concat();
    let pushed = daemon.deployer().pushes("adder_py", &arguments)?;
    pushed.succeeded().map(|_| ())
}

/// A robot that hears what its node says of its sums.
fn listener(daemon: &Daemon, name: &str) -> anyhow::Result<Robot> {
    let mut robot = daemon.robot(&format!("adder_py?robot={name}"))?;
    robot.subscribes("/sums")?;
    // What is said before the node has connected to it, it does not hear; what it has heard by then is forgotten.
    support::until("its subscription", || {
        robot.calls("/add_two", json!({"a": 1, "b": 1}))?;
        let hears_nothing = robot.has_not_heard(|value| value["topic"] == "/sums")?;
        Ok((!hears_nothing)
            .then_some(())
            .ok_or_else(|| "it hears nothing yet".to_owned()))
    })?;
    robot.calls("/add_two", json!({"a": 1, "b": -1}))?;
    while robot.hears_on("/sums")?["data"] != "0" {}
    Ok(robot)
}

/// Its answers are those of its own servant, each once.
fn adds(robot: &mut Robot, times: usize) -> Verdict {
    for _ in 0..times {
        let answer = robot.calls("/add_two", json!({"a": 1, "b": 1}))?;
        ensure!(answer["values"]["sum"] == 2, "{answer}");
        let said = robot.hears_on("/sums")?;
        ensure!(said["data"] == "2", "{said}");
    }
    Ok(())
}

pub fn a_candidate_that_adds_otherwise_is_told_and_its_robot_hears_none_of_it() -> Verdict {
    let daemon = world().own("candidates").start()?;
    pushes(&daemon, &[])?;
    let mut robot = listener(&daemon, "r1")?;
    adds(&mut robot, 1)?;
    pushes(&daemon, &["--param", "offset=100"])?;
    pushes(&daemon, &["--param", "offset=oops"])?;

    let requests = ["--requests", "5"];
    let comparing = Comparing::begins(&daemon, &[&["adder_py", "2"], &requests[..]].concat())?;
    adds(&mut robot, 5)?;
    let found = comparing.found()?;
    ensure!(found["verdict"] == "different", "{found:#}");
    ensure!(
        found["robot"] == "r1" && found["revision"] == 1 && found["candidate"] == 2,
        "{found:#}"
    );
    let (service, topic) = (row(&found, "/add_two")?, row(&found, "/sums")?);
    for (row, field, present, candidate) in [
        (&service, "sum", "2", "102"),
        (&topic, "data", "\"2\"", "\"102\""),
    ] {
        let expected = json!([
            {"field": field, "answers": 5, "present": present, "candidate": candidate}
        ]);
        ensure!(row["fields"] == expected, "{found:#}");
        ensure!(
            row["different"] == 5 && row["missing"] == 0 && row["surplus"] == 0,
            "{found:#}"
        );
        for times in ["present", "candidate"] {
            ensure!(row[times]["p50"].as_f64() > Some(0.0), "{found:#}");
        }
    }

    // What may differ does not count.
    let may = ["--tolerance", "100", "--ignore", "data", "--bound", "1000"];
    let arguments = [&["adder_py", "2"], &may[..], &requests].concat();
    let comparing = Comparing::begins(&daemon, &arguments)?;
    adds(&mut robot, 5)?;
    let found = comparing.found()?;
    ensure!(found["verdict"] == "equal", "{found:#}");

    // No answer is told from another one.
    let comparing = Comparing::begins(&daemon, &["adder_py", "3", "--requests", "2"])?;
    adds(&mut robot, 2)?;
    let found = comparing.found()?;
    let refused = &row(&found, "/add_two")?["fields"][0];
    let words = refused["candidate"].as_str().unwrap_or_default();
    ensure!(
        refused["field"] == "" && words.starts_with("failed: "),
        "{found:#}"
    );
    none_is_left(&daemon, "adder_py")?;

    let nothing = robot.has_not_heard(|value| {
        let other = |field: &Value, own: Value| !field.is_null() && *field != own;
        other(&value["values"]["sum"], json!(2)) || other(&value["msg"]["data"], json!("2"))
    })?;
    ensure!(nothing, "the robot heard a candidate");
    let refusals: [(&[&str], &str); 3] = [
        (&["9"], "adder_py has no revision 9"),
        (&["1"], "robot r1 uses revision 1 of adder_py already"),
        (
            &["2", "--robot", "nobody", "--seconds", "0.3"],
            "robot nobody did not use adder_py within 0.3 s",
        ),
    ];
    for (arguments, words) in refusals {
        let arguments = [&["shadow", "adder_py"], arguments].concat();
        daemon
            .deployer()
            .types(&arguments)?
            .failed_saying(&[words])?;
    }
    Ok(())
}

pub fn what_a_robot_says_is_said_to_a_candidate_too() -> Verdict {
    let daemon = world().own("candidates-topics").start()?;
    let arguments = ["--node", "teller.py"];
    daemon
        .deployer()
        .pushes("teller_py", &arguments)?
        .succeeded()?;
    let mut robot = daemon.robot("teller_py?robot=talker")?;
    robot.says(json!({"op": "advertise", "topic": "/teller/say", "type": "std_msgs/String"}))?;
    robot.subscribes("/teller/said")?;
    robot.subscribes("/teller/told")?;
    robot.hears_on("/teller/told")?;
    robot.awaits_subscriber("/teller/say")?;
    let says = |robot: &mut Robot, word: &str| -> Verdict {
        robot.says(json!({"op": "publish", "topic": "/teller/say", "msg": {"data": word}}))?;
        let said = robot.hears_on("/teller/said")?;
        ensure!(said["data"] == word, "{said}");
        Ok(())
    };
    let before = json!({"op": "publish", "topic": "/teller/say", "msg": {"data": "before"}});
    robot.says_until(&before, "what the node says", |message| {
        message["topic"] == "/teller/said"
    })?;
    robot.says(json!({"op": "publish", "topic": "/teller/say", "msg": {"data": "heard"}}))?;
    while robot.hears_on("/teller/said")?["data"] != "heard" {}
    let changed = [&arguments[..], &["--param", "word=another"]].concat();
    daemon
        .deployer()
        .pushes("teller_py", &changed)?
        .succeeded()?;
    let arguments = ["teller_py", "2", "--requests", "6", "--bound", "1000"];
    let comparing = Comparing::begins(&daemon, &arguments)?;
    for number in 0..6 {
        says(&mut robot, &format!("word {number}"))?;
    }
    let found = comparing.found()?;
    // What it said of itself at its start is latched, and compared, too.
    let (said, told) = (row(&found, "/teller/said")?, row(&found, "/teller/told")?);
    ensure!(said["equal"] == 6, "{found:#}");
    ensure!(said["present"]["p50"].as_f64() > Some(0.0), "{found:#}");
    ensure!(said["candidate"]["p50"].as_f64() > Some(0.0), "{found:#}");
    ensure!(told["different"] == 1, "{found:#}");
    let words = told["fields"][0].to_string();
    ensure!(words.contains("data"), "{found:#}");
    ensure!(
        found["verdict"] == "different" && found["given"] == 6,
        "{found:#}"
    );
    none_is_left(&daemon, "teller_py")
}

pub fn calls_and_goals_are_carried_out_by_a_candidate_too() -> Verdict {
    carries_out("candidates-goals", &[])
}

pub fn a_shared_service_is_compared_at_one_robots_calls_and_goals() -> Verdict {
    carries_out("candidates-shared", &["--shared"])
}

fn carries_out(home: &str, more: &[&str]) -> Verdict {
    let daemon = world().own(home).start()?;
    let arguments = [&["--node", "sharer"], more].concat();
    let pushes = || {
        let pushed = daemon.deployer().pushes("sharer_cpp", &arguments)?;
        pushed.succeeded()
    };
    pushes()?;
    let mut robot = daemon.robot("sharer_cpp?robot=r1")?;
    let work = json!({"who": "r1", "seconds": 0.0});
    robot.calls("/work", work)?;
    pushes()?;
    let comparing = Comparing::begins(&daemon, &["sharer_cpp", "2", "--requests", "3"])?;
    for number in 0..2 {
        let work = json!({"who": format!("r1 {number}"), "seconds": 0.05});
        let answer = robot.calls("/work", work)?;
        ensure!(answer["result"] == true, "{answer}");
    }
    robot.says(json!({
        "op": "send_action_goal", "id": "goal", "action": "/count", "action_type": "sharer_cpp/Count",
        "args": {"who": "r1", "to": 3},
    }))?;
    let result = robot.hears("its result", |value| value["op"] == "action_result")?;
    ensure!(result["values"]["all"] == json!([1, 2, 3]), "{result}");
    let found = comparing.found()?;
    let (work, count) = (row(&found, "/work")?, row(&found, "/count")?);
    // It says in which container it was done.
    ensure!(work["fields"][0]["field"] == "where", "{found:#}");
    ensure!(work["different"] == 2, "{found:#}");
    ensure!(
        count["kind"] == "action" && count["equal"] == 1,
        "{found:#}"
    );
    ensure!(
        count["candidate"]["p50"].as_f64() > Some(200.0),
        "{found:#}"
    );
    let once = robot.has_not_heard(|value| {
        value["op"] == "action_result" || value["op"] == "service_response"
    })?;
    ensure!(once, "it was answered twice");
    none_is_left(&daemon, "sharer_cpp")
}

pub fn a_candidate_gives_way_to_a_robot_and_what_was_compared_is_told() -> Verdict {
    let daemon = world()
        .own("candidates-room")
        .config("[capacity]\ncpus = 2.0\n[servant]\nwarm_pool = 0\n")
        .start()?;
    pushes(&daemon, &["--cpus", "1"])?;
    let mut first = listener(&daemon, "first")?;
    adds(&mut first, 1)?;
    pushes(&daemon, &["--cpus", "1", "--param", "offset=100"])?;
    let comparing = Comparing::begins(&daemon, &["adder_py", "2"])?;
    adds(&mut first, 3)?;
    let mut second = daemon.robot("adder_py?robot=second")?;
    let answer = second.calls("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(answer["values"]["sum"] == 102, "{answer}");
    let found = comparing.found()?;
    let ended = found["ended"].as_str().unwrap_or_default();
    ensure!(ended.contains("a robot needs its room"), "{found:#}");
    // What it had not answered by then is no fault of its revision.
    for row in found["compared"].as_array().into_iter().flatten() {
        ensure!(row["missing"] == 0, "{found:#}");
    }
    adds(&mut first, 1)?;
    none_is_left(&daemon, "adder_py")
}

/// A robot whose stub starts the node, by names of the robot's and with its parameters.
pub fn a_stubs_node_is_started_in_a_candidate_as_it_is_on_its_robot() -> Verdict {
    let daemon = world().own("candidates-stub").start()?;
    pushes(&daemon, &[])?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let argv = [
        "__name:=sum",
        "/add_two:=/robot/add",
        "/sums:=/robot/sums",
        "_offset:=7",
    ];
    let stub = site.stub(
        &daemon,
        ("adder_py", "adder_py", "adder.py"),
        "linked",
        &argv,
    )?;
    let said = || format!("the stub said:\n{}", stub.said());
    site.until(&app, "the service", |graph| {
        graph.services.contains_key("/robot/add")
    })
    .with_context(said)?;
    let mut sums = site.hears(&app, "/robot/sums")?;
    let mut sum = 7i64;
    let mut asks = || -> anyhow::Result<String> {
        sum += 1;
        let request: Vec<u8> = [sum - 7, 0].iter().flat_map(|n| n.to_le_bytes()).collect();
        let answer = site.calls(&app, "/robot/add", &request)?;
        ensure!(*answer == sum.to_le_bytes(), "{answer:?}");
        Ok(sum.to_string())
    };
    // What the node says before all are connected is lost, as in every ROS.
    let last = RefCell::new(String::new());
    let ask = || {
        *last.borrow_mut() = asks()?;
        Ok(())
    };
    let is_last = |said: &Message| Ok(said.bytes.ends_with(last.borrow().as_bytes()));
    site.asks_until(&mut sums, ask, is_last)
        .with_context(said)?;
    let mut adds = || -> Verdict {
        let sum = asks()?;
        let said = site.next(&mut sums)?;
        ensure!(said.bytes.ends_with(sum.as_bytes()), "{said:?}");
        Ok(())
    };
    // Another revision, which adds as the one before.
    pushes(&daemon, &["--cpus", "1"])?;
    let arguments = ["adder_py", "2", "--requests", "5", "--bound", "1000"];
    let comparing = Comparing::begins(&daemon, &arguments)?;
    for _ in 0..5 {
        adds().with_context(said)?;
    }
    let found = comparing.found()?;
    ensure!(
        found["verdict"] == "equal" && found["given"] == 5,
        "{found:#}"
    );
    for name in ["/robot/add", "/robot/sums"] {
        // The last answer may still be on its way when all requests were given.
        let owed = found["not_compared"].as_array().context("what was not")?;
        let owed = owed.iter().filter(|one| one["what"] == name);
        let owed: u64 = owed.filter_map(|one| one["count"].as_u64()).sum();
        let equal = row(&found, name)?["equal"].as_u64().unwrap_or_default();
        ensure!(equal + owed == 5 && owed <= 1, "{found:#}");
    }
    none_is_left(&daemon, "adder_py")
}
