//! Services that robots share: their requests are spread over servants, and none sees another's.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use anyhow::{Context, ensure};
use bytes::Bytes;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ros::bus::{Bus, Publisher, Qos, Subscription};
use ros::ros1::Ros1Bus;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::{PATIENCE, Robot};
use support::site::{Running, Site, registered, string};
use support::world::world;

const SERVICE: &str = "sharer_cpp";

fn pushed(home: &str, config: &str, arguments: &[&str]) -> anyhow::Result<Daemon> {
    let daemon = world().own(home).config(config).start()?;
    let arguments = [&["--node", "sharer", "--shared"], arguments].concat();
    daemon.deployer().pushes(SERVICE, &arguments)?.succeeded()?;
    Ok(daemon)
}

fn robot(daemon: &Daemon, name: &str) -> anyhow::Result<Robot> {
    daemon.robot(&format!("{SERVICE}?robot={name}"))
}

/// The group, once it is so.
fn group(daemon: &Daemon, what: &str, is: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
    daemon.awaits(&format!("/api/v1/services/{SERVICE}"), what, |service| {
        service["groups"]
            .as_array()?
            .iter()
            .find(|group| is(group))
            .cloned()
    })
}

fn ready(group: &Value) -> usize {
    let servants = group["servants"].as_array();
    servants.map_or(0, |all| {
        all.iter().filter(|one| one["ready"] == true).count()
    })
}

/// Ends a servant as a failing machine would.
fn fails(daemon: &Daemon, id: &str) -> Verdict {
    let runtime = daemon.home.join("servants").join(id).join("runtime.json");
    let runtime: Value = serde_json::from_slice(&std::fs::read(runtime)?)?;
    let shim = runtime["shim"]["pid"].as_i64().context("the shim's pid")?;
    Ok(kill(Pid::from_raw(shim as i32), Signal::SIGKILL)?)
}

pub fn twenty_robots_share_two_servants_and_one_of_these_is_killed() -> Verdict {
    let daemon = Arc::new(pushed("sharing", "", &["--min", "2", "--max", "2"])?);
    let mut long = robot(&daemon, "r0")?;
    let mut robots = Vec::new();
    for number in 1..20 {
        let name = format!("r{number}");
        robots.push((name.clone(), robot(&daemon, &name)?));
    }
    let before = group(&daemon, "two servants", |group| ready(group) == 2)?;
    ensure!(before["robots"] == 20, "{before:#}");
    // Both have answered before; then one has a call that it will not end.
    for (name, robot) in &mut robots {
        let answer = robot.calls("/work", json!({"who": name, "seconds": 0.0}))?;
        ensure!(answer["result"] == true, "{answer}");
    }
    long.says(json!({
        "op": "call_service", "id": "long", "service": "/work", "args": {"who": "r0", "seconds": 3600.0},
    }))?;
    let victim = daemon.awaits(
        &format!("/api/v1/services/{SERVICE}"),
        "the servant that has it",
        |service| {
            let servants = service["groups"][0]["servants"].as_array()?;
            let busy = servants.iter().find(|one| one["under_way"] == 1)?;
            Some(busy["id"].as_str()?.to_owned())
        },
    )?;
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
                    let answer = robot.calls("/work", json!({"who": who, "seconds": 0.01}))?;
                    if answer["result"] == true {
                        ensure!(
                            answer["values"]["who"] == who.as_str(),
                            "not its own: {answer}"
                        );
                    }
                    answers.push(answer);
                }
                // Of what was answered nothing comes twice, and nothing of another.
                let more = robot.has_not_heard(|value| value["op"] == "service_response")?;
                ensure!(more, "{name} was answered twice");
                Ok(answers)
            })
        })
        .collect();
    group(&daemon, "many answers of the other", |group| {
        group["answered"].as_u64() > Some(100)
    })?;
    fails(&daemon, &victim)?;
    group(&daemon, "another in its place", |group| {
        ready(group) == 2 && !group["servants"].to_string().contains(&victim)
    })?;
    killed.store(true, Ordering::SeqCst);
    let answer = long.hears("the end of its call", |value| value["id"] == "long")?;
    let words = answer["values"].as_str().unwrap_or_default();
    let told = words.contains(&victim) && words.contains("--idempotent");
    ensure!(answer["result"] == false && told, "{answer}");
    let mut by: BTreeMap<String, usize> = BTreeMap::new();
    for robot in working {
        for answer in robot
            .join()
            .map_err(|_| anyhow::anyhow!("a robot panicked"))??
        {
            let place = match answer["result"] == true {
                true => answer["values"]["where"].as_str(),
                false => {
                    let words = answer["values"].as_str().unwrap_or_default();
                    ensure!(
                        words.contains(&victim) && words.contains("--idempotent"),
                        "{answer}"
                    );
                    Some("failed")
                }
            };
            *by.entry(place.unwrap_or_default().to_owned()).or_default() += 1;
        }
    }
    let failed = by.remove("failed").unwrap_or_default();
    ensure!(!by.contains_key(&victim), "its node was busy: {by:?}");
    let after = group(&daemon, "what was counted", |_| true)?;
    ensure!(after["failed"] == failed + 1, "{after:#}");
    Ok(())
}

