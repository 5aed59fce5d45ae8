//! A user evaluates a package of their own: native, as on a small robot, compared with outsourced over the network.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use support::Verdict;
use support::binaries;
use support::daemon::Daemon;
use support::deployer::{path_str, run};
use support::machine::Machine;
use support::world::{ADDER, PEOPLE, TELLER, world};

use crate::access;
use crate::calibration::{PEDESTRIANS, wait_until_none_left};

/// Recordings in a machine with ROS: images of people, strings, and a message that makes a node exit.
struct RobotRecordings {
    machine: Machine,
}

impl RobotRecordings {
    fn new() -> anyhow::Result<RobotRecordings> {
        let machine = Machine::new()?;
        let place = world().directory("pictures")?;
        for (name, frames, size) in [("raw", "5", "640x480"), ("raw_large", "2", "768x576")] {
            let raw = place.path().join(name);
            run(Command::new("ffmpeg")
                .args(["-loglevel", "error", "-i", PEDESTRIANS, "-frames:v", frames])
                .args(["-s", size, "-pix_fmt", "rgb24", "-f", "rawvideo"])
                .arg(&raw))?
            .expect_success()?;
            machine.install_file(&raw, &format!("/root/{name}"), 0o644)?;
        }
        let records = r#"
import rosbag, rospy, struct
from std_msgs.msg import Float64, Int32, String

class Image:
    """What the machine has no package of."""
    _type = "sensor_msgs/Image"
    _md5sum = "060021388200f6f0f447d0fcd9c64743"
    _full_text = "Header header"

def picture(number, pixels, width=640, height=480):
    text = lambda words: struct.pack("<I", len(words)) + words
    return (struct.pack("<III", number, 1000, number * 100000000) + text(b"camera") + struct.pack("<II", height, width)
        + text(b"rgb8") + struct.pack("<BI", 0, width * 3) + text(pixels))

with open("/root/raw", "rb") as file, rosbag.Bag("/root/people.bag", "w") as bag:
    for number in range(5):
        message = (Image._type, picture(number, file.read(640 * 480 * 3)), Image._md5sum, 0, Image)
        bag.write("/camera", message, rospy.Time(1000, number * 100000000), raw=True)
with open("/root/raw_large", "rb") as file, rosbag.Bag("/root/large.bag", "w") as bag:
    for number in range(2):
        pixels = file.read(768 * 576 * 3)
        message = (Image._type, picture(number, pixels, 768, 576), Image._md5sum, 0, Image)
        bag.write("/camera", message, rospy.Time(1000, number * 100000000), raw=True)
with rosbag.Bag("/root/other.bag", "w") as bag:
    bag.write("/teller/say", Float64(1), rospy.Time(1000, 0))
with rosbag.Bag("/root/words.bag", "w") as bag:
    for number in range(12):
        bag.write("/chatter", String("word %d" % number), rospy.Time(1000, number * 50000000))
with rosbag.Bag("/root/end.bag", "w") as bag:
    for number in range(12):
        bag.write("/end", Int32(1), rospy.Time(1000, number * 50000000))
"#;
        machine.run_script("sh", &format!("python3 - << 'END'\n{records}END"))?.expect_success()?;
        Ok(RobotRecordings { machine })
    }

    fn path(&self, what: &str) -> PathBuf {
        self.machine.host_path(&format!("/root/{what}.bag"))
    }
}

fn json_number(value: &Value, path: &str) -> anyhow::Result<f64> {
    value.pointer(path).and_then(Value::as_f64).with_context(|| format!("{path} of {value:#}"))
}

fn evaluate(daemon: &Daemon, bag: &Path, words: &[&str]) -> anyhow::Result<Value> {
    let bag = ["eval", PEOPLE.name, "--bag", path_str(bag), "--fast"];
    daemon.deployer().run_json(&[&bag, words].concat())
}

