//! Tests of robots' statements and their servants' limits, with the in-memory engine.

use super::servants::{World, ready, request_stating};
use super::*;

/// Returns the cores and memory in force.
async fn enforced_limits(daemon: &Choreographer, lease: &Lease) -> (Option<f64>, Option<api::Size>) {
    let shown = daemon.describe(lease.handle()).await;
    let limits = shown.enforced.expect("it runs");
    (limits.cpus, limits.memory)
}

#[tokio::test(start_paused = true)]
async fn a_robot_gets_and_is_promised_what_it_states() {
    let world = World::new();
    world.publish("greet", "/greet", |record| {
        record.plan.limits.cpus = Some(0.25);
    });
    let daemon = world.daemon();
    let plain = ready(&daemon, ServantRequest::new("greet", "r0")).await;
    assert_eq!(enforced_limits(&daemon, &plain).await.0, Some(0.25));
    assert_eq!(daemon.describe(plain.handle()).await.terms, None);
    let lease = ready(&daemon, request_stating("r1", &[("cpus", "1.5"), ("memory", "512M")])).await;
    let memory = api::Size(512 << 20);
    assert_eq!(enforced_limits(&daemon, &lease).await, (Some(1.5), Some(memory)));
    let promised = Amount::new(1.75, memory.0);
    assert_eq!(daemon.admission().snapshot().1, promised);
    let terms = daemon.describe(lease.handle()).await.terms;
    let terms = terms.expect("it stated something");
    assert_eq!(terms.describe_stated(), "cpus=1.5 memory=512M");
    let told = world.event_messages("terms");
    assert!(told[0].contains("requests cpus=1.5 memory=512M"), "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn a_deployers_service_weighs_what_it_is_promised_and_an_operators_what_it_asks_for() {
    let world = World::new();
    for (name, owner) in [("greet", None), ("greedy", Some("ann".to_owned()))] {
        world.publish(name, "/greet", |record| {
            record.plan.limits.cpu_weight = Some(10_000);
            record.owner = owner;
        });
    }
    let daemon = world.daemon();
    for (service, weight) in [("greet", 10_000), ("greedy", 100)] {
        let lease = ready(&daemon, ServantRequest::new(service, "r1")).await;
        let shown = daemon.describe(lease.handle()).await;
        let limits = shown.enforced.expect("it runs");
        assert_eq!(limits.cpu_weight, Some(weight), "{service}");
    }
}

#[tokio::test(start_paused = true)]
async fn who_states_something_else_is_resized_in_place_or_told_what_would_fit() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let lease = ready(&daemon, request_stating("r1", &[("cpus", "0.5")])).await;
    let id = lease.handle().id.clone();
    let again = ready(&daemon, request_stating("r1", &[("cpus", "1.5")])).await;
    assert_eq!(again.handle().id, id, "the same servant");
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5));
    assert_eq!(daemon.admission().snapshot().1, Amount::new(1.5, 0));
    let told = world.event_messages("terms-changed");
    assert!(told[0].contains("cpus=1.5") && told[0].contains("from cpus 0.5"), "{told:?}");
    // Nothing stated, or the same: nothing changes.
    ready(&daemon, ServantRequest::new("greet", "r1")).await;
    ready(&daemon, request_stating("r1", &[("cpus", "1.5")])).await;
    assert_eq!(world.event_messages("terms-changed").len(), 1);
    // There are two cores.
    let more = daemon.ensure(request_stating("r1", &[("cpus", "2.5")])).expect("a lease");
    let refused = more.wait_ready().await.err().expect("there is no room");
    let Error::NotResized { reason, .. } = &refused else {
        panic!("{refused}");
    };
    let free = Amount::new(2.0, 1 << 30);
    assert!(
        matches!(&**reason, ResizeError::Full(AdmissionError::NoMore { free: left, .. }) if *left == free),
        "{refused}"
    );
    assert!(refused.to_string().contains("cpus=2.5"), "{refused}");
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5), "as it was");
    let stated = lease.handle().terms().describe_stated();
    assert_eq!(stated, "cpus=1.5");
    assert_eq!(world.event_messages("terms-refused").len(), 1);
}

