//! People look into a servant: they subscribe to its topics and, if permitted, act on it, without being clients of its
//! robot.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::thread;

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::binaries;
use support::daemon::{Daemon, DaemonSetup};
use support::patience::{self, Deadline};
use support::robot::{ConnectionRefusal, Robot};
use support::world::world;
use tokio_tungstenite::tungstenite::Message;

use crate::access::create_token;
use crate::people::{self, run_account};

/// Push arguments of the package whose servants are looked into.
pub const SIGHTS: &[&str] = &["--node", "sights.py"];

/// A daemon with tokens, `sights_py`, and a working robot `rover`.
pub struct InsideScene {
    pub daemon: Daemon,
    admin: String,
    pub rover: Robot,
    /// Token of the robot.
    pub token: String,
    pub servant: String,
}

impl InsideScene {
    pub fn new(name: &str, config: &str) -> anyhow::Result<InsideScene> {
        InsideScene::start(&world().setup(name).config(config))
    }

    fn start(setup: &DaemonSetup) -> anyhow::Result<InsideScene> {
        let daemon = setup.start()?;
        let admin = create_token(&daemon, &["chief", "--role", "admin"])?;
        daemon.deployer().push("sights_py", SIGHTS)?.expect_success()?;
        let own = create_token(&daemon, &["rover", "--role", "robot", "--robot", "rover", "--service", "sights_py"])?;
        let mut rover = daemon.robot(&format!("sights_py?token={own}"))?;
        rover.call("/rosapi/get_time", json!({}))?;
        let servant = daemon.servant_of("sights_py", "rover")?;
        let servant = servant["id"].as_str().context("an id")?.to_owned();
        Ok(InsideScene { daemon, admin, rover, token: own, servant })
    }

    pub fn viewer_token(&self, name: &str, services: &str) -> anyhow::Result<String> {
        let given = [name, "--role", "viewer", "--service", services];
        create_token(&self.daemon, &given)
    }

    fn inside_path(&self) -> String {
        format!("api/v1/servants/{}/inside", self.servant)
    }

    fn connect_viewer(&self, token: &str) -> Result<Robot, ConnectionRefusal> {
        let url = self.daemon.url(&format!("{}?token={token}", self.inside_path()));
        Robot::try_connect(&url)
    }

    pub fn servant(&self) -> anyhow::Result<Value> {
        self.daemon.api(&format!("/api/v1/servants/{}", self.servant))
    }

    pub fn wait_for_audit(&self, who: &str, did: &str) -> Verdict {
        support::wait_until(&format!("a record that {who} {did}"), || {
            let typed = ["--format", "json", "audit", "-n", "1000"];
            let log = self.daemon.deployer().run(&typed)?.expect_success()?.stdout;
            let found = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok()).any(|record| {
                let (name, what) = (record["who"].as_str(), record["did"].as_str());
                name.is_some_and(|name| name.starts_with(who)) && what == Some(did)
            });
            Ok(found.then_some(()).ok_or(log))
        })
    }
}

pub fn expect_refused(connection: Result<Robot, ConnectionRefusal>, status: u16, words: &str) -> Verdict {
    match connection {
        Ok(_) => bail!("let in, and not refused with {status} {words}"),
        Err(refusal) => {
            ensure!(refusal.status == status && refusal.body.contains(words), "{status} {words}: {refusal}");
            Ok(())
        }
    }
}

/// Waits for an image in binary with its full size.
pub fn wait_for_picture(robot: &mut Robot) -> Verdict {
    loop {
        if let Message::Binary(bytes) = robot.next_frame()? {
            ensure!(bytes.len() > 640 * 480 * 3, "{} bytes", bytes.len());
            return Ok(());
        }
    }
}

/// Waits for an image in binary that holds a JPEG in place of its pixels.
fn wait_for_preview(robot: &mut Robot) -> Verdict {
    loop {
        if let Message::Binary(bytes) = robot.next_frame()? {
            ensure!(bytes.len() < 640 * 480 / 4, "{} bytes", bytes.len());
            ensure!(bytes.windows(3).any(|three| three == [0xff, 0xd8, 0xff]), "no JPEG in {} bytes", bytes.len());
            return Ok(());
        }
    }
}

