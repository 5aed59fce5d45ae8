//! The daemon's handle to a servant.

use std::fs::File;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::net::UnixStream as StdStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use api::KeptLog;
use api::exec::TerminalSize;
use async_trait::async_trait;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::unix::AsyncFd;
use tokio::net::UnixStream;
use tokio::sync::{broadcast, mpsc, watch};
use tokio::task::JoinHandle;
use tracing::Instrument;

use super::connection::{RequestSender, ServantView, ShimRequestError};
use super::{ended_logs, sweep};
use crate::Error;
use crate::cgroup::Cgroup;
use crate::engine::{ContainerState, EnforcedLimits, LogLine, LogStart, NodeEvent, NodeExit, ServantHandle, Usage};
use crate::exec::{ExecEnds, ExecSession, ExecSpec};
use crate::launch::{self, ExitRecord, LaunchRecord, RuntimeRecord};
use crate::local::GracePeriods;
use crate::logs::{self, DirectoryWatches};
use crate::netns::NetNs;
use crate::process::{self, ProcessIdentity};
use crate::protocol::Command;
use crate::spec::{Limits, NodeSpec};
use crate::sys;

/// Time beyond the grace period for a shim to finish its cleanup.
const FINISH: Duration = Duration::from_secs(20);
/// Time for a running shim to answer.
const ANSWER: Duration = Duration::from_secs(10);
/// Time for which an adoption waits for the state of a servant; a shim that needs longer tells it later.
const PROMPTLY: Duration = Duration::from_secs(1);

/// A servant of the local engine. Dropping it leaves the servant running.
#[derive(Debug)]
pub struct LocalServant {
    id: String,
    directory: PathBuf,
    kept_logs: PathBuf,
    network: Arc<NetNs>,
    cgroup: Cgroup,
    uid_range: (u32, u32),
    grace: GracePeriods,
    shim: Arc<OwnedFd>,
    requests: RequestSender,
    known: Arc<ServantView>,
    listener: JoinHandle<()>,
    /// Notifies followers of the log of changes.
    watches: Arc<DirectoryWatches>,
    /// Followers of the log that may still have a file to open.
    followers: watch::Sender<()>,
}

impl Drop for LocalServant {
    fn drop(&mut self) {
        self.listener.abort();
    }
}

/// Id and directory of a servant.
#[derive(Clone, Copy)]
pub(super) struct ServantLocation<'a> {
    pub id: &'a str,
    pub directory: &'a Path,
    /// Directory of the logs of ended servants.
    pub kept_logs: &'a Path,
    /// Notifies of changes in directories of servants.
    pub watches: &'a Arc<DirectoryWatches>,
}

/// Waits until a newly started shim reports that its container runs.
pub(super) async fn wait_until_running(
    launch: &LaunchRecord,
    place: ServantLocation<'_>,
    network: NetNs,
    control: StdStream,
    shim: ProcessIdentity,
) -> Result<Arc<LocalServant>, Error> {
    let ServantLocation { id, directory, .. } = place;
    let ended = || Error::Start { id: id.to_owned(), reason: start_failure_reason(directory) };
    let pidfd = shim.open_pidfd().map_err(Error::call("looking at the shim just started"))?.ok_or_else(ended)?;
    let runtime = RuntimeRecord {
        shim,
        cgroup: Cgroup::for_servant(&launch.parent, &launch.spec),
        shim_cgroup: Some(Cgroup::for_shim(&launch.parent, &launch.spec.id)),
        uid_range: launch.uid_range,
    };
    let grace = launch.grace;
    let servant = connect(place, network, control, &runtime, pidfd, grace)?;
    let mut state = servant.known.state.subscribe();
    let mut closed = servant.known.closed.subscribe();
    tokio::select! {
        biased;
        _ = state.wait_for(|state| *state != ContainerState::Creating) => {}
        _ = closed.wait_for(|closed| *closed) => {}
    }
    let reached = state.borrow().clone();
    match reached {
        ContainerState::Running => Ok(servant),
        // Its node has done its work already, and it ends as it would have a moment later.
        ContainerState::Stopped { .. } | ContainerState::Failed { .. } if servant.known.has_run() => Ok(servant),
        ContainerState::Creating => Err(ended()),
        ContainerState::Stopped { reason } | ContainerState::Failed { reason } => {
            Err(Error::Start { id: id.to_owned(), reason })
        }
    }
}

