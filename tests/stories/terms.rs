//! Robots get what they state, as enforced by the kernel.

use std::sync::Arc;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Bus, Graph, ParamValue, RosVersion, WireFormat};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::{Site, string_in};
use support::twins::Twin;
use support::world::{FIXTURE, GREETER, StoryService, world};

const MIB: u64 = 1 << 20;

/// Starts a daemon with classes, and pushes the greeter with a dictionary.
fn start_daemon(name: &str, twin: &Twin) -> anyhow::Result<Daemon> {
    let daemon = world()
        .setup(name)
        .config(
            "[capacity]\ncpus = 4.0\n[class.default]\nmax_cpus = 1.5\n\
             [class.urgent]\npriority = 10\nmax_cpus = 3.0\n",
        )
        .start()?;
    let deployer = daemon.deployer();
    let (service, package, executable) = twin.names();
    let push = [
        "--node",
        executable,
        "--param",
        "word=hi",
        "--cpus",
        "0.5",
        "--max-memory",
        "512M",
        "--rrt",
        "100ms",
        "--max-rrt",
        "300ms",
    ];
    deployer.push(package, &push)?.expect_success()?;
    for row in [
        ["--rrt", "200ms", "--cpus", "0.25", "--memory", "128M"],
        ["--rrt", "100ms", "--cpus", "0.75", "--memory", "192M"],
        ["--rrt", "50ms", "--cpus", "2", "--memory", "256M"],
    ] {
        let verb = ["sla", "set", service];
        deployer.run(&[&verb[..], &row[..]].concat())?.expect_success()?;
    }
    Ok(daemon)
}

/// Waits until a robot's servant has this number of cores. On a busy machine the controller may temporarily have given
/// it more, or less while another robot is late.
fn wait_for_cores(daemon: &Daemon, service: &str, robot: &str, cpus: f64) -> anyhow::Result<Value> {
    support::wait_until(&format!("{cpus} cores of {robot}"), || {
        let servant = daemon.servant_of(service, robot)?;
        let are_in_force = servant["enforced"]["cpus"] == cpus;
        Ok(if are_in_force { Ok(servant) } else { Err(format!("{servant:#}")) })
    })
}

/// Waits until a robot's servant has this number of cores and this memory in MiB.
fn wait_for_resources(
    daemon: &Daemon,
    service: &str,
    robot: &str,
    (cpus, memory): (f64, u64),
) -> anyhow::Result<Value> {
    let servant = wait_for_cores(daemon, service, robot, cpus)?;
    ensure!(servant["enforced"]["memory"] == memory * MIB, "{memory} MiB: {servant:#}");
    Ok(servant)
}

/// Returns the status and reason of a refused handshake.
fn refused_handshake(daemon: &Daemon, path: &str) -> anyhow::Result<(u16, Value)> {
    match Robot::try_connect(&daemon.url(path)) {
        Ok(_) => anyhow::bail!("{path} was let in"),
        Err(refusal) => {
            Ok((refusal.status, serde_json::from_str(&refusal.body).with_context(|| refusal.body.clone())?))
        }
    }
}

