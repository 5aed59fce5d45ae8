//! Tests of rollouts, with the in-memory engine.

use api::rollout::{RolloutState, RolloutTerms, Share};
use link::control::RequestTiming;
use reach::links::{MeasuredRequest, RequestUpdate};

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// Returns a world with a service whose revision 1 is the current one, and revision 2 published beside it.
fn two_revisions() -> World {
    let world = World::new();
    // The catalogue sets tags even without such an image.
    let image = |number: u64| format!("sha256:{number:064}");
    world.publish("greet", "/greet", |record| record.image = image(1));
    let mut second = World::record("greet", "/greet");
    second.image = image(2);
    let published = world.state.publish_inactive(&second, &Default::default());
    assert_eq!(published.expect("published"), 2);
    world
}

fn canary(share: Share) -> RolloutTerms {
    RolloutTerms { canary: Some(share), samples: 5, ..RolloutTerms::default() }
}

/// Starts a daemon that runs rollouts.
fn daemon_with_rollouts(world: &World) -> Choreographer {
    let daemon = world.daemon();
    daemon.keep_rollouts().expect("they are read");
    daemon
}

/// Returns a lease of the robot's servant, which is of this revision.
async fn lease_of_revision(daemon: &Choreographer, robot: &str, revision: u64) -> Lease {
    let lease = daemon.ensure(ServantRequest::new("greet", robot));
    let lease = lease.expect("a lease");
    lease.wait_ready().await.expect("ready");
    assert_eq!(lease.handle().revision.number, revision, "{robot}");
    lease
}

async fn wait_for_state(daemon: &Choreographer, state: RolloutState) {
    let there = async {
        while daemon.rollout("greet").expect("a rollout").state != state {
            tokio::time::sleep(SECOND).await;
        }
    };
    let there = tokio::time::timeout(SECOND * 60, there).await;
    assert!(there.is_ok(), "{:?}", daemon.rollout("greet"));
}

#[tokio::test(start_paused = true)]
async fn a_canary_whose_requests_fail_is_taken_back_with_its_servants() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let first = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    first.await.expect("it begins");
    let (first, second) = (lease_of_revision(&daemon, "r1", 2).await, lease_of_revision(&daemon, "r2", 1).await);
    let rollouts = &daemon.inner.rollouts;
    for _ in 0..20 {
        rollouts.note_request("greet", 1, Some(5.0));
        rollouts.note_request("greet", 2, None);
        rollouts.note_request("greet", 7, None);
    }
    first.handle().wait_ended().await;
    let reason = first.handle().life().reason().expect("a reason");
    assert!(reason.contains("100 % of its 20 requests failed"), "{reason}");
    drop(first);
    let shown = daemon.rollout("greet").expect("a rollout");
    assert_eq!(shown.state, RolloutState::RolledBack);
    assert_eq!((shown.of_stable.requests, shown.of_candidate.requests), (20, 20));
    assert_eq!(shown.of_candidate.servants, 1);
    lease_of_revision(&daemon, "r1", 1).await;
    assert_eq!(second.handle().life().phase, Phase::Ready, "others go on");
    assert_eq!(world.event_messages("rollout-rolled-back").len(), 1);
}

/// Returns the observer that receives the reports of the robot's stub.
pub(super) fn observer_of(daemon: &Choreographer, lease: &Lease) -> Arc<dyn reach::Observer> {
    let handle = lease.handle();
    crate::lives::reaching::reach_options(&daemon.inner, &handle.revision, &handle.id).1
}

/// Reports an update about a request of the robot.
fn report(observer: &Arc<dyn reach::Observer>, timing: &RequestTiming, update: RequestUpdate) {
    let request = MeasuredRequest { session: "run-1", node: "/greet", max: None, timing, update };
    observer.on_request_measured(Some("r1"), &request);
}

