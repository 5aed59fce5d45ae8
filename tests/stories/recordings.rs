//! Recordings of a servant's topics, read with the format's own readers, and replayed.

use std::cell::Cell;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use support::Verdict;
use support::binaries;
use support::deployer::{path_str, run};
use support::patience::{scale_seconds, tell_patience};
use support::world::world;

use crate::access::create_token;
use crate::inside::InsideScene;

/// Returns what the format's own Python packages find in a file.
pub fn read_recording(file: &Path) -> anyhow::Result<Value> {
    let said = with_python("read", file)?;
    Ok(serde_json::from_str(&said)?)
}

fn with_python(verb: &str, file: &Path) -> anyhow::Result<String> {
    let program = binaries::checkout().join("tests/readers/recording.py");
    let mut reader = Command::new(binaries::readers().join("python"));
    reader.arg(program).arg(verb).arg(file);
    Ok(run(&mut reader)?.expect_success()?.stdout)
}

/// A robot that publishes and subscribes with roslibpy.
struct TalkingRobot(Child);

impl TalkingRobot {
    /// Starts it; returns once its messages are answered.
    fn start(scene: &InsideScene) -> anyhow::Result<TalkingRobot> {
        let url = scene.daemon.url(&format!("sights_py?token={}", scene.token));
        let mut talks = Command::new(binaries::python());
        talks.arg(binaries::checkout().join("tests/robots/talks_with_roslibpy.py")).arg(url);
        let mut child = tell_patience(&mut talks).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let mut line = String::new();
        let mut out = BufReader::with_capacity(1, child.stdout.as_mut().context("piped")?);
        out.read_line(&mut line)?;
        ensure!(line == "heard\n", "{line}");
        Ok(TalkingRobot(child))
    }

    /// Returns the messages that it received up to its last one.
    fn finish(mut self) -> anyhow::Result<Vec<String>> {
        drop(self.0.stdin.take());
        let mut heard = String::new();
        let out = self.0.stdout.as_mut().context("piped")?;
        out.read_to_string(&mut heard)?;
        ensure!(self.0.wait()?.success(), "{heard}");
        Ok(serde_json::from_str(&heard)?)
    }
}

