//! A servant of ROS 2 with several nodes: one with a lifecycle, which works for its robot once it is active, and two
//! that exchange images through shared memory. A single story, because a push of ROS 2 takes long.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::sync::Arc;

use anyhow::{Context, ensure};
use nix::sys::stat::{major, minor};
use ros::bus::{Bus, Publisher, RosVersion, SerializedMessage, Subscription, WireFormat};
use ros::ros2::lifecycle::{LifecycleNode, State, StateChange, Transition};
use serde_json::{Value, json};
use support::cutter::Cutter;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::patience::{patience, wait_for};
use support::robot::Robot;
use support::site::{NodeProcess, Site, string_in};
use support::world::world;
use support::{Verdict, procfs};

const SERVICE: &str = "sentry_ros2";
const SENTRY: &str = "/sentry";
/// Size of the images: 1920 by 1080 in three colours.
const SIZE: u64 = 1920 * 1080 * 3;
/// Prefix of Fast DDS's files in shared memory.
const SHARED: &str = "/dev/shm/fastrtps_";

pub fn nodes_of_a_servant_become_active_and_share_their_memory() -> Verdict {
    let place = tempfile::tempdir()?;
    let post = place.path().join("post");
    std::fs::create_dir(&post)?;
    let closed = post.join("closed");
    let config = format!("[allow]\nvolumes = [{post:?}]\n");
    let daemon = world().setup("lifecycle").config(&config).start()?;
    let volume = format!("{}:/post", path_str(&post));
    let arguments =
        ["--node", "sentry", "--node", "eye", "--node", "reader", "--param", "drowsy=1.0", "--volume", &volume];
    let pushed = daemon.deployer().push(SERVICE, &arguments)?;
    pushed.expect_success()?;
    let service = daemon.api(&format!("/api/v1/services/{SERVICE}"))?;
    ensure!(service["interface"]["lifecycle"] == json!([SENTRY]), "{service:#}");

    let mut robot = expect_active_node(&daemon)?;
    expect_shared_memory_used(&daemon, &mut robot)?;
    robot.leave()?;
    std::fs::write(&closed, "")?;
    expect_inactive_refused(&daemon, &arguments)?;
    std::fs::remove_file(&closed)?;
    drive_across_failover(&daemon)?;
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    daemon.stop()?;
    Ok(())
}

/// Returns the lifecycle states that a robot's servant reports.
fn lifecycle_states(daemon: &Daemon, robot: &str) -> anyhow::Result<Value> {
    Ok(daemon.servant_of(SERVICE, robot)?["lifecycle"].clone())
}

/// Returns the report with the sentry in this state.
fn sentry_in_state(state: &str) -> Value {
    json!([{"node": SENTRY, "state": state}])
}

fn expect_active_node(daemon: &Daemon) -> anyhow::Result<Robot> {
    let mut robot = daemon.robot(&format!("{SERVICE}?robot=asks"))?;
    // Messages published while the sentry activates reach it, because its servant is not ready before.
    robot.send(json!({"op": "subscribe", "topic": "/alarm"}))?;
    robot.send(json!({"op": "advertise", "topic": "/noise", "type": "std_msgs/msg/String"}))?;
    robot.send(json!({"op": "publish", "topic": "/noise", "msg": {"data": "steps"}}))?;
    let alarm = robot.next_message_on("/alarm")?;
    let alarm = alarm["data"].as_str().context("a text")?;
    ensure!(alarm.starts_with("steps heard by "), "{alarm}");
    let stages = lifecycle_states(daemon, "asks")?;
    ensure!(stages == sentry_in_state("active"), "{stages:#}");
    Ok(robot)
}

/// Returns the processes of a robot's servant that run these programs.
fn find_processes(daemon: &Daemon, robot: &str, programs: [&str; 2]) -> anyhow::Result<[i32; 2]> {
    let servant = daemon.servant_of(SERVICE, robot)?;
    let pids = servant["pids"].as_array().context("pids")?;
    let pids = pids.iter().filter_map(|pid| Some(pid.as_i64()? as i32));
    let pids: Vec<i32> = pids.collect();
    let found = programs.map(|program| {
        let program = format!("/lib/{SERVICE}/{program}");
        let mut pids = pids.iter().copied();
        pids.find(|pid| procfs::command_line(*pid).is_some_and(|line| line.contains(&program)))
    });
    match found {
        [Some(one), Some(other)] => Ok([one, other]),
        _ => anyhow::bail!("{programs:?} are not both among {servant:#}"),
    }
}

/// Returns the files of Fast DDS's shared memory that a process has mapped: file system and file.
fn mapped_shared_memory(pid: i32) -> anyhow::Result<BTreeSet<(String, String)>> {
    let maps = std::fs::read_to_string(format!("/proc/{pid}/maps"))?;
    let lines = maps.lines().filter(|line| line.contains(SHARED));
    let files = lines.filter_map(|line| {
        // Addresses, permissions and offset come before (proc_pid_maps(5)).
        let mut words = line.split_whitespace().skip(3);
        Some((words.next()?.to_owned(), words.next()?.to_owned()))
    });
    Ok(files.collect())
}

