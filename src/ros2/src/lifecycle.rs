//! Nodes with a lifecycle: they do nothing until they are told to configure and activate themselves
//! (<https://design.ros2.org/articles/node_lifecycle.html>).
//!
//! ```text
//!                 configure              activate
//!   unconfigured ───────────▶ inactive ───────────▶ active
//!        ▲  ◀─────────────────┘   ▲  ◀───────────────┘
//!        │        cleanup         │     deactivate
//!        └── shutdown from each of them ──▶ finalized
//! ```

mod begin;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ros_bus::{Bus, BusError, CallFate, Graph, QosProfile, RosVersion, Subscription, WireType, wait_for_connected};
use ros_message::codec::cursor::MessageCursor;
use ros_message::codec::put::CdrWriter;
use tokio::time::timeout;

use crate::interfaces;

pub use begin::{BeginError, BeginOutcome, begin_all};

/// Time limit for requests that a node answers without delay.
const PATIENCE: Duration = Duration::from_secs(10);
/// Queue depth for a slow watcher of changes.
const CHANGES: usize = 100;
/// Maximum number of transitions from one state.
const MOST: usize = 1000;

/// A node with a lifecycle.
pub struct LifecycleNode {
    bus: Arc<dyn Bus>,
    node: String,
}

/// State of a node. Those after the first five are transition states.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    /// The node does not know its state.
    Unknown,
    /// Created, without resources.
    Unconfigured,
    /// Configured, but not active.
    Inactive,
    /// Doing its work.
    Active,
    /// At its end.
    Finalized,
    /// In transition from unconfigured to inactive.
    Configuring,
    /// In transition from inactive to unconfigured.
    CleaningUp,
    /// In transition to finalized.
    ShuttingDown,
    /// In transition from inactive to active.
    Activating,
    /// In transition from active to inactive.
    Deactivating,
    /// Handling the error of a failed transition.
    ErrorProcessing,
    /// A state that is not defined, by its number.
    Other(u8),
}

/// A transition that can be requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Transition {
    /// Unconfigured → inactive.
    Configure,
    /// Inactive → unconfigured.
    Cleanup,
    /// Inactive → active.
    Activate,
    /// Active → inactive.
    Deactivate,
    /// Unconfigured, inactive or active → finalized.
    Shutdown,
}

/// A change of state published by a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateChange {
    /// Previous state.
    pub from: State,
    /// New state.
    pub to: State,
}

/// A stream of a node's state changes; dropping it ends the subscription.
pub struct StateChanges {
    subscription: Subscription,
}

impl LifecycleNode {
    /// Creates a handle to the node of this absolute name.
    pub fn new(bus: Arc<dyn Bus>, node: &str) -> Self {
        let node = node.to_owned();
        Self { bus, node }
    }

    /// Returns true if the node has a lifecycle, judged by the services it has.
    pub fn has_lifecycle(graph: &Graph, node: &str) -> bool {
        let server = graph.services.get(&format!("{node}/change_state"));
        server.is_some_and(|server| server == node)
    }

    /// Returns the current state.
    pub async fn state(&self) -> Result<State, BusError> {
        let answer = self.call("get_state", "GetState", CdrWriter::new().finish(), PATIENCE);
        self.parse_answer("get_state", &answer.await?, |cursor| {
            read_number_and_label(cursor).map(|(number, _)| State::from_number(number))
        })
    }

    /// Requests a transition and waits until it is complete. The node may take up to `patience`; a transition in
    /// progress continues after that.
    pub async fn change_state(&self, by: Transition, patience: Duration) -> Result<(), BusError> {
        let mut put = CdrWriter::new();
        // Nodes use the label if there is one, and then check whether the transition is possible in their state. An
        // impossible number would make rclpy nodes exit.
        put.byte(0);
        put.text(by.label());
        let answer = self.call("change_state", "ChangeState", put.finish(), patience);
        let read = |cursor: &mut MessageCursor<'_>| cursor.number().map(|[done]| done != 0);
        if self.parse_answer("change_state", &answer.await?, read)? {
            return Ok(());
        }
        let reason = match self.state().await {
            Ok(state) => format!("{} did not {}, and is {state} now", self.node, by.label()),
            Err(error) => format!("{} did not {}: {error}", self.node, by.label()),
        };
        Err(BusError::CallFailed { service: format!("{}/change_state", self.node), reason, fate: CallFate::Answered })
    }

