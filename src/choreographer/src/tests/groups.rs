//! Tests of shared services, with the in-memory engine.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicUsize;

use async_trait::async_trait;
use bytes::Bytes;
use futures_util::future::join_all;
use in_memory::Process;
use ros::bus::{
    ActionClient, ActionHandler, Bus, BusError, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome,
    ServiceHandler,
};
use ros::schema::{ActionDef, Registry};
use tokio::sync::Semaphore;

use super::servants::World;
use super::*;
use crate::decide::group::MAX_FORMER_ROBOTS;

const PATIENCE: Duration = Duration::from_secs(600);

/// A service that echoes its request with its servant's id; each answer takes a permit.
struct Echo {
    servant: String,
    answers: Arc<Semaphore>,
    asked: Arc<AtomicUsize>,
}

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        self.asked.fetch_add(1, Ordering::SeqCst);
        self.answers.acquire().await.expect("open").forget();
        let request = String::from_utf8_lossy(&request);
        Ok(format!("{request} {}", self.servant).into())
    }
}

/// An action server that accepts goals, ends none, and ignores cancellation.
struct Deaf(Arc<AtomicUsize>);

impl ActionHandler for Deaf {
    fn on_goal(&self, _id: &str, _goal: Bytes) -> Result<(), FailureReason> {
        self.0.fetch_add(1, Ordering::SeqCst);
        Ok(())
    }
    fn on_cancel(&self, _id: &str) {}
    fn on_failed(&self, _reason: &str) {}
}

/// Returns the type of the action.
fn count() -> Arc<ActionDef> {
    let text = "int32 to\n---\nint32 at\n---\nint32 at\n".to_owned();
    let definitions = [("x_msgs/action/Count".to_owned(), text)].into();
    let registry = Registry::from_definitions(&definitions).expect("definitions");
    registry.action("x_msgs/Count").expect("an action")
}

/// Results of a client's goals.
#[derive(Default)]
struct Ends(Mutex<Vec<Result<GoalEnd, GoalError>>>);

impl GoalEvents for Ends {
    fn on_feedback(&self, _feedback: Bytes) {}
    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        self.0.lock().push(end);
    }
}

/// A world in which `/echo` can be called as often as there are permits, and `/count` accepts goals.
struct Shop {
    world: World,
    answers: Arc<Semaphore>,
    asked: Arc<AtomicUsize>,
    goals: Arc<AtomicUsize>,
}

impl Shop {
    fn new(shared: api::Shared) -> Shop {
        let world = World::new();
        let (answers, asked) = (Arc::new(Semaphore::new(0)), Arc::<AtomicUsize>::default());
        let (gives, counts) = (Arc::clone(&answers), Arc::clone(&asked));
        let goals = Arc::<AtomicUsize>::default();
        let taken = Arc::clone(&goals);
        world.engine.program("/echo", move |process: Process| {
            let echo =
                Echo { servant: process.servant().to_owned(), answers: Arc::clone(&gives), asked: Arc::clone(&counts) };
            let deaf = Arc::new(Deaf(Arc::clone(&taken)));
            async move {
                let _counts = process.serve_action("/count", &count(), deaf);
                let _served = process.serve("/echo", "x_msgs/Echo", Arc::new(echo)).await;
                std::future::pending().await
            }
        });
        world.publish("echo", "/echo", |record| {
            let service = serde_json::json!({ "name": "/echo", "type": "x_msgs/Echo", "md5": "*" });
            record.interface.topics.clear();
            record.interface.services = vec![serde_json::from_value(service).expect("a service")];
            let action = serde_json::json!({ "name": "/count", "type": "x_msgs/Count" });
            record.interface.actions = vec![serde_json::from_value(action).expect("an action")];
            record.plan.shared = Some(shared);
            record.plan.limits.cpus = Some(0.1);
        });
        Shop { world, answers, asked, goals }
    }
}

impl Shop {
    /// Ends a servant like a failing machine; returns when the group knows.
    async fn lose_servant(&self, servant: &str) {
        let container = self.world.engine.servant(servant).expect("it runs");
        container.fail("its power went");
        while self.world.event_messages("shared-servant-lost").is_empty() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }
}

/// Connects a robot.
async fn robot(daemon: &Choreographer, name: &str) -> (Lease, Arc<dyn Bus>) {
    let lease = daemon.ensure(ServantRequest::new("echo", name)).expect("a lease");
    let bus = lease.wait_ready().await.expect("ready").bus();
    (lease, bus)
}

async fn call(bus: &Arc<dyn Bus>, words: &str) -> Result<String, String> {
    let answer = bus.call("/echo", Bytes::from(words.to_owned()), PATIENCE).await;
    let answer = answer.map_err(|error: BusError| error.to_string())?;
    Ok(String::from_utf8_lossy(&answer).into_owned())
}

