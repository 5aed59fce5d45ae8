//! The portal's page in a real browser (Chromium): `tests/web/page.cjs` goes through it, while a robot is served. `make test-web`
//! runs these alone; screenshots are kept below `target/web`.

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

use crate::access::{daemon, token};
use crate::inside;
use crate::people::account;

const PASSWORD: &str = "four quiet purple engines";

/// A robot that has `adder_py` add with roslibpy, by itself.
struct Adder(Child);

impl Adder {
    /// Returns once it has a sum.
    fn begins(url: &str) -> anyhow::Result<Adder> {
        let mut adds = Command::new(binaries::python());
        let child = tell_patience(&mut adds)
            .arg(binaries::checkout().join("tests/robots/adds_with_roslibpy.py"))
            .arg(url)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let mut adder = Adder(child);
        let mut line = String::new();
        let out = adder.0.stdout.as_mut().context("piped")?;
        BufReader::new(out).read_line(&mut line)?;
        ensure!(line == "added\n", "roslibpy said {line:?}");
        Ok(adder)
    }

    /// Ends it, which found every sum right.
    fn ends(mut self) -> Verdict {
        drop(self.0.stdin.take());
        let status = self.0.wait()?;
        ensure!(status.success(), "roslibpy ended with {status}");
        Ok(())
    }
}

impl Drop for Adder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Begins a step of `page.cjs`, in which somebody shows this token.
fn begins(daemon: &Daemon, step: &str, token: &str) -> anyhow::Result<Child> {
    begins_at(daemon, &format!("http://{}/", daemon.address), step, token)
}

/// The same at another address of the daemon.
fn begins_at(daemon: &Daemon, url: &str, step: &str, token: &str) -> anyhow::Result<Child> {
    goes(daemon, url, step, token)
        .spawn()
        .context("node, which make deps installs")
}

fn goes(daemon: &Daemon, url: &str, step: &str, token: &str) -> Command {
    let checkout = binaries::checkout();
    let mut node = Command::new("node");
    tell_patience(&mut node)
        .arg(checkout.join("tests/web/page.cjs"))
        .args([step, url])
        .arg(checkout.join("target/web"))
        .arg(token)
        .arg(binaries::package("adder_py"))
        .env("NODE_PATH", binaries::web_modules())
        // What the browser leaves behind goes with the daemon's home.
        .env("TMPDIR", &daemon.home)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    node
}

fn ends(mut child: Child, step: &str) -> Verdict {
    let mut said = String::new();
    child
        .stderr
        .take()
        .context("its standard error")?
        .read_to_string(&mut said)?;
    let status = child.wait()?;
    ensure!(status.success(), "{step}: {said}");
    Ok(())
}

fn does(daemon: &Daemon, step: &str, token: &str) -> Verdict {
    ends(begins(daemon, step, token)?, step)
}

pub fn it_shows_what_happens_and_does_what_one_may() -> Verdict {
    // The robot's servant is there until somebody stops it.
    let config = "[servant]\ngrace = \"10m\"\n";
    let daemon = world().own("page").config(config).start()?;
    let made = account(&daemon, &["create", "ada", "--role", "operator"], PASSWORD)?;
    made.succeeded()?;
    let admin = token(&daemon, &["admin", "--role", "admin"])?;
    does(&daemon, "empty", &admin)?;
    does(&daemon, "deployer", &admin)?;
    let viewer = token(&daemon, &["viewer", "--role", "viewer", "--service", "*"])?;
    let other = ["stranger", "--role", "viewer", "--service", "other*"];
    let stranger = token(&daemon, &other)?;
    let path = format!("adder_py?robot=rover&rrt=50ms&max_rrt=200ms&token={admin}");
    // It works meanwhile, and its servant warns of each sum.
    let robot = Adder::begins(&daemon.url(&path))?;
    does(&daemon, "operator", &admin)?;
    does(&daemon, "viewer", &viewer)?;
    does(&daemon, "stranger", &stranger)?;
    robot.ends()?;
    does(&daemon, "remover", &admin)?;
    does(&daemon, "admin", &admin)
}

pub fn a_canary_is_begun_promoted_and_taken_back() -> Verdict {
    let daemon = daemon("page-canary")?;
    let admin = token(&daemon, &["admin", "--role", "admin"])?;
    let pushes = |more: &[&str]| {
        let push = [ADDER.arguments, more].concat();
        daemon.deployer().pushes("adder_py", &push)?.succeeded()
    };
    pushes(&[])?;
    does(&daemon, "canary", &admin)?;
    daemon.awaits("/api/v1/services/adder_py", "revision 2", |service| {
        (service["revision"] == 2).then_some(())
    })?;
    pushes(&["--canary", "1"])?;
    let viewer = token(&daemon, &["viewer", "--role", "viewer", "--service", "*"])?;
    does(&daemon, "bystander", &viewer)?;
    does(&daemon, "aborter", &admin)?;
    let service = daemon.deployer().asks(&["services", "adder_py"])?;
    ensure!(service["revision"] == 2, "{service:#}");
    Ok(())
}

pub fn a_robot_is_paired_from_the_page() -> Verdict {
    let daemon = world()
        .own("page-pairing")
        .config("[tls]\nserve = \"tls\"\n")
        .start()?;
    let admin = token(&daemon, &["admin", "--role", "admin"])?;
    let url = format!("https://{}/", daemon.address);
    ends(begins_at(&daemon, &url, "pairing", &admin)?, "pairing")?;
    let waiting = daemon.deployer().asks(&["pair", "--list"])?;
    ensure!(
        waiting[0]["robot"] == "rover" && waiting[0]["state"] == "waiting",
        "{waiting:#}"
    );
    Ok(())
}

