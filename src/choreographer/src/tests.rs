use std::time::Duration;

use api::Phase;
use in_memory::MemoryEngine;

use super::*;
use store::{Plan, RevisionRecord, State};

mod controller;
mod groups;
mod servants;
mod stuck;
mod terms;

fn revision(image: &str, cpus: f64) -> RevisionRecord {
    RevisionRecord {
        service: "detect".into(),
        number: 0,
        image: image.into(),
        published: store::now(),
        package: "detect".into(),
        owner: None,
        source: "a test".into(),
        flavour: Default::default(),
        plan: Plan {
            limits: api::Limits { cpus: Some(cpus), memory: Some(api::Size(0)), ..api::Limits::default() },
            ..Plan::default()
        },
        interface: Default::default(),
    }
}

fn options() -> Options {
    let memory = 64 << 20;
    Options {
        limits: api::Limits::default(),
        classes: Default::default(),
        cores: 2.0,
        controller: true,
        reserve_cpus: 0.01,
        reserve_memory: memory,
        deadline: Duration::from_secs(10),
        start: Duration::from_secs(30),
        grace: Duration::from_secs(60),
        anonymous_grace: Duration::ZERO,
        warm_pool: 8,
        warm_memory: 1 << 30,
        warm_nodes: 0,
        hung: HungPolicy::default(),
        hung_after: 10.0,
        bridge: BridgeOptions::default(),
        memory: MemoryOptions { daemon: memory, client: memory, servant: memory, unfinished: Duration::from_secs(300) },
        kept_logs: KeptLogOptions { age: Duration::from_secs(3600), quota: Quota { files: 100, bytes: 1 << 20 } },
        tracer: None,
    }
}

/// Returns a choreographer of a machine with two cores.
fn choreographer() -> (tempfile::TempDir, Choreographer) {
    let home = tempfile::tempdir().expect("a directory");
    let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
    let state = Arc::new(state);
    let store = image::Store::open(&home.path().join("images"), &home.path().join("layers")).expect("a store");
    let engine = Arc::new(MemoryEngine::default());
    let choreographer = Choreographer::new(
        options(),
        Arc::clone(&state),
        Arc::new(Catalogue::new(state, Arc::new(store))),
        engine.clone(),
        engine,
        Admission::new(Amount::new(2.0, 0), 16),
    );
    (home, choreographer)
}

/// Adds a running servant with these promised cores, idle since then.
async fn running_servant(choreographer: &Choreographer, id: &str, cpus: f64, idle_until: Option<u64>) -> Arc<Handle> {
    let inner = &choreographer.inner;
    let revision = Arc::new(revision("sha256:1", cpus));
    let asked = inner.push_limits(&revision);
    let handle = Handle::new(id.into(), id.into(), false, asked, revision, 0);
    let permit = inner.admission.adopt(inner.promised_amount(&handle.requested_limits()));
    handle.set_promise(permit.promise());
    std::mem::forget(permit);
    handle.set_idle_until(idle_until);
    let handle = Arc::new(handle);
    let mut servants = inner.servants.lock();
    servants.all.insert(id.into(), Arc::clone(&handle));
    handle
}

#[tokio::test(start_paused = true)]
async fn as_many_idle_servants_end_as_it_takes() {
    let (_home, choreographer) = choreographer();
    let inner = &choreographer.inner;
    let oldest = running_servant(&choreographer, "oldest", 0.5, Some(10)).await;
    let middle = running_servant(&choreographer, "middle", 0.5, Some(20)).await;
    let newest = running_servant(&choreographer, "newest", 0.5, Some(30)).await;
    let busy = running_servant(&choreographer, "busy", 0.5, None).await;
    let ending = |handle: &Arc<Handle>| handle.is_ending();
    inner.make_room();
    assert!(!ending(&oldest), "nobody waits");
    let wanted = Amount::new(1.0, 0);
    let deadline = Duration::from_secs(1);
    let waiting = inner
        .admission
        .admit(AdmissionRequest::robot(wanted, 0), deadline, watch::Sender::new(None), || inner.make_room());
    let refused = waiting.await;
    assert!(refused.is_err(), "none of them ends in this test");
    assert!(ending(&oldest) && ending(&middle), "one of them has not enough");
    assert!(!ending(&newest) && !ending(&busy), "more is not needed");
    // A request that waits for more than is idle takes the next servant as soon as that is idle.
    let wanted = Amount::new(2.0, 0);
    let waiting = inner
        .admission
        .admit(AdmissionRequest::robot(wanted, 0), deadline, watch::Sender::new(None), || inner.make_room());
    let left = async {
        tokio::time::sleep(deadline / 2).await;
        assert!(ending(&newest) && !ending(&busy));
        busy.set_idle_until(Some(40));
        inner.make_room();
        assert!(ending(&busy));
    };
    let _ = tokio::join!(waiting, left);
}

#[tokio::test]
async fn a_servant_is_of_the_revision_that_is_current_when_it_is_given() {
    let (_home, choreographer) = choreographer();
    let state = &choreographer.inner.state;
    let first = state.publish(&revision("sha256:1", 9.0), &Default::default()).expect("published");
    // A robot asks while others are being given theirs, and meanwhile there is a new revision.
    let held = choreographer.inner.servants.lock();
    let (sender, thread) = std::sync::mpsc::channel();
    let asking = {
        let choreographer = choreographer.clone();
        let runtime = tokio::runtime::Handle::current();
        std::thread::spawn(move || {
            let _entered = runtime.enter();
            sender.send(nix::unistd::gettid()).expect("it is awaited");
            let lease = choreographer.ensure(ServantRequest::new("detect", "r"));
            lease.expect("a lease").handle().revision.number
        })
    };
    // As far as it can get: it sleeps until the servants are free.
    let thread = thread.recv().expect("it runs");
    let state_of = || std::fs::read_to_string(format!("/proc/self/task/{thread}/stat"));
    while !state_of().expect("it runs").contains(") S ") {
        std::thread::yield_now();
    }
    let second = state.publish(&revision("sha256:2", 9.0), &Default::default()).expect("published");
    drop(held);
    let given = asking.join().expect("no panic");
    assert_eq!((first, given), (1, second));
}
