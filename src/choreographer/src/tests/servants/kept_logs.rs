//! Tests of the logs that are kept of ended servants.

use servant::engine::Engine;

use super::*;

/// Publishes a service whose node prints this and fails; returns the id of a servant of it that has ended.
async fn fail_printing(
    world: &World,
    daemon: &Choreographer,
    service: &str,
    robot: &str,
    line: &'static str,
) -> String {
    let program = format!("/{service}");
    world.engine.program(&program, move |process| async move {
        process.print(line);
        3
    });
    if daemon.inner.state.service_package(service).expect("readable").is_none() {
        world.publish(service, &program, |_| {});
    }
    let lease = daemon.ensure(ServantRequest::new(service, robot)).expect("a lease");
    assert!(lease.wait_ready().await.is_err(), "it fails");
    lease.handle().wait_ended().await;
    lease.handle().id.clone()
}

fn kept_ids(daemon: &Choreographer) -> Vec<String> {
    daemon.kept_logs().into_iter().map(|one| one.servant).collect()
}

#[tokio::test(start_paused = true)]
async fn what_a_servant_printed_outlives_it_and_the_daemon() {
    let world = World::new();
    let daemon = world.daemon();
    let id = fail_printing(&world, &daemon, "greet", "r1", "no model").await;
    assert!(world.engine.servants().is_empty(), "nothing else is left");
    let kept = daemon.kept_log(&id).expect("it is kept");
    assert_eq!((&*kept.service, &*kept.robot, kept.failed), ("greet", "r1", true));
    assert!(kept.reason.contains("exited with status 3"), "{}", kept.reason);
    let lines = daemon.read_kept_log(&id, 1).await;
    assert_eq!(lines.iter().map(|line| &*line.line).collect::<Vec<_>>(), ["no model"]);
    let next = world.daemon();
    next.adopt().await.expect("it starts").removal.await.expect("no panic");
    assert_eq!(next.kept_logs(), [kept]);
    // Whoever publishes a service of this name next sees nothing of it.
    assert!(world.state.remove_service("greet").expect("written"));
    next.forget_logs("greet").await;
    assert_eq!(next.kept_logs(), []);
    assert_eq!(world.engine.kept_logs().await.expect("listed"), []);
    assert!(next.read_kept_log(&id, 1).await.is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_servant_that_fails_again_and_again_drives_out_its_own_logs_alone() {
    let world = World::new();
    let daemon = world.daemon_with(|options| options.kept_logs.quota.files = 2);
    let quiet = fail_printing(&world, &daemon, "quiet", "r1", "once").await;
    let mut busy = Vec::new();
    for robot in ["r1", "r2", "r3"] {
        busy.push(fail_printing(&world, &daemon, "busy", robot, "again").await);
    }
    let mut kept = kept_ids(&daemon);
    kept.sort();
    let mut expected = vec![quiet, busy.remove(2)];
    expected.sort();
    assert_eq!(kept, expected);
    assert_eq!(world.engine.kept_logs().await.expect("listed").len(), 2, "the others are removed");
}

#[tokio::test(start_paused = true)]
async fn no_log_is_kept_where_none_is_wanted() {
    let world = World::new();
    let daemon = world.daemon_with(|options| options.kept_logs.age = Duration::ZERO);
    fail_printing(&world, &daemon, "greet", "r1", "no model").await;
    assert_eq!(kept_ids(&daemon), [] as [String; 0]);
    assert_eq!(world.engine.kept_logs().await.expect("listed"), []);
}
