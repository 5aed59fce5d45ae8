//! What flows in a servant is recorded, read by the format's own readers, and replayed.

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

use crate::access::token;
use crate::inside::Scene;

/// What the format's own Python packages find in a file.
pub fn reads(file: &Path) -> anyhow::Result<Value> {
    let said = with_python("read", file)?;
    Ok(serde_json::from_str(&said)?)
}

fn with_python(verb: &str, file: &Path) -> anyhow::Result<String> {
    let program = binaries::checkout().join("tests/readers/recording.py");
    let mut reader = Command::new(binaries::readers().join("python"));
    reader.arg(program).arg(verb).arg(file);
    Ok(run(&mut reader)?.succeeded()?.stdout)
}

/// A robot that talks with roslibpy.
struct Talker(Child);

impl Talker {
    /// Returns once it is answered.
    fn begins(scene: &Scene) -> anyhow::Result<Talker> {
        let url = scene
            .daemon
            .url(&format!("sights_py?token={}", scene.token));
        let mut talks = Command::new(binaries::python());
        talks
            .arg(binaries::checkout().join("tests/robots/talks_with_roslibpy.py"))
            .arg(url);
        let mut child = tell_patience(&mut talks)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let mut line = String::new();
        let mut out = BufReader::with_capacity(1, child.stdout.as_mut().context("piped")?);
        out.read_line(&mut line)?;
        ensure!(line == "heard\n", "{line}");
        Ok(Talker(child))
    }

    /// What it has heard, once it has heard its last word.
    fn ends(mut self) -> anyhow::Result<Vec<String>> {
        drop(self.0.stdin.take());
        let mut heard = String::new();
        let out = self.0.stdout.as_mut().context("piped")?;
        out.read_to_string(&mut heard)?;
        ensure!(self.0.wait()?.success(), "{heard}");
        Ok(serde_json::from_str(&heard)?)
    }
}

