mod goals;
mod messages;

use std::sync::Arc;

use bytes::Bytes;
use ros_bus::{ActionHandler, FailureReason, GoalEnd, GoalError, GoalEvents, RosVersion};
use ros_message::codec::from_json;
use ros_message::schema::{ActionDef, MessageType, Registry};
use tokio::sync::mpsc;

/// Creates the action with this definition: goal, result, feedback.
fn action(text: &str) -> Arc<ActionDef> {
    let registry = Registry::for_version(RosVersion::Two);
    registry.insert("test_msgs/action/Fibonacci", text).unwrap();
    registry.action("test_msgs/Fibonacci").unwrap()
}

fn fibonacci() -> Arc<ActionDef> {
    action("int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n")
}

fn cdr(of: &MessageType, json: &str) -> Bytes {
    let mut bytes = Vec::new();
    from_json(of, json.as_bytes(), &mut bytes, &Default::default()).unwrap();
    bytes.into()
}

/// Callbacks received by a server's handler.
#[derive(Debug, PartialEq)]
enum Heard {
    Goal(String, Bytes),
    Cancel(String),
}

/// Reports its callbacks, and accepts all goals or none, or answers later.
struct Handler {
    heard: mpsc::UnboundedSender<Heard>,
    takes: bool,
    defers: bool,
}

impl Handler {
    fn new(takes: bool) -> (Arc<Self>, mpsc::UnboundedReceiver<Heard>) {
        let (heard, hears) = mpsc::unbounded_channel();
        (Arc::new(Self { heard, takes, defers: false }), hears)
    }

    fn deferring() -> (Arc<Self>, mpsc::UnboundedReceiver<Heard>) {
        let (heard, hears) = mpsc::unbounded_channel();
        (Arc::new(Self { heard, takes: true, defers: true }), hears)
    }
}

impl ActionHandler for Handler {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let _ = self.heard.send(Heard::Goal(id.to_owned(), goal));
        let taken = self.takes.then_some(());
        taken.ok_or_else(|| FailureReason::new("no"))
    }

    fn is_answer_deferred(&self) -> bool {
        self.defers
    }

    fn on_cancel(&self, id: &str) {
        let _ = self.heard.send(Heard::Cancel(id.to_owned()));
    }

    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

/// Events received by the sender of a goal.
#[derive(Debug, PartialEq)]
enum Told {
    Feedback(Bytes),
    Ended(Result<GoalEnd, String>),
}

struct Events(mpsc::UnboundedSender<Told>);

impl Events {
    fn new() -> (Arc<Self>, mpsc::UnboundedReceiver<Told>) {
        let (told, hears) = mpsc::unbounded_channel();
        (Arc::new(Self(told)), hears)
    }
}

impl GoalEvents for Events {
    fn on_feedback(&self, feedback: Bytes) {
        let _ = self.0.send(Told::Feedback(feedback));
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let end = end.map_err(|error| error.to_string());
        let _ = self.0.send(Told::Ended(end));
    }
}
