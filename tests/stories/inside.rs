//! People look into a servant: they hear what flows there and, where they may, act on it, and are none of its robot's clients.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::thread;

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::binaries;
use support::daemon::{Daemon, Setup};
use support::patience::{self, Deadline};
use support::robot::{Refusal, Robot};
use support::world::world;
use tokio_tungstenite::tungstenite::Message;

use crate::access::token;
use crate::people::{self, account};

/// The package whose servants are looked into.
pub const SIGHTS: &[&str] = &["--node", "sights.py"];

/// A daemon with tokens, `sights_py`, and a robot `rover` at work there.
pub struct Scene {
    pub daemon: Daemon,
    admin: String,
    pub rover: Robot,
    /// The robot's.
    pub token: String,
    pub servant: String,
}

impl Scene {
    pub fn new(name: &str, config: &str) -> anyhow::Result<Scene> {
        Scene::of(&world().own(name).config(config))
    }

    fn of(setup: &Setup) -> anyhow::Result<Scene> {
        let daemon = setup.start()?;
        let admin = token(&daemon, &["chief", "--role", "admin"])?;
        daemon.deployer().pushes("sights_py", SIGHTS)?.succeeded()?;
        let own = token(
            &daemon,
            &[
                "rover",
                "--role",
                "robot",
                "--robot",
                "rover",
                "--service",
                "sights_py",
            ],
        )?;
        let mut rover = daemon.robot(&format!("sights_py?token={own}"))?;
        rover.calls("/rosapi/get_time", json!({}))?;
        let servant = daemon.servant_of("sights_py", "rover")?;
        let servant = servant["id"].as_str().context("an id")?.to_owned();
        Ok(Scene {
            daemon,
            admin,
            rover,
            token: own,
            servant,
        })
    }

    pub fn viewer(&self, name: &str, services: &str) -> anyhow::Result<String> {
        let given = [name, "--role", "viewer", "--service", services];
        token(&self.daemon, &given)
    }

    fn address(&self) -> String {
        format!("api/v1/servants/{}/inside", self.servant)
    }

    fn looks(&self, token: &str) -> Result<Robot, Refusal> {
        let url = self
            .daemon
            .url(&format!("{}?token={token}", self.address()));
        Robot::try_connect(&url)
    }

    pub fn told(&self) -> anyhow::Result<Value> {
        self.daemon
            .api(&format!("/api/v1/servants/{}", self.servant))
    }

    pub fn audited(&self, who: &str, did: &str) -> Verdict {
        support::until(&format!("a record that {who} {did}"), || {
            let typed = ["--format", "json", "audit", "-n", "1000"];
            let log = self.daemon.deployer().types(&typed)?.succeeded()?.stdout;
            let found = log
                .lines()
                .filter_map(|line| serde_json::from_str::<Value>(line).ok())
                .any(|record| {
                    let (name, what) = (record["who"].as_str(), record["did"].as_str());
                    name.is_some_and(|name| name.starts_with(who)) && what == Some(did)
                });
            Ok(found.then_some(()).ok_or(log))
        })
    }
}

pub fn refused(connection: Result<Robot, Refusal>, status: u16, words: &str) -> Verdict {
    match connection {
        Ok(_) => bail!("let in, and not refused with {status} {words}"),
        Err(refusal) => {
            ensure!(
                refusal.status == status && refusal.body.contains(words),
                "{status} {words}: {refusal}"
            );
            Ok(())
        }
    }
}

/// Waits for a picture in binary, which is as large as it was published.
pub fn hears_a_picture(robot: &mut Robot) -> Verdict {
    loop {
        if let Message::Binary(bytes) = robot.frame()? {
            ensure!(bytes.len() > 640 * 480 * 3, "{} bytes", bytes.len());
            return Ok(());
        }
    }
}

