//! Tests with a real process (an ordinary node of either ROS version, `examples/relay.rs`) and real Masters and
//! domains.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use qos::{HandOver, LocalState, QosEvent, QosSla, RequestId, RequestOutcome, SafeStop};
use ros::bus::{Bus, FailureReason, ParamValue, RosVersion, SerializedMessage, ServiceHandler, ServiceType, WireType};
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::original::OriginalEvent;
use super::process::OriginalProgram;
use super::{Application, Cloud, ExpectedInterface, Keeper, Original, OriginalSetup, OutputTiming, PendingAnswer};
use crate::testing::{SOON, World, decode_string, encode_string, message_text, stories, string_message, string_type};

stories! {
    of_ros_1 = One:
        it_answers_under_its_own_names_and_the_robot_sees_nothing_of_it,
        a_cold_start_is_given_what_each_publisher_has_latched_and_has_not_left,
        what_is_latched_while_the_link_is_away_reaches_both_sides,
        what_a_node_waits_for_reaches_it_before_it_listens_to_its_requests,
        a_service_of_the_robot_that_hangs_is_named_when_its_time_is_over,
        it_calls_what_the_robot_serves,
        it_is_told_of_parameters_that_change_while_it_runs,
        a_node_that_waits_for_what_does_not_come_is_taken_for_ready_in_the_end,
        a_crash_is_told_and_it_comes_back,
        what_cannot_run_is_said,
        the_cloud_falls_silent_and_the_local_original_answers_until_it_speaks_again,
        a_call_is_answered_by_the_local_original_when_the_link_is_lost;
    of_ros_2 = Two:
        it_answers_under_its_own_names_and_the_robot_sees_nothing_of_it,
        a_cold_start_is_given_what_each_publisher_has_latched_and_has_not_left,
        what_is_latched_while_the_link_is_away_reaches_both_sides,
        what_a_node_waits_for_reaches_it_before_it_listens_to_its_requests,
        a_crash_is_told_and_it_comes_back,
        what_cannot_run_is_said,
        the_cloud_falls_silent_and_the_local_original_answers_until_it_speaks_again,
        a_call_is_answered_by_the_local_original_when_the_link_is_lost;
}

/// A robot with one node and, in ROS 1, one parameter.
pub struct TestRobot {
    pub world: World,
    pub bus: Arc<dyn Bus>,
}

pub async fn robot(ros: RosVersion) -> TestRobot {
    let world = World::new(ros).await;
    let bus = world.node("/robot").await;
    if let Ok(parameters) = bus.parameters() {
        let greeting = ParamValue::String("hello ".into());
        let name = "/ns/relay_sibling/greeting";
        parameters.set(name, greeting).await.unwrap();
    }
    TestRobot { world, bus }
}

/// Returns the path of the example, which is built beside the tests: `target/PROFILE/{examples,deps}`.
fn relay() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let path = tests.ancestors().nth(2).unwrap().join("examples/relay");
    assert!(path.is_file(), "{} is missing: build it with cargo test -p cloudroid-stub, all targets", path.display());
    path
}

/// Returns the setup of `/ns/relay`, which reads `/ns/in` and publishes `/absolute/out`.
pub fn relay_setup(world: &World, argv: &[&str]) -> OriginalSetup {
    let names = match world.domain() {
        None => "in:=/ns/in out:=/absolute/out __name:=relay",
        Some(_) => "--ros-args -r in:=/ns/in -r out:=/absolute/out -r count:=/count -r __ns:=/ns -r __node:=relay",
    };
    let names = names.split(' ');
    let argv = argv.iter().copied().chain(names).map(str::to_owned);
    let (mut argv, mut environment) = (argv.collect::<Vec<_>>(), vec![]);
    match world.domain() {
        None => environment.push(("ROS_NAMESPACE", "/ns".into())),
        Some(_) => argv.extend(["-p", "greeting:=hello "].map(str::to_owned)),
    }
    OriginalSetup {
        program: Some(OriginalProgram { path: relay(), argv, environment }),
        node: "/ns/relay".into(),
        domain: world.domain(),
        patience: SOON,
    }
}

