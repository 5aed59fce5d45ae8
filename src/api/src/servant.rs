//! Servants: containers that serve a robot.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::dictionary::Row;
use crate::limits::{Limits, Usage};
use crate::size::Size;
use crate::sla::Stated;

/// Phase of a servant's life cycle; see the state machine in the choreographer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// Requested by a robot.
    Requested,
    /// Admitted: resources are reserved.
    Admitted,
    /// The container is running.
    Created,
    /// The nodes are running; their interface is not complete yet.
    Starting,
    /// The interface is complete.
    Ready,
    /// The servant is being stopped.
    Draining,
    /// Stopped normally.
    Stopped,
    /// Failed.
    Failed,
}

impl fmt::Display for Phase {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.pad(match self {
            Phase::Requested => "requested",
            Phase::Admitted => "admitted",
            Phase::Created => "created",
            Phase::Starting => "starting",
            Phase::Ready => "ready",
            Phase::Draining => "draining",
            Phase::Stopped => "stopped",
            Phase::Failed => "failed",
        })
    }
}

/// A servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Servant {
    /// Servant id, which is also the name of its container and cgroup.
    pub id: String,
    /// Name of the service.
    pub service: String,
    /// Revision that the servant was started from.
    pub revision: u64,
    /// Name of the robot.
    pub robot: String,
    /// Phase of the life cycle.
    pub phase: Phase,
    /// Reason for the failure or stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Time when the servant was requested.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Number of connections that use the servant.
    pub connections: usize,
    /// Time at which the servant is stopped if nobody connects before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub idle_until: Option<Millis>,
    /// The robot's statement and the resulting terms; absent if nothing was stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub terms: Option<Terms>,
    /// Requested limits.
    pub limits: Limits,
    /// Limits in force, as read back from the kernel; absent if the servant is not running.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enforced: Option<Limits>,
    /// Version of the cgroup controllers that enforce the limits; 0 if none could be used.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, maximum = 2))]
    pub cgroup_version: u8,
    /// Current resource usage; absent if the servant is not running.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub usage: Option<Usage>,
    /// Recent response times of the robot's requests; absent if none was answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub response: Option<ResponseTimes>,
    /// Host process ids of the nodes and their children.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub pids: Vec<i32>,
    /// Number of messages dropped because clients or nodes were slow.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub dropped: u64,
    /// Dropped messages by topic, including those of the links; the ten topics with the most drops, in descending
    /// order.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub drops: Vec<TopicDrops>,
    /// Nodes that failed and have not been restarted yet.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub down: Vec<NodeDown>,
    /// Nodes that hang, with a description of what they leave unanswered.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub hung: Vec<String>,
    /// Lifecycle nodes (ROS 2) and their states.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub lifecycle: Vec<NodeStage>,
}

/// Lifecycle state of a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct NodeStage {
    /// Name of the node.
    pub node: String,
    /// ROS lifecycle state: `unconfigured`, `inactive`, `active`, `finalized`, or a transition state.
    pub state: String,
    /// Reason why the node did not become active as requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// Dropped messages of a topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct TopicDrops {
    /// Name of the topic.
    pub topic: String,
    /// Number of messages dropped so far.
    pub count: u64,
}

/// Response times of requests answered within the last ten seconds: service calls, goals, and messages on topics if the
/// service has one input that its output answers. Measured by the robot's stubs; for a rosbridge robot, between the
/// bridge and the servant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ResponseTimes {
    /// Number of requests, at most the last 256.
    pub requests: usize,
    /// Median in milliseconds.
    pub p50_ms: f64,
    /// 95th percentile in milliseconds.
    pub p95_ms: f64,
}

/// A node that failed and has not been restarted yet.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct NodeDown {
    /// Name of the node.
    pub node: String,
    /// Number of consecutive failures.
    pub failures: u32,
    /// Time of the next restart.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub again: Millis,
}

/// Back-off of a service for a robot after repeated failures of its servants.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct BackOff {
    /// Name of the service.
    pub service: String,
    /// Revision of the service.
    pub revision: u64,
    /// Name of the robot; `~` for anonymous robots, `~warm` for servants of the warm pool.
    pub robot: String,
    /// Number of consecutive failures.
    pub failures: u32,
    /// Latest failure, beginning with a verb.
    pub reason: String,
    /// Earliest time of the next start.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub again: Millis,
}

/// The robot's statement, and the terms that its servant gets.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Terms {
    /// Statements by the node that a stub stands for; the empty key is a rosbridge client.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub stated: BTreeMap<String, Stated>,
    /// Auxiliary parameters of the dictionary as measured on the clients' messages. Stated values take precedence.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub measured: BTreeMap<String, String>,
    /// Class that the robot is assigned to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Priority of the class; higher values are admitted first.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub priority: i32,
    /// Dictionary rows that were chosen.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub rows: Vec<Row>,
    /// Resulting limits, including those of the push. They are reserved.
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub limits: Limits,
    /// Explanation of the limits, one sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub why: Vec<String>,
}

impl Terms {
    /// Formats the statements of all the robot's clients in one line.
    pub fn describe_stated(&self) -> String {
        let stated = self.stated.iter().map(|(node, stated)| match &**node {
            "" => stated.to_string(),
            node => format!("{node}: {stated}"),
        });
        stated.collect::<Vec<_>>().join("; ")
    }
}

/// Servants that were stopped.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Stopped {
    /// Ids of the servants.
    pub stopped: Vec<String>,
}

/// Output stream of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Stream {
    /// Standard output.
    Stdout,
    /// Standard error.
    Stderr,
}

/// A line of a node's output.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct LogLine {
    /// Time when the line was printed.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Name of the node.
    pub node: String,
    /// Stream that the line was printed to.
    pub stream: Stream,
    /// Severity, if the line is in the console format of ROS 1 or ROS 2.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub level: Option<LogLevel>,
    /// The line, without its line terminator.
    pub line: String,
}

/// Severity of a line of a log, as ROS names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum LogLevel {
    /// Details for developers.
    Debug,
    /// Normal operation.
    Info,
    /// Something unexpected, which the node copes with.
    Warn,
    /// Something that the node cannot do.
    Error,
    /// The node cannot go on.
    Fatal,
}

/// An ended servant whose log is kept for a while, to be read like that of a running one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct KeptLog {
    /// Id of the servant; its log is at `GET /api/v1/servants/ID/logs`.
    pub servant: String,
    /// Name of the service.
    pub service: String,
    /// Revision that the servant was started from.
    pub revision: u64,
    /// Name of the robot.
    pub robot: String,
    /// Time when the servant was requested.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Time when the servant ended.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub ended: Millis,
    /// True if the servant failed, false if it was ended.
    pub failed: bool,
    /// Reason of the end.
    pub reason: String,
    /// Size of the log's files in bytes.
    pub bytes: Size,
}