#[tokio::test(start_paused = true)]
async fn a_canary_that_answers_nothing_is_not_promoted() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let terms = RolloutTerms { promote_after: Some(0.0), ..canary(Share::Robots(1)) };
    let begun = daemon.begin_rollout("greet", None, 2, terms).await;
    begun.expect("it begins");
    let (first, second) = (lease_of_revision(&daemon, "r1", 2).await, lease_of_revision(&daemon, "r2", 1).await);
    let waits = async |words: &str| {
        tokio::time::sleep(SECOND * 3).await;
        let shown = daemon.rollout("greet").expect("a rollout");
        assert_eq!(shown.state, RolloutState::Canary, "{shown:?}");
        let why = shown.waits.expect("it says why it waits");
        assert!(why.contains(words), "{why}");
    };
    waits("it has had 0 requests of the 5 required").await;
    let late = RequestTiming::default();
    let heard = observer_of(&daemon, &first);
    (0..4).for_each(|_| report(&heard, &late, RequestUpdate::Late));
    waits("it has had 4 requests of the 5 required").await;
    report(&heard, &late, RequestUpdate::Late);
    waits("5 of its 5 requests failed").await;
    let told = world.event_messages("rollout-waits");
    assert_eq!(told.len(), 3, "each reason once: {told:?}");
    assert!(told[0].contains("none of its servants"), "{told:?}");
    // The other revision answers: now it is known to be worse.
    let answered = RequestTiming { total: Some(5.0), ..late.clone() };
    let stable = observer_of(&daemon, &second);
    for _ in 0..20 {
        report(&stable, &answered, RequestUpdate::Answered);
        report(&heard, &late, RequestUpdate::Late);
    }
    // Its answers come after all; each request was counted.
    report(&heard, &answered, RequestUpdate::AnsweredLate);
    wait_for_state(&daemon, RolloutState::RolledBack).await;
    let shown = daemon.rollout("greet").expect("a rollout");
    assert_eq!(shown.waits, None);
    let of = shown.of_candidate;
    assert_eq!((of.requests, of.requests_failed, of.p50.is_some()), (25, 25, true));
}

#[tokio::test(start_paused = true)]
async fn robots_without_names_do_not_use_up_the_places_of_a_canary() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    begun.await.expect("it begins");
    for robot in ["~aaaaaa", "~bbbbbb"] {
        let request = ServantRequest::new("greet", robot).anonymous();
        let lease = daemon.ensure(request).expect("a lease");
        assert_eq!(lease.handle().revision.number, 2, "{robot}");
        let handle = Arc::clone(lease.handle());
        drop(lease);
        handle.wait_ended().await;
    }
    drop(lease_of_revision(&daemon, "r1", 2).await);
    drop(lease_of_revision(&daemon, "r2", 1).await);
}

#[tokio::test(start_paused = true)]
async fn who_has_the_canary_keeps_it_when_the_daemon_is_another() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    begun.await.expect("it begins");
    drop(lease_of_revision(&daemon, "r1", 2).await);
    // Written within a second.
    tokio::time::sleep(SECOND * 2).await;
    daemon.stop("the test goes on", |_| true).await;
    let next = daemon_with_rollouts(&world);
    drop(lease_of_revision(&next, "r2", 1).await);
    drop(lease_of_revision(&next, "r1", 2).await);
    assert_eq!(next.rollout("greet").expect("a rollout").of_candidate.servants, 2);
    next.abort_rollout("greet").await.expect("it is one");
    let refused = next.abort_rollout("greet").await.expect_err("it is none any more");
    assert!(refused.to_string().contains("not a canary: aborted"), "{refused}");
    next.stop("the test goes on", |_| true).await;
    drop(lease_of_revision(&next, "r1", 1).await);
}