#[tokio::test(start_paused = true)]
async fn stubs_of_one_robot_state_each_for_itself() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let by = |node: &str, cpus| request_stating("r1", &[("cpus", cpus)]).with_stub(node);
    let one = ready(&daemon, by("/one", "1")).await;
    ready(&daemon, by("/two", "0.5")).await;
    assert_eq!(enforced_limits(&daemon, &one).await.0, Some(1.0), "the more");
    ready(&daemon, by("/two", "1.5")).await;
    assert_eq!(enforced_limits(&daemon, &one).await.0, Some(1.5));
    ready(&daemon, by("/two", "0.25")).await;
    assert_eq!(enforced_limits(&daemon, &one).await.0, Some(1.0));
    assert_eq!(one.handle().terms().describe_stated(), "/one: cpus=1; /two: cpus=0.25");
}

#[tokio::test(start_paused = true)]
async fn what_a_stub_stated_ends_with_it() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    daemon.keep_watch();
    let grace = daemon.inner.options.grace;
    let by = |node: &str, cpus| request_stating("r1", &[("cpus", cpus)]).with_stub(node);
    let one = ready(&daemon, by("/one", "0.5")).await;
    let two = ready(&daemon, by("/two", "1.5")).await;
    let promised = || daemon.admission().snapshot().1.cpus();
    // Back within the grace time, and by another of its connections.
    drop(two);
    tokio::time::sleep(grace / 2).await;
    assert_eq!(promised(), 1.5);
    let two = ready(&daemon, by("/two", "1.5")).await;
    let other = ready(&daemon, by("/two", "1.5")).await;
    drop(two);
    tokio::time::sleep(grace * 2).await;
    assert_eq!(promised(), 1.5);
    // And then not.
    drop(other);
    tokio::time::sleep(grace / 2).await;
    assert_eq!(promised(), 1.5);
    tokio::time::sleep(grace).await;
    assert_eq!(promised(), 0.5);
    assert_eq!(enforced_limits(&daemon, &one).await.0, Some(0.5));
    assert_eq!(one.handle().terms().describe_stated(), "/one: cpus=0.5");
    let told = world.event_messages("terms-changed");
    let last = told.last().expect("it is told");
    assert!(last.contains("the requests of /two expired 60 s after"), "{last}");
    // Each place of a client with a statement is free again.
    for node in 0..100 {
        ready(&daemon, by(&format!("/node{node}"), "0.25")).await;
        tokio::time::sleep(grace / 10).await;
    }
    tokio::time::sleep(grace * 2).await;
    assert_eq!(one.handle().terms().stated.len(), 1);
    // It comes back with its earlier statement.
    ready(&daemon, by("/two", "1.5")).await;
    assert_eq!(promised(), 1.5);
}

