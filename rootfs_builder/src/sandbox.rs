//! Runs a program in a container and receives its output. To cancel, drop the future: the container is ended and
//! removed before the build's directory is.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use servant::container::{ContainerSpec, Mount, Profile};
use servant::engine::{LogStart, NodeExit};
use servant::sandbox::{Sandbox, SandboxContainer};
use servant::spec::{Limits, NodeSpec, Size};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use crate::error::{Error, IoContext};
use crate::process::LastLines;
use crate::removal::PendingRemovals;

/// Directory of a build and the containers that run for it, which are ended and removed on drop.
pub(crate) struct BuildSite {
    id: String,
    directory: PathBuf,
    sandbox: Arc<dyn Sandbox>,
    limits: Limits,
    removals: PendingRemovals,
    running: Arc<Mutex<Vec<JoinHandle<()>>>>,
}

/// Program to run in a container.
pub(crate) struct SandboxRun {
    /// Name of this run, unique within the build: `[a-z0-9-]`, short.
    pub(crate) name: &'static str,
    /// Security profile.
    pub(crate) profile: Profile,
    /// Trees, lowest first.
    pub(crate) layers: Vec<PathBuf>,
    /// Upper directory for changes.
    pub(crate) writable: Option<PathBuf>,
    /// Directories created in `writable` for the compiling user.
    pub(crate) owned: Vec<PathBuf>,
    /// Additional mounts.
    pub(crate) mounts: Vec<Mount>,
    /// Complete environment.
    pub(crate) environment: BTreeMap<String, String>,
    /// Command line.
    pub(crate) argv: Vec<String>,
}

/// Result of a run.
pub(crate) struct RunResult {
    /// Exit code or signal.
    pub(crate) exit: NodeExit,
    /// First host uid of the container: the host uid of its root.
    pub(crate) uid_offset: u32,
    /// Last lines of its output.
    pub(crate) tail: LastLines,
}

impl RunResult {
    /// Returns whether it exited successfully.
    pub(crate) fn success(&self) -> bool {
        self.exit.code == Some(0)
    }

    /// Returns its last lines, with a description of how it ended.
    pub(crate) fn last_output(&self) -> String {
        let text = self.tail.text();
        let about = if self.exit.out_of_memory {
            "it was killed because it ran out of memory".to_owned()
        } else if let Some(reason) = &self.exit.exec_error {
            reason.clone()
        } else if let Some(signal) = self.exit.signal {
            format!("it was killed by signal {signal}")
        } else {
            return text;
        };
        if text.is_empty() { about } else { format!("{text}\n{about}") }
    }
}

impl BuildSite {
    /// Creates the directory below `root`, named `id`. The caller may already have put the pushed tree there; it is
    /// removed with the rest. `limits` apply to each container.
    pub(crate) fn new(
        root: &Path,
        id: &str,
        sandbox: Arc<dyn Sandbox>,
        limits: Limits,
        removals: PendingRemovals,
    ) -> Result<Self, Error> {
        let directory = create_build_directory(root, id)?;
        Ok(Self { id: id.to_owned(), directory, sandbox, limits, removals, running: Arc::default() })
    }

    /// Returns the id of the build.
    pub(crate) fn id(&self) -> &str {
        &self.id
    }

    /// Creates a new directory of this build, even if others are called `name`.
    pub(crate) fn fresh_directory(&self, name: &str) -> Result<PathBuf, Error> {
        let mut number = 1;
        loop {
            let path = self.directory.join(format!("{name}-{number}"));
            match fs::create_dir(&path) {
                Ok(()) => return Ok(path),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
                Err(error) => return Err(Error::io("making", path, error)),
            }
        }
    }

    /// Lets the directory stay until `packing` has ended, which reads trees in it.
    pub(crate) fn keep_while(&self, packing: Vec<JoinHandle<Result<(), Error>>>) {
        let Ok(runtime) = tokio::runtime::Handle::try_current() else {
            return;
        };
        let waiting = packing.into_iter().map(|archive| {
            runtime.spawn(async move {
                if let Ok(Err(error)) = archive.await {
                    tracing::info!("a layer of a build that was cancelled is not kept: {error}");
                }
            })
        });
        self.running.lock().unwrap_or_else(PoisonError::into_inner).extend(waiting);
    }