async fn new_original(robot: &TestRobot, setting: OriginalSetup) -> (Original, mpsc::UnboundedReceiver<OriginalEvent>) {
    let string = string_type(robot.bus.version());
    let input = |topic: &str| (topic.to_owned(), string.clone());
    let interface = ExpectedInterface {
        inputs: BTreeMap::from(["/ns/in", "/pose"].map(input)),
        awaited: BTreeSet::from(["/ns/in".to_owned()]),
        outputs: vec!["/absolute/out".into()],
        ..ExpectedInterface::default()
    };
    Original::new(setting, interface, robot.bus.clone(), SOON).await.unwrap()
}

/// Creates an original that runs the relay with these arguments.
pub async fn new_relay(robot: &TestRobot, argv: &[&str]) -> (Original, mpsc::UnboundedReceiver<OriginalEvent>) {
    new_original(robot, relay_setup(&robot.world, argv)).await
}

async fn wait_for_state(news: &mut mpsc::UnboundedReceiver<OriginalEvent>, wanted: LocalState) {
    let waiting = async {
        while let Some(said) = news.recv().await {
            match said {
                OriginalEvent::State(state) if state == wanted => return,
                OriginalEvent::Crashed(reason) => panic!("it crashed: {reason}"),
                _ => {}
            }
        }
        panic!("it ended before it was {wanted:?}");
    };
    timeout(SOON, waiting).await.unwrap();
}

async fn next_output(news: &mut mpsc::UnboundedReceiver<OriginalEvent>) -> String {
    let waiting = async {
        loop {
            if let OriginalEvent::Output(_, message) = news.recv().await.unwrap() {
                return message_text(&message);
            }
        }
    };
    timeout(SOON, waiting).await.unwrap()
}

async fn it_answers_under_its_own_names_and_the_robot_sees_nothing_of_it(ros: RosVersion) {
    let robot = robot(ros).await;
    let (original, mut news) = new_relay(&robot, &[]).await;
    original.start();
    original.start();
    wait_for_state(&mut news, LocalState::Ready).await;
    original.feed("/ns/in", &string_message(ros, "world"));
    assert_eq!(next_output(&mut news).await, "hello world", "it has its parameters");
    let graph = robot.bus.graph().borrow().clone();
    assert_eq!(graph.nodes.keys().filter(|name| *name != "/robot").count(), 0, "{graph:?}");
    assert!(graph.topics.keys().all(|name| name != "/absolute/out" && name != "/ns/in"), "{graph:?}");
    if let Ok(parameters) = robot.bus.parameters() {
        let names = parameters.names().await.unwrap();
        assert!(names.iter().all(|name| name != "/ns/relay/seen"), "what it writes stays with it: {names:?}");
    }
    original.stop();
    wait_for_state(&mut news, LocalState::Stopped).await;
    original.start();
    wait_for_state(&mut news, LocalState::Ready).await;
    original.feed("/ns/in", &string_message(ros, "again"));
    assert_eq!(next_output(&mut news).await, "hello again");
}

/// Returns a string message of a publisher that latches.
fn latched_message(ros: RosVersion, publisher: &str, text: &str) -> SerializedMessage {
    SerializedMessage { publisher: publisher.into(), latching: true, ..string_message(ros, text) }
}

async fn a_cold_start_is_given_what_each_publisher_has_latched_and_has_not_left(ros: RosVersion) {
    let robot = robot(ros).await;
    let (original, mut news) = new_relay(&robot, &["patient", "keeps"]).await;
    let topic: Arc<str> = "/ns/in".into();
    for (publisher, said) in [("/one", "old"), ("/one", "map"), ("/two", "frames"), ("/gone", "lost")] {
        original.latch(&topic, &latched_message(ros, publisher, said));
    }
    original.unlatch(&topic, &"/gone".into());
    for (left, wanted) in
        [(None, BTreeSet::from(["hello map", "hello frames"])), (Some("/two"), BTreeSet::from(["hello map"]))]
    {
        if let Some(left) = left {
            original.unlatch(&topic, &left.into());
        }
        original.start();
        let mut heard = BTreeSet::new();
        while heard.len() < wanted.len() {
            heard.insert(next_output(&mut news).await);
        }
        assert_eq!(heard, wanted.into_iter().map(str::to_owned).collect());
        // Nothing else came before this.
        original.latch(&topic, &latched_message(ros, "/one", "map"));
        assert_eq!(next_output(&mut news).await, "hello map");
        original.stop();
        wait_for_state(&mut news, LocalState::Stopped).await;
    }
}

