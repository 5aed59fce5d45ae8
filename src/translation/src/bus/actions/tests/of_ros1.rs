//! A robot of ROS 2 at a server of ROS 1.

use ros::codec::{JsonOptions, from_json, to_json};
use ros::schema::MessageType;
use serde_json::{Value, json};

use super::*;

const SEND: &str = "/count/_action/send_goal";
const CANCEL: &str = "/count/_action/cancel_goal";
const RESULT: &str = "/count/_action/get_result";

/// `action_msgs/msg/GoalStatus`.
const SUCCEEDED: u64 = 4;
const CANCELED: u64 = 5;
const ABORTED: u64 = 6;

/// A client of ROS 2 on the robot.
struct Robot {
    bus: Arc<TranslatedBus>,
    known: Registry,
    of: Arc<ActionDef>,
}

fn write(of: &MessageType, values: &Value) -> Bytes {
    let mut out = Vec::new();
    from_json(of, values.to_string().as_bytes(), &mut out, &Default::default()).expect("a message");
    out.into()
}

fn read(of: &MessageType, bytes: &[u8]) -> Value {
    let mut out = Vec::new();
    to_json(of, bytes, &mut out, &JsonOptions::default()).expect("a message");
    serde_json::from_slice(&out).expect("JSON")
}

/// Returns the id of a goal as the servant's server is given it.
fn text_id(number: u8) -> String {
    let digits = format!("{number:02x}").repeat(16);
    [&digits[..8], &digits[8..12], &digits[12..16], &digits[16..20], &digits[20..]].join("-")
}

fn uuid(number: u8) -> Value {
    json!({ "uuid": vec![number; 16] })
}

impl Robot {
    fn new(world: &World) -> Robot {
        let known = Registry::for_version(RosVersion::Two);
        known.insert("x_msgs/action/Count", DEFINITION).expect("a definition");
        let of = known.action("x_msgs/Count").expect("an action");
        Robot { bus: Arc::clone(&world.bus), known, of }
    }

    /// Sends a goal; returns whether it was accepted.
    async fn send(&self, number: u8) -> Result<bool, BusError> {
        let of = &self.of.services.as_ref().expect("of ROS 2").send_goal;
        let goal = json!({ "goal_id": uuid(number), "goal": { "order": 7 } });
        let answer = self.bus.call(SEND, write(&of.request, &goal), PATIENCE).await?;
        Ok(read(&of.response, &answer)["accepted"] == true)
    }

    /// Cancels a goal, or all (0); returns the number of those that end, and the code.
    async fn cancel(&self, number: u8) -> (usize, u64) {
        let of = self.known.service("action_msgs/srv/CancelGoal").expect("known to all");
        let wanted = json!({ "goal_info": { "goal_id": uuid(number) } });
        let answer = self.bus.call(CANCEL, write(&of.request, &wanted), PATIENCE).await.expect("an answer");
        let answer = read(&of.response, &answer);
        let ending = answer["goals_canceling"].as_array().expect("goals").len();
        (ending, answer["return_code"].as_u64().expect("a code"))
    }

    /// Returns status and result.
    async fn result(&self, number: u8) -> (u64, i64) {
        let of = &self.of.services.as_ref().expect("of ROS 2").get_result;
        let request = write(&of.request, &json!({ "goal_id": uuid(number) }));
        let answer = self.bus.call(RESULT, request, PATIENCE).await.expect("an answer");
        let answer = read(&of.response, &answer);
        (answer["status"].as_u64().expect("a status"), answer["result"]["sum"].as_i64().expect("a result"))
    }
}

impl World {
    /// Sends a goal whose server does this with it; returns whether it was accepted.
    async fn send(&self, robot: &Robot, number: u8, server: impl Fn(&dyn GoalEvents)) -> bool {
        let at_server = async {
            let (goal, events) = self.server.goal(&text_id(number)).await;
            assert_eq!(goal, super::number(RosVersion::One, 7));
            server(&*events);
        };
        let (accepted, ()) = tokio::join!(robot.send(number), at_server);
        accepted.expect("an answer")
    }

    fn events(&self, number: u8) -> Arc<dyn GoalEvents> {
        Arc::clone(&self.server.goals.lock()[&text_id(number)].1)
    }
}

fn goal_end(outcome: GoalOutcome) -> Result<GoalEnd, GoalError> {
    end(RosVersion::One, outcome)
}

#[tokio::test]
async fn goals_feedback_and_results_are_translated() {
    let world = World::new(RosVersion::One);
    let robot = Robot::new(&world);
    let qos = QosProfile::keep_last(10);
    let mut feedback = robot.bus.subscribe("/count/_action/feedback", WireType::any(), qos).await.expect("a topic");
    assert!(world.send(&robot, 1, |events| events.on_accepted()).await);
    let events = world.events(1);
    events.on_feedback(number(RosVersion::One, 3));
    let heard = feedback.messages.try_recv().expect("feedback");
    assert_eq!(heard.publisher.node(), "/counter");
    assert_eq!(read(&robot.of.action_feedback, &heard.bytes)["feedback"], json!({ "part": 3 }));
    events.on_ended(goal_end(GoalOutcome::Succeeded));
    assert_eq!(robot.result(1).await, (SUCCEEDED, 9));
    assert_eq!(robot.result(1).await, (SUCCEEDED, 9), "it is kept for who asks late");
}