/// Returns the bytes received on the loopback device of a process's network.
fn loopback_bytes(pid: i32) -> anyhow::Result<u64> {
    let devices = std::fs::read_to_string(format!("/proc/{pid}/net/dev"))?;
    let mut lines = devices.lines().map(str::trim);
    let counts = lines.find_map(|line| line.strip_prefix("lo:"));
    let received = counts.and_then(|counts| counts.split_whitespace().next());
    Ok(received.context("a loopback")?.parse()?)
}

fn expect_shared_memory_used(daemon: &Daemon, robot: &mut Robot) -> Verdict {
    const PICTURES: u64 = 5;
    let mut other = daemon.robot(&format!("{SERVICE}?robot=beside"))?;
    other.subscribe("/seen")?;
    other.wait_for_subscriber("/look")?;
    robot.subscribe("/seen")?;
    robot.send(json!({"op": "advertise", "topic": "/look", "type": "std_msgs/msg/UInt32"}))?;
    robot.wait_for_subscriber("/look")?;
    let nodes = find_processes(daemon, "asks", ["eye", "reader"])?;
    let before = loopback_bytes(nodes[0])?;
    for number in 1..=PICTURES {
        robot.send(json!({"op": "publish", "topic": "/look", "msg": {"data": number}}))?;
        let seen = robot.next_message_on("/seen")?;
        let whole = format!("{number}: {SIZE} bytes, whole");
        ensure!(seen["data"] == whole, "{seen}");
    }
    let carried = loopback_bytes(nodes[0])? - before;
    ensure!(carried < SIZE, "{PICTURES} pictures of {SIZE} bytes took {carried} bytes of the network");
    let [eye, reader] = nodes.map(mapped_shared_memory);
    let (eye, reader) = (eye?, reader?);
    ensure!(!eye.is_disjoint(&reader), "{eye:?} and {reader:?}");
    // Neither the other servant nor this machine has any of these files.
    for node in find_processes(daemon, "beside", ["eye", "reader"])? {
        let theirs = mapped_shared_memory(node)?;
        let ours = eye.union(&reader);
        let systems: BTreeSet<&String> = ours.map(|(system, _)| system).collect();
        ensure!(!theirs.is_empty(), "they share memory, too");
        ensure!(theirs.iter().all(|(system, _)| !systems.contains(system)), "{theirs:?} beside {eye:?}");
    }
    let device = std::fs::metadata("/dev/shm")?.dev();
    let host = format!("{:02x}:{:02x}", major(device), minor(device));
    ensure!(eye.union(&reader).all(|(system, _)| *system != host), "{eye:?} is on {host}, which is this machine's");
    let seen = |told: &Value| told["op"] == "publish" && told["topic"] == "/seen";
    ensure!(other.has_not_heard(seen)?, "it heard of another's pictures");
    other.leave()
}

fn expect_inactive_refused(daemon: &Daemon, arguments: &[&str]) -> Verdict {
    let words = [SENTRY, "does not activate", "inactive"];
    let mut refused = daemon.robot(&format!("{SERVICE}?robot=refused"))?;
    let told = refused.wait_for_status("does not activate")?;
    let said = told["msg"].as_str().unwrap_or_default();
    ensure!(words.iter().all(|word| said.contains(word)), "{told}");
    refused.wait_for_close()?;
    daemon.wait_for_event("that it was refused", |event| {
        let message = event["message"].to_string();
        event["kind"] == "lifecycle-refused" && words.iter().all(|word| message.contains(word))
    })?;
    // Its log is all that is left of it. The line was printed on standard error, as every line of ROS 2.
    let previous = ["--format", "json", "logs", "refused", "--previous"];
    support::wait_until("the log of the refused servant", || {
        let log = daemon.deployer().run(&previous)?;
        let closed = log.stdout.lines().find(|line| line.contains("the post is closed"));
        let is_error = closed.is_some_and(|line| line.contains("\"level\":\"error\""));
        Ok(if is_error { Ok(()) } else { Err(log.output()) })
    })?;
    // It is not published either.
    let again = [&["--name", "closed"], arguments].concat();
    let pushed = daemon.deployer().push(SERVICE, &again)?;
    pushed.expect_failure(&words)?;
    Ok(())
}

/// A robot with a node that publishes noise and subscribes to alarms, and a client that drives the sentry's lifecycle.
struct GuardedRobot {
    // Fields are in the order in which they must be dropped.
    alarms: Subscription,
    noise: Box<dyn Publisher>,
    app: Arc<dyn Bus>,
    site: Site,
    noises: u32,
}

impl GuardedRobot {
    /// Makes transitions of the sentry and checks the published states.
    fn transition_through(&self, way: &[(Transition, [State; 3])]) -> Verdict {
        let node = LifecycleNode::new(Arc::clone(&self.app), SENTRY);
        self.site.runtime.block_on(async {
            let mut changes = node.watch().await?;
            for (transition, [from, by, to]) in way {
                ensure!(node.state().await? == *from);
                node.change_state(*transition, patience()).await?;
                for (from, to) in [(*from, *by), (*by, *to)] {
                    let told = wait_for(changes.next()).await;
                    let told = told.context("its state's change should be told")?;
                    ensure!(told == Some(StateChange { from, to }), "{told:?}");
                }
                ensure!(node.state().await? == *to);
            }
            Ok(())
        })
    }