/// Connects to the shim of an earlier daemon. The servant is in state `Creating` until its shim answers, which may be
/// later.
pub(super) async fn adopt(
    place: ServantLocation<'_>,
    runtime: &RuntimeRecord,
    pidfd: OwnedFd,
) -> Result<Arc<LocalServant>, Error> {
    let ServantLocation { id, directory, .. } = place;
    let path = directory.join(launch::SPEC);
    let missing = || Error::Malformed { path: path.clone(), reason: "there is no launch record".into() };
    let launch: LaunchRecord = launch::read_record(&path)?.ok_or_else(missing)?;
    let opened = File::open(directory).map_err(Error::file("open", directory))?;
    // Through a descriptor, since the path itself may be longer than a socket address allows.
    let address = format!("/proc/self/fd/{}/{}", opened.as_raw_fd(), launch::SOCKET);
    let control = StdStream::connect(address).map_err(Error::file("connect to", directory.join(launch::SOCKET)))?;
    // The pid is certainly that of the process held by its pidfd.
    let network = NetNs::from_pid(runtime.shim.pid)?;
    let grace = launch.grace;
    let servant = connect(place, network, control, runtime, pidfd, grace)?;
    let mut state = servant.known.state.subscribe();
    let mut closed = servant.known.closed.subscribe();
    let silent = || Error::Ended { id: id.to_owned(), reason: "its shim does not answer".into() };
    let answered = async {
        tokio::select! {
            _ = state.wait_for(|state| *state != ContainerState::Creating) => Ok(()),
            _ = closed.wait_for(|closed| *closed) => Err(silent()),
        }
    };
    match tokio::time::timeout(PROMPTLY, answered).await {
        Ok(Err(closed)) => Err(closed),
        Ok(Ok(())) | Err(_) => Ok(servant),
    }
}

fn connect(
    place: ServantLocation<'_>,
    network: NetNs,
    control: StdStream,
    runtime: &RuntimeRecord,
    pidfd: OwnedFd,
    grace: GracePeriods,
) -> Result<Arc<LocalServant>, Error> {
    control.set_nonblocking(true).map_err(Error::call("talking to a shim"))?;
    let stream = UnixStream::from_std(control).map_err(Error::call("talking to a shim"))?;
    let (read, requests) = RequestSender::split(stream);
    let ServantLocation { id, directory, .. } = place;
    let known = Arc::new(ServantView::default());
    let shim = Arc::new(pidfd);
    let watching = watch_shim(known.clone(), read, directory.to_owned(), shim.clone());
    let listener = tokio::spawn(watching.in_current_span());
    Ok(Arc::new(LocalServant {
        id: id.to_owned(),
        directory: directory.to_owned(),
        kept_logs: place.kept_logs.to_owned(),
        network: Arc::new(network),
        cgroup: runtime.cgroup.clone(),
        uid_range: runtime.uid_range,
        grace,
        shim,
        requests,
        known,
        listener,
        watches: Arc::clone(place.watches),
        followers: watch::Sender::new(()),
    }))
}

/// Reads the shim's messages; if the connection ends without a final state, determines the state instead.
async fn watch_shim(
    known: Arc<ServantView>,
    read: tokio::net::unix::OwnedReadHalf,
    directory: PathBuf,
    shim: Arc<OwnedFd>,
) {
    known.read_messages(read).await;
    if let Err(error) = wait_for_end(&shim, FINISH).await {
        tracing::warn!(%error, "a shim closed its connection and did not end");
    }
    let exit: Option<ExitRecord> = launch::read_record(&directory.join(launch::EXIT)).unwrap_or_default();
    let over = known.state.borrow().is_over();
    if !over {
        let lost = || ContainerState::Failed { reason: shim_loss_reason(&directory) };
        let state = exit.map_or_else(lost, |exit| {
            known.nodes.send_replace(exit.nodes);
            exit.state
        });
        known.state.send_replace(state);
    }
}

