//! What a push may take, and how it ends when it takes more or is not wanted any longer.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::world::world;
use support::{Verdict, binaries, leftovers, procfs};

use crate::access::token;

const GREETER: (&str, &[&str]) = ("greeter_cpp", &["--node", "greeter", "--param", "word=hi"]);

/// Between looks at what a push has come to.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// A package whose build runs a Python program in its binary directory.
fn package(below: &Path, name: &str, program: &str) -> anyhow::Result<PathBuf> {
    let place = below.join(name);
    std::fs::create_dir_all(&place)?;
    std::fs::write(
        place.join("package.xml"),
        format!(
            "<package format=\"2\"><name>{name}</name><version>1.0.0</version><description>d</description>\
             <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>\
             <buildtool_depend>catkin</buildtool_depend></package>"
        ),
    )?;
    std::fs::write(place.join("program.py"), program)?;
    std::fs::write(
        place.join("CMakeLists.txt"),
        format!(
            "cmake_minimum_required(VERSION 3.0.2)\nproject({name})\nfind_package(catkin REQUIRED)\n\
             catkin_package()\nexecute_process(COMMAND python3 -u ${{CMAKE_CURRENT_SOURCE_DIR}}/program.py)\n"
        ),
    )?;
    Ok(place)
}

/// Names of builds that are under way or were left.
fn builds(daemon: &Daemon) -> anyhow::Result<Vec<String>> {
    let directory = daemon.home.join("build");
    let names = std::fs::read_dir(directory)?
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
    names.collect()
}

/// Waits for something that comes about while a push goes on: a busy machine takes its time to begin one.
fn during<T>(
    push: &JoinHandle<T>,
    what: &str,
    mut is: impl FnMut() -> anyhow::Result<bool>,
) -> Verdict {
    while !is()? {
        ensure!(!push.is_finished(), "the push ended without {what}");
        std::thread::sleep(LOOK_EVERY);
    }
    Ok(())
}

pub fn a_build_that_takes_too_much_is_ended_and_leaves_nothing() -> Verdict {
    let daemon = world()
        .own("bounds")
        .config("[push]\ndisk = \"8G\"\n")
        .start()?;
    let place = world().directory("bounds-packages")?;
    let endless = "import time\nopen('hole', 'w').truncate(1 << 40)\nwhile True: time.sleep(1)\n";
    let deep = "import os, time\nfor _ in range(15000):\n    os.mkdir('d')\n    os.chdir('d')\nwhile True: time.sleep(1)\n";
    let brief = "import os\nfor _ in range(15000):\n    os.mkdir('d')\n    os.chdir('d')\n";
    for (name, program, words) in [
        ("takes_the_disk", endless, &["8G", "raise disk"][..]),
        ("nests_for_ever", deep, &["directories deep"]),
    ] {
        let package = package(place.path(), name, program)?;
        daemon
            .deployer()
            .types(&["push", path_str(&package)])?
            .failed_saying(words)?;
        ensure!(builds(&daemon)?.is_empty(), "{:?}", builds(&daemon)?);
    }
    // Faster than anybody looks, and removed with all the rest: the daemon is still there to say how it ended.
    let package = package(place.path(), "nests_and_goes_on", brief)?;
    let outcome = daemon.deployer().types(&["push", path_str(&package)])?;
    ensure!(!outcome.said().contains("broke off"), "{}", outcome.said());
    ensure!(builds(&daemon)?.is_empty(), "{:?}", builds(&daemon)?);
    daemon.get_json("/api/v1/status")?;
    Ok(())
}

/// A package whose node never becomes one, so that whoever pushes it waits.
fn waiting(below: &Path) -> anyhow::Result<PathBuf> {
    let place = package(below, "never_there", "print('built')\n")?;
    std::fs::write(
        place.join("waits.py"),
        "#!/usr/bin/env python3\nimport time\ntime.sleep(86400)\n",
    )?;
    let mut list = std::fs::read_to_string(place.join("CMakeLists.txt"))?;
    list.push_str(
        "catkin_install_python(PROGRAMS waits.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n",
    );
    std::fs::write(place.join("CMakeLists.txt"), list)?;
    Ok(place)
}

