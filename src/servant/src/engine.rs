//! Interface to the engines that start servants. It speaks of servants only: no pid, user id, path or namespace of a
//! host.

mod unmet;

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use api::exec::TerminalSize;
use api::{Grants, KeptLog, Pressure};
use async_trait::async_trait;
use serde::{Deserialize, Serialize};
use tokio::sync::{broadcast, mpsc, watch};

use crate::exec::{ExecSession, ExecSpec};
use crate::spec::{Limits, NodeSpec, Spec};

pub use unmet::missing_limits;

/// State of a servant's container. (Admission and readiness, which need more knowledge than the engine has, are the
/// choreographer's.)
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum ContainerState {
    /// Directories, namespaces and cgroup are being created.
    Creating,
    /// Init runs; nodes are started or starting.
    Running,
    /// Ended on request, or because its nodes did.
    Stopped {
        /// Reason of the end.
        reason: String,
    },
    /// Could not be started, or ended unexpectedly (out of memory, init killed).
    Failed {
        /// Reason, and what to do.
        reason: String,
    },
}

impl ContainerState {
    /// Returns whether nothing runs any more.
    pub fn is_over(&self) -> bool {
        matches!(self, Self::Stopped { .. } | Self::Failed { .. })
    }
}

/// An event of one process of a servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "event")]
pub enum NodeEvent {
    /// The process was forked and its program executed.
    Started {
        /// Name of the node.
        node: String,
    },
    /// The program could not be executed.
    ExecFailed {
        /// Name of the node.
        node: String,
        /// Reason of the failure.
        reason: String,
    },
    /// The process ended.
    Exited {
        /// Name of the node.
        node: String,
        /// Exit code, if it exited.
        code: Option<i32>,
        /// Signal number, if it was killed by one.
        signal: Option<i32>,
        /// True if the kernel killed it for exceeding the memory limit.
        out_of_memory: bool,
    },
    /// The process will be restarted after its delay.
    Respawning {
        /// Name of the node.
        node: String,
    },
}

/// The end of a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeExit {
    /// Exit code, if it exited.
    pub code: Option<i32>,
    /// Signal number, if it was killed by one.
    pub signal: Option<i32>,
    /// True if the kernel killed it for exceeding the memory limit.
    pub out_of_memory: bool,
    /// Reason why its program could not be executed, if so.
    pub exec_error: Option<String>,
}

/// Limits in force, as read back from the kernel.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct EnforcedLimits {
    /// Cgroup version, 1 or 2; 0 if no controller could be used.
    pub cgroup_version: u8,
    /// Values in force; absent where this host cannot limit it.
    pub limits: Limits,
    /// Limits of the shim.
    #[serde(default)]
    pub shim: Limits,
}

/// Resource usage as counted by the kernel.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Usage {
    /// CPU time so far in microseconds.
    pub cpu_usec: u64,
    /// Bytes of memory now.
    pub memory: u64,
    /// Bytes of those that belong to files not used lately, which the kernel drops when memory is short.
    #[serde(default)]
    pub reclaimable: u64,
    /// Number of processes and threads now.
    pub pids: u64,
    /// Number of processes killed for lack of memory so far.
    pub oom_kills: u64,
    /// Microseconds so far in which it was throttled: it could have run, but had used up its CPU quota.
    pub throttled_usec: u64,
    /// Share of the last ten seconds in which some of it waited for resources; `None` if the kernel does not report it.
    pub pressure: Option<Pressure>,
}

/// One line printed by a process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogLine {
    /// Number of the line in the log, from 0; `None` for remarks on the log itself.
    #[serde(default)]
    pub number: Option<u64>,
    /// Time at which the shim read it.
    pub time: SystemTime,
    /// Node that printed it.
    pub node: String,
    /// `stdout` or `stderr`.
    pub stream: String,
    /// Text without the line end.
    pub line: String,
}

/// Position in a log to start reading from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogStart {
    /// The first line still available.
    First,
    /// This number of lines before the end.
    Last(usize),
    /// The end: only lines printed from now on.
    Now,
}

