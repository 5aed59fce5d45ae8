//! Protocol of `shim.sock`: JSON, one message per line. A daemon may connect at any time and repeatedly; the shim
//! greets each connection with [`ShimMessage::Hello`], which contains the complete state, and then sends changes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::engine::{ContainerState, EnforcedLimits, NodeEvent, NodeExit};
use crate::exec::ExecSpec;
use crate::process::ProcessIdentity;
use crate::spec::{Limits, NodeSpec};

/// Status of a node as known to the shim.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeStatus {
    /// Host pid while it runs.
    pub pid: Option<i32>,
    /// Most recent exit.
    pub exit: Option<NodeExit>,
    /// Number of starts.
    pub starts: u32,
    /// Run for which it was started, as named by the caller ([`crate::spec::RUN`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<String>,
}

impl NodeStatus {
    /// Returns its exit if it has ended and is not running again.
    pub fn current_exit(&self) -> Option<&NodeExit> {
        self.exit.as_ref().filter(|_| self.pid.is_none())
    }
}

/// State of the container as known to the shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// State of the container.
    #[serde(flatten)]
    pub state: ContainerState,
    /// Host pid of init while it runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_pid: Option<i32>,
}

impl From<ContainerState> for Snapshot {
    /// Makes a snapshot without an init.
    fn from(state: ContainerState) -> Self {
        Self { state, init_pid: None }
    }
}

/// Message from the shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "type")]
pub enum ShimMessage {
    /// First message on every connection.
    Hello {
        /// Identity of the shim.
        shim: ProcessIdentity,
        /// State of the container.
        state: Snapshot,
        /// Nodes by name.
        nodes: BTreeMap<String, NodeStatus>,
        /// Limits in force.
        enforced: EnforcedLimits,
        /// True if it knows [`Command::Exec`]; shims of earlier versions do not.
        #[serde(default)]
        can_exec: bool,
    },
    /// The container's state has changed.
    State {
        /// New state.
        state: Snapshot,
    },
    /// Something happened to a node.
    Node {
        /// Event of the node.
        event: NodeEvent,
        /// New status of the node.
        status: NodeStatus,
    },
    /// The limits in force have changed.
    Enforced {
        /// Limits now in force.
        enforced: EnforcedLimits,
    },
    /// Reply to a [`ShimRequest`].
    Reply {
        /// Id of the request.
        id: u64,
        /// Reason of the failure; `None` on success.
        error: Option<String>,
    },
}

impl NodeEvent {
    /// Returns the name of the node.
    pub fn node(&self) -> &str {
        match self {
            Self::Started { node }
            | Self::ExecFailed { node, .. }
            | Self::Exited { node, .. }
            | Self::Respawning { node } => node,
        }
    }
}

/// Request to the shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShimRequest {
    /// Id repeated in the reply.
    pub id: u64,
    /// Command to carry out.
    pub command: Command,
}

/// Command to a shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// Start another node.
    StartNode(NodeSpec),
    /// Send a signal to a node's process group.
    SignalNode {
        /// Name of the node.
        node: String,
        /// Signal number.
        signal: i32,
        /// The node ends for good: it is not restarted, and the servant does not end with it.
        #[serde(default)]
        last: bool,
    },
    /// Change limits.
    SetLimits(Limits),
    /// Run a program beside the nodes. Attached to the line are the socket of its session and its streams: one
    /// terminal, or input, output and error. The session ends when either side closes its socket; before the shim does,
    /// it writes the program's exit status to it (four bytes, little-endian).
    Exec(ExecSpec),
    /// End the servant. Answered when the stop has begun; the end of the connection tells the rest.
    Stop,
}

impl Command {
    /// Returns the number of descriptors attached to the command.
    pub fn descriptor_count(&self) -> usize {
        match self {
            Self::Exec(ExecSpec { terminal: true, .. }) => 2,
            Self::Exec(_) => 4,
            Self::StartNode(_) | Self::SignalNode { .. } | Self::SetLimits(_) | Self::Stop => 0,
        }
    }
}

/// Encodes a message as a line.
pub(crate) fn to_line<T: Serialize>(message: &T) -> Vec<u8> {
    // Our types only have string keys; other keys are all that could fail.
    let mut text = serde_json::to_vec(message).unwrap_or_default();
    text.push(b'\n');
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_lines_and_read_as_written() {
        let event = NodeEvent::Exited { node: "/a\nb".into(), code: Some(1), signal: None, out_of_memory: false };
        let messages = [
            ShimMessage::State { state: Snapshot { state: ContainerState::Running, init_pid: Some(7) } },
            ShimMessage::Node { event, status: NodeStatus::default() },
            ShimMessage::Reply { id: 1, error: Some("no".into()) },
        ];
        for message in &messages {
            let text = to_line(message);
            assert_eq!(text.iter().filter(|byte| **byte == b'\n').count(), 1);
            assert_eq!(serde_json::from_slice::<ShimMessage>(&text).unwrap(), *message);
        }
        // The format of all versions: a daemon must understand shims started by an earlier one.
        assert_eq!(to_line(&messages[0]), b"{\"type\":\"state\",\"state\":{\"state\":\"running\",\"init_pid\":7}}\n");
        let earlier = r#"{"type":"node","event":{"event":"started","node":"/a","pid":9},"status":{"pid":9,"exit":null,"starts":1}}"#;
        let read: ShimMessage = serde_json::from_str(earlier).unwrap();
        let started = NodeEvent::Started { node: "/a".into() };
        assert!(matches!(read, ShimMessage::Node { event, .. } if event == started));
        let earlier = r#"{"type":"hello","shim":{"pid":7,"start":9},"state":{"state":"running"},"nodes":{},"enforced":{"cgroup_version":2,"limits":{}}}"#;
        let hello: ShimMessage = serde_json::from_str(earlier).unwrap();
        assert!(matches!(hello, ShimMessage::Hello { can_exec: false, .. }), "{hello:?}");
        let request = ShimRequest { id: 3, command: Command::SignalNode { node: "/a".into(), signal: 2, last: true } };
        assert_eq!(serde_json::from_slice::<ShimRequest>(&to_line(&request)).unwrap(), request);
    }
}