pub fn a_viewer_hears_and_does_nothing_and_an_operator_acts() -> Verdict {
    let mut scene = Scene::new("inside", "")?;
    let eve_token = scene.viewer("eve", "sights*")?;
    let mut eve = scene.looks(&eve_token)?;
    // Of what is there she is told topics, and hears them, the robot's own among them.
    let topics = eve.calls("/rosapi/topics", json!({}))?;
    ensure!(
        topics["values"]["topics"]
            .to_string()
            .contains("/sights/scan"),
        "{topics}"
    );
    for topic in ["/sights/said", "/sights/say"] {
        eve.subscribes(topic)?;
        eve.awaits_subscriber(topic)?;
    }
    eve.subscribes("/sights/map")?;
    let map = eve.hears_on("/sights/map")?;
    ensure!(map["info"]["width"] == 100, "latched: {map}");
    let say = |words: &str| json!({"op": "publish", "topic": "/sights/say", "type": "std_msgs/String", "msg": {"data": words}});
    scene
        .rover
        .says(json!({"op": "advertise", "topic": "/sights/say", "type": "std_msgs/String"}))?;
    // She hears from when her node is connected on, and the robot does not wait for that; the node's own words later yet.
    support::until("what the robot sends and its node says, inside", || {
        scene.rover.says(say("by rover"))?;
        for topic in ["/sights/say", "/sights/said"] {
            if eve.has_not_heard(|said| said["topic"] == topic)? {
                return Ok(Err(format!("{topic} is not heard")));
            }
        }
        Ok(Ok(()))
    })?;
    ensure!(eve.hears_on("/sights/say")?["data"] == "by rover");
    ensure!(eve.hears_on("/sights/said")?["data"] == "by rover");
    // Pictures come in binary, if they are asked for so.
    let mut pictures = scene.looks(&eve_token)?;
    pictures.says(json!({"op": "subscribe", "topic": "/sights/image/rgb8", "compression": "cbor", "throttle_rate": 200, "queue_length": 1}))?;
    hears_a_picture(&mut pictures)?;
    pictures.leaves()?;
    // Everything else is refused her.
    eve.says(say("by eve"))?;
    eve.hears_status("publish:/sights/say is not granted")?;
    for (service, arguments) in [
        ("/sights/ping", json!({})),
        (
            "/rosapi/set_param",
            json!({"name": "/sights/gain", "value": "9"}),
        ),
        ("/rosapi/get_param", json!({"name": "/sights/gain"})),
        ("/rosapi/delete_param", json!({"name": "/sights/gain"})),
    ] {
        let answer = eve.calls(service, arguments)?;
        ensure!(
            answer["result"] == false && answer["values"].to_string().contains("not granted"),
            "{service}: {answer}"
        );
    }
    eve.says(json!({"op": "send_action_goal", "id": "g", "action": "/sights/count", "action_type": "actionlib/TestAction", "args": {"goal": 1}}))?;
    let goal = eve.hears("the goal's end", |said| said["op"] == "action_result")?;
    ensure!(goal["result"] == false, "{goal}");
    eve.says(
        json!({"op": "advertise_service", "service": "/sights/other", "type": "std_srvs/Trigger"}),
    )?;
    eve.hears_status("advertise:/sights/other is not granted")?;
    scene.audited("eve", "looks inside")?;
    scene.audited("eve", "was refused publish:/sights/say")?;

    // An operator does all that.
    let olga = token(&scene.daemon, &["olga", "--role", "operator"])?;
    let mut olga = scene.looks(&olga)?;
    let answer = olga.calls("/sights/ping", json!({}))?;
    ensure!(answer["values"]["message"] == "pong", "{answer}");
    olga.calls(
        "/rosapi/set_param",
        json!({"name": "/sights/gain", "value": "9"}),
    )?;
    let gain = olga.calls("/rosapi/get_param", json!({"name": "/sights/gain"}))?;
    ensure!(gain["values"]["value"] == "9", "{gain}");
    scene.rover.subscribes("/sights/said")?;
    olga.says(json!({"op": "advertise", "topic": "/sights/say", "type": "std_msgs/String"}))?;
    // The node takes it as from anybody, and its robot hears what comes of it, once both are connected.
    support::until("what olga sends, at the robot", || {
        olga.says(say("by olga"))?;
        let unheard = scene
            .rover
            .has_not_heard(|said| said["msg"]["data"] == "by olga")?;
        Ok((!unheard)
            .then_some(())
            .ok_or_else(|| "not heard".to_owned()))
    })?;
    olga.says(json!({"op": "send_action_goal", "id": "g", "action": "/sights/count", "action_type": "actionlib/TestAction", "args": {"goal": 10}}))?;
    let goal = olga.hears("the goal's end", |said| said["op"] == "action_result")?;
    ensure!(goal["result"] == true, "{goal}");
    scene.audited("olga", "inside: call:/sights/ping")?;
    scene.audited("olga", "inside: publish:/sights/say")?;
    scene.audited("olga", "inside: call:/rosapi/set_param")?;

    // All this was nobody's robot: one servant, one connection, no request of the robot, no duplicate of it.
    ensure!(scene.daemon.servants_of("sights_py")?.len() == 1);
    let told = scene.told()?;
    ensure!(told["connections"] == 1, "{told:#}");
    ensure!(told["response"].is_null(), "{told:#}");
    ensure!(told["id"] == scene.servant.as_str(), "{told:#}");
    let count = scene.rover.calls("/rosapi/nodes", json!({}))?;
    ensure!(count["result"] == true, "{count}");
    scene.rover.subscribes("/client_count")?;
    ensure!(scene.rover.hears_on("/client_count")?["data"] == 1);
    let events = scene.daemon.api("/api/v1/events?limit=10000")?;
    ensure!(
        !events.to_string().contains("duplicate-robot"),
        "{events:#}"
    );

    // A rule narrows what a viewer hears, at once.
    let rule = [
        "policy",
        "allow",
        "eve",
        "subscribe:/sights/map",
        "--service",
        "*",
    ];
    scene.daemon.deployer().types(&rule)?.succeeded()?;
    eve.hears_status("/sights/said")?;
    eve.says(json!({"op": "subscribe", "id": "again", "topic": "/sights/said"}))?;
    eve.hears_status("subscribe:/sights/said is not granted")?;
    // What was begun with a token ends with it.
    scene
        .daemon
        .deployer()
        .types(&["token", "revoke", "eve"])?
        .succeeded()?;
    let close = eve.hears_close()?;
    ensure!(
        u16::from(close.code) == 1008 && close.reason.contains("revoked"),
        "{close:?}"
    );
    // And with the servant.
    scene
        .daemon
        .deployer()
        .types(&["stop", &scene.servant])?
        .succeeded()?;
    let close = olga.hears_close()?;
    ensure!(u16::from(close.code) == 1012, "{close:?}");
    refused(scene.looks(&scene.admin), 404, "servant")?;
    scene.daemon.ends()?;
    Ok(())
}