pub fn a_robot_is_given_what_its_sla_costs() -> Verdict {
    let daemon = start_daemon("terms", &Twin::greeter(RosVersion::One))?;
    let deployer = daemon.deployer();
    let listed = deployer.run(&["sla", "list", "greeter_cpp"])?.expect_success()?;
    for words in ["rrt 50ms", "2 cpus, 256M", "rrt 200ms"] {
        ensure!(listed.stdout.contains(words), "{}", listed.stdout);
    }
    // A robot that states nothing gets the push's limits; one that states an SLA gets those of its row.
    let mut plain = daemon.robot("greeter_cpp?robot=plain")?;
    plain.call("/rosapi/get_time", json!({}))?;
    wait_for_cores(&daemon, GREETER.name, "plain", 0.5)?;
    let mut robot = daemon.robot("greeter_cpp?robot=rover&rrt=100ms&max_rrt=300ms")?;
    robot.call("/rosapi/get_time", json!({}))?;
    // The limits of the row are in force.
    let before = wait_for_resources(&daemon, GREETER.name, "rover", (0.75, 192))?;
    ensure!(before["terms"]["rows"][0]["id"] == 2 && before["terms"]["class"] == "default", "it is shown: {before:#}");
    daemon.wait_for_event("what was stated", |event| {
        event["kind"] == "terms" && event["message"].as_str().is_some_and(|text| text.contains("rrt=100ms"))
    })?;
    // It reconnects and requests more, in a class that permits it: the same nodes with higher limits.
    let mut again = daemon.robot("greeter_cpp?robot=rover&rrt=50ms&class=urgent")?;
    again.call("/greeter/count", json!({"reset": false}))?;
    let after = wait_for_resources(&daemon, GREETER.name, "rover", (2.0, 256))?;
    ensure!(after["pids"] == before["pids"], "resized in place: {after:#}");
    ensure!(after["terms"]["priority"] == 10, "{after:#}");
    robot.call("/greeter/count", json!({"reset": false}))?;
    for (verb, words) in [
        (&["servants", "-o", "wide"][..], ["rrt=50ms", "entry 3"]),
        (&["explain", "rover"], ["rrt=50ms", "is the cheapest that reaches"]),
    ] {
        let said = deployer.run(verb)?.expect_success()?.stdout;
        for words in words {
            ensure!(said.contains(words), "{verb:?} does not tell {words}: {said}");
        }
    }
    // More than available, permitted or reachable: each request is refused with a remedy, and the robot keeps its
    // limits.
    for (query, status, words) in [
        ("rrt=50ms", 403, &["needs entry 3", "1.5, the max_cpus of class default", "rrt=100ms"][..]),
        ("class=urgent&cpus=2.9&memory=600M", 403, &["memory = 600M", "512M, the --max-memory", "memory=512M or less"]),
        ("rrt=1ms&class=urgent", 422, &["does not reach rrt 1ms", "entry 3", "request what fits: rrt=50ms"]),
        ("class=nope", 400, &["class = \"nope\"", "request an existing class"]),
        ("rrt=soon", 400, &["rrt = \"soon\" is not a time", "300ms"]),
        ("rtt=100ms", 400, &["rtt is not a key; write rrt"]),
    ] {
        let (got, problem) = refused_handshake(&daemon, &format!("greeter_cpp?robot=stranger&{query}"))?;
        let said = format!("{} {}", problem["detail"], problem["next"]).replace("\\\"", "\"");
        ensure!(got == status, "{query}: {got} {said}");
        for words in words {
            ensure!(said.contains(words), "{query}: {words:?} is missing: {said}");
        }
    }
    // A robot that has a servant gets a status message and keeps its limits.
    for (query, words) in [
        ("rrt=50ms", "the max_cpus of class default"),
        ("rrt=1ms&class=urgent", "request what fits: rrt=50ms"),
        ("class=nope", "not one of the configuration's classes"),
    ] {
        let mut rover = daemon.robot(&format!("greeter_cpp?robot=rover&{query}"))?;
        rover.wait_for_status(words)?;
        let code = u16::from(rover.wait_for_close()?.code);
        ensure!(code == 1008, "it will be refused again: {code}");
    }
    wait_for_resources(&daemon, GREETER.name, "rover", (2.0, 256))?;
    ensure!(daemon.servants_of("greeter_cpp")?.len() == 2, "strangers left nothing");
    // There are four cores.
    let mut greedy = daemon.robot("greeter_cpp?robot=plain&class=urgent&cpus=2.5")?;
    greedy.wait_for_status("request at most cpus=")?;
    let code = u16::from(greedy.wait_for_close()?.code);
    ensure!(code == 1013, "there may be room later: {code}");
    // Limits that a robot would get, without connecting one.
    let line = ["sla", "explain", "greeter_cpp", "--rrt", "150ms", "--max-rrt", "250ms"];
    let said = deployer.run(&line)?.expect_success()?.stdout;
    for words in [
        "gets 0.75 cpus, 192M",
        "entry 2 (rrt 100ms: cpus 0.75, memory 192M) is the cheapest that reaches rrt 150ms",
        "next better: entry 3",
        "next cheaper: entry 1",
        "is acceptable, but does not reach 150ms",
    ] {
        ensure!(said.contains(words), "{words:?} is missing: {said}");
    }
    let gone = deployer.run(&["sla", "rm", "greeter_cpp", "1", "2", "3"])?.expect_success()?;
    ensure!(gone.stdout.contains("is empty: every robot"), "{}", gone.stdout);
    deployer.run(&["sla", "rm", "greeter_cpp", "7"])?.expect_failure(&["no entry \"7\"", "sla list greeter_cpp"])?;
    Ok(())
}

