use std::task::Poll;

use async_trait::async_trait;
use futures_util::{FutureExt, poll};
use ros_bus::RosVersion;
use ros_message::codec::Time;
use ros_message::schema::Registry;

use super::*;
use crate::actions::GoalId;
use crate::actions::messages::{self, ActionGoalStatus, GoalInfo};

const LONG: Duration = Duration::from_secs(60);
const SEND: (ActionEndpoint, &str) = (ActionEndpoint::SendGoal, "/count/_action/send_goal");
const CANCEL: (ActionEndpoint, &str) = (ActionEndpoint::CancelGoal, "/count/_action/cancel_goal");
const RESULT: (ActionEndpoint, &str) = (ActionEndpoint::GetResult, "/count/_action/get_result");

/// A client that keeps what it was given.
#[derive(Default)]
struct RecordingClient {
    goals: Mutex<HashMap<String, Arc<dyn GoalEvents>>>,
    cancelled: Mutex<Vec<String>>,
}

#[async_trait]
impl ActionClient for RecordingClient {
    async fn wait_for_server(&self, _patience: Duration) -> Result<(), BusError> {
        Ok(())
    }

    fn send_goal(&self, id: &str, _goal: Bytes, events: Arc<dyn GoalEvents>) {
        self.goals.lock().insert(id.to_owned(), events);
    }

    fn cancel_goal(&self, id: &str) {
        self.cancelled.lock().push(id.to_owned());
    }
}

struct World {
    services: Arc<GoalServices<RecordingClient>>,
    of: Arc<ActionDef>,
    notices: Arc<Mutex<Vec<String>>>,
}

fn id(number: u8) -> GoalId {
    GoalId([number; 16])
}

impl World {
    fn new() -> World {
        World::with_budget(&Budget::without_limit())
    }

    fn with_budget(budget: &Budget) -> World {
        let definitions = Registry::for_version(RosVersion::Two);
        let text = "int32 order\n---\nint32 sum\n---\nint32 part\n";
        definitions.insert("x_msgs/action/Count", text).expect("a definition");
        let of = definitions.action("x_msgs/Count").expect("an action");
        let notices: Arc<Mutex<Vec<String>>> = Arc::default();
        let told = Arc::clone(&notices);
        let notices_to: GoalNotices = Arc::new(move |text| told.lock().push(text));
        let names = ("/count", "/counter");
        let services = GoalServices::new(names, &of, RecordingClient::default(), budget, notices_to);
        World { services: services.expect("services"), of, notices }
    }

    async fn call(&self, service: (ActionEndpoint, &str), request: Bytes) -> Result<Bytes, BusError> {
        self.services.call(service, &Digest::any(), request, LONG).await
    }

    async fn send(&self, number: u8) -> Result<bool, BusError> {
        let goal = [0, 1, 0, 0, 7, 0, 0, 0];
        let request = messages::write_with_id(id(number), &self.of.goal, &goal).expect("a goal");
        let answer = self.call(SEND, request).await?;
        Ok(messages::read_accepted(&answer).expect("an answer"))
    }

    /// Sends a goal that is accepted at once.
    async fn send_accepted(&self, number: u8) -> Arc<dyn GoalEvents> {
        let mut sending = std::pin::pin!(self.send(number));
        assert!(poll!(&mut sending).is_pending(), "its server decides");
        let events = self.events(number);
        events.on_accepted();
        assert!(sending.await.expect("an answer"));
        events
    }

    fn events(&self, number: u8) -> Arc<dyn GoalEvents> {
        let goals = self.services.client().goals.lock();
        Arc::clone(&goals[&id(number).to_string()])
    }

    /// Cancels a goal, or all; returns whether goal 1 is among those that end, or else the code.
    async fn cancel(&self, which: GoalId) -> Result<(), u8> {
        let request = messages::write_cancel(GoalInfo { id: which, stamp: Time::default() });
        let answer = self.call(CANCEL, request).await.expect("an answer");
        messages::read_cancelled(&answer, id(1)).expect("an answer")
    }