pub fn looking_inside_keeps_no_servant_and_is_bounded() -> Verdict {
    let scene = Scene::new("inside-bounds", "[servant]\ngrace = \"1s\"\n")?;
    let eve = scene.viewer("eve", "sights*")?;
    let stranger = scene.viewer("stranger", "other*")?;
    let other = [
        "other",
        "--role",
        "robot",
        "--robot",
        "other",
        "--service",
        "sights_py",
    ];
    let other = token(&scene.daemon, &other)?;
    refused(scene.looks(&stranger), 403, "may not see servant")?;
    refused(scene.looks(&other), 403, "may not see")?;
    refused(scene.looks("guess"), 401, "not known")?;
    let bare = Robot::try_connect(&scene.daemon.url(&scene.address()));
    refused(bare, 401, "token")?;
    let elsewhere = format!("api/v1/servants/nothing/inside?token={eve}");
    refused(
        Robot::try_connect(&scene.daemon.url(&elsewhere)),
        403,
        "may not see",
    )?;
    let bearer = format!("Bearer {eve}");
    let path = format!("/{}", scene.address());
    let (status, body) = scene
        .daemon
        .request("GET", &path, &[("Authorization", &bearer)])?;
    ensure!(
        status == 400 && body.contains("no WebSocket handshake"),
        "{status} {body}"
    );

    // By a session, from the page's own origin alone.
    let made = ["create", "vera", "--role", "viewer", "--service", "sights*"];
    account(&scene.daemon, &made, people::PASSWORD)?.succeeded()?;
    let vera = people::Browser::signs_in(&scene.daemon, "vera", people::PASSWORD)?;
    let url = scene.daemon.url(&scene.address());
    let shows = |origin: Option<&str>| {
        let mut headers = vec![("Cookie", vera.cookie.as_str())];
        headers.extend(origin.map(|origin| ("Origin", origin)));
        Robot::try_connect_showing(&url, &headers)
    };
    refused(shows(None), 403, "may not use the session")?;
    for origin in ["http://evil.example", "null", "http://127.0.0.1:1"] {
        refused(shows(Some(origin)), 403, "may not use the session")?;
    }
    let mut hers = shows(Some(&vera.origin))?;
    hers.calls("/rosapi/topics", json!({}))?;

    // So many of one principal, and no more; one that leaves makes room.
    let mut many: Vec<Robot> = (0..4)
        .map(|_| scene.looks(&eve))
        .collect::<Result<_, _>>()?;
    refused(scene.looks(&eve), 429, "as many as may")?;
    many.pop().context("one")?.leaves()?;
    support::until("room for one more", || {
        Ok(scene
            .looks(&eve)
            .map(|one| many.push(one))
            .map_err(|refusal| refusal.to_string()))
    })?;
    // The robot goes: whoever looks keeps its servant from nothing.
    let Scene { daemon, rover, .. } = scene;
    rover.leaves()?;
    let close = hers.hears_close()?;
    ensure!(u16::from(close.code) == 1012, "{close:?}");
    for mut one in many {
        one.hears_close()?;
    }
    support::until("the servant's end", || {
        let left = daemon.servants_of("sights_py")?;
        Ok(left
            .is_empty()
            .then_some(())
            .ok_or_else(|| format!("{left:#?}")))
    })?;
    daemon.ends()?;
    Ok(())
}

