//! A servant of ROS 2 with several nodes: one with a lifecycle, which works for its robot once it is active, and two that pass pictures
//! to each other by shared memory. All of it is one story, since a push of ROS 2 takes long.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::sync::Arc;

use anyhow::{Context, ensure};
use nix::sys::stat::{major, minor};
use ros::bus::{Bus, Message, Publisher, RosVersion, Subscription, WireFormat};
use ros::ros2::lifecycle::{LifecycleNode, State, StateChange, Transition};
use serde_json::{Value, json};
use support::cutter::Cutter;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::patience::{patience, wait_for};
use support::robot::Robot;
use support::site::{Running, Site, string_of};
use support::world::world;
use support::{Verdict, procfs};

const SERVICE: &str = "sentry_ros2";
const SENTRY: &str = "/sentry";
/// Of pictures, 1920 by 1080 in three colours.
const SIZE: u64 = 1920 * 1080 * 3;
/// Of what programs map that share memory by Fast DDS.
const SHARED: &str = "/dev/shm/fastrtps_";

pub fn nodes_of_a_servant_become_active_and_share_their_memory() -> Verdict {
    let place = tempfile::tempdir()?;
    let post = place.path().join("post");
    std::fs::create_dir(&post)?;
    let closed = post.join("closed");
    let config = format!("[allow]\nvolumes = [{post:?}]\n");
    let daemon = world().own("lifecycle").config(&config).start()?;
    let volume = format!("{}:/post", path_str(&post));
    let arguments = [
        "--node",
        "sentry",
        "--node",
        "eye",
        "--node",
        "reader",
        "--param",
        "drowsy=1.0",
        "--volume",
        &volume,
    ];
    let pushed = daemon.deployer().pushes(SERVICE, &arguments)?;
    pushed.succeeded()?;
    let service = daemon.api(&format!("/api/v1/services/{SERVICE}"))?;
    ensure!(
        service["interface"]["lifecycle"] == json!([SENTRY]),
        "{service:#}"
    );

    let mut robot = who_connects_has_an_active_node(&daemon)?;
    pictures_pass_by_memory_of_one_servant(&daemon, &mut robot)?;
    robot.leaves()?;
    std::fs::write(&closed, "")?;
    a_node_that_does_not_activate_is_given_to_nobody(&daemon, &arguments)?;
    std::fs::remove_file(&closed)?;
    a_robot_drives_its_node_wherever_that_runs(&daemon)?;
    daemon.deployer().types(&["stop", "--all"])?.succeeded()?;
    daemon.ends()?;
    Ok(())
}

/// The states that a robot's servant shows of its nodes.
fn stages(daemon: &Daemon, robot: &str) -> anyhow::Result<Value> {
    Ok(daemon.servant_of(SERVICE, robot)?["lifecycle"].clone())
}

/// What is shown of the sentry in this state.
fn in_state(state: &str) -> Value {
    json!([{"node": SENTRY, "state": state}])
}

fn who_connects_has_an_active_node(daemon: &Daemon) -> anyhow::Result<Robot> {
    let mut robot = daemon.robot(&format!("{SERVICE}?robot=asks"))?;
    // What is said while the sentry wakes up is heard by it, since its servant is not ready before.
    robot.says(json!({"op": "subscribe", "topic": "/alarm"}))?;
    robot.says(json!({"op": "advertise", "topic": "/noise", "type": "std_msgs/msg/String"}))?;
    robot.says(json!({"op": "publish", "topic": "/noise", "msg": {"data": "steps"}}))?;
    let alarm = robot.hears_on("/alarm")?;
    let alarm = alarm["data"].as_str().context("a text")?;
    ensure!(alarm.starts_with("steps heard by "), "{alarm}");
    let stages = stages(daemon, "asks")?;
    ensure!(stages == in_state("active"), "{stages:#}");
    Ok(robot)
}

