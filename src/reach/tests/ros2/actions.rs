use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use ros::bus::{
    ActionClient, ActionHandler, Bus, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome, RosVersion,
};
use ros::ros2::Ros2Bus;
use ros::schema::{ActionDef, Registry};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, cdr, json, wait_graph};

const NODE: &str = "/cloudroid_bridge";
const ACTION: &str = "/fib";
const SCRIPT: &str = "fibonacci.py";

pub fn fibonacci() -> Arc<ActionDef> {
    let registry = Registry::for_version(RosVersion::Two);
    let text = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n";
    let inserted = registry.insert("test_msgs/action/Fibonacci", text);
    inserted.expect("a definition");
    registry.action("test_msgs/Fibonacci").expect("an action")
}

/// An action with numbers of all sizes, whose alignment changes when a goal id or a status precedes them.
fn nested_action() -> Arc<ActionDef> {
    let registry = Registry::for_version(RosVersion::Two);
    let part = "Builtins nested_field_no_pkg\nBasicTypes nested_field\nbuiltin_interfaces/Time nested_different_pkg\n";
    let action = format!("{part}---\n{part}---\n{part}");
    for (key, text) in [
        ("test_msgs/msg/Builtins", "builtin_interfaces/Duration duration_value\nbuiltin_interfaces/Time time_value\n"),
        (
            "test_msgs/msg/BasicTypes",
            "bool bool_value\nbyte byte_value\nchar char_value\nfloat32 float32_value\nfloat64 float64_value\n\
             int8 int8_value\nuint8 uint8_value\nint16 int16_value\nuint16 uint16_value\nint32 int32_value\n\
             uint32 uint32_value\nint64 int64_value\nuint64 uint64_value\n",
        ),
        ("test_msgs/action/NestedMessage", &*action),
    ] {
        registry.insert(key, text).expect("a definition");
    }
    registry.action("test_msgs/NestedMessage").expect("an action")
}

async fn next<T>(events: &mut mpsc::UnboundedReceiver<T>) -> T {
    let event = timeout(LONG, events.recv()).await;
    event.expect("something happens").expect("its sender is there")
}

/// Events for the sender of a goal, with sequences as JSON.
#[derive(Debug, PartialEq)]
enum ClientGoalEvent {
    Feedback(String),
    Ended(Result<(GoalOutcome, String), String>),
}

struct Events {
    told: mpsc::UnboundedSender<ClientGoalEvent>,
    of: Arc<ActionDef>,
}

impl GoalEvents for Events {
    fn on_feedback(&self, feedback: Bytes) {
        let feedback = json(&self.of.feedback, &feedback);
        let _ = self.told.send(ClientGoalEvent::Feedback(feedback));
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let end = end.map(|end| (end.outcome, json(&self.of.result, &end.result)));
        let end = end.map_err(|error| error.to_string());
        let _ = self.told.send(ClientGoalEvent::Ended(end));
    }
}

