//! What robots state is what they get, as the kernel has it.

use std::sync::Arc;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Bus, Graph, ParamValue, RosVersion, WireFormat};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::{Site, string_of};
use support::twins::Twin;
use support::world::{FIXTURE, GREETER, Service, world};

const MIB: u64 = 1 << 20;

/// A daemon with classes, and the greeter with a dictionary.
fn daemon(name: &str, twin: &Twin) -> anyhow::Result<Daemon> {
    let daemon = world()
        .own(name)
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
    deployer.pushes(package, &push)?.succeeded()?;
    for row in [
        ["--rrt", "200ms", "--cpus", "0.25", "--memory", "128M"],
        ["--rrt", "100ms", "--cpus", "0.75", "--memory", "192M"],
        ["--rrt", "50ms", "--cpus", "2", "--memory", "256M"],
    ] {
        let verb = ["sla", "set", service];
        deployer
            .types(&[&verb[..], &row[..]].concat())?
            .succeeded()?;
    }
    Ok(daemon)
}

/// Waits until these cores are in force for a robot's servant. Where this machine is busy the controller may have given it more,
/// or less while another is late, and takes that back.
fn has_cores(daemon: &Daemon, service: &str, robot: &str, cpus: f64) -> anyhow::Result<Value> {
    support::until(&format!("{cpus} cores of {robot}"), || {
        let servant = daemon.servant_of(service, robot)?;
        let are_in_force = servant["enforced"]["cpus"] == cpus;
        Ok(if are_in_force {
            Ok(servant)
        } else {
            Err(format!("{servant:#}"))
        })
    })
}

/// The same of cores and MiB.
fn has(
    daemon: &Daemon,
    service: &str,
    robot: &str,
    (cpus, memory): (f64, u64),
) -> anyhow::Result<Value> {
    let servant = has_cores(daemon, service, robot, cpus)?;
    ensure!(
        servant["enforced"]["memory"] == memory * MIB,
        "{memory} MiB: {servant:#}"
    );
    Ok(servant)
}

/// Why a handshake is refused.
fn refusal(daemon: &Daemon, path: &str) -> anyhow::Result<(u16, Value)> {
    match Robot::try_connect(&daemon.url(path)) {
        Ok(_) => anyhow::bail!("{path} was let in"),
        Err(refusal) => Ok((
            refusal.status,
            serde_json::from_str(&refusal.body).with_context(|| refusal.body.clone())?,
        )),
    }
}

