//! What ends, and what goes on: daemons, shims, inits and nodes are killed, and disks and databases refuse.

use std::path::Path;
use std::process::Command;
use std::time::SystemTime;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use support::burglar::tries;
use support::daemon::{Daemon, Setup};
use support::deployer::run;
use support::patience::{self, Deadline, patience};
use support::robot::Robot;
use support::small_disk::SmallDisk;
use support::world::world;
use support::{Verdict, leftovers, procfs};

/// A daemon of one's own, whose servants outlive it, with these packages pushed.
fn settled(name: &str, packages: &[(&str, &[&str])]) -> anyhow::Result<(Setup, Daemon)> {
    let setup = world().own(name).config("keep_servants = true\n");
    let daemon = setup.start()?;
    for (package, arguments) in packages {
        daemon.deployer().pushes(package, arguments)?.succeeded()?;
    }
    Ok((setup, daemon))
}

/// Nothing of it may be left once its servants were ended.
fn nothing_is_left(daemon: Daemon) -> Verdict {
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    let home = daemon.home.clone();
    daemon.ends()?;
    let left = leftovers::of(&home);
    ensure!(left.is_empty(), "{left:#?}");
    Ok(())
}

/// Waits for an event of this kind whose message has all of these words.
pub(crate) fn event(daemon: &Daemon, kind: &str, words: &[&str]) -> anyhow::Result<Value> {
    daemon.awaits_event(&format!("an event {kind} with {words:?}"), |event| {
        event["kind"] == kind
            && event["message"]
                .as_str()
                .is_some_and(|text| words.iter().all(|word| text.contains(word)))
    })
}

