//! The action for clients that send goals by operations, as roslibjs does in ROS 2: feedback goes to the goal itself, not by
//! topics.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionClient, BusError, GoalEnd, GoalEvents, Outcome};
use ros::codec::{self, JsonOptions};
use ros::schema::ActionDef;
use tokio_util::sync::{CancellationToken, DropGuard};

use super::action_name;
use super::republish::ACTION;
use super::sending::{Wanted, check, send};
use crate::names::is_same_type;
use crate::shared::Shared;

/// One client's goals.
struct Goals {
    shared: Weak<Shared>,
    of: Arc<ActionDef>,
    under_way: Mutex<HashMap<String, Followed>>,
}

/// A goal that is told what moves.
struct Followed {
    events: Arc<dyn GoalEvents>,
    /// Ends its telling.
    _stop: DropGuard,
}

/// What takes a client's goals for this action, where it is the republisher's and no node of the servant serves it.
pub(crate) fn own_action(
    shared: &Arc<Shared>,
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
    Some(Box::new(Goals {
        shared: Arc::downgrade(shared),
        of: of.clone(),
        under_way: Mutex::default(),
    }))
}

impl Goals {
    fn begin(&self, id: &str, goal: &[u8], events: Arc<dyn GoalEvents>) -> Result<(), String> {
        let shared = self.shared.upgrade().ok_or("the bridge has ended")?;
        let mut json = Vec::new();
        codec::to_json(&self.of.goal, goal, &mut json, &JsonOptions::default())
            .map_err(|error| error.to_string())?;
        let wanted: Wanted = serde_json::from_slice(&json).map_err(|error| error.to_string())?;
        let stop = CancellationToken::new();
        {
            let mut under_way = self.under_way.lock();
            check(&wanted, under_way.len())?;
            let followed = Followed {
                events: events.clone(),
                _stop: stop.clone().drop_guard(),
            };
            under_way.insert(id.to_owned(), followed);
        }
        let buffer = shared.republisher.buffer(&shared);
        // It is heard from the beginning to the end.
        let heard = |_: &Shared| Some(0);
        let deliver = move |_: &Arc<Shared>, transforms: Option<Vec<u8>>| {
            if let Some(transforms) = transforms {
                events.feedback(transforms.into());
            }
            true
        };
        tokio::spawn(send(
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

/// Dropping it ends all of its goals without a word: whoever has sent them is gone.
#[async_trait]
impl ActionClient for Goals {
    async fn ready(&self, _patience: Duration) -> Result<(), BusError> {
        Ok(())
    }

    fn send(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        if let Err(text) = self.begin(id, &goal, events.clone()) {
            events.ended(Ok(GoalEnd {
                outcome: Outcome::Rejected,
                text,
                result: Bytes::new(),
            }));
        }
    }

    fn cancel(&self, id: &str) {
        let ended = self.under_way.lock().remove(id);
        if let Some(Followed { events, .. }) = ended {
            events.ended(Ok(GoalEnd {
                outcome: Outcome::Canceled,
                text: String::new(),
                result: codec::default_message(&self.of.result).into(),
            }));
        }
    }
}
