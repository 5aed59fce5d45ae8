//! Robots before a machine that is full: who goes first, and what each is told.

use std::io::{Read, Write};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::run;
use support::patience::{connect, scale_seconds};
use support::world::{GREETER, world};

/// Between looks at what a push has come to.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// A daemon with room for one servant of the greeter.
fn full(name: &str, config: &str) -> anyhow::Result<Daemon> {
    let servant = "[servant]\nwarm_pool = 0\ngrace = \"0s\"\n";
    let daemon = world()
        .own(name)
        .config(&format!("[capacity]\ncpus = 1.0\n{config}\n{servant}"))
        .start()?;
    let package = GREETER.package.context("a package")?;
    let arguments = [GREETER.arguments, &["--cpus", "1"]].concat();
    daemon.deployer().pushes(package, &arguments)?.succeeded()?;
    Ok(daemon)
}

/// The status of the answer to a stub's handshake, and its head.
fn stub_is_answered(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
    let mut stream = connect(&daemon.address)?;
    write!(
        stream,
        "GET /greeter_cpp?robot={robot} HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
         Sec-WebSocket-Protocol: cloudroid-link.v2\r\n\r\n",
        daemon.address
    )?;
    let mut answer = Vec::new();
    let mut part = [0; 4096];
    while !answer.windows(2).any(|end| end == b"}\n") {
        let read = stream.read(&mut part)?;
        if read == 0 {
            bail!("the answer ended: {}", String::from_utf8_lossy(&answer));
        }
        answer.extend(&part[..read]);
    }
    Ok(String::from_utf8_lossy(&answer).into_owned())
}

pub fn who_finds_no_room_is_told_its_place_and_then_why_it_is_refused() -> Verdict {
    // While the second waits, the third has to come.
    let waits = scale_seconds(5);
    let daemon = full("queue", &format!("queue = 1\ndeadline = \"{waits}s\""))?;
    let mut first = daemon.robot("greeter_cpp?robot=first")?;
    first.calls("/rosapi/get_time", json!({}))?;
    // It speaks rosbridge alone.
    let mut second = daemon.robot("greeter_cpp?robot=second")?;
    let told = second.hears_status("this robot is number 1 of 1 that wait")?;
    ensure!(told["level"] == "warning", "{told}");
    let mut third = daemon.robot("greeter_cpp?robot=third")?;
    let told = third.hears_status("1 robots wait for room already")?;
    ensure!(told["level"] == "error", "{told}");
    ensure!(u16::from(third.hears_close()?.code) == 1013);
    let words = format!("no room came free within {waits} s; it was number 1 of 1");
    let told = second.hears_status(&words)?;
    ensure!(told["level"] == "error", "{told}");
    ensure!(u16::from(second.hears_close()?.code) == 1013);
    // A stub reads the status of the handshake.
    let answer = stub_is_answered(&daemon, "fourth")?;
    ensure!(answer.starts_with("HTTP/1.1 503"), "{answer}");
    let head = answer.to_lowercase();
    ensure!(head.contains("retry-after: 10"), "{answer}");
    ensure!(answer.contains("number 1 of 1 that wait"), "{answer}");
    // What they asked for is nobody's now.
    first.leaves()?;
    let mut fifth = daemon.robot("greeter_cpp?robot=fifth")?;
    fifth.calls("/rosapi/get_time", json!({}))?;
    // Names of robots for which there never was room are bound to nobody.
    let script = format!(
        "import sqlite3\nfor name, in sqlite3.connect({:?}).execute('SELECT name FROM robots ORDER BY name'): print(name)",
        daemon.home.join("cloudroid.db")
    );
    let kept = run(Command::new("python3").args(["-c", &script]))?.succeeded()?;
    ensure!(kept.stdout == "fifth\nfirst\n", "{}", kept.stdout);
    Ok(())
}

pub fn robots_of_a_higher_class_go_first() -> Verdict {
    let classes = "deadline = \"10m\"\n[class.urgent]\npriority = 5";
    let daemon = full("classes", classes)?;
    let mut first = daemon.robot("greeter_cpp?robot=first")?;
    first.calls("/rosapi/get_time", json!({}))?;
    let mut second = daemon.robot("greeter_cpp?robot=second")?;
    second.hears_status("number 1 of 1")?;
    let mut urgent = daemon.robot("greeter_cpp?robot=urgent&class=urgent")?;
    urgent.hears_status("number 1 of 2")?;
    second.hears_status("number 2 of 2")?;
    let fit = daemon
        .deployer()
        .types(&["--format", "json", "fit", "greeter_cpp"])?
        .succeeded()?;
    let fit: Value = serde_json::from_str(&fit.stdout)?;
    ensure!(
        fit["now"] == false && fit["more"] == 0 && fit["waiting"] == 2,
        "{fit}"
    );
    first.leaves()?;
    urgent.calls("/rosapi/get_time", json!({}))?;
    second.hears_status("number 1 of 1")?;
    urgent.leaves()?;
    second.calls("/rosapi/get_time", json!({}))?;
    Ok(())
}

/// A package whose node never registers.
const SLEEPER: &str = "#!/usr/bin/env python3\nimport time\nwhile True: time.sleep(1)\n";

pub fn a_probe_gives_way_to_a_robot() -> Verdict {
    // Room for one servant whose push asked for nothing, and time enough to look at a node that never shows itself.
    let daemon = world()
        .own("probe-gives-way")
        .config(
            "[capacity]\nmemory = \"100M\"\n[servant]\nwarm_pool = 0\n[push]\nprobe = \"30m\"\n",
        )
        .start()?;
    let package = GREETER.package.context("a package")?;
    daemon
        .deployer()
        .pushes(package, GREETER.arguments)?
        .succeeded()?;
    let place = world().directory("sleeper")?;
    let sleeper = place.path().join("sleeper_py");
    std::fs::create_dir_all(sleeper.join("scripts"))?;
    std::fs::write(sleeper.join("scripts/sleeper.py"), SLEEPER)?;
    std::fs::write(
        sleeper.join("package.xml"),
        "<package format=\"2\"><name>sleeper_py</name><version>1.0.0</version><description>d</description>\
         <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>\
         <buildtool_depend>catkin</buildtool_depend></package>",
    )?;
    std::fs::write(
        sleeper.join("CMakeLists.txt"),
        "cmake_minimum_required(VERSION 3.0.2)\nproject(sleeper_py)\nfind_package(catkin REQUIRED)\ncatkin_package()\n\
         catkin_install_python(PROGRAMS scripts/sleeper.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n",
    )?;
    let deployer = daemon.deployer();
    let path = sleeper.to_string_lossy().into_owned();
    let push = std::thread::spawn(move || {
        deployer.types(&["push", &path, "--node", "sleeper.py", "--name", "sleeper"])
    });
    // However long it is built.
    let until = |is: fn(&Value) -> bool| -> Verdict {
        while !is(&daemon.get_json("/api/v1/status")?["capacity"]) {
            ensure!(!push.is_finished(), "the push ended");
            std::thread::sleep(LOOK_EVERY);
        }
        Ok(())
    };
    until(|capacity| capacity["memory_reserved"].as_u64() > Some(0))?;
    let mut robot = daemon.robot("greeter_cpp?robot=first")?;
    robot.calls("/rosapi/get_time", json!({}))?;
    until(|capacity| capacity["waiting"] == 1)?;
    daemon.ends()?;
    let Ok(outcome) = push.join() else {
        bail!("the deployer panicked");
    };
    let said = outcome?.said();
    ensure!(
        said.contains("a robot needs its room: it is ended"),
        "{said}"
    );
    Ok(())
}