fn greet(robot: &mut Robot, name: &str) -> anyhow::Result<Value> {
    robot.says(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.awaits_subscriber("/greeter/name")?;
    robot.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": name}}))?;
    // roscpp may give whoever has just connected the latched one twice.
    let greets = format!("hi {name}");
    let heard = robot.hears(&greets, |heard| {
        heard["topic"] == "/greeter/greeting" && heard["msg"]["text"] == *greets
    })?;
    Ok(heard["msg"].clone())
}

const GREETER: (&str, &[&str]) = ("greeter_cpp", &["--node", "greeter", "--param", "word=hi"]);
const ADDER: (&str, &[&str]) = ("adder_py", &["--node", "adder.py"]);
const BURGLAR: (&str, &[&str]) = ("burglar_cpp", &["--node", "burglar"]);

pub fn what_cannot_be_removed_keeps_no_daemon_down() -> Verdict {
    let (setup, first) = settled("stray", &[ADDER])?;
    let mut robot = first.robot("adder_py?robot=r1")?;
    ensure!(robot.calls("/add_two", json!({"a": 1, "b": 1}))?["values"]["sum"] == 2);
    let stray = first.home.join("servants/x");
    first.is_killed()?;
    std::fs::write(&stray, "somebody's")?;
    let second = setup.start()?;
    let mut robot = second.robot("adder_py?robot=r1")?;
    ensure!(robot.calls("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    ensure!(second.servants_of("adder_py")?.len() == 1, "it is the same");
    event(&second, "servant-leftover", &["servants/x"])?;
    std::fs::remove_file(&stray)?;
    nothing_is_left(second)
}

pub fn a_killed_daemon_loses_nothing() -> Verdict {
    let (setup, first) = settled("killed", &[GREETER, ADDER, BURGLAR])?;
    let mut greeter = first.robot("greeter_cpp?robot=r1")?;
    let mut adder = first.robot("adder_py?robot=r1")?;
    let mut caller = first.robot("burglar_cpp?robot=r1")?;
    greeter.subscribes("/greeter/greeting")?;
    ensure!(greet(&mut greeter, "Ada")?["count"] == 1);
    let set = greeter.calls(
        "/rosapi/set_param",
        json!({"name": "/kept", "value": "[1, 2]"}),
    )?;
    ensure!(set["result"] == true, "{set}");
    ensure!(adder.calls("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    let services = ["greeter_cpp", "adder_py", "burglar_cpp"];
    let of = |daemon: &Daemon, service: &str| -> anyhow::Result<(Value, Value)> {
        let servant = daemon.servant_of(service, "r1")?;
        Ok((servant["id"].clone(), servant["pids"].clone()))
    };
    let before: Vec<_> = services
        .iter()
        .map(|service| of(&first, service))
        .collect::<Result<_, _>>()?;
    // Traffic, and a call that its node is still at.
    let url = first.url("greeter_cpp?robot=r1");
    let (flowing, flows) = std::sync::mpsc::channel();
    let traffic = std::thread::spawn(move || {
        let Ok(mut robot) = Robot::connect(&url) else {
            return 0;
        };
        let _ =
            robot.says(json!({"op": "advertise", "topic": "/noise", "type": "std_msgs/String"}));
        let mut sent = 0;
        while robot
            .says(json!({"op": "publish", "topic": "/noise", "msg": {"data": "x"}}))
            .is_ok()
        {
            sent += 1;
            let _ = flowing.send(());
        }
        sent
    });
    caller.says(json!({
        "op": "call_service", "id": "flying", "service": "/burglar/try",
        "args": {"what": "wait", "argument": "600000"},
    }))?;
    ensure!(
        tries(&mut caller, "write", "/tmp/called yes")?.succeeded,
        "another is answered meanwhile"
    );
    patience::receive(&flows).context("no traffic")?;
    first.is_killed()?;
    ensure!(
        traffic.join().is_ok_and(|sent| sent > 0),
        "there was traffic"
    );
    // The call is not answered: its connection ends.
    ensure!(
        caller
            .hears("an answer", |value| value["id"] == "flying")
            .is_err()
    );

    let second = setup.start()?;
    for (service, before) in services.iter().zip(&before) {
        ensure!(
            of(&second, service)? == *before,
            "{service} has another servant"
        );
        event(&second, "servant-adopted", &[service])?;
    }
    let mut greeter = second.robot("greeter_cpp?robot=r1")?;
    greeter.subscribes("/greeter/greeting")?;
    ensure!(
        greeter.hears_on("/greeter/greeting")?["text"] == "hi Ada",
        "what was latched comes again"
    );
    ensure!(
        greet(&mut greeter, "Bea")?["count"] == 2,
        "the node has counted on"
    );
    let kept = greeter.calls("/rosapi/get_param", json!({"name": "/kept"}))?;
    ensure!(
        kept["values"]["value"] == "[1,2]" || kept["values"]["value"] == "[1, 2]",
        "{kept}"
    );
    let mut adder = second.robot("adder_py?robot=r1")?;
    ensure!(adder.calls("/add_two", json!({"a": 20, "b": 22}))?["values"]["sum"] == 42);
    let mut caller = second.robot("burglar_cpp?robot=r1")?;
    ensure!(
        tries(&mut caller, "text-in-file", "/tmp/called yes")?.succeeded,
        "its scratch is as it was"
    );
    nothing_is_left(second)
}

pub fn a_daemon_that_is_ended_says_why_and_keeps_its_servants() -> Verdict {
    let (setup, first) = settled("ended", &[BURGLAR])?;
    let mut robot = first.robot("burglar_cpp?robot=r1")?;
    tries(&mut robot, "write", "/tmp/x y")?;
    let pids = first.servant_of("burglar_cpp", "r1")?["pids"].clone();
    robot.says(json!({
        "op": "call_service", "id": "flying", "service": "/burglar/try",
        "args": {"what": "wait", "argument": "600000"},
    }))?;
    tries(&mut robot, "write", "/tmp/x y")?;
    first.ends()?;
    // Failed with a reason, or the connection closed with one.
    match robot.hears("an answer", |value| value["id"] == "flying") {
        Ok(answer) => ensure!(
            answer["result"] == false && answer["values"].to_string().len() > 4,
            "{answer}"
        ),
        Err(error) => ensure!(format!("{error:#}").contains("connect again"), "{error:#}"),
    }
    let second = setup.start()?;
    let servant = second.servant_of("burglar_cpp", "r1")?;
    ensure!(servant["pids"] == pids, "{servant:#}");
    nothing_is_left(second)
}

/// The parent of a process.
fn parent(pid: i32) -> anyhow::Result<i32> {
    let status = procfs::status(pid).context("a process")?;
    Ok(status.get("PPid").context("PPid")?.parse()?)
}

pub fn a_killed_init_and_a_killed_shim_are_told() -> Verdict {
    let (_, daemon) = settled("orphans", &[GREETER])?;
    for (which, words) in [
        ("init", "its init was killed by signal 9"),
        ("shim", "its shim was killed"),
    ] {
        let path = format!("greeter_cpp?robot={which}");
        let mut robot = daemon.robot(&path)?;
        robot.says(json!({"op": "set_level", "level": "warning"}))?;
        robot.calls("/rosapi/get_time", json!({}))?;
        let servant = daemon.servant_of("greeter_cpp", which)?;
        let node = servant["pids"][0].as_i64().context("a pid")? as i32;
        let init = parent(node)?;
        let victim = if which == "init" { init } else { parent(init)? };
        kill(Pid::from_raw(victim), Signal::SIGKILL)?;
        robot.hears_status("servant")?;
        event(
            &daemon,
            "servant-failed",
            &[servant["id"].as_str().context("an id")?, words],
        )?;
        support::until(&format!("the end of a node after its {which}'s"), || {
            let runs = Path::new(&format!("/proc/{node}")).exists();
            Ok(if runs {
                Err("it runs".to_owned())
            } else {
                Ok(())
            })
        })?;
        // The robot comes again, and is given another.
        let mut robot = daemon.robot(&path)?;
        ensure!(robot.calls("/greeter/count", json!({"reset": false}))?["values"]["count"] == 0);
    }
    nothing_is_left(daemon)
}

pub fn nodes_end_as_ros_users_know_it() -> Verdict {
    let (_, daemon) = settled("ends", &[("burglar_cpp", &["--launch", "ends.launch"])])?;
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    let id = daemon.servant_of("burglar_cpp", "r1")?["id"]
        .as_str()
        .context("an id")?
        .to_owned();
    let mut end = |node: &str, how: &str| -> anyhow::Result<()> {
        let answer = robot.calls(
            &format!("/{node}/try"),
            json!({"what": "end", "argument": how}),
        )?;
        ensure!(answer["result"] == true, "{answer}");
        Ok(())
    };
    // Whatever its status, a node that is to respawn does, after its delay.
    end("phoenix", "exit 0")?;
    respawned(&daemon, 1, "exited with status 0")?;
    end_again_once_it_is_back(&daemon, "phoenix", "signal 11")?;
    respawned(&daemon, 2, "was killed by SIGSEGV")?;
    // One that is not, does not, and the others work on.
    end("mortal", "exit 0")?;
    event(
        &daemon,
        "node-ended",
        &[&id, "/mortal", "exited with status 0"],
    )?;
    // `rosnode kill`: the node's own XML-RPC `shutdown`, asked for in its network namespace.
    rosnode_kills(&daemon, "phoenix")?;
    respawned(&daemon, 3, "exited with status 0")?;
    // A required one takes all with it.
    end("king", "exit 3")?;
    event(
        &daemon,
        "servant-failed",
        &[&id, "required node /king", "exited with status 3"],
    )?;
    nothing_is_left(daemon)
}

/// Waits until phoenix is told to have come again for the `time`th time, and why.
fn respawned(daemon: &Daemon, time: usize, how: &str) -> Verdict {
    let event = support::until(&format!("a {time}th event"), || {
        let told = respawns(daemon)?;
        let event = told.get(time - 1).cloned();
        Ok(event.ok_or_else(|| format!("{told:#?}")))
    })?;
    let words = format!("/phoenix {how} and is started again after 1 s");
    ensure!(event["message"].to_string().contains(&words), "{event:#}");
    Ok(())
}

fn respawns(daemon: &Daemon) -> anyhow::Result<Vec<Value>> {
    let events = daemon.api("/api/v1/events?limit=10000")?;
    let events = events.as_array().context("events")?.iter();
    let of = |event: &&Value| event["kind"] == "node-respawned";
    Ok(events.filter(of).cloned().collect())
}

/// Ends phoenix again when it is back, which it is not before its delay is over.
fn end_again_once_it_is_back(daemon: &Daemon, node: &str, how: &str) -> Verdict {
    let ended = respawns(daemon)?.last().context("its end")?["time"].clone();
    let deadline = Deadline::begin();
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    loop {
        let answer = robot.calls(
            &format!("/{node}/try"),
            json!({"what": "end", "argument": how}),
        )?;
        if answer["result"] == true {
            let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?;
            let away = now.as_millis() as u64 - ended.as_u64().context("a time")?;
            // The event is of when the daemon heard of the end, and the delay of a second counts from the end itself.
            ensure!(away >= 500, "{node} was back after {away} ms");
            return Ok(());
        }
        deadline.check(|| format!("{node} did not come back: {answer}"))?;
    }
}

/// What `rosnode kill` does, by Python's own XML-RPC.
fn rosnode_kills(daemon: &Daemon, node: &str) -> Verdict {
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
    run(Command::new("nsenter").args([
        &format!("--net=/proc/{pid}/ns/net"),
        "python3",
        "-c",
        &script,
    ]))?
    .succeeded()?;
    Ok(())
}

/// What `status` warns of.
fn warnings(daemon: &Daemon) -> anyhow::Result<String> {
    Ok(daemon.deployer().asks(&["status"])?["warnings"].to_string())
}

/// Looks with another program than ours.
fn is_in_the_database(daemon: &Daemon, event: &Value) -> Verdict {
    let script = format!(
        "import sqlite3\nprint(*sqlite3.connect({:?}).execute('SELECT kind FROM events WHERE id = {}').fetchone())",
        daemon.home.join("cloudroid.db"),
        event["id"]
    );
    let found = run(Command::new("python3").args(["-c", &script]))?.succeeded()?;
    ensure!(
        Some(found.stdout.trim()) == event["kind"].as_str(),
        "{} is not {event}",
        found.stdout
    );
    Ok(())
}

pub fn a_locked_database_is_named_and_waited_for() -> Verdict {
    let (_, daemon) = settled("locked", &[GREETER])?;
    daemon
        .robot("greeter_cpp?robot=before")?
        .calls("/greeter/count", json!({}))?;
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
    // Who was here is let in, and what happens is told although it cannot be written.
    let mut before = daemon.robot("greeter_cpp?robot=before")?;
    before.calls("/greeter/count", json!({"reset": false}))?;
    let refused = Robot::try_connect(&daemon.url("greeter_cpp?robot=during"));
    let words = match refused {
        Err(refusal) => refusal.to_string(),
        Ok(mut robot) => format!("{:?}", robot.hears_close()?),
    };
    let unwritable = event(
        &daemon,
        "state-unwritable",
        &["another program has locked it", "cloudroid.db"],
    )?;
    ensure!(warnings(&daemon)?.contains("another program has locked it"));
    ensure!(daemon.get("/healthz")?.0 == 200);
    before.calls("/greeter/count", json!({"reset": false}))?;
    drop(locker.stdin.take());
    locker.wait()?;
    ensure!(words.contains("database"), "{words}");
    event(&daemon, "state-writable", &["can be written again"])?;
    ensure!(!warnings(&daemon)?.contains("another program has locked it"));
    is_in_the_database(&daemon, &unwritable)?;
    let mut robot = daemon.robot("greeter_cpp?robot=after")?;
    ensure!(robot.calls("/greeter/count", json!({"reset": false}))?["result"] == true);
    drop(robot);
    nothing_is_left(daemon)
}

pub fn a_full_disk_is_named_and_robots_at_work_stay() -> Verdict {
    let disk = SmallDisk::mount("full", "1500M")?;
    let daemon = Setup::new(&disk.home()).start()?;
    daemon
        .deployer()
        .pushes(GREETER.0, GREETER.1)?
        .succeeded()?;
    let mut early = daemon.robot("greeter_cpp?robot=early")?;
    ensure!(early.calls("/greeter/count", json!({"reset": false}))?["result"] == true);
    disk.fill()?;
    let words = match Robot::try_connect(&daemon.url("greeter_cpp?robot=late")) {
        Err(refusal) => refusal.to_string(),
        Ok(mut robot) => format!("{:?}", robot.hears_close()?),
    };
    ensure!(words.contains("space") || words.contains("full"), "{words}");
    ensure!(
        early.calls("/greeter/count", json!({"reset": false}))?["result"] == true,
        "at work"
    );
    // Who was here is let in again.
    early.leaves()?;
    let mut early = daemon.robot("greeter_cpp?robot=early")?;
    ensure!(early.calls("/greeter/count", json!({"reset": false}))?["result"] == true);
    let unwritable = event(&daemon, "state-unwritable", &["its disk is full"])?;
    ensure!(warnings(&daemon)?.contains("its disk is full"));
    ensure!(daemon.get("/healthz")?.0 == 200);
    disk.make_room()?;
    event(&daemon, "state-writable", &["can be written again"])?;
    is_in_the_database(&daemon, &unwritable)?;
    let mut late = daemon.robot("greeter_cpp?robot=late")?;
    ensure!(late.calls("/greeter/count", json!({"reset": false}))?["result"] == true);
    drop((early, late));
    nothing_is_left(daemon)
}

pub fn what_a_full_disk_refuses_is_not_done() -> Verdict {
    let disk = SmallDisk::mount("refusing", "32M")?;
    let setup = Setup::new(&disk.home());
    let daemon = setup.start()?;
    let deployer = daemon.deployer();
    let create = |name| {
        [
            "token",
            "create",
            name,
            "--role",
            "viewer",
            "--service",
            "*",
        ]
    };
    deployer.types(&create("ada"))?.succeeded()?;
    disk.fill()?;
    // The secret of a token that is not kept would be worth nothing, and whoever revoked one would trust in it.
    for refused in [
        &create("eve")[..],
        &["token", "rotate", "ada"],
        &["token", "revoke", "ada"],
        &["policy", "allow", "ada", "call:/x"],
    ] {
        deployer.types(refused)?.failed_saying(&["full"])?;
    }
    disk.make_room()?;
    event(&daemon, "state-writable", &["can be written again"])?;
    daemon.ends()?;
    let daemon = setup.start()?;
    let live = |daemon: &Daemon| -> anyhow::Result<Vec<String>> {
        let tokens = daemon.deployer().asks(&["token", "list"])?;
        let tokens = tokens.as_array().context("a list")?.iter();
        let live = tokens.filter(|token| token["revoked"].is_null());
        Ok(live.map(|token| token["name"].to_string()).collect())
    };
    ensure!(live(&daemon)? == ["\"ada\""], "{:?}", live(&daemon)?);
    let rules = daemon.deployer().asks(&["policy", "list"])?.to_string();
    ensure!(!rules.contains("ada"), "{rules}");
    daemon
        .deployer()
        .types(&["token", "revoke", "ada"])?
        .succeeded()?;
    ensure!(live(&daemon)?.is_empty());
    nothing_is_left(daemon)
}
