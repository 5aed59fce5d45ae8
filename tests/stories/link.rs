//! A robot's node in the cloud: the robot cannot distinguish it from the original.

use std::collections::BTreeSet;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Bus, GlobalParameters, Graph, ParamValue, RosVersion, WireFormat};
use ros::ros1::Ros1Bus;
use support::Verdict;
use support::freezer::Freezer;
use support::patience::scale_seconds;
use support::site::{NodeProcess, Site, registrations, string, string_in, string_text};
use support::twins::{Twin, greeting_count, sum_request};
use support::world::{GREETER, PEOPLE, world};

const THE_GREETER: (&str, &str, &str) = ("greeter_cpp", "greeter_cpp", "greeter");
const PEOPLE_DETECT: (&str, &str, &str) = ("opencv_apps", "opencv_apps", "people_detect");

fn has_service(service: &str) -> impl Fn(&Graph) -> bool {
    let service = service.to_owned();
    move |graph| graph.services.contains_key(&service)
}

fn to_text(message: &[u8]) -> String {
    String::from_utf8_lossy(message).into_owned()
}

/// Adds the node's output to an error.
fn with_log<T>(outcome: anyhow::Result<T>, node: &NodeProcess) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", node.output()))
}

pub fn a_greeter_in_the_cloud_is_a_node_of_the_robot() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let run = |future| site.runtime.block_on(future);
    run(app.set("/front/hello/style", ParamValue::String("{name: robot's}".into())))?;
    let argv = ["__name:=hello", "__ns:=/front", "~name:=/who", "__log:=/nowhere/x.log"];
    let mut stub = site.start_stub(&daemon, THE_GREETER, "linked-greeter", &argv)?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/front/hello/count")), &stub)?;
    // An input topic, remapped; an output topic; both with the original's names and types.
    let names = site.advertise_strings(&app, "/who", false)?;
    site.wait_for_subscribers(&*names, 1)?;
    let mut greetings = site.subscribe(&app, "/front/hello/greeting")?;
    names.publish(string("robot"));
    let greeting = with_log(site.next_message(&mut greetings), &stub)?;
    ensure!(to_text(&greeting.bytes).contains("hi robot"), "{greeting:?}");
    ensure!(
        greeting.wire_type.name == "greeter_cpp/Greeting" && greeting.publisher.node() == "/front/hello",
        "{greeting:?}"
    );
    // A late subscriber gets the latched message.
    let late = site.node("/late")?;
    let mut again = site.subscribe(&late, "/front/hello/greeting")?;
    ensure!(site.next_message(&mut again)?.bytes == greeting.bytes);
    // A service that uses a parameter of the robot.
    let response = site.call_service(&app, "/front/hello/count", &[0])?;
    ensure!(to_text(&response).contains("robot's") && response[0] == 1, "{response:?}");
    // The services of the node's logger are available.
    ensure!(to_text(&site.call_service(&app, "/front/hello/get_loggers", &[])?).contains("ros.roscpp"));
    // The signal with which roslaunch ends nodes.
    stub.signal(Signal::SIGINT)?;
    let status = stub.wait_for_exit()?;
    // The stub ends as the node did: successfully, or with its error.
    let crashed =
        std::os::unix::process::ExitStatusExt::signal(&status).is_some() && stub.output().contains("was killed by");
    ensure!(status.code() == Some(0) || crashed, "{status}: {}", stub.output());
    site.wait_for_graph(&app, "an empty graph", |graph| registrations(graph, "/front/hello").is_empty())?;
    Ok(())
}

/// Describes a node for a robot's user: its registrations with types, and its parameters with values.
fn describe_node(site: &Site, watcher: &Ros1Bus, node: &str) -> BTreeSet<String> {
    let graph = watcher.graph().borrow().clone();
    let mut lines = registrations(&graph, node);
    let services = graph.services.iter().filter(|(_, server)| *server == node);
    for (service, _) in services {
        if let Ok(kind) = site.runtime.block_on(watcher.service_type(service)) {
            lines.insert(format!("{service} is a {} {}", kind.name, kind.digest));
        }
    }
    if let Ok(ParamValue::Map(all)) = site.runtime.block_on(watcher.get(node)) {
        lines.extend(all.iter().map(|(name, value)| format!("sets {name} to {value:?}")));
    }
    lines
}

