//! Isolation of untrusted code.

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::world::{ADDER, GREETER, PEOPLE, StoryService, world};
use support::{Verdict, procfs};

/// Returns the host pids of a robot's nodes.
fn node_pids(daemon: &Daemon, service: &str, robot: &str) -> anyhow::Result<Vec<i32>> {
    let servant = daemon.servant_of(service, robot)?;
    let pids: Vec<i32> =
        servant["pids"].as_array().context("pids")?.iter().filter_map(|pid| Some(pid.as_i64()? as i32)).collect();
    ensure!(!pids.is_empty(), "a ready servant has node processes: {servant:#}");
    Ok(pids)
}

pub fn every_node_process_is_confined() -> Verdict {
    for service in [PEOPLE, GREETER, ADDER] {
        let daemon = world().daemon_with(service)?;
        let _robot = daemon.robot(&format!("{}?robot=confined", service.name))?.call("/rosapi/get_time", json!({}))?;
        for pid in node_pids(&daemon, service.name, "confined")? {
            let status = procfs::status(pid).with_context(|| format!("process {pid}"))?;
            let field = |name: &str| status.get(name).map_or("missing", String::as_str);
            let who = format!("{} ({pid}) of {}", field("Name"), service.name);
            ensure!(field("Seccomp") == "2", "{who}: Seccomp {}", field("Seccomp"));
            ensure!(field("NoNewPrivs") == "1", "{who}: NoNewPrivs {}", field("NoNewPrivs"));
            for set in ["CapEff", "CapPrm", "CapInh", "CapBnd", "CapAmb"] {
                ensure!(field(set) == "0000000000000000", "{who}: {set} {}", field(set));
            }
            let map = std::fs::read_to_string(format!("/proc/{pid}/uid_map"))?;
            let numbers: Vec<u64> = map.split_whitespace().filter_map(|number| number.parse().ok()).collect();
            ensure!(matches!(numbers[..], [0, first, 65536] if first >= 65536), "{who}: uid_map {map}");
            for kind in ["user", "mnt", "pid", "net", "ipc", "uts", "cgroup"] {
                let (theirs, ours) = (procfs::namespace(pid, kind), procfs::namespace(std::process::id() as i32, kind));
                ensure!(theirs.is_some() && theirs != ours, "{who} shares our {kind} namespace");
            }
        }
    }
    Ok(())
}

pub fn nothing_of_ours_but_init_runs_inside() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let _answer = daemon.robot("opencv_apps?robot=counted")?.call("/rosapi/get_time", json!({}))?;
    let node = node_pids(&daemon, "opencv_apps", "counted")?[0];
    let inside = procfs::namespace(node, "pid").context("the node's pid namespace")?;
    let mut commands: Vec<String> = procfs::pids()
        .into_iter()
        .filter(|pid| procfs::namespace(*pid, "pid").as_ref() == Some(&inside))
        .filter_map(procfs::command_line)
        .collect();
    commands.sort();
    ensure!(commands.len() == 2, "init and one node: {commands:#?}");
    ensure!(commands.iter().any(|command| command.contains("init")), "{commands:#?}");
    ensure!(commands.iter().any(|command| command.contains("/usr/lib/opencv_apps/people_detect")), "{commands:#?}");
    for word in ["roscore", "rosmaster", "rosbridge"] {
        ensure!(!commands.iter().any(|command| command.contains(word)), "{word} runs inside: {commands:#?}");
    }
    Ok(())
}

/// Waits until all requested limits are in force: while another robot waits too long, the controller gives it cores of
/// robots that have not stated a response time.
fn wait_for_limits(daemon: &Daemon, robot: &str) -> anyhow::Result<Value> {
    support::wait_until(&format!("the limits of {robot}"), || {
        let servant = daemon.servant_of("greeter_cpp", robot)?;
        let is = |limit: &&str| servant["enforced"][limit] == servant["limits"][limit];
        let are_in_force = ["cpus", "memory", "pids"].iter().all(is);
        Ok(if are_in_force { Ok(servant) } else { Err(format!("{servant:#}")) })
    })
}

pub fn limits_are_set_and_read_back() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let _answer = daemon.robot("greeter_cpp?robot=limited")?.call("/rosapi/get_time", json!({}))?;
    let servant = wait_for_limits(&daemon, "limited")?;
    let version = servant["cgroup_version"].as_i64().context("the cgroup version is told")?;
    ensure!(version == 1 || version == 2, "this host has cgroup controllers: {servant:#}");
    for limit in ["cpus", "memory", "pids"] {
        ensure!(servant["enforced"][limit].is_number(), "{limit} is read back: {servant:#}");
    }
    // The kernel's own files contain the same values.
    let pid = node_pids(&daemon, "greeter_cpp", "limited")?[0];
    let groups = std::fs::read_to_string(format!("/proc/{pid}/cgroup"))?;
    let memory = if version == 1 {
        let path = groups.lines().find_map(|line| line.split_once(":memory:")).context("a memory cgroup")?.1;
        std::fs::read_to_string(format!("/sys/fs/cgroup/memory{path}/memory.limit_in_bytes"))?
    } else {
        let path = groups.lines().find_map(|line| line.strip_prefix("0::")).context("a cgroup")?;
        std::fs::read_to_string(format!("/sys/fs/cgroup{path}/memory.max"))?
    };
    ensure!(memory.trim().parse().ok() == servant["enforced"]["memory"].as_u64(), "{memory} against {servant:#}");
    Ok(())
}

