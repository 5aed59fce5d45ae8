use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;
use package::interface::Interface;
use ros::bus::{
    ActionHandler, ActionServer, Bus, BusError, FailureReason, GoalEnd, GoalOutcome, QosProfile, RosVersion,
    Subscription, WireType,
};
use ros::codec::{from_json, to_json};
use ros::schema::{ActionDef, MessageType, Registry};
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::group::ServantGroup;
use crate::group::bus::GroupBus;
use crate::group::dispatch::{GroupLoad, Member, Rules};
use crate::group::node_ends;
use crate::memory_bus::MemorySystem;

/// Budget of each robot.
const BYTES: usize = 1 << 20;
const PATIENCE: Duration = Duration::from_secs(60);
const SEND: &str = "/count/_action/send_goal";
const CANCEL: &str = "/count/_action/cancel_goal";
const RESULT: &str = "/count/_action/get_result";

struct PartsWorld {
    group: Arc<ServantGroup>,
    registry: Arc<Registry>,
    of: Arc<ActionDef>,
}

impl PartsWorld {
    /// Creates a group without servants.
    fn new() -> PartsWorld {
        let interface: Interface = serde_json::from_value(json!({
            "topics": [],
            "services": [],
            "actions": [{ "name": "/count", "type": "x_msgs/action/Count", "node": "/counter" }],
            "definitions": { "x_msgs/action/Count": "string data\n---\nint64 all\n---\nint64 now\n" },
        }))
        .expect("an interface");
        let ros = RosVersion::Two;
        let registry = Registry::with_definitions(ros, &interface.definitions);
        let registry = Arc::new(registry.expect("definitions"));
        let rules = Rules { window: 1, replicas: 1, idempotent: false };
        PartsWorld {
            group: ServantGroup::new(ros, "jazzy", &interface, rules),
            of: registry.action("x_msgs/action/Count").expect("an action"),
            registry,
        }
    }

    /// Adds a servant that accepts or rejects goals.
    fn servant(&self, takes: bool) -> Servant {
        let system = Arc::<MemorySystem>::default();
        let (told, heard) = mpsc::unbounded_channel();
        let node = system.join("/counter");
        let server = node.serve_action("/count", &self.of, Arc::new(Handler { told, takes }));
        let member = self.group.join("servant-1", system.join("/daemon"));
        Servant { server: server.expect("served"), heard, member }
    }

    fn robot(&self) -> Robot {
        let (notices, told) = mpsc::unbounded_channel();
        let budget = Budget::new("the robot", BYTES);
        let (bus, _) = self.group.create_buses(&self.registry, &budget, &notices);
        Robot { bus, of: Arc::clone(&self.of), told }
    }

    fn waiting(&self) -> usize {
        let GroupLoad { waiting, .. } = self.group.load();
        waiting
    }
}

struct Handler {
    told: mpsc::UnboundedSender<(String, bool)>,
    takes: bool,
}

impl ActionHandler for Handler {
    fn on_goal(&self, id: &str, _goal: Bytes) -> Result<(), FailureReason> {
        let _ = self.told.send((id.to_owned(), true));
        if self.takes { Ok(()) } else { Err(FailureReason::new("")) }
    }

