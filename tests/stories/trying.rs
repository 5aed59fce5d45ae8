//! Trials before a robot is involved, and diagnosis while it works: the output of a package for a recording, and why a
//! robot is slow.

use std::process::Command;

use anyhow::{Context, ensure};
use support::Verdict;
use support::binaries;
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, path_str, run};
use support::machine::Machine;
use support::site::{Site, string};
use support::world::{TELLER, world};

/// Video of Debian's opencv-doc.
const PEDESTRIANS: &str = "/usr/share/doc/opencv-doc/examples/data/vtest.avi";

/// Checks that trials leave no service behind.
fn expect_nothing_left(daemon: &Daemon) -> Verdict {
    let services = daemon.deployer().run_json(&["services"])?;
    ensure!(services.as_array().is_some_and(Vec::is_empty), "{services:#}");
    Ok(())
}

fn expect_suggestions(daemon: &Daemon, outcome: &CommandOutcome) -> Verdict {
    for words in ["requests answered", "initial values: desire = ", ", max = "] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    expect_nothing_left(daemon)
}

pub fn a_packaged_node_is_tried_on_a_picture() -> Verdict {
    let daemon = world().setup("tried-picture").start()?;
    let place = world().directory("picture")?;
    let picture = place.path().join("people.png");
    run(Command::new("ffmpeg")
        .args(["-loglevel", "error", "-ss", "2", "-i", PEDESTRIANS])
        .args(["-frames:v", "1", "-s", "640x480"])
        .arg(&picture))?
    .expect_success()?;
    let outcome = daemon
        .deployer()
        .run(&[
            "try",
            "--apt",
            "opencv_apps",
            "--node",
            "people_detect",
            "--param",
            "debug_view=false",
            "--image",
            path_str(&picture),
        ])?
        .expect_success()?;
    for words in ["/people_detect/found", "of 20 requests answered", "\"rects\""] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    expect_suggestions(&daemon, &outcome)
}

pub fn a_source_package_is_tried_on_a_recording() -> Verdict {
    let daemon = world().setup("tried-bag").start()?;
    let machine = Machine::new()?;
    let recorded = r#"
import rosbag
from std_msgs.msg import Float32, String
with rosbag.Bag("/root/talk.bag", "w") as bag:
    for number in range(12):
        bag.write("/chatter", String("word %d" % number))
        bag.write("/temperature", Float32(20.5))
with rosbag.Bag("/root/packed.bag", "w", compression="bz2") as bag:
    bag.write("/chatter", String("word"))
"#;
    machine.run_script("sh", &format!("python3 - << 'END'\n{recorded}END"))?.expect_success()?;
    let package = binaries::package("teller_py");
    let tried = |bag: &str| {
        let bag = machine.host_path(bag);
        let words = ["try", path_str(&package), "--node", "teller.py", "--bag", path_str(&bag)];
        daemon.deployer().run(&words)
    };
    let outcome = tried("/root/talk.bag")?.expect_success()?;
    for words in [
        "/teller/say",
        "12 sent",
        // The first message is lost if rospy's publisher has not yet accepted the connection that it agreed to.
        "word 11",
        "11 of 11 requests answered",
        "not used of",
        "/temperature",
    ] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    expect_suggestions(&daemon, &outcome)?;
    tried("/root/packed.bag")?.expect_failure(&["compressed (bz2)", "rosbag decompress"])?;
    tried("/root/nowhere.bag")?.expect_failure(&["cannot read", "nowhere.bag"])?;
    expect_nothing_left(&daemon)
}

pub fn a_robot_is_explained() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let robot = "explained";
    let explained = || daemon.deployer().run(&["explain", robot]);
    explained()?.expect_failure(&["unknown robot \"explained\""])?;
    let of = ("teller_py", "teller_py", "teller.py");
    let stub = site.start_stub(&daemon, of, robot, &[])?;
    let mut said = site.subscribe(&app, "/teller/said")?;
    let say = site.advertise_strings(&app, "/elsewhere", false)?;
    site.wait_for_graph(&app, "the node", |graph| graph.topics.contains_key("/teller/say"))
        .with_context(|| stub.output())?;
    // A wrong remapping: nobody publishes the node's input.
    let screen = explained()?.expect_success()?.stdout;
    for words in [
        "BLOCKS  /teller subscribes to /teller/say, which no node on the robot publishes",
        "remap it to the intended topic: /teller/say:=/THE/TOPIC",
        "of teller_py (revision 1): ready, 1 connection",
        "/teller: link up, round trip ",
    ] {
        ensure!(screen.contains(words), "{words}: {screen}");
    }
    ensure!(screen.lines().count() <= 24, "more than one screen: {screen}");
    drop((say, stub));
    site.wait_for_publishers(&said, 0)?;
    // With the right remapping it gets its input.
    let stub = site.start_stub(&daemon, of, robot, &["~say:=/elsewhere"])?;
    let say = site.advertise_strings(&app, "/elsewhere", false)?;
    site.wait_for_subscribers(&*say, 1).with_context(|| stub.output())?;
    // Earlier answers are lost, as they are where the node itself runs.
    site.wait_for_publishers(&said, 1).with_context(|| stub.output())?;
    say.publish(string("hello"));
    site.next_message(&mut said).with_context(|| stub.output())?;
    let screen = explained()?.expect_success()?.stdout;
    ensure!(!screen.contains("listens to /elsewhere"), "{screen}");
    // After its end the output says where to look.
    drop(stub);
    let screen = explained()?.expect_success()?.stdout;
    ensure!(screen.contains("cloudroid-stub doctor"), "{screen}");
    Ok(())
}