pub fn a_robot_is_given_what_its_sla_costs() -> Verdict {
    let daemon = daemon("terms", &Twin::greeter(RosVersion::One))?;
    let deployer = daemon.deployer();
    let listed = deployer
        .types(&["sla", "list", "greeter_cpp"])?
        .succeeded()?;
    for words in ["rrt 50ms", "2 cpus, 256M", "rrt 200ms"] {
        ensure!(listed.stdout.contains(words), "{}", listed.stdout);
    }
    // Who states nothing gets what the push says; who states an SLA what its row says.
    let mut plain = daemon.robot("greeter_cpp?robot=plain")?;
    plain.calls("/rosapi/get_time", json!({}))?;
    has_cores(&daemon, GREETER.name, "plain", 0.5)?;
    let mut robot = daemon.robot("greeter_cpp?robot=rover&rrt=100ms&max_rrt=300ms")?;
    robot.calls("/rosapi/get_time", json!({}))?;
    // What the row says is in force.
    let before = has(&daemon, GREETER.name, "rover", (0.75, 192))?;
    ensure!(
        before["terms"]["rows"][0]["id"] == 2 && before["terms"]["class"] == "default",
        "it is shown: {before:#}"
    );
    daemon.awaits_event("what was stated", |event| {
        event["kind"] == "terms"
            && event["message"]
                .as_str()
                .is_some_and(|text| text.contains("rrt=100ms"))
    })?;
    // It connects again and wishes for more, in a class that may have it: the same nodes, with more.
    let mut again = daemon.robot("greeter_cpp?robot=rover&rrt=50ms&class=urgent")?;
    again.calls("/greeter/count", json!({"reset": false}))?;
    let after = has(&daemon, GREETER.name, "rover", (2.0, 256))?;
    ensure!(
        after["pids"] == before["pids"],
        "resized in place: {after:#}"
    );
    ensure!(after["terms"]["priority"] == 10, "{after:#}");
    robot.calls("/greeter/count", json!({"reset": false}))?;
    for (verb, words) in [
        (&["servants"][..], ["rrt=50ms", "row 3"]),
        (
            &["explain", "rover"],
            ["rrt=50ms", "is the cheapest that reaches"],
        ),
    ] {
        let said = deployer.types(verb)?.succeeded()?.stdout;
        for words in words {
            ensure!(
                said.contains(words),
                "{verb:?} does not tell {words}: {said}"
            );
        }
    }
    // More than there is, than is allowed, or than can be reached: each is told what to do, and it keeps what it has.
    for (query, status, words) in [
        (
            "rrt=50ms",
            403,
            &[
                "needs row 3",
                "1.5, the max_cpus of class default",
                "rrt=100ms",
            ][..],
        ),
        (
            "class=urgent&cpus=2.9&memory=600M",
            403,
            &[
                "memory = 600M",
                "512M, the --max-memory",
                "memory=512M or less",
            ],
        ),
        (
            "rrt=1ms&class=urgent",
            422,
            &[
                "does not reach rrt 1ms",
                "row 3",
                "state what fits: rrt=50ms",
            ],
        ),
        (
            "class=nope",
            400,
            &["class = \"nope\"", "state one that exists"],
        ),
        ("rrt=soon", 400, &["rrt = \"soon\" is not a time", "300ms"]),
        ("rtt=100ms", 400, &["rtt is not a key; write rrt"]),
    ] {
        let (got, problem) = refusal(&daemon, &format!("greeter_cpp?robot=stranger&{query}"))?;
        let said = format!("{} {}", problem["detail"], problem["next"]).replace("\\\"", "\"");
        ensure!(got == status, "{query}: {got} {said}");
        for words in words {
            ensure!(
                said.contains(words),
                "{query}: {words:?} is missing: {said}"
            );
        }
    }
    // Who has a servant is told by a status message, and keeps it as it is.
    for (query, words) in [
        ("rrt=50ms", "the max_cpus of class default"),
        ("rrt=1ms&class=urgent", "state what fits: rrt=50ms"),
        ("class=nope", "not one of the configuration's classes"),
    ] {
        let mut rover = daemon.robot(&format!("greeter_cpp?robot=rover&{query}"))?;
        rover.hears_status(words)?;
        let code = u16::from(rover.hears_close()?.code);
        ensure!(code == 1008, "it will be refused again: {code}");
    }
    has(&daemon, GREETER.name, "rover", (2.0, 256))?;
    ensure!(
        daemon.servants_of("greeter_cpp")?.len() == 2,
        "strangers left nothing"
    );
    // There are four cores.
    let mut greedy = daemon.robot("greeter_cpp?robot=plain&class=urgent&cpus=2.5")?;
    greedy.hears_status("state what fits: cpus=")?;
    let code = u16::from(greedy.hears_close()?.code);
    ensure!(code == 1013, "there may be room later: {code}");
    // What a robot would get, without being one.
    let line = [
        "sla",
        "explain",
        "greeter_cpp",
        "--rrt",
        "150ms",
        "--max-rrt",
        "250ms",
    ];
    let said = deployer.types(&line)?.succeeded()?.stdout;
    for words in [
        "is promised 0.75 cpus, 192M",
        "row 2 (rrt 100ms: cpus 0.75, memory 192M) is the cheapest that reaches rrt 150ms",
        "next better: row 3",
        "next cheaper: row 1",
        "is acceptable, but does not reach 150ms",
    ] {
        ensure!(said.contains(words), "{words:?} is missing: {said}");
    }
    let gone = deployer
        .types(&["sla", "rm", "greeter_cpp", "1", "2", "3"])?
        .succeeded()?;
    ensure!(gone.stdout.contains("has no rows"), "{}", gone.stdout);
    deployer
        .types(&["sla", "rm", "greeter_cpp", "7"])?
        .failed_saying(&["no row \"7\"", "sla list greeter_cpp"])?;
    Ok(())
}