pub fn a_viewer_hears_and_does_nothing_and_an_operator_acts() -> Verdict {
    let mut scene = InsideScene::new("inside", "")?;
    let eve_token = scene.viewer_token("eve", "sights*")?;
    let mut eve = scene.connect_viewer(&eve_token)?;
    // A viewer sees and receives all topics, including the robot's own.
    let topics = eve.call("/rosapi/topics", json!({}))?;
    ensure!(topics["values"]["topics"].to_string().contains("/sights/scan"), "{topics}");
    for topic in ["/sights/said", "/sights/say"] {
        eve.subscribe(topic)?;
        eve.wait_for_subscriber(topic)?;
    }
    eve.subscribe("/sights/map")?;
    let map = eve.next_message_on("/sights/map")?;
    ensure!(map["info"]["width"] == 100, "latched: {map}");
    let say = |words: &str| {
        json!({"op": "publish", "topic": "/sights/say", "type": "std_msgs/String",
        "msg": {"data": words}})
    };
    scene.rover.send(json!({"op": "advertise", "topic": "/sights/say", "type": "std_msgs/String"}))?;
    // She receives messages once her node is connected, for which the robot does not wait; the node's own messages
    // arrive even later.
    support::wait_until("what the robot sends and its node says, inside", || {
        scene.rover.send(say("by rover"))?;
        for topic in ["/sights/say", "/sights/said"] {
            if eve.has_not_heard(|said| said["topic"] == topic)? {
                return Ok(Err(format!("{topic} is not heard")));
            }
        }
        Ok(Ok(()))
    })?;
    ensure!(eve.next_message_on("/sights/say")?["data"] == "by rover");
    ensure!(eve.next_message_on("/sights/said")?["data"] == "by rover");
    // Images are sent in binary on request.
    let mut pictures = scene.connect_viewer(&eve_token)?;
    pictures
        .send(json!({"op": "subscribe", "topic": "/sights/image/rgb8", "compression": "cbor", "throttle_rate": 200,
        "queue_length": 1}))?;
    wait_for_picture(&mut pictures)?;
    pictures.leave()?;
    // For people they are a JPEG within the same message.
    let mut previews = scene.connect_viewer(&eve_token)?;
    previews.send(json!({"op": "subscribe", "topic": "/sights/image/rgb8", "compression": "preview"}))?;
    wait_for_preview(&mut previews)?;
    previews.leave()?;
    // All other operations are refused.
    eve.send(say("by eve"))?;
    eve.wait_for_status("publish:/sights/say is not granted")?;
    for (service, arguments) in [
        ("/sights/ping", json!({})),
        ("/rosapi/set_param", json!({"name": "/sights/gain", "value": "9"})),
        ("/rosapi/get_param", json!({"name": "/sights/gain"})),
        ("/rosapi/delete_param", json!({"name": "/sights/gain"})),
    ] {
        let answer = eve.call(service, arguments)?;
        ensure!(
            answer["result"] == false && answer["values"].to_string().contains("not granted"),
            "{service}: {answer}"
        );
    }
    eve.send(json!({"op": "send_action_goal", "id": "g", "action": "/sights/count",
        "action_type": "actionlib/TestAction", "args": {"goal": 1}}))?;
    let goal = eve.wait_for("the goal's end", |said| said["op"] == "action_result")?;
    ensure!(goal["result"] == false, "{goal}");
    eve.send(json!({"op": "advertise_service", "service": "/sights/other", "type": "std_srvs/Trigger"}))?;
    eve.wait_for_status("advertise:/sights/other is not granted")?;
    scene.wait_for_audit("eve", "looks inside")?;
    scene.wait_for_audit("eve", "was refused publish:/sights/say")?;

    // An operator may use all operations.
    let olga = create_token(&scene.daemon, &["olga", "--role", "operator"])?;
    let mut olga = scene.connect_viewer(&olga)?;
    let answer = olga.call("/sights/ping", json!({}))?;
    ensure!(answer["values"]["message"] == "pong", "{answer}");
    olga.call("/rosapi/set_param", json!({"name": "/sights/gain", "value": "9"}))?;
    let gain = olga.call("/rosapi/get_param", json!({"name": "/sights/gain"}))?;
    ensure!(gain["values"]["value"] == "9", "{gain}");
    scene.rover.subscribe("/sights/said")?;
    olga.send(json!({"op": "advertise", "topic": "/sights/say", "type": "std_msgs/String"}))?;
    // The node treats it like any other publication, and its robot gets the answer once both are connected.
    support::wait_until("what olga sends, at the robot", || {
        olga.send(say("by olga"))?;
        let unheard = scene.rover.has_not_heard(|said| said["msg"]["data"] == "by olga")?;
        Ok((!unheard).then_some(()).ok_or_else(|| "not heard".to_owned()))
    })?;
    olga.send(json!({"op": "send_action_goal", "id": "g", "action": "/sights/count",
        "action_type": "actionlib/TestAction", "args": {"goal": 10}}))?;
    let goal = olga.wait_for("the goal's end", |said| said["op"] == "action_result")?;
    ensure!(goal["result"] == true, "{goal}");
    scene.wait_for_audit("olga", "inside: call:/sights/ping")?;
    scene.wait_for_audit("olga", "inside: publish:/sights/say")?;
    scene.wait_for_audit("olga", "inside: call:/rosapi/set_param")?;

    // None of this counted as the robot's: one servant, one connection, no requests and no duplicates of the robot.
    ensure!(scene.daemon.servants_of("sights_py")?.len() == 1);
    let told = scene.servant()?;
    ensure!(told["connections"] == 1, "{told:#}");
    ensure!(told["response"].is_null(), "{told:#}");
    ensure!(told["id"] == scene.servant.as_str(), "{told:#}");
    let count = scene.rover.call("/rosapi/nodes", json!({}))?;
    ensure!(count["result"] == true, "{count}");
    scene.rover.subscribe("/client_count")?;
    ensure!(scene.rover.next_message_on("/client_count")?["data"] == 1);
    let events = scene.daemon.api("/api/v1/events?limit=10000")?;
    ensure!(!events.to_string().contains("duplicate-robot"), "{events:#}");

    // A rule restricts a viewer's subscriptions immediately.
    let rule = ["policy", "allow", "eve", "subscribe:/sights/map", "--service", "*"];
    scene.daemon.deployer().run(&rule)?.expect_success()?;
    eve.wait_for_status("/sights/said")?;
    eve.send(json!({"op": "subscribe", "id": "again", "topic": "/sights/said"}))?;
    eve.wait_for_status("subscribe:/sights/said is not granted")?;
    // Connections end with their token.
    scene.daemon.deployer().run(&["token", "revoke", "eve"])?.expect_success()?;
    let close = eve.wait_for_close()?;
    ensure!(u16::from(close.code) == 1008 && close.reason.contains("revoked"), "{close:?}");
    // Connections end with the servant.
    scene.daemon.deployer().run(&["stop", &scene.servant])?.expect_success()?;
    let close = olga.wait_for_close()?;
    ensure!(u16::from(close.code) == 1012, "{close:?}");
    expect_refused(scene.connect_viewer(&scene.admin), 404, "servant")?;
    scene.daemon.stop()?;
    Ok(())
}

