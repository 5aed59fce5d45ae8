//! Resource limits of a push, and the end of a push that exceeds them or is no longer wanted.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::path_str;
use support::world::world;
use support::{Verdict, binaries, leftovers, procfs};

use crate::access::{create_token, push_adder, run_with_token};

const GREETER: (&str, &[&str]) = ("greeter_cpp", &["--node", "greeter", "--param", "word=hi"]);

/// Polling interval for the state of a push.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Writes a package whose build runs a Python program in its binary directory.
fn write_package(below: &Path, name: &str, program: &str) -> anyhow::Result<PathBuf> {
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

/// Returns the names of running or abandoned builds.
fn list_builds(daemon: &Daemon) -> anyhow::Result<Vec<String>> {
    let directory = daemon.home.join("build");
    let names = std::fs::read_dir(directory)?.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
    names.collect()
}

/// Waits for a condition while a push runs; on a busy machine a push takes a while to start.
fn wait_during_push<T>(push: &JoinHandle<T>, what: &str, mut is: impl FnMut() -> anyhow::Result<bool>) -> Verdict {
    while !is()? {
        ensure!(!push.is_finished(), "the push ended without {what}");
        std::thread::sleep(LOOK_EVERY);
    }
    Ok(())
}

pub fn a_build_that_takes_too_much_is_ended_and_leaves_nothing() -> Verdict {
    let daemon = world().setup("bounds").config("[push]\ndisk = \"8G\"\n").start()?;
    let place = world().directory("bounds-packages")?;
    let endless = "import time\nopen('hole', 'w').truncate(1 << 40)\nwhile True: time.sleep(1)\n";
    let deep = "import os, time\nfor _ in range(15000):\n    os.mkdir('d')\n    os.chdir('d')\nwhile True: \
        time.sleep(1)\n";
    let brief = "import os\nfor _ in range(15000):\n    os.mkdir('d')\n    os.chdir('d')\n";
    for (name, program, words) in
        [("takes_the_disk", endless, &["8G", "raise disk"][..]), ("nests_for_ever", deep, &["directories deep"])]
    {
        let package = write_package(place.path(), name, program)?;
        daemon.deployer().run(&["push", path_str(&package)])?.expect_failure(words)?;
        ensure!(list_builds(&daemon)?.is_empty(), "{:?}", list_builds(&daemon)?);
    }
    // Faster than the monitor's interval, and removed completely: the daemon is still running to report the end.
    let package = write_package(place.path(), "nests_and_goes_on", brief)?;
    let outcome = daemon.deployer().run(&["push", path_str(&package)])?;
    ensure!(!outcome.output().contains("aborted the push"), "{}", outcome.output());
    ensure!(list_builds(&daemon)?.is_empty(), "{:?}", list_builds(&daemon)?);
    daemon.get_json("/api/v1/status")?;
    Ok(())
}

/// Writes a package whose node never registers, so that its push waits.
fn write_waiting_package(below: &Path) -> anyhow::Result<PathBuf> {
    let place = write_package(below, "never_there", "print('built')\n")?;
    std::fs::write(place.join("waits.py"), "#!/usr/bin/env python3\nimport time\ntime.sleep(86400)\n")?;
    let mut list = std::fs::read_to_string(place.join("CMakeLists.txt"))?;
    list.push_str("catkin_install_python(PROGRAMS waits.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n");
    std::fs::write(place.join("CMakeLists.txt"), list)?;
    Ok(place)
}

/// Program of a build that never ends by itself.
const SLEEPER: &str = "import time\nprint('it sleeps')\nwhile True: time.sleep(1)\n";

/// Starts a push over TCP with a token, without a terminal; its errors go to a file.
fn spawn_push(daemon: &Daemon, secret: &str, arguments: &[&str], errors: &Path) -> anyhow::Result<Child> {
    let push = Command::new(binaries::path("cloudroidctl"))
        .args(["--server", &format!("http://{}", daemon.address), "--token", secret, "push"])
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::from(File::create(errors)?))
        .spawn()?;
    Ok(push)
}

