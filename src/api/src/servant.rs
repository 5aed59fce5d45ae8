//! Servants: containers at work for one robot.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::Millis;
use crate::dictionary::Row;
use crate::limits::{Limits, Usage};
use crate::sla::Stated;

/// Where a servant is in its life; the choreographer draws the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// A robot asked for it.
    Requested,
    /// The machine has room for it.
    Admitted,
    /// Its container runs.
    Created,
    /// Its nodes run; their interface is awaited.
    Starting,
    /// Its interface is there.
    Ready,
    /// It is being ended.
    Draining,
    /// It ended as it should.
    Stopped,
    /// It ended otherwise.
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
    /// Its id, also its container's and its cgroup's name.
    pub id: String,
    /// The service it serves.
    pub service: String,
    /// The revision it was started from.
    pub revision: u64,
    /// The robot it serves.
    pub robot: String,
    /// Where it is in its life.
    pub phase: Phase,
    /// Why it failed or stopped.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// When it was asked for.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub created: Millis,
    /// Connections that use it now.
    pub connections: usize,
    /// When it is ended if nobody connects before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<crate::schema::Millis>))]
    pub idle_until: Option<Millis>,
    /// What its robot stated, and what follows from it; none where nothing was stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub terms: Option<Terms>,
    /// Limits asked for.
    pub limits: Limits,
    /// Limits in force, read back from the kernel; none while it is not running.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enforced: Option<Limits>,
    /// Version of the cgroup controllers that enforce them; 0: none could be used.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true, maximum = 2))]
    pub cgroup_version: u8,
    /// Usage now; none while it is not running.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub usage: Option<Usage>,
    /// How long its robot's requests took lately; none where none was answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub response: Option<ResponseTimes>,
    /// Host process ids of its nodes and their children.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub pids: Vec<i32>,
    /// Messages dropped because its clients or nodes were slow.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub dropped: u64,
    /// Of which topics messages were dropped, those of its links among them; the ten with most, the most first.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub drops: Vec<TopicDrops>,
    /// Its nodes that failed and are not started again yet.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub down: Vec<NodeDown>,
    /// Of its nodes that hang: which, and what they leave unanswered, in words.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub hung: Vec<String>,
    /// Its nodes that have a lifecycle (ROS 2), and where they are in it.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schema(required = true))]
    pub lifecycle: Vec<NodeStage>,
}

/// Where a node is in its lifecycle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct NodeStage {
    /// Its name.
    pub node: String,
    /// In ROS's own word: `unconfigured`, `inactive`, `active`, `finalized`, or one between two of them.
    pub state: String,
    /// Why it is not active although it was told to be.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// Messages of a topic that were dropped.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct TopicDrops {
    /// The topic.
    pub topic: String,
    /// How many so far.
    pub count: u64,
}

/// How long requests took that were answered within the last ten seconds: calls of services, goals, and messages on topics where
/// the service has one input that its output answers. Measured by the robot's stubs, and of a robot that speaks rosbridge
/// between the bridge and the servant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct ResponseTimes {
    /// So many requests; at most the last 256.
    pub requests: usize,
    /// What half of them did not exceed, milliseconds.
    pub p50_ms: f64,
    /// What 19 of 20 of them did not exceed, milliseconds.
    pub p95_ms: f64,
}

/// A node that failed and is not started again yet.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct NodeDown {
    /// Its name.
    pub node: String,
    /// How often in a row it failed.
    pub failures: u32,
    /// When it is started again.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub again: Millis,
}

/// A service that is not started for a robot before a time, since its servants have failed again and again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct BackOff {
    /// The service.
    pub service: String,
    /// Its revision.
    pub revision: u64,
    /// The robot; `~`: those without a name, `~warm`: servants that are kept ready for robots.
    pub robot: String,
    /// How often in a row.
    pub failures: u32,
    /// What happened last, beginning with a verb.
    pub reason: String,
    /// When it may be started again.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub again: Millis,
}

/// What a robot stated, and what its servant is promised for it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Terms {
    /// What was stated: by the node that a stub stands for, or by `` (nothing), a rosbridge client.
    pub stated: BTreeMap<String, Stated>,
    /// Auxiliary parameters of the dictionary that were measured, of what its clients sent. What they state comes before.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub measured: BTreeMap<String, String>,
    /// The class of the configuration that it is in.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// The class's priority: who has the greater one is served first.
    pub priority: i32,
    /// Rows of the dictionary that were taken.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub rows: Vec<Row>,
    /// The limits that follow, those of the push included. They are promised.
    pub limits: Limits,
    /// How they follow, a sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub why: Vec<String>,
}

impl Terms {
    /// What all of its robot's clients stated, in a line.
    pub fn stated_in_words(&self) -> String {
        let stated = self.stated.iter().map(|(node, stated)| match &**node {
            "" => stated.to_string(),
            node => format!("{node}: {stated}"),
        });
        stated.collect::<Vec<_>>().join("; ")
    }
}

/// Which servants were ended.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Stopped {
    /// Their ids.
    pub stopped: Vec<String>,
}

/// What a program prints to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Stream {
    /// Standard output.
    Stdout,
    /// Standard error.
    Stderr,
}

/// One line that a node printed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct LogLine {
    /// When the line was printed.
    #[cfg_attr(feature = "schema", schema(value_type = crate::schema::Millis))]
    pub time: Millis,
    /// Which node.
    pub node: String,
    /// How it was printed.
    pub stream: Stream,
    /// Without the line end.
    pub line: String,
}
