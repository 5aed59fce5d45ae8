//! Failures and what survives them: daemons, shims, inits and nodes are killed, and disks and databases fail.

use std::collections::BTreeSet;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use support::burglar::try_attempt;
use support::daemon::{Daemon, DaemonSetup};
use support::deployer::run;
use support::patience::{self, Deadline, patience};
use support::robot::Robot;
use support::small_disk::SmallDisk;
use support::world::world;
use support::{Verdict, leftovers, procfs};

/// Starts a separate daemon whose servants outlive it, and pushes these packages.
fn start_with_packages(name: &str, packages: &[(&str, &[&str])]) -> anyhow::Result<(DaemonSetup, Daemon)> {
    let setup = world().setup(name).config("keep_servants = true\n");
    let daemon = setup.start()?;
    for (package, arguments) in packages {
        daemon.deployer().push(package, arguments)?.expect_success()?;
    }
    Ok((setup, daemon))
}

/// Checks that nothing is left after its servants have been stopped.
pub(crate) fn expect_nothing_left(daemon: Daemon) -> Verdict {
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    let home = daemon.home.clone();
    daemon.stop()?;
    let left = leftovers::find_leftovers(&home);
    ensure!(left.is_empty(), "{left:#?}");
    Ok(())
}

/// Waits for an event of this kind whose message contains all of these words.
pub(crate) fn wait_for_event(daemon: &Daemon, kind: &str, words: &[&str]) -> anyhow::Result<Value> {
    daemon.wait_for_event(&format!("an event {kind} with {words:?}"), |event| {
        event["kind"] == kind
            && event["message"].as_str().is_some_and(|text| words.iter().all(|word| text.contains(word)))
    })
}

fn greet(robot: &mut Robot, name: &str) -> anyhow::Result<Value> {
    robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.wait_for_subscriber("/greeter/name")?;
    robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": name}}))?;
    // roscpp may deliver the latched message twice to a late subscriber.
    let greets = format!("hi {name}");
    let heard =
        robot.wait_for(&greets, |heard| heard["topic"] == "/greeter/greeting" && heard["msg"]["text"] == *greets)?;
    Ok(heard["msg"].clone())
}

const GREETER: (&str, &[&str]) = ("greeter_cpp", &["--node", "greeter", "--param", "word=hi"]);
const ADDER: (&str, &[&str]) = ("adder_py", &["--node", "adder.py"]);
const BURGLAR: (&str, &[&str]) = ("burglar_cpp", &["--node", "burglar"]);

pub fn what_cannot_be_removed_keeps_no_daemon_down() -> Verdict {
    let (setup, first) = start_with_packages("stray", &[ADDER])?;
    let mut robot = first.robot("adder_py?robot=r1")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 1}))?["values"]["sum"] == 2);
    let stray = first.home.join("servants/x");
    first.kill()?;
    std::fs::write(&stray, "somebody's")?;
    let second = setup.start()?;
    let mut robot = second.robot("adder_py?robot=r1")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    ensure!(second.servants_of("adder_py")?.len() == 1, "it is the same");
    wait_for_event(&second, "servant-leftover", &["servants/x"])?;
    std::fs::remove_file(&stray)?;
    expect_nothing_left(second)
}