    fn on_cancel(&self, id: &str) {
        let _ = self.told.send((id.to_owned(), false));
    }

    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

/// The servant's side of goals.
struct Servant {
    server: Box<dyn ActionServer>,
    heard: mpsc::UnboundedReceiver<(String, bool)>,
    member: Member,
}

impl Servant {
    /// Returns the next goal that it receives, or that is to be cancelled.
    async fn next_goal(&mut self) -> (String, bool) {
        self.heard.recv().await.expect("it is there")
    }
}

struct Robot {
    bus: Arc<GroupBus>,
    of: Arc<ActionDef>,
    told: mpsc::UnboundedReceiver<(String, String)>,
}

fn cdr(of: &MessageType, values: &Value) -> Bytes {
    let mut out = Vec::new();
    let text = values.to_string();
    from_json(of, text.as_bytes(), &mut out, &Default::default()).expect("a message");
    out.into()
}

fn read(of: &MessageType, bytes: &[u8]) -> Value {
    let mut out = Vec::new();
    to_json(of, bytes, &mut out, &Default::default()).expect("a message");
    serde_json::from_slice(&out).expect("JSON")
}

/// Returns the id of a goal as JSON, in which bytes are text.
fn id(number: u8) -> Value {
    let of = Registry::for_version(RosVersion::Two).message("unique_identifier_msgs/msg/UUID");
    let of = of.expect("known to all");
    read(&of, &cdr(&of, &json!({ "uuid": vec![number; 16] })))
}

impl Robot {
    /// Sends a goal; returns whether it was accepted.
    async fn send_goal(&self, number: u8, data: &str) -> Result<bool, BusError> {
        let of = &self.of.services.as_ref().expect("of ROS 2").send_goal;
        let goal = json!({ "goal_id": id(number), "goal": { "data": data } });
        let answer = self.bus.call(SEND, cdr(&of.request, &goal), PATIENCE).await?;
        Ok(read(&of.response, &answer)["accepted"] == true)
    }

    /// Cancels goals; returns those that will end and the return code.
    async fn cancel_goals(&self, number: u8) -> (Vec<u8>, u64) {
        let service = self.registry_service("action_msgs/srv/CancelGoal");
        let wanted = json!({ "goal_info": { "goal_id": id(number) } });
        let answer = self.bus.call(CANCEL, cdr(&service.request, &wanted), PATIENCE);
        let answer = read(&service.response, &answer.await.expect("an answer"));
        let goals = answer["goals_canceling"].as_array().expect("goals");
        let number = |goal: &Value| (1..9).find(|number| goal["goal_id"] == id(*number));
        let numbers: Option<Vec<u8>> = goals.iter().map(number).collect();
        let code = answer["return_code"].as_u64().unwrap_or_default();
        (numbers.expect("goals of these tests"), code)
    }

    fn registry_service(&self, name: &str) -> Arc<ros::schema::ServiceDef> {
        Registry::for_version(RosVersion::Two).service(name).expect("known to all")
    }

    /// Returns status and result.
    async fn result(&self, number: u8) -> (u64, i64) {
        let of = &self.of.services.as_ref().expect("of ROS 2").get_result;
        let request = cdr(&of.request, &json!({ "goal_id": id(number) }));
        let answer = self.bus.call(RESULT, request, PATIENCE).await;
        let answer = read(&of.response, &answer.expect("an answer"));
        (answer["status"].as_u64().unwrap_or_default(), answer["result"]["all"].as_i64().unwrap_or_default())
    }

    async fn subscribe(&self, topic: &str) -> Subscription {
        let topic = format!("/count/_action/{topic}");
        let qos = QosProfile::keep_last(10).latching(true);
        let heard = self.bus.subscribe(&topic, WireType::any(), qos).await;
        heard.expect("a topic")
    }

    /// Returns the statuses published last.
    async fn statuses(&self) -> Vec<u64> {
        let mut heard = self.subscribe("status").await;
        let last = heard.messages.try_recv().expect("a status");
        assert!(last.latching);
        let of = Registry::for_version(RosVersion::Two).message("action_msgs/msg/GoalStatusArray");
        let statuses = read(&of.expect("known to all"), &last.bytes);
        let statuses = statuses["status_list"].as_array().expect("a list");
        let statuses = statuses.iter().map(|one| one["status"].as_u64());
        statuses.map(Option::unwrap_or_default).collect()
    }