pub fn what_response_times_cost_is_measured_from_the_page() -> Verdict {
    let daemon = daemon("page-calibrates")?;
    let admin = token(&daemon, &["admin", "--role", "admin"])?;
    daemon
        .deployer()
        .pushes("teller_py", TELLER.arguments)?
        .succeeded()?;
    // Of some size, so that it is seen how much of it was sent.
    let machine = Machine::new()?;
    let recorded = r#"
import rosbag
from std_msgs.msg import Float64MultiArray, String
with rosbag.Bag("/root/talk.bag", "w") as bag:
    for number in range(12):
        bag.write("/chatter", String("word %d" % number))
        bag.write("/noise", Float64MultiArray(data=[0.5] * 3000))
"#;
    machine
        .runs("sh", &format!("python3 - << 'END'\n{recorded}END"))?
        .succeeded()?;
    let path = format!("teller_py?robot=talker&token={admin}");
    let mut robot = daemon.robot(&path)?;
    robot.says(json!({"op": "advertise", "topic": "/teller/say", "type": "std_msgs/String"}))?;
    robot.subscribes("/teller/said")?;
    robot.awaits_subscriber("/teller/say")?;
    let say = json!({"op": "publish", "topic": "/teller/say", "msg": {"data": "hello"}});
    // What it says before the node has connected to the robot is not heard.
    robot.says_until(&say, "what it says", |value| {
        value["topic"] == "/teller/said"
    })?;
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let talks = scope.spawn(|| -> Verdict {
            while !over.load(Ordering::Relaxed) {
                robot.says(say.clone())?;
                robot.hears_on("/teller/said")?;
            }
            Ok(())
        });
        let url = format!("http://{}/", daemon.address);
        let told = goes(&daemon, &url, "calibrator", &admin)
            .env("RECORDING", path_str(&machine.written("/root/talk.bag")))
            .spawn()
            .map_err(anyhow::Error::from)
            .and_then(|child| ends(child, "calibrator"));
        over.store(true, Ordering::Relaxed);
        let talked = talks
            .join()
            .unwrap_or_else(|_| anyhow::bail!("the robot panicked"));
        told.and(talked)
    })
}

pub fn what_flows_inside_a_servant_is_drawn_and_changed() -> Verdict {
    let daemon = world()
        .own("page-inside")
        // Pictures alone are some hundred megabytes a second.
        .config("[black_box]\nseconds = \"10s\"\ntopics = [\"/sights/scan\", \"/sights/say\", \"/tf*\"]\n")
        .start()?;
    let admin = token(&daemon, &["admin", "--role", "admin"])?;
    let viewer = token(&daemon, &["viewer", "--role", "viewer", "--service", "*"])?;
    daemon
        .deployer()
        .pushes("sights_py", inside::SIGHTS)?
        .succeeded()?;
    // The robot is another principal's than whoever looks.
    let own = [
        "rover",
        "--role",
        "robot",
        "--robot",
        "rover",
        "--service",
        "sights_py",
    ];
    let mut robot = daemon.robot(&format!("sights_py?token={}", token(&daemon, &own)?))?;
    robot.calls("/rosapi/get_time", json!({}))?;
    does(&daemon, "looker", &admin)?;
    does(&daemon, "onlooker", &viewer)?;
    does(&daemon, "clearer", &admin)?;
    ensure!(daemon.servants_of("sights_py")?.len() == 1);
    robot.leaves()
}

pub fn a_servant_of_ros_2_is_looked_into() -> Verdict {
    let daemon = world().with(SIGHTS_TWO)?;
    let mut robot = daemon.robot(&format!("{}?robot=rover", SIGHTS_TWO.name))?;
    robot.calls("/rosapi/get_time", json!({}))?;
    does(&daemon, "ros2", "")?;
    robot.leaves()
}

pub fn settings_of_a_node_are_changed_inside() -> Verdict {
    let daemon = world().with(PEOPLE)?;
    let mut robot = daemon.robot("opencv_apps?robot=settings")?;
    robot.calls("/rosapi/get_time", json!({}))?;
    does(&daemon, "settings", "")?;
    // The node uses them: it has written them where its parameters are.
    let padding = robot.calls(
        "/rosapi/get_param",
        json!({"name": "/people_detect/padding"}),
    )?;
    ensure!(padding["values"]["value"] == "17", "{padding}");
    robot.leaves()
}

pub fn it_is_told_at_once_that_a_token_was_revoked() -> Verdict {
    let daemon = world().own("page-revoked").start()?;
    let short = token(&daemon, &["short", "--role", "viewer", "--service", "*"])?;
    let mut child = begins(&daemon, "revoked", &short)?;
    let output = child.stdout.take().context("its standard output")?;
    let mut line = String::new();
    BufReader::new(output).read_line(&mut line)?;
    if line.trim() == "looks" {
        let revoke = daemon.deployer().types(&["token", "revoke", "short"])?;
        revoke.succeeded()?;
    }
    ends(child, "revoked")
}

pub fn a_hundred_servants_stay_fluid_and_an_hour_leaves_nothing() -> Verdict {
    let daemon = daemon("page-many")?;
    let viewer = ["viewer", "--role", "viewer", "--service", "*"];
    does(&daemon, "many", &token(&daemon, &viewer)?)
}
