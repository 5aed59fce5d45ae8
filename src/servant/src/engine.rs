//! The seam to whoever starts servants. It speaks of servants alone: no pid, user id, path or namespace of a host.

mod unmet;

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use api::{Grants, Pressure};
use async_trait::async_trait;
use serde::{Deserialize, Serialize};
use tokio::sync::{broadcast, mpsc, watch};

use crate::spec::{Limits, NodeSpec, Spec};

pub use unmet::missing;

/// Where a servant's container is in its life. (Admission and readiness, which need more knowledge than the
/// engine has, are the choreographer's.)
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum ContainerState {
    /// Directories, namespaces and cgroup are being made.
    Creating,
    /// Init runs; nodes are started or starting.
    Running,
    /// Ended as asked, or because its nodes did.
    Stopped {
        /// Why it ended.
        reason: String,
    },
    /// Could not be started, or died of something that was not asked for (out of memory, init killed).
    Failed {
        /// What happened and what to do.
        reason: String,
    },
}

impl ContainerState {
    /// Whether nothing runs any more.
    pub fn is_over(&self) -> bool {
        matches!(self, Self::Stopped { .. } | Self::Failed { .. })
    }
}

/// What happened to one process of a servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "event")]
pub enum NodeEvent {
    /// It was forked and its program executed.
    Started {
        /// The node's name.
        node: String,
    },
    /// Its program could not be executed.
    ExecFailed {
        /// The node's name.
        node: String,
        /// Why it could not be executed.
        reason: String,
    },
    /// It ended.
    Exited {
        /// The node's name.
        node: String,
        /// Exit code, when it exited.
        code: Option<i32>,
        /// Signal number, when it was killed.
        signal: Option<i32>,
        /// The kernel killed it for exceeding the memory limit.
        out_of_memory: bool,
    },
    /// It will be started again after its delay.
    Respawning {
        /// The node's name.
        node: String,
    },
}

/// How a node ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeExit {
    /// Exit code, when it exited.
    pub code: Option<i32>,
    /// Signal number, when it was killed.
    pub signal: Option<i32>,
    /// The kernel killed it for exceeding the memory limit.
    pub out_of_memory: bool,
    /// Why its program could not be executed, when so.
    pub exec_error: Option<String>,
}

/// Which limits are in force, as read back from the kernel.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Enforced {
    /// 1 or 2; 0 where no controller could be used.
    pub cgroup_version: u8,
    /// The values in force; none: this host cannot limit it.
    pub limits: Limits,
    /// Those of its shim.
    #[serde(default)]
    pub shim: Limits,
}

/// Usage as the kernel counts it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Usage {
    /// Microseconds of CPU so far.
    pub cpu_usec: u64,
    /// Bytes of memory now.
    pub memory: u64,
    /// Of them those of files that were not used lately, which the kernel drops where memory is short.
    #[serde(default)]
    pub reclaimable: u64,
    /// Processes and threads now.
    pub pids: u64,
    /// Processes killed for want of memory so far.
    pub oom_kills: u64,
    /// Microseconds so far in which it wanted to run and had used its cores up.
    pub throttled_usec: u64,
    /// How much of the last ten seconds some of it waited for what others used; none where the kernel does not tell.
    pub pressure: Option<Pressure>,
}

/// One line that a process printed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogLine {
    /// Its place in the log, from 0; none for what is said about the log itself.
    #[serde(default)]
    pub number: Option<u64>,
    /// When the shim read it.
    pub time: SystemTime,
    /// Which node printed it.
    pub node: String,
    /// `stdout` or `stderr`.
    pub stream: String,
    /// Without the line end.
    pub line: String,
}

/// Where in a log to begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogStart {
    /// At the first line that is still there.
    First,
    /// So many lines back.
    Last(usize),
    /// Behind what was printed before.
    Now,
}

