//! Tests of servants' lives from start to end, with the in-memory engine.

use std::future::pending;

use in_memory::Process;
use servant::spec::NodeSpec;

use super::*;

mod ahead;
mod hung;
mod kept_logs;
mod log;
mod rollouts;
mod traces;

/// Returns a request of this robot for a servant of `greet`, with this statement.
pub(super) fn request_stating(robot: &str, query: &[(&str, &str)]) -> ServantRequest {
    let stated = api::Stated::read(query.iter().copied()).expect("valid");
    ServantRequest::new("greet", robot).with_stated(stated)
}

/// Returns a lease of a ready servant.
pub(super) async fn ready(daemon: &Choreographer, request: ServantRequest) -> Lease {
    let lease = daemon.ensure(request).expect("a lease");
    lease.wait_ready().await.expect("ready");
    lease
}

/// A machine, with everything that outlives a daemon on it.
pub(super) struct World {
    home: tempfile::TempDir,
    pub(super) state: Arc<State>,
    catalogue: Arc<Catalogue>,
    pub(super) engine: MemoryEngine,
}

impl World {
    pub(super) fn new() -> World {
        let home = tempfile::tempdir().expect("a directory");
        let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
        let state = Arc::new(state);
        let store = image::Store::open(&home.path().join("images"), &home.path().join("layers")).expect("a store");
        let engine = MemoryEngine::default();
        engine.program("/greet", |process| async move {
            process.advertise("/greeting", "std_msgs/String");
            pending().await
        });
        World { home, catalogue: Arc::new(Catalogue::new(Arc::clone(&state), Arc::new(store))), state, engine }
    }

    /// Starts a daemon, which promises a core to each servant and has two.
    pub(super) fn daemon(&self) -> Choreographer {
        self.daemon_with(|_| {})
    }

    /// Starts a daemon with other options.
    pub(super) fn daemon_with(&self, change: impl FnOnce(&mut Options)) -> Choreographer {
        let mut options = Options { warm_pool: 0, reserve_cpus: 1.0, reserve_memory: 0, ..options() };
        change(&mut options);
        Choreographer::new(
            options,
            Arc::clone(&self.state),
            Arc::clone(&self.catalogue),
            Arc::new(self.engine.clone()),
            Arc::new(self.engine.clone()),
            Admission::new(Amount::new(2.0, 1 << 30), 16),
        )
    }

    /// Returns a revision of a service with one node, `/greeter`, that runs `program` and publishes a topic.
    fn record(service: &str, program: &str) -> RevisionRecord {
        let mut record = revision(&format!("sha256:{service}"), 1.0);
        record.service = service.to_owned();
        record.plan.limits = api::Limits::default();
        record.plan.nodes = vec![node(program)];
        let greeting = serde_json::json!({
            "name": "/greeting", "type": "std_msgs/String", "direction": "output", "nodes": ["/greeter"],
        });
        record.interface.topics = vec![serde_json::from_value(greeting).expect("a topic")];
        record
    }

    /// Publishes a service with one node, `/greeter`, that runs `program` and publishes a topic.
    pub(super) fn publish(&self, service: &str, program: &str, change: impl FnOnce(&mut RevisionRecord)) {
        let mut record = World::record(service, program);
        change(&mut record);
        let published = self.state.publish(&record, &Default::default());
        published.expect("published");
    }

    /// Returns the messages of events of a kind.
    pub(super) fn event_messages(&self, kind: &str) -> Vec<String> {
        let mut events = self.state.events(0, 1000).expect("events");
        events.retain(|event| event.kind == kind);
        events.into_iter().map(|event| event.message).collect()
    }
}

fn node(program: &str) -> NodeSpec {
    let node = serde_json::json!({ "name": "/greeter", "argv": [program] });
    serde_json::from_value(node).expect("a node")
}

/// Returns the reason and the log of a servant that does not become ready, or has failed.
fn failure_parts(error: Error) -> (String, Vec<String>) {
    match error {
        Error::Servant { reason, log, .. } => (reason, log),
        other => panic!("{other}"),
    }
}