    async fn result(&self, number: u8) -> ActionGoalStatus {
        let answer = self.call(RESULT, messages::write_id(id(number))).await.expect("an answer");
        messages::read_result(&self.of.result, &answer).expect("a result").0.expect("a status")
    }

    fn subscribe(&self, end: ActionEndpoint) -> Subscription {
        let qos = QosProfile::keep_last(10).latching(true);
        self.services.subscribe(end, &WireType::any(), qos).expect("a topic")
    }
}

fn end(outcome: GoalOutcome) -> Result<GoalEnd, GoalError> {
    Ok(GoalEnd { outcome, text: String::new(), result: Bytes::from_static(&[0, 1, 0, 0, 9, 0, 0, 0]) })
}

#[tokio::test]
async fn ends_of_goals_become_statuses() {
    for (outcome, expected) in [
        (GoalOutcome::Succeeded, ActionGoalStatus::Succeeded),
        (GoalOutcome::Canceled, ActionGoalStatus::Canceled),
        (GoalOutcome::Aborted, ActionGoalStatus::Aborted),
        // It was accepted.
        (GoalOutcome::Rejected, ActionGoalStatus::Aborted),
        (GoalOutcome::Unknown, ActionGoalStatus::Aborted),
    ] {
        let world = World::new();
        world.send_accepted(1).await.on_ended(end(outcome));
        assert_eq!(world.result(1).await, expected, "{outcome:?}");
        assert!(!world.services.has_goals());
    }
}

#[tokio::test]
async fn a_goal_that_is_rejected_has_no_status() {
    let world = World::new();
    let mut sending = std::pin::pin!(world.send(1));
    assert!(poll!(&mut sending).is_pending());
    world.events(1).on_ended(end(GoalOutcome::Rejected));
    assert!(!sending.await.expect("an answer"));
    assert_eq!(world.result(1).await, ActionGoalStatus::Unknown);
}

#[tokio::test]
async fn a_goal_whose_server_is_lost_fails_or_is_aborted_and_people_are_told() {
    let world = World::new();
    let gone = || Err(GoalError::ServerGone("/count".to_owned()));
    let mut sending = std::pin::pin!(world.send(1));
    assert!(poll!(&mut sending).is_pending());
    world.events(1).on_ended(gone());
    let lost = sending.await;
    assert!(matches!(lost, Err(BusError::CallFailed { .. })), "{lost:?}");
    world.send_accepted(2).await.on_ended(gone());
    assert_eq!(world.result(2).await, ActionGoalStatus::Aborted);
    let notices = world.notices.lock();
    assert_eq!(notices.len(), 2);
    assert!(notices.iter().all(|text| text.contains("action server /count is gone")), "{notices:?}");
}

#[tokio::test]
async fn a_goal_that_waits_is_accepted_before_it_is_executed() {
    let world = World::new();
    let mut sending = std::pin::pin!(world.send(1));
    assert!(poll!(&mut sending).is_pending());
    let events = world.events(1);
    events.on_waiting();
    assert!(sending.await.expect("an answer"));
    // A server that turns it down now can only abort it.
    events.on_ended(end(GoalOutcome::Rejected));
    assert_eq!(world.result(1).await, ActionGoalStatus::Aborted);
    assert!(world.notices.lock()[0].contains("did not accept it"));
}

#[tokio::test]
async fn a_goal_is_accepted_before_its_feedback_and_its_result() {
    let world = World::new();
    let mut feedback = world.subscribe(ActionEndpoint::Feedback);
    let mut sending = std::pin::pin!(world.send(1));
    assert!(poll!(&mut sending).is_pending());
    world.events(1).on_feedback(Bytes::from_static(&[0, 1, 0, 0, 3, 0, 0, 0]));
    let Poll::Ready(Ok(true)) = poll!(&mut sending) else {
        panic!("only a goal that is executed has feedback");
    };
    assert_eq!(messages::read_id(&feedback.messages.try_recv().expect("feedback").bytes), Some(id(1)));

    let mut sending = std::pin::pin!(world.send(2));
    assert!(poll!(&mut sending).is_pending());
    world.events(2).on_ended(end(GoalOutcome::Succeeded));
    assert!(sending.await.expect("an answer"), "the result came before any status");
    assert_eq!(world.result(2).await, ActionGoalStatus::Succeeded);
}

