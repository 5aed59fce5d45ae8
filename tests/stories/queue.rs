//! Robots waiting for a full machine: their order, and what each of them is told.

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

/// Polling interval for the state of a push.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Starts a daemon with capacity for one servant of the greeter.
fn start_full(name: &str, config: &str) -> anyhow::Result<Daemon> {
    let servant = "[servant]\nwarm_pool = 0\ngrace = \"0s\"\n";
    let daemon = world().setup(name).config(&format!("[capacity]\ncpus = 1.0\n{config}\n{servant}")).start()?;
    let package = GREETER.package.context("a package")?;
    let arguments = [GREETER.arguments, &["--cpus", "1"]].concat();
    daemon.deployer().push(package, &arguments)?.expect_success()?;
    Ok(daemon)
}

/// Returns the status line and headers of the response to a stub's handshake.
fn stub_handshake(daemon: &Daemon, robot: &str) -> anyhow::Result<String> {
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
    // Enough time for the third robot to connect while the second one waits.
    let waits = scale_seconds(5);
    let daemon = start_full("queue", &format!("queue = 1\ndeadline = \"{waits}s\""))?;
    let mut first = daemon.robot("greeter_cpp?robot=first")?;
    first.call("/rosapi/get_time", json!({}))?;
    // A client that speaks only rosbridge.
    let mut second = daemon.robot("greeter_cpp?robot=second")?;
    let told = second.wait_for_status("this robot is number 1 of 1 waiting")?;
    ensure!(told["level"] == "warning", "{told}");
    let mut third = daemon.robot("greeter_cpp?robot=third")?;
    let told = third.wait_for_status("1 robot already waiting")?;
    ensure!(told["level"] == "error", "{told}");
    ensure!(u16::from(third.wait_for_close()?.code) == 1013);
    let words = format!("no capacity became free within {waits} s; it was number 1 of 1");
    let told = second.wait_for_status(&words)?;
    ensure!(told["level"] == "error", "{told}");
    ensure!(u16::from(second.wait_for_close()?.code) == 1013);
    // A stub reads the status of the handshake.
    let answer = stub_handshake(&daemon, "fourth")?;
    ensure!(answer.starts_with("HTTP/1.1 503"), "{answer}");
    let head = answer.to_lowercase();
    ensure!(head.contains("retry-after: 10"), "{answer}");
    ensure!(answer.contains("number 1 of 1 waiting"), "{answer}");
    // Their requests have been dropped.
    first.leave()?;
    let mut fifth = daemon.robot("greeter_cpp?robot=fifth")?;
    fifth.call("/rosapi/get_time", json!({}))?;
    // Names of robots that were never served are not stored.
    let script = format!(
        "import sqlite3\nfor name, in sqlite3.connect({:?}).execute('SELECT name FROM robots ORDER BY name'): \
         print(name)",
        daemon.home.join("cloudroid.db")
    );
    let kept = run(Command::new("python3").args(["-c", &script]))?.expect_success()?;
    ensure!(kept.stdout == "fifth\nfirst\n", "{}", kept.stdout);
    Ok(())
}

pub fn robots_of_a_higher_class_go_first() -> Verdict {
    let classes = "deadline = \"10m\"\n[class.urgent]\npriority = 5";
    let daemon = start_full("classes", classes)?;
    let mut first = daemon.robot("greeter_cpp?robot=first")?;
    first.call("/rosapi/get_time", json!({}))?;
    let mut second = daemon.robot("greeter_cpp?robot=second")?;
    second.wait_for_status("number 1 of 1")?;
    let mut urgent = daemon.robot("greeter_cpp?robot=urgent&class=urgent")?;
    urgent.wait_for_status("number 1 of 2")?;
    second.wait_for_status("number 2 of 2")?;
    let fit = daemon.deployer().run(&["--format", "json", "fit", "greeter_cpp"])?.expect_success()?;
    let fit: Value = serde_json::from_str(&fit.stdout)?;
    ensure!(fit["now"] == false && fit["more"] == 0 && fit["waiting"] == 2, "{fit}");
    first.leave()?;
    urgent.call("/rosapi/get_time", json!({}))?;
    second.wait_for_status("number 1 of 1")?;
    urgent.leave()?;
    second.call("/rosapi/get_time", json!({}))?;
    Ok(())
}

/// A node that never registers.
const SLEEPER: &str = "#!/usr/bin/env python3\nimport time\nwhile True: time.sleep(1)\n";

pub fn a_probe_gives_way_to_a_robot() -> Verdict {
    // Capacity for one servant with the default limits, and enough time to examine a node that never registers.
    let daemon = world()
        .setup("probe-gives-way")
        .config("[capacity]\nmemory = \"100M\"\n[servant]\nwarm_pool = 0\n[push]\nprobe = \"30m\"\n")
        .start()?;
    let package = GREETER.package.context("a package")?;
    daemon.deployer().push(package, GREETER.arguments)?.expect_success()?;
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
    let push = std::thread::spawn(move || deployer.run(&["push", &path, "--node", "sleeper.py", "--name", "sleeper"]));
    // However long the build takes.
    let until = |is: fn(&Value) -> bool| -> Verdict {
        while !is(&daemon.get_json("/api/v1/status")?["capacity"]) {
            ensure!(!push.is_finished(), "the push ended");
            std::thread::sleep(LOOK_EVERY);
        }
        Ok(())
    };
    until(|capacity| capacity["memory_reserved"].as_u64() > Some(0))?;
    let mut robot = daemon.robot("greeter_cpp?robot=first")?;
    robot.call("/rosapi/get_time", json!({}))?;
    until(|capacity| capacity["waiting"] == 1)?;
    daemon.stop()?;
    let Ok(outcome) = push.join() else {
        bail!("the deployer panicked");
    };
    let said = outcome?.output();
    ensure!(said.contains("a robot needs this capacity"), "{said}");
    Ok(())
}