impl Drop for TalkingRobot {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the strings of a topic in a file that was read.
pub fn topic_texts(file: &Value, topic: &str) -> anyhow::Result<Vec<String>> {
    Ok(serde_json::from_value(file["texts"][topic].clone())?)
}

pub fn a_recording_holds_what_a_robot_heard_and_is_replayed() -> Verdict {
    let mut scene = InsideScene::new("recordings", "")?;
    let place = world().directory("recordings")?;
    let file = place.path().join("said.mcap");
    let talker = TalkingRobot::start(&scene)?;
    // Long enough for all topics to be connected, and for some messages.
    let duration = format!("{}s", scale_seconds(3));
    let typed = [
        "--format",
        "json",
        "record",
        &scene.servant,
        "-o",
        path_str(&file),
        "--topic",
        "/sights/sa*",
        "--topic",
        "/sights/map",
        "--duration",
        &duration,
    ];
    let outcome = scene.daemon.deployer().run(&typed)?.expect_success()?;
    let summary: Value = serde_json::from_str(&outcome.stdout)?;
    let heard = talker.finish()?;

    let read = read_recording(&file)?;
    ensure!(read["profile"] == "ros1", "{read}");
    ensure!(
        read["topics"]
            == json!({"/sights/map": "nav_msgs/OccupancyGrid", "/sights/said": "std_msgs/String",
                "/sights/say": "std_msgs/String"}),
        "{read}"
    );
    ensure!(read["messages"] == summary["messages"], "{read} {summary}");
    // All messages that roslibpy received from the first to the last one in the file.
    let said = topic_texts(&read, "/sights/said")?;
    let first = heard.iter().position(|word| Some(word) == said.first());
    let during = &heard[first.context("recorded and not heard")?..];
    ensure!(said.len() > 10 && during.starts_with(&said), "{said:?} {during:?}");

    // When the recording is replayed, the node gives the same answers.
    scene.rover.subscribe("/sights/said")?;
    let say = |op: &str| {
        json!({"op": op, "topic": "/sights/say", "type": "std_msgs/String",
        "msg": {"data": "heard?"}})
    };
    scene.rover.send(say("advertise"))?;
    support::wait_until("what it says itself comes back", || {
        scene.rover.send(say("publish"))?;
        let unheard = scene.rover.has_not_heard(|said| said["topic"] == "/sights/said")?;
        Ok((!unheard).then_some(()).ok_or_else(|| "not heard".to_owned()))
    })?;
    let replay = |more: &[&str]| {
        let typed = ["replay", path_str(&file), "--to", &scene.servant];
        scene.daemon.deployer().run(&[&typed, more].concat())
    };
    replay(&["--topic", "/sights/say", "--rate", "4"])?.expect_success()?;
    for word in &topic_texts(&read, "/sights/say")? {
        let mut again = scene.rover.next_message_on("/sights/said")?;
        while again["data"] == "heard?" {
            again = scene.rover.next_message_on("/sights/said")?;
        }
        ensure!(again["data"] == word.as_str(), "{again}, not {word}");
    }
    replay(&["--topic", "/nothing"])?.expect_failure(&["no messages on the selected topics"])?;
    // A viewer may record, but not publish.
    let eve = scene.viewer_token("eve", "sights*")?;
    let server = format!("http://{}", scene.daemon.address);
    let hers = ["--server", &server, "--token", &eve, "--topic", "/sights/say"];
    replay(&hers)?.expect_failure(&["publish:/sights/say is not granted"])?;
    scene.daemon.stop()?;
    Ok(())
}

pub fn what_cannot_be_recorded_or_replayed_is_said() -> Verdict {
    let scene = InsideScene::new("recordings-bad", "")?;
    let place = world().directory("recordings-bad")?;
    let at = |name: &str| place.path().join(name);
    let stranger = scene.viewer_token("stranger", "other*")?;
    let types = |words: &[&str]| scene.daemon.deployer().run(words);

    // A recording ends with Ctrl-C or with its servant; both leave a complete file.
    let size_of = |name: &str| std::fs::metadata(at(name)).map_or(0, |found| found.len());
    let begins = |name: &str, more: &[&str], has_begun: &dyn Fn() -> bool| -> anyhow::Result<Child> {
        let mut child = Command::new(binaries::path("cloudroidctl"))
            .args(["record", "sights_py", "-o", path_str(&at(name))])
            .args(["--topic", "/sights/scan"])
            .args(more)
            .env("CLOUDROID_HOME", &scene.daemon.deployer().home)
            .env_remove("CLOUDROID_SERVER")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut line = String::new();
        BufReader::new(child.stderr.as_mut().context("piped")?).read_line(&mut line)?;
        ensure!(line.contains("stop with Ctrl-C"), "{line}");
        // The file is flushed every second.
        support::wait_until("something in the file", || {
            Ok(has_begun().then_some(()).ok_or_else(|| "nothing".to_owned()))
        })?;
        Ok(child)
    };
    let interrupted = begins("interrupted.mcap", &[], &|| size_of("interrupted.mcap") > 2000)?;
    kill(Pid::from_raw(i32::try_from(interrupted.id())?), Signal::SIGINT)?;
    // As ros2 bag record does it: -d is the duration of a file, after which the next one begins.
    let part = |number: u32| at(&format!("parts_{number}.mcap"));
    let later = Cell::new(1);
    let has_later_messages = || {
        // A part is complete once the next one has begun. On a slow machine a part may contain no message.
        while part(later.get() + 1).exists() {
            if read_recording(&part(later.get())).is_ok_and(|read| read["messages"] != 0) {
                return true;
            }
            later.set(later.get() + 1);
        }
        false
    };
    let parts = begins("parts.mcap", &["-d", "1"], &has_later_messages)?;
    kill(Pid::from_raw(i32::try_from(parts.id())?), Signal::SIGINT)?;
    let parts = parts.wait_with_output()?;
    let said = String::from_utf8_lossy(&parts.stdout).into_owned();
    ensure!(parts.status.success() && said.contains("parts_0.mcap") && said.contains("parts_1.mcap"), "{said}");
    let later = read_recording(&part(later.get()))?;
    ensure!(later["topics"] == json!({"/sights/scan": "sensor_msgs/LaserScan"}), "{later}");
    let mut killed = begins("killed.mcap", &[], &|| size_of("killed.mcap") > 2000)?;
    killed.kill()?;
    killed.wait()?;
    let served = begins("served.mcap", &[], &|| size_of("served.mcap") > 2000)?;
    types(&["stop", &scene.servant])?.expect_success()?;
    for child in [interrupted, served] {
        let ended = child.wait_with_output()?;
        let said = String::from_utf8_lossy(&ended.stdout).into_owned();
        ensure!(ended.status.success(), "{said}");
        ensure!(said.contains("/sights/scan  sensor_msgs/LaserScan"), "{said}");
    }
    for name in ["interrupted.mcap", "served.mcap"] {
        let read = read_recording(&at(name))?;
        ensure!(read["topics"] == json!({"/sights/scan": "sensor_msgs/LaserScan"}), "{read}");
    }

    // Errors with their message and exit status.
    std::fs::write(at("text.mcap"), "no recording")?;
    with_python("foreign", &at("foreign.mcap"))?;
    let mut rover = scene.daemon.robot(&format!("sights_py?token={}", scene.token))?;
    rover.call("/rosapi/get_time", json!({}))?;
    let servant = scene.daemon.servant_of("sights_py", "rover")?;
    let servant = servant["id"].as_str().context("an id")?;
    let server = format!("http://{}", scene.daemon.address);
    let (text, foreign, killed, new) = (at("text.mcap"), at("foreign.mcap"), at("killed.mcap"), at("new.mcap"));
    let nowhere = at("no/such/directory.mcap");
    let rows: [(&[&str], i32, &[&str]); 9] = [
        (&["record", servant, "-o", path_str(&text)], 1, &["exists", "-o must name a new file"]),
        (&["record", servant, "-o", path_str(&nowhere)], 1, &["cannot create"]),
        (&["record", "nothing", "-o", path_str(&new)], 5, &["nothing"]),
        (&["record", servant, "-o", path_str(&new), "--duration", "soon"], 2, &["--duration"]),
        (&["record", servant, "-o", path_str(&new), "--server", &server, "--token", &stranger], 4, &["may not see"]),
        (&["replay", path_str(&text), "--to", servant], 1, &["is not an MCAP file"]),
        (&["replay", path_str(&new), "--to", servant], 1, &["cannot be read"]),
        (&["replay", path_str(&foreign), "--to", servant], 1, &["/chatter was skipped", "this servant expects ros1"]),
        (&["replay", path_str(&text), "--to", servant, "--rate", "0"], 2, &["greater than 0"]),
    ];
    for (words, status, said) in rows {
        let outcome = types(words)?.expect_failure(said)?;
        ensure!(outcome.status == status, "{words:?}: {}", outcome.status);
    }
    ensure!(!new.exists(), "what failed leaves no file");
    // The file of a killed recorder is played up to its last complete part.
    let outcome = types(&["replay", path_str(&killed), "--to", servant, "--rate", "100"])?;
    let outcome = outcome.expect_success()?;
    ensure!(outcome.stderr.contains("is truncated"), "{}", outcome.output());
    scene.daemon.stop()?;
    Ok(())
}

pub fn a_black_box_is_written_when_a_robot_waits_too_long() -> Verdict {
    let config = "[black_box]\nseconds = \"20s\"\ntopics = [\"/sights/scan\", \"/tf*\"]\nfiles = 2\n";
    let scene = InsideScene::new("black-box", config)?;
    let place = world().directory("black-box")?;
    let types = |words: &[&str]| scene.daemon.deployer().run(words);
    let listed = |words: &[&str]| -> anyhow::Result<Vec<Value>> {
        let typed = [&["--format", "json", "recordings", "list"], words].concat();
        Ok(serde_json::from_str(&types(&typed)?.expect_success()?.stdout)?)
    };
    ensure!(listed(&[])?.is_empty(), "nobody has waited yet");

    // Scans have been received for a while.
    support::wait_until("some seconds in the box", || {
        let typed = ["--format", "json", "recordings", "take", &scene.servant];
        let outcome = types(&typed)?;
        if outcome.status != 0 {
            return Ok(Err(outcome.output()));
        }
        let taken: Value = serde_json::from_str(&outcome.stdout)?;
        let number = taken[0]["number"].to_string();
        types(&["recordings", "rm", &number])?.expect_success()?;
        let enough = taken[0]["seconds"].as_f64() > Some(2.0);
        Ok(enough.then_some(()).ok_or_else(|| taken.to_string()))
    })?;
    // No answer arrives within twenty microseconds.
    let path = format!("sights_py?token={}&rrt=0.00001&max_rrt=0.00002", scene.token);
    let mut rover = scene.daemon.robot(&path)?;
    let written = support::wait_until("a recording", || {
        rover.call("/sights/ping", json!({}))?;
        let all = listed(&["--robot", "rover"])?;
        Ok(all.first().cloned().ok_or_else(|| "none yet".to_owned()))
    })?;
    let why = written["why"].as_str().context("a reason")?;
    ensure!(why.contains("a request took") && why.contains("its robot accepts"), "{why}");
    scene
        .daemon
        .wait_for_event("that it is recorded", |event| event["kind"] == "recorded" && event["robot"] == "rover")?;
    // At most once per minute, however many answers are late.
    rover.call("/sights/ping", json!({}))?;
    let times: Vec<u64> = listed(&[])?.iter().filter_map(|one| one["time"].as_u64()).collect();
    ensure!(!times.is_empty() && times.windows(2).all(|two| two[0] - two[1] > 59_000), "{times:?}");

    // It contains earlier messages, latched messages, and nothing else.
    let number = written["number"].to_string();
    let file = place.path().join("box.mcap");
    types(&["recordings", "get", &number, "-o", path_str(&file)])?.expect_success()?;
    let read = read_recording(&file)?;
    ensure!(read["messages"] == written["messages"], "{read} {written}");
    let size = std::fs::metadata(&file)?.len();
    ensure!(written["bytes"] == size, "{size} bytes: {written}");
    for topic in ["/tf_static", "/sights/scan", "/tf"] {
        ensure!(read["topics"].get(topic).is_some(), "{topic}: {read}");
    }
    ensure!(read["topics"].as_object().is_some_and(|topics| topics.len() == 3), "{read}");
    types(&["replay", path_str(&file), "--to", &scene.servant, "--rate", "100"])?.expect_success()?;

    // Principals who may view the service may read recordings; those who may operate it may also take them.
    let server = format!("http://{}", scene.daemon.address);
    let typed_by =
        |token: &str, words: &[&str]| types(&[&["--server", &server, "--token", token, "recordings"], words].concat());
    let eve = scene.viewer_token("eve", "sights*")?;
    let stranger = scene.viewer_token("stranger", "other*")?;
    let copy = place.path().join("copy.mcap");
    typed_by(&eve, &["get", &number, "-o", path_str(&copy)])?.expect_success()?;
    ensure!(std::fs::read(&copy)? == std::fs::read(&file)?, "another file");
    // As far as the rules permit her to receive the topics.
    let refused = |who: &str| typed_by(who, &["get", &number])?.expect_failure(&["may not subscribe to"]);
    let allow = |grant: &str| {
        let rule = ["policy", "allow", "narrow", grant, "--service", "sights*"];
        types(&rule)?.expect_success()
    };
    let narrow = scene.viewer_token("narrow", "sights*")?;
    allow("subscribe:/sights/scan")?;
    ensure!(refused(&narrow)?.status == 4, "another status");
    let hidden = typed_by(&narrow, &["list"])?.expect_success()?;
    ensure!(hidden.stdout.is_empty(), "{}", hidden.stdout);
    allow("subscribe:/tf*")?;
    let had = place.path().join("had.mcap");
    typed_by(&narrow, &["get", &number, "-o", path_str(&had)])?.expect_success()?;
    // A robot may read its own recordings, and no others.
    let own = place.path().join("own.mcap");
    typed_by(&scene.token, &["get", &number, "-o", path_str(&own)])?.expect_success()?;
    let other = ["other", "--role", "robot", "--robot", "other", "--service", "sights*"];
    let other = create_token(&scene.daemon, &other)?;
    let hidden = typed_by(&other, &["list"])?.expect_success()?;
    ensure!(hidden.stdout.is_empty(), "{}", hidden.stdout);
    for (who, words, status) in [
        (&other, &["get", &number][..], 4),
        (&eve, &["take", &scene.servant], 4),
        (&eve, &["rm", &number], 4),
        (&stranger, &["get", &number], 4),
        (&stranger, &["rm", &number], 4),
    ] {
        let refused = typed_by(who, words)?;
        ensure!(refused.status == status, "{words:?}: {}", refused.status);
    }
    let hidden = typed_by(&stranger, &["list"])?.expect_success()?;
    ensure!(hidden.stdout.is_empty(), "{}", hidden.stdout);
    types(&["recordings", "get", "99"])?.expect_failure(&["there is no recording 99", "recordings list"])?;

    // The oldest recording is deleted when there are more than two.
    let take = || types(&["recordings", "take", &scene.servant]);
    for _ in 0..2 {
        support::wait_until("another file", || {
            let taken = take()?;
            Ok((taken.status == 0).then_some(()).ok_or_else(|| taken.output()))
        })?;
    }
    // Recordings cannot be taken in quick succession.
    let soon = support::wait_until("a refusal", || {
        let taken = take()?;
        Ok(if taken.status == 0 { Err("this machine took its time to ask again".to_owned()) } else { Ok(taken) })
    })?;
    let soon = soon.expect_failure(&["a moment ago"])?;
    ensure!(soon.status == 7, "{}", soon.status);
    let all = listed(&[])?;
    ensure!(all.len() == 2 && all.iter().all(|one| one["number"] != written["number"]), "{all:?}");
    ensure!(all[0]["why"].as_str().is_some_and(|why| why.contains("asked for it")), "{all:?}");
    let files = || -> anyhow::Result<usize> { Ok(std::fs::read_dir(scene.daemon.home.join("recordings"))?.count()) };
    ensure!(files()? == 2, "{} files", files()?);
    let last = all[1]["number"].to_string();
    types(&["recordings", "rm", &last])?.expect_success()?;
    ensure!((listed(&[])?.len(), files()?) == (1, 1), "{} files", files()?);

    // Recordings are removed with their service, because the next service of that name may have another owner.
    types(&["rm", "sights_py"])?.expect_success()?;
    ensure!((listed(&[])?.len(), files()?) == (0, 0), "{} files", files()?);

    // Without a black box that is reported.
    scene.daemon.stop()?;
    let scene = InsideScene::new("no-black-box", "")?;
    scene
        .daemon
        .deployer()
        .run(&["recordings", "take", &scene.servant])?
        .expect_failure(&["has no ring-buffer recording", "[black_box]"])?;
    scene.daemon.stop()?;
    Ok(())
}