/// Returns the reason why a shim ended without a final state.
fn shim_loss_reason(directory: &Path) -> String {
    let runtime: Option<RuntimeRecord> = launch::read_record(&directory.join(launch::RUNTIME)).unwrap_or_default();
    let cgroup = runtime.and_then(|runtime| runtime.shim_cgroup);
    match cgroup.filter(|cgroup| cgroup.oom_kills() > 0) {
        Some(cgroup) => {
            let limit = cgroup.enforced_limits().limits.memory.unwrap_or_default();
            format!(
                "its shim was killed: it needed more than its {limit} of memory, for parameters, registrations \
                 or what nodes do not read"
            )
        }
        None => "its shim was killed".into(),
    }
}

/// Waits until the process has ended, reaped or not.
async fn wait_for_end(pidfd: &OwnedFd, patience: Duration) -> std::io::Result<()> {
    if process::has_ended(pidfd) {
        return Ok(());
    }
    // Duplicated, since several tasks wait for the same process, and one descriptor can be registered only once.
    let own = pidfd.try_clone()?;
    // SAFETY: owned by the registration, and therefore open for as long as it lasts.
    let watched = unsafe { AsyncFd::register_with_interest(own, tokio::io::Interest::READABLE) }?;
    let _ready = tokio::time::timeout(patience, watched.readable()).await??;
    Ok(())
}

/// Returns the last error messages of a shim that ended.
fn start_failure_reason(directory: &Path) -> String {
    let exit: Option<ExitRecord> = launch::read_record(&directory.join(launch::EXIT)).unwrap_or_default();
    if let Some(ExitRecord { state: ContainerState::Failed { reason } | ContainerState::Stopped { reason }, .. }) = exit
    {
        return reason;
    }
    let log = std::fs::read_to_string(directory.join(launch::SHIM_LOG)).unwrap_or_default();
    match log.trim() {
        "" => "its shim ended without a word".into(),
        text => text.lines().rev().take(5).collect::<Vec<_>>().into_iter().rev().collect::<Vec<_>>().join("; "),
    }
}

impl LocalServant {
    async fn send_signal(&self, node: &str, signal: i32, last: bool) -> Result<(), Error> {
        if !self.known.nodes.borrow().contains_key(node) {
            return Err(Error::NoNode { id: self.id.clone(), node: node.to_owned() });
        }
        self.request_briefly(Command::SignalNode { node: node.to_owned(), signal, last }).await
    }

    /// Sends a request to the shim.
    async fn request(&self, command: Command) -> Result<(), Error> {
        let asked = self.requests.request(&self.known, command).await;
        asked.map_err(|unfulfilled| self.request_error(unfulfilled))
    }

    /// Sends a request that the shim answers at once.
    async fn request_briefly(&self, command: Command) -> Result<(), Error> {
        let asked = self.requests.request_with_timeout(&self.known, command, ANSWER);
        asked.await.map_err(|unfulfilled| self.request_error(unfulfilled))
    }

    fn request_error(&self, unfulfilled: ShimRequestError) -> Error {
        let id = self.id.clone();
        match unfulfilled {
            ShimRequestError::Refused(reason) => Error::Refused { id, reason },
            ShimRequestError::Silent => Error::Unanswered { id },
            ShimRequestError::Gone => self.ended_error(),
        }
    }

    fn ended_error(&self) -> Error {
        let reason = match &*self.known.state.borrow() {
            ContainerState::Stopped { reason } | ContainerState::Failed { reason } => reason.clone(),
            _ => "its shim does not answer".into(),
        };
        Error::Ended { id: self.id.clone(), reason }
    }

    fn ensure_running(&self) -> Result<(), Error> {
        match *self.known.state.borrow() {
            ContainerState::Running => Ok(()),
            _ => Err(self.ended_error()),
        }
    }

