//! Tests of servants whose shims do not answer, beside others, with the in-memory engine.

use servant::engine::ServantHandle as _;

use super::servants::{World, ready, request_stating};
use super::*;
use crate::options::HungPolicy;

const SECOND: Duration = Duration::from_secs(1);
/// Number of each kind: in any order, a stuck servant comes before one that is not.
const SERVANTS_PER_KIND: usize = 4;

fn container(world: &World, lease: &Lease) -> Arc<in_memory::MemoryServant> {
    world.engine.servant(&lease.handle().id).expect("it runs")
}

/// Starts robots whose servants answer, and as many whose servants stop answering now.
async fn robots(world: &World, daemon: &Choreographer, query: &[(&str, &str)]) -> (Vec<Lease>, Vec<Lease>) {
    let (mut sound, mut stuck) = (Vec::new(), Vec::new());
    for number in 0..SERVANTS_PER_KIND {
        sound.push(ready(daemon, request_stating(&format!("sound{number}"), query)).await);
        stuck.push(ready(daemon, request_stating(&format!("stuck{number}"), query)).await);
    }
    for lease in &stuck {
        container(world, lease).stuck.send_replace(true);
    }
    (sound, stuck)
}

#[tokio::test(start_paused = true)]
async fn what_clients_stated_that_left_ends_although_other_servants_are_stuck() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    daemon.keep_watch();
    let by = |lease: &Lease| {
        let robot = lease.handle().robot.clone();
        request_stating(&robot, &[("cpus", "0.2")]).with_stub("/two")
    };
    let (sound, stuck) = robots(&world, &daemon, &[("cpus", "0.1")]).await;
    let mut second = Vec::new();
    for lease in &stuck {
        container(&world, lease).stuck.send_replace(false);
    }
    for lease in sound.iter().chain(&stuck) {
        second.push(ready(&daemon, by(lease)).await);
    }
    for lease in &stuck {
        container(&world, lease).stuck.send_replace(true);
    }
    drop(second);
    tokio::time::sleep(daemon.inner.options.grace + SECOND * 3).await;
    let cpus = |lease: &Lease| container(&world, lease).enforced_limits().limits.cpus;
    for lease in &sound {
        assert_eq!(cpus(lease), Some(0.1), "{}", lease.handle().robot);
    }
    for lease in &stuck {
        assert_eq!(cpus(lease), Some(0.2), "{}", lease.handle().robot);
        container(&world, lease).stuck.send_replace(false);
    }
    // They are resized as soon as they answer.
    tokio::time::sleep(SECOND).await;
    for lease in &stuck {
        assert_eq!(cpus(lease), Some(0.1), "{}", lease.handle().robot);
    }
}

#[tokio::test(start_paused = true)]
async fn nodes_that_hang_are_ended_although_other_servants_are_stuck() {
    let world = World::new();
    world.publish("greet", "/greet", |record| record.plan.restart = true);
    let daemon = world.daemon_with(|options| {
        (options.hung, options.hung_after) = (HungPolicy::Restart, 5.0);
    });
    daemon.watch_nodes();
    let query = [("cpus", "0.1"), ("max_rrt", "300ms")];
    let (sound, stuck) = robots(&world, &daemon, &query).await;
    let all = || sound.iter().chain(&stuck);
    for lease in all() {
        *container(&world, lease).flow.lock() = (1, 1);
    }
    for _ in 0..10 {
        tokio::time::sleep(SECOND).await;
        for lease in all() {
            container(&world, lease).flow.lock().0 += 10;
        }
    }
    assert_eq!(world.event_messages("node-hung").len(), 2 * SERVANTS_PER_KIND);
    assert_eq!(world.event_messages("node-failed").len(), SERVANTS_PER_KIND, "each that answers was ended");
    // A servant that does not answer is reported, and watched as before.
    for lease in &stuck {
        container(&world, lease).stuck.send_replace(false);
    }
    tokio::time::sleep(SECOND).await;
    assert_eq!(world.event_messages("node-failed").len(), 2 * SERVANTS_PER_KIND);
}

#[tokio::test(start_paused = true)]
async fn cores_are_moved_although_other_servants_are_stuck() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    daemon.keep_watch();
    let near = [("cpus", "0.02"), ("max_rrt", "100ms")];
    let (sound, stuck) = robots(&world, &daemon, &near).await;
    let takes = |lease: &Lease| {
        let handle = lease.handle();
        let inner = &daemon.inner;
        let measures = crate::lives::reaching::RequestRecorder::new(inner, &handle.revision, &handle.id);
        for _ in 0..3 {
            measures.record_rosbridge(Some(Duration::from_millis(95)));
        }
    };
    let moved = |lease: &Lease| container(&world, lease).enforced_limits().limits.cpus > Some(0.02);
    // There is a round each second; a servant that does not answer is waited for five seconds.
    let mut seconds = 0;
    while !sound.iter().all(moved) {
        assert!(seconds < 5, "they wait for those that are stuck");
        seconds += 1;
        sound.iter().chain(&stuck).for_each(takes);
        tokio::time::sleep(SECOND).await;
    }
}

#[tokio::test(start_paused = true)]
async fn robots_find_their_servants_after_a_restart_although_other_shims_do_not_answer() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let query = [("cpus", "0.1")];
    let daemon = world.daemon();
    let (sound, stuck) = robots(&world, &daemon, &query).await;
    for lease in &stuck {
        container(&world, lease).hide_state(true);
    }
    let next = world.daemon();
    let began = tokio::time::Instant::now();
    let inherited = next.adopt().await.expect("it starts");
    assert_eq!(inherited.adopted, 2 * SERVANTS_PER_KIND);
    let again = |lease: &Lease| request_stating(&lease.handle().robot, &query);
    for lease in &sound {
        assert_eq!(ready(&next, again(lease)).await.handle().id, lease.handle().id);
    }
    assert!(began.elapsed() < SECOND, "they wait for those that are stuck");
    // One answers after all.
    container(&world, &stuck[0]).hide_state(false);
    assert_eq!(ready(&next, again(&stuck[0])).await.handle().id, stuck[0].handle().id);
    let silent = next.ensure(again(&stuck[1])).expect("a lease");
    assert_eq!(silent.handle().id, stuck[1].handle().id);
    let refused = silent.wait_ready().await.err().expect("it does not answer").to_string();
    assert!(refused.contains("its shim did not answer"), "{refused}");
}