/// Processes of a robot's servant that run these programs.
fn processes(daemon: &Daemon, robot: &str, programs: [&str; 2]) -> anyhow::Result<[i32; 2]> {
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

/// What a process has mapped of memory that Fast DDS shares: file system and file.
fn shared_memory(pid: i32) -> anyhow::Result<BTreeSet<(String, String)>> {
    let maps = std::fs::read_to_string(format!("/proc/{pid}/maps"))?;
    let lines = maps.lines().filter(|line| line.contains(SHARED));
    let files = lines.filter_map(|line| {
        // Addresses, rights and offset stand before (proc_pid_maps(5)).
        let mut words = line.split_whitespace().skip(3);
        Some((words.next()?.to_owned(), words.next()?.to_owned()))
    });
    Ok(files.collect())
}

/// Bytes that have come over the loopback of a process's network.
fn over_loopback(pid: i32) -> anyhow::Result<u64> {
    let devices = std::fs::read_to_string(format!("/proc/{pid}/net/dev"))?;
    let mut lines = devices.lines().map(str::trim);
    let counts = lines.find_map(|line| line.strip_prefix("lo:"));
    let received = counts.and_then(|counts| counts.split_whitespace().next());
    Ok(received.context("a loopback")?.parse()?)
}

fn pictures_pass_by_memory_of_one_servant(daemon: &Daemon, robot: &mut Robot) -> Verdict {
    const PICTURES: u64 = 5;
    let mut other = daemon.robot(&format!("{SERVICE}?robot=beside"))?;
    other.subscribes("/seen")?;
    other.awaits_subscriber("/look")?;
    robot.subscribes("/seen")?;
    robot.says(json!({"op": "advertise", "topic": "/look", "type": "std_msgs/msg/UInt32"}))?;
    robot.awaits_subscriber("/look")?;
    let nodes = processes(daemon, "asks", ["eye", "reader"])?;
    let before = over_loopback(nodes[0])?;
    for number in 1..=PICTURES {
        robot.says(json!({"op": "publish", "topic": "/look", "msg": {"data": number}}))?;
        let seen = robot.hears_on("/seen")?;
        let whole = format!("{number}: {SIZE} bytes, whole");
        ensure!(seen["data"] == whole, "{seen}");
    }
    let carried = over_loopback(nodes[0])? - before;
    ensure!(
        carried < SIZE,
        "{PICTURES} pictures of {SIZE} bytes took {carried} bytes of the network"
    );
    let [eye, reader] = nodes.map(shared_memory);
    let (eye, reader) = (eye?, reader?);
    ensure!(!eye.is_disjoint(&reader), "{eye:?} and {reader:?}");
    // Neither who is beside it nor this machine has any of that.
    for node in processes(daemon, "beside", ["eye", "reader"])? {
        let theirs = shared_memory(node)?;
        let ours = eye.union(&reader);
        let systems: BTreeSet<&String> = ours.map(|(system, _)| system).collect();
        ensure!(!theirs.is_empty(), "they share memory, too");
        ensure!(
            theirs.iter().all(|(system, _)| !systems.contains(system)),
            "{theirs:?} beside {eye:?}"
        );
    }
    let device = std::fs::metadata("/dev/shm")?.dev();
    let host = format!("{:02x}:{:02x}", major(device), minor(device));
    ensure!(
        eye.union(&reader).all(|(system, _)| *system != host),
        "{eye:?} is on {host}, which is this machine's"
    );
    let seen = |told: &Value| told["op"] == "publish" && told["topic"] == "/seen";
    ensure!(other.has_not_heard(seen)?, "it heard of another's pictures");
    other.leaves()
}

fn a_node_that_does_not_activate_is_given_to_nobody(
    daemon: &Daemon,
    arguments: &[&str],
) -> Verdict {
    let words = [SENTRY, "does not activate", "inactive"];
    let mut refused = daemon.robot(&format!("{SERVICE}?robot=refused"))?;
    let told = refused.hears_status("does not activate")?;
    let said = told["msg"].as_str().unwrap_or_default();
    ensure!(words.iter().all(|word| said.contains(word)), "{told}");
    refused.hears_close()?;
    daemon.awaits_event("that it was refused", |event| {
        let message = event["message"].to_string();
        event["kind"] == "lifecycle-refused" && words.iter().all(|word| message.contains(word))
    })?;
    // Nor is it published.
    let again = [&["--name", "closed"], arguments].concat();
    let pushed = daemon.deployer().pushes(SERVICE, &again)?;
    pushed.failed_saying(&words)?;
    Ok(())
}

/// A robot's nodes that make noise and hear alarms, and what drives the sentry.
struct Guarded {
    // In the order in which they end.
    alarms: Subscription,
    noise: Box<dyn Publisher>,
    app: Arc<dyn Bus>,
    site: Site,
    noises: u32,
}

impl Guarded {
    /// The sentry is told to become this, and tells of it.
    fn becomes(&self, way: &[(Transition, [State; 3])]) -> Verdict {
        let node = LifecycleNode::of(Arc::clone(&self.app), SENTRY);
        self.site.runtime.block_on(async {
            let mut changes = node.watch().await?;
            for (transition, [from, by, to]) in way {
                ensure!(node.state().await? == *from);
                node.change(*transition, patience()).await?;
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

    /// Makes noise until an alarm of it is heard: on which host it was raised.
    fn alarmed(&mut self) -> anyhow::Result<String> {
        let (noises, begun) = (Cell::new(self.noises), self.noises);
        let ask = || {
            noises.set(noises.get() + 1);
            let noise = format!("noise {}", noises.get());
            self.noise.publish(string_of(WireFormat::Cdr, &noise));
            Ok(())
        };
        let mut raised = None;
        // One of noise that was made before says nothing of who raises alarms now.
        let is_of_now = |alarm: &Message| {
            let said = String::from_utf8_lossy(&alarm.bytes).into_owned();
            raised = (begun + 1..=noises.get()).find_map(|number| {
                let (_, host) = said.split_once(&format!("noise {number} heard by "))?;
                Some(host.trim_end_matches('\0').to_owned())
            });
            Ok(raised.is_some())
        };
        let heard = self.site.asks_until(&mut self.alarms, ask, is_of_now);
        heard.context("an alarm should be heard")?;
        self.noises = noises.get();
        raised.context("a host")
    }
}

/// The stub as its archive comes, before an original on the robot.
fn stub(site: &Site, daemon: &Daemon, server: &str) -> anyhow::Result<Running> {
    let settings = "robot = \"drives\"\nfallback_after = 1.0\n";
    let overlay = site.installs(daemon, SERVICE, settings)?;
    let program = format!("/opt/cloudroid/install/lib/{SERVICE}/sentry");
    let original = site.installs_original(daemon, SERVICE, (SERVICE, "sentry"), &program)?;
    let prefixes = format!("{}:{}", overlay.display(), original.display());
    let server = format!("ws://{server}");
    let variables = [
        ("AMENT_PREFIX_PATH", prefixes.as_str()),
        ("CLOUDROID_SERVER", server.as_str()),
        ("NO_COLOR", "1"),
    ];
    site.runs_among(&variables, &overlay, SERVICE, "sentry", &[])
}

fn a_robot_drives_its_node_wherever_that_runs(daemon: &Daemon) -> Verdict {
    let way = Cutter::new(&daemon.address, 0, 1, 1)?;
    let site = Site::of(RosVersion::Two)?;
    let app = site.joins("/app")?;
    let stub = stub(&site, daemon, &way.server.to_string())?;
    let driven = drive(site, app, daemon, (&way, &stub));
    driven.with_context(|| format!("the stub said:\n{}", stub.said()))
}

fn drive(
    site: Site,
    app: Arc<dyn Bus>,
    daemon: &Daemon,
    (way, stub): (&Cutter, &Running),
) -> Verdict {
    site.until(&app, "the node", |graph| {
        LifecycleNode::is_one(graph, SENTRY)
    })?;
    stub.says("linked to")?;
    // It is the robot's to drive: nobody else has it begin.
    let shows = |state: &str| {
        let wanted = in_state(state);
        support::until(&format!("a sentry that is {state}"), || {
            let shown = stages(daemon, "drives")?;
            Ok(if shown == wanted {
                Ok(())
            } else {
                Err(format!("{shown:#}"))
            })
        })
    };
    shows("unconfigured")?;
    let mut guarded = Guarded {
        alarms: site.hears(&app, "/alarm")?,
        noise: site.says(&app, "/noise", false)?,
        app,
        site,
        noises: 0,
    };
    let (unconfigured, inactive, active) = (State::Unconfigured, State::Inactive, State::Active);
    let configures = (
        Transition::Configure,
        [unconfigured, State::Configuring, inactive],
    );
    let activates = (Transition::Activate, [inactive, State::Activating, active]);
    guarded.becomes(&[configures])?;
    shows("inactive")?;
    guarded.becomes(&[activates])?;
    shows("active")?;
    let here = nix::unistd::gethostname()?;
    let here = here.to_string_lossy();
    let in_the_cloud = guarded.alarmed()?;
    ensure!(in_the_cloud != here, "the servant has the name of its host");

    // The original has to be what the robot has made of the node.
    way.cut(true);
    stub.says("the local original answers, too why=LinkDown")?;
    let on_the_robot = guarded.alarmed()?;
    ensure!(on_the_robot == here, "{on_the_robot} raised it");
    let node = LifecycleNode::of(Arc::clone(&guarded.app), SENTRY);
    let state = guarded.site.runtime.block_on(node.state())?;
    ensure!(state == active, "{state}");
    way.cut(false);
    stub.says("the cloud answers alone why=LinkUp")?;
    stub.says("the local original is stopped why=LinkUp")?;
    let again = guarded.alarmed()?;
    ensure!(again == in_the_cloud, "{again} raised it");
    Ok(())
}