pub fn a_shared_service_grows_under_load_and_shrinks_after_it() -> Verdict {
    let daemon = pushed(
        "sharing-scale",
        "[servant]\ngrace = \"3s\"\n",
        &["--max", "2", "--cpus", "0.2"],
    )?;
    let mut busy = (0..6)
        .map(|number| robot(&daemon, &format!("r{number}")))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let deadline = std::time::Instant::now() + support::robot::PATIENCE;
    loop {
        for robot in &mut busy {
            robot.says(
                json!({"op": "call_service", "service": "/work", "args": {"seconds": 0.2}}),
            )?;
        }
        for robot in &mut busy {
            let answer = robot.hears("its answer", |value| value["op"] == "service_response")?;
            ensure!(answer["result"] == true, "{answer}");
        }
        let service = daemon.api(&format!("/api/v1/services/{SERVICE}"))?;
        if ready(&service["groups"][0]) == 2 {
            break;
        }
        ensure!(std::time::Instant::now() < deadline, "{service:#}");
    }
    let few = group(&daemon, "one servant again", |group| {
        group["servants"]
            .as_array()
            .is_some_and(|all| all.len() == 1)
    })?;
    ensure!(few["failed"] == 0, "{few:#}");
    let answer = busy[0].calls("/work", json!({"who": "still", "seconds": 0.0}))?;
    ensure!(answer["values"]["who"] == "still", "{answer}");
    let events = daemon.deployer().types(&["events"])?.said();
    for reason in [
        "requests at a time are many for 1 servants",
        "are few for 2 servants",
    ] {
        ensure!(events.contains(reason), "{events}");
    }
    Ok(())
}