/// Sets a parameter of the stub as robots of its ROS do: on the parameter server, or on the command line.
fn set_stub_parameter(
    site: &Site,
    app: &Arc<dyn Bus>,
    argv: &mut Vec<String>,
    key: &str,
    value: &ParamValue,
) -> Verdict {
    match app.parameters() {
        Ok(parameters) => {
            let name = format!("/greeter/cloudroid/{key}");
            site.runtime.block_on(parameters.set(&name, value.clone()))?;
        }
        Err(_) => {
            let value = match value {
                ParamValue::Double(number) => number.to_string(),
                ParamValue::String(text) => text.clone(),
                other => anyhow::bail!("{other:?}"),
            };
            argv.extend(["-p".to_owned(), format!("cloudroid.{key}:={value}")]);
        }
    }
    Ok(())
}

pub fn a_stub_states_what_its_robot_says_before_it_is_admitted(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let daemon = start_daemon(&twin.robot_name("terms-stub"), &twin)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let serves = |graph: &Graph| graph.services.contains_key("/greeter/count");
    // The same arguments are passed at the next start.
    let mut argv = twin.argv("greeter", &[]);
    let mut run = |state: &[(&str, ParamValue)], given: (f64, u64)| -> anyhow::Result<Value> {
        for (key, value) in state {
            set_stub_parameter(&site, &app, &mut argv, key, value)?;
        }
        let settings = "robot = \"linked\"\nlocal = \"none\"\n";
        let overlay = site.install_stub(&daemon, service, settings)?;
        let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
        let mut stub = site.start_installed(&overlay, package, executable, &argv)?;
        let there = site.wait_for_graph(&app, "the service", serves);
        there.with_context(|| format!("the stub said:\n{}", stub.output()))?;
        let servant = wait_for_resources(&daemon, service, "linked", given)?;
        stub.signal(Signal::SIGINT)?;
        stub.wait_for_exit()?;
        site.wait_for_graph(&app, "its end", |graph| !serves(graph))?;
        Ok(servant)
    };
    // The robot states nothing, so the terms of the push apply to its stubs.
    let first = run(&[], (0.75, 192))?;
    ensure!(first["terms"]["stated"]["/greeter"]["sla"] == json!({"rrt": "100ms", "max_rrt": "300ms"}), "{first:#}");
    // It states other terms by parameters and is restarted: the same servant, resized.
    let times = [
        ("desire", ParamValue::Double(0.05)),
        ("max", ParamValue::Double(0.2)),
        ("class", ParamValue::String("urgent".into())),
    ];
    let second = run(&times, (2.0, 256))?;
    ensure!(second["id"] == first["id"], "{second:#}");
    // Explicit limits take precedence.
    let direct = [("cpus", ParamValue::Double(1.25)), ("memory", ParamValue::String("300M".into()))];
    run(&direct, (1.25, 300)).map(drop)
}

/// Starts a daemon with a service whose rows cost more for larger messages: half a core up to the first value of a
/// parameter, one and a half up to the second.
fn start_sized_service(name: &str, service: &StoryService, key: &str, sizes: [&str; 2]) -> anyhow::Result<Daemon> {
    let daemon = world().setup(name).config("[capacity]\ncpus = 4.0\n").start()?;
    let deployer = daemon.deployer();
    let package = service.package.context("a package")?;
    deployer.push(package, service.arguments)?.expect_success()?;
    for (cpus, size) in ["0.5", "1.5"].into_iter().zip(sizes) {
        let aux = format!("{key}={size}");
        let row = ["--rrt", "100ms", "--cpus", cpus, "--aux", &aux];
        let verb = ["sla", "set", service.name];
        deployer.run(&[&verb[..], &row[..]].concat())?.expect_success()?;
    }
    Ok(daemon)
}