async fn failure(lease: &Lease) -> String {
    lease.handle().wait_ended().await;
    lease.handle().life().reason().expect("a reason")
}

#[tokio::test(start_paused = true)]
async fn a_servant_is_ready_with_its_interface_and_ends_when_its_robot_stays_away() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    let reach = lease.wait_ready().await.expect("ready");
    assert!(reach.graph().borrow().nodes.contains_key("/greeter"));
    let handle = Arc::clone(lease.handle());
    let shown = daemon.describe(&handle).await;
    assert_eq!((shown.phase, shown.connections), (Phase::Ready, 1));
    assert_eq!(shown.usage.expect("it runs").pids, 1);
    assert_eq!(world.engine.started_specs()[0].image, "sha256:greet");
    // Back within the grace time, and then not.
    drop(lease);
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    assert!(Arc::ptr_eq(lease.handle(), &handle), "the same servant");
    drop(lease);
    handle.wait_ended().await;
    assert_eq!(handle.life().phase, Phase::Stopped);
    assert!(world.engine.servants().is_empty(), "nothing is left");
    assert_eq!(world.event_messages("servant-stopped").len(), 1);
}

#[tokio::test(start_paused = true)]
async fn a_node_that_ends_before_it_is_ready_is_told_with_its_last_words() {
    let world = World::new();
    world.engine.program("/broken", |process| async move {
        process.print("no model in /models");
        3
    });
    world.publish("greet", "/broken", |_| {});
    world.publish("other", "/missing", |_| {});
    let daemon = world.daemon();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    let (reason, log) = failure_parts(lease.wait_ready().await.err().expect("it failed"));
    assert!(reason.contains("/greeter exited with status 3"), "{reason}");
    assert_eq!(log, ["no model in /models"]);
    let lease = daemon.ensure(ServantRequest::new("other", "r1")).expect("a lease");
    let (reason, _) = failure_parts(lease.wait_ready().await.err().expect("it failed"));
    assert!(reason.contains("there is no program /missing"), "{reason}");
}

#[tokio::test(start_paused = true)]
async fn what_cannot_be_started_and_what_is_not_granted_is_told_as_such() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    world.engine.break_image("sha256:greet", "the registry is away");
    let daemon = world.daemon();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    let (reason, _) = failure_parts(lease.wait_ready().await.err().expect("it failed"));
    assert!(reason.ends_with("the registry is away"), "{reason}");
    let camera = api::Grants { devices: vec!["lab.org/camera=0".to_owned()], ..api::Grants::default() };
    let refused = daemon.check_grants(&camera).expect_err("not allowed");
    assert!(refused.to_string().contains("[allow]"), "{refused}");
    world.publish("see", "/greet", |record| record.plan.grants = camera.clone());
    let lease = daemon.ensure(ServantRequest::new("see", "r1")).expect("a lease");
    let (reason, _) = failure_parts(lease.wait_ready().await.err().expect("it failed"));
    assert!(reason.contains("lab.org/camera=0"), "{reason}");
    world.engine.allow(camera.clone());
    let lease = daemon.ensure(ServantRequest::new("see", "r2")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    let started = world.engine.started_specs();
    assert_eq!(started.last().expect("it was started").grants, camera);
}

/// A program that greets, then fails once it was heard, and never recovers.
async fn fails(process: Process, after: Duration) -> i32 {
    process.advertise("/greeting", "std_msgs/String");
    tokio::time::sleep(after).await;
    1
}

#[tokio::test(start_paused = true)]
async fn a_failing_node_is_started_again_after_pauses_and_then_given_up() {
    let world = World::new();
    let program = |process| fails(process, Duration::from_secs(1));
    world.engine.program("/fails", program);
    world.publish("greet", "/fails", |record| record.plan.restart = true);
    let daemon = world.daemon();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    let reason = failure(&lease).await;
    assert!(reason.contains("gave up on /greeter"), "{reason}");
    let told = world.event_messages("node-failed");
    let pauses: Vec<_> = told.iter().filter_map(|text| text.rsplit_once(" in ")).map(|(_, pause)| pause).collect();
    let expected = ["500", "1000", "2000", "4000", "8000", "16000"];
    assert_eq!(pauses, expected.map(|pause| format!("{pause} ms")));
}

