//! The action for clients that send goals by operations, as roslibjs does in ROS 2: feedback is sent to the goal
//! itself, not by topics.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionClient, BusError, GoalEnd, GoalEvents, GoalOutcome};
use ros::codec::{self, JsonOptions};
use ros::schema::ActionDef;
use tokio_util::sync::{CancellationToken, DropGuard};

use super::action_name;
use super::republish::ACTION;
use super::sending::{TransformRequest, TransformRequestError, check_limits, send_transforms};
use crate::names::is_same_type;
use crate::shared::BridgeShared;

/// Goals of one client.
struct TfGoals {
    shared: Weak<BridgeShared>,
    of: Arc<ActionDef>,
    under_way: Mutex<HashMap<String, ActiveTfGoal>>,
}

/// A goal that receives transforms.
struct ActiveTfGoal {
    events: Arc<dyn GoalEvents>,
    /// Ends the sending of transforms.
    _stop: DropGuard,
}

/// Returns the handler of a client's goals for this action, if it is the republisher's and no node of the servant
/// serves it.
pub(crate) fn own_action_client(
    shared: &Arc<BridgeShared>,
    action: &str,
    of: &Arc<ActionDef>,
) -> Option<Box<dyn ActionClient>> {
    if action != ACTION || !is_same_type(&of.name, action_name(shared.bus.version())) {
        return None;
    }
    let graph = shared.bus.graph().borrow().clone();
    let nodes = graph.actions.get(action);
    if nodes.is_some_and(|nodes| !nodes.servers.is_empty()) {
        return None;
    }
    Some(Box::new(TfGoals { shared: Arc::downgrade(shared), of: of.clone(), under_way: Mutex::default() }))
}

impl TfGoals {
    fn begin(&self, id: &str, goal: &[u8], events: Arc<dyn GoalEvents>) -> Result<(), TransformRequestError> {
        let shared = self.shared.upgrade();
        let shared = shared.ok_or(TransformRequestError::BridgeEnded)?;
        let mut json = Vec::new();
        codec::to_json(&self.of.goal, goal, &mut json, &JsonOptions::default()).map_err(Box::new)?;
        let wanted: TransformRequest = serde_json::from_slice(&json)?;
        let stop = CancellationToken::new();
        {
            let mut under_way = self.under_way.lock();
            check_limits(&wanted, under_way.len())?;
            let followed = ActiveTfGoal { events: events.clone(), _stop: stop.clone().drop_guard() };
            under_way.insert(id.to_owned(), followed);
        }
        let buffer = shared.republisher.buffer(&shared);
        // It has a listener from the beginning to the end.
        let heard = |_: &BridgeShared| Some(0);
        let deliver = move |_: &Arc<BridgeShared>, transforms: Option<Vec<u8>>| {
            if let Some(transforms) = transforms {
                events.on_feedback(transforms.into());
            }
            true
        };
        tokio::spawn(send_transforms(
            Arc::downgrade(&shared),
            buffer,
            wanted,
            (heard, self.of.feedback.clone()),
            stop,
            deliver,
        ));
        Ok(())
    }
}

/// Dropping it ends all of its goals silently, since their sender is gone.
#[async_trait]
impl ActionClient for TfGoals {
    async fn wait_for_server(&self, _patience: Duration) -> Result<(), BusError> {
        Ok(())
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        if let Err(error) = self.begin(id, &goal, events.clone()) {
            events.on_ended(Ok(GoalEnd {
                outcome: GoalOutcome::Rejected,
                text: error.to_string(),
                result: Bytes::new(),
            }));
        }
    }

    fn cancel_goal(&self, id: &str) {
        let ended = self.under_way.lock().remove(id);
        if let Some(ActiveTfGoal { events, .. }) = ended {
            events.on_ended(Ok(GoalEnd {
                outcome: GoalOutcome::Canceled,
                text: String::new(),
                result: codec::default_message(&self.of.result).into(),
            }));
        }
    }
}