fn send(client: &dyn ActionClient, order: i32) -> mpsc::UnboundedReceiver<ClientGoalEvent> {
    let (told, hears) = mpsc::unbounded_channel();
    let of = fibonacci();
    let goal = cdr(&of.goal, &format!(r#"{{"order":{order}}}"#));
    let events = Arc::new(Events { told, of });
    client.send_goal(&format!("order {order}"), goal, events);
    hears
}

/// Waits for the end of a goal; also returns the amount of feedback before it.
async fn wait_end(
    told: &mut mpsc::UnboundedReceiver<ClientGoalEvent>,
) -> (usize, Result<(GoalOutcome, String), String>) {
    let mut feedback = 0;
    loop {
        match next(told).await {
            ClientGoalEvent::Feedback(_) => feedback += 1,
            ClientGoalEvent::Ended(end) => return (feedback, end),
        }
    }
}

async fn client(bus: &Ros2Bus) -> Box<dyn ActionClient> {
    let client = bus.action_client(ACTION, &fibonacci()).expect("a client");
    client.wait_for_server(LONG).await.expect("a server");
    client
}

#[tokio::test]
async fn a_node_carries_out_goals() {
    let lab = Lab::new();
    let _server = lab.node(SCRIPT, &["server"]).await;
    let bus = lab.join(NODE).await;
    let client = client(&bus).await;
    wait_graph(&bus, |graph| {
        let action = graph.actions.get(ACTION);
        action.is_some_and(|action| {
            action.type_name == "test_msgs/action/Fibonacci" && action.servers == ["/lab/fibonacci"]
        })
    })
    .await;

    let mut told = send(&*client, 5);
    for sequence in ["[0,1,1]", "[0,1,1,2]", "[0,1,1,2,3]", "[0,1,1,2,3,5]"] {
        let expected = format!(r#"{{"sequence":{sequence}}}"#);
        assert_eq!(next(&mut told).await, ClientGoalEvent::Feedback(expected));
    }
    let result = r#"{"sequence":[0,1,1,2,3,5]}"#.to_owned();
    let succeeded = ClientGoalEvent::Ended(Ok((GoalOutcome::Succeeded, result)));
    assert_eq!(next(&mut told).await, succeeded);

    let (_, refused) = wait_end(&mut send(&*client, -1)).await;
    assert_eq!(refused.unwrap().0, GoalOutcome::Rejected);
    let (_, aborted) = wait_end(&mut send(&*client, 7)).await;
    let (outcome, result) = aborted.unwrap();
    assert_eq!(outcome, GoalOutcome::Aborted);
    assert_eq!(result, r#"{"sequence":[0,1,1,2,3,5,8,13]}"#);
}

#[tokio::test]
async fn numbers_of_all_sizes_come_back_as_feedback_and_result() {
    let lab = Lab::new();
    let _server = lab.node(SCRIPT, &["server"]).await;
    let bus = lab.join(NODE).await;
    let of = nested_action();
    let client = bus.action_client("/echo", &of).expect("a client");
    client.wait_for_server(LONG).await.expect("a server");
    let sent = concat!(
        r#"{"nested_field_no_pkg":{"duration_value":{"sec":-1,"nanosec":2},"time_value":{"sec":3,"nanosec":4}},"#,
        r#""nested_field":{"bool_value":true,"byte_value":5,"char_value":6,"float32_value":0.5,"float64_value":0.25,"#,
        r#""int8_value":-7,"uint8_value":8,"int16_value":-9,"uint16_value":10,"int32_value":-11,"uint32_value":12,"#,
        r#""int64_value":-13,"uint64_value":14},"nested_different_pkg":{"sec":15,"nanosec":16}}"#
    );
    let (told, mut hears) = mpsc::unbounded_channel();
    let events = Events { told, of: of.clone() };
    client.send_goal("numbers", cdr(&of.goal, sent), Arc::new(events));
    assert_eq!(next(&mut hears).await, ClientGoalEvent::Feedback(sent.to_owned()));
    let ended = ClientGoalEvent::Ended(Ok((GoalOutcome::Succeeded, sent.to_owned())));
    assert_eq!(next(&mut hears).await, ended);
}

#[tokio::test]
async fn goals_of_a_node_are_cancelled_if_it_agrees() {
    let lab = Lab::new();
    let _server = lab.node(SCRIPT, &["server"]).await;
    let bus = lab.join(NODE).await;
    let client = client(&bus).await;
    let mut told = send(&*client, 100_000);
    next(&mut told).await;
    client.cancel_goal("order 100000");
    let (_, cancelled) = wait_end(&mut told).await;
    assert_eq!(cancelled.unwrap().0, GoalOutcome::Canceled);

    let mut told = send(&*client, 13);
    next(&mut told).await;
    client.cancel_goal("order 13");
    let (feedback, finished) = wait_end(&mut told).await;
    assert_eq!((feedback, finished.unwrap().0), (11, GoalOutcome::Succeeded));

    // Two goals at a time, of which one is abandoned with its client.
    let other = bus.action_client(ACTION, &fibonacci()).unwrap();
    let mut of_other = send(&*other, 100_000);
    next(&mut of_other).await;
    let mut told = send(&*client, 20);
    next(&mut told).await;
    drop(other);
    let (_, finished) = wait_end(&mut told).await;
    assert_eq!(finished.unwrap().0, GoalOutcome::Succeeded);
    assert_eq!(timeout(LONG, async { while of_other.recv().await.is_some() {} }).await, Ok(()));
}

#[tokio::test]
async fn goals_end_with_a_node_that_is_killed() {
    let lab = Lab::new();
    let _server = lab.node(SCRIPT, &["server"]).await;
    let bus = lab.join(NODE).await;
    let client = client(&bus).await;
    let mut told = send(&*client, 99);
    next(&mut told).await;
    let begun = Instant::now();
    let (_, lost) = wait_end(&mut told).await;
    assert_eq!(lost, Err("action server /fib is gone".to_owned()));
    // Its own lease is 20 s.
    assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", begun.elapsed());
}

/// Events of a handler.
#[derive(Debug, PartialEq)]
enum HandlerEvent {
    /// Id and order of the goal, as JSON.
    Goal(String, String),
    Cancel(String),
}

struct Handler(mpsc::UnboundedSender<HandlerEvent>);

impl ActionHandler for Handler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let goal = json(&fibonacci().goal, &goal);
        if goal == r#"{"order":-1}"# {
            return Err(FailureReason::new("negative"));
        }
        let _ = self.0.send(HandlerEvent::Goal(id.to_owned(), goal));
        Ok(())
    }

    fn on_cancel(&self, id: &str) {
        let _ = self.0.send(HandlerEvent::Cancel(id.to_owned()));
    }

    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

/// Returns goals as their results.
struct Echo(mpsc::UnboundedSender<(String, Bytes)>);

impl ActionHandler for Echo {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let _ = self.0.send((id.to_owned(), goal));
        Ok(())
    }

    fn on_cancel(&self, _: &str) {}

    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

#[tokio::test]
async fn numbers_of_all_sizes_come_back_to_a_node() {
    let lab = Lab::new();
    let bus = lab.join(NODE).await;
    let (sender, mut goals) = mpsc::unbounded_channel();
    let server = bus.serve_action("/echo", &nested_action(), Arc::new(Echo(sender)));
    let server = server.expect("a server");
    let mut peer = lab.node(SCRIPT, &["client"]).await;
    peer.tell("echo -123456789012").await;
    // Goal, feedback and result have the same fields.
    let (id, same) = next(&mut goals).await;
    assert!(server.publish_feedback(&id, same.clone()));
    let expected = [json!(-123_456_789_012_i64), json!(true), json!(7)];
    assert_eq!(peer.wait_for("echoed").await, expected);
    let end = GoalEnd { outcome: GoalOutcome::Succeeded, text: String::new(), result: same };
    assert!(server.end_goal(&id, end));
    assert_eq!(peer.wait_for("echo").await, expected);
}

async fn expect_goal(heard: &mut mpsc::UnboundedReceiver<HandlerEvent>, order: u32) -> String {
    match next(heard).await {
        HandlerEvent::Goal(id, goal) => {
            assert_eq!(goal, format!(r#"{{"order":{order}}}"#));
            id
        }
        other => panic!("{other:?} is no goal"),
    }
}

/// Has the peer send a goal; returns its id, which is reported once the goal is accepted.
async fn send_peer_goal(peer: &mut Peer, order: u32) -> String {
    let answer = peer.obey(&format!("goal {order}")).await;
    assert_eq!(answer[0], json!(true), "{answer:?}");
    answer[1].as_str().expect("an id").to_owned()
}

#[tokio::test]
async fn goals_of_a_node_are_carried_out() {
    let lab = Lab::new();
    let bus = lab.join(NODE).await;
    let (sender, mut heard) = mpsc::unbounded_channel();
    let server = bus.serve_action(ACTION, &fibonacci(), Arc::new(Handler(sender)));
    let server = server.expect("a server");
    let mut peer = lab.node(SCRIPT, &["client"]).await;
    assert_eq!(peer.obey("there").await, [json!(true)]);

    let of = fibonacci();
    let sequence = |json: &str| cdr(&of.result, &format!(r#"{{"sequence":{json}}}"#));
    let told = send_peer_goal(&mut peer, 3).await;
    let id = expect_goal(&mut heard, 3).await;
    assert_eq!(id.replace('-', ""), told);
    assert!(server.publish_feedback(&id, sequence("[0,1]")));
    assert_eq!(peer.wait_for("feedback").await, [json!([0, 1])]);
    let result = |outcome, json: &str| GoalEnd { outcome, text: String::new(), result: sequence(json) };
    assert!(server.end_goal(&id, result(GoalOutcome::Succeeded, "[0,1,1]")));
    assert_eq!(peer.wait_for("ended").await, [json!(4), json!([0, 1, 1])]);

    let refused = peer.obey("goal -1").await;
    assert_eq!(refused[0], json!(false));

    send_peer_goal(&mut peer, 4).await;
    let id = expect_goal(&mut heard, 4).await;
    assert_eq!(peer.obey("cancel").await, [json!(1), json!(0)]);
    assert_eq!(next(&mut heard).await, HandlerEvent::Cancel(id.clone()));
    assert!(server.end_goal(&id, result(GoalOutcome::Canceled, "[7]")));
    assert_eq!(peer.wait_for("ended").await, [json!(5), json!([7])]);
    let late = peer.obey("cancel").await;
    assert_eq!(late[0], json!(0), "it has ended");

    send_peer_goal(&mut peer, 5).await;
    expect_goal(&mut heard, 5).await;
    drop(server);
    assert_eq!(peer.wait_for("ended").await, [json!(6), json!([])]);
}
