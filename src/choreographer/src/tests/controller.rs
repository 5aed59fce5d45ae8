//! Tests of moving cores while servants work, and of a stalling machine, with the in-memory engine.

use super::servants::World;
use super::*;
use crate::lives::reaching::RequestRecorder;

/// Returns a lease of a ready servant, whose robot states this.
async fn ready(daemon: &Choreographer, robot: &str, query: &[(&str, &str)]) -> Lease {
    let stated = api::Stated::read(query.iter().copied()).expect("valid");
    let request = ServantRequest::new("greet", robot).with_stated(stated);
    let lease = daemon.ensure(request).expect("a lease");
    lease.wait_ready().await.expect("ready");
    lease
}

fn cpus(lease: &Lease) -> Option<f64> {
    let container = lease.handle().container().expect("it runs");
    container.enforced_limits().limits.cpus
}

/// Records requests of its rosbridge clients with these times.
fn record_requests(daemon: &Choreographer, lease: &Lease, milliseconds: f64) {
    let handle = lease.handle();
    let measures = RequestRecorder::new(&daemon.inner, &handle.revision, &handle.id);
    for _ in 0..3 {
        let took = Duration::from_secs_f64(milliseconds / 1e3);
        measures.record_rosbridge(Some(took));
    }
}

/// Advances the time until it has the wanted cores; in each second its requests take this long.
async fn run_until_cpus(daemon: &Choreographer, lease: &Lease, milliseconds: f64, wanted: impl Fn(f64) -> bool) {
    for _ in 0..120 {
        record_requests(daemon, lease, milliseconds);
        tokio::time::sleep(Duration::from_secs(1)).await;
        if cpus(lease).is_some_and(&wanted) {
            return;
        }
    }
    panic!("it has {:?} cores", cpus(lease));
}

#[tokio::test(start_paused = true)]
async fn one_that_is_near_gets_more_than_its_promise_and_gives_it_back() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    daemon.keep_watch();
    // So little that it is throttled, whatever it uses.
    let near = [("cpus", "0.02"), ("max_rrt", "100ms")];
    let near = ready(&daemon, "near", &near).await;
    let other = ready(&daemon, "other", &[("cpus", "0.5")]).await;
    assert_eq!(cpus(&near), Some(0.02));
    run_until_cpus(&daemon, &near, 95.0, |cpus| cpus > 0.02).await;
    let told = world.event_messages("cores-moved");
    let words = told.last().map(String::as_str).unwrap_or_default();
    assert!(words.contains("cpu.max 0.02 → 0.12 cores"), "{words}");
    assert!(words.contains("95 ms; its robot accepts 100 ms"), "{words}");
    assert!(daemon.move_count() > 0);
    run_until_cpus(&daemon, &near, 5.0, |cpus| cpus == 0.02).await;
    assert_eq!(cpus(&other), Some(0.5), "nobody has less than was promised");
    assert_eq!(daemon.admission().snapshot().1.cpus(), 0.52, "promises are as they were");
}

#[tokio::test(start_paused = true)]
async fn without_a_controller_limits_stay_as_they_were_asked_for() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon_with(|options| options.controller = false);
    daemon.keep_watch();
    let near = [("cpus", "0.02"), ("max_rrt", "100ms")];
    let near = ready(&daemon, "near", &near).await;
    for _ in 0..30 {
        record_requests(&daemon, &near, 99.0);
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    assert_eq!((cpus(&near), daemon.move_count()), (Some(0.02), 0));
}