pub fn limits_are_changed_while_it_works() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut robot = daemon.robot("greeter_cpp?robot=changed")?;
    robot.call("/rosapi/get_time", json!({}))?;
    let before = daemon.servant_of("greeter_cpp", "changed")?;
    let id = before["id"].as_str().context("an id")?;
    let deployer = daemon.deployer();
    let said = deployer.run(&["set", id, "--cpus", "0.5", "--memory", "256M"])?.expect_success()?;
    ensure!(said.stdout.contains("0.5 cpus, 256M"), "{}", said.stdout);
    let after = wait_for_limits(&daemon, "changed")?;
    ensure!(
        after["enforced"]["cpus"] == 0.5 && after["enforced"]["memory"] == 256 << 20,
        "the kernel took them: {after:#}"
    );
    ensure!(after["enforced"]["pids"] == before["enforced"]["pids"], "what was not named stays: {after:#}");
    let status = deployer.run_json(&["status"])?;
    ensure!(status["capacity"]["cpus_reserved"].as_f64() >= Some(0.5), "what it has is promised to it: {status:#}");
    ensure!(
        status["usage"]["memory"].as_u64() > Some(0) && status["usage"]["cpu_usec"].as_u64() > Some(0),
        "what servants use is told: {status:#}"
    );
    for (verb, words) in [
        (&["status"][..], ["used by servants", "throttled", "stalled (PSI)"]),
        (&["servants", "-o", "wide"], ["MEMORY", "THROTTLED", "PRESSURE"]),
    ] {
        let said = deployer.run(verb)?.expect_success()?.stdout;
        for word in words {
            ensure!(said.contains(word), "{verb:?} does not tell {word}: {said}");
        }
    }
    // The same nodes are still running.
    ensure!(after["pids"] == before["pids"]);
    ensure!(robot.call("/greeter/count", json!({"reset": false}))?["result"] == true);
    // The machine will never have so much: that is no matter of waiting.
    let beyond = deployer.run(&["set", id, "--memory", "900T"])?.expect_failure(&["does not fit on this machine"])?;
    ensure!(beyond.status == 6, "{beyond:#?}");
    deployer.run(&["set", id, "--cpus", "5000"])?.expect_failure(&["between 0.01 and 4096"])?;
    deployer.run(&["set", id])?.expect_failure(&["--cpus"])?;
    ensure!(wait_for_limits(&daemon, "changed")?["enforced"] == after["enforced"]);
    Ok(())
}

const HOG: StoryService =
    StoryService { name: "hog_py", package: Some("hog_py"), arguments: &["--node", "hog.py", "--memory", "128M"] };

pub fn a_node_that_takes_too_much_memory_is_killed_and_its_robot_told() -> Verdict {
    let daemon = world().daemon_with(HOG)?;
    let mut robot = daemon.robot("hog_py?robot=greedy")?;
    robot.send(json!({"op": "set_level", "level": "warning"}))?;
    robot.send(json!({"op": "advertise", "topic": "/take", "type": "std_msgs/UInt32"}))?;
    robot.wait_for_subscriber("/take")?;
    robot.send(json!({"op": "publish", "topic": "/take", "msg": {"data": 400}}))?;
    let status = robot.wait_for_status("memory")?;
    ensure!(status["msg"].as_str().is_some_and(|text| text.contains("128")), "the limit is named: {status}");
    Ok(())
}

pub fn two_robots_see_nothing_of_each_other() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let (mut anna, mut bert) = (daemon.robot("greeter_cpp?robot=anna")?, daemon.robot("greeter_cpp?robot=bert")?);
    for robot in [&mut anna, &mut bert] {
        robot.subscribe("/greeter/greeting")?;
        robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
        robot.wait_for_subscriber("/greeter/name")?;
    }
    anna.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Anna"}}))?;
    ensure!(anna.next_message_on("/greeter/greeting")?["text"] == "hi Anna");
    bert.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Bert"}}))?;
    let greeting = bert.next_message_on("/greeter/greeting")?;
    ensure!(greeting["text"] == "hi Bert" && greeting["count"] == 1, "Bert's node has greeted Bert alone: {greeting}");
    ensure!(anna.has_not_heard(|value| value["msg"]["text"] == "hi Bert")?, "Anna heard what was meant for Bert");
    let (first, second) = (daemon.servant_of("greeter_cpp", "anna")?, daemon.servant_of("greeter_cpp", "bert")?);
    ensure!(first["id"] != second["id"], "each has a servant of its own");
    let nets: Vec<_> = [&first, &second]
        .iter()
        .filter_map(|servant| procfs::namespace(servant["pids"][0].as_i64()? as i32, "net"))
        .collect();
    ensure!(nets.len() == 2 && nets[0] != nets[1], "{nets:?}");
    // Anna leaves and returns within the grace time: the same servant, with its state.
    anna.leave()?;
    let mut anna = daemon.robot("greeter_cpp?robot=anna")?;
    let answer = anna.call("/greeter/count", json!({"reset": false}))?;
    ensure!(answer["values"]["count"] == 1, "the servant remembers: {answer}");
    ensure!(daemon.servant_of("greeter_cpp", "anna")?["id"] == first["id"]);
    Ok(())
}
