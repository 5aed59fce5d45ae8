//! Tests with a cloud whose answers the test gives, and a real local original with an action (`examples/relay.rs`).

use bytes::Bytes;
use qos::{HandOver, QosEvent, QosSla, RequestOutcome, SafeStop};
use ros::bus::RosVersion;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::*;
use crate::local::keeper::{Application, Cloud, PendingAnswer};
use crate::local::tests::{new_relay, robot};
use crate::testing::SOON;

/// A call to the cloud: the part of the action, the request, and the sender of the answer.
struct CloudCall {
    part: String,
    request: Bytes,
    answer: oneshot::Sender<Result<Bytes, Failure>>,
}

struct RecordingCloud(mpsc::UnboundedSender<CloudCall>);

impl Cloud for RecordingCloud {
    fn publish(&self, _: &str, _: &SerializedMessage) {}
    fn call(&self, _: RequestId, _: &str, _: Bytes) {
        unreachable!("there is nothing but an action");
    }
    fn call_unmeasured(&self, service: &str, request: Bytes) -> PendingAnswer {
        let (answer, answered) = oneshot::channel();
        let part = service.strip_prefix("/count/_action/").unwrap().to_owned();
        let asked = CloudCall { part, request, answer };
        let _ = self.0.send(asked);
        Box::pin(async move {
            let gone = || Failure::Unreachable("the test has ended".to_owned());
            answered.await.unwrap_or_else(|_| Err(gone()))
        })
    }
}

struct IgnoringApplication;

impl Application for IgnoringApplication {
    fn deliver(&self, _: &str, _: SerializedMessage) {}
    fn on_latched_output(&self, _: &str, _: SerializedMessage) {}
    fn safe_stop(&self, _: &SafeStop) {}
    fn on_decision(&self, _: &QosEvent) {}
    fn on_hand_over(&self, _: &HandOver) {}
    fn on_missed_requests(&self, _: &HandOver) {}
    fn on_outcome(&self, _: &RequestOutcome) {}
}

/// A keeper with the link up, and the calls to its cloud.
struct Scene {
    keeper: Arc<Keeper>,
    asked: mpsc::UnboundedReceiver<CloudCall>,
    action: Arc<str>,
}

impl Scene {
    async fn new(sla: serde_json::Value, robot: Option<&crate::local::tests::TestRobot>) -> Self {
        let (sender, asked) = mpsc::unbounded_channel();
        let original = match robot {
            Some(robot) => Some(new_relay(robot, &[]).await),
            None => None,
        };
        let sla = QosSla::parse(sla).unwrap();
        let cloud = Arc::new(RecordingCloud(sender));
        let keeper = Keeper::start(sla, vec![], original, cloud, Arc::new(IgnoringApplication));
        keeper.link_up(false);
        Self { keeper, asked, action: "/count".into() }
    }

    /// Returns the next call to the cloud, which must be of this part.
    async fn next_call(&mut self, part: &str) -> CloudCall {
        let asked = timeout(SOON, self.asked.recv()).await.unwrap().unwrap();
        assert_eq!(asked.part, part);
        asked
    }

    async fn answer_next(&mut self, part: &str, answer: Bytes) {
        let asked = self.next_call(part).await;
        asked.answer.send(Ok(answer)).unwrap();
    }

    fn send_goal(&self, request: Bytes) -> ApplicationCall {
        let (keeper, action) = (self.keeper.clone(), self.action.clone());
        ApplicationCall(tokio::spawn(async move { keeper.send_goal(&action, request).await }))
    }

    fn request_result(&self, id: &GoalId) -> ApplicationCall {
        let (keeper, action) = (self.keeper.clone(), self.action.clone());
        let request = messages::result_request(id);
        ApplicationCall(tokio::spawn(async move { keeper.get_result(&action, request).await }))
    }

    fn cancel_goal(&self, id: &GoalId) -> ApplicationCall {
        let (keeper, action) = (self.keeper.clone(), self.action.clone());
        let request = messages::cancel_request(id);
        ApplicationCall(tokio::spawn(async move { keeper.cancel_goal(&action, request).await }))
    }
}

/// A call of the application.
struct ApplicationCall(tokio::task::JoinHandle<Result<Bytes, FailureReason>>);

impl ApplicationCall {
    async fn answer(self) -> Bytes {
        timeout(SOON, self.0).await.unwrap().unwrap().unwrap()
    }
}

fn goal(id: &GoalId, number: i32) -> Bytes {
    [&messages::result_request(id)[..], &number.to_le_bytes()].concat().into()
}

fn acceptance() -> Bytes {
    messages::goal_response(true, 1)
}

/// Encodes a result with this status.
fn result(status: u8, number: i32) -> Bytes {
    let status = [0, 1, 0, 0, status, 0, 0, 0];
    [&status[..], &number.to_le_bytes()].concat().into()
}

const SUCCEEDED: u8 = 4;
const UNKNOWN: u8 = 0;

fn slow() -> serde_json::Value {
    serde_json::json!({"t_desire": 100, "t_max": 200, "local": "none"})
}