pub fn looking_inside_keeps_no_servant_and_is_bounded() -> Verdict {
    let scene = InsideScene::new("inside-bounds", "[servant]\ngrace = \"1s\"\n")?;
    let eve = scene.viewer_token("eve", "sights*")?;
    let stranger = scene.viewer_token("stranger", "other*")?;
    let other = ["other", "--role", "robot", "--robot", "other", "--service", "sights_py"];
    let other = create_token(&scene.daemon, &other)?;
    expect_refused(scene.connect_viewer(&stranger), 403, "may not see servant")?;
    expect_refused(scene.connect_viewer(&other), 403, "may not see")?;
    expect_refused(scene.connect_viewer("guess"), 401, "not known")?;
    let bare = Robot::try_connect(&scene.daemon.url(&scene.inside_path()));
    expect_refused(bare, 401, "token")?;
    let elsewhere = format!("api/v1/servants/nothing/inside?token={eve}");
    expect_refused(Robot::try_connect(&scene.daemon.url(&elsewhere)), 403, "may not see")?;
    let bearer = format!("Bearer {eve}");
    let path = format!("/{}", scene.inside_path());
    let (status, body) = scene.daemon.request("GET", &path, &[("Authorization", &bearer)])?;
    ensure!(status == 400 && body.contains("not a WebSocket handshake"), "{status} {body}");

    // With a session, only from the page's own origin.
    let made = ["create", "vera", "--role", "viewer", "--service", "sights*"];
    run_account(&scene.daemon, &made, people::PASSWORD)?.expect_success()?;
    let vera = people::SignedInBrowser::sign_in(&scene.daemon, "vera", people::PASSWORD)?;
    let url = scene.daemon.url(&scene.inside_path());
    let shows = |origin: Option<&str>| {
        let mut headers = vec![("Cookie", vera.cookie.as_str())];
        headers.extend(origin.map(|origin| ("Origin", origin)));
        Robot::try_connect_with_headers(&url, &headers)
    };
    expect_refused(shows(None), 403, "may not use a session")?;
    for origin in ["http://evil.example", "null", "http://127.0.0.1:1"] {
        expect_refused(shows(Some(origin)), 403, "may not use a session")?;
    }
    let mut hers = shows(Some(&vera.origin))?;
    hers.call("/rosapi/topics", json!({}))?;

    // The number of connections of a principal is limited; a closed one makes room.
    let mut many: Vec<Robot> = (0..4).map(|_| scene.connect_viewer(&eve)).collect::<Result<_, _>>()?;
    expect_refused(scene.connect_viewer(&eve), 429, "too many connections look into")?;
    many.pop().context("one")?.leave()?;
    support::wait_until("room for one more", || {
        Ok(scene.connect_viewer(&eve).map(|one| many.push(one)).map_err(|refusal| refusal.to_string()))
    })?;
    // The robot leaves: viewers do not keep its servant alive.
    let InsideScene { daemon, rover, .. } = scene;
    rover.leave()?;
    let close = hers.wait_for_close()?;
    ensure!(u16::from(close.code) == 1012, "{close:?}");
    for mut one in many {
        one.wait_for_close()?;
    }
    support::wait_until("the servant's end", || {
        let left = daemon.servants_of("sights_py")?;
        Ok(left.is_empty().then_some(()).ok_or_else(|| format!("{left:#?}")))
    })?;
    daemon.stop()?;
    Ok(())
}