/// Says a setting of the stub as robots of its ROS do: on the parameter server, or in the command line.
fn says_setting(
    site: &Site,
    app: &Arc<dyn Bus>,
    argv: &mut Vec<String>,
    key: &str,
    value: &ParamValue,
) -> Verdict {
    match app.parameters() {
        Ok(parameters) => {
            let name = format!("/greeter/cloudroid/{key}");
            site.runtime
                .block_on(parameters.set(&name, value.clone()))?;
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
    let daemon = daemon(&twin.robot("terms-stub"), &twin)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let serves = |graph: &Graph| graph.services.contains_key("/greeter/count");
    // It goes on to say what it has said.
    let mut argv = twin.argv("greeter", &[]);
    let mut run = |state: &[(&str, ParamValue)], given: (f64, u64)| -> anyhow::Result<Value> {
        for (key, value) in state {
            says_setting(&site, &app, &mut argv, key, value)?;
        }
        let settings = "robot = \"linked\"\nlocal = \"none\"\n";
        let overlay = site.installs(&daemon, service, settings)?;
        let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
        let mut stub = site.runs(&overlay, package, executable, &argv)?;
        let there = site.until(&app, "the service", serves);
        there.with_context(|| format!("the stub said:\n{}", stub.said()))?;
        let servant = has(&daemon, service, "linked", given)?;
        stub.signal(Signal::SIGINT)?;
        stub.ends()?;
        site.until(&app, "its end", |graph| !serves(graph))?;
        Ok(servant)
    };
    // The robot says nothing: what the push says of its stubs.
    let first = run(&[], (0.75, 192))?;
    ensure!(
        first["terms"]["stated"]["/greeter"]["sla"] == json!({"rrt": "100ms", "max_rrt": "300ms"}),
        "{first:#}"
    );
    // It says something else by its parameters, and is started again: the same servant, resized.
    let times = [
        ("desire", ParamValue::Double(0.05)),
        ("max", ParamValue::Double(0.2)),
        ("class", ParamValue::String("urgent".into())),
    ];
    let second = run(&times, (2.0, 256))?;
    ensure!(second["id"] == first["id"], "{second:#}");
    // Resources outright come before.
    let direct = [
        ("cpus", ParamValue::Double(1.25)),
        ("memory", ParamValue::String("300M".into())),
    ];
    run(&direct, (1.25, 300)).map(drop)
}

/// A service whose rows cost more for what is larger: half a core up to the first value of a parameter, one and a half up to
/// the second.
fn sized(name: &str, service: &Service, key: &str, sizes: [&str; 2]) -> anyhow::Result<Daemon> {
    let daemon = world()
        .own(name)
        .config("[capacity]\ncpus = 4.0\n")
        .start()?;
    let deployer = daemon.deployer();
    let package = service.package.context("a package")?;
    deployer.pushes(package, service.arguments)?.succeeded()?;
    for (cpus, size) in ["0.5", "1.5"].into_iter().zip(sizes) {
        let aux = format!("{key}={size}");
        let row = ["--rrt", "100ms", "--cpus", cpus, "--aux", &aux];
        let verb = ["sla", "set", service.name];
        deployer
            .types(&[&verb[..], &row[..]].concat())?
            .succeeded()?;
    }
    Ok(daemon)
}

/// Waits until a servant was resized for messages of this size.
fn resized(daemon: &Daemon, size: &str) -> anyhow::Result<()> {
    let words = format!("sends messages of aux.{size}");
    daemon.awaits_event(&words, |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == "terms-changed" && message.contains(&words)
    })?;
    Ok(())
}

pub fn a_robot_that_says_nothing_of_its_pictures_pays_for_those_that_it_sends() -> Verdict {
    let daemon = sized("measured", &FIXTURE, "width", ["320", "1280"])?;
    let has = |cpus: f64| has_cores(&daemon, FIXTURE.name, "seer", cpus);
    let mut robot = daemon.robot(&format!("{}?robot=seer&rrt=100ms", FIXTURE.name))?;
    robot.calls("/rosapi/get_time", json!({}))?;
    has(1.5).context("nobody knows yet how large they are")?;
    robot.says(json!({"op": "advertise", "topic": "/camera", "type": "sensor_msgs/Image"}))?;
    let mut shows = |width: u32| {
        let picture = json!({"width": width, "height": 240, "encoding": "mono8", "data": ""});
        robot.says(json!({"op": "publish", "topic": "/camera", "msg": picture}))
    };
    for _ in 0..10 {
        shows(320)?;
    }
    resized(&daemon, "width=320")?;
    has(0.5)?;
    shows(640)?;
    resized(&daemon, "width=640")?;
    has(1.5)?;
    // For larger ones there is no row: it keeps what it has.
    shows(1920)?;
    daemon.awaits_event("what cannot be had", |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == "terms-refused" && message.contains("aux.width=1920")
    })?;
    has(1.5)?;
    let deployer = daemon.deployer();
    let said = deployer.types(&["explain", "seer"])?.succeeded()?.stdout;
    ensure!(said.contains("aux.width=640"), "{said}");
    // What one more would cost that does say it.
    let fit = [
        "--format",
        "json",
        "fit",
        FIXTURE.name,
        "--rrt",
        "100ms",
        "--aux",
        "width=320",
    ];
    let fit = deployer.types(&fit)?.succeeded()?.stdout;
    let fit: Value = serde_json::from_str(&fit)?;
    ensure!(fit["cpus"] == 0.5 && fit["expected"]["rrt"] == 0.1, "{fit}");
    Ok(())
}