/// A servant run by an engine. Cheap to share; dropping it does not end the servant.
#[async_trait]
pub trait ServantHandle: Send + Sync + 'static {
    /// Returns the id of its spec.
    fn id(&self) -> &str;
    /// Returns a receiver of its state.
    fn state(&self) -> watch::Receiver<ContainerState>;
    /// Returns a receiver of node events from now on.
    fn events(&self) -> broadcast::Receiver<NodeEvent>;
    /// Returns the limits read back from the kernel.
    fn enforced_limits(&self) -> EnforcedLimits;
    /// Changes the limits that are given, keeps the others, and returns those then in force.
    async fn set_limits(&self, limits: Limits) -> Result<EnforcedLimits, crate::Error>;
    /// Returns the current usage.
    async fn usage(&self) -> Result<Usage, crate::Error>;
    /// Returns how long so far threads of its nodes, and of the processes that serve them, were runnable but waited for
    /// a CPU, summed up over threads; zero if that is not counted.
    async fn cpu_wait_time(&self) -> Duration {
        Duration::ZERO
    }
    /// Returns the names of the nodes that were ever started in it, or are about to be.
    fn nodes(&self) -> Vec<String>;
    /// Returns the run, as named by the caller ([`crate::spec::RUN`]), for which a node was last started; `None` if it
    /// was not named.
    fn run_id(&self, _node: &str) -> Option<String> {
        None
    }
    /// Starts another node; returns when its program is executed, or with the reason why it could not be.
    async fn start_node(&self, node: NodeSpec) -> Result<(), crate::Error>;
    /// Sends a signal to a node.
    async fn signal_node(&self, node: &str, signal: i32) -> Result<(), crate::Error>;
    /// Ends a node for good with a signal: it is not restarted, and the servant does not end with it, whatever its spec
    /// says. This holds from now on even if there is nothing to signal.
    async fn end_node(&self, node: &str, signal: i32) -> Result<(), crate::Error> {
        self.signal_node(node, signal).await
    }
    /// Runs a program beside the nodes, at a terminal of this size or with separate streams; returns when it is
    /// executed, or with the reason why it could not be. An engine that cannot do this refuses.
    async fn exec(&self, _spec: ExecSpec, _terminal: Option<TerminalSize>) -> Result<ExecSession, crate::Error> {
        let reason = "its engine runs no programs beside its nodes".to_owned();
        Err(crate::Error::Refused { id: self.id().to_owned(), reason })
    }
    /// Waits for a node to end; returns at once if it has ended already.
    async fn wait_node(&self, node: &str) -> Result<NodeExit, crate::Error>;
    /// Returns the last lines printed, at most `last`, oldest first; of one node only if `node` is given.
    async fn logs(&self, last: usize, node: Option<&str>) -> Vec<LogLine>;
    /// Streams every line printed, each exactly once; ends when the container has ended.
    fn follow(&self, from: LogStart) -> mpsc::Receiver<LogLine>;
    /// Ends its processes like [`stop`](Self::stop), which is to be called afterwards, and keeps its log beyond that,
    /// with `about`; returns `about` with the size of the log. [`Engine::read_kept_log`] reads it.
    async fn keep_log(&self, about: KeptLog) -> Result<KeptLog, crate::Error>;
    /// Stops it: SIGINT to the nodes, SIGTERM, then SIGKILL to all; returns when nothing is left (process, mount,
    /// cgroup, directory).
    async fn stop(&self) -> Result<(), crate::Error>;
}

/// A servant that ended while no daemon was running.
#[derive(Debug, Clone)]
pub struct EndedServant {
    /// Id of its spec.
    pub id: String,
    /// Final state; `None` if there is no record of it.
    pub state: Option<ContainerState>,
    /// Record with which [`Engine::sweep`] keeps its log; `None` if the log is removed with the rest.
    pub keep: Option<KeptLog>,
}

/// Servants found from an earlier daemon: each is in one of the three lists.
#[derive(Default)]
pub struct AdoptedServants {
    /// Servants that are running. Those that have not told their state yet are in state [`ContainerState::Creating`].
    pub running: Vec<Arc<dyn ServantHandle>>,
    /// Servants that have ended. Their remains are harmless until [`Engine::sweep`] removes them.
    pub ended: Vec<EndedServant>,
    /// Servants that could not be examined, each with the reason.
    pub failures: Vec<crate::Error>,
}

/// Starts and finds servants.
#[async_trait]
pub trait Engine: Send + Sync + 'static {
    /// Starts a servant; returns once its container runs and its nodes are started or starting.
    async fn start(&self, spec: Spec) -> Result<Arc<dyn ServantHandle>, crate::Error>;
    /// Finds the servants of an earlier daemon: running ones are adopted, the others reported. Robots wait for it, so
    /// nothing is removed, and none that does not answer is waited for long. Fails only if nothing can be examined.
    async fn adopt(&self) -> Result<AdoptedServants, crate::Error>;
    /// Removes the remains of servants that have ended, except for the logs to be kept; returns errors for what could
    /// not be removed or kept.
    async fn sweep(&self, ended: &[EndedServant]) -> Vec<crate::Error>;
    /// Lists the kept logs of ended servants, in no order, and removes those that a killed daemon left incomplete.
    async fn kept_logs(&self) -> Result<Vec<KeptLog>, crate::Error>;
    /// Returns the last lines of a kept log, at most `last`, oldest first; none if there is no such log.
    async fn read_kept_log(&self, id: &str, last: usize) -> Vec<LogLine>;
    /// Removes kept logs of the servants with these ids; returns errors for what could not be removed.
    async fn remove_kept_logs(&self, ids: Vec<String>) -> Vec<crate::Error>;
    /// Refuses grants that are not allowed or do not exist; returns descriptions of what servants will lack of them.
    fn check_grants(&self, grants: &Grants) -> Result<Vec<String>, crate::Error>;
}