    /// Ends its processes; returns when its log is complete, and open wherever it is followed.
    async fn end(&self) {
        // On an error or timeout it is ending, gone, or about to be killed.
        let _ = tokio::time::timeout(ANSWER, self.request(Command::Stop)).await;
        let patience = self.grace.interrupt + self.grace.terminate + FINISH;
        if let Err(error) = wait_for_end(&self.shim, patience).await {
            tracing::warn!(%error, id = self.id, "a shim did not end its servant and is killed");
            let shim = self.shim.clone();
            let _ = privilege::run_sync(move || sys::pidfd_send_signal(shim.as_fd(), libc::SIGKILL));
            let _ = wait_for_end(&self.shim, FINISH).await;
        }
        // Its final messages are read, and its log is opened by its followers, before both are removed.
        let _ = tokio::time::timeout(ANSWER, wait_until_over(self.known.state.subscribe())).await;
        let _ = tokio::time::timeout(ANSWER, self.followers.closed()).await;
    }

    fn log_path(&self) -> PathBuf {
        self.directory.join(logs::FILE)
    }

    /// Returns its network namespace, for opening sockets in it. A namespace lives for as long as it is held, even
    /// after the servant.
    pub fn network(&self) -> &Arc<NetNs> {
        &self.network
    }

    /// Loads the state left by this daemon or an earlier one for the next; `None` if there is none.
    pub async fn load_handover<T: DeserializeOwned + Send + 'static>(&self) -> Result<Option<T>, Error> {
        let path = self.directory.join(launch::DAEMON);
        privilege::run(async move { launch::read_record(&path) }).await
    }

    /// Saves state for the next daemon, atomically replacing what was saved before. It is removed with the servant.
    pub async fn save_handover<T: Serialize + Send + 'static>(&self, what: T) -> Result<(), Error> {
        let path = self.directory.join(launch::DAEMON);
        privilege::run(async move { launch::write_record(&path, &what) }).await
    }

    /// Returns the first host uid (= gid) of its range and their number; uid 0 in the container is the first.
    pub fn uid_range(&self) -> (u32, u32) {
        self.uid_range
    }

    /// Returns the host pid of init.
    pub fn init_pid(&self) -> Result<i32, Error> {
        self.ensure_running()?;
        self.known.init_pid().ok_or_else(|| self.ended_error())
    }

    /// Returns the host pids of the node processes and all their children (without init).
    pub fn processes(&self) -> Result<Vec<i32>, Error> {
        let init = self.init_pid()?;
        let cgroup = self.cgroup.clone();
        let mut processes = privilege::run_sync(move || cgroup.processes());
        processes.retain(|pid| *pid != init);
        Ok(processes)
    }
}

/// Returns how long the threads of a process were runnable but waited for a CPU; zero if the kernel does not count it
/// (Documentation/scheduler/sched-stats.rst: nanoseconds on a CPU, nanoseconds waiting, timeslices).
fn thread_wait_time(pid: i32) -> Duration {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task"));
    let waited = threads.into_iter().flatten().flatten().filter_map(|thread| {
        let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().nth(1)?.parse::<u64>().ok()
    });
    Duration::from_nanos(waited.sum())
}

/// Completes when the servant has ended and its log is complete.
async fn wait_until_over(mut state: watch::Receiver<ContainerState>) {
    // An error means that the handle is gone: then nothing more is known either.
    let _ = state.wait_for(ContainerState::is_over).await;
}

#[async_trait]
impl ServantHandle for LocalServant {
    fn id(&self) -> &str {
        &self.id
    }

    fn state(&self) -> watch::Receiver<ContainerState> {
        self.known.state.subscribe()
    }

    fn events(&self) -> broadcast::Receiver<NodeEvent> {
        self.known.events.subscribe()
    }

    fn enforced_limits(&self) -> EnforcedLimits {
        self.known.enforced.borrow().clone()
    }

    async fn set_limits(&self, limits: Limits) -> Result<EnforcedLimits, Error> {
        self.request_briefly(Command::SetLimits(limits)).await?;
        Ok(self.enforced_limits())
    }

