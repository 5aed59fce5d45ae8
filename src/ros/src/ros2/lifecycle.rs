//! Nodes with a lifecycle: they do nothing until somebody has them configure and activate themselves
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
use tokio::time::timeout;

use crate::bus::{
    Bus, BusError, CallFate, Graph, Qos, RosVersion, Subscription, WireType, reaches,
};
use crate::codec::cursor::Cursor;
use crate::codec::put::Put;
use crate::ros2::interfaces;

pub use begin::{Begun, NotBegun, begin_all};

/// For a node to answer what takes it no time.
const PATIENCE: Duration = Duration::from_secs(10);
/// Changes that are kept for a slow watcher.
const CHANGES: usize = 100;
/// Transitions that a node may have in one state.
const MOST: usize = 1000;

/// A node that has a lifecycle.
pub struct LifecycleNode {
    bus: Arc<dyn Bus>,
    node: String,
}

/// In which state a node is. Those behind the first five are passed through while a transition goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    /// The node does not know.
    Unknown,
    /// It was made, and holds nothing yet.
    Unconfigured,
    /// It holds what it needs, and does nothing.
    Inactive,
    /// It does its work.
    Active,
    /// It can only end.
    Finalized,
    /// On the way from unconfigured to inactive.
    Configuring,
    /// On the way from inactive to unconfigured.
    CleaningUp,
    /// On the way to finalized.
    ShuttingDown,
    /// On the way from inactive to active.
    Activating,
    /// On the way from active to inactive.
    Deactivating,
    /// A transition has failed, and the node sees what it can do.
    ErrorProcessing,
    /// One that nobody has defined, by its number.
    Other(u8),
}

/// What a node can be asked for.
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

/// A change of state, as a node tells of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateChange {
    /// From which state.
    pub from: State,
    /// To which.
    pub to: State,
}

/// Changes of a node's state; dropping it ends that.
pub struct StateChanges {
    subscription: Subscription,
}

impl LifecycleNode {
    /// The node of this absolute name.
    pub fn of(bus: Arc<dyn Bus>, node: &str) -> Self {
        let node = node.to_owned();
        Self { bus, node }
    }

    /// Whether the node has a lifecycle: it serves what others have not.
    pub fn is_one(graph: &Graph, node: &str) -> bool {
        let server = graph.services.get(&format!("{node}/change_state"));
        server.is_some_and(|server| server == node)
    }

    /// In which state it is.
    pub async fn state(&self) -> Result<State, BusError> {
        let answer = self.ask("get_state", "GetState", Put::new().end(), PATIENCE);
        self.read("get_state", &answer.await?, |cursor| {
            read_number_and_label(cursor).map(|(number, _)| State::of(number))
        })
    }

    /// Has it change its state, and returns when it has. The node may take as long as `patience`; what it does meanwhile goes
    /// on when it is over.
    pub async fn change(&self, by: Transition, patience: Duration) -> Result<(), BusError> {
        let mut put = Put::new();
        // Nodes look at the label where there is one, and then whether the transition leads on from where they are. A number
        // that does not makes those of rclpy end.
        put.byte(0);
        put.text(by.label());
        let answer = self.ask("change_state", "ChangeState", put.end(), patience);
        let read = |cursor: &mut Cursor<'_>| cursor.number().map(|[done]| done != 0);
        if self.read("change_state", &answer.await?, read)? {
            return Ok(());
        }
        let reason = match self.state().await {
            Ok(state) => format!("{} did not {}, and is {state} now", self.node, by.label()),
            Err(error) => format!("{} did not {}: {error}", self.node, by.label()),
        };
        Err(BusError::CallFailed {
            service: format!("{}/change_state", self.node),
            reason,
            fate: CallFate::Answered,
        })
    }

    /// Labels of the transitions that lead on from where it is, and to which states. Those that a node goes through by itself
    /// are among them while it is between two states.
    pub async fn transitions(&self) -> Result<Vec<(String, State)>, BusError> {
        let (part, type_name) = ("get_available_transitions", "GetAvailableTransitions");
        let answer = self.ask(part, type_name, Put::new().end(), PATIENCE);
        self.read(part, &answer.await?, |cursor| {
            let length = cursor.length().filter(|length| *length <= MOST)?;
            let all = (0..length).map(|_| read_change(cursor));
            let all = all.map(|known| known.map(|(label, change)| (label, change.to)));
            all.collect()
        })
    }

    /// Changes of its state from when this returns.
    pub async fn watch(&self) -> Result<StateChanges, BusError> {
        let of = interfaces::message("lifecycle_msgs/msg/TransitionEvent")?;
        let (of, qos) = (WireType::of(&of), Qos::keep_last(CHANGES));
        let topic = format!("{}/transition_event", self.node);
        let subscription = self.bus.subscribe(&topic, of, qos).await?;
        let heard = timeout(PATIENCE, reaches(subscription.matched.clone(), 1));
        heard.await.map_err(|_| BusError::Timeout {
            what: format!("topic {topic}"),
            after: PATIENCE,
        })?;
        Ok(StateChanges { subscription })
    }

    async fn ask(
        &self,
        part: &str,
        type_name: &str,
        request: Bytes,
        patience: Duration,
    ) -> Result<Bytes, BusError> {
        let of = interfaces::service(&format!("lifecycle_msgs/srv/{type_name}"))?;
        let service = format!("{}/{part}", self.node);
        let answer = self.bus.call_typed(&service, &of.digest, request, patience);
        answer.await
    }

    fn read<T>(
        &self,
        part: &str,
        answer: &[u8],
        read: impl FnOnce(&mut Cursor<'_>) -> Option<T>,
    ) -> Result<T, BusError> {
        let cursor = Cursor::new(RosVersion::Two, answer);
        let read = cursor.and_then(|mut cursor| read(&mut cursor));
        read.ok_or_else(|| BusError::Protocol {
            what: format!("service {}/{part}", self.node),
            reason: "its answer is torn".to_owned(),
        })
    }
}

impl StateChanges {
    /// The next one; none when the connection to the ROS system has ended. Safe to cancel.
    pub async fn next(&mut self) -> Option<StateChange> {
        loop {
            let message = self.subscription.messages.recv().await?;
            let cursor = Cursor::new(RosVersion::Two, &message.bytes);
            let change = cursor.and_then(|mut cursor| {
                // When it was.
                cursor.skip(1, 8, 8)?;
                read_change(&mut cursor).map(|(_, change)| change)
            });
            if change.is_some() {
                return change;
            }
        }
    }
}

/// The label of a transition, which events leave empty, and from where to where it leads.
fn read_change(cursor: &mut Cursor<'_>) -> Option<(String, StateChange)> {
    let (_, label) = read_number_and_label(cursor)?;
    let (from, _) = read_number_and_label(cursor)?;
    let (to, _) = read_number_and_label(cursor)?;
    let change = StateChange {
        from: State::of(from),
        to: State::of(to),
    };
    Some((label, change))
}

fn read_number_and_label(cursor: &mut Cursor<'_>) -> Option<(u8, String)> {
    let [number] = cursor.number()?;
    let label = cursor.string(false)?;
    let label = label.strip_suffix(&[0]).unwrap_or(label);
    Some((number, String::from_utf8_lossy(label).into_owned()))
}

impl State {
    /// By its number in `lifecycle_msgs/msg/State`.
    fn of(number: u8) -> Self {
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

/// As nodes call it.
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
    /// As nodes call it.
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