#[tokio::test(start_paused = true)]
async fn what_a_stub_stated_is_kept_while_it_is_in_use() {
    let world = World::new();
    world.engine.program("/eats", |process| async move {
        process.allocate(100 << 20).await;
        process.advertise("/greeting", "std_msgs/String");
        std::future::pending().await
    });
    world.publish("greet", "/eats", |_| {});
    let daemon = world.daemon();
    daemon.keep_watch();
    let by = |memory| request_stating("r1", &[("memory", memory)]);
    let big = ready(&daemon, by("200M")).await;
    let grown = world.engine.servant(&big.handle().id).expect("it runs");
    let small = daemon.ensure(by("50M").with_stub("/small"));
    let small = small.expect("a lease");
    small.wait_ready().await.expect("the greater counts");
    drop(big);
    tokio::time::sleep(daemon.inner.options.grace * 3).await;
    let memory = || servant::engine::ServantHandle::enforced_limits(&*grown).limits.memory;
    assert_eq!(memory(), Some(api::Size(200 << 20)), "it uses more than 50M");
    let told = world.event_messages("terms-refused");
    assert_eq!(told.len(), 1, "{told:?}");
    assert!(told[0].contains("clients without a rosbridge client"), "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn what_the_operator_sets_stays_whatever_the_robot_states() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let lease = ready(&daemon, request_stating("r1", &[("cpus", "0.5")])).await;
    let set = api::Limits { cpus: Some(0.75), ..api::Limits::default() };
    let id = lease.handle().id.clone();
    daemon.set_limits(&id, set).await.expect("changed");
    let again = ready(&daemon, request_stating("r1", &[("cpus", "1.5"), ("memory", "64M")])).await;
    let memory = api::Size(64 << 20);
    assert_eq!(enforced_limits(&daemon, &again).await, (Some(0.75), Some(memory)));
    assert_eq!(daemon.admission().snapshot().1, Amount::new(0.75, memory.0));
    // There are two cores: waiting would not help.
    let beyond = api::Limits { cpus: Some(5.0), ..api::Limits::default() };
    let refused = daemon.set_limits(&id, beyond).await;
    assert!(matches!(refused, Err(Error::Full(AdmissionError::TooBig { .. }))), "{refused:?}");
    assert_eq!(daemon.admission().snapshot().1, Amount::new(0.75, memory.0));
}

#[tokio::test(start_paused = true)]
async fn what_the_kernel_does_not_take_from_a_servant_is_given_to_nobody() {
    let world = World::new();
    world.engine.program("/eats", |process| async move {
        process.allocate(100 << 20).await;
        process.advertise("/greeting", "std_msgs/String");
        std::future::pending().await
    });
    world.publish("greet", "/eats", |_| {});
    let daemon = world.daemon();
    let small = [("cpus", "0.1"), ("memory", "800M")];
    let has = ready(&daemon, request_stating("r1", &small)).await;
    let waits = [("cpus", "0.1"), ("memory", "500M")];
    let waits = daemon.ensure(request_stating("r2", &waits)).expect("a lease");
    let mut standing = waits.handle().watch_standing();
    standing.wait_for(Option::is_some).await.expect("it waits");
    let less = api::Limits { memory: Some(api::Size(64 << 20)), ..api::Limits::default() };
    let refused = daemon.set_limits(&has.handle().id, less).await;
    let refused = refused.expect_err("it uses more").to_string();
    assert!(refused.contains("of memory are in use"), "{refused}");
    assert_eq!(
        daemon.admission().snapshot().1,
        Amount::new(0.1, 800 << 20),
        "what is promised is what the servant has"
    );
    assert!(standing.borrow().is_some(), "the other one waits on");
    let less = api::Limits { memory: Some(api::Size(200 << 20)), ..api::Limits::default() };
    let set = daemon.set_limits(&has.handle().id, less).await;
    set.expect("it uses less");
    waits.wait_ready().await.expect("there is room now");
    assert_eq!(daemon.admission().snapshot().1, Amount::new(0.2, 700 << 20));
}

#[tokio::test(start_paused = true)]
async fn a_servant_is_not_made_smaller_than_what_it_uses() {
    let world = World::new();
    world.engine.program("/eats", |process| async move {
        process.allocate(100 << 20).await;
        process.advertise("/greeting", "std_msgs/String");
        std::future::pending().await
    });
    world.publish("greet", "/eats", |_| {});
    let daemon = world.daemon();
    let lease = ready(&daemon, request_stating("r1", &[("memory", "200M")])).await;
    let less = daemon.ensure(request_stating("r1", &[("memory", "50M")])).expect("a lease");
    let refused = less.wait_ready().await.err().expect("it would be killed");
    assert!(refused.to_string().contains("it uses 100M of memory"), "{refused}");
    assert_eq!(enforced_limits(&daemon, &lease).await.1, Some(api::Size(200 << 20)));
}

#[tokio::test(start_paused = true)]
async fn a_class_bounds_what_its_robots_state_and_ranks_them() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon_with(|options| {
        let caps = api::Caps { cpus: Some(1.0), memory: None };
        let class = ClassOptions { caps, ..ClassOptions::default() };
        let urgent = ClassOptions { priority: 7, ..ClassOptions::default() };
        options.classes = [("default".to_owned(), class), ("urgent".to_owned(), urgent)].into();
    });
    let refused = daemon.ensure(request_stating("r1", &[("cpus", "1.5")])).err();
    let refused = refused.expect("more than its class may have").to_string();
    assert!(refused.contains("max_cpus of class default"), "{refused}");
    let told = world.event_messages("terms-refused");
    assert!(told[0].starts_with("robot r1 requests cpus=1.5"), "{told:?}");
    let lease = ready(&daemon, request_stating("r1", &[("cpus", "1.5"), ("class", "urgent")])).await;
    assert_eq!(lease.handle().priority(), 7);
    let shown = daemon.describe(lease.handle()).await.terms.expect("terms");
    assert_eq!((shown.class.as_deref(), shown.priority), (Some("urgent"), 7));
    assert!(daemon.servants().len() == 1, "the one that was refused left nothing");
}

