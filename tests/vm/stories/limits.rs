//! Limits that the kernel enforces, and how they are reported.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::burglar::try_attempt;
use support::daemon::Daemon;
use support::patience::Deadline;

use crate::machine::{SERVANTS, daemon, read_control_file};

/// Returns the id of a robot's servant.
fn servant_id(daemon: &Daemon, service: &str, robot: &str) -> anyhow::Result<String> {
    let servant = daemon.servant_of(service, robot)?;
    Ok(servant["id"].as_str().context("an id")?.to_owned())
}

fn set_limits(daemon: &Daemon, id: &str, flags: &[&str]) -> anyhow::Result<Value> {
    daemon.deployer().run_json(&[&["set", id], flags].concat())
}

pub fn limits_are_in_the_kernels_own_files() -> Verdict {
    let daemon = daemon()?;
    let mut robot = daemon.robot("small?robot=limited")?;
    robot.call("/rosapi/get_time", json!({}))?;
    let servant = daemon.servant_of("small", "limited")?;
    let id = servant["id"].as_str().context("an id")?;
    ensure!(servant["cgroup_version"] == 2, "{servant:#}");
    ensure!(read_control_file(id, "cpu.max")? == "50000 100000");
    ensure!(read_control_file(id, "cpu.weight")? == "500", "as much as is promised");
    ensure!(read_control_file(id, "memory.max")? == (96 << 20).to_string());
    ensure!(read_control_file(id, "memory.swap.max")? == "0");
    ensure!(read_control_file(id, "memory.oom.group")? == "1");
    ensure!(read_control_file(id, "pids.max")? == servant["enforced"]["pids"].to_string());
    // All limits at once, while it works.
    let changed = set_limits(
        &daemon,
        id,
        &[
            "--cpus",
            "0.75",
            "--memory",
            "128M",
            "--memory-high",
            "100M",
            "--pids",
            "99",
            "--io-read",
            "5M",
            "--io-write",
            "3M",
            "--cpuset",
            "1",
            "--cpu-weight",
            "300",
        ],
    )?;
    ensure!(read_control_file(id, "cpu.max")? == "75000 100000");
    ensure!(read_control_file(id, "cpu.weight")? == "300");
    ensure!(read_control_file(id, "memory.max")? == (128 << 20).to_string());
    ensure!(read_control_file(id, "memory.high")? == (100 << 20).to_string());
    ensure!(read_control_file(id, "pids.max")? == "99");
    ensure!(read_control_file(id, "cpuset.cpus")? == "1");
    let io = read_control_file(id, "io.max")?;
    ensure!(io.contains("rbps=5242880 wbps=3145728"), "{io}");
    ensure!(
        changed["enforced"]
            == json!({
                "cpus": 0.75, "cpu_weight": 300, "memory": 128 << 20, "memory_high": 100 << 20, "pids": 99,
                "io_read": 5 << 20, "io_write": 3 << 20, "cpuset": "1",
            }),
        "{changed:#}"
    );
    robot.call("/rosapi/get_time", json!({}))?;
    daemon.deployer().run(&["stop", id])?.expect_success()?;
    Ok(())
}

pub fn cores_are_shared_out_as_asked() -> Verdict {
    let daemon = daemon()?;
    let mut robot = daemon.robot("burglar_cpp?robot=burner")?;
    try_attempt(&mut robot, "burn", "2")?;
    let id = servant_id(&daemon, "burglar_cpp", "burner")?;
    let used = || anyhow::Ok(read_processor_time(&id)? / 1e6);
    let mut told = Vec::new();
    for cores in [0.2, 0.5, 1.5] {
        set_limits(&daemon, &id, &["--cpus", &cores.to_string()])?;
        // Usage and time are read one after the other, and a busy host may delay the second read: the share lies
        // between the usage divided by the longest and by the shortest time that may have passed.
        let look = || Ok::<_, anyhow::Error>((Instant::now(), used()?, Instant::now()));
        let began = look()?;
        // A share of time can only be measured over some time.
        std::thread::sleep(Duration::from_secs(4));
        let ended = look()?;
        let spent = ended.1 - began.1;
        let least = spent / (ended.2 - began.0).as_secs_f64();
        let most = spent / (ended.0 - began.2).as_secs_f64();
        told.push(format!("{:.0} % asked, {:.1} % got", cores * 100.0, least * 100.0));
        let allowed = 0.02 + cores * 0.1;
        ensure!(least <= cores + allowed && most >= cores - allowed, "{told:?}");
    }
    println!("        {}", told.join("; "));
    let servant = daemon.servant_of("burglar_cpp", "burner")?;
    ensure!(servant["usage"]["throttled_usec"].as_u64() > Some(100_000), "{servant:#}");
    ensure!(servant["usage"]["pressure"]["cpu"].as_f64() > Some(1.0), "{servant:#}");
    let (_, metrics) = daemon.get("/metrics")?;
    for name in ["throttled_seconds_total", "pressure_ratio"] {
        ensure!(metrics.contains(&format!("cloudroid_servant_{name}{{servant=\"{id}\"")), "{metrics}");
    }
    try_attempt(&mut robot, "rest", "")?;
    Ok(())
}