#[tokio::test]
async fn a_goal_is_one_request_from_when_it_is_sent_to_its_result() {
    let mut scene = Scene::new(slow(), None).await;
    let id = [1; 16];
    let sent = scene.send_goal(goal(&id, 7));
    let asked = scene.next_call("send_goal").await;
    assert_eq!(asked.request, goal(&id, 7));
    asked.answer.send(Ok(acceptance())).unwrap();
    assert_eq!(sent.answer().await, acceptance());
    // A goal with this id is already in progress.
    let again = scene.send_goal(goal(&id, 8)).answer().await;
    assert!(!messages::is_accepted(&again));
    let wanted = scene.request_result(&id);
    assert_eq!(scene.keeper.report().counts.from_cloud, 0);
    scene.answer_next("get_result", result(SUCCEEDED, 7)).await;
    assert_eq!(wanted.answer().await, result(SUCCEEDED, 7));
    let late = scene.request_result(&id).answer().await;
    assert_eq!(late, result(SUCCEEDED, 7));
    let counts = scene.keeper.report().counts;
    assert_eq!((counts.requests, counts.from_cloud), (1, 1));
    // A refused goal is answered, too.
    let refused = scene.send_goal(goal(&[2; 16], 7));
    scene.answer_next("send_goal", messages::goal_response(false, 1)).await;
    assert!(!messages::is_accepted(&refused.answer().await));
    let counts = scene.keeper.report().counts;
    assert_eq!((counts.requests, counts.from_cloud), (2, 2));
}

#[tokio::test]
async fn a_goal_that_a_new_servant_does_not_know_is_sent_to_it_again() {
    let mut scene = Scene::new(slow(), None).await;
    let id = [1; 16];
    let sent = scene.send_goal(goal(&id, 7));
    scene.answer_next("send_goal", acceptance()).await;
    sent.answer().await;
    let wanted = scene.request_result(&id);
    let lost = scene.next_call("get_result").await;
    scene.keeper.link_down();
    let forgotten = Failure::Unreachable("this call was lost".to_owned());
    lost.answer.send(Err(forgotten)).unwrap();
    scene.keeper.link_up(false);
    scene.answer_next("get_result", result(UNKNOWN, 0)).await;
    scene.answer_next("send_goal", acceptance()).await;
    scene.answer_next("get_result", result(SUCCEEDED, 7)).await;
    assert_eq!(wanted.answer().await, result(SUCCEEDED, 7));
}

#[tokio::test]
async fn what_a_node_says_that_has_forgotten_a_goal_is_told_where_nobody_else_has_it() {
    let mut scene = Scene::new(slow(), None).await;
    let id = [1; 16];
    let sent = scene.send_goal(goal(&id, 7));
    scene.answer_next("send_goal", acceptance()).await;
    sent.answer().await;
    let wanted = scene.request_result(&id);
    scene.answer_next("get_result", result(UNKNOWN, 0)).await;
    assert_eq!(wanted.answer().await, result(UNKNOWN, 0));
    // A goal from before this stub started gets the node's own answer.
    let wanted = scene.request_result(&[9; 16]);
    scene.answer_next("get_result", result(SUCCEEDED, 3)).await;
    assert_eq!(wanted.answer().await, result(SUCCEEDED, 3));
}

#[tokio::test]
async fn a_goal_that_is_cancelled_ends_wherever_it_was_given() {
    let mut scene = Scene::new(slow(), None).await;
    let (one, two) = ([1; 16], [2; 16]);
    let mut under_way = Vec::new();
    for id in [&one, &two] {
        let sent = scene.send_goal(goal(id, 7));
        scene.answer_next("send_goal", acceptance()).await;
        sent.answer().await;
        under_way.push(scene.next_call("get_result").await);
    }
    let canceled = scene.cancel_goal(&ALL);
    let asked = scene.next_call("cancel_goal").await;
    assert_eq!(asked.request, messages::cancel_request(&ALL));
    let both = messages::cancel_response(&[one, two]);
    asked.answer.send(Ok(both.clone())).unwrap();
    assert_eq!(canceled.answer().await, both);
}

#[tokio::test]
async fn a_goal_that_the_cloud_is_at_ends_at_the_local_original_when_the_link_is_lost() {
    let robot = robot(RosVersion::Two).await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
    let mut scene = Scene::new(sla, Some(&robot)).await;
    let id = [1; 16];
    let sent = scene.send_goal(goal(&id, 7));
    scene.answer_next("send_goal", acceptance()).await;
    sent.answer().await;
    let wanted = scene.request_result(&id);
    let _late = scene.next_call("get_result").await;
    scene.keeper.link_down();
    let answer = wanted.answer().await;
    assert_eq!(answer[..], result(SUCCEEDED, 7)[..]);
    assert_eq!(scene.keeper.report().counts.from_local, 1);
    // A goal that is sent while the link is down.
    let sent = scene.send_goal(goal(&[2; 16], 8)).answer().await;
    assert!(messages::is_accepted(&sent));
    let answer = scene.request_result(&[2; 16]).answer().await;
    assert_eq!(answer[..], result(SUCCEEDED, 8)[..]);
}