pub fn who_looks_slowly_costs_its_robot_nothing() -> Verdict {
    let mut scene = Scene::new("inside-slow", "")?;
    let eve = scene.viewer("eve", "*")?;
    let url = scene
        .daemon
        .url(&format!("{}?token={eve}", scene.address()));
    // She asks for thirty pictures a second, and takes none of them.
    let mut slow = Robot::on_a_short_line(&url, &[])?;
    slow.says(json!({"op": "subscribe", "topic": "/sights/image/rgb8", "compression": "cbor"}))?;
    let publish = |op: &str| json!({"op": op, "topic": "/sights/say", "type": "std_msgs/String"});
    scene.rover.says(publish("advertise"))?;
    scene.rover.subscribes("/sights/said")?;
    let said = |words: &str| {
        let mut message = publish("publish");
        message["msg"] = json!({"data": words});
        message
    };
    support::until("the first answer", || {
        scene.rover.says(said("first"))?;
        let unheard = scene
            .rover
            .has_not_heard(|heard| heard["topic"] == "/sights/said")?;
        Ok((!unheard).then_some(()).ok_or_else(|| "none".to_owned()))
    })?;
    for number in 0..100 {
        let words = format!("the {number}th");
        scene.rover.says(said(&words))?;
        let is = |heard: &Value| heard["op"] == "publish" && heard["msg"]["data"] == words.as_str();
        scene.rover.hears(&words, is)?;
    }
    // The robot has lost nothing, and what she did not take is none of its drops.
    ensure!(scene.told()?["dropped"] == 0, "{:#}", scene.told()?);
    // And what she is given at last is new, not what was so when she began.
    hears_a_picture(&mut slow)?;
    scene.daemon.ends()?;
    Ok(())
}

/// `cloudroidctl topics` at work, which says a line each second.
struct Counting {
    child: Child,
    lines: mpsc::Receiver<String>,
}