/// Waits until the description of a node satisfies `wanted`; returns the last description.
fn wait_for_description(
    site: &Site,
    watcher: &Ros1Bus,
    node: &str,
    wanted: impl Fn(&BTreeSet<String>) -> bool,
) -> BTreeSet<String> {
    let mut last = BTreeSet::new();
    // The caller compares the description and reports the difference.
    let _ = support::wait_until(node, || {
        last = describe_node(site, watcher, node);
        Ok(wanted(&last).then_some(()).ok_or_else(String::new))
    });
    last
}

/// Describes people_detect in three states: without a subscriber, with one, and after it has left. `arrived` decides
/// whether each state has been reached.
fn describe_states(
    site: &Site,
    arrived: impl Fn(usize, &BTreeSet<String>) -> bool,
) -> anyhow::Result<Vec<BTreeSet<String>>> {
    let node = "/people_detect";
    let watcher = site.node("/watcher")?;
    let mut states = vec![wait_for_description(site, &watcher, node, |lines| arrived(0, lines))];
    let listener = site.node("/listener")?;
    let found = site.subscribe(&listener, &format!("{node}/found"))?;
    states.push(wait_for_description(site, &watcher, node, |lines| arrived(1, lines)));
    drop(found);
    states.push(wait_for_description(site, &watcher, node, |lines| arrived(2, lines)));
    Ok(states)
}

pub fn the_robot_s_graph_is_the_original_s() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let argv = ["__name:=people_detect", "_debug_view:=false"];
    // Number of permanent registrations; the lazy input is not among them.
    let (outputs, services, parameters) = (5, 6, 8);
    let original = {
        let site = Site::new()?;
        let program = "/usr/lib/opencv_apps/people_detect";
        let node = site.start_original(&daemon, "opencv_apps", program, &argv)?;
        let states = describe_states(&site, |state, lines| {
            let count = |word: &str| lines.iter().filter(|line| line.starts_with(word)).count();
            count("publishes") == outputs
                && count("serves") == services
                && count("sets") == parameters
                && count("subscribes") == usize::from(state == 1)
        });
        let states = with_log(states, &node)?;
        let lazy = "subscribes /image [sensor_msgs/Image]";
        for (state, lines) in states.iter().enumerate() {
            ensure!(
                lines.contains(lazy) == (state == 1) && lines.len() >= 25,
                "the original itself is not as it should be in state {state}: {lines:#?}"
            );
        }
        states
    };
    let site = Site::new()?;
    let stub = site.start_stub(&daemon, PEOPLE_DETECT, "linked-people", &argv)?;
    let linked = describe_states(&site, |state, lines| *lines == original[state]);
    let linked = with_log(linked, &stub)?;
    for (state, (theirs, ours)) in ["idle", "busy", "left"].iter().zip(original.iter().zip(&linked)) {
        let missing: Vec<_> = theirs.difference(ours).collect();
        let extra: Vec<_> = ours.difference(theirs).collect();
        ensure!(
            missing.is_empty() && extra.is_empty(),
            "{state}: the stub lacks {missing:#?} and has {extra:#?} too much"
        );
    }
    Ok(())
}

pub fn two_nodes_share_a_servant(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = &*twin.robot_name("linked-pair");
    let start = |node: &str| {
        let argv = twin.argv(node, &[("~name", "/who")]);
        twin.stub(&site, (&daemon.address, robot), "", &argv)
    };
    let (one, two) = (start("one")?, start("two")?);
    with_log(site.wait_for_graph(&app, "the first", has_service("/one/count")), &one)?;
    with_log(site.wait_for_graph(&app, "the second", has_service("/two/count")), &two)?;
    let servants = daemon.deployer().run_json(&["servants"])?;
    let theirs = servants.as_array().context("a list")?.iter().filter(|servant| servant["robot"] == robot);
    ensure!(theirs.count() == 1, "{servants:#}");
    let names = site.advertise_strings(&app, "/who", false)?;
    site.wait_for_subscribers(&*names, 2)?;
    let mut first = site.subscribe(&app, "/one/greeting")?;
    let mut second = site.subscribe(&app, "/two/greeting")?;
    site.wait_for_publishers(&first, 1)?;
    site.wait_for_publishers(&second, 1)?;
    names.publish(string_in(WireFormat::for_version(ros), "robot"));
    // Each of them receives it once, although both subscribe.
    with_log(site.next_message(&mut first), &one)?;
    with_log(site.next_message(&mut second), &two)?;
    for node in ["/one", "/two"] {
        let count = greeting_count(&site, &app, node)?;
        ensure!(count == 1, "{node}: {count}");
    }
    Ok(())
}