    /// Publishes noise until there is an alarm about it; returns the host that raised the alarm.
    fn wait_for_alarm(&mut self) -> anyhow::Result<String> {
        let (noises, begun) = (Cell::new(self.noises), self.noises);
        let ask = || {
            noises.set(noises.get() + 1);
            let noise = format!("noise {}", noises.get());
            self.noise.publish(string_in(WireFormat::Cdr, &noise));
            Ok(())
        };
        let mut raised = None;
        // An alarm about earlier noise does not show which host raises alarms now.
        let is_of_now = |alarm: &SerializedMessage| {
            let said = String::from_utf8_lossy(&alarm.bytes).into_owned();
            raised = (begun + 1..=noises.get()).find_map(|number| {
                let (_, host) = said.split_once(&format!("noise {number} heard by "))?;
                Some(host.trim_end_matches('\0').to_owned())
            });
            Ok(raised.is_some())
        };
        let heard = self.site.ask_until(&mut self.alarms, ask, is_of_now);
        heard.context("an alarm should be heard")?;
        self.noises = noises.get();
        raised.context("a host")
    }
}

/// Starts the stub from its archive, with an original on the robot.
fn start_stub(site: &Site, daemon: &Daemon, server: &str) -> anyhow::Result<NodeProcess> {
    let settings = "robot = \"drives\"\nfallback_after = 1.0\n";
    let overlay = site.install_stub(daemon, SERVICE, settings)?;
    let program = format!("/opt/cloudroid/install/lib/{SERVICE}/sentry");
    let original = site.install_original(daemon, SERVICE, (SERVICE, "sentry"), &program)?;
    let prefixes = format!("{}:{}", overlay.display(), original.display());
    let server = format!("ws://{server}");
    let variables =
        [("AMENT_PREFIX_PATH", prefixes.as_str()), ("CLOUDROID_SERVER", server.as_str()), ("NO_COLOR", "1")];
    site.start_installed_with_environment(&variables, &overlay, SERVICE, "sentry", &[])
}

fn drive_across_failover(daemon: &Daemon) -> Verdict {
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    let site = Site::with_ros(RosVersion::Two)?;
    let app = site.join("/app")?;
    let stub = start_stub(&site, daemon, &way.server.to_string())?;
    let driven = drive_node(site, app, daemon, (&way, &stub));
    driven.with_context(|| format!("the stub said:\n{}", stub.output()))
}

fn drive_node(site: Site, app: Arc<dyn Bus>, daemon: &Daemon, (way, stub): (&Cutter, &NodeProcess)) -> Verdict {
    site.wait_for_graph(&app, "the node", |graph| LifecycleNode::has_lifecycle(graph, SENTRY))?;
    stub.wait_for_output("linked to")?;
    // The robot drives the lifecycle: the node does not activate by itself.
    let shows = |state: &str| {
        let wanted = sentry_in_state(state);
        support::wait_until(&format!("a sentry that is {state}"), || {
            let shown = lifecycle_states(daemon, "drives")?;
            Ok(if shown == wanted { Ok(()) } else { Err(format!("{shown:#}")) })
        })
    };
    shows("unconfigured")?;
    let mut guarded = GuardedRobot {
        alarms: site.subscribe(&app, "/alarm")?,
        noise: site.advertise_strings(&app, "/noise", false)?,
        app,
        site,
        noises: 0,
    };
    let (unconfigured, inactive, active) = (State::Unconfigured, State::Inactive, State::Active);
    let configures = (Transition::Configure, [unconfigured, State::Configuring, inactive]);
    let activates = (Transition::Activate, [inactive, State::Activating, active]);
    guarded.transition_through(&[configures])?;
    shows("inactive")?;
    guarded.transition_through(&[activates])?;
    shows("active")?;
    let here = nix::unistd::gethostname()?;
    let here = here.to_string_lossy();
    let in_the_cloud = guarded.wait_for_alarm()?;
    ensure!(in_the_cloud != here, "the servant has the name of its host");

    // The original has to get into the state that the robot has chosen.
    way.cut(true);
    stub.wait_for_output("the local original answers, too why=LinkDown")?;
    let on_the_robot = guarded.wait_for_alarm()?;
    ensure!(on_the_robot == here, "{on_the_robot} raised it");
    let node = LifecycleNode::new(Arc::clone(&guarded.app), SENTRY);
    let state = guarded.site.runtime.block_on(node.state())?;
    ensure!(state == active, "{state}");
    way.cut(false);
    stub.wait_for_output("the cloud answers alone why=LinkUp")?;
    stub.wait_for_output("the local original is stopped why=LinkUp")?;
    let again = guarded.wait_for_alarm()?;
    ensure!(again == in_the_cloud, "{again} raised it");
    Ok(())
}
