//! A servant as the daemon holds it.

use std::fs::File;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::net::UnixStream as StdStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::unix::AsyncFd;
use tokio::net::UnixStream;
use tokio::sync::{broadcast, mpsc, watch};
use tokio::task::JoinHandle;

use super::connection::{Known, Requests, Unfulfilled};
use super::sweep;
use crate::Error;
use crate::cgroup::Cgroup;
use crate::engine::{
    ContainerState, Enforced, LogLine, LogStart, NodeEvent, NodeExit, Servant, Usage,
};
use crate::launch::{self, Exit, Launch, Runtime};
use crate::local::Grace;
use crate::logs::{self, Watches};
use crate::netns::NetNs;
use crate::process::{self, Identity};
use crate::protocol::Command;
use crate::spec::{Limits, NodeSpec};
use crate::sys;

/// Beyond the grace time, for a shim to finish what it does at the end.
const FINISH: Duration = Duration::from_secs(20);
/// For a shim that runs to answer.
const ANSWER: Duration = Duration::from_secs(10);

/// A servant of the local engine. Dropping it leaves the servant as it is.
#[derive(Debug)]
pub struct LocalServant {
    id: String,
    directory: PathBuf,
    network: Arc<NetNs>,
    cgroup: Cgroup,
    uid_range: (u32, u32),
    grace: Grace,
    shim: Arc<OwnedFd>,
    requests: Requests,
    known: Arc<Known>,
    listener: JoinHandle<()>,
    /// What tells followers of the log that it has changed.
    watches: Arc<Watches>,
    /// Followers of the log that may still have a file to open.
    followers: watch::Sender<()>,
}

impl Drop for LocalServant {
    fn drop(&mut self) {
        self.listener.abort();
    }
}

/// Where a servant lives.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    pub id: &'a str,
    pub directory: &'a Path,
    /// What tells of changes in directories of servants.
    pub watches: &'a Arc<Watches>,
}

/// Waits for a shim just started to say that its container runs.
pub(super) async fn started(
    launch: &Launch,
    place: Place<'_>,
    network: NetNs,
    control: StdStream,
    shim: Identity,
) -> Result<Arc<LocalServant>, Error> {
    let Place { id, directory, .. } = place;
    let ended = || Error::Start {
        id: id.to_owned(),
        reason: last_words(directory),
    };
    let pidfd = shim
        .open()
        .map_err(Error::call("looking at the shim just started"))?
        .ok_or_else(ended)?;
    let runtime = Runtime {
        shim,
        cgroup: Cgroup::planned(&launch.parent, &launch.spec),
        shim_cgroup: Some(Cgroup::of_shim(&launch.parent, &launch.spec.id)),
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
        ContainerState::Creating => Err(ended()),
        ContainerState::Stopped { reason } | ContainerState::Failed { reason } => {
            Err(Error::Start {
                id: id.to_owned(),
                reason,
            })
        }
    }
}

/// Connects to the shim that an earlier daemon left.
pub(super) async fn adopt(
    place: Place<'_>,
    runtime: &Runtime,
    pidfd: OwnedFd,
) -> Result<Arc<LocalServant>, Error> {
    let Place { id, directory, .. } = place;
    let path = directory.join(launch::SPEC);
    let missing = || Error::Malformed {
        path: path.clone(),
        reason: "there is no launch record".into(),
    };
    let launch: Launch = launch::read(&path)?.ok_or_else(missing)?;
    let opened = File::open(directory).map_err(Error::file("open", directory))?;
    // Through a descriptor: the path itself may be longer than an address can be.
    let address = format!("/proc/self/fd/{}/{}", opened.as_raw_fd(), launch::SOCKET);
    let control = StdStream::connect(address)
        .map_err(Error::file("connect to", directory.join(launch::SOCKET)))?;
    // The pid is that of the process held by its pidfd.
    let network = NetNs::from_pid(runtime.shim.pid)?;
    let grace = launch.grace;
    let servant = connect(place, network, control, runtime, pidfd, grace)?;
    let mut state = servant.known.state.subscribe();
    let mut closed = servant.known.closed.subscribe();
    let silent = || Error::Ended {
        id: id.to_owned(),
        reason: "its shim does not answer".into(),
    };
    let answered = async {
        tokio::select! {
            _ = state.wait_for(|state| *state != ContainerState::Creating) => Ok(()),
            _ = closed.wait_for(|closed| *closed) => Err(silent()),
        }
    };
    tokio::time::timeout(ANSWER, answered)
        .await
        .map_err(|_| silent())??;
    Ok(servant)
}