pub fn a_killed_daemon_loses_nothing() -> Verdict {
    let (setup, first) = start_with_packages("killed", &[GREETER, ADDER, BURGLAR])?;
    let mut greeter = first.robot("greeter_cpp?robot=r1")?;
    let mut adder = first.robot("adder_py?robot=r1")?;
    let mut caller = first.robot("burglar_cpp?robot=r1")?;
    greeter.subscribe("/greeter/greeting")?;
    ensure!(greet(&mut greeter, "Ada")?["count"] == 1);
    let set = greeter.call("/rosapi/set_param", json!({"name": "/kept", "value": "[1, 2]"}))?;
    ensure!(set["result"] == true, "{set}");
    ensure!(adder.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    let services = ["greeter_cpp", "adder_py", "burglar_cpp"];
    let of = |daemon: &Daemon, service: &str| -> anyhow::Result<(Value, Value)> {
        let servant = daemon.servant_of(service, "r1")?;
        Ok((servant["id"].clone(), servant["pids"].clone()))
    };
    let before: Vec<_> = services.iter().map(|service| of(&first, service)).collect::<Result<_, _>>()?;
    // Traffic, and a call that its node has not answered yet.
    let url = first.url("greeter_cpp?robot=r1");
    let (flowing, flows) = std::sync::mpsc::channel();
    let traffic = std::thread::spawn(move || {
        let Ok(mut robot) = Robot::connect(&url) else {
            return 0;
        };
        let _ = robot.send(json!({"op": "advertise", "topic": "/noise", "type": "std_msgs/String"}));
        let mut sent = 0;
        while robot.send(json!({"op": "publish", "topic": "/noise", "msg": {"data": "x"}})).is_ok() {
            sent += 1;
            let _ = flowing.send(());
        }
        sent
    });
    caller.send(json!({
        "op": "call_service", "id": "flying", "service": "/burglar/try",
        "args": {"what": "wait", "argument": "600000"},
    }))?;
    ensure!(try_attempt(&mut caller, "write", "/tmp/called yes")?.succeeded, "another is answered meanwhile");
    patience::receive(&flows).context("no traffic")?;
    first.kill()?;
    ensure!(traffic.join().is_ok_and(|sent| sent > 0), "there was traffic");
    // The call is not answered, because its connection ends.
    ensure!(caller.wait_for("an answer", |value| value["id"] == "flying").is_err());

    let second = setup.start()?;
    for (service, before) in services.iter().zip(&before) {
        ensure!(of(&second, service)? == *before, "{service} has another servant");
        wait_for_event(&second, "servant-adopted", &[service])?;
    }
    let mut greeter = second.robot("greeter_cpp?robot=r1")?;
    greeter.subscribe("/greeter/greeting")?;
    ensure!(greeter.next_message_on("/greeter/greeting")?["text"] == "hi Ada", "what was latched comes again");
    ensure!(greet(&mut greeter, "Bea")?["count"] == 2, "the node has counted on");
    let kept = greeter.call("/rosapi/get_param", json!({"name": "/kept"}))?;
    ensure!(kept["values"]["value"] == "[1,2]" || kept["values"]["value"] == "[1, 2]", "{kept}");
    let mut adder = second.robot("adder_py?robot=r1")?;
    ensure!(adder.call("/add_two", json!({"a": 20, "b": 22}))?["values"]["sum"] == 42);
    let mut caller = second.robot("burglar_cpp?robot=r1")?;
    ensure!(try_attempt(&mut caller, "text-in-file", "/tmp/called yes")?.succeeded, "its scratch is as it was");
    expect_nothing_left(second)
}

/// Returns the directories of servants.
fn servant_directories(daemon: &Daemon) -> BTreeSet<PathBuf> {
    let entries = std::fs::read_dir(daemon.home.join("servants")).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

pub fn a_daemon_killed_while_a_servant_is_made_gives_it_all_that_it_is_granted() -> Verdict {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let out = listener.local_addr()?;
    let config = format!("keep_servants = true\n[servant]\nwarm_pool = 0\n[allow]\negress = [\"{out}\"]\n");
    let setup = world().setup("relayed").config(&config);
    let mut daemon = setup.start()?;
    daemon.deployer().push(BURGLAR.0, &[BURGLAR.1, &["--egress", &out.to_string()]].concat())?.expect_success()?;
    // Files of a servant in the order in which they come: its container and its relays are made after the first ones.
    for (robot, file) in [("first", "spec.json"), ("second", "shim.log"), ("third", "runtime.json")] {
        let (known, url) = (servant_directories(&daemon), daemon.url(&format!("burglar_cpp?robot={robot}")));
        let asking = std::thread::spawn(move || drop(Robot::try_connect(&url)));
        support::wait_until(&format!("{file} of a servant"), || {
            let all = servant_directories(&daemon);
            let is_made = all.difference(&known).any(|new| new.join(file).exists());
            Ok(if is_made { Ok(()) } else { Err(format!("{all:?}")) })
        })?;
        daemon.kill()?;
        ensure!(asking.join().is_ok(), "it panicked");
        daemon = setup.start()?;
        let mut robot = daemon.robot(&format!("burglar_cpp?robot={robot}"))?;
        let way = format!("127.0.1.1:{}", out.port());
        let attempt = try_attempt(&mut robot, "connect", &way)?;
        ensure!(attempt.succeeded, "killed after {file}: no way out: {}", attempt.report);
        listener.accept()?;
    }
    expect_nothing_left(daemon)
}

pub fn a_daemon_that_is_ended_says_why_and_keeps_its_servants() -> Verdict {
    let (setup, first) = start_with_packages("ended", &[BURGLAR])?;
    let mut robot = first.robot("burglar_cpp?robot=r1")?;
    try_attempt(&mut robot, "write", "/tmp/x y")?;
    let pids = first.servant_of("burglar_cpp", "r1")?["pids"].clone();
    robot.send(json!({
        "op": "call_service", "id": "flying", "service": "/burglar/try",
        "args": {"what": "wait", "argument": "600000"},
    }))?;
    try_attempt(&mut robot, "write", "/tmp/x y")?;
    first.stop()?;
    // It failed with a reason, or the connection was closed with one.
    match robot.wait_for("an answer", |value| value["id"] == "flying") {
        Ok(answer) => ensure!(answer["result"] == false && answer["values"].to_string().len() > 4, "{answer}"),
        Err(error) => ensure!(format!("{error:#}").contains("connect again"), "{error:#}"),
    }
    let second = setup.start()?;
    let servant = second.servant_of("burglar_cpp", "r1")?;
    ensure!(servant["pids"] == pids, "{servant:#}");
    expect_nothing_left(second)
}

/// Returns the parent of a process.
fn parent_of_process(pid: i32) -> anyhow::Result<i32> {
    let status = procfs::status(pid).context("a process")?;
    Ok(status.get("PPid").context("PPid")?.parse()?)
}

pub fn a_killed_init_and_a_killed_shim_are_told() -> Verdict {
    let (_, daemon) = start_with_packages("orphans", &[GREETER])?;
    for (which, words) in [("init", "its init was killed by signal 9"), ("shim", "its shim was killed")] {
        let path = format!("greeter_cpp?robot={which}");
        let mut robot = daemon.robot(&path)?;
        robot.send(json!({"op": "set_level", "level": "warning"}))?;
        robot.call("/rosapi/get_time", json!({}))?;
        let servant = daemon.servant_of("greeter_cpp", which)?;
        let node = servant["pids"][0].as_i64().context("a pid")? as i32;
        let init = parent_of_process(node)?;
        let victim = if which == "init" { init } else { parent_of_process(init)? };
        kill(Pid::from_raw(victim), Signal::SIGKILL)?;
        robot.wait_for_status("servant")?;
        wait_for_event(&daemon, "servant-failed", &[servant["id"].as_str().context("an id")?, words])?;
        support::wait_until(&format!("the end of a node after its {which}'s"), || {
            let runs = Path::new(&format!("/proc/{node}")).exists();
            Ok(if runs { Err("it runs".to_owned()) } else { Ok(()) })
        })?;
        // The robot returns and gets another servant.
        let mut robot = daemon.robot(&path)?;
        ensure!(robot.call("/greeter/count", json!({"reset": false}))?["values"]["count"] == 0);
    }
    expect_nothing_left(daemon)
}

pub fn nodes_end_as_ros_users_know_it() -> Verdict {
    let (_, daemon) = start_with_packages("ends", &[("burglar_cpp", &["--launch", "ends.launch"])])?;
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    let id = daemon.servant_of("burglar_cpp", "r1")?["id"].as_str().context("an id")?.to_owned();
    let mut end = |node: &str, how: &str| -> anyhow::Result<()> {
        let answer = robot.call(&format!("/{node}/try"), json!({"what": "end", "argument": how}))?;
        ensure!(answer["result"] == true, "{answer}");
        Ok(())
    };
    // A node with respawn is restarted after its delay, whatever its exit status.
    end("phoenix", "exit 0")?;
    wait_for_respawn(&daemon, 1, "exited with status 0")?;
    kill_again_when_back(&daemon, "phoenix", "signal 11")?;
    wait_for_respawn(&daemon, 2, "was killed by SIGSEGV")?;
    // A node without respawn is not restarted, and the others continue.
    end("mortal", "exit 0")?;
    wait_for_event(&daemon, "node-ended", &[&id, "/mortal", "exited with status 0"])?;
    // `rosnode kill` calls `shutdown` of the node's own XML-RPC API, in its network namespace.
    rosnode_kill(&daemon, "phoenix")?;
    wait_for_respawn(&daemon, 3, "exited with status 0")?;
    // The end of a required node ends the servant.
    end("king", "exit 3")?;
    wait_for_event(&daemon, "servant-failed", &[&id, "required node /king", "exited with status 3"])?;
    expect_nothing_left(daemon)
}

/// Waits for the `time`th report that phoenix was restarted, and checks the reason.
fn wait_for_respawn(daemon: &Daemon, time: usize, how: &str) -> Verdict {
    let event = support::wait_until(&format!("a {time}th event"), || {
        let told = respawn_events(daemon)?;
        let event = told.get(time - 1).cloned();
        Ok(event.ok_or_else(|| format!("{told:#?}")))
    })?;
    let words = format!("/phoenix {how} and is restarted after 1 s");
    ensure!(event["message"].to_string().contains(&words), "{event:#}");
    Ok(())
}

fn respawn_events(daemon: &Daemon) -> anyhow::Result<Vec<Value>> {
    let events = daemon.api("/api/v1/events?limit=10000")?;
    let events = events.as_array().context("events")?.iter();
    let of = |event: &&Value| event["kind"] == "node-respawned";
    Ok(events.filter(of).cloned().collect())
}

/// Ends phoenix again once it is back, which happens only after its delay.
fn kill_again_when_back(daemon: &Daemon, node: &str, how: &str) -> Verdict {
    let ended = respawn_events(daemon)?.last().context("its end")?["time"].clone();
    let deadline = Deadline::begin();
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    loop {
        let answer = robot.call(&format!("/{node}/try"), json!({"what": "end", "argument": how}))?;
        if answer["result"] == true {
            let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?;
            let away = now.as_millis() as u64 - ended.as_u64().context("a time")?;
            // The event has the time at which the daemon learned of the end, while the delay of a second starts at the
            // end itself.
            ensure!(away >= 500, "{node} was back after {away} ms");
            return Ok(());
        }
        deadline.check(|| format!("{node} did not come back: {answer}"))?;
    }
}

/// Does the same as `rosnode kill`, with Python's XML-RPC.
fn rosnode_kill(daemon: &Daemon, node: &str) -> Verdict {
    let script = format!(
        "import time, xmlrpc.client as x\n\
         end = time.time() + {}\n\
         while True:\n\
         \x20   try:\n\
         \x20       code, _, uri = x.ServerProxy('http://127.0.0.1:11311').lookupNode('/story', '/{node}')\n\
         \x20       assert code == 1\n\
         \x20       x.ServerProxy(uri.replace('localhost', '127.0.0.1')).shutdown('/story', 'killed')\n\
         \x20       break\n\
         \x20   except Exception:\n\
         \x20       if time.time() > end: raise\n",
        patience().as_secs()
    );
    let pid = daemon.servant_of("burglar_cpp", "r1")?["pids"][0].to_string();
    run(Command::new("nsenter").args([&format!("--net=/proc/{pid}/ns/net"), "python3", "-c", &script]))?
        .expect_success()?;
    Ok(())
}

/// Returns the warnings of `status`.
fn status_warnings(daemon: &Daemon) -> anyhow::Result<String> {
    Ok(daemon.deployer().run_json(&["status"])?["warnings"].to_string())
}

/// Checks the database with an independent program.
fn expect_in_database(daemon: &Daemon, event: &Value) -> Verdict {
    let script = format!(
        "import sqlite3\nprint(*sqlite3.connect({:?}).execute('SELECT kind FROM events WHERE id = {}').fetchone())",
        daemon.home.join("cloudroid.db"),
        event["id"]
    );
    let found = run(Command::new("python3").args(["-c", &script]))?.expect_success()?;
    ensure!(Some(found.stdout.trim()) == event["kind"].as_str(), "{} is not {event}", found.stdout);
    Ok(())
}

pub fn a_locked_database_is_named_and_waited_for() -> Verdict {
    let (_, daemon) = start_with_packages("locked", &[GREETER])?;
    daemon.robot("greeter_cpp?robot=before")?.call("/greeter/count", json!({}))?;
    let script = format!(
        "import sqlite3, sys\nc = sqlite3.connect({:?})\nc.isolation_level = None\nc.execute('BEGIN EXCLUSIVE')\n\
         print('locked', flush=True)\nsys.stdin.read()\n",
        daemon.home.join("cloudroid.db")
    );
    let mut locker = Command::new("python3")
        .args(["-c", &script])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()?;
    let mut said = [0; 6];
    std::io::Read::read_exact(locker.stdout.as_mut().context("piped")?, &mut said)?;
    // Known robots are admitted, and events are reported although they cannot be stored.
    let mut before = daemon.robot("greeter_cpp?robot=before")?;
    before.call("/greeter/count", json!({"reset": false}))?;
    let refused = Robot::try_connect(&daemon.url("greeter_cpp?robot=during"));
    let words = match refused {
        Err(refusal) => refusal.to_string(),
        Ok(mut robot) => format!("{:?}", robot.wait_for_close()?),
    };
    let unwritable = wait_for_event(&daemon, "state-unwritable", &["another program has locked it", "cloudroid.db"])?;
    ensure!(status_warnings(&daemon)?.contains("another program has locked it"));
    ensure!(daemon.get("/healthz")?.0 == 200);
    before.call("/greeter/count", json!({"reset": false}))?;
    drop(locker.stdin.take());
    locker.wait()?;
    ensure!(words.contains("database"), "{words}");
    wait_for_event(&daemon, "state-writable", &["can be written again"])?;
    ensure!(!status_warnings(&daemon)?.contains("another program has locked it"));
    expect_in_database(&daemon, &unwritable)?;
    let mut robot = daemon.robot("greeter_cpp?robot=after")?;
    ensure!(robot.call("/greeter/count", json!({"reset": false}))?["result"] == true);
    drop(robot);
    expect_nothing_left(daemon)
}

pub fn a_full_disk_is_named_and_robots_at_work_stay() -> Verdict {
    let disk = SmallDisk::mount("full", "1500M")?;
    let daemon = DaemonSetup::new(&disk.home()).start()?;
    daemon.deployer().push(GREETER.0, GREETER.1)?.expect_success()?;
    let mut early = daemon.robot("greeter_cpp?robot=early")?;
    ensure!(early.call("/greeter/count", json!({"reset": false}))?["result"] == true);
    disk.fill()?;
    let words = match Robot::try_connect(&daemon.url("greeter_cpp?robot=late")) {
        Err(refusal) => refusal.to_string(),
        Ok(mut robot) => format!("{:?}", robot.wait_for_close()?),
    };
    ensure!(words.contains("space") || words.contains("full"), "{words}");
    ensure!(early.call("/greeter/count", json!({"reset": false}))?["result"] == true, "at work");
    // Known robots are admitted again.
    early.leave()?;
    let mut early = daemon.robot("greeter_cpp?robot=early")?;
    ensure!(early.call("/greeter/count", json!({"reset": false}))?["result"] == true);
    let unwritable = wait_for_event(&daemon, "state-unwritable", &["its disk is full"])?;
    ensure!(status_warnings(&daemon)?.contains("its disk is full"));
    ensure!(daemon.get("/healthz")?.0 == 200);
    disk.make_room()?;
    wait_for_event(&daemon, "state-writable", &["can be written again"])?;
    expect_in_database(&daemon, &unwritable)?;
    let mut late = daemon.robot("greeter_cpp?robot=late")?;
    ensure!(late.call("/greeter/count", json!({"reset": false}))?["result"] == true);
    drop((early, late));
    expect_nothing_left(daemon)
}

pub fn what_a_full_disk_refuses_is_not_done() -> Verdict {
    let disk = SmallDisk::mount("refusing", "32M")?;
    let setup = DaemonSetup::new(&disk.home());
    let daemon = setup.start()?;
    let deployer = daemon.deployer();
    let create = |name| ["token", "create", name, "--role", "viewer", "--service", "*"];
    deployer.run(&create("ada"))?.expect_success()?;
    disk.fill()?;
    // A token that is not stored would be useless, and a revocation that is not stored would be misleading.
    for refused in [
        &create("eve")[..],
        &["token", "rotate", "ada"],
        &["token", "revoke", "ada"],
        &["policy", "allow", "ada", "call:/x"],
    ] {
        deployer.run(refused)?.expect_failure(&["full"])?;
    }
    disk.make_room()?;
    wait_for_event(&daemon, "state-writable", &["can be written again"])?;
    daemon.stop()?;
    let daemon = setup.start()?;
    let live = |daemon: &Daemon| -> anyhow::Result<Vec<String>> {
        let tokens = daemon.deployer().run_json(&["token", "list"])?;
        let tokens = tokens.as_array().context("a list")?.iter();
        let live = tokens.filter(|token| token["revoked"].is_null());
        Ok(live.map(|token| token["name"].to_string()).collect())
    };
    ensure!(live(&daemon)? == ["\"ada\""], "{:?}", live(&daemon)?);
    let rules = daemon.deployer().run_json(&["policy", "list"])?.to_string();
    ensure!(!rules.contains("ada"), "{rules}");
    daemon.deployer().run(&["token", "revoke", "ada"])?.expect_success()?;
    ensure!(live(&daemon)?.is_empty());
    expect_nothing_left(daemon)
}