/// Waits until a servant was resized for messages of this size.
fn wait_for_resize(daemon: &Daemon, size: &str) -> anyhow::Result<()> {
    let words = format!("sends messages of aux.{size}");
    daemon.wait_for_event(&words, |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == "terms-changed" && message.contains(&words)
    })?;
    Ok(())
}

pub fn a_robot_that_says_nothing_of_its_pictures_pays_for_those_that_it_sends() -> Verdict {
    let daemon = start_sized_service("measured", &FIXTURE, "width", ["320", "1280"])?;
    let has = |cpus: f64| wait_for_cores(&daemon, FIXTURE.name, "seer", cpus);
    let mut robot = daemon.robot(&format!("{}?robot=seer&rrt=100ms", FIXTURE.name))?;
    robot.call("/rosapi/get_time", json!({}))?;
    has(1.5).context("nobody knows yet how large they are")?;
    robot.send(json!({"op": "advertise", "topic": "/camera", "type": "sensor_msgs/Image"}))?;
    let mut shows = |width: u32| {
        let picture = json!({"width": width, "height": 240, "encoding": "mono8", "data": ""});
        robot.send(json!({"op": "publish", "topic": "/camera", "msg": picture}))
    };
    for _ in 0..10 {
        shows(320)?;
    }
    wait_for_resize(&daemon, "width=320")?;
    has(0.5)?;
    shows(640)?;
    wait_for_resize(&daemon, "width=640")?;
    has(1.5)?;
    // For larger messages there is no row, so it keeps its limits.
    shows(1920)?;
    daemon.wait_for_event("what cannot be had", |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == "terms-refused" && message.contains("aux.width=1920")
    })?;
    has(1.5)?;
    let deployer = daemon.deployer();
    let said = deployer.run(&["explain", "seer"])?.expect_success()?.stdout;
    ensure!(said.contains("aux.width=640"), "{said}");
    // Cost of a further robot that states this size.
    let fit = ["--format", "json", "fit", FIXTURE.name, "--rrt", "100ms", "--aux", "width=320"];
    let fit = deployer.run(&fit)?.expect_success()?.stdout;
    let fit: Value = serde_json::from_str(&fit)?;
    ensure!(fit["cpus"] == 0.5 && fit["expected"]["rrt"] == 0.1, "{fit}");
    Ok(())
}

pub fn what_a_stub_passes_on_is_measured_as_well(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let name = twin.robot_name("measured-stub");
    let daemon = start_sized_service(&name, &twin.service, "bytes", ["1000", "100000"])?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let mut argv = twin.argv("greeter", &[]);
    for (key, value) in [("desire", 0.1), ("max", 0.2)] {
        set_stub_parameter(&site, &app, &mut argv, key, &ParamValue::Double(value))?;
    }
    let settings = "robot = \"linked\"\nlocal = \"none\"\n";
    let overlay = site.install_stub(&daemon, service, settings)?;
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    let stub = site.start_installed(&overlay, package, executable, &argv)?;
    let serves = |graph: &Graph| graph.services.contains_key("/greeter/count");
    let there = site.wait_for_graph(&app, "the service", serves);
    there.with_context(|| format!("the stub said:\n{}", stub.output()))?;
    let has = |cpus: f64| wait_for_cores(&daemon, service, "linked", cpus);
    has(1.5)?;
    let names = site.advertise_strings(&app, "/greeter/name", false)?;
    site.wait_for_subscribers(&*names, 1)?;
    let says = |name: &str| {
        let name = string_in(WireFormat::for_version(ros), name);
        names.publish(name.clone());
        match ros {
            RosVersion::One => name.len(),
            // RTPS pads to multiples of four bytes.
            RosVersion::Two => name.len().next_multiple_of(4),
        }
    };
    let mut size = 0;
    for _ in 0..10 {
        size = says("ada");
    }
    wait_for_resize(&daemon, &format!("bytes={size}"))?;
    has(0.5)?;
    let size = says(&"a".repeat(5000));
    wait_for_resize(&daemon, &format!("bytes={size}"))?;
    has(1.5)?;
    Ok(())
}