#[tokio::test]
async fn the_terms_of_a_servant_outlive_the_daemon() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let died = tokio::task::spawn_blocking(move || {
        let runtime = tokio::runtime::Runtime::new().expect("a runtime");
        runtime.block_on(async {
            let one = ready(&daemon, request_stating("r1", &[("cpus", "0.5")])).await;
            let two = ready(&daemon, request_stating("r1", &[("cpus", "1.5")])).await;
            // It dies before its robot leaves.
            std::mem::forget((one, two));
        });
        runtime.shutdown_background();
    });
    died.await.expect("no panic");
    let next = world.daemon();
    let inherited = next.adopt().await.expect("adopted");
    assert_eq!(inherited.adopted, 1);
    inherited.removal.await.expect("no panic");
    assert_eq!(next.admission().snapshot().1, Amount::new(1.5, 0));
    let lease = ready(&next, request_stating("r1", &[("cpus", "1.5")])).await;
    assert_eq!(lease.handle().terms().describe_stated(), "cpus=1.5");
    assert_eq!(enforced_limits(&next, &lease).await.0, Some(1.5));
}

#[tokio::test(start_paused = true)]
async fn a_warm_container_gets_what_its_robot_states() {
    let world = World::new();
    world.publish("greet", "/greet", |record| {
        record.plan.limits.cpus = Some(0.5);
    });
    let daemon = world.daemon_with(|options| options.warm_pool = 1);
    daemon.keep_warm_pool();
    while daemon.warm_pool().0 == 0 {
        tokio::task::yield_now().await;
    }
    let lease = ready(&daemon, request_stating("r1", &[("cpus", "1.5")])).await;
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5));
    let first = &world.engine.started_specs()[0];
    assert_eq!(first.id, lease.handle().id, "the warm one was used");
}

fn row(millis: u64, cpus: f64) -> api::dictionary::Row {
    api::dictionary::Row {
        id: 0,
        measure: api::Measure::Rrt,
        value: millis as f64 / 1000.0,
        aux: Default::default(),
        limits: api::Limits { cpus: Some(cpus), ..api::Limits::default() },
        spread: None,
        revision: None,
        written: 0,
    }
}