pub fn who_looks_slowly_costs_its_robot_nothing() -> Verdict {
    let mut scene = InsideScene::new("inside-slow", "")?;
    let eve = scene.viewer_token("eve", "*")?;
    let url = scene.daemon.url(&format!("{}?token={eve}", scene.inside_path()));
    // She requests thirty images per second and reads none of them.
    let mut slow = Robot::connect_with_small_buffer(&url, &[])?;
    slow.send(json!({"op": "subscribe", "topic": "/sights/image/rgb8", "compression": "cbor"}))?;
    let publish = |op: &str| json!({"op": op, "topic": "/sights/say", "type": "std_msgs/String"});
    scene.rover.send(publish("advertise"))?;
    scene.rover.subscribe("/sights/said")?;
    let said = |words: &str| {
        let mut message = publish("publish");
        message["msg"] = json!({"data": words});
        message
    };
    support::wait_until("the first answer", || {
        scene.rover.send(said("first"))?;
        let unheard = scene.rover.has_not_heard(|heard| heard["topic"] == "/sights/said")?;
        Ok((!unheard).then_some(()).ok_or_else(|| "none".to_owned()))
    })?;
    for number in 0..100 {
        let words = format!("the {number}th");
        scene.rover.send(said(&words))?;
        let is = |heard: &Value| heard["op"] == "publish" && heard["msg"]["data"] == words.as_str();
        scene.rover.wait_for(&words, is)?;
    }
    // The robot has lost nothing, and her lost images do not count as its drops.
    ensure!(scene.servant()?["dropped"] == 0, "{:#}", scene.servant()?);
    // When she reads again, she gets current images rather than old ones.
    wait_for_picture(&mut slow)?;
    scene.daemon.stop()?;
    Ok(())
}

/// A running `cloudroidctl topics`, which prints a line per second.
struct TopicCounting {
    child: Child,
    lines: mpsc::Receiver<String>,
}

impl TopicCounting {
    /// Starts it with a token, or as root without one.
    fn start(scene: &InsideScene, token: Option<&str>) -> anyhow::Result<TopicCounting> {
        let mut command = Command::new(binaries::path("cloudroidctl"));
        command.args(["--format", "json", "topics", &scene.servant]);
        if let Some(token) = token {
            let server = format!("http://{}", scene.daemon.address);
            command.args(["--server", &server, "--token", token]);
        }
        let mut child = command
            .env("CLOUDROID_HOME", &scene.daemon.home)
            .env_remove("CLOUDROID_SERVER")
            .stdout(Stdio::piped())
            .spawn()?;
        let out = BufReader::new(child.stdout.take().context("piped")?);
        let (told, lines) = mpsc::channel();
        thread::spawn(move || out.lines().map_while(Result::ok).try_for_each(|line| told.send(line)));
        Ok(TopicCounting { child, lines })
    }

