//! Tests of servants that are made before their robots come, and of servants that fail repeatedly.

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// Starts a daemon with warm containers, of which `nodes` have running nodes.
fn daemon_with_pool(world: &World, nodes: usize) -> Choreographer {
    let daemon = world.daemon_with(|options| {
        options.warm_pool = 8;
        options.warm_nodes = nodes;
    });
    daemon.keep_warm_pool();
    daemon
}

/// Waits until the pool has this size and this number with running nodes.
async fn wait_for_pool(daemon: &Choreographer, wanted: (usize, usize)) {
    let there = async {
        while daemon.warm_pool() != wanted {
            tokio::time::sleep(SECOND / 10).await;
        }
    };
    let there = tokio::time::timeout(SECOND * 600, there).await;
    assert!(there.is_ok(), "{:?} is not {wanted:?}", daemon.warm_pool());
}

fn promised_cores(daemon: &Choreographer) -> f64 {
    daemon.admission().snapshot().1.cpus()
}

#[tokio::test(start_paused = true)]
async fn a_robot_gets_a_servant_whose_nodes_run_already() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = daemon_with_pool(&world, 1);
    wait_for_pool(&daemon, (1, 1)).await;
    assert_eq!(promised_cores(&daemon), 1.0, "nodes that run are promised a core");
    let ids = world.engine.servants();
    assert!(daemon.servants().is_empty(), "it is nobody's");
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    assert_eq!(ids, [lease.handle().id.clone()]);
    let shown = daemon.describe(lease.handle()).await;
    assert_eq!((&*shown.robot, shown.connections), ("r1", 1));
    let ready = world.event_messages("servant-ready");
    assert!(ready[0].contains("for r1"), "{ready:?}");
    // Another one takes its place, and is promised the second core.
    wait_for_pool(&daemon, (1, 1)).await;
    assert_eq!(promised_cores(&daemon), 2.0);
    daemon.end_warm_pool().await;
    assert_eq!(promised_cores(&daemon), 1.0);
    assert_eq!(world.engine.servants(), ids);
}

#[tokio::test(start_paused = true)]
async fn only_what_is_measured_with_so_much_memory_starts_nodes_of_its_own() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = daemon_with_pool(&world, 1);
    wait_for_pool(&daemon, (1, 1)).await;
    let ahead = world.engine.servants();
    let memory = Some(api::Size(64 << 20));
    let set = api::Limits { memory, ..api::Limits::default() };
    let measured = daemon.start_measured("greet", "calibrate", set).expect("a lease");
    measured.lease.wait_ready().await.expect("ready");
    assert_ne!(ahead, [measured.lease.handle().id.clone()]);
    drop(measured);
    wait_for_pool(&daemon, (1, 1)).await;
    let ahead = world.engine.servants();
    let stated = api::Stated { memory, ..api::Stated::default() };
    let request = ServantRequest::new("greet", "~abc").with_stated(stated);
    let lease = daemon.ensure(request.anonymous()).expect("a lease");
    lease.wait_ready().await.expect("ready");
    assert!(ahead.contains(&lease.handle().id), "its nodes ran already");
    daemon.end_warm_pool().await;
}

#[tokio::test(start_paused = true)]
async fn a_robots_stubs_get_no_servant_whose_nodes_have_other_names() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = daemon_with_pool(&world, 1);
    wait_for_pool(&daemon, (1, 1)).await;
    let ids = world.engine.servants();
    let lease = daemon.ensure(ServantRequest::new("greet", "r1").with_stub("/greeter")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    assert!(!ids.contains(&lease.handle().id));
    let servant = world.engine.servant(&lease.handle().id).expect("it runs");
    assert!(servant::engine::ServantHandle::nodes(&*servant).is_empty());
}

#[tokio::test(start_paused = true)]
async fn what_is_kept_ready_ends_before_a_robot_waits() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    world.publish("map", "/greet", |record| {
        record.plan.limits.cpus = Some(2.0);
    });
    let daemon = daemon_with_pool(&world, 2);
    // The second of them does not fit beside the first.
    wait_for_pool(&daemon, (2, 1)).await;
    let lease = daemon.ensure(ServantRequest::new("map", "r1")).expect("a lease");
    lease.wait_ready().await.expect("ready");
    assert_eq!(promised_cores(&daemon), 2.0);
    assert_eq!(daemon.warm_pool().1, 0, "there is no capacity for it");
}