pub fn what_a_stub_passes_on_is_measured_as_well(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let name = twin.robot("measured-stub");
    let daemon = sized(&name, &twin.service, "bytes", ["1000", "100000"])?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let mut argv = twin.argv("greeter", &[]);
    for (key, value) in [("desire", 0.1), ("max", 0.2)] {
        says_setting(&site, &app, &mut argv, key, &ParamValue::Double(value))?;
    }
    let settings = "robot = \"linked\"\nlocal = \"none\"\n";
    let overlay = site.installs(&daemon, service, settings)?;
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    let stub = site.runs(&overlay, package, executable, &argv)?;
    let serves = |graph: &Graph| graph.services.contains_key("/greeter/count");
    let there = site.until(&app, "the service", serves);
    there.with_context(|| format!("the stub said:\n{}", stub.said()))?;
    let has = |cpus: f64| has_cores(&daemon, service, "linked", cpus);
    has(1.5)?;
    let names = site.says(&app, "/greeter/name", false)?;
    site.connected(&*names, 1)?;
    let says = |name: &str| {
        let name = string_of(WireFormat::of(ros), name);
        names.publish(name.clone());
        match ros {
            RosVersion::One => name.len(),
            // RTPS carries whole words.
            RosVersion::Two => name.len().next_multiple_of(4),
        }
    };
    let mut size = 0;
    for _ in 0..10 {
        size = says("ada");
    }
    resized(&daemon, &format!("bytes={size}"))?;
    has(0.5)?;
    let size = says(&"a".repeat(5000));
    resized(&daemon, &format!("bytes={size}"))?;
    has(1.5)?;
    Ok(())
}