#[tokio::test(start_paused = true)]
async fn a_promoted_canary_serves_all_and_others_end_at_their_deadline() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let terms = RolloutTerms { deadline: Some(0.0), promote_after: Some(0.0), ..canary(Share::Robots(1)) };
    daemon.begin_rollout("greet", None, 2, terms).await.expect("it begins");
    let old = lease_of_revision(&daemon, "r1", 2).await;
    for _ in 0..5 {
        daemon.inner.rollouts.note_request("greet", 2, Some(5.0));
    }
    wait_for_state(&daemon, RolloutState::Promoted).await;
    drop(lease_of_revision(&daemon, "r2", 2).await);
    assert_eq!(old.handle().life().phase, Phase::Ready, "it is of that revision");
    // A rollout without a canary: robots keep their servants until the deadline.
    let terms = RolloutTerms { deadline: Some(0.0), ..RolloutTerms::default() };
    daemon.begin_rollout("greet", None, 1, terms).await.expect("it begins");
    old.handle().wait_ended().await;
    let reason = old.handle().life().reason().expect("a reason");
    assert!(reason.contains("its deadline has passed: revision 1"), "{reason}");
    drop(lease_of_revision(&daemon, "r1", 1).await);
}

#[tokio::test(start_paused = true)]
async fn what_makes_no_sense_or_would_break_robots_is_refused() {
    let world = two_revisions();
    world.publish("other", "/greet", |_| {});
    let daemon = daemon_with_rollouts(&world);
    let mut third = World::record("greet", "/greet");
    third.interface.topics.clear();
    let published = world.state.publish_inactive(&third, &Default::default());
    assert_eq!(published.expect("published"), 3);
    let wrong = |change: fn(&mut RolloutTerms)| {
        let mut terms = canary(Share::Robots(1));
        change(&mut terms);
        terms
    };
    let share = canary(Share::Percent(10.0));
    for (service, revision, terms, words) in [
        ("greet", 9, share, "no revision 9"),
        ("greet", 1, share, "is already the current one"),
        ("greet", 3, share, "its interface breaks robots of revision 1"),
        ("greet", 2, wrong(|terms| terms.bound = f64::NAN), "must be 0 or greater"),
        ("greet", 2, wrong(|terms| terms.deadline = Some(-1.0)), "must be 0 or greater"),
        ("greet", 2, wrong(|terms| terms.samples = 0), "at least 1"),
        ("greet", 2, wrong(|terms| (terms.canary, terms.promote_after) = (None, Some(1.0))), "needs a canary"),
        ("gone", 2, share, "gone"),
    ] {
        let refused = daemon.begin_rollout(service, None, revision, terms).await;
        let refused = refused.expect_err(words).to_string();
        assert!(refused.contains(words), "{refused}");
    }
    let none = daemon.rollout("other").expect_err("it has none");
    assert!(matches!(none, Error::NoRollout(_)), "{none}");
    lease_of_revision(&daemon, "r1", 1).await;
}

#[tokio::test(start_paused = true)]
async fn another_revision_ends_a_rollout() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Percent(100.0)));
    begun.await.expect("it begins");
    let lease = lease_of_revision(&daemon, "r1", 2).await;
    world.publish("greet", "/greet", |_| {});
    let told = daemon.revision_changed("greet", 3).await;
    told.expect("it is told");
    lease.handle().wait_ended().await;
    drop(lease);
    lease_of_revision(&daemon, "r1", 3).await;
    let shown = daemon.rollout("greet").expect("a rollout");
    assert_eq!(shown.state, RolloutState::Replaced, "{shown:?}");
}

/// Returns the current revision.
fn current(world: &World) -> u64 {
    world.catalogue.current_revision("greet").expect("published").number
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_refused_or_keeps_its_servant_takes_no_place_of_a_canary() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let kept = lease_of_revision(&daemon, "r1", 1).await;
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    begun.await.expect("it begins");
    // It is connected, and comes once more.
    drop(lease_of_revision(&daemon, "r1", 1).await);
    let unknown = api::Stated::read([("class", "captain")]).expect("valid");
    let refused = ServantRequest::new("greet", "r2").with_stated(unknown);
    let refused = daemon.ensure(refused).err().expect("no such class");
    assert!(refused.to_string().contains("captain"), "{refused}");
    drop(lease_of_revision(&daemon, "r3", 2).await);
    drop(kept);
    daemon.stop("the test goes on", |_| true).await;
    lease_of_revision(&daemon, "r1", 1).await;
}