async fn what_is_latched_while_the_link_is_away_reaches_both_sides(ros: RosVersion) {
    let robot = robot(ros).await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
    let (told, mut hears) = mpsc::unbounded_channel();
    let cloud = Arc::new(SilentCloud::default());
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec![],
        Some(new_relay(&robot, &["patient", "keeps"]).await),
        cloud.clone(),
        Arc::new(RecordingApplication(told)),
    );
    keeper.link_up(false);
    let topic: Arc<str> = "/ns/in".into();
    keeper.on_input(&topic, latched_message(ros, "/map_server", "map"));
    keeper.on_input(&topic, string_message(ros, "scan"));
    assert_eq!(cloud.inputs.lock().len(), 2);
    assert!(hears.try_recv().is_err(), "only the cloud answers");
    keeper.link_down();
    let mut heard = Vec::new();
    while !heard.contains(&"hello map".to_owned()) || !heard.contains(&"feed".to_owned()) {
        heard.push(timeout(SOON, hears.recv()).await.unwrap().unwrap());
    }
    assert!(!heard.contains(&"hello scan".to_owned()), "{heard:?}");
    keeper.on_input(&topic, latched_message(ros, "/map_server", "another map"));
    keeper.on_input(&topic, string_message(ros, "another scan"));
    for wanted in ["hello another map", "hello another scan"] {
        while !heard.iter().any(|heard| heard == wanted) {
            heard.push(timeout(SOON, hears.recv()).await.unwrap().unwrap());
        }
    }
    // Messages from another node of the servant reach the original, too.
    keeper.on_overheard_input(&topic, string_message(ros, "a sibling's scan"));
    keeper.on_overheard_input(&topic, latched_message(ros, "/sibling", "a sibling's map"));
    for wanted in ["hello a sibling's scan", "hello a sibling's map"] {
        while !heard.iter().any(|heard| heard == wanted) {
            heard.push(timeout(SOON, hears.recv()).await.unwrap().unwrap());
        }
    }
    let sent: Vec<String> = cloud.inputs.lock().iter().map(message_text).collect();
    assert_eq!(sent, ["map", "scan", "another map"], "the cloud will need the map, too");
    keeper.link_up(true);
    while heard.last().map(String::as_str) != Some("stop") {
        heard.push(timeout(SOON, hears.recv()).await.unwrap().unwrap());
    }
    assert_eq!(cloud.inputs.lock().len(), 3, "nothing goes twice");
}

async fn what_a_node_waits_for_reaches_it_before_it_listens_to_its_requests(ros: RosVersion) {
    let robot = robot(ros).await;
    let sla = serde_json::json!({"t_desire": 0.02, "t_max": 60, "local": "cold", "unreached": 0.05});
    let (told, mut hears) = mpsc::unbounded_channel();
    let waits = ["awaits=/pose", "awaits-latched=/map"];
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec!["/ns/in -> /absolute/out by arrival".parse().unwrap()],
        Some(new_relay(&robot, &waits).await),
        Arc::new(SilentCloud::default()),
        Arc::new(RecordingApplication(told)),
    );
    keeper.on_input(&"/map".into(), latched_message(ros, "/map_server", "map"));
    // If the cloud was never reached, the original takes over at once.
    keeper.link_down();
    let topic: Arc<str> = "/ns/in".into();
    keeper.on_input(&topic, string_message(ros, "world"));
    // The pose is published repeatedly, as transforms are.
    let mut due = tokio::time::interval(Duration::from_millis(20));
    let mut heard = Vec::new();
    let waiting = async {
        while heard.last().map(String::as_str) != Some("hello world") {
            tokio::select! {
                said = hears.recv() => heard.push(said.unwrap()),
                _ = due.tick() => keeper.on_input(&"/pose".into(), string_message(ros, "pose")),
            }
        }
    };
    let answered = timeout(SOON, waiting).await;
    assert!(answered.is_ok(), "{heard:?}: {}", keeper.report().summary);
    assert_eq!(heard, ["start", "feed", "hello world"]);
}

