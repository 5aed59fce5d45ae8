//! Requests for transforms, by the service and by the topics of the action.

use std::sync::{Arc, Weak};

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{PeerId, RosVersion, SerializedMessage, WireType};
use ros::codec::{self, JsonOptions, Time};
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId, GoalState};
use ros::schema::{MessageType, SchemaError, ServiceDef};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::sending::{TransformRequest, TransformRequestError, check_limits, newest_listener_on, send_transforms};
use super::{array_name, package};
use crate::fanout::Listener;
use crate::own_service::{Caller, OwnService, OwnServiceError};
use crate::republisher::{Republisher, TransformBuffer};
use crate::sample::TopicSample;
use crate::shared::BridgeShared;

/// Name of the service.
pub(crate) const SERVICE: &str = "/republish_tfs";
/// Topic of the action's goals.
pub(crate) const GOAL_TOPIC: &str = "/tf2_web_republisher/goal";
const CANCEL_TOPIC: &str = "/tf2_web_republisher/cancel";
const FEEDBACK_TOPIC: &str = "/tf2_web_republisher/feedback";
const RESULT_TOPIC: &str = "/tf2_web_republisher/result";
pub(crate) const STATUS_TOPIC: &str = "/tf2_web_republisher/status";

/// Topics of the action in ROS 1, their types, and whether the action's server publishes them.
pub(crate) const TOPICS: [(&str, &str, bool); 5] = [
    (GOAL_TOPIC, "tf2_web_republisher/TFSubscriptionActionGoal", false),
    (CANCEL_TOPIC, "actionlib_msgs/GoalID", false),
    (FEEDBACK_TOPIC, "tf2_web_republisher/TFSubscriptionActionFeedback", true),
    (RESULT_TOPIC, "tf2_web_republisher/TFSubscriptionActionResult", true),
    (STATUS_TOPIC, "actionlib_msgs/GoalStatusArray", true),
];
/// Prefix of the topics created for callers of the service.
const TOPIC_PREFIX: &str = "/tf_repub_";
/// Name of the action, and of the node that appears to publish.
pub(crate) const ACTION: &str = "/tf2_web_republisher";

/// The service `/republish_tfs`.
pub(crate) struct RepublishTfs;

#[async_trait]
impl OwnService for RepublishTfs {
    fn definition(&self, shared: &BridgeShared) -> Result<Arc<ServiceDef>, SchemaError> {
        let name = format!("{}/RepublishTFs", package(shared.bus.version()));
        shared.registry.service(&name)
    }

    async fn answer(
        &self,
        shared: &Arc<BridgeShared>,
        args: &[u8],
        _: &Caller<'_>,
    ) -> Result<Vec<u8>, OwnServiceError> {
        shared.republisher.call(shared, args)
    }
}