/// Returns a client of `/count` that has sent this number of goals.
async fn send_goals(bus: &Arc<dyn Bus>, goals: usize) -> (Box<dyn ActionClient>, Arc<Ends>) {
    let client = bus.action_client("/count", &count()).expect("an action");
    client.wait_for_server(PATIENCE).await.expect("it is served");
    let ends = Arc::<Ends>::default();
    for number in 0..goals {
        let goal = Bytes::from_static(&[1, 0, 0, 0]);
        client.send_goal(&number.to_string(), goal, ends.clone());
    }
    (client, ends)
}

/// Waits until the group satisfies `is`.
async fn wait_for_group(daemon: &Choreographer, is: impl Fn(&api::Group) -> bool) -> api::Group {
    loop {
        let groups = daemon.groups("echo");
        if let Some(group) = groups.into_iter().find(|group| is(group)) {
            return group;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

fn ready(group: &api::Group) -> usize {
    group.servants.iter().filter(|servant| servant.ready).count()
}

#[tokio::test(start_paused = true)]
async fn one_more_robot_of_a_group_that_runs_needs_no_room() {
    let shop = Shop::new(api::Shared::default());
    let daemon = shop.world.daemon();
    let fit = || async {
        let fit = daemon.fit("echo", api::Stated::default()).await;
        fit.expect("it is published")
    };
    let first = fit().await;
    assert_eq!((first.shared, first.cpus), (Some(0), 0.1), "{first:?}");
    let _robot = robot(&daemon, "r1").await;
    let more = fit().await;
    assert_eq!((more.shared, more.now, more.cpus), (Some(1), true, 0.0));
}

#[tokio::test(start_paused = true)]
async fn a_place_has_no_limits_of_its_own() {
    let shop = Shop::new(api::Shared::default());
    let daemon = shop.world.daemon();
    let (lease, _bus) = robot(&daemon, "r1").await;
    let change = api::Limits { cpus: Some(0.5), ..api::Limits::default() };
    let refused = daemon.set_limits(&lease.handle().id, change).await;
    let refused = refused.expect_err("it has no container").to_string();
    assert!(refused.contains("the reservation of robot r1 at the shared service echo"), "{refused}");
}

#[tokio::test(start_paused = true)]
async fn twenty_robots_share_two_servants_and_one_of_these_ends_in_the_middle() {
    let shop = Shop::new(api::Shared { min: 2, max: 2, ..api::Shared::default() });
    let daemon = shop.world.daemon();
    let robots = (0..20).map(|number| {
        let daemon = daemon.clone();
        async move { robot(&daemon, &format!("r{number}")).await }
    });
    let robots = join_all(robots).await;
    let group = wait_for_group(&daemon, |group| ready(group) == 2).await;
    assert_eq!((group.robots, shop.world.engine.servants().len()), (20, 2));
    let calls = robots
        .iter()
        .enumerate()
        .flat_map(|(number, (_, bus))| (0..5).map(move |call| (format!("r{number} c{call}"), Arc::clone(bus))));
    let calls = calls.map(|(words, bus)| async move { (call(&bus, &words).await, words) });
    let calls = tokio::spawn(join_all(calls.collect::<Vec<_>>()));
    // Some are answered, some in progress, the others wait.
    shop.answers.add_permits(30);
    wait_for_group(&daemon, |group| group.answered == 30).await;
    let victim = &shop.world.engine.servants()[0];
    let container = shop.world.engine.servant(victim).expect("it runs");
    container.fail("its power went");
    wait_for_group(&daemon, |group| ready(group) == 2 && group.failed > 0).await;
    shop.answers.add_permits(1000);
    let answers = calls.await.expect("no panic");
    let mut failed = 0;
    let mut by: BTreeMap<String, usize> = BTreeMap::new();
    for (answer, words) in answers {
        match answer {
            Ok(answer) => {
                let (said, servant) = answer.rsplit_once(' ').expect("words");
                assert_eq!(said, words, "it is another's");
                *by.entry(servant.to_owned()).or_default() += 1;
            }
            Err(reason) => {
                assert!(reason.contains(victim) && reason.contains("--idempotent"), "{reason}");
                assert!(reason.contains("SIGKILL"), "{reason}");
                failed += 1;
            }
        }
    }
    // The requests of the lost servant; none of the waiting ones.
    assert_eq!(failed, 8);
    assert_eq!(by.values().sum::<usize>(), 92);
    assert_eq!(by.len(), 3, "{by:?}");
    assert_eq!(shop.asked.load(Ordering::SeqCst), 100);
    assert_eq!(shop.world.event_messages("shared-servant-lost").len(), 1);
}

#[tokio::test(start_paused = true)]
async fn what_a_lost_servant_had_is_asked_again_where_that_may_be() {
    let shop = Shop::new(api::Shared { min: 2, max: 2, idempotent: true, ..api::Shared::default() });
    let daemon = shop.world.daemon();
    let (_lease, bus) = robot(&daemon, "r1").await;
    wait_for_group(&daemon, |group| ready(group) == 2).await;
    let calls = (0..10).map(|number| {
        let bus = Arc::clone(&bus);
        async move { call(&bus, &number.to_string()).await }
    });
    let calls = tokio::spawn(join_all(calls.collect::<Vec<_>>()));
    wait_for_group(&daemon, |group| group.servants.iter().all(|it| it.under_way == 5)).await;
    let victim = &shop.world.engine.servants()[0];
    shop.lose_servant(victim).await;
    shop.answers.add_permits(100);
    for answer in calls.await.expect("no panic") {
        assert!(answer.is_ok(), "{answer:?}");
    }
    let group = wait_for_group(&daemon, |_| true).await;
    assert_eq!((group.answered, group.failed, group.asked_again), (10, 0, 5));
}

#[tokio::test(start_paused = true)]
async fn a_group_grows_under_load_and_shrinks_after_it() {
    let shop = Shop::new(api::Shared { max: 3, calls: 2, ..api::Shared::default() });
    let daemon = shop.world.daemon();
    let (lease, bus) = robot(&daemon, "r1").await;
    assert_eq!(shop.world.engine.servants().len(), 1);
    let calls = (0..20).map(|number| {
        let bus = Arc::clone(&bus);
        async move { call(&bus, &number.to_string()).await }
    });
    let calls = tokio::spawn(join_all(calls.collect::<Vec<_>>()));
    let group = wait_for_group(&daemon, |group| ready(group) == 3).await;
    assert_eq!(group.waiting, 14, "each works at two");
    let grown = shop.world.event_messages("shared-servant");
    assert!(grown[1].contains("concurrent requests are many"), "{grown:?}");
    shop.answers.add_permits(100);
    assert!(calls.await.expect("no panic").iter().all(Result::is_ok));
    wait_for_group(&daemon, |group| group.servants.len() == 1).await;
    let shrunk = shop.world.event_messages("shared-servant-retires");
    assert_eq!(shrunk.len(), 2, "{shrunk:?}");
    // The last one works until the robot stays away.
    assert!(call(&bus, "still").await.is_ok());
    drop(lease);
    while !shop.world.engine.servants().is_empty() {
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    assert!(daemon.groups("echo").is_empty());
}

#[tokio::test(start_paused = true)]
async fn of_replicas_the_first_answers_and_what_that_costs_is_shown() {
    let shop = Shop::new(api::Shared { min: 2, max: 2, replicas: 2, idempotent: true, ..api::Shared::default() });
    let daemon = shop.world.daemon();
    let (_lease, bus) = robot(&daemon, "r1").await;
    wait_for_group(&daemon, |group| ready(group) == 2).await;
    let calls = tokio::spawn({
        let bus = Arc::clone(&bus);
        async move { call(&bus, "one").await }
    });
    while shop.asked.load(Ordering::SeqCst) < 2 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    shop.answers.add_permits(1);
    assert!(calls.await.expect("no panic").is_ok());
    // One hangs for ever, and ends: nobody notices.
    let calls = tokio::spawn({
        let bus = Arc::clone(&bus);
        async move { call(&bus, "two").await }
    });
    wait_for_group(&daemon, |group| group.servants.iter().all(|it| it.under_way == 1)).await;
    let victim = &shop.world.engine.servants()[0];
    shop.lose_servant(victim).await;
    shop.answers.add_permits(100);
    assert!(calls.await.expect("no panic").is_ok());
    let group = wait_for_group(&daemon, |group| group.answered == 2).await;
    assert_eq!((group.failed, group.asked_again, group.wasted), (0, 0, 1));
}

#[tokio::test(start_paused = true)]
async fn a_group_that_does_not_start_says_why_and_is_started_anew() {
    let shop = Shop::new(api::Shared::default());
    shop.world.engine.break_image("sha256:echo", "the registry is away");
    let daemon = shop.world.daemon();
    let lease = daemon.ensure(ServantRequest::new("echo", "r1")).expect("a lease");
    let refused = lease.wait_ready().await.err().expect("it cannot start").to_string();
    assert!(refused.contains("the registry is away"), "{refused}");
    lease.handle().wait_ended().await;
    let lease = daemon.ensure(ServantRequest::new("echo", "r1")).expect("a lease");
    assert!(lease.wait_ready().await.is_err(), "it was tried again");
    assert_eq!(shop.world.engine.started_specs().len(), 2);
}

#[tokio::test(start_paused = true)]
async fn a_daemon_that_comes_after_uses_the_servants_that_are_there() {
    let shop = Shop::new(api::Shared::default());
    let first = shop.world.daemon();
    let (_lease, _bus) = robot(&first, "r1").await;
    let servants = shop.world.engine.servants();
    let second = shop.world.daemon();
    let inherited = second.adopt().await.expect("adopted");
    assert_eq!(inherited.adopted, 1);
    inherited.removal.await.expect("no panic");
    let (_lease, bus) = robot(&second, "r1").await;
    shop.answers.add_permits(1);
    assert!(call(&bus, "again").await.is_ok());
    assert_eq!(shop.world.engine.servants(), servants);
}

#[tokio::test(start_paused = true)]
async fn robots_of_ever_new_names_leave_no_more_places_than_are_kept() {
    let shop = Shop::new(api::Shared::default());
    let daemon = shop.world.daemon();
    let began = tokio::time::Instant::now();
    let (_lease, bus) = robot(&daemon, "stays").await;
    for number in 0..2 * MAX_FORMER_ROBOTS {
        drop(robot(&daemon, &format!("r{number}")).await);
    }
    let (last, _) = robot(&daemon, "last").await;
    let id = last.handle().id.clone();
    drop(last);
    wait_for_group(&daemon, |group| group.robots <= MAX_FORMER_ROBOTS + 1).await;
    assert!(began.elapsed() < options().grace, "all of them were kept until their time was over");
    // The robot that left last finds its place, and the one that stayed was not disturbed.
    let (last, _) = robot(&daemon, "last").await;
    assert_eq!(last.handle().id, id);
    shop.answers.add_permits(1);
    assert!(call(&bus, "still").await.is_ok());
}

#[tokio::test(start_paused = true)]
async fn servants_of_a_group_are_no_robots_that_arrive() {
    let shop = Shop::new(api::Shared { min: 8, max: 8, ..api::Shared::default() });
    let daemon = shop.world.daemon_with(|options| options.warm_pool = 8);
    daemon.keep_warm_pool();
    let (_lease, _bus) = robot(&daemon, "r1").await;
    wait_for_group(&daemon, |group| ready(group) == 8).await;
    for _ in 0..100 {
        tokio::time::sleep(Duration::from_millis(100)).await;
        let (ahead, _) = daemon.warm_pool();
        assert!(ahead <= 1, "{ahead} for robots that have not come");
    }
    daemon.end_warm_pool().await;
}

#[tokio::test(start_paused = true)]
async fn what_is_measured_of_a_shared_service_is_a_servant_of_its_own() {
    let shop = Shop::new(api::Shared::default());
    let daemon = shop.world.daemon();
    let request = ServantRequest::new("echo", "~calibrate-1").anonymous();
    let lease = daemon.ensure(request).expect("a lease");
    let bus = lease.wait_ready().await.expect("ready").bus();
    shop.answers.add_permits(1);
    assert!(call(&bus, "measured").await.is_ok());
    // Limits of a container are changed, and no robot's call reaches the measured servant.
    assert!(lease.handle().container().is_some());
    assert!(daemon.groups("echo").is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_goal_that_its_node_does_not_end_holds_up_others_only_while_its_robot_is_there() {
    let shop = Shop::new(api::Shared { max: 1, ..api::Shared::default() });
    let daemon = shop.world.daemon();
    let (_one, one) = robot(&daemon, "one").await;
    let (_two, two) = robot(&daemon, "two").await;
    let (client, _) = send_goals(&one, 1).await;
    let (_other, _) = send_goals(&two, 1).await;
    tokio::time::sleep(PATIENCE).await;
    assert_eq!(shop.goals.load(Ordering::SeqCst), 1, "the robot's alone");
    drop(client);
    let taken = async {
        while shop.goals.load(Ordering::SeqCst) < 2 {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    let taken = tokio::time::timeout(PATIENCE, taken).await;
    assert!(taken.is_ok(), "the other's waits for ever");
}

#[tokio::test(start_paused = true)]
async fn a_robot_has_no_more_than_so_many_goals() {
    let shop = Shop::new(api::Shared::default());
    let daemon = shop.world.daemon();
    let (_one, bus) = robot(&daemon, "one").await;
    let (client, ends) = send_goals(&bus, 300).await;
    // A goal with an id that another one has.
    client.send_goal("7", Bytes::from_static(&[1, 0, 0, 0]), ends.clone());
    tokio::time::sleep(PATIENCE).await;
    assert_eq!(shop.goals.load(Ordering::SeqCst), 256);
    let ends = ends.0.lock();
    let rejected = ends.iter().flatten();
    let rejected = rejected.filter(|end| end.outcome == GoalOutcome::Rejected);
    assert_eq!((ends.len(), rejected.count()), (45, 45), "{ends:?}");
}