/// Waits until a push has printed these words.
fn wait_until_printed(push: &mut Child, words: &str) -> Verdict {
    let mut said = String::new();
    for line in BufReader::new(push.stdout.as_mut().context("piped")?).lines() {
        said += &line?;
        if said.contains(words) {
            return Ok(());
        }
        said.push('\n');
    }
    bail!("the push did not print {words:?}, but:\n{said}")
}

pub fn a_push_outlives_its_client() -> Verdict {
    let daemon = world().setup("outlived").start()?;
    let deployer = daemon.deployer();
    let place = world().directory("outlived-packages")?;
    let package = write_package(place.path(), "sleeps_alone", SLEEPER)?;
    let errors = place.path().join("errors");
    let arguments = [path_str(&package), "--name", "alone", "--node", "x"];
    let ada = create_token(&daemon, &["ada", "--role", "deployer", "--service", "*"])?;
    let bob = create_token(&daemon, &["bob", "--role", "deployer", "--service", "*"])?;
    let eve = create_token(&daemon, &["eve", "--role", "viewer", "--service", "*"])?;
    let stranger = create_token(&daemon, &["sam", "--role", "viewer", "--service", "other*"])?;
    let newest = |token: &str| -> anyhow::Result<Value> {
        let listed = run_with_token(&daemon, token, &["--format", "json", "pushes"])?.expect_success()?;
        Ok(serde_json::from_str::<Value>(&listed.stdout)?[0].clone())
    };
    // Its client is killed, and the push continues.
    let mut push = spawn_push(&daemon, &ada, &arguments, &errors)?;
    wait_until_printed(&mut push, "it sleeps")?;
    push.kill()?;
    push.wait()?;
    let seen = newest(&ada)?;
    let number = seen["number"].to_string();
    ensure!(seen["state"] == "running" && seen["by"] == "ada" && seen["service"] == "alone", "{seen:#}");
    ensure!(seen["step"].as_str().is_some_and(|step| !step.is_empty()) && seen["can_cancel"] == true, "{seen:#}");
    // Those who see the service see the push; it is for others to read and to end.
    let seen = newest(&eve)?;
    ensure!(seen["state"] == "running" && seen["can_cancel"] == false && seen["can_read"] == false, "{seen:#}");
    ensure!(newest(&stranger)?.is_null());
    for token in [&eve, &bob] {
        for verb in ["cancel", "logs"] {
            let refused = run_with_token(&daemon, token, &["pushes", verb, &number])?.expect_failure(&["may not"])?;
            ensure!(refused.status == 4, "{}", refused.output());
        }
    }
    let said = run_with_token(&daemon, &ada, &["pushes", "logs", &number])?.expect_success()?;
    ensure!(said.stdout.contains("it sleeps"), "{}", said.output());
    ensure!(list_builds(&daemon)?.len() == 1, "{:?}", list_builds(&daemon)?);
    deployer.run(&["pushes", "cancel", &number])?.expect_success()?;
    ensure!(list_builds(&daemon)?.is_empty(), "{:?}", list_builds(&daemon)?);
    ensure!(newest(&ada)?["state"] == "cancelled");
    let said = deployer.run(&["pushes", "logs", &number])?.expect_success()?;
    ensure!(said.stdout.contains("it sleeps") && said.stdout.contains("was cancelled"), "{}", said.output());
    deployer.run(&["pushes", "cancel", &number])?.expect_failure(&["it has ended"])?;
    // An interrupt without a terminal stops it.
    let mut push = spawn_push(&daemon, &ada, &arguments, &errors)?;
    wait_until_printed(&mut push, "it sleeps")?;
    kill(Pid::from_raw(i32::try_from(push.id())?), Signal::SIGINT)?;
    let status = push.wait()?;
    let said = std::fs::read_to_string(&errors)?;
    ensure!(status.code() == Some(1) && said.contains("cancelled; nothing was published"), "{status}: {said}");
    ensure!(newest(&ada)?["state"] == "cancelled" && list_builds(&daemon)?.is_empty());
    // What is detached is published.
    let detached = push_adder(&daemon, &ada, &["--detach"])?.expect_success()?;
    let number = detached.stdout.trim().to_owned();
    ensure!(number.parse::<u64>().is_ok(), "{}", detached.output());
    run_with_token(&daemon, &ada, &["pushes", "logs", &number, "--follow"])?.expect_success()?;
    let seen = newest(&ada)?;
    ensure!(seen["state"] == "published" && seen["service"] == "adder_py", "{seen:#}");
    Ok(())
}

