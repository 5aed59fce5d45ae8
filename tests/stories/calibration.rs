//! Calibration measures the limits needed for response times, without affecting the robot whose requests are used.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::{path_str, run};
use support::robot::Robot;
use support::world::{PEOPLE, TELLER, world};

/// Video of Debian's opencv-doc.
pub const PEDESTRIANS: &str = "/usr/share/doc/opencv-doc/examples/data/vtest.avi";

/// Separate service name for people_detect.
const SERVICE: &str = "calibrated";

/// Extracts five images.
fn extract_frames(directory: &Path) -> Verdict {
    run(Command::new("ffmpeg")
        .args(["-loglevel", "error", "-i", PEDESTRIANS, "-frames:v", "5"])
        .args(["-s", "640x480"])
        .arg(directory.join("frame%02d.png")))?
    .expect_success()?;
    Ok(())
}

/// Returns the servants of a service that are being calibrated.
pub fn measured_servants(daemon: &Daemon, service: &str) -> anyhow::Result<Vec<Value>> {
    let servants = daemon.servants_of(service)?.into_iter();
    let measured = servants.filter(|servant| {
        let robot = servant["robot"].as_str().unwrap_or_default();
        robot.starts_with("~calibrate-")
    });
    Ok(measured.collect())
}

/// Waits until no such servant is left.
pub fn wait_until_none_left(daemon: &Daemon, service: &str) -> Verdict {
    support::wait_until("the measured servant's end", || {
        let left = measured_servants(daemon, service)?;
        Ok(if left.is_empty() { Ok(()) } else { Err(format!("{left:#?}")) })
    })
}

/// Parses the last line of the machine-readable output.
fn parse_calibration(printed: &str) -> anyhow::Result<Value> {
    let last = printed.lines().last().context("nothing was printed")?;
    serde_json::from_str(last).with_context(|| last.to_owned())
}

fn point_time(point: &Value, name: &str) -> anyhow::Result<f64> {
    point[name].as_f64().with_context(|| format!("{name} of {point}"))
}

pub fn fewer_cores_take_longer_and_rows_say_how_long() -> Verdict {
    // A separate daemon, because the cores for calibration are not available to the robots of other stories.
    let daemon = world().setup("calibrated").start()?;
    let pushed = [&["push", "--name", SERVICE], PEOPLE.arguments].concat();
    daemon.deployer().run(&pushed)?.expect_success()?;
    let place = world().directory("frames")?;
    extract_frames(place.path())?;
    let curve = place.path().join("curve.svg");
    let printed = daemon
        .deployer()
        .run(&[
            "--format",
            "json",
            "calibrate",
            SERVICE,
            "--frames",
            path_str(place.path()),
            "--cpus",
            "0.2,1",
            "--requests",
            "12",
            "--network",
            "10",
            "--aux",
            "width=640",
            "--yes",
            "--curve",
            path_str(&curve),
        ])?
        .expect_success()?;
    wait_until_none_left(&daemon, SERVICE)?;
    let calibration = parse_calibration(&printed.stdout)?;
    let points = calibration["points"].as_array().context("points")?;
    ensure!(points.len() == 2, "{calibration:#}");
    let (tight, wide) = (&points[0], &points[1]);
    ensure!(tight["answered"] == 12 && tight["requests"] == 12, "{tight:#}");
    // With a fifth of a core the work takes five times as long; at least half of that remains even if the first tenth
    // of a second is free.
    let (running, took) = (point_time(tight, "running")?, point_time(&tight["compute"], "p50")?);
    ensure!(took > running * 2.5, "no limit was in force: {tight:#}");
    ensure!(point_time(tight, "throttled")? > running, "{tight:#}");
    ensure!(point_time(wide, "throttled")? < point_time(tight, "throttled")?, "{calibration:#}");
    let peak = calibration["memory_peak"].as_u64().context("a peak")?;
    let rows = calibration["rows"].as_array().context("rows")?;
    let cheapest = rows.first().with_context(|| format!("{calibration:#}"))?;
    ensure!(cheapest["limits"]["memory"].as_u64() >= Some(peak / 100 * 125), "{calibration:#}");
    ensure!(peak > 20 << 20, "people_detect has more than that: {calibration:#}");
    // The row includes the time on the network.
    let slowest = point_time(&tight["compute"], "p95")? + 10.0;
    ensure!((point_time(&cheapest["spread"], "p95")? * 1000.0 - slowest).abs() < 1e-6, "{calibration:#}");
    let drawn = std::fs::read_to_string(&curve)?;
    ensure!(drawn.contains("calibrated, revision") && drawn.contains("class=\"row\""), "{drawn}");
    robots_get_what_was_measured(&daemon, rows)?;
    Ok(())
}