pub fn a_package_is_evaluated_native_against_outsourced() -> Verdict {
    // A separate daemon, because the cores for the evaluation are not available to the robots of other stories. The
    // recording alone needs nearly all memory of a client's budget.
    let setup = world().setup("evaluated").config("[memory]\nclient = \"5M\"\n");
    let daemon = setup.start()?;
    // Robots may request less memory than the native run has.
    let pushed = [&["push", "--max-memory", "512M"], PEOPLE.arguments].concat();
    daemon.deployer().run(&pushed)?.expect_success()?;
    let recordings = RobotRecordings::new()?;
    let place = world().directory("evaluation")?;
    let plot = place.path().join("plot.svg");
    let plot = ["--plot", path_str(&plot)];
    let words = ["--requests", "12", "--cpus", "1", "--network", "20", "--yes"];
    let found = evaluate(&daemon, &recordings.path("people"), &[&words[..], &plot].concat())?;
    wait_until_none_left(&daemon, PEOPLE.name)?;
    for side in ["native", "outsourced"] {
        ensure!(found[side]["answered"] == 12, "{side}: {found:#}");
        ensure!(found[side]["times"].as_array().map(Vec::len) == Some(12), "{side}: {found:#}");
    }
    ensure!(found["native"]["cpus"] == 0.25 && found["outsourced"]["cpus"] == 1.0, "{found:#}");
    ensure!(found["native"]["memory_limit"] == 1u64 << 30, "{found:#}");
    // Load changes times, so the verdict is compared with the times that it is of; which is faster is not known here.
    let median_of = |side: &str| json_number(&found, &format!("/{side}/rrt/p50"));
    let factor = json_number(&found, "/times_as_fast")?;
    ensure!((factor - median_of("native")? / median_of("outsourced")?).abs() < 0.01 * factor, "{found:#}");
    let verdict = found["verdict"].as_str().unwrap_or_default();
    let worth = ["worth it: outsourced", "no difference in time", "not worth it for response time"];
    ensure!(worth.iter().any(|words| verdict.starts_with(words)), "{verdict}");
    // Half of the network's delay in each direction; the measured times are within the total.
    ensure!(json_number(&found, "/outsourced/phases/up")? == 10.0, "{found:#}");
    let part = |name: &str| json_number(&found, &format!("/outsourced/phases/{name}"));
    let median = json_number(&found, "/outsourced/rrt/p50")?;
    // Of only two runs some parts may be missing.
    if !found["outsourced"]["phases"]["transport"].is_null() {
        let parts = part("up")? + part("transport")? + part("compute")? + part("down")?;
        ensure!((parts - median).abs() < 1e-6, "{parts} is not {median}: {found:#}");
    }
    ensure!(found["native"]["phases"]["up"].is_null(), "{found:#}");
    // The image was sent unencoded.
    ensure!(json_number(&found, "/outsourced/bytes/0")? > 640.0 * 480.0 * 3.0, "{found:#}");
    expect_suggestion(&daemon, &found)?;
    let drawn = std::fs::read_to_string(plot[1])?;
    for class in ["class=\"native\"", "class=\"outsourced\""] {
        ensure!(drawn.contains(class), "{class}: {drawn}");
    }
    evaluate_large_pictures(&daemon, &recordings, plot[1])?;
    evaluate_with_little_memory(&daemon, &recordings, plot[1])?;
    deployers_evaluate_what_is_theirs(&daemon, &recordings, plot[1])
}

/// Checks that what was measured is suggested and written, unless the robot was the faster one.
fn expect_suggestion(daemon: &Daemon, found: &Value) -> Verdict {
    let rows = daemon.deployer().run_json(&["sla", "list", PEOPLE.name])?;
    if found["verdict"].as_str().is_some_and(|verdict| verdict.starts_with("not worth it")) {
        ensure!(found["sla"].is_null() && rows.as_array().is_some_and(Vec::is_empty), "{found:#} {rows:#}");
        return Ok(());
    }
    ensure!(found["sla"]["network_added"] == 20.0, "{found:#}");
    let (desire, p95) = (json_number(found, "/sla/desire")?, json_number(found, "/outsourced/rrt/p95")?);
    ensure!((p95..p95 * 1.1).contains(&(desire * 1000.0)), "{found:#}");
    ensure!(rows.as_array().map(Vec::len) == Some(1), "{rows:#}");
    ensure!(rows[0]["value"] == found["sla"]["desire"], "{rows:#}");
    ensure!(found["sla"]["written"] == true && found["sla"]["row"]["id"] == rows[0]["id"], "{found:#}");
    Ok(())
}

