//! A robot's node in the cloud: the robot's side cannot tell it from the original.

use std::collections::BTreeSet;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use ros::bus::{Bus, GlobalParameters, Graph, ParamValue, RosVersion, WireFormat};
use ros::ros1::Ros1Bus;
use support::Verdict;
use support::freezer::Freezer;
use support::patience::scale_seconds;
use support::site::{Running, Site, registered, string, string_of, text_of};
use support::twins::{Twin, count, sum};
use support::world::{GREETER, PEOPLE, world};

const THE_GREETER: (&str, &str, &str) = ("greeter_cpp", "greeter_cpp", "greeter");
const PEOPLE_DETECT: (&str, &str, &str) = ("opencv_apps", "opencv_apps", "people_detect");

fn serves(service: &str) -> impl Fn(&Graph) -> bool {
    let service = service.to_owned();
    move |graph| graph.services.contains_key(&service)
}

fn text(message: &[u8]) -> String {
    String::from_utf8_lossy(message).into_owned()
}

/// The message with what the node said when it fails.
fn with_log<T>(outcome: anyhow::Result<T>, node: &Running) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", node.said()))
}

pub fn a_greeter_in_the_cloud_is_a_node_of_the_robot() -> Verdict {
    let daemon = world().with(GREETER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let run = |future| site.runtime.block_on(future);
    run(app.set(
        "/front/hello/style",
        ParamValue::String("{name: robot's}".into()),
    ))?;
    let argv = [
        "__name:=hello",
        "__ns:=/front",
        "~name:=/who",
        "__log:=/nowhere/x.log",
    ];
    let mut stub = site.stub(&daemon, THE_GREETER, "linked-greeter", &argv)?;
    with_log(
        site.until(&app, "the service", serves("/front/hello/count")),
        &stub,
    )?;
    // A topic in, remapped; a topic out; both with the original's names and types.
    let names = site.says(&app, "/who", false)?;
    site.connected(&*names, 1)?;
    let mut greetings = site.hears(&app, "/front/hello/greeting")?;
    names.publish(string("robot"));
    let greeting = with_log(site.next(&mut greetings), &stub)?;
    ensure!(text(&greeting.bytes).contains("hi robot"), "{greeting:?}");
    ensure!(
        greeting.wire_type.name == "greeter_cpp/Greeting"
            && greeting.publisher.node() == "/front/hello",
        "{greeting:?}"
    );
    // A newcomer is given the latched one.
    let late = site.node("/late")?;
    let mut again = site.hears(&late, "/front/hello/greeting")?;
    ensure!(site.next(&mut again)?.bytes == greeting.bytes);
    // A service, with a parameter of the robot behind it.
    let response = site.calls(&app, "/front/hello/count", &[0])?;
    ensure!(
        text(&response).contains("robot's") && response[0] == 1,
        "{response:?}"
    );
    // The node's logger is the node's.
    ensure!(text(&site.calls(&app, "/front/hello/get_loggers", &[])?).contains("ros.roscpp"));
    // roslaunch's way to end it.
    stub.signal(Signal::SIGINT)?;
    let status = stub.ends()?;
    // As the real node ended: in good order, or with whatever befalls it at its end.
    let crashed = std::os::unix::process::ExitStatusExt::signal(&status).is_some()
        && stub.said().contains("was killed by");
    ensure!(
        status.code() == Some(0) || crashed,
        "{status}: {}",
        stub.said()
    );
    site.until(&app, "an empty graph", |graph| {
        registered(graph, "/front/hello").is_empty()
    })?;
    Ok(())
}

/// What a robot's user is told of a node: its registrations with their types, and its parameters with their values.
fn told_of(site: &Site, watcher: &Ros1Bus, node: &str) -> BTreeSet<String> {
    let graph = watcher.graph().borrow().clone();
    let mut lines = registered(&graph, node);
    let services = graph.services.iter().filter(|(_, server)| *server == node);
    for (service, _) in services {
        if let Ok(kind) = site.runtime.block_on(watcher.service_type(service)) {
            lines.insert(format!("{service} is a {} {}", kind.name, kind.digest));
        }
    }
    if let Ok(ParamValue::Map(all)) = site.runtime.block_on(watcher.get(node)) {
        lines.extend(
            all.iter()
                .map(|(name, value)| format!("sets {name} to {value:?}")),
        );
    }
    lines
}

/// Waits until what is told of a node satisfies `wanted`; what it was at last.
fn comes_to(
    site: &Site,
    watcher: &Ros1Bus,
    node: &str,
    wanted: impl Fn(&BTreeSet<String>) -> bool,
) -> BTreeSet<String> {
    let mut last = BTreeSet::new();
    // Who compares says better than this what is missing.
    let _ = support::until(node, || {
        last = told_of(site, watcher, node);
        Ok(wanted(&last).then_some(()).ok_or_else(String::new))
    });
    last
}

/// What is told of people_detect in three states: nobody listens, one does, it has left. In each, `arrived` decides
/// whether it has come about.
fn states(
    site: &Site,
    arrived: impl Fn(usize, &BTreeSet<String>) -> bool,
) -> anyhow::Result<Vec<BTreeSet<String>>> {
    let node = "/people_detect";
    let watcher = site.node("/watcher")?;
    let mut states = vec![comes_to(site, &watcher, node, |lines| arrived(0, lines))];
    let listener = site.node("/listener")?;
    let found = site.hears(&listener, &format!("{node}/found"))?;
    states.push(comes_to(site, &watcher, node, |lines| arrived(1, lines)));
    drop(found);
    states.push(comes_to(site, &watcher, node, |lines| arrived(2, lines)));
    Ok(states)
}

pub fn the_robot_s_graph_is_the_original_s() -> Verdict {
    let daemon = world().with(PEOPLE)?;
    let argv = ["__name:=people_detect", "_debug_view:=false"];
    // What is always there, and the lazy input: so much is known of it without looking.
    let (outputs, services, parameters) = (5, 6, 8);
    let original = {
        let site = Site::new()?;
        let program = "/usr/lib/opencv_apps/people_detect";
        let node = site.original(&daemon, "opencv_apps", program, &argv)?;
        let states = states(&site, |state, lines| {
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
    let stub = site.stub(&daemon, PEOPLE_DETECT, "linked-people", &argv)?;
    let linked = states(&site, |state, lines| *lines == original[state]);
    let linked = with_log(linked, &stub)?;
    for (state, (theirs, ours)) in ["idle", "busy", "left"]
        .iter()
        .zip(original.iter().zip(&linked))
    {
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
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = &*twin.robot("linked-pair");
    let start = |node: &str| {
        let argv = twin.argv(node, &[("~name", "/who")]);
        twin.stub(&site, (&daemon.address, robot), "", &argv)
    };
    let (one, two) = (start("one")?, start("two")?);
    with_log(site.until(&app, "the first", serves("/one/count")), &one)?;
    with_log(site.until(&app, "the second", serves("/two/count")), &two)?;
    let servants = daemon.deployer().asks(&["servants"])?;
    let theirs = servants
        .as_array()
        .context("a list")?
        .iter()
        .filter(|servant| servant["robot"] == robot);
    ensure!(theirs.count() == 1, "{servants:#}");
    let names = site.says(&app, "/who", false)?;
    site.connected(&*names, 2)?;
    let mut first = site.hears(&app, "/one/greeting")?;
    let mut second = site.hears(&app, "/two/greeting")?;
    site.fed(&first, 1)?;
    site.fed(&second, 1)?;
    names.publish(string_of(WireFormat::of(ros), "robot"));
    // Each hears it once, though both listen.
    with_log(site.next(&mut first), &one)?;
    with_log(site.next(&mut second), &two)?;
    for node in ["/one", "/two"] {
        let count = count(&site, &app, node)?;
        ensure!(count == 1, "{node}: {count}");
    }
    Ok(())
}

pub fn a_lost_link_is_taken_up_again() -> Verdict {
    // Of its own: its end is the story.
    let home = world().home("link-restarted");
    let setup = world().own("link-restarted");
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes("greeter_cpp", GREETER.arguments)?
        .succeeded()?;
    let address = daemon.address.clone();
    let site = Site::new()?;
    let app = site.node("/app")?;
    let stub = site.stub(
        &daemon,
        THE_GREETER,
        "linked-again",
        &["__name:=greeter", "~name:=/who"],
    )?;
    with_log(
        site.until(&app, "the service", serves("/greeter/count")),
        &stub,
    )?;
    let names = site.says(&app, "/who", false)?;
    site.connected(&*names, 1)?;
    let mut greetings = site.hears(&app, "/greeter/greeting")?;
    names.publish(string("first"));
    site.next(&mut greetings)?;
    let before = registered(&app.graph().borrow(), "/greeter");
    // The daemon goes and comes back; the servant lives on, and the node with all it knows.
    daemon.is_killed()?;
    let daemon = setup.listen(&address).start()?;
    ensure!(daemon.home == home);
    // A call made meanwhile is answered, or fails with a reason; the next one is answered.
    if let Err(error) = site.calls(&app, "/greeter/count", &[0]) {
        ensure!(
            format!("{error:#}").contains("forgotten this call"),
            "{error:#}"
        );
    }
    let count = with_log(site.calls(&app, "/greeter/count", &[0]), &stub)?;
    ensure!(count[0] == 1, "it has forgotten what it did: {count:?}");
    ensure!(registered(&app.graph().borrow(), "/greeter") == before);
    names.publish(string("second"));
    let greeting = with_log(site.next(&mut greetings), &stub)?;
    ensure!(
        text(&greeting.bytes).contains("second") || text(&greeting.bytes).contains("first"),
        "{greeting:?}"
    );
    drop(stub);
    daemon.deployer().types(&["stop", "--all"])?;
    daemon.ends()?;
    Ok(())
}

pub fn what_a_stub_cannot_do_is_said(ros: RosVersion) -> Verdict {
    let (greeter, adder) = (Twin::greeter(ros), Twin::adder(ros));
    let daemon = world().with(greeter.service)?;
    world().with(adder.service)?;
    let site = Site::of(ros)?;
    let (service, package, executable) = greeter.names();
    let server = format!(
        "server = \"ws://{}\"\nrobot = \"{}\"\nlocal = \"none\"\n",
        daemon.address,
        greeter.robot("linked-wrong")
    );
    let cases = [
        (
            format!("{server}service = \"nothing\""),
            executable,
            "nothing",
        ),
        (
            format!("{server}service = \"{service}\""),
            "no_such",
            "not pushed with the executable no_such",
        ),
        (
            format!("{server}service = \"{service}\"\ntoken_file = \"/nowhere/token\""),
            executable,
            "/nowhere/token",
        ),
        (
            format!("{server}service = \"{service}\"\nmaximum = 3"),
            executable,
            "maximum",
        ),
    ];
    let argv = greeter.argv("wrong", &[]);
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    for (toml, executable, said) in cases {
        let mut stub = site.stub_with(&toml, package, executable, &argv)?;
        let status = stub.ends()?;
        ensure!(
            status.code() == Some(1) && stub.said().contains(said),
            "{said}: {status}\n{}",
            stub.said()
        );
    }
    // A node that ends takes its stub along, with its status.
    let robot = &*adder.robot("linked-ended");
    let argv = adder.argv("adder", &[]);
    let mut stub = adder.stub(&site, (&daemon.address, robot), "", &argv)?;
    let app = site.joins("/app")?;
    with_log(site.until(&app, "the service", serves("/add_two")), &stub)?;
    let servant = daemon.servant_of(adder.service.name, robot)?;
    let pid = servant["pids"][0].as_i64().context("its process")?;
    nix::sys::signal::kill(
        nix::unistd::Pid::from_raw(i32::try_from(pid)?),
        Signal::SIGKILL,
    )?;
    let status = stub.ends()?;
    ensure!(
        std::os::unix::process::ExitStatusExt::signal(&status) == Some(9),
        "{status}: {}",
        stub.said()
    );
    // With it goes all that it had.
    site.until(&app, "its end", |graph| !serves("/add_two")(graph))?;
    Ok(())
}

pub fn the_robot_s_master_starts_again() -> Verdict {
    let daemon = world().with(GREETER)?;
    let mut site = Site::new()?;
    let stub = site.stub(&daemon, THE_GREETER, "linked-master", &["__name:=greeter"])?;
    let before = {
        let app = site.node("/app")?;
        let graph = with_log(
            site.until(&app, "the service", serves("/greeter/count")),
            &stub,
        )?;
        site.until(&app, "all of it", |graph| {
            registered(graph, "/greeter").len() == 6
        })?;
        registered(&app.graph().borrow(), "/greeter")
            .union(&registered(&graph, "/greeter"))
            .cloned()
            .collect::<BTreeSet<_>>()
    };
    site.end_master();
    site.start_master()?;
    let app = site.node("/app")?;
    with_log(
        site.until(&app, "the same graph", |graph| {
            registered(graph, "/greeter") == before
        }),
        &stub,
    )?;
    Ok(())
}

pub fn a_connection_that_falls_silent_is_replaced(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().with(twin.service)?;
    let freezer = Freezer::new(&daemon.address)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let server = freezer.server.to_string();
    let robot = twin.robot("linked-silent");
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    // It would be given up ten times T_max after it fell silent.
    let max = scale_seconds(2);
    let settings = format!("desire = 1.0\nmax = {max}.0\n");
    let stub = twin.stub(&site, (&server, &robot), &settings, &argv)?;
    with_log(
        site.until(&app, "the service", serves("/greeter/count")),
        &stub,
    )?;
    let names = site.says(&app, "/who", false)?;
    let say = |name: &str| names.publish(string_of(WireFormat::of(ros), name));
    site.connected(&*names, 1)?;
    let mut greetings = site.hears(&app, "/greeter/greeting")?;
    site.fed(&greetings, 1)?;
    say("first");
    with_log(site.next(&mut greetings), &stub)?;
    ensure!(freezer.freeze() == 1, "one connection carries it");
    // What is sent meanwhile is not lost: the same node hears it.
    say("second");
    // roscpp may give whoever has just connected the latched one twice.
    while !text(&with_log(site.next(&mut greetings), &stub)?.bytes).contains("second") {}
    let count = with_log(count(&site, &app, "/greeter"), &stub)?;
    ensure!(count == 2, "{count}");
    let said = stub.said();
    ensure!(
        said.contains("is silent, another takes its place"),
        "{said}"
    );
    ensure!(!said.contains("nothing came from the other end"), "{said}");
    Ok(())
}

pub fn one_message_right_after_connecting_is_not_lost(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    for round in 0..5 {
        // Each time another servant, whose node has heard nothing yet.
        let robot = twin.robot(&format!("linked-once-{round}"));
        let argv = twin.argv("greeter", &[("~name", "/who")]);
        // The application is there first, as often; or it comes to a stub that is.
        let early = site.says(&app, "/who", false)?;
        let stub = twin.stub(&site, (&daemon.address, &robot), "", &argv)?;
        let names = if round % 2 == 0 {
            early
        } else {
            drop(early);
            site.until(&app, "the service", serves("/greeter/count"))?;
            site.says(&app, "/who", false)?
        };
        with_log(site.connected(&*names, 1), &stub)?;
        names.publish(string_of(WireFormat::of(ros), "only"));
        site.until(&app, "the service", serves("/greeter/count"))?;
        support::until("a greeting of what was said at once", || {
            let greeted = with_log(count(&site, &app, "/greeter"), &stub)?;
            let lost = || format!("{greeted} in round {round}:\n{}", stub.said());
            Ok((greeted == 1).then_some(()).ok_or_else(lost))
        })?;
        let mut stub = stub;
        stub.signal(Signal::SIGINT)?;
        stub.ends()?;
    }
    Ok(())
}

pub fn who_has_just_connected_hears_what_the_node_answers(ros: RosVersion) -> Verdict {
    let twin = Twin::adder(ros);
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = twin.robot("linked-newcomer");
    let argv = twin.argv("adder", &[]);
    let stub = twin.stub(&site, (&daemon.address, &robot), "", &argv)?;
    with_log(site.until(&app, "the service", serves("/add_two")), &stub)?;
    for number in 1..=10_i64 {
        // Nobody listens yet: in the cloud the node is subscribed to from now on.
        let app = site.joins(&format!("/app{number}"))?;
        let mut sums = site.hears(&app, "/sums")?;
        site.fed(&sums, 1)?;
        with_log(site.calls(&app, "/add_two", &sum(ros, number)), &stub)?;
        let told = with_log(site.next(&mut sums), &stub)
            .with_context(|| format!("sum {number} was not heard"))?;
        ensure!(
            text_of(ros, &told.bytes, 0)? == number.to_string(),
            "{told:?}"
        );
        drop(sums);
        site.runtime.block_on(app.close());
    }
    Ok(())
}