pub fn what_a_push_lacks_is_told_before_it_waits_for_others() -> Verdict {
    let daemon = world().setup("told-first").config("[push]\nat_once = 1\n").start()?;
    let deployer = daemon.deployer();
    let place = world().directory("told-first-packages")?;
    let sleeper = write_package(place.path(), "sleeps_first", SLEEPER)?;
    let detached = deployer.run(&["push", path_str(&sleeper), "--node", "x", "--detach"])?.expect_success()?;
    let number: u64 = detached.stdout.trim().parse()?;
    let is_running = |pushes: &Value| {
        let push = pushes.as_array()?.iter().find(|push| push["number"] == number)?;
        push["step"].as_str()?.starts_with("compiling").then(|| push["state"].clone())
    };
    daemon.wait_for("/api/v1/pushes", "the first push builds", is_running)?;
    let needy = write_package(place.path(), "needs_warp", "")?;
    let manifest = std::fs::read_to_string(needy.join("package.xml"))?;
    let needs = "<depend>no_such_warp_drive</depend></package>";
    std::fs::write(needy.join("package.xml"), manifest.replace("</package>", needs))?;
    let choosy = write_package(place.path(), "choosy_twice", "")?;
    let list = std::fs::read_to_string(choosy.join("CMakeLists.txt"))?;
    std::fs::write(choosy.join("it.cpp"), "this is never compiled\n")?;
    let programs = "add_executable(left it.cpp)\nadd_executable(right it.cpp)\n";
    std::fs::write(choosy.join("CMakeLists.txt"), format!("{list}{programs}"))?;
    for (package, words) in [(&needy, "no_such_warp_drive"), (&choosy, "choose what to run with --node or --launch")] {
        deployer.run(&["push", path_str(package)])?.expect_failure(&[words])?;
    }
    let pushes = daemon.get_json("/api/v1/pushes")?;
    ensure!(is_running(&pushes) == Some("running".into()), "{pushes:#}");
    deployer.run(&["pushes", "cancel", &number.to_string()])?.expect_success()?;
    Ok(())
}

pub fn a_push_ends_with_what_its_deployer_showed() -> Verdict {
    let daemon = world().setup("disowned").start()?;
    let place = world().directory("disowned-packages")?;
    // During the build, and while the node is examined.
    for (name, package, node, words) in [
        ("alice", write_package(place.path(), "sleeps_on", SLEEPER)?, "x", "it sleeps"),
        ("bob", write_waiting_package(place.path())?, "waits.py", "starting it once"),
    ] {
        let secret = create_token(&daemon, &[name, "--role", "deployer", "--service", "*"])?;
        let mut push = spawn_push(&daemon, &secret, &[path_str(&package), "--node", node], &place.path().join(name))?;
        let told = BufReader::new(push.stdout.take().context("piped")?).lines();
        let mut said = String::new();
        for line in told {
            let line = line?;
            said.push_str(&line);
            said.push('\n');
            if line.contains(words) {
                daemon.deployer().run(&["token", "revoke", name])?.expect_success()?;
            }
        }
        said += &std::fs::read_to_string(place.path().join(name))?;
        ensure!(!push.wait()?.success() && said.contains(words), "{said}");
        ensure!(said.contains("this token was revoked"), "{said}");
        // Nothing is left of the build, and nothing was published.
        support::wait_until("the build's end", || {
            let builds = list_builds(&daemon)?;
            Ok(if builds.is_empty() { Ok(()) } else { Err(format!("{builds:?}")) })
        })?;
        ensure!(daemon.api("/api/v1/services")? == json!([]));
    }
    Ok(())
}