    /// Returns the topics of the first line that satisfies `is`.
    fn wait_for_topics(&self, is: impl Fn(&[Value]) -> bool) -> anyhow::Result<Vec<Value>> {
        let deadline = Deadline::begin();
        let mut last = String::new();
        loop {
            let line = patience::receive(&self.lines);
            last = line.with_context(|| format!("no line is so, the last is {last}"))?;
            deadline.check(|| format!("no line is so, the last is {last}"))?;
            let mut told: Value = serde_json::from_str(&last)?;
            let topics: Vec<Value> = serde_json::from_value(told["topics"].take())?;
            if is(&topics) {
                return Ok(topics);
            }
        }
    }
}

impl Drop for TopicCounting {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn find_topic(topics: &[Value], name: &str) -> Option<Value> {
    topics.iter().find(|one| one["topic"] == name).cloned()
}

pub fn what_is_published_is_counted_and_goals_are_remembered() -> Verdict {
    // A stopping daemon waits long for robots; connections that only report on a servant do not delay it.
    let patient = "keep_servants = true\n[portal]\ndrain = \"20m\"\n";
    let setup = world().setup("counted").config(patient);
    let mut scene = InsideScene::start(&setup)?;
    // A line per second, until the client leaves.
    let counting = TopicCounting::start(&scene, None)?;
    let flows =
        |topics: &[Value], name: &str| find_topic(topics, name).is_some_and(|one| one["rate"].as_f64() > Some(0.0));
    let topics =
        counting.wait_for_topics(|topics| flows(topics, "/sights/scan") && flows(topics, "/sights/image/rgb8"))?;
    drop(counting);
    let found = find_topic(&topics, "/sights/scan").zip(find_topic(&topics, "/sights/image/rgb8"));
    let (scan, picture) = found.context("scans and pictures that are counted")?;
    ensure!(scan["type"] == "sensor_msgs/LaserScan", "{scan}");
    let number = |of: &Value, key: &str| of[key].as_f64().unwrap_or_default();
    // The size of a message follows from bandwidth and rate.
    let each = number(&picture, "bandwidth") / number(&picture, "rate");
    ensure!(each > 640.0 * 480.0 * 3.0 && each < 640.0 * 480.0 * 3.1, "{picture}");
    // Scans have a stamp, images here do not.
    let latency = scan["latency"].as_f64().context("a latency")?;
    ensure!((0.0..30.0).contains(&latency), "{scan}");
    ensure!(picture.get("latency").is_none(), "{picture}");
    // Counting stops once the client has left.
    support::wait_until("the place of who counted", || {
        let graph = scene.rover.call("/rosapi/subscribers", json!({"topic": "/sights/image/rgb8"}))?;
        let left = graph["values"]["subscribers"].as_array().map_or(0, Vec::len);
        Ok((left == 0).then_some(()).ok_or_else(|| graph.to_string()))
    })?;

    // A viewer sees the topics that a rule permits, and a robot sees its own servant only.
    let eve = scene.viewer_token("eve", "sights*")?;
    let rule = ["policy", "allow", "eve", "subscribe:/sights/map", "--service", "*"];
    scene.daemon.deployer().run(&rule)?.expect_success()?;
    let counting = TopicCounting::start(&scene, Some(&eve))?;
    let topics = counting.wait_for_topics(|topics| !topics.is_empty())?;
    drop(counting);
    ensure!(topics.len() == 1 && topics[0]["topic"] == "/sights/map", "{topics:?}");
    let other = ["other", "--role", "robot", "--robot", "other", "--service", "*"];
    let other = create_token(&scene.daemon, &other)?;
    let server = format!("http://{}", scene.daemon.address);
    for verb in ["topics", "goals"] {
        let typed = ["--server", &server, "--token", &other, verb, &scene.servant];
        let refused = scene.daemon.deployer().run(&typed)?;
        ensure!(refused.status == 4, "{verb}: {}", refused.output());
    }

    // A goal of the robot that succeeds, one that it cancels, and one of a principal who looks inside.
    let goal = |id: &str, count: u32| {
        json!({"op": "send_action_goal", "id": id, "action": "/sights/count",
        "action_type": "actionlib/TestAction", "args": {"goal": count}, "feedback": true})
    };
    let path = format!("/api/v1/servants/{}/goals", scene.servant);
    let listed = |daemon: &Daemon| -> anyhow::Result<Vec<Value>> { Ok(serde_json::from_value(daemon.api(&path)?)?) };
    // The first goal may be sent before the robot's node has been discovered; of such a goal only the end is known.
    let mut early = 0;
    support::wait_until("a goal that was heard when it was sent", || {
        early += 1;
        let id = format!("early{early}");
        scene.rover.send(goal(&id, 1))?;
        scene.rover.wait_for("its end", |said| said["op"] == "action_result" && said["id"] == id.as_str())?;
        let goals = listed(&scene.daemon)?;
        let known = [json!("robot rover"), json!("unknown sender")];
        ensure!(goals.iter().all(|goal| known.contains(&goal["by"])), "{goals:?}");
        let heard = goals.iter().any(|goal| goal["by"] == known[0]);
        Ok(heard.then_some(()).ok_or_else(|| format!("{goals:?}")))
    })?;
    let all_ended = |count: usize| {
        support::wait_until(&format!("{count} goals that have ended"), || {
            let goals = listed(&scene.daemon)?;
            let ended = goals.iter().filter(|goal| goal["ended"].is_u64()).count();
            let are = ended == count && goals.len() == count;
            Ok(are.then(|| goals.clone()).ok_or_else(|| format!("{goals:?}")))
        })
    };
    all_ended(early)?;
    scene.rover.send(goal("short", 1))?;
    scene.rover.wait_for("its end", |said| said["op"] == "action_result" && said["id"] == "short")?;
    scene.rover.send(goal("long", 10_000))?;
    scene.rover.wait_for("that it has begun", |said| said["op"] == "action_feedback" && said["id"] == "long")?;
    scene.rover.send(json!({"op": "cancel_action_goal", "id": "long", "action": "/sights/count"}))?;
    scene.rover.wait_for("its end", |said| said["op"] == "action_result" && said["id"] == "long")?;
    let olga = create_token(&scene.daemon, &["olga", "--role", "operator"])?;
    let mut olga = scene.connect_viewer(&olga)?;
    olga.send(goal("hers", 1))?;
    let hers = olga.wait_for("its end", |said| said["op"] == "action_result")?;
    ensure!(hers["result"] == true, "{hers}");
    let goals = all_ended(early + 3)?;
    let told: Vec<_> = goals[..3].iter().rev().map(|goal| (goal["by"].clone(), goal["state"].clone())).collect();
    ensure!(
        told == [
            (json!("robot rover"), json!("succeeded")),
            (json!("robot rover"), json!("preempted")),
            (json!("somebody who looks inside"), json!("succeeded")),
        ],
        "{goals:?}"
    );
    // Every end is reported, also if several occur at once.
    for words in ["robot rover succeeded", "robot rover was cancelled", "somebody who looks inside succeeded"] {
        scene.daemon.wait_for_event(words, |event| {
            let said = event["message"].as_str().unwrap_or_default();
            event["kind"] == "goal-ended" && said.contains(&format!("/sights/count: the goal of {words}"))
        })?;
    }
    // She may not see them.
    let typed = ["--server", &server, "--token", &eve, "--format", "json", "goals", &scene.servant];
    let none = scene.daemon.deployer().run(&typed)?.expect_success()?;
    ensure!(none.stdout.trim() == "[]", "{}", none.output());

    let counting = TopicCounting::start(&scene, None)?;
    counting.wait_for_topics(|_| true)?;
    drop(olga);
    let InsideScene { daemon, rover, .. } = scene;
    drop(rover);
    let (ended, end) = mpsc::channel();
    thread::spawn(move || ended.send(daemon.stop()));
    let ended = patience::receive(&end);
    ended.context("the daemon waits for those who are told of a servant")??;
    drop(counting);
    // Servants left by the daemon continue; the next daemon stops them.
    let daemon = setup.start()?;
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    daemon.stop()?;
    Ok(())
}