/// Checks that the written rows determine the limits of robots with corresponding wishes.
fn robots_get_what_was_measured(daemon: &Daemon, measured: &[Value]) -> Verdict {
    let written = daemon.deployer().run_json(&["sla", "list", SERVICE])?;
    let written = written.as_array().context("rows")?;
    ensure!(written.len() == measured.len(), "{written:#?}");
    for (number, row) in measured.iter().enumerate() {
        ensure!(row["aux"]["width"] == "640", "{row:#}");
        let path = format!("{SERVICE}?robot=wishes{number}&rrt={}&aux.width=320", row["value"]);
        let _robot = daemon.robot(&path)?;
        let servant = daemon.servant_of(SERVICE, &format!("wishes{number}"))?;
        for limit in ["cpus", "memory"] {
            ensure!(servant["limits"][limit] == row["limits"][limit], "{limit} of {row:#}: {servant:#}");
        }
        let id = servant["id"].as_str().context("an id")?;
        daemon.deployer().run(&["stop", id])?.expect_success()?;
    }
    Ok(())
}

pub fn what_cannot_be_calibrated_is_said() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let place = world().directory("no-frames")?;
    let refused = |words: &[&str], saying: &[&str]| {
        let outcome = daemon.deployer().run(&[&["calibrate", "opencv_apps"], words].concat())?;
        outcome.expect_failure(saying)
    };
    refused(&["--frames", path_str(place.path())], &["holds no .png file"])?;
    let bad = place.path().join("bad.png");
    std::fs::write(&bad, "no picture")?;
    refused(&["--frames", path_str(place.path())], &["cannot be read", "PNG"])?;
    refused(&["--bag", path_str(&bad)], &["not a rosbag file"])?;
    refused(&["--live", "nobody"], &["robot nobody does not use opencv_apps now", "cloudroidctl servants"])?;
    refused(&["--live", "nobody", "--cpus", "0"], &["cpus = 0 is not between"])?;
    let robot = daemon.robot("opencv_apps?robot=silent")?;
    daemon.wait_for_event("a ready servant", |event| event["kind"] == "servant-ready" && event["robot"] == "silent")?;
    refused(&["--live", "silent", "--seconds", "0.2"], &["robot silent sent nothing to opencv_apps within 0.2 s"])?;
    drop(robot);
    wait_until_none_left(&daemon, "opencv_apps")
}

/// Publishes words until one of them is answered and all answers have arrived: then both topics are connected and no
/// message is in flight.
fn wait_until_echoed(robot: &mut Robot) -> Verdict {
    let say = |robot: &mut Robot, word: &str| {
        robot.send(json!({"op": "publish", "topic": "/teller/say", "msg": {"data": word}}))
    };
    support::wait_until("an answer", || {
        say(robot, "hello")?;
        let heard = !robot.has_not_heard(|value| value["topic"] == "/teller/said")?;
        Ok(if heard { Ok(()) } else { Err("none".to_owned()) })
    })?;
    say(robot, "begin")?;
    while robot.next_message_on("/teller/said")?["data"] != "begin" {}
    Ok(())
}

fn talk(robot: &mut Robot, told: &AtomicBool) -> anyhow::Result<(Vec<String>, Vec<String>)> {
    let (mut said, mut heard) = (Vec::new(), Vec::new());
    while !told.load(Ordering::SeqCst) {
        let word = format!("word {}", said.len());
        robot.send(json!({"op": "publish", "topic": "/teller/say", "msg": {"data": word}}))?;
        said.push(word);
        let answer = robot.next_message_on("/teller/said")?;
        heard.push(answer["data"].as_str().unwrap_or_default().to_owned());
    }
    // Everything in flight arrives before this call is answered.
    let more = !robot.has_not_heard(|value| value["topic"] == "/teller/said")?;
    ensure!(!more, "something was answered twice");
    Ok((said, heard))
}