async fn a_node_that_waits_for_what_does_not_come_is_taken_for_ready_in_the_end(ros: RosVersion) {
    let robot = robot(ros).await;
    let mut setting = relay_setup(&robot.world, &["awaits=/pose"]);
    setting.patience = Duration::from_millis(200);
    let (original, mut news) = new_original(&robot, setting).await;
    original.start();
    wait_for_state(&mut news, LocalState::Ready).await;
    original.feed("/pose", &string_message(ros, "pose"));
    let mut due = tokio::time::interval(Duration::from_millis(20));
    let answered = async {
        loop {
            tokio::select! {
                said = next_output(&mut news) => return said,
                _ = due.tick() => original.feed("/ns/in", &string_message(ros, "world")),
            }
        }
    };
    assert_eq!(timeout(SOON, answered).await.unwrap(), "hello world");
}

#[tokio::test]
async fn a_stateful_hand_over_says_what_is_lost() {
    let robot = robot(RosVersion::One).await;
    let sla = serde_json::json!({"t_desire": 10, "t_max": 20, "mode": "stateful"});
    let (told, mut hears) = mpsc::unbounded_channel();
    let cloud = Arc::new(SilentCloud::default());
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec![],
        Some(new_relay(&robot, &["patient"]).await),
        cloud.clone(),
        Arc::new(RecordingApplication(told)),
    );
    keeper.link_up(false);
    let topic: Arc<str> = "/ns/in".into();
    // Latched messages reach both sides, so none is lost.
    keeper.on_input(&topic, latched_message(RosVersion::One, "/map_server", "map"));
    for _ in 0..3 {
        keeper.on_input(&topic, string_message(RosVersion::One, "scan"));
    }
    let mut heard = Vec::new();
    let mut until = async |wanted: &str| {
        while heard.last().map(String::as_str) != Some(wanted) {
            heard.push(timeout(SOON, hears.recv()).await.unwrap().unwrap());
        }
    };
    keeper.link_down();
    until("local lacks 3 of /ns/in").await;
    let lost = keeper.report().lost.unwrap().1;
    assert!(lost.contains("the local original takes over without"), "{lost}");
    for _ in 0..2 {
        keeper.on_input(&topic, string_message(RosVersion::One, "another scan"));
    }
    keeper.link_up(true);
    until("cloud lacks 2 of /ns/in").await;
    // The next servant is another one.
    keeper.link_down();
    until("feed").await;
    keeper.link_up(false);
    until("cloud lacks 5 of /ns/in").await;
    let lost = keeper.report().lost.unwrap().1;
    assert!(lost.contains("a new servant takes over without"), "{lost}");
}

#[tokio::test]
async fn a_hand_over_names_calls_and_goals_that_the_other_side_was_given() {
    let robot = robot(RosVersion::One).await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
    let (told, mut hears) = mpsc::unbounded_channel();
    let cloud = Arc::new(SilentCloud::default());
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec!["/mux/goal -> /mux/result by goal".parse().unwrap()],
        Some(new_relay(&robot, &[]).await),
        cloud.clone(),
        Arc::new(RecordingApplication(told)),
    );
    keeper.link_up(false);
    let service: Arc<str> = "/mux/select".into();
    let call = {
        let (keeper, service) = (keeper.clone(), service.clone());
        tokio::spawn(async move { keeper.call(&service, Bytes::new()).await })
    };
    while cloud.calls.lock().is_empty() {
        tokio::task::yield_now().await;
    }
    let id = cloud.calls.lock()[0];
    keeper.on_cloud_answer(id, Ok(Bytes::new()), None);
    timeout(SOON, call).await.unwrap().unwrap().unwrap();
    // A goal without an id is not a request, but the cloud receives it all the same. Plain messages are not listed in
    // the hand-over.
    let goal = WireType::with_name("mux_msgs/SwitchActionGoal");
    let goal = SerializedMessage { wire_type: Arc::new(goal), ..string_message(RosVersion::One, "") };
    keeper.on_input(&"/mux/goal".into(), goal);
    keeper.on_input(&"/ns/in".into(), string_message(RosVersion::One, "scan"));
    keeper.link_down();
    let mut heard = String::new();
    while !heard.starts_with("local lacks") {
        heard = timeout(SOON, hears.recv()).await.unwrap().unwrap();
    }
    assert_eq!(heard, "local lacks 1 of /mux/goal, 1 of /mux/select");
    assert_eq!(keeper.report().lost, None, "its state is not said to be lost");
}