impl Counting {
    /// As somebody with a token; none: as root.
    fn begins(scene: &Scene, token: Option<&str>) -> anyhow::Result<Counting> {
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
        thread::spawn(move || {
            out.lines()
                .map_while(Result::ok)
                .try_for_each(|line| told.send(line))
        });
        Ok(Counting { child, lines })
    }

    /// The topics of the first line that is so.
    fn tells(&self, is: impl Fn(&[Value]) -> bool) -> anyhow::Result<Vec<Value>> {
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

impl Drop for Counting {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn of(topics: &[Value], name: &str) -> Option<Value> {
    topics.iter().find(|one| one["topic"] == name).cloned()
}

pub fn what_is_published_is_counted_and_goals_are_remembered() -> Verdict {
    // A daemon that ends waits long for robots: what only tells of a servant is not waited for.
    let patient = "keep_servants = true\n[portal]\ndrain = \"20m\"\n";
    let setup = world().own("counted").config(patient);
    let mut scene = Scene::of(&setup)?;
    // A line each second, until whoever asks leaves.
    let counting = Counting::begins(&scene, None)?;
    let flows = |topics: &[Value], name: &str| {
        of(topics, name).is_some_and(|one| one["rate"].as_f64() > Some(0.0))
    };
    let topics = counting
        .tells(|topics| flows(topics, "/sights/scan") && flows(topics, "/sights/image/rgb8"))?;
    drop(counting);
    let found = of(&topics, "/sights/scan").zip(of(&topics, "/sights/image/rgb8"));
    let (scan, picture) = found.context("scans and pictures that are counted")?;
    ensure!(scan["type"] == "sensor_msgs/LaserScan", "{scan}");
    let number = |of: &Value, key: &str| of[key].as_f64().unwrap_or_default();
    // What a message has, rate and bandwidth say together.
    let each = number(&picture, "bandwidth") / number(&picture, "rate");
    ensure!(
        each > 640.0 * 480.0 * 3.0 && each < 640.0 * 480.0 * 3.1,
        "{picture}"
    );
    // Scans have a stamp, the pictures none.
    let latency = scan["latency"].as_f64().context("a latency")?;
    ensure!((0.0..30.0).contains(&latency), "{scan}");
    ensure!(picture.get("latency").is_none(), "{picture}");
    // Nobody keeps counting behind it.
    support::until("the place of who counted", || {
        let graph = scene.rover.calls(
            "/rosapi/subscribers",
            json!({"topic": "/sights/image/rgb8"}),
        )?;
        let left = graph["values"]["subscribers"]
            .as_array()
            .map_or(0, Vec::len);
        Ok((left == 0).then_some(()).ok_or_else(|| graph.to_string()))
    })?;

    // Who only looks is told of what a rule says, and a robot of itself alone.
    let eve = scene.viewer("eve", "sights*")?;
    let rule = [
        "policy",
        "allow",
        "eve",
        "subscribe:/sights/map",
        "--service",
        "*",
    ];
    scene.daemon.deployer().types(&rule)?.succeeded()?;
    let counting = Counting::begins(&scene, Some(&eve))?;
    let topics = counting.tells(|topics| !topics.is_empty())?;
    drop(counting);
    ensure!(
        topics.len() == 1 && topics[0]["topic"] == "/sights/map",
        "{topics:?}"
    );
    let other = [
        "other",
        "--role",
        "robot",
        "--robot",
        "other",
        "--service",
        "*",
    ];
    let other = token(&scene.daemon, &other)?;
    let server = format!("http://{}", scene.daemon.address);
    for verb in ["topics", "goals"] {
        let typed = ["--server", &server, "--token", &other, verb, &scene.servant];
        let refused = scene.daemon.deployer().types(&typed)?;
        ensure!(refused.status == 4, "{verb}: {}", refused.said());
    }

    // A goal of the robot that is reached, one that it cancels, and one of somebody who looks inside.
    let goal = |id: &str, count: u32| json!({"op": "send_action_goal", "id": id, "action": "/sights/count", "action_type": "actionlib/TestAction", "args": {"goal": count}, "feedback": true});
    let path = format!("/api/v1/servants/{}/goals", scene.servant);
    let listed = |daemon: &Daemon| -> anyhow::Result<Vec<Value>> {
        Ok(serde_json::from_value(daemon.api(&path)?)?)
    };
    // The first may have been sent before the robot's node is heard, of which only the end is known then.
    let mut early = 0;
    support::until("a goal that was heard when it was sent", || {
        early += 1;
        let id = format!("early{early}");
        scene.rover.says(goal(&id, 1))?;
        scene.rover.hears("its end", |said| {
            said["op"] == "action_result" && said["id"] == id.as_str()
        })?;
        let goals = listed(&scene.daemon)?;
        let known = [json!("robot rover"), json!("who sent it was not heard")];
        ensure!(
            goals.iter().all(|goal| known.contains(&goal["by"])),
            "{goals:?}"
        );
        let heard = goals.iter().any(|goal| goal["by"] == known[0]);
        Ok(heard.then_some(()).ok_or_else(|| format!("{goals:?}")))
    })?;
    let all_ended = |count: usize| {
        support::until(&format!("{count} goals that have ended"), || {
            let goals = listed(&scene.daemon)?;
            let ended = goals.iter().filter(|goal| goal["ended"].is_u64()).count();
            let are = ended == count && goals.len() == count;
            Ok(are
                .then(|| goals.clone())
                .ok_or_else(|| format!("{goals:?}")))
        })
    };
    all_ended(early)?;
    scene.rover.says(goal("short", 1))?;
    scene.rover.hears("its end", |said| {
        said["op"] == "action_result" && said["id"] == "short"
    })?;
    scene.rover.says(goal("long", 10_000))?;
    scene.rover.hears("that it has begun", |said| {
        said["op"] == "action_feedback" && said["id"] == "long"
    })?;
    scene
        .rover
        .says(json!({"op": "cancel_action_goal", "id": "long", "action": "/sights/count"}))?;
    scene.rover.hears("its end", |said| {
        said["op"] == "action_result" && said["id"] == "long"
    })?;
    let olga = token(&scene.daemon, &["olga", "--role", "operator"])?;
    let mut olga = scene.looks(&olga)?;
    olga.says(goal("hers", 1))?;
    let hers = olga.hears("its end", |said| said["op"] == "action_result")?;
    ensure!(hers["result"] == true, "{hers}");
    let goals = all_ended(early + 3)?;
    let told: Vec<_> = goals[..3]
        .iter()
        .rev()
        .map(|goal| (goal["by"].clone(), goal["state"].clone()))
        .collect();
    ensure!(
        told == [
            (json!("robot rover"), json!("succeeded")),
            (json!("robot rover"), json!("preempted")),
            (json!("somebody who looks inside"), json!("succeeded")),
        ],
        "{goals:?}"
    );
    // Each that ends is told, also where several end at once.
    for words in [
        "robot rover succeeded",
        "robot rover was cancelled",
        "somebody who looks inside succeeded",
    ] {
        scene.daemon.awaits_event(words, |event| {
            let said = event["message"].as_str().unwrap_or_default();
            event["kind"] == "goal-ended"
                && said.contains(&format!("/sights/count: the goal of {words}"))
        })?;
    }
    // She may not hear of them.
    let typed = [
        "--server",
        &server,
        "--token",
        &eve,
        "--format",
        "json",
        "goals",
        &scene.servant,
    ];
    let none = scene.daemon.deployer().types(&typed)?.succeeded()?;
    ensure!(none.stdout.trim() == "[]", "{}", none.said());

    let counting = Counting::begins(&scene, None)?;
    counting.tells(|_| true)?;
    drop(olga);
    let Scene { daemon, rover, .. } = scene;
    drop(rover);
    let (ended, end) = mpsc::channel();
    thread::spawn(move || ended.send(daemon.ends()));
    let ended = patience::receive(&end);
    ended.context("the daemon waits for those who are told of a servant")??;
    drop(counting);
    // What it has left goes on; the next one ends it.
    let daemon = setup.start()?;
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    daemon.ends()?;
    Ok(())
}