#[tokio::test]
async fn ends_become_those_of_ros_2() {
    let world = World::new(RosVersion::One);
    let robot = Robot::new(&world);
    let gone = || Err(GoalError::ServerGone("/count".to_owned()));
    for (number, (listed, end, expected)) in [
        (true, goal_end(GoalOutcome::Succeeded), SUCCEEDED),
        (true, goal_end(GoalOutcome::Canceled), CANCELED),
        (true, goal_end(GoalOutcome::Aborted), ABORTED),
        (true, goal_end(GoalOutcome::Unknown), ABORTED),
        // It was listed as pending first.
        (true, goal_end(GoalOutcome::Rejected), ABORTED),
        (true, gone(), ABORTED),
        // The result comes before any status.
        (false, goal_end(GoalOutcome::Succeeded), SUCCEEDED),
        (false, goal_end(GoalOutcome::Canceled), CANCELED),
    ]
    .into_iter()
    .enumerate()
    {
        let number = u8::try_from(number + 1).expect("few");
        let end = Mutex::new(Some(end));
        let accepted = world.send(&robot, number, |events| {
            if listed {
                events.on_waiting();
            }
            events.on_ended(end.lock().take().expect("one end"));
        });
        assert!(accepted.await, "{number}");
        assert_eq!(robot.result(number).await.0, expected, "{number}");
    }
}

#[tokio::test]
async fn a_goal_that_is_rejected_or_has_no_server_is_not_accepted_and_people_are_told() {
    let world = World::new(RosVersion::One);
    let robot = Robot::new(&world);
    let rejected = || {
        let text = "too far".to_owned();
        Ok(GoalEnd { outcome: GoalOutcome::Rejected, text, result: number(RosVersion::One, 0) })
    };
    assert!(!world.send(&robot, 1, |events| events.on_ended(rejected())).await);
    assert!(!world.send(&robot, 2, |events| events.on_ended(Err(GoalError::Forgotten))).await);
    let notices = world.notices.0.lock();
    assert!(notices.iter().any(|text| text.contains("too far")), "{notices:?}");
    assert!(notices.iter().any(|text| text.contains("no longer knows the goal")), "{notices:?}");
}

#[tokio::test]
async fn a_cancel_is_answered_by_the_status_or_by_the_end() {
    let world = World::new(RosVersion::One);
    let robot = Robot::new(&world);
    for number in [1, 2] {
        assert!(world.send(&robot, number, |events| events.on_accepted()).await);
    }
    let (answer, ()) = tokio::join!(robot.cancel(1), async {
        world.server.wait_cancelled(&text_id(1)).await;
        // The status lists it as preempting.
        world.events(1).on_cancel_response(true);
    });
    assert_eq!(answer, (1, 0));
    world.events(1).on_ended(goal_end(GoalOutcome::Canceled));
    assert_eq!(robot.result(1).await, (CANCELED, 9));
    let (answer, ()) = tokio::join!(robot.cancel(0), async {
        world.server.wait_cancelled(&text_id(2)).await;
        world.events(2).on_ended(goal_end(GoalOutcome::Succeeded));
    });
    assert_eq!(answer.0, 0, "it ended before");
    assert_eq!(robot.cancel(2).await, (0, 3), "it has ended");
    assert_eq!(robot.cancel(9).await, (0, 2), "there is no such goal");
}

#[tokio::test]
async fn a_newer_goal_preempts_the_older_one_where_the_server_does_so() {
    let world = World::new(RosVersion::One);
    let robot = Robot::new(&world);
    assert!(world.send(&robot, 1, |events| events.on_accepted()).await);
    // A SimpleActionServer lists the newer goal as pending until it has preempted the older one.
    assert!(world.send(&robot, 2, |events| events.on_waiting()).await);
    world.events(1).on_ended(goal_end(GoalOutcome::Canceled));
    world.events(2).on_accepted();
    assert_eq!(robot.result(1).await.0, CANCELED);
    world.events(2).on_ended(goal_end(GoalOutcome::Succeeded));
    assert_eq!(robot.result(2).await.0, SUCCEEDED);
}

#[tokio::test]
async fn the_graph_has_the_services_and_topics() {
    let world = World::new(RosVersion::One);
    let graph = world.wait_for_graph(|graph| graph.actions.contains_key("/count")).await;
    let action = &graph.actions["/count"];
    assert_eq!((&*action.type_name, &*action.servers), ("x_msgs/action/Count", &["/counter".to_owned()][..]));
    assert!(action.topics.is_empty());
    let ends = &graph.ends["/counter"];
    let of_the_action = ends.services.keys().filter(|service| service.starts_with("/count/"));
    assert_eq!(of_the_action.collect::<Vec<_>>(), [CANCEL, RESULT, SEND]);
    assert_eq!(ends.services[SEND], world.bus.service_type(SEND).await.expect("a type"));
    let robot = Robot::new(&world);
    let ours = ServiceType::from_service(&robot.of.services.as_ref().expect("of ROS 2").send_goal);
    assert!(ends.services[SEND].is_compatible_with(&ours));
    assert!(ends.publishers["/count/_action/status"].1.is_latching());
    assert!(!graph.topics.keys().any(|topic| topic.starts_with("/count")), "they are no topics of ROS 2");
    let missing = robot.bus.service_type("/other/_action/send_goal").await.err();
    assert!(matches!(missing, Some(BusError::NoService(_))), "{missing:?}");
}