    /// Runs a program to its end; each line of its output is passed to `on_line`.
    pub(crate) async fn run(&self, run: SandboxRun, mut on_line: impl FnMut(&str)) -> Result<RunResult, Error> {
        let spec = ContainerSpec {
            id: format!("{}-{}", self.id, run.name),
            layers: run.layers,
            writable: run.writable,
            profile: run.profile,
            limits: self.limits,
            environment: run.environment,
            nodes: vec![NodeSpec {
                name: run.name.to_owned(),
                argv: run.argv,
                environment: BTreeMap::new(),
                directory: String::new(),
                respawn: false,
                respawn_delay: 0.0,
                required: true,
            }],
            owned_directories: run.owned,
            mounts: run.mounts,
            hosts: Vec::new(),
            resident: serde_json::Value::Null,
        };
        let (line, mut lines) = mpsc::channel(256);
        let (result, finished) = oneshot::channel();
        // Held by this future only: when it is dropped, the task below notices and ends the container.
        let (_alive, cancelled) = oneshot::channel::<()>();
        let task = tokio::spawn(run_to_end(self.sandbox.clone(), spec, run.name, line, cancelled, result));
        self.running.lock().unwrap_or_else(PoisonError::into_inner).push(task);
        let mut tail = LastLines::default();
        while let Some(line) = lines.recv().await {
            tail.push(&line);
            on_line(&line);
        }
        match finished.await {
            Ok(Ok((exit, uid_offset))) => Ok(RunResult { exit, uid_offset, tail }),
            Ok(Err(error)) => Err(error.into()),
            Err(_) => Err(Error::Inside { what: "the sandbox", last_lines: tail.text() }),
        }
    }
}

/// Creates the directory of a build below `root`, unless it exists, and returns it.
pub(crate) fn create_build_directory(root: &Path, id: &str) -> Result<PathBuf, Error> {
    let directory = root.join(id);
    fs::create_dir_all(&directory).io_context("making", &directory)?;
    // Files that are readable in the container must not be readable for others on the host.
    crate::modes::set_mode(&directory, 0o700)?;
    Ok(directory)
}

type Outcome = Result<(NodeExit, u32), servant::Error>;

async fn run_to_end(
    sandbox: Arc<dyn Sandbox>,
    spec: ContainerSpec,
    node: &'static str,
    line: mpsc::Sender<String>,
    cancelled: oneshot::Receiver<()>,
    result: oneshot::Sender<Outcome>,
) {
    // The start is not interrupted: a half-started container has no handle to end it by.
    let SandboxContainer { servant, uid_offset } = match sandbox.start_sandbox(spec).await {
        Ok(sandboxed) => sandboxed,
        Err(error) => {
            let _ = result.send(Err(error));
            return;
        }
    };
    let mut log = servant.follow(LogStart::First);
    let listener = async {
        while let Some(entry) = log.recv().await {
            // Reading must continue without a listener: otherwise the program would block on a full pipe.
            let _ = line.send(entry.line).await;
        }
    };
    let work = async {
        let exit = tokio::select! {
            exit = servant.wait_node(node) => exit,
            _ = cancelled => Err(servant::Error::Ended { id: servant.id().to_owned(), reason: "cancelled".into() }),
        };
        let stopped = servant.stop().await;
        let exit = exit?;
        stopped.map(|()| (exit, uid_offset))
    };
    let (_, outcome) = tokio::join!(listener, work);
    let _ = result.send(outcome);
}

/// Default limits of a build's container: half of the machine's memory, and the cores that servants leave idle.
pub(crate) fn default_limits() -> Limits {
    Limits {
        cpu_weight: Some(20),
        memory: servant::host::total_memory().map(|bytes| Size(bytes / 2)),
        pids: Some(4096),
        ..Limits::default()
    }
}

impl Drop for BuildSite {
    fn drop(&mut self) {
        let running = std::mem::take(&mut *self.running.lock().unwrap_or_else(PoisonError::into_inner));
        let (id, directory) = (std::mem::take(&mut self.id), std::mem::take(&mut self.directory));
        self.removals.start(id, running, directory);
    }
}

#[cfg(test)]
mod tests;