#[tokio::test(start_paused = true)]
async fn a_respawning_node_is_the_engines_and_its_servant_lives_on() {
    let world = World::new();
    world.engine.program("/again", |process| async move {
        process.advertise("/greeting", "std_msgs/String");
        match process.start() {
            1 => tokio::time::sleep(Duration::from_secs(1)).await,
            _ => pending().await,
        }
        7
    });
    world.publish("greet", "/again", |record| {
        record.plan.nodes[0].respawn = true;
        record.plan.nodes[0].respawn_delay = 2.0;
    });
    let daemon = world.daemon();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    let reach = lease.wait_ready().await.expect("ready");
    let mut graph = reach.graph();
    let there = |graph: &Arc<ros::bus::Graph>| graph.nodes.contains_key("/greeter");
    graph.wait_for(|graph| !there(graph)).await.expect("a graph");
    graph.wait_for(there).await.expect("a graph");
    let told = world.event_messages("node-respawned");
    assert!(told[0].contains("exited with status 7") && told[0].contains("after 2 s"), "{told:?}");
    assert_eq!(lease.handle().life().phase, Phase::Ready);
}

#[tokio::test(start_paused = true)]
async fn limits_are_changed_while_it_runs_and_more_memory_than_allowed_ends_it() {
    let world = World::new();
    let (sender, eats) = tokio::sync::watch::channel(0);
    world.engine.program("/eats", move |process| {
        let mut eats = eats.clone();
        async move {
            process.allocate(100 << 20).await;
            process.advertise("/greeting", "std_msgs/String");
            while eats.changed().await.is_ok() {
                process.allocate(100 << 20).await;
            }
            0
        }
    });
    let memory = |mib: u64| api::Limits { memory: Some(api::Size(mib << 20)), ..api::Limits::default() };
    world.publish("greet", "/eats", |record| record.plan.limits = memory(150));
    let daemon = world.daemon();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    let id = lease.handle().id.clone();
    let enforced = async || {
        let shown = daemon.describe(lease.handle()).await;
        shown.enforced.expect("it runs").memory
    };
    assert_eq!(enforced().await, Some(api::Size(150 << 20)));
    let refused = daemon.set_limits(&id, memory(50)).await;
    assert!(matches!(refused, Err(Error::Engine(_))), "it holds more");
    assert_eq!(enforced().await, Some(api::Size(150 << 20)), "taken back");
    daemon.set_limits(&id, memory(250)).await.expect("changed");
    assert_eq!(enforced().await, Some(api::Size(250 << 20)));
    sender.send_modify(|times| *times += 1);
    tokio::task::yield_now().await;
    assert_eq!(lease.handle().life().phase, Phase::Ready);
    sender.send_modify(|times| *times += 1);
    let reason = failure(&lease).await;
    assert!(reason.contains("250"), "{reason}");
    assert_eq!(world.event_messages("out-of-memory").len(), 1);
}

#[tokio::test(start_paused = true)]
async fn who_finds_no_room_waits_until_an_idle_servant_has_ended() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let ready = async |robot: &str| {
        let lease = daemon.ensure(ServantRequest::new("greet", robot)).expect("a lease");
        lease.wait_ready().await.expect("ready");
        lease
    };
    let (first, _second) = (ready("r1").await, ready("r2").await);
    let third = daemon.ensure(ServantRequest::new("greet", "r3")).expect("a lease");
    let waiting = tokio::time::timeout(Duration::from_secs(1), third.wait_admitted());
    waiting.await.expect_err("there are two cores");
    let ended = Arc::clone(first.handle());
    drop(first);
    third.wait_ready().await.expect("ready");
    assert_eq!(ended.life().phase, Phase::Stopped);
    // Nobody leaves this time.
    let fourth = daemon.ensure(ServantRequest::new("greet", "r4")).expect("a lease");
    let refused = fourth.wait_ready().await.err().expect("no room");
    assert!(matches!(refused, Error::Full(_)), "{refused}");
}