impl Drop for Talker {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Those of a topic of strings in a file that was read.
pub fn texts(file: &Value, topic: &str) -> anyhow::Result<Vec<String>> {
    Ok(serde_json::from_value(file["texts"][topic].clone())?)
}

pub fn a_recording_holds_what_a_robot_heard_and_is_replayed() -> Verdict {
    let mut scene = Scene::new("recordings", "")?;
    let place = world().directory("recordings")?;
    let file = place.path().join("said.mcap");
    let talker = Talker::begins(&scene)?;
    // Long enough for all topics to be connected, and for some words.
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
    let outcome = scene.daemon.deployer().types(&typed)?.succeeded()?;
    let summary: Value = serde_json::from_str(&outcome.stdout)?;
    let heard = talker.ends()?;

    let read = reads(&file)?;
    ensure!(read["profile"] == "ros1", "{read}");
    ensure!(
        read["topics"]
            == json!({"/sights/map": "nav_msgs/OccupancyGrid", "/sights/said": "std_msgs/String", "/sights/say": "std_msgs/String"}),
        "{read}"
    );
    ensure!(read["messages"] == summary["messages"], "{read} {summary}");
    // All that roslibpy heard from the first to the last of them.
    let said = texts(&read, "/sights/said")?;
    let first = heard.iter().position(|word| Some(word) == said.first());
    let during = &heard[first.context("recorded and not heard")?..];
    ensure!(
        said.len() > 10 && during.starts_with(&said),
        "{said:?} {during:?}"
    );

    // Replayed, the node answers as it did.
    scene.rover.subscribes("/sights/said")?;
    let say = |op: &str| json!({"op": op, "topic": "/sights/say", "type": "std_msgs/String", "msg": {"data": "heard?"}});
    scene.rover.says(say("advertise"))?;
    support::until("what it says itself comes back", || {
        scene.rover.says(say("publish"))?;
        let unheard = scene
            .rover
            .has_not_heard(|said| said["topic"] == "/sights/said")?;
        Ok((!unheard)
            .then_some(())
            .ok_or_else(|| "not heard".to_owned()))
    })?;
    let replay = |more: &[&str]| {
        let typed = ["replay", path_str(&file), "--to", &scene.servant];
        scene.daemon.deployer().types(&[&typed, more].concat())
    };
    replay(&["--topic", "/sights/say", "--rate", "4"])?.succeeded()?;
    for word in &texts(&read, "/sights/say")? {
        let mut again = scene.rover.hears_on("/sights/said")?;
        while again["data"] == "heard?" {
            again = scene.rover.hears_on("/sights/said")?;
        }
        ensure!(again["data"] == word.as_str(), "{again}, not {word}");
    }
    replay(&["--topic", "/nothing"])?.failed_saying(&["no message of a wanted topic"])?;
    // Who only looks may record, and publish nothing.
    let eve = scene.viewer("eve", "sights*")?;
    let server = format!("http://{}", scene.daemon.address);
    let hers = [
        "--server",
        &server,
        "--token",
        &eve,
        "--topic",
        "/sights/say",
    ];
    replay(&hers)?.failed_saying(&["publish:/sights/say is not granted"])?;
    scene.daemon.ends()?;
    Ok(())
}

pub fn what_cannot_be_recorded_or_replayed_is_said() -> Verdict {
    let scene = Scene::new("recordings-bad", "")?;
    let place = world().directory("recordings-bad")?;
    let at = |name: &str| place.path().join(name);
    let stranger = scene.viewer("stranger", "other*")?;
    let types = |words: &[&str]| scene.daemon.deployer().types(words);

    // Ctrl-C ends a recording, and so does the servant's end: both leave a whole file.
    let begins = |name: &str| -> anyhow::Result<Child> {
        let mut child = Command::new(binaries::path("cloudroidctl"))
            .args(["record", "sights_py", "-o", path_str(&at(name))])
            .args(["--topic", "/sights/scan"])
            .env("CLOUDROID_HOME", &scene.daemon.deployer().home)
            .env_remove("CLOUDROID_SERVER")
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut line = String::new();
        BufReader::new(child.stderr.as_mut().context("piped")?).read_line(&mut line)?;
        ensure!(line.contains("Ctrl-C ends it"), "{line}");
        // Written out every second, whatever comes after.
        support::until("something in the file", || {
            let size = std::fs::metadata(at(name))?.len();
            Ok((size > 2000).then_some(()).ok_or(size.to_string()))
        })?;
        Ok(child)
    };
    let interrupted = begins("interrupted.mcap")?;
    kill(
        Pid::from_raw(i32::try_from(interrupted.id())?),
        Signal::SIGINT,
    )?;
    let mut killed = begins("killed.mcap")?;
    killed.kill()?;
    killed.wait()?;
    let served = begins("served.mcap")?;
    types(&["stop", &scene.servant])?.succeeded()?;
    for child in [interrupted, served] {
        let ended = child.wait_with_output()?;
        let said = String::from_utf8_lossy(&ended.stdout).into_owned();
        ensure!(ended.status.success(), "{said}");
        ensure!(
            said.contains("/sights/scan  sensor_msgs/LaserScan"),
            "{said}"
        );
    }
    for name in ["interrupted.mcap", "served.mcap"] {
        let read = reads(&at(name))?;
        ensure!(
            read["topics"] == json!({"/sights/scan": "sensor_msgs/LaserScan"}),
            "{read}"
        );
    }

    // Each in words, with the exit status that belongs to it.
    std::fs::write(at("text.mcap"), "no recording")?;
    with_python("foreign", &at("foreign.mcap"))?;
    let mut rover = scene
        .daemon
        .robot(&format!("sights_py?token={}", scene.token))?;
    rover.calls("/rosapi/get_time", json!({}))?;
    let servant = scene.daemon.servant_of("sights_py", "rover")?;
    let servant = servant["id"].as_str().context("an id")?;
    let server = format!("http://{}", scene.daemon.address);
    let (text, foreign, killed, new) = (
        at("text.mcap"),
        at("foreign.mcap"),
        at("killed.mcap"),
        at("new.mcap"),
    );
    let nowhere = at("no/such/directory.mcap");
    let rows: [(&[&str], i32, &[&str]); 9] = [
        (
            &["record", servant, "-o", path_str(&text)],
            1,
            &["exists", "-o is to name a new file"],
        ),
        (
            &["record", servant, "-o", path_str(&nowhere)],
            1,
            &["cannot be made"],
        ),
        (
            &["record", "nothing", "-o", path_str(&new)],
            5,
            &["nothing"],
        ),
        (
            &[
                "record",
                servant,
                "-o",
                path_str(&new),
                "--duration",
                "soon",
            ],
            2,
            &["--duration"],
        ),
        (
            &[
                "record",
                servant,
                "-o",
                path_str(&new),
                "--server",
                &server,
                "--token",
                &stranger,
            ],
            4,
            &["may not see"],
        ),
        (
            &["replay", path_str(&text), "--to", servant],
            1,
            &["is no MCAP file"],
        ),
        (
            &["replay", path_str(&new), "--to", servant],
            1,
            &["cannot be read"],
        ),
        (
            &["replay", path_str(&foreign), "--to", servant],
            1,
            &["/chatter was left out", "this servant takes ros1"],
        ),
        (
            &["replay", path_str(&text), "--to", servant, "--rate", "0"],
            2,
            &["more than 0"],
        ),
    ];
    for (words, status, said) in rows {
        let outcome = types(words)?.failed_saying(said)?;
        ensure!(outcome.status == status, "{words:?}: {}", outcome.status);
    }
    ensure!(!new.exists(), "what failed leaves no file");
    // What was being written when its program was killed is played up to there.
    let outcome = types(&[
        "replay",
        path_str(&killed),
        "--to",
        servant,
        "--rate",
        "100",
    ])?;
    let outcome = outcome.succeeded()?;
    ensure!(outcome.stderr.contains("breaks off"), "{}", outcome.said());
    scene.daemon.ends()?;
    Ok(())
}

pub fn a_black_box_is_written_when_a_robot_waits_too_long() -> Verdict {
    let config =
        "[black_box]\nseconds = \"20s\"\ntopics = [\"/sights/scan\", \"/tf*\"]\nfiles = 2\n";
    let scene = Scene::new("black-box", config)?;
    let place = world().directory("black-box")?;
    let types = |words: &[&str]| scene.daemon.deployer().types(words);
    let listed = |words: &[&str]| -> anyhow::Result<Vec<Value>> {
        let typed = [&["--format", "json", "recordings", "list"], words].concat();
        Ok(serde_json::from_str(&types(&typed)?.succeeded()?.stdout)?)
    };
    ensure!(listed(&[])?.is_empty(), "nobody has waited yet");

    // It has heard scans for a while.
    support::until("some seconds in the box", || {
        let typed = ["--format", "json", "recordings", "take", &scene.servant];
        let outcome = types(&typed)?;
        if outcome.status != 0 {
            return Ok(Err(outcome.said()));
        }
        let taken: Value = serde_json::from_str(&outcome.stdout)?;
        let number = taken[0]["number"].to_string();
        types(&["recordings", "rm", &number])?.succeeded()?;
        let enough = taken[0]["seconds"].as_f64() > Some(2.0);
        Ok(enough.then_some(()).ok_or_else(|| taken.to_string()))
    })?;
    // No answer comes in twenty microseconds.
    let path = format!(
        "sights_py?token={}&rrt=0.00001&max_rrt=0.00002",
        scene.token
    );
    let mut rover = scene.daemon.robot(&path)?;
    let written = support::until("a recording", || {
        rover.calls("/sights/ping", json!({}))?;
        let all = listed(&["--robot", "rover"])?;
        Ok(all.first().cloned().ok_or_else(|| "none yet".to_owned()))
    })?;
    let why = written["why"].as_str().context("a reason")?;
    ensure!(
        why.contains("a request took") && why.contains("its robot accepts"),
        "{why}"
    );
    scene.daemon.awaits_event("that it is recorded", |event| {
        event["kind"] == "recorded" && event["robot"] == "rover"
    })?;
    // Once in a minute, however often it waits.
    rover.calls("/sights/ping", json!({}))?;
    let times: Vec<u64> = listed(&[])?
        .iter()
        .filter_map(|one| one["time"].as_u64())
        .collect();
    ensure!(
        !times.is_empty() && times.windows(2).all(|two| two[0] - two[1] > 59_000),
        "{times:?}"
    );

    // It holds what was published before, what was latched long ago, and nothing else.
    let number = written["number"].to_string();
    let file = place.path().join("box.mcap");
    types(&["recordings", "get", &number, "-o", path_str(&file)])?.succeeded()?;
    let read = reads(&file)?;
    ensure!(read["messages"] == written["messages"], "{read} {written}");
    let size = std::fs::metadata(&file)?.len();
    ensure!(written["bytes"] == size, "{size} bytes: {written}");
    for topic in ["/tf_static", "/sights/scan", "/tf"] {
        ensure!(read["topics"].get(topic).is_some(), "{topic}: {read}");
    }
    ensure!(
        read["topics"]
            .as_object()
            .is_some_and(|topics| topics.len() == 3),
        "{read}"
    );
    types(&[
        "replay",
        path_str(&file),
        "--to",
        &scene.servant,
        "--rate",
        "100",
    ])?
    .succeeded()?;

    // Who sees the service sees it; who operates it takes one when it is wanted.
    let server = format!("http://{}", scene.daemon.address);
    let typed_by = |token: &str, words: &[&str]| {
        types(
            &[
                &["--server", &server, "--token", token, "recordings"],
                words,
            ]
            .concat(),
        )
    };
    let eve = scene.viewer("eve", "sights*")?;
    let stranger = scene.viewer("stranger", "other*")?;
    let copy = place.path().join("copy.mcap");
    typed_by(&eve, &["get", &number, "-o", path_str(&copy)])?.succeeded()?;
    ensure!(
        std::fs::read(&copy)? == std::fs::read(&file)?,
        "another file"
    );
    // As far as rules let her hear what is in it.
    let refused = |who: &str| typed_by(who, &["get", &number])?.failed_saying(&["may not hear"]);
    let allow = |grant: &str| {
        let rule = ["policy", "allow", "narrow", grant, "--service", "sights*"];
        types(&rule)?.succeeded()
    };
    let narrow = scene.viewer("narrow", "sights*")?;
    allow("subscribe:/sights/scan")?;
    ensure!(refused(&narrow)?.status == 4, "another status");
    let hidden = typed_by(&narrow, &["list"])?.succeeded()?;
    ensure!(hidden.stdout.is_empty(), "{}", hidden.stdout);
    allow("subscribe:/tf*")?;
    let had = place.path().join("had.mcap");
    typed_by(&narrow, &["get", &number, "-o", path_str(&had)])?.succeeded()?;
    // A robot has its own, and no other's.
    let own = place.path().join("own.mcap");
    typed_by(&scene.token, &["get", &number, "-o", path_str(&own)])?.succeeded()?;
    let other = [
        "other",
        "--role",
        "robot",
        "--robot",
        "other",
        "--service",
        "sights*",
    ];
    let other = token(&scene.daemon, &other)?;
    let hidden = typed_by(&other, &["list"])?.succeeded()?;
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
    let hidden = typed_by(&stranger, &["list"])?.succeeded()?;
    ensure!(hidden.stdout.is_empty(), "{}", hidden.stdout);
    types(&["recordings", "get", "99"])?
        .failed_saying(&["there is no recording 99", "recordings list"])?;

    // Beyond two files the oldest goes.
    let take = || types(&["recordings", "take", &scene.servant]);
    for _ in 0..2 {
        support::until("another file", || {
            let taken = take()?;
            Ok((taken.status == 0)
                .then_some(())
                .ok_or_else(|| taken.said()))
        })?;
    }
    // Nobody takes one after the other.
    let soon = support::until("a refusal", || {
        let taken = take()?;
        Ok(if taken.status == 0 {
            Err("this machine took its time to ask again".to_owned())
        } else {
            Ok(taken)
        })
    })?;
    let soon = soon.failed_saying(&["a moment ago"])?;
    ensure!(soon.status == 7, "{}", soon.status);
    let all = listed(&[])?;
    ensure!(
        all.len() == 2 && all.iter().all(|one| one["number"] != written["number"]),
        "{all:?}"
    );
    ensure!(
        all[0]["why"]
            .as_str()
            .is_some_and(|why| why.contains("asked for it")),
        "{all:?}"
    );
    let files = || -> anyhow::Result<usize> {
        Ok(std::fs::read_dir(scene.daemon.home.join("recordings"))?.count())
    };
    ensure!(files()? == 2, "{} files", files()?);
    let last = all[1]["number"].to_string();
    types(&["recordings", "rm", &last])?.succeeded()?;
    ensure!(
        (listed(&[])?.len(), files()?) == (1, 1),
        "{} files",
        files()?
    );

    // They go with their service: the next of that name may be somebody else's.
    types(&["rm", "sights_py"])?.succeeded()?;
    ensure!(
        (listed(&[])?.len(), files()?) == (0, 0),
        "{} files",
        files()?
    );

    // Where nothing is kept, that is said.
    scene.daemon.ends()?;
    let scene = Scene::new("no-black-box", "")?;
    scene
        .daemon
        .deployer()
        .types(&["recordings", "take", &scene.servant])?
        .failed_saying(&["nothing of servant", "[black_box]"])?;
    scene.daemon.ends()?;
    Ok(())
}