    async fn usage(&self) -> Result<Usage, Error> {
        self.ensure_running()?;
        let cgroup = self.cgroup.clone();
        Ok(privilege::run(async move { cgroup.usage() }).await)
    }

    async fn cpu_wait_time(&self) -> Duration {
        if self.init_pid().is_err() {
            return Duration::ZERO;
        }
        let cgroup = self.cgroup.clone();
        let waited = privilege::spawn_blocking(move || {
            let mut processes = cgroup.processes();
            // Nodes progress only if their Master and their peers do; this process is one of these.
            processes.extend(i32::try_from(std::process::id()));
            processes.into_iter().map(thread_wait_time).sum()
        });
        waited.await.unwrap_or_default()
    }

    fn nodes(&self) -> Vec<String> {
        self.known.nodes.borrow().keys().cloned().collect()
    }

    fn run_id(&self, node: &str) -> Option<String> {
        self.known.nodes.borrow().get(node)?.run.clone()
    }

    async fn start_node(&self, node: NodeSpec) -> Result<(), Error> {
        self.request(Command::StartNode(node)).await
    }

    async fn signal_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.send_signal(node, signal, false).await
    }

    async fn end_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.send_signal(node, signal, true).await
    }

    async fn exec(&self, spec: ExecSpec, terminal: Option<TerminalSize>) -> Result<ExecSession, Error> {
        self.ensure_running()?;
        if !self.known.can_exec() {
            let reason = "it was started by an earlier version of the daemon, which could not run programs in it; \
                          stop it, so that the robot gets a new one"
                .to_owned();
            return Err(Error::Refused { id: self.id.clone(), reason });
        }
        // Programs run as user 0 of the container.
        let user = self.uid_range.0;
        let (ends, theirs) = privilege::run_sync(move || ExecEnds::create(terminal, user))?;
        let session = ends.register().map_err(Error::call("watching an exec session"))?;
        let command = Command::Exec(ExecSpec { terminal: terminal.is_some(), ..spec });
        let asked = self.requests.request_with_descriptors(&self.known, command, theirs);
        let asked = tokio::time::timeout(ANSWER, asked).await.unwrap_or(Err(ShimRequestError::Silent));
        asked.map_err(|unfulfilled| self.request_error(unfulfilled))?;
        Ok(session)
    }

    async fn wait_node(&self, node: &str) -> Result<NodeExit, Error> {
        let mut nodes = self.known.nodes.subscribe();
        if !nodes.borrow().contains_key(node) {
            return Err(Error::NoNode { id: self.id.clone(), node: node.to_owned() });
        }
        let mut state = self.known.state.subscribe();
        let exit = |nodes: &watch::Receiver<_>| {
            let nodes: watch::Ref<'_, std::collections::BTreeMap<String, crate::protocol::NodeStatus>> = nodes.borrow();
            nodes.get(node).and_then(|status| status.current_exit().cloned())
        };
        loop {
            if let Some(exit) = exit(&nodes) {
                return Ok(exit);
            }
            tokio::select! {
                biased;
                _ = nodes.changed() => {}
                _ = state.wait_for(ContainerState::is_over) => return exit(&nodes).ok_or_else(|| self.ended_error()),
            }
        }
    }

    async fn logs(&self, last: usize, node: Option<&str>) -> Vec<LogLine> {
        logs::read_last(self.log_path(), last, node.map(str::to_owned)).await
    }

    fn follow(&self, from: LogStart) -> mpsc::Receiver<LogLine> {
        let path = self.log_path();
        let guard = self.followers.subscribe();
        logs::follow(&self.watches, path, from, wait_until_over(self.state()), guard)
    }

    async fn keep_log(&self, about: KeptLog) -> Result<KeptLog, Error> {
        self.end().await;
        ended_logs::keep_log(&self.kept_logs, &self.directory, about).await
    }

    async fn stop(&self) -> Result<(), Error> {
        self.end().await;
        sweep::sweep(&self.id, &self.directory).await
    }
}