#[tokio::test]
async fn where_nothing_is_promised_a_missing_original_is_told_when_it_is_needed() {
    let sla = serde_json::json!({"measure": {"link": {"after": 0.02}}});
    let (told, mut hears) = mpsc::unbounded_channel();
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec![],
        None,
        Arc::new(SilentCloud::default()),
        Arc::new(RecordingApplication(told)),
    );
    keeper.link_up(false);
    assert!(hears.try_recv().is_err());
    keeper.link_down();
    let said = timeout(SOON, hears.recv()).await.unwrap().unwrap();
    assert_eq!(said, "saidoncemissing");
    assert!(keeper.report().summary.contains("nobody answers"));
}

async fn a_service_of_the_robot_that_hangs_is_named_when_its_time_is_over(ros: RosVersion) {
    let robot = robot(ros).await;
    let of = ServiceType::new("tests/Says", "0123456789abcdef0123456789abcdef");
    let _hangs = robot.bus.serve("/hangs", of, Arc::new(Hangs)).await.unwrap();
    let limit = Duration::from_millis(100);
    let relay = relay_setup(&robot.world, &["patient"]);
    let original = Original::new(relay, ExpectedInterface::default(), robot.bus, limit);
    let (original, mut news) = original.await.unwrap();
    let interface = ExpectedInterface { outputs: vec!["/absolute/out".into()], ..ExpectedInterface::default() };
    original.adapt(interface).await.unwrap();
    original.latch(&"/ns/in".into(), &latched_message(ros, "/app", "ask /hangs"));
    original.start();
    let answer = next_output(&mut news).await;
    assert!(answer.contains("service /hangs did not answer within 100ms") && answer.contains("call_limit"), "{answer}");
}

/// Accepts a call and never answers.
struct Hangs;

#[async_trait::async_trait]
impl ServiceHandler for Hangs {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        std::future::pending().await
    }
}

/// Answers with this text, or fails with this reason.
struct Says(Result<&'static str, &'static str>);

#[async_trait::async_trait]
impl ServiceHandler for Says {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        self.0.map(Bytes::from).map_err(FailureReason::new)
    }
}

async fn it_calls_what_the_robot_serves(ros: RosVersion) {
    let robot = robot(ros).await;
    let (original, mut news) = new_relay(&robot, &[]).await;
    original.start();
    wait_for_state(&mut news, LocalState::Ready).await;
    let mut served = Vec::new();
    for (name, says) in [("/secret", Ok("42")), ("/silent", Err("it is a secret"))] {
        let of = ServiceType::new("tests/Says", "0123456789abcdef0123456789abcdef");
        let serving = robot.bus.serve(name, of, Arc::new(Says(says))).await;
        served.push(serving.unwrap());
    }
    for (asked, wanted) in
        [("ask /secret", "42"), ("ask /silent", "it is a secret"), ("ask /nobody", "service /nobody has no server")]
    {
        original.feed("/ns/in", &string_message(ros, asked));
        let answer = next_output(&mut news).await;
        assert!(answer.contains(wanted), "{answer}");
    }
}

