//! Goals between two buses, and between both ends of one bus.

use std::time::Duration;

use bytes::Bytes;
use ros_bus::{ActionClient, ActionServer, Bus, BusError, GoalOutcome, QosProfile, WireType};
use ros_message::codec::{JsonOptions, default_message, to_json};
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::time::timeout;

use super::*;
use crate::Ros2Bus;
use crate::actions::GoalId;
use crate::actions::messages;
use crate::interfaces;
use crate::testing::join;

const LONG: Duration = Duration::from_secs(60);
const UUID: &str = "00112233-4455-6677-8899-aabbccddeeff";

async fn next<T>(events: &mut UnboundedReceiver<T>) -> T {
    let event = timeout(LONG, events.recv()).await;
    event.expect("something happens in time").expect("its sender is there")
}

fn goal() -> Bytes {
    cdr(&fibonacci().goal, r#"{"order":5}"#)
}

fn sequence(json: &str) -> Bytes {
    cdr(&fibonacci().result, &format!(r#"{{"sequence":{json}}}"#))
}

fn end(outcome: GoalOutcome, result: Bytes) -> GoalEnd {
    GoalEnd { outcome, text: String::new(), result }
}

async fn client(bus: &Ros2Bus) -> Box<dyn ActionClient> {
    let client = bus.action_client("/fib", &fibonacci()).unwrap();
    client.wait_for_server(LONG).await.unwrap();
    client
}

fn serve(bus: &Ros2Bus, takes: bool) -> (Box<dyn ActionServer>, UnboundedReceiver<Heard>) {
    let (handler, heard) = Handler::new(takes);
    (bus.serve_action("/fib", &fibonacci(), handler).unwrap(), heard)
}

fn send(client: &dyn ActionClient, id: &str) -> UnboundedReceiver<Told> {
    let (events, told) = Events::new();
    client.send_goal(id, goal(), events);
    told
}

/// Returns the server's id of the next goal it receives.
async fn next_goal_id(heard: &mut UnboundedReceiver<Heard>) -> String {
    match next(heard).await {
        Heard::Goal(id, sent) => {
            assert_eq!(sent, goal());
            id
        }
        other => panic!("{other:?} is no goal"),
    }
}

/// One goal whose feedback and result arrive, and one that is cancelled.
async fn goals_pass(using: &Ros2Bus, serving: &Ros2Bus) {
    let (server, mut heard) = serve(serving, true);
    let client = client(using).await;
    let mut told = send(&*client, UUID);
    assert_eq!(next_goal_id(&mut heard).await, UUID, "a UUID is kept");
    for feedback in ["[0]", "[0,1]"] {
        assert!(server.publish_feedback(UUID, sequence(feedback)));
        assert_eq!(next(&mut told).await, Told::Feedback(sequence(feedback)));
    }
    assert!(server.publish_feedback(UUID, sequence("[0,1,1]")));
    assert!(server.end_goal(UUID, end(GoalOutcome::Succeeded, sequence("[0,1,1,2]"))));
    assert_eq!(next(&mut told).await, Told::Feedback(sequence("[0,1,1]")));
    let ended = end(GoalOutcome::Succeeded, sequence("[0,1,1,2]"));
    assert_eq!(next(&mut told).await, Told::Ended(Ok(ended)));
    assert!(!server.publish_feedback(UUID, sequence("[]")));
    assert!(!server.end_goal(UUID, end(GoalOutcome::Aborted, sequence("[]"))));

    let mut told = send(&*client, "second");
    let id = next_goal_id(&mut heard).await;
    client.cancel_goal("second");
    assert_eq!(next(&mut heard).await, Heard::Cancel(id.clone()));
    assert!(server.end_goal(&id, end(GoalOutcome::Canceled, sequence("[0]"))));
    let ended = end(GoalOutcome::Canceled, sequence("[0]"));
    assert_eq!(next(&mut told).await, Told::Ended(Ok(ended)));
    client.cancel_goal("second");

    let mut told = send(&*client, "third");
    let id = next_goal_id(&mut heard).await;
    let mut twice = send(&*client, "third");
    assert!(matches!(next(&mut twice).await, Told::Ended(Err(_))), "it is under way");
    // No result at all, and one of the wrong type.
    assert!(server.end_goal(&id, end(GoalOutcome::Aborted, Bytes::new())));
    let nothing = Bytes::from(default_message(&fibonacci().result));
    let ended = end(GoalOutcome::Aborted, nothing.clone());
    assert_eq!(next(&mut told).await, Told::Ended(Ok(ended)));
    let mut told = send(&*client, "fourth");
    let id = next_goal_id(&mut heard).await;
    assert!(server.end_goal(&id, end(GoalOutcome::Succeeded, Bytes::from_static(b"?"))));
    let ended = end(GoalOutcome::Aborted, nothing);
    assert_eq!(next(&mut told).await, Told::Ended(Ok(ended)));
}

#[tokio::test]
async fn goals_pass_between_two_nodes() {
    let (one, two) = (join(71, "/one").await, join(71, "/two").await);
    goals_pass(&one, &two).await;
}

#[tokio::test]
async fn goals_pass_between_the_ends_of_one_node() {
    let one = join(72, "/one").await;
    goals_pass(&one, &one).await;
}

#[tokio::test]
async fn a_goal_that_is_not_taken_was_rejected() {
    let (one, two) = (join(73, "/one").await, join(73, "/two").await);
    let (_server, mut heard) = serve(&two, false);
    let client = client(&one).await;
    let mut told = send(&*client, "goal");
    next_goal_id(&mut heard).await;
    match next(&mut told).await {
        Told::Ended(Ok(end)) => assert_eq!(end.outcome, GoalOutcome::Rejected),
        other => panic!("{other:?}"),
    }
    let mut told = {
        let (events, told) = Events::new();
        client.send_goal("goal", Bytes::from_static(&[0, 1, 0, 0]), events);
        told
    };
    assert!(matches!(next(&mut told).await, Told::Ended(Err(_))), "it is no goal");
}

#[tokio::test]
async fn a_goal_may_be_accepted_or_rejected_later() {
    let (one, two) = (join(85, "/one").await, join(85, "/two").await);
    let (handler, mut heard) = Handler::deferring();
    let server = two.serve_action("/fib", &fibonacci(), handler).unwrap();
    let client = client(&one).await;
    let rejected = async |told: &mut UnboundedReceiver<Told>| match next(told).await {
        Told::Ended(Ok(end)) => assert_eq!(end.outcome, GoalOutcome::Rejected),
        other => panic!("{other:?}"),
    };
    let mut told = send(&*client, "rejected");
    let id = next_goal_id(&mut heard).await;
    assert!(server.end_goal(&id, end(GoalOutcome::Rejected, Bytes::new())));
    rejected(&mut told).await;
    assert!(!server.end_goal(&id, end(GoalOutcome::Succeeded, sequence("[0]"))), "it is forgotten");
    // One that waits first, and one that ends before it is accepted.
    let succeeded = || end(GoalOutcome::Succeeded, sequence("[0]"));
    let mut told = send(&*client, "accepted");
    let id = next_goal_id(&mut heard).await;
    server.accept_goal(&id);
    server.execute_goal(&id);
    assert!(server.end_goal(&id, succeeded()));
    assert_eq!(next(&mut told).await, Told::Ended(Ok(succeeded())));
    let mut told = send(&*client, "ended");
    let id = next_goal_id(&mut heard).await;
    assert!(server.end_goal(&id, succeeded()));
    assert_eq!(next(&mut told).await, Told::Ended(Ok(succeeded())));
    let mut told = send(&*client, "left");
    next_goal_id(&mut heard).await;
    drop(server);
    rejected(&mut told).await;
}

#[tokio::test]
async fn who_drops_its_client_has_its_goals_cancelled() {
    let (one, two) = (join(74, "/one").await, join(74, "/two").await);
    let (_server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let _told = send(&*client, "goal");
    let id = next_goal_id(&mut heard).await;
    drop(client);
    assert_eq!(next(&mut heard).await, Heard::Cancel(id));
}

#[tokio::test]
async fn who_drops_its_server_has_its_goals_aborted() {
    let (one, two) = (join(75, "/one").await, join(75, "/two").await);
    let (server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let (of, id) = (fibonacci(), GoalId::parse(UUID).unwrap());
    let sent = messages::write_with_id(id, &of.goal, &goal()).unwrap();
    let answer = one.call("/fib/_action/send_goal", sent, LONG).await;
    assert_eq!(messages::read_accepted(&answer.unwrap()), Some(true));
    next_goal_id(&mut heard).await;
    let ask = async |id| {
        let request = messages::write_id(id);
        let answer = one.call("/fib/_action/get_result", request, LONG).await;
        let (status, _) = messages::read_result(&of.result, &answer.unwrap()).unwrap();
        status.unwrap()
    };
    let mut waiting = std::pin::pin!(ask(id));
    // Requests are processed in order: when the second is answered, the first is waiting there.
    let second = tokio::select! {
        biased;
        status = &mut waiting => panic!("{status:?} of a goal under way"),
        status = ask(GoalId([9; 16])) => status,
    };
    assert_eq!(second, messages::ActionGoalStatus::Unknown);
    drop(server);
    assert_eq!(waiting.await, messages::ActionGoalStatus::Aborted);
    // Another server may serve it at once.
    let (server, mut heard) = serve(&two, true);
    client.wait_for_server(LONG).await.unwrap();
    let mut told = send(&*client, UUID);
    next_goal_id(&mut heard).await;
    assert!(server.end_goal(UUID, end(GoalOutcome::Succeeded, sequence("[]"))));
    assert!(matches!(next(&mut told).await, Told::Ended(Ok(_))));
}

/// The client has not requested the result yet when the server goes.
#[tokio::test]
async fn a_goal_that_was_just_taken_is_aborted_as_well() {
    let (one, two) = (join(80, "/one").await, join(80, "/two").await);
    let (server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let mut told = send(&*client, "goal");
    next_goal_id(&mut heard).await;
    drop(server);
    match next(&mut told).await {
        Told::Ended(Ok(end)) => assert_eq!(end.outcome, GoalOutcome::Aborted),
        other => panic!("{other:?}"),
    }
    let _another = serve(&two, true);
}

#[tokio::test]
async fn another_server_takes_over_from_one_whose_results_nobody_has_asked_for() {
    let (one, two) = (join(84, "/one").await, join(84, "/two").await);
    let (server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let (of, id) = (fibonacci(), GoalId::parse(UUID).unwrap());
    let sent = messages::write_with_id(id, &of.goal, &goal()).unwrap();
    let answer = one.call("/fib/_action/send_goal", sent, LONG).await;
    assert_eq!(messages::read_accepted(&answer.unwrap()), Some(true));
    next_goal_id(&mut heard).await;
    drop(server);
    let (_server, mut heard) = serve(&two, true);
    client.wait_for_server(LONG).await.unwrap();
    let _told = send(&*client, UUID);
    assert_eq!(next_goal_id(&mut heard).await, UUID, "it knows nothing of the first one");
}

#[tokio::test]
async fn goals_end_with_the_node_that_carries_them_out() {
    let (one, two) = (join(76, "/one").await, join(76, "/two").await);
    let (_server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let mut told = send(&*client, "goal");
    next_goal_id(&mut heard).await;
    two.close().await;
    let gone = "action server /fib is gone".to_owned();
    assert_eq!(next(&mut told).await, Told::Ended(Err(gone)));
    let mut told = send(&*client, "late");
    let none = "action /fib has no server".to_owned();
    assert_eq!(next(&mut told).await, Told::Ended(Err(none)));
    let late = client.wait_for_server(Duration::from_millis(100)).await;
    assert!(matches!(late, Err(BusError::Timeout { .. })), "{late:?}");
}

#[tokio::test]
async fn goals_end_with_the_bus_that_has_sent_them() {
    let (one, two) = (join(77, "/one").await, join(77, "/two").await);
    let (_server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let mut told = send(&*client, "goal");
    next_goal_id(&mut heard).await;
    one.close().await;
    assert!(matches!(next(&mut told).await, Told::Ended(Err(_))));
    let mut told = send(&*client, "late");
    assert!(matches!(next(&mut told).await, Told::Ended(Err(_))));
}

#[tokio::test]
async fn several_clients_hear_of_their_own_goals_only() {
    let (one, two, three) = (join(78, "/one").await, join(78, "/two").await, join(78, "/three").await);
    let (server, mut heard) = serve(&three, true);
    let (first, second) = (client(&one).await, client(&two).await);
    let mut of_first = send(&*first, "same");
    let id_of_first = next_goal_id(&mut heard).await;
    let mut of_second = send(&*second, "same");
    let id_of_second = next_goal_id(&mut heard).await;
    assert!(server.publish_feedback(&id_of_second, sequence("[2]")));
    assert!(server.publish_feedback(&id_of_first, sequence("[1]")));
    assert_eq!(next(&mut of_first).await, Told::Feedback(sequence("[1]")));
    assert_eq!(next(&mut of_second).await, Told::Feedback(sequence("[2]")));
    for (id, told) in [(id_of_second, &mut of_second), (id_of_first, &mut of_first)] {
        assert!(server.end_goal(&id, end(GoalOutcome::Succeeded, sequence("[]"))));
        let ended = end(GoalOutcome::Succeeded, sequence("[]"));
        assert_eq!(next(told).await, Told::Ended(Ok(ended)));
    }
}

#[tokio::test]
async fn a_result_is_there_for_who_asks_late_and_statuses_for_who_comes_late() {
    let (one, two) = (join(79, "/one").await, join(79, "/two").await);
    let (server, mut heard) = serve(&two, true);
    let client = client(&one).await;
    let mut told = send(&*client, UUID);
    next_goal_id(&mut heard).await;
    assert!(server.end_goal(UUID, end(GoalOutcome::Succeeded, sequence("[8]"))));
    next(&mut told).await;
    let of = fibonacci();
    let result = async |id: &str| {
        let request = messages::write_id(GoalId::parse(id).unwrap());
        let answer = one.call("/fib/_action/get_result", request, LONG).await.unwrap();
        messages::read_result(&of.result, &answer).unwrap()
    };
    let succeeded = Some(messages::ActionGoalStatus::Succeeded);
    assert_eq!(result(UUID).await, (succeeded, sequence("[8]")));
    let (unknown, _) = result("ffffffff-4455-6677-8899-aabbccddeeff").await;
    assert_eq!(unknown, Some(messages::ActionGoalStatus::Unknown));

    let list = interfaces::message("action_msgs/msg/GoalStatusArray").unwrap();
    let qos = QosProfile::keep_last(1).latching(true);
    let status = "/fib/_action/status";
    let mut late = one.subscribe(status, WireType::from_message(&list), qos).await.unwrap();
    let message = timeout(LONG, late.messages.recv()).await.unwrap().unwrap();
    let mut json = Vec::new();
    to_json(&list, &message.bytes, &mut json, &JsonOptions::default()).unwrap();
    let json = String::from_utf8(json).unwrap();
    assert!(json.contains(r#""uuid":"ABEiM0RVZneImaq7zN3u/w==""#), "{json}");
    assert!(json.ends_with(r#""status":4}]}"#), "{json}");
}
