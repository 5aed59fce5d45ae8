//! Samples of what observers of servants report.

use api::goals::{Goal, GoalState};
use api::recordings::Recording;
use api::topics::{PublishedTopic, PublishedTopics};
use serde_json::Value;

use super::sample;

pub(super) fn samples() -> Vec<(&'static str, Value)> {
    let recording = Recording {
        number: 1,
        service: "x".into(),
        robot: "r".into(),
        servant: "x-1".into(),
        time: 1,
        why: "x".into(),
        seconds: 1.5,
        messages: 1,
        bytes: api::Size(1),
    };
    let log = api::KeptLog {
        servant: "x-1".into(),
        service: "x".into(),
        revision: 1,
        robot: "r".into(),
        created: 1,
        ended: 2,
        failed: true,
        reason: "x".into(),
        bytes: api::Size(1),
    };
    let topic = |latency| PublishedTopic {
        topic: "/x".into(),
        of: "std_msgs/String".into(),
        rate: 1.5,
        bandwidth: 1.5,
        latency,
    };
    let topics = PublishedTopics { seconds: 1.0, topics: vec![topic(None), topic(Some(0.5))] };
    let goal = |ended, state, text: &str| Goal {
        action: "/x".into(),
        id: "x".into(),
        by: "robot r".into(),
        began: 1,
        ended,
        state,
        text: text.into(),
    };
    let ended = [
        GoalState::Preempted,
        GoalState::Succeeded,
        GoalState::Aborted,
        GoalState::Rejected,
        GoalState::Recalled,
        GoalState::Lost,
    ];
    let mut samples = vec![
        sample("Recording", recording),
        sample("KeptLog", log),
        sample("PublishedTopics", topics),
        sample("Goal", goal(None, GoalState::Underway, "")),
    ];
    samples.extend(ended.map(|state| sample("Goal", goal(Some(2), state, "x"))));
    samples
}
