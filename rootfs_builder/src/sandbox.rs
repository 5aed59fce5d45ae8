//! Runs one program in a container and listens to it. Cancelled by dropping the future; what it leaves behind is
//! ended and removed before the build's directory goes.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use servant::container::{ContainerSpec, Mount, Profile};
use servant::engine::{LogStart, NodeExit};
use servant::sandbox::{Sandbox, Sandboxed};
use servant::spec::{Limits, NodeSpec};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use crate::error::{Error, IoAt};
use crate::process::Tail;
use crate::removal::Removals;

/// The directory of one build and the containers that run for it. Dropping it ends them and removes it.
pub(crate) struct Site {
    id: String,
    directory: PathBuf,
    sandbox: Arc<dyn Sandbox>,
    limits: Limits,
    removals: Removals,
    running: Arc<Mutex<Vec<JoinHandle<()>>>>,
}

/// What to run.
pub(crate) struct Run {
    /// Tells this run from others of the same build: `[a-z0-9-]`, short.
    pub(crate) name: &'static str,
    /// Which rights.
    pub(crate) profile: Profile,
    /// Trees, lowest first.
    pub(crate) layers: Vec<PathBuf>,
    /// Where changes go.
    pub(crate) writable: Option<PathBuf>,
    /// Directories made in `writable` for the compile user.
    pub(crate) owned: Vec<PathBuf>,
    /// Extra mounts.
    pub(crate) mounts: Vec<Mount>,
    /// All of its environment.
    pub(crate) environment: BTreeMap<String, String>,
    /// The program.
    pub(crate) argv: Vec<String>,
}

/// How it ended.
pub(crate) struct Finished {
    /// Exit code or signal.
    pub(crate) exit: NodeExit,
    /// First host uid of its range: what uid 0 inside was outside.
    pub(crate) uid_offset: u32,
    /// The last lines it printed.
    pub(crate) tail: Tail,
}

impl Finished {
    /// Whether it ended well.
    pub(crate) fn success(&self) -> bool {
        self.exit.code == Some(0)
    }

    /// Its last lines, and what is to be said about its end.
    pub(crate) fn last_words(&self) -> String {
        let text = self.tail.text();
        let about = if self.exit.out_of_memory {
            "it was killed for want of memory".to_owned()
        } else if let Some(reason) = &self.exit.exec_error {
            reason.clone()
        } else if let Some(signal) = self.exit.signal {
            format!("it was killed by signal {signal}")
        } else {
            return text;
        };
        if text.is_empty() {
            about
        } else {
            format!("{text}\n{about}")
        }
    }
}

impl Site {
    /// Makes the directory below `root`, named `id`. The caller may have put the pushed tree there already; it
    /// goes with all the rest. `limits` are those of each container.
    pub(crate) fn new(
        root: &Path,
        id: &str,
        sandbox: Arc<dyn Sandbox>,
        limits: Limits,
        removals: Removals,
    ) -> Result<Self, Error> {
        let directory = root.join(id);
        fs::create_dir_all(&directory).at("making", &directory)?;
        // What others may read in it is nobody's business out here.
        crate::install::set_mode(&directory, 0o700)?;
        Ok(Self {
            id: id.to_owned(),
            directory,
            sandbox,
            limits,
            removals,
            running: Arc::default(),
        })
    }

    /// A new directory below the build's own.
    pub(crate) fn directory(&self, name: &str) -> Result<PathBuf, Error> {
        let path = self.directory.join(name);
        fs::create_dir_all(&path).at("making", &path)?;
        Ok(path)
    }

    /// A new directory of this build, whatever else is called `name`.
    pub(crate) fn fresh(&self, name: &str) -> Result<PathBuf, Error> {
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

    /// Runs it to its end; each line it prints goes to `lines` as it comes.
    pub(crate) async fn run(
        &self,
        run: Run,
        mut on_line: impl FnMut(&str),
    ) -> Result<Finished, Error> {
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
        // Held by this future alone: when it is dropped, the task below sees it and ends the container.
        let (_alive, cancelled) = oneshot::channel::<()>();
        let task = tokio::spawn(to_its_end(
            self.sandbox.clone(),
            spec,
            run.name,
            line,
            cancelled,
            result,
        ));
        self.running
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(task);
        let mut tail = Tail::default();
        while let Some(line) = lines.recv().await {
            tail.push(&line);
            on_line(&line);
        }
        match finished.await {
            Ok(Ok((exit, uid_offset))) => Ok(Finished {
                exit,
                uid_offset,
                tail,
            }),
            Ok(Err(error)) => Err(error.into()),
            Err(_) => Err(Error::Inside {
                what: "the sandbox",
                last_lines: tail.text(),
            }),
        }
    }
}

type Outcome = Result<(NodeExit, u32), servant::Error>;

async fn to_its_end(
    sandbox: Arc<dyn Sandbox>,
    spec: ContainerSpec,
    node: &'static str,
    line: mpsc::Sender<String>,
    cancelled: oneshot::Receiver<()>,
    result: oneshot::Sender<Outcome>,
) {
    // Starting is not interrupted: a container half-started would have no handle to end it by.
    let Sandboxed {
        servant,
        uid_offset,
    } = match sandbox.sandbox(spec).await {
        Ok(sandboxed) => sandboxed,
        Err(error) => {
            let _ = result.send(Err(error));
            return;
        }
    };
    let mut log = servant.follow(LogStart::First);
    let listener = async {
        while let Some(entry) = log.recv().await {
            // A listener that went away must not stop the reading: the program would block on a full pipe.
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

/// What a container of a build gets where nothing else was configured: half of the machine's memory, and cores when
/// servants leave some.
pub(crate) fn default_limits() -> Limits {
    Limits {
        cpu_weight: Some(20),
        memory: servant::host::memory().map(|bytes| bytes / 2),
        pids: Some(4096),
        ..Limits::default()
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        let running =
            std::mem::take(&mut *self.running.lock().unwrap_or_else(PoisonError::into_inner));
        let (id, directory) = (
            std::mem::take(&mut self.id),
            std::mem::take(&mut self.directory),
        );
        self.removals.start(id, running, directory);
    }
}

#[cfg(test)]
mod tests;