pub fn goals_of_robots_do_not_meet() -> Verdict {
    let daemon = pushed("sharing-goals", "", &["--max", "1"])?;
    let mut one = robot(&daemon, "one")?;
    let mut two = robot(&daemon, "two")?;
    // One by the operations on actions, the other by actionlib's topics, as clients of ROS 1 do.
    one.says(json!({
        "op": "send_action_goal", "id": "first", "action": "/count", "action_type": "sharer_cpp/Count",
        "args": {"who": "one", "to": 5}, "feedback": true,
    }))?;
    let feedback = one.hears("feedback", |value| value["op"] == "action_feedback")?;
    ensure!(feedback["values"]["who"] == "one", "{feedback}");
    for topic in ["feedback", "result", "status"] {
        two.subscribes(&format!("/count/{topic}"))?;
    }
    two.says(
        json!({"op": "advertise", "topic": "/count/goal", "type": "sharer_cpp/CountActionGoal"}),
    )?;
    two.says(json!({
        "op": "publish", "topic": "/count/goal",
        "msg": {"goal_id": {"id": "mine"}, "goal": {"who": "two", "to": 3}},
    }))?;
    let result = one.hears("its result", |value| value["op"] == "action_result")?;
    ensure!(
        result["values"] == json!({"who": "one", "all": [1, 2, 3, 4, 5]}),
        "{result}"
    );
    let result = two.hears_on("/count/result")?;
    ensure!(
        result["result"] == json!({"who": "two", "all": [1, 2, 3]}),
        "{result}"
    );
    ensure!(result["status"]["goal_id"]["id"] == "mine", "{result}");
    let foreign = |value: &Value| {
        value["topic"] == "/count/feedback" && value["msg"]["feedback"]["who"] != "two"
            || value["topic"] == "/count/status" && value.to_string().contains("first")
    };
    ensure!(two.has_not_heard(foreign)?, "two heard of one's goal");
    ensure!(
        one.has_not_heard(|value| value["op"] == "publish")?,
        "one heard of two's goal"
    );
    // Neither is shown what the node says to everybody.
    two.says(json!({"op": "subscribe", "topic": "/rosout", "type": "rosgraph_msgs/Log"}))?;
    let refused = two.hears_status("/rosout")?;
    ensure!(
        refused["msg"]
            .as_str()
            .is_some_and(|words| words.contains("robots share")),
        "{refused}"
    );
    Ok(())
}

pub fn what_robots_cannot_share_is_refused_with_what_was_found() -> Verdict {
    let daemon = world().own("sharing-refused").start()?;
    let refused = daemon
        .deployer()
        .pushes("greeter_cpp", &["--node", "greeter", "--shared"])?;
    refused.failed_saying(&[
        "robots cannot share it",
        "it subscribes to",
        "it publishes",
        "without --shared",
    ])?;
    let refused = daemon.deployer().pushes(
        SERVICE,
        &["--node", "sharer", "--shared", "--min", "5", "--max", "2"],
    )?;
    refused.failed_saying(&["--min 5", "--max 2"])?;
    ensure!(
        daemon.deployer().asks(&["services"])? == json!([]),
        "something was published"
    );
    Ok(())
}

pub fn of_two_replicas_the_first_answers_and_the_cost_is_shown() -> Verdict {
    let daemon = pushed("sharing-replicas", "", &["--replicas", "2", "--max", "2"])?;
    let mut robot = robot(&daemon, "one")?;
    group(&daemon, "two servants", |group| ready(group) == 2)?;
    for number in 0..5 {
        let answer = robot.calls("/work", json!({"who": format!("{number}"), "seconds": 0.0}))?;
        ensure!(answer["values"]["who"] == format!("{number}"), "{answer}");
    }
    let group = group(&daemon, "five answers", |group| group["answered"] == 5)?;
    ensure!(group["wasted"] == 5 && group["failed"] == 0, "{group:#}");
    let shown = daemon
        .deployer()
        .types(&["services", SERVICE])?
        .succeeded()?;
    ensure!(
        shown.stdout.contains("5 of 10 answers wasted"),
        "{}",
        shown.stdout
    );
    Ok(())
}

/// A robot with a stub of the service, and an application of its own.
struct Linked {
    name: &'static str,
    /// As the robot has them: the node, its service, its action.
    node: &'static str,
    work: &'static str,
    count: &'static str,
    site: Site,
    app: Arc<Ros1Bus>,
    stub: Running,
}

impl Linked {
    fn new(
        daemon: &Daemon,
        name: &'static str,
        argv: &[&str],
        [node, work, count]: [&'static str; 3],
    ) -> anyhow::Result<Linked> {
        let site = Site::new()?;
        let app = site.node("/app")?;
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{SERVICE}\"\nrobot = \"{name}\"\nlocal = \"none\"\ndesire = 30.0\nmax = 60.0\n",
            daemon.address
        );
        let stub = site.stub_with(&toml, SERVICE, "sharer", argv)?;
        let all = |graph: &ros::bus::Graph| registered(graph, node).len() >= 6;
        site.until(&app, "what the node serves", all)
            .with_context(|| format!("the stub said:\n{}", stub.said()))?;
        Ok(Linked {
            name,
            node,
            work,
            count,
            site,
            app,
            stub,
        })
    }