#[tokio::test(start_paused = true)]
async fn what_a_controller_has_moved_goes_back_where_the_next_daemon_has_none() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = |controller| {
        world.daemon_with(|options| {
            options.limits.cpus = Some(2.0);
            options.controller = controller;
        })
    };
    let first = daemon(true);
    let moved = ready(&first, "moved", &[("cpus", "0.25")]).await;
    let left = ready(&first, "left", &[("cpus", "0.5")]).await;
    let plain = ready(&first, "plain", &[]).await;
    let limits = |lease: &Lease| {
        let container = world.engine.servant(&lease.handle().id).expect("it runs");
        let limits = servant::engine::ServantHandle::enforced_limits(&*container).limits;
        (limits.cpus, limits.cpu_weight)
    };
    let mut before = [&moved, &left, &plain].map(limits);
    assert_eq!(before[0], (Some(0.25), Some(250)));
    for (lease, cpus, cpu_weight) in [(&moved, 1.5, 1500), (&plain, 0.05, 1)] {
        let container = lease.handle().container().expect("it runs");
        let moves = api::Limits { cpus: Some(cpus), cpu_weight: Some(cpu_weight), ..Default::default() };
        container.set_limits(moves).await.expect("it takes them");
    }
    // A daemon with a controller continues from the current state.
    let next = daemon(true);
    let inherited = next.adopt().await.expect("adopted");
    assert_eq!(inherited.adopted, 3);
    inherited.removal.await.expect("no panic");
    let there = async |daemon: &Choreographer| {
        for servant in daemon.servants() {
            let mut life = servant.watch();
            let ready = life.wait_for(|life| life.phase == Phase::Ready).await;
            ready.expect("it lives");
        }
    };
    there(&next).await;
    assert_eq!(limits(&moved), (Some(1.5), Some(1500)));
    let last = daemon(false);
    let inherited = last.adopt().await.expect("adopted");
    assert_eq!(inherited.adopted, 3);
    inherited.removal.await.expect("no panic");
    there(&last).await;
    // The kernel's default weight.
    before[2].1 = Some(100);
    assert_eq!([&moved, &left, &plain].map(limits), before);
    let told = world.event_messages("cores-moved");
    assert_eq!(told.len(), 2, "{told:?}");
    let words = "back from cpus 1.5, cpu-weight 1500 to cpus 0.25, cpu-weight 250";
    assert!(told.iter().any(|it| it.contains(words)), "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn a_machine_that_stalls_admits_nobody_and_says_so() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let inner = &daemon.inner;
    inner.note_stall(Some("this machine swaps".to_owned()));
    inner.note_stall(Some("this machine swaps still".to_owned()));
    let lease = daemon.ensure(ServantRequest::new("greet", "r1")).expect("a lease");
    let mut standing = lease.handle().watch_standing();
    standing
        .wait_for(|standing| {
            let words = standing.as_ref().map(ToString::to_string);
            words.is_some_and(|words| words.contains("swaps still") && words.contains("number 1 of 1"))
        })
        .await
        .expect("it is told");
    let fit = daemon.fit("greet", api::Stated::default()).await;
    let fit = fit.expect("a service");
    assert_eq!((fit.now, fit.stalled.is_some()), (false, true));
    inner.note_stall(None);
    lease.wait_ready().await.expect("it is admitted");
    let told = (world.event_messages("machine-stalled"), world.event_messages("machine-recovered"));
    assert_eq!((told.0.len(), told.1.len()), (1, 1), "{told:?}");
    assert!(told.0[0].starts_with("this machine swaps; no servant"), "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn what_would_fit_is_told_with_what_it_costs() {
    let world = World::new();
    world.publish("greet", "/greet", |record| {
        record.plan.limits.cpus = Some(0.75);
    });
    let daemon = world.daemon();
    let fit = async |query: &[(&str, &str)]| {
        let stated = api::Stated::read(query.iter().copied()).expect("valid");
        daemon.fit("greet", stated).await.expect("a service")
    };
    let plain = fit(&[]).await;
    assert_eq!((plain.now, plain.more, plain.cpus), (true, Some(2), 0.75));
    assert_eq!(fit(&[("cpus", "2")]).await.more, Some(1));
    let lease = ready(&daemon, "r1", &[]).await;
    assert_eq!(fit(&[]).await.more, Some(1));
    let big = fit(&[("cpus", "1.5")]).await;
    assert_eq!((big.now, big.lacking_cpus, big.ends.len()), (false, 0.25, 0));
    let id = lease.handle().id.clone();
    drop(lease);
    let idle = daemon.servant(&id).expect("it lives");
    while idle.idle_until().is_none() {
        tokio::task::yield_now().await;
    }
    let big = fit(&[("cpus", "1.5")]).await;
    assert_eq!((big.now, big.lacking_cpus, big.ends), (false, 0.0, vec![id]));
    let unknown = daemon.fit("nothing", api::Stated::default()).await;
    assert!(matches!(unknown, Err(Error::Catalogue(_))));
}
