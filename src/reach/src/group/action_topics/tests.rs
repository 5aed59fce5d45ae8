use package::interface::Interface;
use ros::bus::{Bus, MessageReceiver, RosVersion};
use serde_json::json;

use super::*;
use crate::group::dispatch::{Load, Rules};

/// Of each robot's budget.
const BYTES: usize = 1 << 20;

/// A group without servants, in which goals wait, and a robot's bus.
fn group() -> (Arc<Group>, Arc<dyn Bus>) {
    let interface: Interface = serde_json::from_value(json!({
        "topics": [],
        "services": [],
        "actions": [{ "name": "/count", "type": "x_msgs/Count" }],
        "definitions": { "x_msgs/action/Count": "string data\n---\nint64 all\n---\nint64 now\n" },
    }))
    .expect("an interface");
    let registry = Registry::from_definitions(&interface.definitions).expect("definitions");
    let rules = Rules {
        window: 1,
        replicas: 1,
        idempotent: false,
    };
    let group = Group::new(RosVersion::One, "noetic", &interface, rules);
    let budget = Budget::new("the robot", BYTES);
    let bus = group.bus(&Arc::new(registry), &budget);
    (group, bus)
}

/// Another robot's.
fn another(group: &Arc<Group>) -> Arc<dyn Bus> {
    let definitions = &group.interface.definitions;
    let registry = Registry::from_definitions(definitions).expect("definitions");
    group.bus(&Arc::new(registry), &Budget::new("another", BYTES))
}

struct Robot {
    goals: Box<dyn Publisher>,
    results: Subscription,
    states: Subscription,
}

impl Robot {
    async fn of(bus: &Arc<dyn Bus>) -> Robot {
        let qos = Qos::keep_last(10 * GOALS);
        let any = WireType::any;
        let goals = bus.advertise("/count/goal", any(), qos).await;
        let results = bus.subscribe("/count/result", any(), qos).await;
        let states = bus.subscribe("/count/status", any(), qos).await;
        Robot {
            goals: goals.expect("a topic"),
            results: results.expect("a topic"),
            states: states.expect("a topic"),
        }
    }

    fn sends(&self, id: &str, bytes: usize) {
        let id = GoalId {
            id: id.to_owned(),
            ..GoalId::default()
        };
        let body = [&(bytes as u32).to_le_bytes()[..], &vec![b'x'; bytes]].concat();
        self.goals
            .publish(messages::write_goal(Time::default(), &id, &body));
    }

    /// Results so far: id, status and text.
    fn results(&mut self) -> Vec<(String, Status, String)> {
        let read = |bytes: &Bytes| messages::read_state(bytes).expect("a result").0;
        let results = all(&mut self.results.messages).into_iter();
        results
            .map(|bytes| read(&bytes))
            .map(|state| (state.goal.id, state.status, state.text))
            .collect()
    }

    /// What the last status says.
    fn status(&mut self) -> Vec<GoalState> {
        let last = all(&mut self.states.messages).pop().expect("a status");
        messages::read_states(&last).expect("a status")
    }
}

fn all(messages: &mut MessageReceiver) -> Vec<Bytes> {
    std::iter::from_fn(|| messages.try_recv())
        .map(|message| message.bytes)
        .collect()
}

fn waiting(group: &Arc<Group>) -> usize {
    let Load { waiting, .. } = group.load();
    waiting
}

#[tokio::test]
async fn a_robot_cannot_have_the_daemon_hold_goals_without_end() {
    let (group, bus) = group();
    let mut robot = Robot::of(&bus).await;
    for number in 0..3 * GOALS {
        robot.sends(&format!("{number}"), 8);
    }
    assert_eq!(waiting(&group), GOALS);
    let results = robot.results();
    assert_eq!(results.len(), 2 * GOALS);
    for (id, status, text) in &results {
        assert_eq!(*status, Status::Rejected, "{id}");
        assert!(text.contains("256 goals of this robot"), "{text}");
    }
    // What is told again and again stays small, too.
    assert_eq!(robot.status().len(), GOALS + ENDED);
    // Another robot is no worse off.
    let mut other = Robot::of(&another(&group)).await;
    other.sends("mine", 8);
    assert_eq!((waiting(&group), other.results()), (GOALS + 1, vec![]));
}

#[tokio::test]
async fn goals_under_way_count_in_their_robots_budget() {
    let (group, bus) = group();
    let mut robot = Robot::of(&bus).await;
    robot.sends("one", BYTES / 2);
    robot.sends("two", BYTES / 2);
    assert_eq!(waiting(&group), 1);
    let results = robot.results();
    assert_eq!(results.len(), 1, "{results:?}");
    let (id, status, text) = &results[0];
    assert_eq!((&**id, *status), ("two", Status::Rejected));
    assert!(text.contains("the robot"), "{text}");
    // What has ended is held no longer.
    let cancel = bus.advertise("/count/cancel", WireType::any(), Qos::keep_last(1));
    let cancel = cancel.await.expect("a topic");
    cancel.publish(messages::write_cancel(&GoalId::default()));
    robot.results.messages.recv().await.expect("it ends");
    robot.sends("three", BYTES / 2);
    assert_eq!((waiting(&group), robot.results()), (1, vec![]));
}

#[tokio::test]
async fn a_goal_with_an_endless_id_is_not_taken() {
    let (group, bus) = group();
    let robot = Robot::of(&bus).await;
    robot.sends(&"i".repeat(LONGEST_ID + 1), 8);
    assert_eq!(waiting(&group), 0);
    robot.sends(&"i".repeat(LONGEST_ID), 8);
    assert_eq!(waiting(&group), 1);
}

#[tokio::test]
async fn robots_with_goals_of_one_name_hear_of_their_own() {
    let (group, bus) = group();
    let mut one = Robot::of(&bus).await;
    let another = another(&group);
    let mut other = Robot::of(&another).await;
    one.sends("same", 8);
    other.sends("same", 8);
    assert_eq!(waiting(&group), 2);
    let cancel = bus.advertise("/count/cancel", WireType::any(), Qos::keep_last(1));
    let same = GoalId {
        id: "same".to_owned(),
        ..GoalId::default()
    };
    let cancel = cancel.await.expect("a topic");
    cancel.publish(messages::write_cancel(&same));
    let ended = one.results.messages.recv().await.expect("it ends");
    let ended = messages::read_state(&ended.bytes).expect("a result").0;
    assert_eq!(ended.status, Status::Preempted);
    assert_eq!((waiting(&group), other.results()), (1, vec![]));
    assert_eq!(other.status()[0].status, Status::Active);
}

#[tokio::test]
async fn goals_of_a_robot_whose_place_ended_keep_no_servant_from_others() {
    let (group, bus) = group();
    let robot = Robot::of(&bus).await;
    robot.sends("endless", 8);
    drop((bus, robot));
    // It hears of that in a task of its own.
    let ended = async {
        while waiting(&group) > 0 {
            tokio::task::yield_now().await;
        }
    };
    let ended = tokio::time::timeout(Duration::from_secs(60), ended).await;
    assert!(ended.is_ok(), "it waits for ever");
}
