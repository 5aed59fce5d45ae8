//! The portal's page in a real browser (Chromium): `tests/web/page.cjs` operates it while a robot is served. `make
//! test-web` runs only these stories; screenshots are stored below `target/web`.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, ensure};
use serde_json::json;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::machine::Machine;
use support::patience::tell_patience;
use support::world::{ADDER, PEOPLE, SIGHTS_TWO, TELLER, world};
use support::{Verdict, binaries};

use crate::access::{create_token, daemon};
use crate::inside;
use crate::people::run_account;

const PASSWORD: &str = "four quiet purple engines";

/// A robot that uses `adder_py` through roslibpy, by itself.
struct AdderRobot(Child);

impl AdderRobot {
    /// Starts it; returns once it has a sum.
    fn start(url: &str) -> anyhow::Result<AdderRobot> {
        let mut adds = Command::new(binaries::python());
        let child = tell_patience(&mut adds)
            .arg(binaries::checkout().join("tests/robots/adds_with_roslibpy.py"))
            .arg(url)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let mut adder = AdderRobot(child);
        let mut line = String::new();
        let out = adder.0.stdout.as_mut().context("piped")?;
        BufReader::new(out).read_line(&mut line)?;
        ensure!(line == "added\n", "roslibpy said {line:?}");
        Ok(adder)
    }

    /// Ends it and checks that all sums were right.
    fn finish(mut self) -> Verdict {
        drop(self.0.stdin.take());
        let status = self.0.wait()?;
        ensure!(status.success(), "roslibpy ended with {status}");
        Ok(())
    }
}

impl Drop for AdderRobot {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a step of `page.cjs` with this token.
fn begin_step(daemon: &Daemon, step: &str, token: &str) -> anyhow::Result<Child> {
    begin_step_at(daemon, &format!("http://{}/", daemon.address), step, token)
}

/// Starts a step at another address of the daemon.
fn begin_step_at(daemon: &Daemon, url: &str, step: &str, token: &str) -> anyhow::Result<Child> {
    step_command(daemon, url, step, token).spawn().context("node, which make deps installs")
}

fn step_command(daemon: &Daemon, url: &str, step: &str, token: &str) -> Command {
    let checkout = binaries::checkout();
    let mut node = Command::new("node");
    tell_patience(&mut node)
        .arg(checkout.join("tests/web/page.cjs"))
        .args([step, url])
        .arg(checkout.join("target/web"))
        .arg(token)
        .arg(binaries::package("adder_py"))
        .env("NODE_PATH", binaries::web_modules())
        // The browser's temporary files are removed together with the daemon's home.
        .env("TMPDIR", &daemon.home)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    node
}

fn finish_step(mut child: Child, step: &str) -> Verdict {
    let mut said = String::new();
    child.stderr.take().context("its standard error")?.read_to_string(&mut said)?;
    let status = child.wait()?;
    ensure!(status.success(), "{step}: {said}");
    Ok(())
}

fn run_step(daemon: &Daemon, step: &str, token: &str) -> Verdict {
    finish_step(begin_step(daemon, step, token)?, step)
}

pub fn it_shows_what_happens_and_does_what_one_may() -> Verdict {
    // The robot's servant is kept until it is stopped.
    let config = "[servant]\ngrace = \"10m\"\n";
    let daemon = world().setup("page").config(config).start()?;
    let made = run_account(&daemon, &["create", "ada", "--role", "operator"], PASSWORD)?;
    made.expect_success()?;
    let admin = create_token(&daemon, &["admin", "--role", "admin"])?;
    run_step(&daemon, "empty", &admin)?;
    run_step(&daemon, "deployer", &admin)?;
    let viewer = create_token(&daemon, &["viewer", "--role", "viewer", "--service", "*"])?;
    let other = ["stranger", "--role", "viewer", "--service", "other*"];
    let stranger = create_token(&daemon, &other)?;
    let path = format!("adder_py?robot=rover&rrt=50ms&max_rrt=200ms&token={admin}");
    // It works meanwhile, and its servant logs a warning for each sum.
    let robot = AdderRobot::start(&daemon.url(&path))?;
    run_step(&daemon, "operator", &admin)?;
    run_step(&daemon, "viewer", &viewer)?;
    run_step(&daemon, "stranger", &stranger)?;
    robot.finish()?;
    run_step(&daemon, "remover", &admin)?;
    run_step(&daemon, "admin", &admin)
}

pub fn a_canary_is_begun_promoted_and_taken_back() -> Verdict {
    let daemon = daemon("page-canary")?;
    let admin = create_token(&daemon, &["admin", "--role", "admin"])?;
    let pushes = |more: &[&str]| {
        let push = [ADDER.arguments, more].concat();
        daemon.deployer().push("adder_py", &push)?.expect_success()
    };
    pushes(&[])?;
    run_step(&daemon, "canary", &admin)?;
    daemon.wait_for("/api/v1/services/adder_py", "revision 2", |service| (service["revision"] == 2).then_some(()))?;
    pushes(&["--canary", "1"])?;
    let viewer = create_token(&daemon, &["viewer", "--role", "viewer", "--service", "*"])?;
    run_step(&daemon, "bystander", &viewer)?;
    run_step(&daemon, "aborter", &admin)?;
    let service = daemon.deployer().run_json(&["services", "adder_py"])?;
    ensure!(service["revision"] == 2, "{service:#}");
    Ok(())
}

pub fn a_robot_is_paired_from_the_page() -> Verdict {
    let daemon = world().setup("page-pairing").config("[tls]\nserve = \"tls\"\n").start()?;
    let admin = create_token(&daemon, &["admin", "--role", "admin"])?;
    let url = format!("https://{}/", daemon.address);
    finish_step(begin_step_at(&daemon, &url, "pairing", &admin)?, "pairing")?;
    let waiting = daemon.deployer().run_json(&["pair", "--list"])?;
    ensure!(waiting[0]["robot"] == "rover" && waiting[0]["state"] == "waiting", "{waiting:#}");
    Ok(())
}

pub fn what_response_times_cost_is_measured_from_the_page() -> Verdict {
    let daemon = daemon("page-calibrates")?;
    let admin = create_token(&daemon, &["admin", "--role", "admin"])?;
    daemon.deployer().push("teller_py", TELLER.arguments)?.expect_success()?;
    // Large enough for the progress of the upload to be visible.
    let machine = Machine::new()?;
    let recorded = r#"
import rosbag
from std_msgs.msg import Float64MultiArray, String
with rosbag.Bag("/root/talk.bag", "w") as bag:
    for number in range(12):
        bag.write("/chatter", String("word %d" % number))
        bag.write("/noise", Float64MultiArray(data=[0.5] * 3000))
"#;
    machine.run_script("sh", &format!("python3 - << 'END'\n{recorded}END"))?.expect_success()?;
    let path = format!("teller_py?robot=talker&token={admin}");
    let mut robot = daemon.robot(&path)?;
    robot.send(json!({"op": "advertise", "topic": "/teller/say", "type": "std_msgs/String"}))?;
    robot.subscribe("/teller/said")?;
    robot.wait_for_subscriber("/teller/say")?;
    let say = json!({"op": "publish", "topic": "/teller/say", "msg": {"data": "hello"}});
    // Messages are lost until the node has connected to the robot.
    robot.send_until(&say, "what it says", |value| value["topic"] == "/teller/said")?;
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let talks = scope.spawn(|| -> Verdict {
            while !over.load(Ordering::Relaxed) {
                robot.send(say.clone())?;
                robot.next_message_on("/teller/said")?;
            }
            Ok(())
        });
        let url = format!("http://{}/", daemon.address);
        let told = step_command(&daemon, &url, "calibrator", &admin)
            .env("RECORDING", path_str(&machine.host_path("/root/talk.bag")))
            .spawn()
            .map_err(anyhow::Error::from)
            .and_then(|child| finish_step(child, "calibrator"));
        over.store(true, Ordering::Relaxed);
        let talked = talks.join().unwrap_or_else(|_| anyhow::bail!("the robot panicked"));
        told.and(talked)
    })
}