pub fn a_lost_link_is_taken_up_again() -> Verdict {
    // A separate daemon, because it is killed.
    let home = world().home("link-restarted");
    let setup = world().setup("link-restarted");
    let daemon = setup.start()?;
    daemon.deployer().push("greeter_cpp", GREETER.arguments)?.expect_success()?;
    let address = daemon.address.clone();
    let site = Site::new()?;
    let app = site.node("/app")?;
    let stub = site.start_stub(&daemon, THE_GREETER, "linked-again", &["__name:=greeter", "~name:=/who"])?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/greeter/count")), &stub)?;
    let names = site.advertise_strings(&app, "/who", false)?;
    site.wait_for_subscribers(&*names, 1)?;
    let mut greetings = site.subscribe(&app, "/greeter/greeting")?;
    names.publish(string("first"));
    site.next_message(&mut greetings)?;
    let before = registrations(&app.graph().borrow(), "/greeter");
    // The daemon ends and returns; the servant continues, and the node keeps its state.
    daemon.kill()?;
    let daemon = setup.listen(&address).start()?;
    ensure!(daemon.home == home);
    // A call made meanwhile is answered or fails with a reason; the next one is answered.
    if let Err(error) = site.call_service(&app, "/greeter/count", &[0]) {
        ensure!(format!("{error:#}").contains("this call was lost"), "{error:#}");
    }
    let count = with_log(site.call_service(&app, "/greeter/count", &[0]), &stub)?;
    ensure!(count[0] == 1, "it has forgotten what it did: {count:?}");
    ensure!(registrations(&app.graph().borrow(), "/greeter") == before);
    names.publish(string("second"));
    let greeting = with_log(site.next_message(&mut greetings), &stub)?;
    ensure!(to_text(&greeting.bytes).contains("second") || to_text(&greeting.bytes).contains("first"), "{greeting:?}");
    drop(stub);
    daemon.deployer().run(&["stop", "--all"])?;
    daemon.stop()?;
    Ok(())
}

pub fn what_a_stub_cannot_do_is_said(ros: RosVersion) -> Verdict {
    let (greeter, adder) = (Twin::greeter(ros), Twin::adder(ros));
    let daemon = world().daemon_with(greeter.service)?;
    world().daemon_with(adder.service)?;
    let site = Site::with_ros(ros)?;
    let (service, package, executable) = greeter.names();
    let server = format!(
        "server = \"ws://{}\"\nrobot = \"{}\"\nlocal = \"none\"\n",
        daemon.address,
        greeter.robot_name("linked-wrong")
    );
    let cases = [
        (format!("{server}service = \"nothing\""), executable, "nothing"),
        (format!("{server}service = \"{service}\""), "no_such", "not pushed with the executable no_such"),
        (format!("{server}service = \"{service}\"\ntoken_file = \"/nowhere/token\""), executable, "/nowhere/token"),
        (format!("{server}service = \"{service}\"\nmaximum = 3"), executable, "maximum"),
    ];
    let argv = greeter.argv("wrong", &[]);
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    for (toml, executable, said) in cases {
        let mut stub = site.start_stub_with_config(&toml, package, executable, &argv)?;
        let status = stub.wait_for_exit()?;
        ensure!(status.code() == Some(1) && stub.output().contains(said), "{said}: {status}\n{}", stub.output());
    }
    // The end of a node ends its stub, with its exit status.
    let robot = &*adder.robot_name("linked-ended");
    let argv = adder.argv("adder", &[]);
    let mut stub = adder.stub(&site, (&daemon.address, robot), "", &argv)?;
    let app = site.join("/app")?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/add_two")), &stub)?;
    let servant = daemon.servant_of(adder.service.name, robot)?;
    let pid = servant["pids"][0].as_i64().context("its process")?;
    nix::sys::signal::kill(nix::unistd::Pid::from_raw(i32::try_from(pid)?), Signal::SIGKILL)?;
    let status = stub.wait_for_exit()?;
    ensure!(std::os::unix::process::ExitStatusExt::signal(&status) == Some(9), "{status}: {}", stub.output());
    // All its registrations disappear with it.
    site.wait_for_graph(&app, "its end", |graph| !has_service("/add_two")(graph))?;
    Ok(())
}