pub fn a_push_ends_with_what_its_deployer_showed() -> Verdict {
    let daemon = world().own("disowned").start()?;
    let place = world().directory("disowned-packages")?;
    let sleeper = "import time\nprint('it sleeps')\nwhile True: time.sleep(1)\n";
    // While it is built, and while its node is looked at.
    for (name, package, node, words) in [
        (
            "alice",
            package(place.path(), "sleeps_on", sleeper)?,
            "x",
            "it sleeps",
        ),
        (
            "bob",
            waiting(place.path())?,
            "waits.py",
            "starting it once",
        ),
    ] {
        let secret = token(&daemon, &[name, "--role", "deployer", "--service", "*"])?;
        let mut push = Command::new(binaries::path("cloudroidctl"))
            .args([
                "--server",
                &format!("http://{}", daemon.address),
                "--token",
                &secret,
            ])
            .args(["push", path_str(&package), "--node", node])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::from(File::create(place.path().join(name))?))
            .spawn()?;
        let told = BufReader::new(push.stdout.take().context("piped")?).lines();
        let mut said = String::new();
        for line in told {
            let line = line?;
            said.push_str(&line);
            said.push('\n');
            if line.contains(words) {
                daemon
                    .deployer()
                    .types(&["token", "revoke", name])?
                    .succeeded()?;
            }
        }
        said += &std::fs::read_to_string(place.path().join(name))?;
        ensure!(!push.wait()?.success() && said.contains(words), "{said}");
        ensure!(said.contains("this token was revoked"), "{said}");
        // Nothing is left of it, and nothing was published.
        support::until("the build's end", || {
            let builds = builds(&daemon)?;
            Ok(if builds.is_empty() {
                Ok(())
            } else {
                Err(format!("{builds:?}"))
            })
        })?;
        ensure!(daemon.api("/api/v1/services")? == json!([]));
    }
    Ok(())
}

pub fn a_push_nobody_waits_for_ends_with_its_daemon() -> Verdict {
    let daemon = world().own("cancelled").start()?;
    let place = world().directory("cancelled-packages")?;
    let sleeper = "import time\nprint('it sleeps')\nwhile True: time.sleep(1)\n";
    let package = package(place.path(), "sleeps_for_ever", sleeper)?;
    let (deployer, home) = (daemon.deployer(), daemon.home.clone());
    let push = std::thread::spawn(move || deployer.types(&["push", path_str(&package)]));
    let logs = home.join("logs");
    during(&push, "its build", || {
        let mut logs = std::fs::read_dir(&logs).into_iter().flatten().flatten();
        Ok(logs.any(|log| {
            std::fs::read_to_string(log.path()).is_ok_and(|text| text.contains("it sleeps"))
        }))
    })?;
    ensure!(builds(&daemon)?.len() == 1, "{:?}", builds(&daemon)?);
    ensure!(daemon.ends()?.success(), "it ended as asked");
    let Ok(outcome) = push.join() else {
        bail!("the deployer panicked");
    };
    ensure!(outcome?.status != 0, "the push did not succeed");
    let left: Vec<_> = std::fs::read_dir(home.join("build"))?.collect();
    ensure!(left.is_empty(), "{left:?}");
    let left = leftovers::of(&home);
    ensure!(left.is_empty(), "{left:#?}");
    Ok(())
}

pub fn a_second_signal_ends_the_daemon_at_once() -> Verdict {
    let setup = world().own("impatient");
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes(GREETER.0, GREETER.1)?
        .succeeded()?;
    let mut robot = daemon.robot("greeter_cpp?robot=stuck")?;
    robot.calls("/rosapi/get_time", json!({}))?;
    let servant = daemon.servant_of("greeter_cpp", "stuck")?;
    let node = servant["pids"][0].as_i64().context("a pid")? as i32;
    let shim = Pid::from_raw(parent(parent(node)?)?);
    // It answers nobody: whoever ends its servant waits for it.
    kill(shim, Signal::SIGSTOP)?;
    let home = daemon.home.clone();
    // Of two signals of one kind the second might come before the first was seen, and be lost.
    kill(Pid::from_raw(daemon.pid()), Signal::SIGINT)?;
    let status = daemon.ends()?;
    kill(shim, Signal::SIGCONT)?;
    // A daemon that had waited would have ended well.
    ensure!(status.code() == Some(1), "{status}");
    // The servant outlived it, and is swept by the next.
    let next = setup.start()?;
    next.deployer().types(&["stop", "--all"])?;
    ensure!(next.ends()?.success());
    let left = leftovers::of(&home);
    ensure!(left.is_empty(), "{left:#?}");
    Ok(())
}

/// The parent of a process.
fn parent(pid: i32) -> anyhow::Result<i32> {
    let status = procfs::status(pid).context("a process")?;
    Ok(status.get("PPid").context("PPid")?.parse()?)
}

pub fn a_probe_waits_for_room_like_any_servant() -> Verdict {
    // Room for one servant whose push asked for nothing.
    let daemon = world()
        .own("probe-room")
        .config("[capacity]\nmemory = \"100M\"\n[servant]\nwarm_pool = 0\n")
        .start()?;
    daemon
        .deployer()
        .pushes(GREETER.0, GREETER.1)?
        .succeeded()?;
    let mut robot = daemon.robot("greeter_cpp?robot=first")?;
    robot.calls("/rosapi/get_time", json!({}))?;
    let deployer = daemon.deployer();
    let second = std::thread::spawn(move || {
        deployer.pushes(GREETER.0, &[GREETER.1, &["--name", "second"]].concat())
    });
    during(&second, "waiting for room", || {
        Ok(daemon.get_json("/api/v1/status")?["capacity"]["waiting"] == 1)
    })?;
    robot.leaves()?;
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    let Ok(outcome) = second.join() else {
        bail!("the deployer panicked");
    };
    let outcome = outcome?.succeeded()?;
    ensure!(
        outcome.said().contains("waiting for room to start it"),
        "{}",
        outcome.said()
    );
    Ok(())
}