#[tokio::test]
async fn what_an_earlier_daemon_left_is_adopted_one_by_one() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    // A daemon with its own runtime, which dies with all its tasks; the engine's nodes do not.
    let daemon = world.daemon();
    let died = tokio::task::spawn_blocking(move || {
        let runtime = tokio::runtime::Runtime::new().expect("a runtime");
        let ids = runtime.block_on(async {
            let mut ids = Vec::new();
            for robot in ["r1", "r2"] {
                let lease = daemon.ensure(ServantRequest::new("greet", robot)).expect("a lease");
                lease.wait_ready().await.expect("ready");
                ids.push(lease.handle().id.clone());
                // It dies before its robots leave.
                std::mem::forget(lease);
            }
            ids
        });
        runtime.shutdown_background();
        ids
    });
    let ids = died.await.expect("no panic");
    let ended = world.engine.servant(&ids[1]).expect("it is there");
    ended.fail("its node was killed");
    world.engine.leave_behind("half-made");
    let next = world.daemon();
    let inherited = next.adopt().await.expect("it starts");
    assert_eq!(inherited.adopted, 1);
    inherited.removal.await.expect("no panic");
    let left = world.event_messages("servant-leftover");
    assert!(left.len() == 1 && left[0].contains("half-made"), "{left:?}");
    let lost = world.event_messages("servant-lost");
    assert!(lost.len() == 1 && lost[0].contains(&ids[1]) && lost[0].ends_with("its node was killed"), "{lost:?}");
    let log = next.kept_log(&ids[1]).expect("its log is kept");
    assert!(log.failed && log.reason.ends_with("its node was killed"), "{}", log.reason);
    // The robot finds its servant, and nothing was started for that.
    let lease = next.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    assert_eq!(lease.handle().id, ids[0]);
    assert_eq!(world.engine.started_specs().len(), 2);
    next.stop("the test is over", |_| true).await;
    assert!(world.engine.servants().is_empty());
}

#[tokio::test(start_paused = true)]
async fn want_of_memory_while_it_is_measured_keeps_no_robot_waiting() {
    let world = World::new();
    world.engine.program("/eats", |process| async move {
        process.allocate(100 << 20).await;
        process.advertise("/greeting", "std_msgs/String");
        std::future::pending::<i32>().await
    });
    world.publish("greet", "/eats", |_| {});
    let daemon = world.daemon();
    let little = api::Limits { memory: Some(api::Size(50 << 20)), ..api::Limits::default() };
    // As often as would make a robot without a name wait.
    for _ in 0..5 {
        let measured = daemon.start_measured("greet", "calibrate", little);
        let measured = measured.expect("it is not held up");
        let reason = failure(&measured.lease).await;
        assert!(reason.contains("50M"), "{reason}");
        assert!(measured.lease.handle().was_out_of_memory());
    }
    assert!(daemon.back_offs().is_empty());
    let nameless = ServantRequest::new("greet", "~abc").anonymous();
    let lease = daemon.ensure(nameless).expect("a lease");
    lease.wait_ready().await.expect("it has all memory");
    assert!(!lease.handle().was_out_of_memory());
}

#[tokio::test(start_paused = true)]
async fn what_robots_may_ask_for_at_most_bounds_no_measurement() {
    let world = World::new();
    world.publish("greet", "/greet", |record| {
        record.plan.caps.memory = Some(api::Size(32 << 20));
    });
    let daemon = world.daemon();
    let memory = Some(api::Size(64 << 20));
    let stated = api::Stated { memory, ..api::Stated::default() };
    let robot = ServantRequest::new("greet", "r1").with_stated(stated);
    let refused = daemon.ensure(robot).err().expect("it is more");
    assert!(matches!(refused, Error::Terms(_)), "{refused}");
    let set = api::Limits { memory, ..api::Limits::default() };
    let measured = daemon.start_measured("greet", "calibrate", set).expect("a lease");
    measured.lease.wait_ready().await.expect("ready");
    assert_eq!(measured.lease.handle().limits().memory, memory);
    assert_eq!(daemon.admission().snapshot().1.memory, 64 << 20, "promised");
}