/// Requests and answers of 1.3 MB, which meet in the daemon's socket; and a second row for the same number of cores.
fn evaluate_large_pictures(daemon: &Daemon, recordings: &RobotRecordings, plot: &str) -> Verdict {
    let bag = recordings.path("large");
    let words = ["eval", PEOPLE.name, "--bag", path_str(&bag), "--fast"];
    let more = ["--requests", "10", "--cpus", "1", "--robot-cpus", "0.5"];
    let yes = ["--yes", "--plot", plot];
    let outcome = daemon.deployer().run(&[&words[..], &more, &yes].concat())?.expect_success()?;
    for words in ["10 of 10", "request: ", " 1.3M, answer: /", "THROTTLED MS"] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    // A row with the same desired time replaces the first one.
    let rows = daemon.deployer().run_json(&["sla", "list", PEOPLE.name])?;
    if rows.as_array().is_some_and(|rows| rows.len() > 1) {
        let words = "already had entries for the same number of cores (";
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    wait_until_none_left(daemon, PEOPLE.name)
}

/// Checks that too little memory is a result, and that robots still get servants afterwards.
fn evaluate_with_little_memory(daemon: &Daemon, recordings: &RobotRecordings, plot: &str) -> Verdict {
    let words = ["--requests", "12", "--robot-memory", "24M", "--plot", plot];
    let found = evaluate(daemon, &recordings.path("people"), &words)?;
    let told = found["native"]["out_of_memory"].as_str().unwrap_or_default();
    ensure!(told.contains("needs more than 24M of memory: the kernel killed it"), "{found:#}");
    let verdict = found["verdict"].as_str().unwrap_or_default();
    ensure!(verdict.starts_with("only outsourced: "), "{verdict}");
    ensure!(found["sla"]["has_local"] == false, "{found:#}");
    // By default no robot is promised all cores of the machine.
    ensure!(found["outsourced"]["cpus"] == 1.0, "{found:#}");
    ensure!(found["sla"]["row"]["limits"]["cpus"] == 1.0, "{found:#}");
    wait_until_none_left(daemon, PEOPLE.name)?;
    let status = daemon.api("/api/v1/status")?;
    let failing = status["back_offs"].as_array();
    ensure!(failing.is_none_or(Vec::is_empty), "{status:#}");
    // Output for people.
    let bag = recordings.path("people");
    let shown = daemon
        .deployer()
        .run(&[&["eval", PEOPLE.name, "--bag", path_str(&bag), "--fast"], &words[..]].concat())?
        .expect_success()?;
    for words in ["out of memory", "answer: /", "local = \"none\"", "nothing was written; --yes"] {
        ensure!(shown.stdout.contains(words), "{words}: {}", shown.output());
    }
    Ok(())
}

/// Checks an evaluation over TCP with a token of the role that may calibrate, at the recording's own rate.
fn deployers_evaluate_what_is_theirs(daemon: &Daemon, recordings: &RobotRecordings, plot: &str) -> Verdict {
    let named = ["theirs", "--role", "deployer", "--service", TELLER.name];
    let token = access::create_token(daemon, &named)?;
    let package = binaries::package("teller_py");
    let pushed = [&["push", path_str(&package)], TELLER.arguments].concat();
    access::run_with_token(daemon, &token, &pushed)?.expect_success()?;
    let bag = recordings.path("words");
    let words = ["eval", TELLER.name, "--requests", "10", "--plot", plot];
    let words = [&words[..], &["--bag", path_str(&bag)]].concat();
    let outcome = access::run_with_token(daemon, &token, &words)?.expect_success()?;
    for words in ["10 of 10", "/chatter of the recording was sent to /teller/say", "without a codec"] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    // It may be faster without a network, and then nothing is suggested.
    let suggested = "in stub.toml (desire is p95 of 10 outsourced requests";
    let is_suggested = outcome.stdout.contains(suggested);
    ensure!(is_suggested != outcome.stdout.contains("it is faster on the robot"), "{}", outcome.output());
    wait_until_none_left(daemon, TELLER.name)
}

pub fn what_cannot_be_evaluated_is_said() -> Verdict {
    let daemon = world().setup("unevaluated").start()?;
    for service in [ADDER, TELLER] {
        let package = service.package.context("a package")?;
        daemon.deployer().push(package, service.arguments)?.expect_success()?;
    }
    let recordings = RobotRecordings::new()?;
    let place = world().directory("unevaluated")?;
    let plot = place.path().join("plot.svg");
    let refused = |service: &str, bag: &Path, more: &[&str], saying: &[&str]| {
        let words = ["eval", service, "--bag", path_str(bag), "--plot", path_str(&plot)];
        let outcome = daemon.deployer().run(&[&words, more].concat())?;
        outcome.expect_failure(saying)
    };
    let words = recordings.path("words");
    let nowhere = place.path().join("nowhere.bag");
    refused(TELLER.name, &nowhere, &[], &["cannot read", "nowhere.bag"])?;
    let text = place.path().join("text.bag");
    std::fs::write(&text, "no recording")?;
    refused(TELLER.name, &text, &[], &["text.bag cannot be replayed", "not a rosbag file"])?;
    let empty = place.path().join("empty.bag");
    std::fs::write(&empty, "")?;
    refused(TELLER.name, &empty, &[], &["the file is empty"])?;
    let other = recordings.path("other");
    refused(TELLER.name, &other, &[], &["/teller/say is std_msgs/Float64 there"])?;
    let output = ["--output", "/nothing"];
    refused(TELLER.name, &words, &output, &["has no output /nothing; its outputs are: "])?;
    let people = recordings.path("people");
    let saying = ["(it has /camera)", "its inputs are: ", "/teller/say (std_msgs/String)"];
    refused(TELLER.name, &people, &[], &saying)?;
    let saying = ["unheard_of", "available: ", TELLER.name, "cloudroidctl push"];
    refused("unheard_of", &words, &[], &saying)?;
    expect_directory_name_errors(&daemon, place.path(), &people)?;
    let directory = binaries::package("teller_py");
    let saying = ["is a directory", "cloudroidctl push"];
    refused(path_str(&directory), &words, &[], &saying)?;
    let saying = ["/add_two", "a recording has topic messages only", "explain"];
    refused(ADDER.name, &words, &[], &saying)?;
    refused(TELLER.name, &words, &["--robot-cpus", "0"], &["--robot-cpus", "expected 0.01 to 4096"])?;
    refused(TELLER.name, &words, &["--robot-memory", "64T"], &["64T"])?;
    refused(TELLER.name, &words, &["--cpus", "4000"], &["--cpus 4000 can never be measured", "4000 cores"])?;
    // Its node exits at the first request.
    let saying = [TELLER.name, "exited with status 0"];
    refused(TELLER.name, &recordings.path("end"), &[], &saying)?;
    wait_until_none_left(&daemon, TELLER.name)?;
    expect_interruptible(&daemon, &words, &plot)
}

/// Checks errors for services with the names of directories in the working directory.
fn expect_directory_name_errors(daemon: &Daemon, place: &Path, bag: &Path) -> Verdict {
    for (name, saying) in [(TELLER.name, "(it has /camera)"), ("unheard_of", "unheard_of is a directory here")] {
        std::fs::create_dir(place.join(name))?;
        let outcome = run(Command::new(binaries::path("cloudroidctl"))
            .current_dir(place)
            .env("CLOUDROID_HOME", &daemon.home)
            .env_remove("CLOUDROID_SERVER")
            .args(["eval", name, "--bag", path_str(bag)]))?;
        outcome.expect_failure(&[saying])?;
    }
    Ok(())
}

/// Checks that Ctrl-C ends an evaluation early.
fn expect_interruptible(daemon: &Daemon, bag: &Path, plot: &Path) -> Verdict {
    let going = Command::new(binaries::path("cloudroidctl"))
        .env("CLOUDROID_HOME", &daemon.home)
        .env_remove("CLOUDROID_SERVER")
        .args(["eval", TELLER.name, "--requests", "10000", "--bag"])
        .arg(bag)
        .arg("--plot")
        .arg(plot)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let seen = support::wait_until("a servant that is measured", || {
        let found = crate::calibration::measured_servants(daemon, TELLER.name)?;
        Ok(found.iter().any(|servant| servant["phase"] == "ready").then_some(()).ok_or_else(|| "none".to_owned()))
    });
    kill(Pid::from_raw(i32::try_from(going.id())?), Signal::SIGINT)?;
    let outcome = going.wait_with_output()?;
    seen?;
    let said = String::from_utf8_lossy(&outcome.stderr);
    ensure!(outcome.status.code() == Some(1) && said.contains("cancelled; nothing was written"), "{said}");
    ensure!(!plot.exists(), "it drew what was not measured");
    wait_until_none_left(daemon, TELLER.name)
}
