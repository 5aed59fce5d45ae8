//! A cloud whose answers the test gives, and a real local original with an action (`examples/relay.rs`).

use bytes::Bytes;
use qos::{Event, HandOver, Outcome, SafeStop, Sla};
use ros::bus::RosVersion;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::*;
use crate::local::keeper::{Answer, Application, Cloud};
use crate::local::tests::{a_relay, robot};
use crate::testing::SOON;

/// A call of the cloud: the part of the action, what it is asked, and where the answer goes.
struct Asked {
    part: String,
    request: Bytes,
    answer: oneshot::Sender<Result<Bytes, Failure>>,
}

struct Told(mpsc::UnboundedSender<Asked>);

impl Cloud for Told {
    fn publish(&self, _: &str, _: &Message) {}
    fn call(&self, _: RequestId, _: &str, _: Bytes) {
        unreachable!("there is nothing but an action");
    }
    fn ask(&self, service: &str, request: Bytes) -> Answer {
        let (answer, answered) = oneshot::channel();
        let part = service.strip_prefix("/count/_action/").unwrap().to_owned();
        let asked = Asked {
            part,
            request,
            answer,
        };
        let _ = self.0.send(asked);
        Box::pin(async move {
            let gone = || Failure::Unreachable("the test has ended".to_owned());
            answered.await.unwrap_or_else(|_| Err(gone()))
        })
    }
}

struct Deaf;

impl Application for Deaf {
    fn deliver(&self, _: &str, _: Message) {}
    fn latched(&self, _: &str, _: Message) {}
    fn safe_stop(&self, _: &SafeStop) {}
    fn decided(&self, _: &Event) {}
    fn handed_over(&self, _: &HandOver) {}
    fn lacks(&self, _: &HandOver) {}
    fn told(&self, _: &Outcome) {}
}

/// A keeper with the link up, and what its cloud is asked.
struct Scene {
    keeper: Arc<Keeper>,
    asked: mpsc::UnboundedReceiver<Asked>,
    action: Arc<str>,
}

impl Scene {
    async fn new(sla: serde_json::Value, robot: Option<&crate::local::tests::Robot>) -> Self {
        let (sender, asked) = mpsc::unbounded_channel();
        let original = match robot {
            Some(robot) => Some(a_relay(robot, &[]).await),
            None => None,
        };
        let sla = Sla::parse(sla).unwrap();
        let cloud = Arc::new(Told(sender));
        let keeper = Keeper::start(sla, vec![], original, cloud, Arc::new(Deaf));
        keeper.link_up(false);
        Self {
            keeper,
            asked,
            action: "/count".into(),
        }
    }

    /// The next call of the cloud, which should be of this part.
    async fn asked(&mut self, part: &str) -> Asked {
        let asked = timeout(SOON, self.asked.recv()).await.unwrap().unwrap();
        assert_eq!(asked.part, part);
        asked
    }

    async fn answers(&mut self, part: &str, answer: Bytes) {
        let asked = self.asked(part).await;
        asked.answer.send(Ok(answer)).unwrap();
    }

    fn sends(&self, request: Bytes) -> Calling {
        let (keeper, action) = (self.keeper.clone(), self.action.clone());
        Calling(tokio::spawn(async move {
            keeper.send_goal(&action, request).await
        }))
    }

    fn wants_result(&self, id: &GoalId) -> Calling {
        let (keeper, action) = (self.keeper.clone(), self.action.clone());
        let request = messages::get_result(id);
        Calling(tokio::spawn(async move {
            keeper.get_result(&action, request).await
        }))
    }

    fn cancels(&self, id: &GoalId) -> Calling {
        let (keeper, action) = (self.keeper.clone(), self.action.clone());
        let request = messages::cancel(id);
        Calling(tokio::spawn(async move {
            keeper.cancel_goal(&action, request).await
        }))
    }
}

/// A call of the application.
struct Calling(tokio::task::JoinHandle<Result<Bytes, String>>);

impl Calling {
    async fn answered(self) -> Bytes {
        timeout(SOON, self.0).await.unwrap().unwrap().unwrap()
    }
}

fn goal(id: &GoalId, number: i32) -> Bytes {
    [&messages::get_result(id)[..], &number.to_le_bytes()]
        .concat()
        .into()
}

fn accepted() -> Bytes {
    messages::answer(true, 1)
}