/// Returns the processor time that a servant has used, in microseconds.
fn read_processor_time(id: &str) -> anyhow::Result<f64> {
    let text = read_control_file(id, "cpu.stat")?;
    let used = text.lines().find_map(|line| line.strip_prefix("usage_usec "));
    Ok(used.context("usage_usec")?.parse()?)
}

pub fn a_promised_servant_is_held_up_by_no_greedy_neighbours() -> Verdict {
    let daemon = daemon()?;
    let mut promised = daemon.robot("burglar_cpp?robot=burner")?;
    try_attempt(&mut promised, "rest", "")?;
    let id = servant_id(&daemon, "burglar_cpp", "burner")?;
    set_limits(&daemon, &id, &["--cpus", "1", "--cpu-weight", "100"])?;
    let mut neighbours = Vec::new();
    for number in 0..4 {
        neighbours.push(daemon.robot(&format!("burglar_cpp?robot=greedy{number}"))?);
    }
    // All start before the first one slows down the others.
    for neighbour in &mut neighbours {
        try_attempt(neighbour, "rest", "")?;
    }
    let mut ids = vec![id.clone()];
    for number in 0..neighbours.len() {
        ids.push(servant_id(&daemon, "burglar_cpp", &format!("greedy{number}"))?);
    }
    for neighbour in &mut neighbours {
        try_attempt(neighbour, "burn", "2")?;
    }
    try_attempt(&mut promised, "burn", "1")?;
    // Shares of the time that the servants used, so that it does not matter how much of it a busy host leaves to them.
    let measure_share = || -> anyhow::Result<f64> {
        let read_all = || ids.iter().map(|id| read_processor_time(id)).collect::<anyhow::Result<Vec<_>>>();
        let before = read_all()?;
        // A share of time can only be measured over some time.
        std::thread::sleep(Duration::from_secs(4));
        let used: Vec<f64> = read_all()?.iter().zip(&before).map(|(after, before)| after - before).collect();
        Ok(used[0] / used.iter().sum::<f64>())
    };
    let without = measure_share()?;
    // The promise is effective as long as its weight is not lowered.
    set_limits(&daemon, &id, &["--cpu-weight", "1000"])?;
    let with = measure_share()?;
    println!("        share of two cores, beside 8 greedy threads: {without:.2} without a promise, {with:.2} with one");
    for robot in neighbours.iter_mut().chain([&mut promised]) {
        try_attempt(robot, "rest", "")?;
    }
    ensure!(without < 0.3, "the neighbours are not greedy: {without}");
    // Half of the machine is the most that a servant with one core can have.
    ensure!(with > 0.35 && with > without * 1.4, "{with} with a promise, {without} without one");
    daemon.deployer().run(&["stop", "--service", "burglar_cpp"])?.expect_success()?;
    Ok(())
}

pub fn who_takes_too_much_memory_is_told_so() -> Verdict {
    let daemon = daemon()?;
    let mut robot = daemon.robot("small?robot=hungry")?;
    robot.send(json!({"op": "set_level", "level": "warning"}))?;
    robot
        .send(json!({"op": "call_service", "service": "/burglar/try", "args": {"what": "take", "argument": "400"}}))?;
    let status = robot.wait_for_status("memory")?;
    ensure!(status["msg"].as_str().is_some_and(|text| text.contains("96M")), "the limit is named: {status}");
    let events = daemon.deployer().run_json(&["events"])?;
    let told = events.as_array().context("events")?.iter().any(|event| {
        event["kind"] == "out-of-memory" && event["message"].as_str().is_some_and(|text| text.contains("96M"))
    });
    ensure!(told, "{events:#}");
    Ok(())
}

pub fn a_fork_bomb_ends_when_its_servant_does() -> Verdict {
    let daemon = daemon()?;
    let mut robot = daemon.robot("small?robot=bomber")?;
    robot.call("/rosapi/get_time", json!({}))?;
    let id = servant_id(&daemon, "small", "bomber")?;
    set_limits(&daemon, &id, &["--pids", "100"])?;
    try_attempt(&mut robot, "bomb", "")?;
    let deadline = Deadline::begin();
    while read_control_file(&id, "pids.current")?.parse::<u64>()? < 95 && !deadline.is_over() {
        std::thread::yield_now();
    }
    ensure!(read_control_file(&id, "pids.current")?.parse::<u64>()? <= 100, "the limit holds");
    // Other servants are not affected.
    daemon.robot("greeter_cpp?robot=calm")?.call("/greeter/count", json!({}))?;
    daemon.deployer().run(&["stop", &id])?.expect_success()?;
    ensure!(!Path::new(SERVANTS).join(&id).exists(), "its cgroup is gone");
    Ok(())
}