impl Republisher {
    /// Returns the type of a topic created for a caller.
    pub(crate) fn type_name(&self, version: RosVersion, topic: &str) -> Option<&'static str> {
        (topic.starts_with(TOPIC_PREFIX) && self.topics.lock().contains_key(topic)).then(|| array_name(version))
    }

    /// Answers a call of the service; request and response are JSON.
    fn call(&self, shared: &Arc<BridgeShared>, request: &[u8]) -> Result<Vec<u8>, OwnServiceError> {
        let wanted: TransformRequest = serde_json::from_slice(request).map_err(OwnServiceError::Args)?;
        check_limits(&wanted, self.topics.lock().len())?;
        let topic = format!("{TOPIC_PREFIX}{}", shared.next_number());
        let stop = CancellationToken::new();
        self.topics.lock().insert(topic.clone(), stop.clone().drop_guard());
        let patience = wanted.topic_timeout();
        let (name, message_type) = (topic.clone(), shared.registry.message(array_name(shared.bus.version())));
        let message_type = message_type?;
        let mut heard = Instant::now();
        let of = message_type.clone();
        let deliver = move |shared: &Arc<BridgeShared>, transforms: Option<Vec<u8>>| {
            let live = shared.live_fanouts(&name);
            if !live.is_empty() {
                heard = Instant::now();
            }
            if let Some(transforms) = transforms {
                let message = message(&message_type, transforms.into());
                for fanout in live {
                    fanout.deliver(message.clone(), true);
                }
            }
            // Nobody has listened for the time given by the caller: it is gone.
            let gone = heard.elapsed() > patience;
            if gone {
                shared.republisher.topics.lock().remove(&name);
            }
            !gone
        };
        tokio::spawn(send_transforms(
            Arc::downgrade(shared),
            self.buffer(shared),
            wanted,
            (newest_listener_on(&topic), of),
            stop,
            deliver,
        ));
        Ok(serde_json::json!({ "topic_name": topic }).to_string().into_bytes())
    }

    /// Listens to goals when a client is about to send some, unless a node serves them.
    pub(crate) fn listen_for_goals(&self, shared: &Arc<BridgeShared>) {
        let graph = shared.bus.graph().borrow().clone();
        let served = graph.topics.get(FEEDBACK_TOPIC).is_some_and(|nodes| !nodes.publishers.is_empty());
        if served || self.listening.get().is_some() {
            return;
        }
        let registry = &shared.registry;
        let (Ok(action), Ok(cancel)) =
            (registry.action("tf2_web_republisher/TFSubscription"), registry.message("actionlib_msgs/GoalID"))
        else {
            return;
        };
        let listener = |cancels| Arc::new(GoalListener { shared: Arc::downgrade(shared), cancels });
        let goals = shared.fanout(GOAL_TOPIC, Some(&action.action_goal)).listen(listener(false));
        let cancels = shared.fanout(CANCEL_TOPIC, Some(&cancel)).listen(listener(true));
        // The loser of a race drops its listeners.
        let _ = self.listening.set([goals, cancels]);
    }

    pub(super) fn buffer(&self, shared: &Arc<BridgeShared>) -> Arc<TransformBuffer> {
        self.buffer.get(|| TransformBuffer::new(shared))
    }

    fn begin(
        &self,
        shared: &Arc<BridgeShared>,
        goal: GoalId,
        body: &[u8],
        publisher: PeerId,
    ) -> Result<(), TransformRequestError> {
        let action = shared.registry.action("tf2_web_republisher/TFSubscription")?;
        let mut json = Vec::new();
        codec::to_json(&action.goal, body, &mut json, &JsonOptions::default()).map_err(Box::new)?;
        let wanted: TransformRequest = serde_json::from_slice(&json)?;
        check_limits(&wanted, self.goals.lock().len())?;
        let stop = CancellationToken::new();
        self.goals.lock().insert(goal.id.clone(), stop.clone().drop_guard());
        let of = action.feedback.clone();
        let deliver = move |shared: &Arc<BridgeShared>, transforms: Option<Vec<u8>>| {
            if let Some(transforms) = transforms {
                let bytes =
                    messages::write_state(Time::now(), &goal_state(&goal, ActionlibStatus::Active), &transforms);
                shared.deliver(FEEDBACK_TOPIC, &message(&action.action_feedback, bytes));
            }
            // The goal of a client that is gone is given up.
            let alive = shared.has_publisher(GOAL_TOPIC, &publisher);
            if !alive {
                shared.republisher.goals.lock().remove(&goal.id);
            }
            alive
        };
        tokio::spawn(send_transforms(
            Arc::downgrade(shared),
            self.buffer(shared),
            wanted,
            (newest_listener_on(FEEDBACK_TOPIC), of),
            stop,
            deliver,
        ));
        Ok(())
    }

    /// Cancels a goal, or all of them if the id is empty.
    fn cancel(&self, shared: &Arc<BridgeShared>, goal: &GoalId) {
        let mut goals = self.goals.lock();
        let ended: Vec<String> = match goal.id.as_str() {
            "" => goals.drain().map(|(id, _)| id).collect(),
            id => goals.remove(id).map(|_| id.to_owned()).into_iter().collect(),
        };
        drop(goals);
        let action = shared.registry.action("tf2_web_republisher/TFSubscription");
        let Ok(action) = action else { return };
        for id in ended {
            let goal = GoalId { id, ..GoalId::default() };
            let bytes = messages::write_state(Time::now(), &goal_state(&goal, ActionlibStatus::Preempted), &[]);
            shared.deliver(RESULT_TOPIC, &message(&action.action_result, bytes));
        }
    }
}

fn goal_state(goal: &GoalId, status: ActionlibStatus) -> GoalState {
    GoalState { goal: goal.clone(), status, text: String::new() }
}

fn message(message_type: &MessageType, bytes: Bytes) -> SerializedMessage {
    SerializedMessage {
        bytes,
        wire_type: Arc::new(WireType::from_message(message_type)),
        publisher: ACTION.into(),
        latching: false,
    }
}

/// Listens to goals, or to their cancellation.
struct GoalListener {
    shared: Weak<BridgeShared>,
    cancels: bool,
}

impl Listener for GoalListener {
    fn on_sample(&self, sample: &Arc<TopicSample>, _replay: bool) {
        // Nodes have a republisher of their own, or none.
        let Some(shared) = self.shared.upgrade().filter(|_| sample.local) else {
            return;
        };
        if self.cancels {
            if let Some(goal) = messages::read_cancel(&sample.bytes) {
                shared.republisher.cancel(&shared, &goal);
            }
        } else if let Some((goal, body)) = messages::read_goal(&sample.bytes)
            && let Err(reason) = shared.republisher.begin(&shared, goal, &body, sample.publisher.clone())
        {
            tracing::debug!("a request for transforms was refused: {reason}");
        }
    }

    fn on_failed(&self, reason: &str) {
        tracing::debug!("cannot receive goals for transforms: {reason}");
    }
}