#[tokio::test(start_paused = true)]
async fn a_service_that_cannot_be_made_ahead_keeps_no_other_cold() {
    let world = World::new();
    for service in ["a", "greet", "z"] {
        world.publish(service, "/greet", |_| {});
    }
    // Whatever the order in which they are made, one comes before another.
    for broken in ["a", "z"] {
        world.engine.break_image(&format!("sha256:{broken}"), "its image is damaged");
    }
    let daemon = daemon_with_pool(&world, 1);
    wait_for_pool(&daemon, (1, 1)).await;
    tokio::time::sleep(SECOND * 600).await;
    assert_eq!(daemon.warm_pool(), (1, 1));
    let told = world.event_messages("warm-failed");
    let words = "in advance: ";
    assert!(told.iter().all(|it| it.contains(words)), "{told:?}");
    // Each is retried after growing pauses.
    assert!((6..=40).contains(&told.len()), "{}: {told:?}", told.len());
    assert!(told[0].contains("its image is damaged"), "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn whether_one_more_fits_knows_that_what_is_kept_ready_would_end() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    world.publish("map", "/greet", |record| {
        record.plan.limits.cpus = Some(2.0);
    });
    let daemon = daemon_with_pool(&world, 2);
    wait_for_pool(&daemon, (2, 1)).await;
    let fit = daemon.fit("map", api::Stated::default()).await;
    let fit = fit.expect("it is published");
    assert_eq!((fit.lacking_cpus, fit.more), (0.0, Some(1)), "{fit:?}");
    assert_eq!((fit.now, fit.ends.len()), (false, 1), "{fit:?}");
    assert_eq!(fit.costs, []);
}

#[tokio::test(start_paused = true)]
async fn nodes_that_fail_without_a_robot_are_told_and_back_off() {
    let world = World::new();
    world.engine.program("/fails", |process| fails(process, SECOND));
    world.publish("greet", "/fails", |_| {});
    let daemon = daemon_with_pool(&world, 1);
    tokio::time::sleep(SECOND * 600).await;
    let told = world.event_messages("warm-failed");
    let words = "/greeter exited with status 1";
    assert!(told.iter().all(|told| told.contains(words)), "{told:?}");
    // Ten seconds apart without pauses.
    assert!((3..=15).contains(&told.len()), "{told:?}");
    let backs_off = async {
        while daemon.back_offs().is_empty() {
            tokio::time::sleep(SECOND / 2).await;
        }
        daemon.back_offs()
    };
    let back_offs = tokio::time::timeout(SECOND * 600, backs_off).await;
    let back_offs = back_offs.expect("it fails again");
    assert_eq!((&*back_offs[0].robot, &*back_offs[0].service), ("~warm", "greet"));
    // A robot's back-off is separate.
    daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
}

#[tokio::test]
async fn what_a_killed_daemon_kept_ready_ends_without_a_word() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon_with(|options| {
        options.warm_pool = 8;
        options.warm_nodes = 1;
    });
    let died = tokio::task::spawn_blocking(move || {
        let runtime = tokio::runtime::Runtime::new().expect("a runtime");
        runtime.block_on(async {
            daemon.keep_warm_pool();
            wait_for_pool(&daemon, (1, 1)).await;
        });
        runtime.shutdown_background();
    });
    died.await.expect("no panic");
    assert_eq!(world.engine.servants().len(), 1);
    let next = world.daemon();
    let inherited = next.adopt().await.expect("it starts");
    assert_eq!(inherited.adopted, 0);
    let left = world.engine.servants().len();
    assert_eq!(left, 1, "robots wait for no removal");
    inherited.removal.await.expect("no panic");
    assert!(world.engine.servants().is_empty());
    let events = world.state.events(0, 100).expect("events");
    assert!(events.is_empty(), "{events:?}");
    assert!(world.state.servants().expect("servants").is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_servant_that_fails_again_and_again_is_started_after_pauses_that_grow() {
    let world = World::new();
    world.engine.program("/broken", |_| async { 3 });
    world.publish("greet", "/broken", |_| {});
    world.publish("other", "/greet", |_| {});
    let daemon = world.daemon();
    let mut pauses = Vec::new();
    let mut starts = 0;
    while pauses.len() < 4 {
        match daemon.ensure(ServantRequest::new("greet", "r1")) {
            Ok(lease) => {
                let reason = failure(&lease).await;
                assert!(reason.contains("status 3"), "{reason}");
                starts += 1;
            }
            Err(Error::BackOff { failures, reason, again, .. }) => {
                assert_eq!(failures, starts);
                assert!(reason.contains("status 3"), "{reason}");
                pauses.push(seconds(again));
                let shown = daemon.back_offs();
                assert_eq!((&*shown[0].robot, shown[0].failures), ("r1", starts));
                // Others are served meanwhile.
                daemon.ensure(ServantRequest::new("greet", "r2")).expect("a lease");
                daemon.ensure(ServantRequest::new("other", "r1")).expect("a lease");
                tokio::time::sleep(again).await;
            }
            Err(error) => panic!("{error}"),
        }
    }
    assert_eq!(pauses, [1, 2, 4, 8]);
    let told = world.event_messages("servant-back-off");
    assert!(told[0].contains("2 times in a row") && told[0].contains("in 1 s"), "{told:?}");
    assert!(daemon.back_offs().is_empty(), "its pause is over");
    failure(&daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease")).await;
    daemon.ensure(ServantRequest::new("greet", "r1")).err().expect("a pause");
    // A new push is started at once.
    world.publish("greet", "/greet", |_| {});
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    lease.wait_ready().await.expect("ready");
}
