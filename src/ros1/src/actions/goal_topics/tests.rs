use std::collections::HashMap;
use std::time::Duration;

use async_trait::async_trait;
use ros_bus::MessageReceiver;
use ros_message::codec::Time;
use ros_message::schema::Registry;

use super::*;
use crate::actions::messages::{self, ActionlibStatus, GoalId};

/// A goal as it was given to the client.
type SentGoal = (Bytes, Arc<dyn GoalEvents>);

/// A client that keeps what it was given.
#[derive(Default)]
struct RecordingClient {
    goals: Mutex<HashMap<String, SentGoal>>,
    cancelled: Mutex<Vec<String>>,
}

#[async_trait]
impl ActionClient for RecordingClient {
    async fn wait_for_server(&self, _patience: Duration) -> Result<(), BusError> {
        Ok(())
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        self.goals.lock().insert(id.to_owned(), (goal, events));
    }

    fn cancel_goal(&self, id: &str) {
        self.cancelled.lock().push(id.to_owned());
    }
}

struct World {
    topics: Arc<GoalTopics<RecordingClient>>,
    goal: Box<dyn Publisher>,
    cancel: Box<dyn Publisher>,
    status: Subscription,
    feedback: Subscription,
    result: Subscription,
}

impl World {
    fn new() -> World {
        let definitions = Registry::new();
        definitions.insert("x/action/Do", "int32 order\n---\nint32 sum\n---\nint32 part\n").expect("a definition");
        let of = definitions.action("x/Do").expect("an action");
        let budget = Budget::without_limit();
        let topics = GoalTopics::new(("/do", "/server"), &of, RecordingClient::default(), &budget);
        let topics = topics.expect("topics");
        let qos = QosProfile::keep_last(100);
        let subscribe = |end| topics.subscribe(end, &WireType::any(), qos).expect("a topic");
        let advertise = |end| topics.advertise(end, &WireType::any()).expect("a topic");
        World {
            goal: advertise(ActionEndpoint::Goal),
            cancel: advertise(ActionEndpoint::Cancel),
            status: subscribe(ActionEndpoint::Status),
            feedback: subscribe(ActionEndpoint::Feedback),
            result: subscribe(ActionEndpoint::Result),
            topics,
        }
    }

    fn send(&self, id: &str) -> Arc<dyn GoalEvents> {
        let goal = GoalId { id: id.to_owned(), ..GoalId::default() };
        self.goal.publish(messages::write_goal(Time::default(), &goal, &7i32.to_le_bytes()));
        let goals = self.topics.client().goals.lock();
        let (body, events) = goals.get(id).expect("it was sent");
        assert_eq!(body[..], 7i32.to_le_bytes());
        Arc::clone(events)
    }

    fn cancel_goal(&self, id: &str) -> Vec<String> {
        self.cancel.publish(messages::write_cancel(&GoalId { id: id.to_owned(), ..GoalId::default() }));
        std::mem::take(&mut *self.topics.client().cancelled.lock())
    }

    /// Returns the status published last.
    fn status(&mut self, id: &str) -> Option<ActionlibStatus> {
        let last = drain(&mut self.status.messages).pop().expect("a status");
        let states = messages::read_states(&last).expect("a status").into_iter();
        states.map(|state| (state.goal.id, state.status)).find(|(of, _)| of == id).map(|(_, status)| status)
    }

    /// Returns the results so far.
    fn results(&mut self) -> Vec<(String, ActionlibStatus, String)> {
        let results = drain(&mut self.result.messages).into_iter();
        let states = results.map(|bytes| messages::read_state(&bytes).expect("a result").0);
        states.map(|state| (state.goal.id, state.status, state.text)).collect()
    }
}

fn drain(messages: &mut MessageReceiver) -> Vec<Bytes> {
    std::iter::from_fn(|| messages.try_recv()).map(|message| message.bytes).collect()
}

fn end(outcome: GoalOutcome) -> Result<GoalEnd, GoalError> {
    Ok(GoalEnd { outcome, text: "why".to_owned(), result: Bytes::from_static(&[1, 0, 0, 0]) })
}

#[tokio::test]
async fn a_goal_is_pending_until_its_server_accepts_it() {
    let mut world = World::new();
    let events = world.send("one");
    assert_eq!(world.status("one"), Some(ActionlibStatus::Pending));
    events.on_waiting();
    events.on_accepted();
    assert_eq!(world.status("one"), Some(ActionlibStatus::Active));
    events.on_feedback(Bytes::from_static(&[5, 0, 0, 0]));
    let heard = drain(&mut world.feedback.messages);
    let (state, body) = messages::read_state(&heard[0]).expect("feedback");
    assert_eq!((state.goal.id.as_str(), state.status, &body[..]), ("one", ActionlibStatus::Active, &[5, 0, 0, 0][..]));
    events.on_ended(end(GoalOutcome::Succeeded));
    assert_eq!(world.results(), [("one".to_owned(), ActionlibStatus::Succeeded, "why".to_owned())]);
    assert_eq!(world.status("one"), Some(ActionlibStatus::Succeeded));
}

