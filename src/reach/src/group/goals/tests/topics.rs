use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use bytes::Bytes;
use package::interface::Interface;
use ros::bus::{Bus, MessageReceiver, Publisher, QosProfile, RosVersion, Subscription, WireType};
use ros::codec::Time;
use ros::ros1::actions::goal_topics::MAX_GOALS;
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId, GoalState};
use ros::schema::Registry;
use serde_json::json;
use tokio::time::timeout;

use crate::group::ServantGroup;
use crate::group::dispatch::{GroupLoad, Rules};

/// Budget of each robot.
const BYTES: usize = 1 << 20;

/// Creates a group without servants, in which goals wait, and the bus of a robot.
fn group() -> (Arc<ServantGroup>, Arc<dyn Bus>) {
    let interface: Interface = serde_json::from_value(json!({
        "topics": [],
        "services": [],
        "actions": [{ "name": "/count", "type": "x_msgs/Count" }],
        "definitions": { "x_msgs/action/Count": "string data\n---\nint64 all\n---\nint64 now\n" },
    }))
    .expect("an interface");
    let registry = Registry::from_definitions(&interface.definitions).expect("definitions");
    let rules = Rules { window: 1, replicas: 1, idempotent: false };
    let group = ServantGroup::new(RosVersion::One, "noetic", &interface, rules);
    let budget = Budget::new("the robot", BYTES);
    let bus = group.create_bus(&Arc::new(registry), &budget);
    (group, bus)
}

/// Creates the bus of another robot.
fn another_robot_bus(group: &Arc<ServantGroup>) -> Arc<dyn Bus> {
    let definitions = &group.interface.definitions;
    let registry = Registry::from_definitions(definitions).expect("definitions");
    group.create_bus(&Arc::new(registry), &Budget::new("another", BYTES))
}

struct Robot {
    goals: Box<dyn Publisher>,
    results: Subscription,
    states: Subscription,
}

impl Robot {
    async fn new(bus: &Arc<dyn Bus>) -> Robot {
        let qos = QosProfile::keep_last(10 * MAX_GOALS);
        let any = WireType::any;
        let goals = bus.advertise("/count/goal", any(), qos).await;
        let results = bus.subscribe("/count/result", any(), qos).await;
        let states = bus.subscribe("/count/status", any(), qos).await;
        Robot { goals: goals.expect("a topic"), results: results.expect("a topic"), states: states.expect("a topic") }
    }

    fn send_goal(&self, id: &str, bytes: usize) {
        let id = GoalId { id: id.to_owned(), ..GoalId::default() };
        let body = [&(bytes as u32).to_le_bytes()[..], &vec![b'x'; bytes]].concat();
        self.goals.publish(messages::write_goal(Time::default(), &id, &body));
    }

    /// Returns the results so far: id, status and text.
    fn results(&mut self) -> Vec<(String, ActionlibStatus, String)> {
        let read = |bytes: &Bytes| messages::read_state(bytes).expect("a result").0;
        let results = drain(&mut self.results.messages).into_iter();
        results.map(|bytes| read(&bytes)).map(|state| (state.goal.id, state.status, state.text)).collect()
    }

    /// Returns the last status.
    fn status(&mut self) -> Vec<GoalState> {
        let last = drain(&mut self.states.messages).pop().expect("a status");
        messages::read_states(&last).expect("a status")
    }
}

fn drain(messages: &mut MessageReceiver) -> Vec<Bytes> {
    std::iter::from_fn(|| messages.try_recv()).map(|message| message.bytes).collect()
}

fn waiting(group: &Arc<ServantGroup>) -> usize {
    let GroupLoad { waiting, .. } = group.load();
    waiting
}

#[tokio::test]
async fn a_robot_cannot_have_the_daemon_hold_goals_without_end() {
    let (group, bus) = group();
    let mut robot = Robot::new(&bus).await;
    for number in 0..3 * MAX_GOALS {
        robot.send_goal(&format!("{number}"), 8);
    }
    assert_eq!(waiting(&group), MAX_GOALS);
    let results = robot.results();
    assert_eq!(results.len(), 2 * MAX_GOALS);
    for (id, status, text) in &results {
        assert_eq!(*status, ActionlibStatus::Rejected, "{id}");
        assert!(text.contains("256 goals of this robot"), "{text}");
    }
    // The periodic status names them all, and stays small as well.
    let mut states = robot.status();
    while states.len() < 2 * MAX_GOALS {
        let next = timeout(Duration::from_secs(30), robot.states.messages.recv()).await.expect("in time");
        states = messages::read_states(&next.expect("a status").bytes).expect("a status");
    }
    assert_eq!(states.len(), 2 * MAX_GOALS);
    // Other robots are not affected.
    let mut other = Robot::new(&another_robot_bus(&group)).await;
    other.send_goal("mine", 8);
    assert_eq!((waiting(&group), other.results()), (MAX_GOALS + 1, vec![]));
}

#[tokio::test]
async fn goals_under_way_count_in_their_robots_budget() {
    let (group, bus) = group();
    let mut robot = Robot::new(&bus).await;
    robot.send_goal("one", BYTES / 2);
    robot.send_goal("two", BYTES / 2);
    assert_eq!(waiting(&group), 1);
    let results = robot.results();
    assert_eq!(results.len(), 1, "{results:?}");
    let (id, status, text) = &results[0];
    assert_eq!((&**id, *status), ("two", ActionlibStatus::Rejected));
    assert!(text.contains("the robot"), "{text}");
    // Ended goals release their memory.
    let cancel = bus.advertise("/count/cancel", WireType::any(), QosProfile::keep_last(1));
    let cancel = cancel.await.expect("a topic");
    cancel.publish(messages::write_cancel(&GoalId::default()));
    robot.results.messages.recv().await.expect("it ends");
    robot.send_goal("three", BYTES / 2);
    assert_eq!((waiting(&group), robot.results()), (1, vec![]));
}

#[tokio::test]
async fn robots_with_goals_of_one_name_hear_of_their_own() {
    let (group, bus) = group();
    let mut one = Robot::new(&bus).await;
    let another = another_robot_bus(&group);
    let mut other = Robot::new(&another).await;
    one.send_goal("same", 8);
    other.send_goal("same", 8);
    assert_eq!(waiting(&group), 2);
    let cancel = bus.advertise("/count/cancel", WireType::any(), QosProfile::keep_last(1));
    let same = GoalId { id: "same".to_owned(), ..GoalId::default() };
    let cancel = cancel.await.expect("a topic");
    cancel.publish(messages::write_cancel(&same));
    let ended = one.results.messages.recv().await.expect("it ends");
    let ended = messages::read_state(&ended.bytes).expect("a result").0;
    assert_eq!(ended.status, ActionlibStatus::Recalled, "no node had it");
    assert_eq!((waiting(&group), other.results()), (1, vec![]));
    assert_eq!(other.status()[0].status, ActionlibStatus::Pending);
}

#[tokio::test]
async fn goals_of_a_robot_whose_place_ended_keep_no_servant_from_others() {
    let (group, bus) = group();
    let robot = Robot::new(&bus).await;
    robot.send_goal("endless", 8);
    drop((bus, robot));
    // It is told in a task of its own.
    let ended = async {
        while waiting(&group) > 0 {
            tokio::task::yield_now().await;
        }
    };
    let ended = timeout(Duration::from_secs(60), ended).await;
    assert!(ended.is_ok(), "it waits for ever");
}
