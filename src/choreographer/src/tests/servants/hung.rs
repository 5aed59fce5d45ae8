//! Tests of nodes that run and answer nobody.

use super::*;

const SECOND: Duration = Duration::from_secs(1);

type Query<'a> = &'a [(&'a str, &'a str)];

/// Starts a servant whose nodes have answered one input, and then none of ten per second, until a hang is reported, or
/// for a minute. Then another minute passes without inputs.
async fn run_hanging(
    (hung, restart): (HungPolicy, bool),
    warm: bool,
    class: bool,
    stated: Query<'_>,
) -> (World, Lease) {
    let read = |pairs: Query<'_>| api::Stated::read(pairs.iter().copied()).expect("valid");
    let world = World::new();
    world.publish("greet", "/greet", |record| record.plan.restart = restart);
    let daemon = world.daemon_with(|options| {
        (options.hung, options.hung_after) = (hung, 5.0);
        (options.warm_pool, options.warm_nodes) = if warm { (8, 1) } else { (0, 0) };
        let by_default = ClassOptions { sla: read(&[("rrt", "300ms")]).sla, ..ClassOptions::default() };
        let name = DEFAULT_CLASS.to_owned();
        options.classes.extend(class.then_some((name, by_default)));
    });
    if warm {
        daemon.keep_warm_pool();
        while daemon.warm_pool() != (1, 1) {
            tokio::time::sleep(SECOND).await;
        }
    }
    daemon.watch_nodes();
    let request = ServantRequest::new("greet", "r1").with_stated(read(stated));
    let lease = daemon.ensure(request).expect("a lease");
    lease.wait_ready().await.expect("ready");
    let container = world.engine.servant(&lease.handle().id).expect("it runs");
    *container.flow.lock() = (1, 1);
    for _ in 0..60 {
        tokio::time::sleep(SECOND).await;
        container.flow.lock().0 += 10;
        if !world.event_messages("node-hung").is_empty() {
            break;
        }
    }
    tokio::time::sleep(SECOND * 60).await;
    (world, lease)
}

#[tokio::test(start_paused = true)]
async fn a_node_that_hangs_is_told_and_started_again_wherever_its_time_comes_from() {
    for (warm, class, stated) in [
        (false, false, &[("max_rrt", "300ms")][..]),
        (false, false, &[("rrt", "300ms")]),
        (true, false, &[("rrt", "300ms")]),
        (true, false, &[("rrt", "100ms"), ("max_rrt", "300ms")]),
        (true, true, &[]),
        (false, true, &[("aux.width", "640")]),
    ] {
        let (world, lease) = run_hanging((HungPolicy::Restart, true), warm, class, stated).await;
        let case = format!("{stated:?}, warm: {warm}, by class: {class}");
        let told = world.event_messages("node-hung");
        assert_eq!(told.len(), 1, "{case}: {told:?}");
        let words = "/greeter answered none of";
        assert!(told[0].contains(words), "{case}: {told:?}");
        let again = world.event_messages("node-failed");
        assert_eq!(again.len(), 1, "{case}: it is started again: {again:?}");
        assert!(lease.handle().hung_nodes().is_empty(), "{case}");
        let servant = world.engine.servant(&lease.handle().id);
        let reported = servant.expect("it runs").reported.lock().clone();
        assert_eq!(reported.len(), 1, "{case}: {reported:?}");
        assert!(told[0].starts_with(&reported[0]), "{case}: {reported:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_node_that_hangs_is_shown_until_it_answers() {
    let (world, lease) = run_hanging((HungPolicy::Report, true), true, false, &[("rrt", "300ms")]).await;
    let hung = lease.handle().hung_nodes();
    assert!(hung[0].contains("/greeter answered none of"), "{hung:?}");
    let container = world.engine.servant(&lease.handle().id).expect("it runs");
    container.flow.lock().1 += 1;
    tokio::time::sleep(SECOND * 2).await;
    assert!(lease.handle().hung_nodes().is_empty());
    assert_eq!(world.event_messages("node-failed"), Vec::<String>::new());
}

#[tokio::test(start_paused = true)]
async fn without_a_time_nothing_hangs() {
    for (class, stated) in [(false, &[][..]), (true, &[("cpus", "0.5")])] {
        let (world, _lease) = run_hanging((HungPolicy::Report, true), false, class, stated).await;
        assert_eq!(world.event_messages("node-hung"), Vec::<String>::new(), "{stated:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_node_that_nobody_starts_again_is_not_killed() {
    let stated = [("rrt", "300ms")];
    let (world, lease) = run_hanging((HungPolicy::Restart, false), false, false, &stated).await;
    let told = world.event_messages("node-hung");
    assert!(told[0].contains("it is not killed"), "{told:?}");
    assert!(!lease.handle().hung_nodes().is_empty(), "it runs, and hangs");
}
