//! Before a robot is touched, and while it works: what a package makes of a recording, and why a robot is slow.

use std::process::Command;

use anyhow::{Context, ensure};
use support::Verdict;
use support::binaries;
use support::daemon::Daemon;
use support::deployer::{Outcome, path_str, run};
use support::machine::Machine;
use support::site::{Site, string};
use support::world::{TELLER, world};

/// Of Debian's opencv-doc.
const PEDESTRIANS: &str = "/usr/share/doc/opencv-doc/examples/data/vtest.avi";

/// Trials leave no service behind.
fn nothing_is_left(daemon: &Daemon) -> Verdict {
    let services = daemon.deployer().asks(&["services"])?;
    ensure!(
        services.as_array().is_some_and(Vec::is_empty),
        "{services:#}"
    );
    Ok(())
}

fn suggests(daemon: &Daemon, outcome: &Outcome) -> Verdict {
    for words in ["requests answered", "to begin with: desire = ", ", max = "] {
        ensure!(
            outcome.stdout.contains(words),
            "{words}: {}",
            outcome.said()
        );
    }
    nothing_is_left(daemon)
}

pub fn a_packaged_node_is_tried_on_a_picture() -> Verdict {
    let daemon = world().own("tried-picture").start()?;
    let place = world().directory("picture")?;
    let picture = place.path().join("people.png");
    run(Command::new("ffmpeg")
        .args(["-loglevel", "error", "-ss", "2", "-i", PEDESTRIANS])
        .args(["-frames:v", "1", "-s", "640x480"])
        .arg(&picture))?
    .succeeded()?;
    let outcome = daemon
        .deployer()
        .types(&[
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
        .succeeded()?;
    for words in [
        "/people_detect/found",
        "of 20 requests answered",
        "\"rects\"",
    ] {
        ensure!(
            outcome.stdout.contains(words),
            "{words}: {}",
            outcome.said()
        );
    }
    suggests(&daemon, &outcome)
}

pub fn a_source_package_is_tried_on_a_recording() -> Verdict {
    let daemon = world().own("tried-bag").start()?;
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
    machine
        .runs("sh", &format!("python3 - << 'END'\n{recorded}END"))?
        .succeeded()?;
    let package = binaries::package("teller_py");
    let tried = |bag: &str| {
        let bag = machine.written(bag);
        let words = [
            "try",
            path_str(&package),
            "--node",
            "teller.py",
            "--bag",
            path_str(&bag),
        ];
        daemon.deployer().types(&words)
    };
    let outcome = tried("/root/talk.bag")?.succeeded()?;
    for words in [
        "/teller/say",
        "12 sent",
        // The first goes unheard where rospy's publisher has not yet taken up the connection that it agreed to.
        "word 11",
        "11 of 11 requests answered",
        "not used of",
        "/temperature",
    ] {
        ensure!(
            outcome.stdout.contains(words),
            "{words}: {}",
            outcome.said()
        );
    }
    suggests(&daemon, &outcome)?;
    tried("/root/packed.bag")?.failed_saying(&["compressed (bz2)", "rosbag decompress"])?;
    tried("/root/nowhere.bag")?.failed_saying(&["cannot read", "nowhere.bag"])?;
    nothing_is_left(&daemon)
}

pub fn a_robot_is_explained() -> Verdict {
    let daemon = world().with(TELLER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let robot = "explained";
    let explained = || daemon.deployer().types(&["explain", robot]);
    explained()?.failed_saying(&["robot \"explained\" is not served"])?;
    let of = ("teller_py", "teller_py", "teller.py");
    let stub = site.stub(&daemon, of, robot, &[])?;
    let mut said = site.hears(&app, "/teller/said")?;
    let say = site.says(&app, "/elsewhere", false)?;
    site.until(&app, "the node", |graph| {
        graph.topics.contains_key("/teller/say")
    })
    .with_context(|| stub.said())?;
    // A remap that does not match: nobody publishes what the node listens to.
    let screen = explained()?.succeeded()?.stdout;
    for words in [
        "BLOCKS  /teller listens to /teller/say, which nobody on the robot publishes",
        "remap it to the topic that is meant: /teller/say:=/THE/TOPIC",
        "of teller_py (revision 1): ready, 1 connections",
        "/teller: link up, round trip ",
    ] {
        ensure!(screen.contains(words), "{words}: {screen}");
    }
    ensure!(
        screen.lines().count() <= 24,
        "more than one screen: {screen}"
    );
    drop((say, stub));
    site.fed(&said, 0)?;
    // Remapped, it is fed.
    let stub = site.stub(&daemon, of, robot, &["~say:=/elsewhere"])?;
    let say = site.says(&app, "/elsewhere", false)?;
    site.connected(&*say, 1).with_context(|| stub.said())?;
    // An answer from before that is not heard, as it is not where the node itself runs.
    site.fed(&said, 1).with_context(|| stub.said())?;
    say.publish(string("hello"));
    site.next(&mut said).with_context(|| stub.said())?;
    let screen = explained()?.succeeded()?.stdout;
    ensure!(!screen.contains("listens to /elsewhere"), "{screen}");
    // Gone, it says where to look.
    drop(stub);
    let screen = explained()?.succeeded()?.stdout;
    ensure!(screen.contains("cloudroid-stub doctor"), "{screen}");
    Ok(())
}