async fn it_is_told_of_parameters_that_change_while_it_runs(ros: RosVersion) {
    let robot = robot(ros).await;
    let (original, mut news) = new_relay(&robot, &[]).await;
    original.start();
    wait_for_state(&mut news, LocalState::Ready).await;
    let late = ParamValue::String("late".into());
    for (value, wanted) in [(Some(late), "late"), (None, "/speed")] {
        original.change_parameter("/speed", value).await;
        original.feed("/ns/in", &string_message(ros, "get /speed"));
        let said = next_output(&mut news).await;
        assert!(said.contains(wanted), "{said}");
    }
}

async fn a_crash_is_told_and_it_comes_back(ros: RosVersion) {
    let robot = robot(ros).await;
    let (original, mut news) = new_relay(&robot, &["crash-on=boom"]).await;
    original.start();
    wait_for_state(&mut news, LocalState::Ready).await;
    original.feed("/ns/in", &string_message(ros, "boom"));
    let crashed = async {
        loop {
            if let OriginalEvent::Crashed(reason) = news.recv().await.unwrap() {
                return reason;
            }
        }
    };
    let reason = timeout(SOON, crashed).await.unwrap();
    assert!(reason.contains('3'), "{reason}");
    wait_for_state(&mut news, LocalState::Ready).await;
    original.feed("/ns/in", &string_message(ros, "world"));
    assert_eq!(next_output(&mut news).await, "hello world");
}

async fn what_cannot_run_is_said(ros: RosVersion) {
    let robot = robot(ros).await;
    let mut missing = relay_setup(&robot.world, &[]);
    missing.program = None;
    let (original, mut news) = new_original(&robot, missing).await;
    original.start();
    wait_for_state(&mut news, LocalState::Missing).await;

    let mut broken = relay_setup(&robot.world, &[]);
    broken.program.as_mut().unwrap().path = "/nonexistent/relay".into();
    let (original, mut news) = new_original(&robot, broken).await;
    original.start();
    let said = async {
        loop {
            if let OriginalEvent::Crashed(reason) = news.recv().await.unwrap() {
                return reason;
            }
        }
    };
    let reason = timeout(SOON, said).await.unwrap();
    assert!(reason.contains("/nonexistent/relay"), "{reason}");
}

/// A cloud that accepts everything and answers only when the test says so.
#[derive(Default)]
struct SilentCloud {
    inputs: Mutex<Vec<SerializedMessage>>,
    calls: Mutex<Vec<RequestId>>,
}

impl Cloud for SilentCloud {
    fn publish(&self, _: &str, message: &SerializedMessage) {
        self.inputs.lock().push(message.clone());
    }

    fn call(&self, request: RequestId, _: &str, _: Bytes) {
        self.calls.lock().push(request);
    }

    fn call_unmeasured(&self, _: &str, _: Bytes) -> PendingAnswer {
        Box::pin(std::future::pending())
    }
}

struct RecordingApplication(mpsc::UnboundedSender<String>);

impl Application for RecordingApplication {
    fn deliver(&self, _: &str, message: SerializedMessage) {
        let _ = self.0.send(message_text(&message));
    }

    fn on_latched_output(&self, _: &str, message: SerializedMessage) {
        let _ = self.0.send(format!("kept: {}", message_text(&message)));
    }

    fn safe_stop(&self, stop: &SafeStop) {
        let _ = self.0.send(format!("stop on {}", stop.topic));
    }

    fn on_decision(&self, event: &QosEvent) {
        let name = format!("{event:?}");
        let name = name.split('(').next().unwrap();
        let _ = self.0.send(name.to_lowercase());
    }

    fn on_hand_over(&self, over: &HandOver) {
        let missed = over.missed.iter();
        let missed = missed.map(|missed| format!("{} of {}", missed.count, missed.name));
        let missed = missed.collect::<Vec<_>>().join(", ");
        let to = format!("{:?}", over.to).to_lowercase();
        let _ = self.0.send(format!("{to} lacks {missed}"));
    }

    fn on_missed_requests(&self, over: &HandOver) {
        self.on_hand_over(over);
    }

    fn on_outcome(&self, _: &RequestOutcome) {}
}