pub fn a_robots_own_requests_are_replayed_and_it_hears_none_of_the_answers() -> Verdict {
    let daemon = world().setup("calibrated-live").start()?;
    daemon.deployer().push("teller_py", TELLER.arguments)?.expect_success()?;
    let mut robot = daemon.robot("teller_py?robot=talker")?;
    robot.send(json!({"op": "advertise", "topic": "/teller/say", "type": "std_msgs/String"}))?;
    robot.subscribe("/teller/said")?;
    robot.wait_for_subscriber("/teller/say")?;
    wait_until_echoed(&mut robot)?;
    let over = AtomicBool::new(false);
    let place = world().directory("live")?;
    let curve = place.path().join("curve.svg");
    let (calibrated, talked) = std::thread::scope(|scope| {
        let talking = scope.spawn(|| talk(&mut robot, &over));
        let words = [
            "--format",
            "json",
            "calibrate",
            "teller_py",
            "--live",
            "talker",
            "--seconds",
            "3",
            "--cpus",
            "0.5,1",
            "--requests",
            "10",
            "--fast",
            "--curve",
            path_str(&curve),
        ];
        let calibrated = daemon.deployer().run(&words);
        over.store(true, Ordering::SeqCst);
        (calibrated, talking.join())
    });
    let (said, heard) = talked.map_err(|_| anyhow::anyhow!("the robot panicked"))??;
    ensure!(said == heard, "the robot said {said:?} and heard {heard:?}");
    let calibration = parse_calibration(&calibrated?.expect_success()?.stdout)?;
    ensure!(calibration["inputs"][0]["topic"] == "/teller/say", "{calibration:#}");
    ensure!(calibration["points"][1]["answered"] == 10, "{calibration:#}");
    wait_until_none_left(&daemon, "teller_py")?;
    // The robot's own servant is unchanged.
    let servant = daemon.servant_of("teller_py", "talker")?;
    ensure!(servant["phase"] == "ready" && servant["connections"] == 1, "{servant:#}");
    Ok(())
}

pub fn a_calibration_that_nobody_waits_for_leaves_nothing() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let place = world().directory("gone")?;
    extract_frames(place.path())?;
    // This would take minutes.
    let mut going = Command::new(support::binaries::path("cloudroidctl"))
        .env("CLOUDROID_HOME", &daemon.home)
        .env_remove("CLOUDROID_SERVER")
        .args(["calibrate", "opencv_apps", "--cpus", "0.05", "--requests", "1000"])
        .arg("--frames")
        .arg(place.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()?;
    let seen = support::wait_until("a servant that is measured", || {
        let found = measured_servants(&daemon, "opencv_apps")?;
        Ok(if found.is_empty() { Err("none".to_owned()) } else { Ok(()) })
    });
    going.kill()?;
    going.wait()?;
    seen?;
    wait_until_none_left(&daemon, "opencv_apps")
}

pub fn a_calibration_gives_way_to_a_robot() -> Verdict {
    // Capacity for either a calibration or a robot.
    let setup =
        world().setup("gives-way").config("[capacity]\ncpus = 1.0\n[servant]\nwarm_pool = 0\nreserve_cpus = 0.1\n");
    let daemon = setup.start()?;
    daemon.deployer().run(&[&["push"], PEOPLE.arguments].concat())?.expect_success()?;
    let place = world().directory("given-up")?;
    extract_frames(place.path())?;
    // This would take minutes.
    let going = Command::new(support::binaries::path("cloudroidctl"))
        .env("CLOUDROID_HOME", &daemon.home)
        .env_remove("CLOUDROID_SERVER")
        .args(["calibrate", "opencv_apps", "--cpus", "1"])
        .args(["--requests", "10000", "--frames"])
        .arg(place.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    support::wait_until("a servant that is promised all", || {
        let status = daemon.api("/api/v1/status")?;
        Ok((status["capacity"]["cpus_reserved"] == 1.0).then_some(()).ok_or_else(|| status.to_string()))
    })?;
    let _robot = daemon.robot("opencv_apps?robot=needs&cpus=0.5")?;
    daemon
        .wait_for_event("the robot's servant", |event| event["kind"] == "servant-ready" && event["robot"] == "needs")?;
    let outcome = going.wait_with_output()?;
    let said = String::from_utf8_lossy(&outcome.stderr);
    ensure!(!outcome.status.success() && said.contains("a robot needs this capacity"), "{said}");
    wait_until_none_left(&daemon, "opencv_apps")
}
