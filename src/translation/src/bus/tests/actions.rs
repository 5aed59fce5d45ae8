//! Goals of a robot at real servers of the other ROS.

use ros::bus::{ActionHandler, ActionServer, GoalEnd, GoalOutcome};
use ros::codec::Time;
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId};
use tokio::sync::mpsc;

use super::*;

pub(super) fn count(version: RosVersion) -> Arc<ActionDef> {
    definitions(version).action("x_msgs/Count").expect("an action")
}

/// Reports goals, and cancels with `None`.
struct Handler(mpsc::UnboundedSender<(String, Option<Bytes>)>);

impl ActionHandler for Handler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let _ = self.0.send((id.to_owned(), Some(goal)));
        Ok(())
    }

    fn on_cancel(&self, id: &str) {
        let _ = self.0.send((id.to_owned(), None));
    }

    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

/// A server of the servant, and what it is asked for.
struct Server {
    server: Box<dyn ActionServer>,
    heard: mpsc::UnboundedReceiver<(String, Option<Bytes>)>,
}

impl Server {
    fn new(node: &dyn Bus) -> Server {
        let (told, heard) = mpsc::unbounded_channel();
        let server = node.serve_action("/count", &count(node.version()), Arc::new(Handler(told)));
        Server { server: server.expect("served"), heard }
    }

    async fn next(&mut self) -> (String, Option<Bytes>) {
        timeout(LONG, self.heard.recv()).await.expect("it comes").expect("a handler")
    }
}

async fn wait_for_server(bus: &dyn Bus) {
    wait_graph(bus, |graph| graph.actions.get("/count").is_some_and(|action| action.servers == ["/see"])).await;
}

fn end(version: RosVersion, outcome: GoalOutcome) -> GoalEnd {
    let result = serialize(&count(version).result, &json!({ "sum": 9 }));
    GoalEnd { outcome, text: String::new(), result }
}

#[tokio::test]
async fn a_robot_of_ros_1_has_goals_carried_out_by_a_server_of_ros_2() {
    let (bus, _, node) = servant_of_ros2();
    let mut server = Server::new(&*node);
    wait_for_server(&*bus).await;
    let qos = QosProfile::keep_last(100);
    let of = |part: &Arc<MessageType>| WireType::from_message(part);
    let robots = count(RosVersion::One);
    let mut feedback = bus.subscribe("/count/feedback", of(&robots.action_feedback), qos).await.expect("a topic");
    let mut result = bus.subscribe("/count/result", of(&robots.action_result), qos).await.expect("a topic");
    let goals = bus.advertise("/count/goal", of(&robots.action_goal), qos).await.expect("a topic");
    let cancels = bus.advertise("/count/cancel", WireType::any(), qos).await.expect("a topic");
    let id = |id: &str| GoalId { id: id.to_owned(), ..GoalId::default() };
    for name in ["first", "second"] {
        let goal = serialize(&robots.goal, &json!({ "order": 7 }));
        goals.publish(messages::write_goal(Time::default(), &id(name), &goal));
    }
    let (first, goal) = server.next().await;
    assert_eq!(parse(&count(RosVersion::Two).goal, &goal.expect("a goal")), json!({ "order": 7 }));
    let (second, _) = server.next().await;
    assert!(server.server.publish_feedback(&first, serialize(&count(RosVersion::Two).feedback, &json!({ "part": 3 }))));
    let told = next(&mut feedback).await;
    let (state, body) = messages::read_state(&told.bytes).expect("feedback");
    assert_eq!((&*state.goal.id, parse(&robots.feedback, &body)), ("first", json!({ "part": 3 })));
    assert!(server.server.end_goal(&first, end(RosVersion::Two, GoalOutcome::Succeeded)));
    let (state, body) = messages::read_state(&next(&mut result).await.bytes).expect("a result");
    assert_eq!((&*state.goal.id, state.status), ("first", ActionlibStatus::Succeeded));
    assert_eq!(parse(&robots.result, &body), json!({ "sum": 9 }));
    cancels.publish(messages::write_cancel(&id("second")));
    assert_eq!(server.next().await, (second.clone(), None));
    assert!(server.server.end_goal(&second, end(RosVersion::Two, GoalOutcome::Canceled)));
    let (state, _) = messages::read_state(&next(&mut result).await.bytes).expect("a result");
    assert_eq!(&*state.goal.id, "second");
    assert!(matches!(state.status, ActionlibStatus::Preempted | ActionlibStatus::Recalled), "{state:?}");
}

#[tokio::test]
async fn a_robot_of_ros_2_has_goals_carried_out_by_a_server_of_ros_1() {
    let (bus, _, node) = servant_of_ros1().await;
    let mut server = Server::new(&*node);
    wait_for_server(&*bus).await;
    let robots = count(RosVersion::Two);
    let services = robots.services.as_ref().expect("of ROS 2");
    let qos = QosProfile::keep_last(100);
    let of = WireType::from_message(&robots.action_feedback);
    let mut feedback = bus.subscribe("/count/_action/feedback", of, qos).await.expect("a topic");
    let uuid = |number: u8| json!({ "uuid": vec![number; 16] });
    let call = async |name: &str, of: &MessageType, value: Value| {
        let answer = bus.call(&format!("/count/_action/{name}"), serialize(of, &value), LONG).await;
        answer.expect("an answer")
    };
    let send = async |number: u8| {
        let goal = json!({ "goal_id": uuid(number), "goal": { "order": 7 } });
        let answer = call("send_goal", &services.send_goal.request, goal).await;
        parse(&services.send_goal.response, &answer)["accepted"] == true
    };
    let result = async |number: u8| {
        let answer = call("get_result", &services.get_result.request, json!({ "goal_id": uuid(number) })).await;
        let answer = parse(&services.get_result.response, &answer);
        (answer["status"].clone(), answer["result"]["sum"].clone())
    };
    // Its status, which comes five times a second, tells that it is accepted.
    assert!(send(1).await);
    let (first, goal) = server.next().await;
    assert_eq!(first, "01010101-0101-0101-0101-010101010101");
    assert_eq!(parse(&count(RosVersion::One).goal, &goal.expect("a goal")), json!({ "order": 7 }));
    assert!(server.server.publish_feedback(&first, serialize(&count(RosVersion::One).feedback, &json!({ "part": 3 }))));
    let told = parse(&robots.action_feedback, &next(&mut feedback).await.bytes);
    assert_eq!(told["feedback"], json!({ "part": 3 }));
    assert!(server.server.end_goal(&first, end(RosVersion::One, GoalOutcome::Succeeded)));
    assert_eq!(result(1).await, (json!(4), json!(9)));
    assert!(send(2).await);
    let (second, _) = server.next().await;
    let cancel = Registry::for_version(RosVersion::Two).service("action_msgs/srv/CancelGoal").expect("known to all");
    let wanted = json!({ "goal_info": { "goal_id": uuid(2) } });
    let answer = call("cancel_goal", &cancel.request, wanted).await;
    let answer = parse(&cancel.response, &answer);
    assert_eq!(answer["goals_canceling"].as_array().map(Vec::len), Some(1), "{answer}");
    assert_eq!(server.next().await, (second.clone(), None));
    assert!(server.server.end_goal(&second, end(RosVersion::One, GoalOutcome::Canceled)));
    assert_eq!(result(2).await.0, json!(5));
    // Its goals end with the server.
    assert!(send(3).await);
    drop(server);
    assert_eq!(result(3).await.0, json!(6));
}