    /// Who was answered, and by which servant.
    fn works(&self, who: &str, seconds: f64) -> anyhow::Result<(String, String)> {
        let request = [&string(who)[..], &seconds.to_le_bytes()].concat();
        let answer = self.site.calls(&self.app, self.work, &request)?;
        let mut words = Words(&answer);
        Ok((words.next()?, words.next()?))
    }

    fn hears_of(&self, end: &str) -> anyhow::Result<Subscription> {
        let heard = self
            .site
            .hears(&self.app, &format!("{}/{end}", self.count))?;
        let mut publishers = heard.matched.clone();
        let there = publishers.wait_for(|it| it.connected() > 0);
        let there = async { tokio::time::timeout(PATIENCE, there).await.is_ok() };
        ensure!(self.site.runtime.block_on(there), "{end} has no publisher");
        Ok(heard)
    }

    /// Where goals are published.
    fn goals(&self) -> anyhow::Result<Box<dyn Publisher>> {
        let topic = format!("{}/goal", self.count);
        let advertised = async {
            let of = self.app.topic_type(&topic).await?;
            self.app.advertise(&topic, of, Qos::keep_last(10)).await
        };
        let goals = self.site.runtime.block_on(advertised)?;
        self.site.connected(&*goals, 1)?;
        Ok(goals)
    }
}

/// Strings of a serialized message, one after the other.
struct Words<'a>(&'a [u8]);

impl Words<'_> {
    fn next(&mut self) -> anyhow::Result<String> {
        let (length, rest) = self.0.split_first_chunk().context("a length")?;
        let length = usize::try_from(u32::from_le_bytes(*length))?;
        let (word, rest) = rest.split_at_checked(length).context("a string")?;
        self.0 = rest;
        Ok(String::from_utf8_lossy(word).into_owned())
    }

    fn skip(&mut self, bytes: usize) -> anyhow::Result<()> {
        self.0 = self.0.get(bytes..).context("more bytes")?;
        Ok(())
    }
}

/// A serialized goal to count.
fn goal(id: &str, who: &str, to: i32) -> Bytes {
    let header = [&[0; 12][..], &string("")].concat();
    let goal_id = [&[0; 8][..], &string(id)].concat();
    [&header[..], &goal_id, &string(who), &to.to_le_bytes()]
        .concat()
        .into()
}

/// Of a serialized feedback or result: the goal's id, its status, and who.
fn about(message: &[u8]) -> anyhow::Result<(String, u8, String)> {
    let mut words = Words(message);
    words.skip(12)?;
    words.next()?;
    words.skip(8)?;
    let id = words.next()?;
    let status = *words.0.first().context("a status")?;
    words.skip(1)?;
    words.next()?;
    Ok((id, status, words.next()?))
}