/// A result with this status.
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
    let sent = scene.sends(goal(&id, 7));
    let asked = scene.asked("send_goal").await;
    assert_eq!(asked.request, goal(&id, 7));
    asked.answer.send(Ok(accepted())).unwrap();
    assert_eq!(sent.answered().await, accepted());
    // A goal of this id is under way.
    let again = scene.sends(goal(&id, 8)).answered().await;
    assert!(!messages::is_accepted(&again));
    let wanted = scene.wants_result(&id);
    assert_eq!(scene.keeper.report().counts.from_cloud, 0);
    scene.answers("get_result", result(SUCCEEDED, 7)).await;
    assert_eq!(wanted.answered().await, result(SUCCEEDED, 7));
    let late = scene.wants_result(&id).answered().await;
    assert_eq!(late, result(SUCCEEDED, 7));
    let counts = scene.keeper.report().counts;
    assert_eq!((counts.requests, counts.from_cloud), (1, 1));
    // One that is not accepted is answered, too.
    let refused = scene.sends(goal(&[2; 16], 7));
    scene.answers("send_goal", messages::answer(false, 1)).await;
    assert!(!messages::is_accepted(&refused.answered().await));
    let counts = scene.keeper.report().counts;
    assert_eq!((counts.requests, counts.from_cloud), (2, 2));
}

#[tokio::test]
async fn a_goal_that_a_new_servant_does_not_know_is_sent_to_it_again() {
    let mut scene = Scene::new(slow(), None).await;
    let id = [1; 16];
    let sent = scene.sends(goal(&id, 7));
    scene.answers("send_goal", accepted()).await;
    sent.answered().await;
    let wanted = scene.wants_result(&id);
    let lost = scene.asked("get_result").await;
    scene.keeper.link_down();
    let forgotten = Failure::Unreachable("the cloud has forgotten this call".to_owned());
    lost.answer.send(Err(forgotten)).unwrap();
    scene.keeper.link_up(false);
    scene.answers("get_result", result(UNKNOWN, 0)).await;
    scene.answers("send_goal", accepted()).await;
    scene.answers("get_result", result(SUCCEEDED, 7)).await;
    assert_eq!(wanted.answered().await, result(SUCCEEDED, 7));
}

#[tokio::test]
async fn what_a_node_says_that_has_forgotten_a_goal_is_told_where_nobody_else_has_it() {
    let mut scene = Scene::new(slow(), None).await;
    let id = [1; 16];
    let sent = scene.sends(goal(&id, 7));
    scene.answers("send_goal", accepted()).await;
    sent.answered().await;
    let wanted = scene.wants_result(&id);
    scene.answers("get_result", result(UNKNOWN, 0)).await;
    assert_eq!(wanted.answered().await, result(UNKNOWN, 0));
    // A goal of before this stub began: the node's own answer.
    let wanted = scene.wants_result(&[9; 16]);
    scene.answers("get_result", result(SUCCEEDED, 3)).await;
    assert_eq!(wanted.answered().await, result(SUCCEEDED, 3));
}

#[tokio::test]
async fn a_goal_that_is_cancelled_ends_wherever_it_was_given() {
    let mut scene = Scene::new(slow(), None).await;
    let (one, two) = ([1; 16], [2; 16]);
    let mut under_way = Vec::new();
    for id in [&one, &two] {
        let sent = scene.sends(goal(id, 7));
        scene.answers("send_goal", accepted()).await;
        sent.answered().await;
        under_way.push(scene.asked("get_result").await);
    }
    let canceled = scene.cancels(&ALL);
    let asked = scene.asked("cancel_goal").await;
    assert_eq!(asked.request, messages::cancel(&ALL));
    let both = messages::canceled(&[one, two]);
    asked.answer.send(Ok(both.clone())).unwrap();
    assert_eq!(canceled.answered().await, both);
}

#[tokio::test]
async fn a_goal_that_the_cloud_is_at_ends_at_the_local_original_when_the_link_is_lost() {
    let robot = robot(RosVersion::Two).await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
    let mut scene = Scene::new(sla, Some(&robot)).await;
    let id = [1; 16];
    let sent = scene.sends(goal(&id, 7));
    scene.answers("send_goal", accepted()).await;
    sent.answered().await;
    let wanted = scene.wants_result(&id);
    let _late = scene.asked("get_result").await;
    scene.keeper.link_down();
    let answer = wanted.answered().await;
    assert_eq!(answer[..], result(SUCCEEDED, 7)[..]);
    assert_eq!(scene.keeper.report().counts.from_local, 1);
    // One that is sent while the link is away.
    let sent = scene.sends(goal(&[2; 16], 8)).answered().await;
    assert!(messages::is_accepted(&sent));
    let answer = scene.wants_result(&[2; 16]).answered().await;
    assert_eq!(answer[..], result(SUCCEEDED, 8)[..]);
}