fn connect(
    place: Place<'_>,
    network: NetNs,
    control: StdStream,
    runtime: &Runtime,
    pidfd: OwnedFd,
    grace: Grace,
) -> Result<Arc<LocalServant>, Error> {
    control
        .set_nonblocking(true)
        .map_err(Error::call("talking to a shim"))?;
    let stream = UnixStream::from_std(control).map_err(Error::call("talking to a shim"))?;
    let (read, requests) = Requests::split(stream);
    let Place { id, directory, .. } = place;
    let known = Arc::new(Known::default());
    let shim = Arc::new(pidfd);
    let listener = tokio::spawn(watch_over(
        known.clone(),
        read,
        directory.to_owned(),
        shim.clone(),
    ));
    Ok(Arc::new(LocalServant {
        id: id.to_owned(),
        directory: directory.to_owned(),
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

/// Listens to the shim; when it falls silent without having said how the servant ended, says so in its place.
async fn watch_over(
    known: Arc<Known>,
    read: tokio::net::unix::OwnedReadHalf,
    directory: PathBuf,
    shim: Arc<OwnedFd>,
) {
    known.listen(read).await;
    if let Err(error) = wait_for_end(&shim, FINISH).await {
        tracing::warn!(%error, "a shim closed its connection and did not end");
    }
    let exit: Option<Exit> = launch::read(&directory.join(launch::EXIT)).unwrap_or_default();
    let over = known.state.borrow().is_over();
    if !over {
        let lost = || ContainerState::Failed {
            reason: how_it_was_lost(&directory),
        };
        let state = exit.map_or_else(lost, |exit| {
            known.nodes.send_replace(exit.nodes);
            exit.state
        });
        known.state.send_replace(state);
    }
}

/// Why a shim ended without a word.
fn how_it_was_lost(directory: &Path) -> String {
    let runtime: Option<Runtime> =
        launch::read(&directory.join(launch::RUNTIME)).unwrap_or_default();
    let cgroup = runtime.and_then(|runtime| runtime.shim_cgroup);
    match cgroup.filter(|cgroup| cgroup.oom_kills() > 0) {
        Some(cgroup) => {
            let limit = cgroup.enforced().limits.memory.unwrap_or_default();
            format!(
                "its shim was killed: it needed more than its {limit} bytes of memory, for parameters, registrations or what \
                 nodes do not read"
            )
        }
        None => "its shim was killed".into(),
    }
}

/// Until the process has ended, reaped or not.
async fn wait_for_end(pidfd: &OwnedFd, patience: Duration) -> std::io::Result<()> {
    if process::has_ended(pidfd) {
        return Ok(());
    }
    // A descriptor of its own: several wait for the same end, and one descriptor can be watched only once.
    let own = pidfd.try_clone()?;
    // SAFETY: owned by what watches it, and so open for as long as it is watched.
    let watched = unsafe { AsyncFd::register_with_interest(own, tokio::io::Interest::READABLE) }?;
    let _ready = tokio::time::timeout(patience, watched.readable()).await??;
    Ok(())
}

/// What the shim complained of before it ended.
fn last_words(directory: &Path) -> String {
    let exit: Option<Exit> = launch::read(&directory.join(launch::EXIT)).unwrap_or_default();
    if let Some(Exit {
        state: ContainerState::Failed { reason } | ContainerState::Stopped { reason },
        ..
    }) = exit
    {
        return reason;
    }
    let log = std::fs::read_to_string(directory.join(launch::SHIM_LOG)).unwrap_or_default();
    match log.trim() {
        "" => "its shim ended without a word".into(),
        text => text
            .lines()
            .rev()
            .take(5)
            .collect::<Vec<_>>()
            .into_iter()
            .rev()
            .collect::<Vec<_>>()
            .join("; "),
    }
}

impl LocalServant {
    async fn send_signal(&self, node: &str, signal: i32, last: bool) -> Result<(), Error> {
        if !self.known.nodes.borrow().contains_key(node) {
            return Err(Error::NoNode {
                id: self.id.clone(),
                node: node.to_owned(),
            });
        }
        self.ask_briefly(Command::SignalNode {
            node: node.to_owned(),
            signal,
            last,
        })
        .await
    }

    /// Asks the shim.
    async fn ask(&self, command: Command) -> Result<(), Error> {
        let asked = self.requests.ask(&self.known, command).await;
        asked.map_err(|unfulfilled| self.error(unfulfilled))
    }

    /// Asks the shim what takes it no time.
    async fn ask_briefly(&self, command: Command) -> Result<(), Error> {
        let asked = self.requests.ask_within(&self.known, command, ANSWER);
        asked.await.map_err(|unfulfilled| self.error(unfulfilled))
    }

    fn error(&self, unfulfilled: Unfulfilled) -> Error {
        let id = self.id.clone();
        match unfulfilled {
            Unfulfilled::Refused(reason) => Error::Refused { id, reason },
            Unfulfilled::Silent => Error::Unanswered { id },
            Unfulfilled::Gone => self.ended(),
        }
    }

    fn ended(&self) -> Error {
        let reason = match &*self.known.state.borrow() {
            ContainerState::Stopped { reason } | ContainerState::Failed { reason } => {
                reason.clone()
            }
            _ => "its shim does not answer".into(),
        };
        Error::Ended {
            id: self.id.clone(),
            reason,
        }
    }

    fn check_runs(&self) -> Result<(), Error> {
        match *self.known.state.borrow() {
            ContainerState::Running => Ok(()),
            _ => Err(self.ended()),
        }
    }

    fn log_path(&self) -> PathBuf {
        self.directory.join(logs::FILE)
    }

    /// Its network namespace, to open sockets in; a namespace lives for as long as it is held, also after the servant.
    pub fn network(&self) -> &Arc<NetNs> {
        &self.network
    }

    /// What this daemon or an earlier one has left for the next; none where there is nothing.
    pub async fn left<T: DeserializeOwned + Send + 'static>(&self) -> Result<Option<T>, Error> {
        let path = self.directory.join(launch::DAEMON);
        privilege::run(async move { launch::read(&path) }).await
    }

    /// Leaves this for the next daemon in place of what was left before, whole or not at all. It goes with the servant.
    pub async fn leave<T: Serialize + Send + 'static>(&self, what: T) -> Result<(), Error> {
        let path = self.directory.join(launch::DAEMON);
        privilege::run(async move { launch::write(&path, &what) }).await
    }

    /// First host uid (= gid) of its range and how many; uid 0 inside is the first.
    pub fn uid_range(&self) -> (u32, u32) {
        self.uid_range
    }

    /// Pid of init on this host.
    pub fn init(&self) -> Result<i32, Error> {
        self.check_runs()?;
        self.known.init().ok_or_else(|| self.ended())
    }

    /// Pids on this host of the node processes and all their children (not of init).
    pub fn processes(&self) -> Result<Vec<i32>, Error> {
        let init = self.init()?;
        let cgroup = self.cgroup.clone();
        let mut processes = privilege::now(move || cgroup.processes());
        processes.retain(|pid| *pid != init);
        Ok(processes)
    }
}

/// How long the threads of a process could have run and others had the cores; nothing where the kernel does not count it
/// (Documentation/scheduler/sched-stats.rst: nanoseconds on a core, nanoseconds waiting, slices).
fn waited(pid: i32) -> Duration {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task"));
    let waited = threads
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|thread| {
            let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
            text.split_whitespace().nth(1)?.parse::<u64>().ok()
        });
    Duration::from_nanos(waited.sum())
}

/// Completes when the servant has ended and its log is complete.
async fn ended(mut state: watch::Receiver<ContainerState>) {
    // The other side is gone with its handle: then nothing more is known either.
    let _ = state.wait_for(ContainerState::is_over).await;
}

#[async_trait]
impl Servant for LocalServant {
    fn id(&self) -> &str {
        &self.id
    }

    fn state(&self) -> watch::Receiver<ContainerState> {
        self.known.state.subscribe()
    }

    fn events(&self) -> broadcast::Receiver<NodeEvent> {
        self.known.events.subscribe()
    }

    fn enforced(&self) -> Enforced {
        self.known.enforced.borrow().clone()
    }

    async fn set_limits(&self, limits: Limits) -> Result<Enforced, Error> {
        self.ask_briefly(Command::SetLimits(limits)).await?;
        Ok(self.enforced())
    }

    async fn usage(&self) -> Result<Usage, Error> {
        self.check_runs()?;
        let cgroup = self.cgroup.clone();
        Ok(privilege::run(async move { cgroup.usage() }).await)
    }

    async fn waited(&self) -> Duration {
        if self.init().is_err() {
            return Duration::ZERO;
        }
        let cgroup = self.cgroup.clone();
        let waited = privilege::blocking(move || {
            let mut processes = cgroup.processes();
            // Nodes go on only when their Master and whoever is connected to them do.
            processes.extend(i32::try_from(std::process::id()));
            processes.into_iter().map(waited).sum()
        });
        waited.await.unwrap_or_default()
    }

    fn nodes(&self) -> Vec<String> {
        self.known.nodes.borrow().keys().cloned().collect()
    }

    fn run(&self, node: &str) -> Option<String> {
        self.known.nodes.borrow().get(node)?.run.clone()
    }

    async fn start_node(&self, node: NodeSpec) -> Result<(), Error> {
        self.ask(Command::StartNode(node)).await
    }

    async fn signal_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.send_signal(node, signal, false).await
    }

    async fn end_node(&self, node: &str, signal: i32) -> Result<(), Error> {
        self.send_signal(node, signal, true).await
    }

    async fn wait_node(&self, node: &str) -> Result<NodeExit, Error> {
        let mut nodes = self.known.nodes.subscribe();
        if !nodes.borrow().contains_key(node) {
            return Err(Error::NoNode {
                id: self.id.clone(),
                node: node.to_owned(),
            });
        }
        let mut state = self.known.state.subscribe();
        let exit = |nodes: &watch::Receiver<_>| {
            let nodes: watch::Ref<
                '_,
                std::collections::BTreeMap<String, crate::protocol::NodeStatus>,
            > = nodes.borrow();
            nodes.get(node).and_then(|status| status.ended().cloned())
        };
        loop {
            if let Some(exit) = exit(&nodes) {
                return Ok(exit);
            }
            tokio::select! {
                biased;
                _ = nodes.changed() => {}
                _ = state.wait_for(ContainerState::is_over) => return exit(&nodes).ok_or_else(|| self.ended()),
            }
        }
    }

    async fn logs(&self, last: usize, node: Option<&str>) -> Vec<LogLine> {
        logs::last(self.log_path(), last, node.map(str::to_owned)).await
    }

    fn follow(&self, from: LogStart) -> mpsc::Receiver<LogLine> {
        let path = self.log_path();
        let guard = self.followers.subscribe();
        logs::follow(&self.watches, path, from, ended(self.state()), guard)
    }

    async fn stop(&self) -> Result<(), Error> {
        // Refused or unanswered: it is ending, or gone, or about to be ended by force.
        let _ = tokio::time::timeout(ANSWER, self.ask(Command::Stop)).await;
        let patience = self.grace.interrupt + self.grace.terminate + FINISH;
        if let Err(error) = wait_for_end(&self.shim, patience).await {
            tracing::warn!(%error, id = self.id, "a shim did not end its servant and is killed");
            let shim = self.shim.clone();
            let _ = privilege::now(move || sys::pidfd_send_signal(shim.as_fd(), libc::SIGKILL));
            let _ = wait_for_end(&self.shim, FINISH).await;
        }
        // Its last words are taken in, and its log opened by those who read it, before both are swept away.
        let _ = tokio::time::timeout(ANSWER, ended(self.known.state.subscribe())).await;
        let _ = tokio::time::timeout(ANSWER, self.followers.closed()).await;
        sweep::sweep(&self.id, &self.directory).await
    }
}