#[tokio::test(start_paused = true)]
async fn a_servant_that_is_measured_is_of_the_current_revision_and_judges_none() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Percent(100.0)));
    begun.await.expect("it begins");
    let measured = daemon.start_measured("greet", "try", api::Limits::default());
    let measured = measured.expect("a servant");
    measured.lease.wait_ready().await.expect("ready");
    assert_eq!(measured.lease.handle().revision.number, 1);
    let shown = daemon.rollout("greet").expect("a rollout");
    assert_eq!(shown.of_stable.servants, 0, "{shown:?}");
}

#[tokio::test(start_paused = true)]
async fn a_canary_does_not_take_the_place_of_a_revision_that_was_published_meanwhile() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    begun.await.expect("it begins");
    let lease = lease_of_revision(&daemon, "r1", 2).await;
    // Published, and the choreographer is not told yet.
    world.publish("greet", "/greet", |_| {});
    let shown = daemon.promote_rollout("greet").await.expect("answered");
    assert_eq!(shown.state, RolloutState::Replaced, "{shown:?}");
    assert_eq!(current(&world), 3);
    lease.handle().wait_ended().await;
}

#[tokio::test(start_paused = true)]
async fn what_cannot_be_written_is_not_done() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    begun.await.expect("it begins");
    let lease = lease_of_revision(&daemon, "r1", 2).await;
    let database = rusqlite::Connection::open(world.home.path().join("cloudroid.db"));
    let database = database.expect("the database");
    let rename = |from: &str, to: &str| {
        let renamed = database.execute(&format!("ALTER TABLE {from} RENAME TO {to}"), []);
        renamed.expect("renamed");
    };
    rename("rollouts", "gone");
    daemon.abort_rollout("greet").await.expect_err("no table");
    let shown = daemon.rollout("greet").expect("a rollout");
    assert_eq!(shown.state, RolloutState::Canary, "it goes on");
    assert_eq!(lease.handle().life().phase, Phase::Ready);
    rename("gone", "rollouts");
    daemon.abort_rollout("greet").await.expect("it is written");
    lease.handle().wait_ended().await;
    let next = daemon_with_rollouts(&world);
    let shown = next.rollout("greet").expect("a rollout");
    assert_eq!(shown.state, RolloutState::Aborted);
}

#[tokio::test(start_paused = true)]
async fn a_service_that_is_removed_has_no_rollout() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    let begun = daemon.begin_rollout("greet", None, 2, canary(Share::Robots(1)));
    begun.await.expect("it begins");
    world.catalogue.withdraw("greet").expect("removed");
    daemon.forget_rollout("greet").await;
    world.publish("greet", "/greet", |_| {});
    let none = daemon.rollout("greet").expect_err("it is another service");
    assert!(matches!(none, Error::NoRollout(_)), "{none}");
    daemon.inner.write_changed();
    assert!(world.state.rollouts().expect("read").is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_revision_with_a_deadline_alone_follows_the_one_before() {
    let world = two_revisions();
    let daemon = daemon_with_rollouts(&world);
    world.publish("greet", "/greet", |record| {
        record.image = format!("sha256:{:064}", 1);
    });
    let terms = RolloutTerms { deadline: Some(60.0), ..RolloutTerms::default() };
    let shown = daemon.begin_rollout("greet", Some(1), 3, terms).await;
    let shown = shown.expect("it begins");
    assert_eq!((shown.stable, shown.candidate), (1, 3));
    assert_eq!(shown.state, RolloutState::Draining);
}