#[tokio::test(start_paused = true)]
async fn an_sla_is_given_what_the_services_dictionary_says() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon_with(|options| options.reserve_cpus = 0.25);
    let rows = api::dictionary::NewRows { rows: vec![row(50, 1.5), row(100, 0.5)], replace: false };
    let state = &daemon.inner.state;
    state.write_dictionary("greet", 1, &rows).expect("written");
    let one = ready(&daemon, request_stating("r1", &[("rrt", "100ms")])).await;
    let plain = ready(&daemon, ServantRequest::new("greet", "r0")).await;
    assert_eq!(enforced_limits(&daemon, &one).await.0, Some(0.5));
    assert_eq!(enforced_limits(&daemon, &plain).await.0, None);
    drop(plain);
    let told = world.event_messages("terms");
    assert!(told[0].contains("rrt=100ms") && told[0].contains("entry 2"), "{told:?}");
    // It states a stricter goal.
    let again = ready(&daemon, request_stating("r1", &[("rrt", "80ms")])).await;
    assert_eq!(enforced_limits(&daemon, &again).await.0, Some(1.5));
    let terms = again.handle().terms();
    assert_eq!(terms.rows[0].value, 0.05);
    let impossible = daemon.ensure(request_stating("r2", &[("rrt", "10ms")])).err();
    assert!(matches!(impossible, Some(Error::Terms(TermsError::Unmet { .. }))));
    let impossible = daemon.ensure(request_stating("r1", &[("rrt", "10ms")])).expect("a lease");
    let refused = impossible.wait_ready().await.err().expect("no row reaches it");
    assert!(refused.to_string().contains("entry 1"), "{refused}");
    assert_eq!(enforced_limits(&daemon, &again).await.0, Some(1.5), "as it was");
}

/// Starts a robot that only states a response time of a tenth of a second for its pictures; by the dictionary small
/// ones need half a core and large ones one and a half.
async fn robot_with_pictures(world: &World, daemon: &Choreographer) -> (Lease, Arc<ros::sizes::SizeCounters>) {
    let of_width = |cpus, width: &str| api::dictionary::Row {
        aux: [("width".to_owned(), width.to_owned())].into(),
        ..row(100, cpus)
    };
    let rows = api::dictionary::NewRows { rows: vec![of_width(0.5, "320"), of_width(1.5, "1280")], replace: false };
    let state = &daemon.inner.state;
    state.write_dictionary("greet", 1, &rows).expect("written");
    daemon.keep_watch();
    let lease = ready(daemon, request_stating("r1", &[("rrt", "100ms")])).await;
    assert_eq!(enforced_limits(daemon, &lease).await.0, Some(1.5), "the dearest");
    let registry = ros::schema::Registry::new();
    registry.insert("a/Picture", "uint32 height\nuint32 width").expect("valid");
    let picture = registry.message("a/Picture").expect("known");
    let servant = world.engine.servant(&lease.handle().id).expect("it runs");
    let sizes = servant.inputs.for_input("/camera", Some(&picture));
    (lease, sizes)
}

fn picture(width: u32) -> Vec<u8> {
    [width / 2, width].map(u32::to_le_bytes).concat()
}

/// Waits until one more event of this kind is reported.
async fn wait_next_event(world: &World, kind: &str, before: usize) -> String {
    let mut told = world.event_messages(kind);
    while told.len() <= before {
        tokio::time::sleep(Duration::from_millis(100)).await;
        told = world.event_messages(kind);
    }
    // The order is unspecified: all are searched by their number.
    told.retain(|message| message.contains("aux.width"));
    told.into_iter().next_back().expect("of a width")
}

#[tokio::test(start_paused = true)]
async fn what_the_session_measures_resizes_the_servant_in_place() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let (lease, sizes) = robot_with_pictures(&world, &daemon).await;
    for _ in 0..10 {
        sizes.record(&picture(320));
    }
    let told = wait_next_event(&world, "terms-changed", 0).await;
    assert!(told.contains("sends messages of aux.width=320"), "{told}");
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(0.5));
    assert_eq!(daemon.admission().snapshot().1.cpus(), 0.5);
    let terms = daemon.describe(lease.handle()).await.terms.expect("terms");
    assert_eq!(terms.measured["width"], "320");
    assert!(terms.why.iter().any(|why| why.contains("aux.width=320")));
    // It sends larger ones from now on, and smaller ones again.
    sizes.record(&picture(640));
    wait_next_event(&world, "terms-changed", 1).await;
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5));
    sizes.record(&picture(320));
    tokio::time::sleep(Duration::from_secs(60)).await;
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5), "it stays");
    // Its own statement takes precedence.
    let again = request_stating("r1", &[("rrt", "100ms"), ("aux.width", "320")]);
    ready(&daemon, again).await;
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(0.5));
}