async fn the_cloud_falls_silent_and_the_local_original_answers_until_it_speaks_again(ros: RosVersion) {
    let robot = robot(ros).await;
    let sla = serde_json::json!({
        "t_desire": 0.02, "t_max": 0.05, "local": "cold", "initial": 5,
        "safe_stop": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist"},
    });
    let (told, mut hears) = mpsc::unbounded_channel();
    let cloud = Arc::new(SilentCloud::default());
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec!["/ns/in -> /absolute/out by arrival".parse().unwrap()],
        Some(new_relay(&robot, &[]).await),
        cloud.clone(),
        Arc::new(RecordingApplication(told)),
    );
    keeper.link_up(false);
    let topic: Arc<str> = "/ns/in".into();
    keeper.on_input(&topic, string_message(ros, "lost"));
    for expected in ["stop on /cmd_vel", "start", "feed"] {
        let heard = timeout(SOON, hears.recv()).await.unwrap().unwrap();
        assert_eq!(heard, expected);
    }
    keeper.on_input(&topic, string_message(ros, "world"));
    let mut heard = String::new();
    while heard != "hello world" {
        heard = timeout(SOON, hears.recv()).await.unwrap().unwrap();
    }
    assert_eq!(cloud.inputs.lock().len(), 2, "the cloud is asked all the time");
    // The cloud answers in time again, until Q is above its threshold.
    let stopped = async {
        while heard != "stop" {
            keeper.on_input(&topic, string_message(ros, "x"));
            keeper.on_cloud_output("/absolute/out", &string_message(ros, "cloud"), OutputTiming::default());
            // The answers of the original may be too late to be published.
            tokio::task::yield_now().await;
            while heard != "stop" {
                match hears.try_recv() {
                    Ok(next) => heard = next,
                    Err(_) => break,
                }
            }
        }
    };
    timeout(SOON, stopped).await.unwrap();
    let report = keeper.report();
    assert!(report.summary.contains("the cloud answers"), "{}", report.summary);
}

async fn a_call_is_answered_by_the_local_original_when_the_link_is_lost(ros: RosVersion) {
    let robot = robot(ros).await;
    let sla = serde_json::json!({"t_desire": 0.05, "t_max": 0.1, "local": "warm", "initial": 5});
    let (told, mut hears) = mpsc::unbounded_channel();
    let cloud = Arc::new(SilentCloud::default());
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec![],
        Some(new_relay(&robot, &[]).await),
        cloud.clone(),
        Arc::new(RecordingApplication(told)),
    );
    keeper.link_up(false);
    let service: Arc<str> = "/ns/relay/echo".into();
    let call = {
        let (keeper, service) = (keeper.clone(), service.clone());
        tokio::spawn(async move { keeper.call(&service, encode_string(ros, "request")).await })
    };
    while cloud.calls.lock().is_empty() {
        tokio::task::yield_now().await;
    }
    assert_eq!(hears.recv().await.unwrap(), "start");
    keeper.link_down();
    let answer = timeout(SOON, call).await.unwrap().unwrap();
    let answer = answer.map(|answer| decode_string(ros, &answer));
    assert_eq!(answer.as_deref(), Ok("request"));
    let id = cloud.calls.lock()[0];
    keeper.on_cloud_answer(id, Ok(Bytes::from_static(b"late")), None);
    assert_eq!(keeper.report().counts.from_local, 1);
}

#[tokio::test]
async fn without_a_local_original_a_call_fails_with_the_reason() {
    let sla = serde_json::json!({"t_desire": 0.01, "t_max": 0.02});
    let (told, mut hears) = mpsc::unbounded_channel();
    let keeper = Keeper::start(
        QosSla::parse(sla).unwrap(),
        vec![],
        None,
        Arc::new(SilentCloud::default()),
        Arc::new(RecordingApplication(told)),
    );
    let error = timeout(SOON, keeper.call(&"/add".into(), Bytes::new())).await.unwrap().unwrap_err().to_string();
    assert!(error.contains("the link is down"), "{error}");
    assert!(error.contains("there is no local original"), "{error}");
    assert_eq!(hears.recv().await.unwrap(), "saidoncemissing");
    assert!(hears.try_recv().is_err());
}