pub fn what_flows_inside_a_servant_is_drawn_and_changed() -> Verdict {
    let daemon = world()
        .setup("page-inside")
        // Images alone are some hundred megabytes per second.
        .config("[black_box]\nseconds = \"10s\"\ntopics = [\"/sights/scan\", \"/sights/say\", \"/tf*\"]\n")
        .start()?;
    let admin = create_token(&daemon, &["admin", "--role", "admin"])?;
    let viewer = create_token(&daemon, &["viewer", "--role", "viewer", "--service", "*"])?;
    daemon.deployer().push("sights_py", inside::SIGHTS)?.expect_success()?;
    // The robot belongs to another principal than the viewer.
    let own = ["rover", "--role", "robot", "--robot", "rover", "--service", "sights_py"];
    let mut robot = daemon.robot(&format!("sights_py?token={}", create_token(&daemon, &own)?))?;
    robot.call("/rosapi/get_time", json!({}))?;
    run_step(&daemon, "looker", &admin)?;
    run_step(&daemon, "onlooker", &viewer)?;
    run_step(&daemon, "clearer", &admin)?;
    ensure!(daemon.servants_of("sights_py")?.len() == 1);
    robot.leave()
}

pub fn a_servant_of_ros_2_is_looked_into() -> Verdict {
    let daemon = world().daemon_with(SIGHTS_TWO)?;
    let mut robot = daemon.robot(&format!("{}?robot=rover", SIGHTS_TWO.name))?;
    robot.call("/rosapi/get_time", json!({}))?;
    run_step(&daemon, "ros2", "")?;
    robot.leave()
}

pub fn settings_of_a_node_are_changed_inside() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let mut robot = daemon.robot("opencv_apps?robot=settings")?;
    robot.call("/rosapi/get_time", json!({}))?;
    run_step(&daemon, "settings", "")?;
    // The node uses the settings: it has written them to its parameters.
    let padding = robot.call("/rosapi/get_param", json!({"name": "/people_detect/padding"}))?;
    ensure!(padding["values"]["value"] == "17", "{padding}");
    robot.leave()
}

pub fn it_is_told_at_once_that_a_token_was_revoked() -> Verdict {
    let daemon = world().setup("page-revoked").start()?;
    let short = create_token(&daemon, &["short", "--role", "viewer", "--service", "*"])?;
    let mut child = begin_step(&daemon, "revoked", &short)?;
    let output = child.stdout.take().context("its standard output")?;
    let mut line = String::new();
    BufReader::new(output).read_line(&mut line)?;
    if line.trim() == "looks" {
        let revoke = daemon.deployer().run(&["token", "revoke", "short"])?;
        revoke.expect_success()?;
    }
    finish_step(child, "revoked")
}

pub fn a_hundred_servants_stay_fluid_and_an_hour_leaves_nothing() -> Verdict {
    let daemon = daemon("page-many")?;
    run_step(&daemon, "many", &create_token(&daemon, &["admin", "--role", "admin"])?)
}