    /// Returns the labels of the transitions possible in the current state, with the states they lead to. Between two
    /// states these include the transitions that a node makes by itself.
    pub async fn transitions(&self) -> Result<Vec<(String, State)>, BusError> {
        let (part, type_name) = ("get_available_transitions", "GetAvailableTransitions");
        let answer = self.call(part, type_name, CdrWriter::new().finish(), PATIENCE);
        self.parse_answer(part, &answer.await?, |cursor| {
            let length = cursor.length().filter(|length| *length <= MOST)?;
            let all = (0..length).map(|_| read_change(cursor));
            let all = all.map(|known| known.map(|(label, change)| (label, change.to)));
            all.collect()
        })
    }

    /// Watches changes of the state from the time this returns.
    pub async fn watch(&self) -> Result<StateChanges, BusError> {
        let of = interfaces::message("lifecycle_msgs/msg/TransitionEvent")?;
        let (of, qos) = (WireType::from_message(&of), QosProfile::keep_last(CHANGES));
        let topic = format!("{}/transition_event", self.node);
        let subscription = self.bus.subscribe(&topic, of, qos).await?;
        let heard = timeout(PATIENCE, wait_for_connected(subscription.matched.clone(), 1));
        heard.await.map_err(|_| BusError::Timeout { what: format!("topic {topic}"), after: PATIENCE })?;
        Ok(StateChanges { subscription })
    }

    async fn call(&self, part: &str, type_name: &str, request: Bytes, patience: Duration) -> Result<Bytes, BusError> {
        let of = interfaces::service(&format!("lifecycle_msgs/srv/{type_name}"))?;
        let service = format!("{}/{part}", self.node);
        let answer = self.bus.call_typed(&service, &of.digest, request, patience);
        answer.await
    }

    fn parse_answer<T>(
        &self,
        part: &str,
        answer: &[u8],
        read: impl FnOnce(&mut MessageCursor<'_>) -> Option<T>,
    ) -> Result<T, BusError> {
        let cursor = MessageCursor::new(RosVersion::Two, answer);
        let read = cursor.and_then(|mut cursor| read(&mut cursor));
        read.ok_or_else(|| BusError::Protocol {
            what: format!("service {}/{part}", self.node),
            reason: "its answer is truncated".to_owned(),
        })
    }
}

impl StateChanges {
    /// Returns the next change, or `None` when the connection to the ROS system has ended. Cancel-safe.
    pub async fn next(&mut self) -> Option<StateChange> {
        loop {
            let message = self.subscription.messages.recv().await?;
            let cursor = MessageCursor::new(RosVersion::Two, &message.bytes);
            let change = cursor.and_then(|mut cursor| {
                // The timestamp.
                cursor.skip(1, 8, 8)?;
                read_change(&mut cursor).map(|(_, change)| change)
            });
            if change.is_some() {
                return change;
            }
        }
    }
}

/// Reads the label of a transition, which is empty in events, and its states.
fn read_change(cursor: &mut MessageCursor<'_>) -> Option<(String, StateChange)> {
    let (_, label) = read_number_and_label(cursor)?;
    let (from, _) = read_number_and_label(cursor)?;
    let (to, _) = read_number_and_label(cursor)?;
    let change = StateChange { from: State::from_number(from), to: State::from_number(to) };
    Some((label, change))
}

fn read_number_and_label(cursor: &mut MessageCursor<'_>) -> Option<(u8, String)> {
    let [number] = cursor.number()?;
    let label = cursor.string(false)?;
    let label = label.strip_suffix(&[0]).unwrap_or(label);
    Some((number, String::from_utf8_lossy(label).into_owned()))
}

impl State {
    /// Returns the state of this number in `lifecycle_msgs/msg/State`.
    fn from_number(number: u8) -> Self {
        match number {
            0 => Self::Unknown,
            1 => Self::Unconfigured,
            2 => Self::Inactive,
            3 => Self::Active,
            4 => Self::Finalized,
            10 => Self::Configuring,
            11 => Self::CleaningUp,
            12 => Self::ShuttingDown,
            13 => Self::Activating,
            14 => Self::Deactivating,
            15 => Self::ErrorProcessing,
            other => Self::Other(other),
        }
    }
}

/// Displays the label that nodes use.
impl fmt::Display for State {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let label = match self {
            Self::Unknown => "unknown",
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
            Self::Configuring => "configuring",
            Self::CleaningUp => "cleaningup",
            Self::ShuttingDown => "shuttingdown",
            Self::Activating => "activating",
            Self::Deactivating => "deactivating",
            Self::ErrorProcessing => "errorprocessing",
            Self::Other(number) => return write!(formatter, "in state {number}"),
        };
        formatter.write_str(label)
    }
}

impl Transition {
    /// Returns the label that nodes use.
    pub fn label(self) -> &'static str {
        match self {
            Self::Configure => "configure",
            Self::Cleanup => "cleanup",
            Self::Activate => "activate",
            Self::Deactivate => "deactivate",
            Self::Shutdown => "shutdown",
        }
    }
}