pub fn the_robot_s_master_starts_again() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut site = Site::new()?;
    let stub = site.start_stub(&daemon, THE_GREETER, "linked-master", &["__name:=greeter"])?;
    let before = {
        let app = site.node("/app")?;
        let graph = with_log(site.wait_for_graph(&app, "the service", has_service("/greeter/count")), &stub)?;
        site.wait_for_graph(&app, "all of it", |graph| registrations(graph, "/greeter").len() == 6)?;
        registrations(&app.graph().borrow(), "/greeter")
            .union(&registrations(&graph, "/greeter"))
            .cloned()
            .collect::<BTreeSet<_>>()
    };
    site.end_master();
    site.start_master()?;
    let app = site.node("/app")?;
    with_log(site.wait_for_graph(&app, "the same graph", |graph| registrations(graph, "/greeter") == before), &stub)?;
    Ok(())
}

pub fn a_connection_that_falls_silent_is_replaced(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().daemon_with(twin.service)?;
    let freezer = Freezer::new(&daemon.address)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let server = freezer.server.to_string();
    let robot = twin.robot_name("linked-silent");
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    // The link is given up ten times T_max after it fell silent.
    let max = scale_seconds(2);
    let settings = format!("desire = 1.0\nmax = {max}.0\n");
    let stub = twin.stub(&site, (&server, &robot), &settings, &argv)?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/greeter/count")), &stub)?;
    let names = site.advertise_strings(&app, "/who", false)?;
    let say = |name: &str| names.publish(string_in(WireFormat::for_version(ros), name));
    site.wait_for_subscribers(&*names, 1)?;
    let mut greetings = site.subscribe(&app, "/greeter/greeting")?;
    site.wait_for_publishers(&greetings, 1)?;
    say("first");
    with_log(site.next_message(&mut greetings), &stub)?;
    ensure!(freezer.freeze() == 1, "one connection carries it");
    // Messages sent meanwhile are not lost: the same node receives them.
    say("second");
    // roscpp may deliver the latched message twice to a late subscriber.
    while !to_text(&with_log(site.next_message(&mut greetings), &stub)?.bytes).contains("second") {}
    let count = with_log(greeting_count(&site, &app, "/greeter"), &stub)?;
    ensure!(count == 2, "{count}");
    let said = stub.output();
    ensure!(said.contains("is silent, a new one replaces it"), "{said}");
    ensure!(!said.contains("nothing was received from the other end"), "{said}");
    Ok(())
}

pub fn one_message_right_after_connecting_is_not_lost(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    for round in 0..5 {
        // A new servant each time, whose node has not received anything yet.
        let robot = twin.robot_name(&format!("linked-once-{round}"));
        let argv = twin.argv("greeter", &[("~name", "/who")]);
        // In half of the rounds the application starts first, in the others the stub does.
        let early = site.advertise_strings(&app, "/who", false)?;
        let stub = twin.stub(&site, (&daemon.address, &robot), "", &argv)?;
        let names = if round % 2 == 0 {
            early
        } else {
            drop(early);
            site.wait_for_graph(&app, "the service", has_service("/greeter/count"))?;
            site.advertise_strings(&app, "/who", false)?
        };
        with_log(site.wait_for_subscribers(&*names, 1), &stub)?;
        names.publish(string_in(WireFormat::for_version(ros), "only"));
        site.wait_for_graph(&app, "the service", has_service("/greeter/count"))?;
        support::wait_until("a greeting of what was said at once", || {
            let greeted = with_log(greeting_count(&site, &app, "/greeter"), &stub)?;
            let lost = || format!("{greeted} in round {round}:\n{}", stub.output());
            Ok((greeted == 1).then_some(()).ok_or_else(lost))
        })?;
        let mut stub = stub;
        stub.signal(Signal::SIGINT)?;
        stub.wait_for_exit()?;
    }
    Ok(())
}

pub fn who_has_just_connected_hears_what_the_node_answers(ros: RosVersion) -> Verdict {
    let twin = Twin::adder(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = twin.robot_name("linked-newcomer");
    let argv = twin.argv("adder", &[]);
    let stub = twin.stub(&site, (&daemon.address, &robot), "", &argv)?;
    with_log(site.wait_for_graph(&app, "the service", has_service("/add_two")), &stub)?;
    for number in 1..=10_i64 {
        // Without subscribers on the robot: from now on the node in the cloud is subscribed.
        let app = site.join(&format!("/app{number}"))?;
        let mut sums = site.subscribe(&app, "/sums")?;
        site.wait_for_publishers(&sums, 1)?;
        with_log(site.call_service(&app, "/add_two", &sum_request(ros, number)), &stub)?;
        let told =
            with_log(site.next_message(&mut sums), &stub).with_context(|| format!("sum {number} was not heard"))?;
        ensure!(string_text(ros, &told.bytes, 0)? == number.to_string(), "{told:?}");
        drop(sums);
        site.runtime.block_on(app.close());
    }
    Ok(())
}