#[tokio::test]
async fn goals_of_several_clients_go_on_beside_each_other() {
    let mut world = World::new();
    let (one, two) = (world.send("one"), world.send("two"));
    one.on_accepted();
    two.on_accepted();
    // The server itself preempts the older one.
    one.on_ended(end(GoalOutcome::Canceled));
    assert_eq!(world.results(), [("one".to_owned(), ActionlibStatus::Preempted, "why".to_owned())]);
    two.on_feedback(Bytes::from_static(&[0; 4]));
    assert_eq!(drain(&mut world.feedback.messages).len(), 1);
    assert_eq!(world.status("two"), Some(ActionlibStatus::Active));
    assert_eq!(world.cancel_goal("one"), Vec::<String>::new(), "it has ended");
    assert_eq!(world.cancel_goal(""), ["two"]);
    assert_eq!(world.cancel_goal("two"), Vec::<String>::new(), "it is being cancelled");
    assert_eq!(world.status("two"), Some(ActionlibStatus::Preempting));
    // The server refuses, which clients of actionlib do not know: the goal goes on to its end.
    two.on_cancel_response(false);
    two.on_ended(end(GoalOutcome::Succeeded));
    assert_eq!(world.results(), [("two".to_owned(), ActionlibStatus::Succeeded, "why".to_owned())]);
}

#[tokio::test]
async fn a_goal_that_is_cancelled_before_it_is_accepted_is_recalled_or_preempted() {
    let mut world = World::new();
    let (one, two) = (world.send("one"), world.send("two"));
    let mut cancelled = world.cancel_goal("");
    cancelled.sort();
    assert_eq!(cancelled, ["one", "two"]);
    assert_eq!(world.status("one"), Some(ActionlibStatus::Recalling));
    one.on_ended(end(GoalOutcome::Canceled));
    two.on_accepted();
    assert_eq!(world.status("two"), Some(ActionlibStatus::Preempting));
    two.on_ended(end(GoalOutcome::Canceled));
    let statuses: Vec<_> = world.results().into_iter().map(|(id, status, _)| (id, status)).collect();
    let expected = [("one", ActionlibStatus::Recalled), ("two", ActionlibStatus::Preempted)];
    assert_eq!(statuses, expected.map(|(id, status)| (id.to_owned(), status)));
}

#[tokio::test]
async fn a_goal_whose_server_is_lost_is_aborted_with_the_reason() {
    let mut world = World::new();
    let events = world.send("one");
    events.on_ended(Err(GoalError::ServerGone("/do".to_owned())));
    let text = "action server /do is gone".to_owned();
    assert_eq!(world.results(), [("one".to_owned(), ActionlibStatus::Aborted, text)]);
    events.on_feedback(Bytes::from_static(&[0; 4]));
    assert_eq!(drain(&mut world.feedback.messages).len(), 0, "nothing follows its end");
}

#[tokio::test(start_paused = true)]
async fn the_status_is_published_while_somebody_subscribes() {
    let World { topics, mut status, .. } = World::new();
    drain(&mut status.messages);
    tokio::time::sleep(Duration::from_secs(1)).await;
    let count = drain(&mut status.messages).len();
    assert!((4..=5).contains(&count), "{count} in a second");
    drop(status);
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert!(!topics.goals.topics().state.lock().ticking);
    let qos = QosProfile::keep_last(1);
    let mut again = topics.subscribe(ActionEndpoint::Status, &WireType::any(), qos).expect("a topic");
    assert_eq!(drain(&mut again.messages).len(), 1);
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(drain(&mut again.messages).len(), 1);
}

#[tokio::test]
async fn other_types_and_parts_are_refused() {
    let World { topics, .. } = World::new();
    let other = WireType::new("x/Other", "0123456789abcdef0123456789abcdef", "");
    let refused = topics.advertise(ActionEndpoint::Goal, &other).err();
    assert!(matches!(refused, Some(BusError::TypeMismatch { .. })), "{refused:?}");
    let refused = topics.subscribe(ActionEndpoint::SendGoal, &WireType::any(), QosProfile::keep_last(1)).err();
    assert!(matches!(refused, Some(BusError::NoTopic(_))), "{refused:?}");
    assert!(topics.wire_type(ActionEndpoint::Cancel).is_some_and(|of| of.name == "actionlib_msgs/GoalID"));
}