    fn next_notice(&mut self) -> String {
        let (node, what) = self.told.try_recv().expect("it is told");
        assert_eq!(node, "/counter");
        what
    }
}

/// `action_msgs/msg/GoalStatus`.
const ACCEPTED: u64 = 1;
const EXECUTING: u64 = 2;
const SUCCEEDED: u64 = 4;
const CANCELED: u64 = 5;
const ABORTED: u64 = 6;

fn end(of: &ActionDef, all: i64) -> GoalEnd {
    GoalEnd { outcome: GoalOutcome::Succeeded, text: String::new(), result: cdr(&of.result, &json!({ "all": all })) }
}

#[tokio::test]
async fn a_goal_is_answered_as_its_node_answers_it() {
    let world = PartsWorld::new();
    let mut servant = world.servant(true);
    let robot = world.robot();
    let mut feedback = robot.subscribe("feedback").await;
    assert!(robot.send_goal(1, "go").await.expect("an answer"));
    let (goal, _) = servant.next_goal().await;
    assert_eq!(robot.statuses().await, [EXECUTING]);
    let now = cdr(&world.of.feedback, &json!({ "now": 3 }));
    assert!(servant.server.publish_feedback(&goal, now));
    let told = feedback.messages.recv().await.expect("feedback");
    assert_eq!(told.publisher.node(), "/counter");
    let told = read(&world.of.action_feedback, &told.bytes);
    assert_eq!(told, json!({ "goal_id": id(1), "feedback": { "now": 3 } }));
    assert!(servant.server.end_goal(&goal, end(&world.of, 7)));
    assert_eq!(robot.result(1).await, (SUCCEEDED, 7));
    assert_eq!(robot.statuses().await, [SUCCEEDED]);
    // A goal that was not sent.
    assert_eq!(robot.result(9).await.0, 0);
    assert_eq!(robot.cancel_goals(9).await, (vec![], 2));

    world.group.leave(servant.member, "it is replaced");
    let _refuses = world.servant(false);
    assert!(!robot.send_goal(2, "go").await.expect("an answer"));
    assert_eq!(robot.result(2).await.0, 0);
    assert_eq!(robot.statuses().await, [SUCCEEDED]);
}

#[tokio::test]
async fn a_goal_that_waits_for_a_servant_is_accepted_and_can_be_cancelled() {
    let world = PartsWorld::new();
    let robot = world.robot();
    assert!(robot.send_goal(1, "go").await.expect("an answer"));
    assert!(robot.send_goal(2, "go").await.expect("an answer"));
    assert_eq!(world.waiting(), 2);
    assert_eq!(robot.statuses().await, [ACCEPTED, ACCEPTED]);
    assert_eq!(robot.cancel_goals(1).await, (vec![1], 0));
    assert_eq!(robot.result(1).await.0, CANCELED);
    let mut servant = world.servant(true);
    let (goal, _) = servant.next_goal().await;
    while robot.statuses().await != [CANCELED, EXECUTING] {
        tokio::task::yield_now().await;
    }
    assert_eq!(robot.cancel_goals(2).await, (vec![2], 0));
    assert_eq!(servant.next_goal().await, (goal.clone(), false));
    let canceled = GoalEnd { outcome: GoalOutcome::Canceled, ..end(&world.of, 1) };
    assert!(servant.server.end_goal(&goal, canceled));
    assert_eq!(robot.result(2).await, (CANCELED, 1));
    // The goal has ended.
    assert_eq!(robot.cancel_goals(2).await, (vec![], 3));
}

#[tokio::test]
async fn a_node_that_refuses_a_goal_that_has_waited_aborts_it_and_the_robot_is_told() {
    let world = PartsWorld::new();
    let mut robot = world.robot();
    assert!(robot.send_goal(1, "go").await.expect("an answer"));
    let _refuses = world.servant(false);
    assert_eq!(robot.result(1).await.0, ABORTED);
    let told = robot.next_notice();
    assert!(told.contains("did not accept it"), "{told}");
}

#[tokio::test]
async fn a_goal_whose_servant_is_lost_is_aborted_and_the_robot_is_told_why() {
    let world = PartsWorld::new();
    let mut robot = world.robot();
    let mut servant = world.servant(true);
    assert!(robot.send_goal(1, "go").await.expect("an answer"));
    servant.next_goal().await;
    world.group.leave(servant.member, "its power went");
    assert_eq!(robot.result(1).await.0, ABORTED);
    let told = robot.next_notice();
    for words in ["servant-1", "its power went", "--idempotent", "/count"] {
        assert!(told.contains(words), "{told}");
    }
}

#[tokio::test]
async fn goals_of_two_robots_do_not_meet() {
    let world = PartsWorld::new();
    let (one, two) = (world.robot(), world.robot());
    assert!(one.send_goal(1, "one").await.expect("an answer"));
    assert!(two.send_goal(1, "two").await.expect("an answer"));
    assert_eq!(one.cancel_goals(0).await, (vec![1], 0));
    assert_eq!(one.statuses().await, [CANCELED]);
    assert_eq!(two.statuses().await, [ACCEPTED]);
    // A goal with an id in use is rejected, and the other goal is unaffected.
    assert!(!two.send_goal(1, "again").await.expect("an answer"));
}

#[tokio::test]
async fn goals_under_way_count_in_their_robots_budget() {
    let world = PartsWorld::new();
    let mut robot = world.robot();
    let large = "x".repeat(BYTES / 2);
    assert!(robot.send_goal(1, &large).await.expect("an answer"));
    assert!(!robot.send_goal(2, &large).await.expect("an answer"));
    let told = robot.next_notice();
    assert!(told.contains("the robot"), "{told}");
    assert_eq!(world.waiting(), 1);
    robot.cancel_goals(1).await;
    assert_eq!(robot.result(1).await.0, CANCELED);
    assert!(robot.send_goal(3, &large).await.expect("an answer"));
}

#[tokio::test]
async fn goals_of_a_robot_whose_place_ended_keep_no_servant_from_others() {
    let world = PartsWorld::new();
    let robot = world.robot();
    assert!(robot.send_goal(1, "go").await.expect("an answer"));
    assert_eq!(world.waiting(), 1);
    drop(robot);
    let ended = async {
        while world.waiting() > 0 {
            tokio::task::yield_now().await;
        }
    };
    timeout(PATIENCE, ended).await.expect("it is cancelled");
}

#[tokio::test]
async fn the_group_has_the_ends_of_an_action_server() {
    let world = PartsWorld::new();
    let robot = world.robot();
    let graph = robot.bus.graph().borrow().clone();
    assert!(graph.topics.is_empty(), "they are hidden");
    assert_eq!(graph.actions["/count"].servers, ["/counter"]);
    let ends = &graph.ends["/counter"];
    let services: Vec<_> = ends.services.keys().map(String::as_str).collect();
    assert_eq!(services, [CANCEL, RESULT, SEND]);
    let sends = &ends.services[SEND];
    assert_eq!(sends.name, "x_msgs/action/Count_SendGoal");
    assert!(sends.request.as_str().starts_with("RIHS01_"));
    assert!(ends.publishers["/count/_action/status"].1.is_latching());
    assert!(!ends.publishers["/count/_action/feedback"].1.is_latching());
    let told = robot.bus.service_type(SEND).await.expect("a type");
    assert_eq!(told, *sends);
    let view = &world.group.whole;
    let again = node_ends::collect_node_ends(view, &world.group.interface, &world.registry);
    assert_eq!(again, graph.ends);
    // Services are not topics.
    let refused = robot.bus.subscribe(SEND, WireType::any(), QosProfile::keep_last(1));
    assert!(matches!(refused.await, Err(BusError::NotShared(_))));
    let refused = robot.bus.node_parameters().err().expect("refused");
    assert!(refused.to_string().contains("robots share"), "{refused}");
}