/// A servant that an engine runs. Cheap to share; dropping it does not end the servant.
#[async_trait]
pub trait Servant: Send + Sync + 'static {
    /// The spec's id.
    fn id(&self) -> &str;
    /// Its state now and as it changes.
    fn state(&self) -> watch::Receiver<ContainerState>;
    /// Node events from now on.
    fn events(&self) -> broadcast::Receiver<NodeEvent>;
    /// Limits read back from the kernel.
    fn enforced(&self) -> Enforced;
    /// Changes the limits that are given and leaves the others; answers what is in force then.
    async fn set_limits(&self, limits: Limits) -> Result<Enforced, crate::Error>;
    /// Usage now.
    async fn usage(&self) -> Result<Usage, crate::Error>;
    /// How long threads of its nodes, and of the processes that serve these, could have run so far and others had the cores,
    /// summed up; nothing where that is not counted.
    async fn waited(&self) -> Duration {
        Duration::ZERO
    }
    /// Names of the nodes that were ever started in it, or are about to be.
    fn nodes(&self) -> Vec<String>;
    /// For which run of its starter's a node was started last ([`crate::spec::RUN`]); none where nobody said so.
    fn run(&self, _node: &str) -> Option<String> {
        None
    }
    /// Starts one more node; returns when its program is executed, or with the reason why it could not be.
    async fn start_node(&self, node: NodeSpec) -> Result<(), crate::Error>;
    /// Sends a signal to a node.
    async fn signal_node(&self, node: &str, signal: i32) -> Result<(), crate::Error>;
    /// Sends a signal to a node that is to end for good: it is not started again, and the servant does not end with
    /// it, whatever its spec says. So it is from now on even if there is nothing to signal.
    async fn end_node(&self, node: &str, signal: i32) -> Result<(), crate::Error> {
        self.signal_node(node, signal).await
    }
    /// Waits for a node to end and tells how; answers at once when it has ended already.
    async fn wait_node(&self, node: &str) -> Result<NodeExit, crate::Error>;
    /// The last lines printed, at most so many, oldest first; of one node alone where one is named.
    async fn logs(&self, last: usize, node: Option<&str>) -> Vec<LogLine>;
    /// Every line printed, each once, none lost; ends when the container has ended.
    fn follow(&self, from: LogStart) -> mpsc::Receiver<LogLine>;
    /// Ends it: SIGINT to the nodes, SIGTERM, then SIGKILL to all; returns when nothing is left
    /// (process, mount, cgroup, directory).
    async fn stop(&self) -> Result<(), crate::Error>;
}

/// A servant that ended while no daemon watched.
#[derive(Debug, Clone)]
pub struct Ended {
    /// The spec's id.
    pub id: String,
    /// How it ended; none where nothing was left to tell.
    pub state: Option<ContainerState>,
}

/// What an engine found of an earlier daemon's: each servant is in one of the three.
#[derive(Default)]
pub struct Adopted {
    /// Servants that run.
    pub running: Vec<Arc<dyn Servant>>,
    /// Servants that have ended. What is left of them is in nobody's way until [`Engine::sweep`] removes it.
    pub ended: Vec<Ended>,
    /// What could not be looked at, each with the reason.
    pub failures: Vec<crate::Error>,
}

/// Starts and finds servants.
#[async_trait]
pub trait Engine: Send + Sync + 'static {
    /// Starts one; returns once its container runs and its nodes are started or starting.
    async fn start(&self, spec: Spec) -> Result<Arc<dyn Servant>, crate::Error>;
    /// Finds those that an earlier daemon left: adopted where they run, else told. Robots wait for it, so nothing is removed.
    /// Fails only where nothing can be looked at.
    async fn adopt(&self) -> Result<Adopted, crate::Error>;
    /// Removes what is left of servants that have ended; answers, with the reasons, what could not be removed.
    async fn sweep(&self, ended: &[Ended]) -> Vec<crate::Error>;
    /// Refuses grants that are not allowed or not there; answers, in words, what of them servants will lack.
    fn check(&self, grants: &Grants) -> Result<Vec<String>, crate::Error>;
}