#[tokio::test]
async fn a_cancel_is_answered_as_the_server_answers_it() {
    let world = World::new();
    // The sender does not know the goal before it is accepted.
    let mut sending = std::pin::pin!(world.send(1));
    assert!(poll!(&mut sending).is_pending());
    assert_eq!(world.cancel(id(1)).await, Err(2), "unknown");
    world.events(1).on_accepted();
    assert!(sending.await.expect("an answer"));
    for (answer, expected) in [(false, Err(1)), (true, Ok(()))] {
        let mut canceling = std::pin::pin!(world.cancel(id(1)));
        assert!(poll!(&mut canceling).is_pending());
        world.events(1).on_cancel_response(answer);
        assert_eq!(canceling.await, expected);
    }
    assert_eq!(world.services.client().cancelled.lock().len(), 2);
    assert_eq!(world.cancel(id(1)).await, Ok(()), "it is being cancelled");
    world.events(1).on_ended(end(GoalOutcome::Canceled));
    assert_eq!(world.result(1).await, ActionGoalStatus::Canceled);
    assert_eq!(world.cancel(id(1)).await, Err(3), "it has ended");
}

#[tokio::test]
async fn cancels_that_nobody_answers_take_no_more_memory_each_time() {
    let world = World::new();
    world.send_accepted(1).await;
    for _ in 0..100 {
        let mut canceling = Box::pin(world.cancel(id(1)));
        assert!(poll!(&mut canceling).is_pending());
    }
    let waiting = world.services.canceling.lock().values().map(Vec::len).sum::<usize>();
    assert!(waiting <= 1, "{waiting} wait, of whom none is left");
}

#[tokio::test]
async fn a_goal_that_ends_instead_answers_its_cancel() {
    for (outcome, expected) in [(GoalOutcome::Succeeded, Err(1)), (GoalOutcome::Canceled, Ok(()))] {
        let world = World::new();
        let (one, two) = (world.send_accepted(1).await, world.send_accepted(2).await);
        let mut canceling = std::pin::pin!(world.cancel(GoalId::NONE));
        assert!(poll!(&mut canceling).is_pending());
        one.on_ended(end(outcome));
        assert!(poll!(&mut canceling).is_pending(), "the other has not answered");
        two.on_cancel_response(false);
        assert_eq!(canceling.await, expected, "{outcome:?}");
        assert!(world.result(1).now_or_never().is_some());
        assert!(world.services.has_goals(), "the other goes on");
    }
}

#[tokio::test]
async fn goals_under_way_are_charged_until_they_end() {
    let budget = Budget::new("the robot", 12);
    let world = World::with_budget(&budget);
    let events = world.send_accepted(1).await;
    assert!(!world.send(2).await.expect("an answer"));
    assert!(world.notices.lock()[0].contains("the robot"));
    assert!(!world.services.client().goals.lock().contains_key(&id(2).to_string()));
    events.on_ended(end(GoalOutcome::Aborted));
    // Its result is kept for late requests, unless there is no room left for another.
    assert_eq!(world.result(1).await, ActionGoalStatus::Aborted);
}

#[tokio::test]
async fn late_subscribers_get_the_last_status() {
    let world = World::new();
    world.send_accepted(1).await;
    let mut status = world.subscribe(ActionEndpoint::Status);
    let last = status.messages.try_recv().expect("a status");
    assert!(last.latching);
    assert_eq!(last.bytes.last(), Some(&(ActionGoalStatus::Executing as u8)));
}