#[tokio::test(start_paused = true)]
async fn what_was_measured_and_cannot_be_had_is_told_once_and_given_when_it_can() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    world.publish("other", "/greet", |_| {});
    let daemon = world.daemon();
    let (lease, sizes) = robot_with_pictures(&world, &daemon).await;
    for _ in 0..10 {
        sizes.record(&picture(320));
    }
    wait_next_event(&world, "terms-changed", 0).await;
    let other = api::Stated::read([("cpus", "1")]).expect("valid");
    let other = ready(&daemon, ServantRequest::new("other", "r2").with_stated(other)).await;
    sizes.record(&picture(640));
    let told = wait_next_event(&world, "terms-refused", 0).await;
    assert!(told.contains("messages of aux.width=640") && told.contains("1 cores and"), "{told}");
    tokio::time::sleep(Duration::from_secs(300)).await;
    assert_eq!(world.event_messages("terms-refused").len(), 1);
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(0.5), "as it was");
    let id = other.handle().id.clone();
    daemon.stop("it is in the way", |handle| handle.id == id).await;
    wait_next_event(&world, "terms-changed", 1).await;
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5));
    // Larger than in any row: its limits stay.
    sizes.record(&picture(2000));
    let told = wait_next_event(&world, "terms-refused", 1).await;
    assert!(told.contains("aux.width=2000"), "{told}");
    assert_eq!(enforced_limits(&daemon, &lease).await.0, Some(1.5));
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_refused_again_and_again_does_not_fill_the_journal() {
    let world = World::new();
    world.publish("greet", "/greet", |record| {
        record.plan.caps.cpus = Some(0.5);
    });
    let daemon = world.daemon();
    for _ in 0..100 {
        let refused = daemon.ensure(request_stating("r1", &[("cpus", "1.5")]));
        refused.err().expect("more than it may have");
    }
    assert_eq!(world.event_messages("terms-refused").len(), 1);
    for number in 0..100 {
        let refused = daemon.ensure(request_stating(&format!("r{number}"), &[("cpus", "1.5")]));
        refused.err().expect("more than it may have");
    }
    assert!(world.event_messages("terms-refused").len() <= 20);
    tokio::time::sleep(Duration::from_secs(60)).await;
    let refused = daemon.ensure(request_stating("r1", &[("cpus", "1.5")]));
    refused.err().expect("more than it may have");
    let told = world.event_messages("terms-refused");
    let more = told.iter().filter(|told| told.contains("180 more refusals"));
    assert_eq!(more.count(), 1, "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn stubs_of_ever_new_nodes_do_not_make_what_is_stated_grow_without_end() {
    let world = World::new();
    world.publish("greet", "/greet", |_| {});
    let daemon = world.daemon();
    let _stays = ready(&daemon, request_stating("r1", &[("cpus", "0.5")])).await;
    let mut refused = None;
    for number in 0..1000 {
        let request = request_stating("r1", &[("aux.width", &number.to_string())]);
        let request = request.with_stub(&format!("/node{number}"));
        let lease = daemon.ensure(request).expect("a lease");
        if let Err(error) = lease.wait_admitted().await {
            refused = Some((number, error.to_string()));
            break;
        }
    }
    let (number, error) = refused.expect("that are too many");
    assert_eq!(number, 63, "the first client stated something, too");
    assert!(error.contains("64 nodes of its robot"), "{error}");
    // A client with a statement may change it.
    let known = request_stating("r1", &[("aux.width", "7")]).with_stub("/node3");
    let known = daemon.ensure(known).expect("a lease").wait_admitted().await;
    assert!(known.is_ok(), "{known:?}");
}