pub fn a_push_nobody_waits_for_ends_with_its_daemon() -> Verdict {
    let daemon = world().setup("cancelled").start()?;
    let place = world().directory("cancelled-packages")?;
    let package = write_package(place.path(), "sleeps_for_ever", SLEEPER)?;
    let (deployer, home) = (daemon.deployer(), daemon.home.clone());
    let push = std::thread::spawn(move || deployer.run(&["push", path_str(&package)]));
    let logs = home.join("logs");
    wait_during_push(&push, "its build", || {
        let mut logs = std::fs::read_dir(&logs).into_iter().flatten().flatten();
        Ok(logs.any(|log| std::fs::read_to_string(log.path()).is_ok_and(|text| text.contains("it sleeps"))))
    })?;
    ensure!(list_builds(&daemon)?.len() == 1, "{:?}", list_builds(&daemon)?);
    ensure!(daemon.stop()?.success(), "it ended as asked");
    let Ok(outcome) = push.join() else {
        bail!("the deployer panicked");
    };
    ensure!(outcome?.status != 0, "the push did not succeed");
    let left: Vec<_> = std::fs::read_dir(home.join("build"))?.collect();
    ensure!(left.is_empty(), "{left:?}");
    let left = leftovers::find_leftovers(&home);
    ensure!(left.is_empty(), "{left:#?}");
    Ok(())
}

pub fn a_second_signal_ends_the_daemon_at_once() -> Verdict {
    let setup = world().setup("impatient");
    let daemon = setup.start()?;
    daemon.deployer().push(GREETER.0, GREETER.1)?.expect_success()?;
    let mut robot = daemon.robot("greeter_cpp?robot=stuck")?;
    robot.call("/rosapi/get_time", json!({}))?;
    let servant = daemon.servant_of("greeter_cpp", "stuck")?;
    let node = servant["pids"][0].as_i64().context("a pid")? as i32;
    let shim = Pid::from_raw(parent_of_process(parent_of_process(node)?)?);
    // The shim does not respond, so stopping its servant waits for it.
    kill(shim, Signal::SIGSTOP)?;
    let home = daemon.home.clone();
    // Two different signals, because the second of two equal ones could arrive before the first is handled, and be
    // lost.
    kill(Pid::from_raw(daemon.pid()), Signal::SIGINT)?;
    let status = daemon.stop()?;
    kill(shim, Signal::SIGCONT)?;
    // A daemon that had waited would have exited successfully.
    ensure!(status.code() == Some(1), "{status}");
    // The servant outlives the daemon and is removed by the next one.
    let next = setup.start()?;
    next.deployer().run(&["stop", "--all"])?;
    ensure!(next.stop()?.success());
    let left = leftovers::find_leftovers(&home);
    ensure!(left.is_empty(), "{left:#?}");
    Ok(())
}

/// Returns the parent of a process.
fn parent_of_process(pid: i32) -> anyhow::Result<i32> {
    let status = procfs::status(pid).context("a process")?;
    Ok(status.get("PPid").context("PPid")?.parse()?)
}

pub fn a_probe_waits_for_room_like_any_servant() -> Verdict {
    // Capacity for one servant with the default limits.
    let daemon =
        world().setup("probe-room").config("[capacity]\nmemory = \"100M\"\n[servant]\nwarm_pool = 0\n").start()?;
    daemon.deployer().push(GREETER.0, GREETER.1)?.expect_success()?;
    let mut robot = daemon.robot("greeter_cpp?robot=first")?;
    robot.call("/rosapi/get_time", json!({}))?;
    let deployer = daemon.deployer();
    let second = std::thread::spawn(move || deployer.push(GREETER.0, &[GREETER.1, &["--name", "second"]].concat()));
    wait_during_push(&second, "waiting for free capacity", || {
        Ok(daemon.get_json("/api/v1/status")?["capacity"]["waiting"] == 1)
    })?;
    robot.leave()?;
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    let Ok(outcome) = second.join() else {
        bail!("the deployer panicked");
    };
    let outcome = outcome?.expect_success()?;
    ensure!(outcome.output().contains("waiting for free capacity to start it"), "{}", outcome.output());
    Ok(())
}