pub fn stubs_of_three_robots_use_two_servants_and_one_of_these_is_killed() -> Verdict {
    let daemon = pushed("sharing-stubs", "", &["--min", "2", "--max", "2"])?;
    let own = ["/sharer", "/work", "/count"];
    let mut plain = Linked::new(&daemon, "plain", &[], own)?;
    let front = Linked::new(
        &daemon,
        "front",
        &["__ns:=/front", "__name:=hands"],
        ["/front/hands", "/front/work", "/front/count"],
    )?;
    let argv = ["work:=/plan", "count:=tally", "_speed:=3"];
    let other = Linked::new(&daemon, "other", &argv, ["/sharer", "/plan", "/tally"])?;
    // The names of the original, and its types.
    for robot in [&plain, &front, &other] {
        let graph = robot.app.graph().borrow().clone();
        let count = robot.count;
        let expected = [
            format!("publishes {count}/feedback [sharer_cpp/CountActionFeedback]"),
            format!("publishes {count}/result [sharer_cpp/CountActionResult]"),
            format!("publishes {count}/status [actionlib_msgs/GoalStatusArray]"),
            format!("serves {}", robot.work),
            format!("subscribes {count}/cancel [actionlib_msgs/GoalID]"),
            format!("subscribes {count}/goal [sharer_cpp/CountActionGoal]"),
        ];
        let found = registered(&graph, robot.node);
        ensure!(found == expected.into(), "{}: {found:#?}", robot.name);
    }
    // What would change the node for all is not heeded, and that is said.
    other.stub.says("~speed")?;
    let before = group(&daemon, "two servants", |group| ready(group) == 2)?;
    ensure!(before["robots"] == 3, "{before:#}");

    // Goals do not meet: each robot hears of its own alone.
    let mut heard = [&plain, &front].map(|robot| {
        Ok::<_, anyhow::Error>((robot.hears_of("feedback")?, robot.hears_of("result")?))
    });
    for (robot, id) in [(&plain, "mine"), (&front, "mine")] {
        robot.goals()?.publish(goal(id, robot.name, 5));
    }
    for (robot, heard) in [&plain, &front].into_iter().zip(&mut heard) {
        let (feedback, result) = heard
            .as_mut()
            .map_err(|error| anyhow::anyhow!("{error:#}"))?;
        let first = about(&robot.site.next(feedback)?.bytes)?;
        ensure!(first.0 == "mine" && first.2 == robot.name, "{first:?}");
        let end = about(&robot.site.next(result)?.bytes)?;
        // Succeeded.
        ensure!(end == ("mine".into(), 3, robot.name.into()), "{end:?}");
        while let Some(more) = feedback.messages.try_recv() {
            let more = about(&more.bytes)?;
            ensure!(more.2 == robot.name, "{more:?}");
        }
    }

    // One has a call that its servant will not end.
    let request = [&string("plain")[..], &3600f64.to_le_bytes()].concat();
    let long = {
        let app = Arc::clone(&plain.app);
        let call = async move { app.call("/work", request.into(), PATIENCE * 10).await };
        plain.site.runtime.spawn(call)
    };
    let victim = daemon.awaits(
        &format!("/api/v1/services/{SERVICE}"),
        "the servant that has it",
        |service| {
            let servants = service["groups"][0]["servants"].as_array()?;
            let busy = servants.iter().find(|one| one["under_way"] == 1)?;
            Some(busy["id"].as_str()?.to_owned())
        },
    )?;
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
                    match robot.works(&who, 0.01) {
                        Ok((said, _)) => {
                            ensure!(said == who, "not its own: {said}");
                            answered += 1;
                        }
                        Err(error) => {
                            ensure!(format!("{error:#}").contains("--idempotent"), "{error:#}")
                        }
                    }
                }
                Ok((robot, answered))
            })
        })
        .collect();
    group(&daemon, "answers of both", |group| {
        group["answered"].as_u64() > Some(20)
    })?;
    fails(&daemon, &victim)?;
    group(&daemon, "another in its place", |group| {
        ready(group) == 2 && !group["servants"].to_string().contains(&victim)
    })?;
    killed.store(true, Ordering::SeqCst);
    let refused = plain.site.runtime.block_on(long)?;
    let words = refused.err().map(|error| error.to_string());
    let words = words.context("a lost call was answered")?;
    ensure!(
        words.contains(&victim) && words.contains("--idempotent"),
        "{words}"
    );
    for robot in working {
        let (robot, answered) = robot
            .join()
            .map_err(|_| anyhow::anyhow!("a robot panicked"))??;
        ensure!(answered > 0, "{} was never answered", robot.name);
    }
    let (said, place) = plain.works("still", 0.0)?;
    ensure!(said == "still" && place != victim, "{said} {place}");
    // roslaunch's way to end it.
    plain.stub.signal(Signal::SIGINT)?;
    let status = plain.stub.ends()?;
    ensure!(status.code() == Some(0), "{status}: {}", plain.stub.said());
    plain.site.until(&plain.app, "an empty graph", |graph| {
        registered(graph, plain.node).is_empty()
    })?;
    group(&daemon, "two servants still", |group| ready(group) == 2)?;
    Ok(())
}
