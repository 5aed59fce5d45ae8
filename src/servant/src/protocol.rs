//! What is said over `shim.sock`: JSON, one message a line. A daemon may connect at any time and as often as it
//! likes; the shim answers each connection with [`FromShim::Hello`], which tells all there is to know, and from
//! then on with what changes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::engine::{ContainerState, Enforced, NodeEvent, NodeExit};
use crate::process::Identity;
use crate::spec::{Limits, NodeSpec};

/// A node as the shim knows it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeStatus {
    /// Pid on the host while it runs.
    pub pid: Option<i32>,
    /// How it ended last.
    pub exit: Option<NodeExit>,
    /// How often it was started.
    pub starts: u32,
    /// For which run of its starter's, if that said so ([`crate::spec::RUN`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<String>,
}

impl NodeStatus {
    /// It has ended and does not run again at this moment.
    pub fn ended(&self) -> Option<&NodeExit> {
        self.exit.as_ref().filter(|_| self.pid.is_none())
    }
}

/// The container as its shim knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Where it is in its life.
    #[serde(flatten)]
    pub state: ContainerState,
    /// Init's pid on the host while it runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_pid: Option<i32>,
}

impl From<ContainerState> for Snapshot {
    /// Of one without an init.
    fn from(state: ContainerState) -> Self {
        Self {
            state,
            init_pid: None,
        }
    }
}

/// From the shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "type")]
pub enum FromShim {
    /// First on every connection.
    Hello {
        /// Who speaks.
        shim: Identity,
        /// The container.
        state: Snapshot,
        /// Its nodes by name.
        nodes: BTreeMap<String, NodeStatus>,
        /// Limits in force.
        enforced: Enforced,
    },
    /// The container's state has changed.
    State {
        /// The state that it is in now.
        state: Snapshot,
    },
    /// Something happened to a node.
    Node {
        /// What became of the node.
        event: NodeEvent,
        /// How the node is now.
        status: NodeStatus,
    },
    /// The limits in force have changed.
    Enforced {
        /// The limits in force now.
        enforced: Enforced,
    },
    /// An answer to a [`Request`].
    Reply {
        /// Id of the request that is answered.
        id: u64,
        /// None: done. Some: why not.
        error: Option<String>,
    },
}

impl NodeEvent {
    /// Which node it is about.
    pub fn node(&self) -> &str {
        match self {
            Self::Started { node }
            | Self::ExecFailed { node, .. }
            | Self::Exited { node, .. }
            | Self::Respawning { node } => node,
        }
    }
}

/// To the shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// Returned in the answer.
    pub id: u64,
    /// The command.
    pub command: Command,
}

/// The command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// Start one more node.
    StartNode(NodeSpec),
    /// Send a signal to a node's process group.
    SignalNode {
        /// Name of the node.
        node: String,
        /// Signal number.
        signal: i32,
        /// It ends for good: is not started again, and the servant does not end with it.
        #[serde(default)]
        last: bool,
    },
    /// Change limits.
    SetLimits(Limits),
    /// End the servant. Answered when it has begun; the end of the connection tells the rest.
    Stop,
}

/// A message as a line.
pub(crate) fn line<T: Serialize>(message: &T) -> Vec<u8> {
    // Our own types have string keys only, which is all that could fail.
    let mut text = serde_json::to_vec(message).unwrap_or_default();
    text.push(b'\n');
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_lines_and_read_as_written() {
        let event = NodeEvent::Exited {
            node: "/a\nb".into(),
            code: Some(1),
            signal: None,
            out_of_memory: false,
        };
        let messages = [
            FromShim::State {
                state: Snapshot {
                    state: ContainerState::Running,
                    init_pid: Some(7),
                },
            },
            FromShim::Node {
                event,
                status: NodeStatus::default(),
            },
            FromShim::Reply {
                id: 1,
                error: Some("no".into()),
            },
        ];
        for message in &messages {
            let text = line(message);
            assert_eq!(text.iter().filter(|byte| **byte == b'\n').count(), 1);
            assert_eq!(serde_json::from_slice::<FromShim>(&text).unwrap(), *message);
        }
        // As every version has written them: a daemon must understand the shims that an earlier one has started.
        assert_eq!(
            line(&messages[0]),
            b"{\"type\":\"state\",\"state\":{\"state\":\"running\",\"init_pid\":7}}\n"
        );
        let earlier = r#"{"type":"node","event":{"event":"started","node":"/a","pid":9},"status":{"pid":9,"exit":null,"starts":1}}"#;
        let read: FromShim = serde_json::from_str(earlier).unwrap();
        let started = NodeEvent::Started { node: "/a".into() };
        assert!(matches!(read, FromShim::Node { event, .. } if event == started));
        let request = Request {
            id: 3,
            command: Command::SignalNode {
                node: "/a".into(),
                signal: 2,
                last: true,
            },
        };
        assert_eq!(
            serde_json::from_slice::<Request>(&line(&request)).unwrap(),
            request
        );
    }
}
