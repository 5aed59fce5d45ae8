//! Creation of the container, in a process that exits afterwards.
//!
//! libcontainer must run in a process with one thread, changes that process's working directory and dumpable flag, and
//! uses memory that would otherwise stay for the servant's whole life. So the shim forks, the child creates the
//! container as its own *sibling* (init's parent is the shim), and exits. The mount namespace in which the layers were
//! assembled ends with it; the container has its own copy.
//!
//! Moving a process into a cgroup can take as long as everything else (the kernel waits for an RCU grace period before
//! the first move in a while), so the shim moves the creator while that assembles the layers:
//!
//! ```text
//!   shim      fork ── move the creator ──▶ gate ── event loop
//!   creator     └──── layers, config ───▶ gate ── libcontainer, in the cgroup ── end
//! ```

use std::collections::HashMap;
use std::ffi::CString;
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use libcontainer::container::builder::ContainerBuilder;
use libcontainer::error::LibcontainerError;
use libcontainer::syscall::syscall::SyscallType;
use libcontainer::workload::{Executor, ExecutorError, ExecutorSetEnvsError, ExecutorValidationError};
use nix::sys::socket::{AddressFamily, MsgFlags, SockFlag, SockType, send, socketpair};
use nix::sys::stat::{Mode, umask};
use nix::unistd::ForkResult;
use oci_spec::OciSpecError;
use serde::{Deserialize, Serialize};

use crate::Error;
use crate::bundle;
use crate::launch::LaunchRecord;
use crate::rootfs::{Rootfs, make_skeleton};

/// A line of the creator's report. The last one counts.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum CreatorReport {
    /// Init runs.
    Created {
        /// Host pid of init.
        init: i32,
    },
    /// An error, possibly followed by others.
    Failed(String),
}

/// The creating process.
#[derive(Debug)]
pub(super) struct Creator {
    /// Pipe on which it reports.
    pub(super) report: OwnedFd,
}

/// The creating process before it has created any process: it waits until it is in its cgroup.
#[derive(Debug)]
pub(super) struct PausedCreator {
    pub(super) pid: u32,
    report: OwnedFd,
    /// Lets it continue; if closed without a message, it exits.
    go: OwnedFd,
}

impl PausedCreator {
    /// Kills it. Once this returns it writes nothing any more, so that the servant's directory can be removed.
    pub(super) fn kill(self) {
        let pid = nix::unistd::Pid::from_raw(self.pid as i32);
        // Our own child, not reaped yet: the pid is certainly its own.
        let _ = nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGKILL);
        let _ = nix::sys::wait::waitpid(pid, None);
    }

    /// Lets it continue.
    pub(super) fn resume(self) -> Creator {
        // If nobody listens, it has failed and exited, and says so in its report. That must not kill us (SIGPIPE).
        let _ = send(self.go.as_raw_fd(), b".", MsgFlags::MSG_NOSIGNAL);
        Creator { report: self.report }
    }
}

/// Forks the creator. The calling process must have one thread.
pub(super) fn fork(directory: &Path, launch: &LaunchRecord, socket: OwnedFd) -> Result<PausedCreator, Error> {
    let (report, write) = nix::unistd::pipe2(nix::fcntl::OFlag::O_CLOEXEC).map_err(Error::nix("pipe"))?;
    let (wait, go) = socketpair(AddressFamily::Unix, SockType::Stream, None, SockFlag::SOCK_CLOEXEC)
        .map_err(Error::nix("socketpair for the creator"))?;
    // SAFETY: one thread, so that the child may do anything its parent might.
    match unsafe { nix::unistd::fork() }.map_err(Error::nix("fork of the creator"))? {
        ForkResult::Parent { child } => Ok(PausedCreator { pid: child.as_raw() as u32, report, go }),
        ForkResult::Child => {
            drop((report, go));
            let write = Arc::new(File::from(write));
            // Errors that libcontainer meets in its own children are only logged.
            let _ = tracing::subscriber::set_global_default(ErrorReporter(write.clone()));
            let outcome =
                match stage(directory, launch).and_then(|staged| create(directory, launch, staged, socket, wait)) {
                    Ok(init) => CreatorReport::Created { init },
                    Err(error) => CreatorReport::Failed(chain(&error)),
                };
            report_line(&write, &outcome);
            // SAFETY: ends the child without running the exit handlers registered by the parent.
            unsafe { libc::_exit(0) }
        }
    }
}

/// Everything the creator has prepared.
struct StagedContainer {
    /// The static init, opened before anything of the servant was mounted.
    init: File,
    /// Directory of libcontainer's records. They are not needed later, and writing them to a disk took up to a fifth of
    /// the creation: this one is in memory, and disappears with the creator's mount namespace.
    records: PathBuf,
    /// The configuration names it by its descriptor number.
    _user_namespace: OwnedFd,
}

/// Reason why the creator does not create the container.
#[derive(Debug, thiserror::Error)]
enum CreatorError {
    #[error(transparent)]
    Files(#[from] Error),
    /// The container cannot be described.
    #[error(transparent)]
    Config(#[from] OciSpecError),
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    #[error("the shim did not move its creator into the cgroup")]
    NotMoved,
    /// `/dev/null` cannot be opened.
    #[error(transparent)]
    Null(io::Error),
    #[error(transparent)]
    Libcontainer(Box<LibcontainerError>),
    #[error("libcontainer does not know init's pid")]
    NoPid,
}

impl From<LibcontainerError> for CreatorError {
    fn from(error: LibcontainerError) -> Self {
        Self::Libcontainer(Box::new(error))
    }
}

/// Prepares everything that libcontainer needs: root, volumes, configuration.
fn stage(directory: &Path, launch: &LaunchRecord) -> Result<StagedContainer, CreatorError> {
    // Roots of containers must be readable for their own users, whatever the shim's umask.
    umask(Mode::from_bits_truncate(0o022));
    let init = File::open(&launch.init).map_err(Error::file("open", &launch.init))?;
    let skeleton = directory.join("skeleton");
    make_skeleton(&skeleton, &launch.spec.id, &launch.spec.layers, &launch.spec.mounts, &launch.spec.hosts)?;
    let rootfs = Rootfs {
        layers: &launch.spec.layers,
        skeleton: &skeleton,
        upper: launch.spec.writable.as_deref(),
        uid_range: launch.uid_range,
    };
    let staged = rootfs.mount(&launch.spec.mounts)?;
    rootfs.make_owned_directories(&staged.root, &launch.spec.owned_directories)?;
    let config = bundle::config(&launch.spec, &staged, &launch.quotas())?;
    let file = directory.join("config.json");
    let json = serde_json::to_vec(&config)?;
    let mut options = File::options();
    options.write(true).create(true).truncate(true).mode(0o600);
    options.open(&file).and_then(|mut file| file.write_all(&json)).map_err(Error::file("write", &file))?;
    Ok(StagedContainer { init, records: staged.root.with_file_name("records"), _user_namespace: staged.user_namespace })
}

/// Creates and starts the container; returns the host pid of init.
fn create(
    directory: &Path,
    launch: &LaunchRecord,
    staged: StagedContainer,
    socket: OwnedFd,
    wait: OwnedFd,
) -> Result<i32, CreatorError> {
    if nix::unistd::read(&wait, &mut [0]) != Ok(1) {
        return Err(CreatorError::NotMoved);
    }
    let null = || File::options().read(true).write(true).open("/dev/null").map_err(CreatorError::Null);
    let mut container = ContainerBuilder::new(launch.spec.id.clone(), SyscallType::default())
        .with_root_path(&staged.records)?
        .with_executor(RunInit { init: Arc::new(staged.init) })
        .with_stdin(socket)
        .with_stdout(null()?)
        .with_stderr(null()?)
        .validate_id()?
        .as_init(directory)
        .with_systemd(false)
        .with_detach(true)
        .as_sibling(true)
        .build()?;
    container.start()?;
    let pid = container.pid().ok_or(CreatorError::NoPid)?;
    Ok(pid.as_raw())
}

/// Formats an error with all its causes.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let words = error.to_string();
        if !text.ends_with(&words) {
            text = format!("{text}: {words}");
        }
        cause = error.source();
    }
    text
}

fn report_line(mut file: &File, report: &CreatorReport) {
    // An error means that the shim is gone, which init will notice by itself.
    let _ = file.write_all(&crate::protocol::to_line(report));
}

/// Executes init from an open file, so that the container need not contain it and cannot find it.
#[derive(Clone)]
struct RunInit {
    init: Arc<File>,
}

impl Executor for RunInit {
    fn exec(&self, _spec: &libcontainer::oci_spec::runtime::Spec) -> Result<(), ExecutorError> {
        let name = CString::from(c"cloudroid-init");
        let environment: [CString; 0] = [];
        let flags = nix::fcntl::AtFlags::AT_EMPTY_PATH;
        let Err(error) = nix::unistd::execveat(&*self.init, c"", &[name], &environment, flags);
        Err(ExecutorError::Other(format!("init could not be executed: {error}")))
    }

    fn validate(&self, _spec: &libcontainer::oci_spec::runtime::Spec) -> Result<(), ExecutorValidationError> {
        Ok(())
    }

    fn setup_envs(&self, _variables: HashMap<String, String>) -> Result<(), ExecutorSetEnvsError> {
        // Init needs none, and gives each node its own.
        Ok(())
    }
}

/// Writes the errors logged by libcontainer into the report.
struct ErrorReporter(Arc<File>);

impl tracing::Subscriber for ErrorReporter {
    fn enabled(&self, metadata: &tracing::Metadata<'_>) -> bool {
        *metadata.level() == tracing::Level::ERROR
    }

    fn max_level_hint(&self) -> Option<tracing::level_filters::LevelFilter> {
        Some(tracing::level_filters::LevelFilter::ERROR)
    }

    fn event(&self, event: &tracing::Event<'_>) {
        let mut text = String::new();
        event.record(&mut |field: &tracing::field::Field, value: &dyn std::fmt::Debug| {
            let separator = if text.is_empty() { "" } else { ", " };
            let part = if field.name() == "message" {
                format!("{separator}{value:?}")
            } else {
                format!("{separator}{}: {value:?}", field.name())
            };
            text += &part;
        });
        report_line(&self.0, &CreatorReport::Failed(text));
    }

    fn new_span(&self, _span: &tracing::span::Attributes<'_>) -> tracing::Id {
        tracing::Id::from_u64(1)
    }

    fn record(&self, _span: &tracing::Id, _values: &tracing::span::Record<'_>) {}

    fn record_follows_from(&self, _span: &tracing::Id, _follows: &tracing::Id) {}

    fn enter(&self, _span: &tracing::Id) {}

    fn exit(&self, _span: &tracing::Id) {}
}

/// Reason why a container was not created, in the words of its creator.
#[derive(Debug, thiserror::Error)]
pub(super) enum CreationError {
    #[error("the creating process ended without a word: see the kernel's log for an out-of-memory kill")]
    Silent,
    #[error("{0}")]
    Reported(String),
    #[error("{outermost} ({cause})")]
    ReportedWithCause { outermost: String, cause: String },
}

impl Creator {
    /// Returns whether the report, as far as it was read, says that init runs.
    pub(super) fn has_succeeded(text: &[u8]) -> bool {
        let last = text.strip_suffix(b"\n").and_then(|whole| whole.rsplit(|byte| *byte == b'\n').next());
        last.is_some_and(|line| matches!(serde_json::from_slice(line), Ok(CreatorReport::Created { .. })))
    }

    /// Evaluates the whole report: host pid of init, or the errors.
    pub(super) fn outcome(text: &str) -> Result<i32, CreationError> {
        let mut complaints: Vec<String> = Vec::new();
        for line in text.lines() {
            match serde_json::from_str(line) {
                Ok(CreatorReport::Created { init }) => return Ok(init),
                Ok(CreatorReport::Failed(reason)) if !complaints.contains(&reason) => complaints.push(reason),
                Ok(CreatorReport::Failed(_)) => {}
                Err(_) => complaints.push(line.to_owned()),
            }
        }
        // The outermost error comes last and says least; the first is the cause.
        Err(match complaints.as_slice() {
            [] => CreationError::Silent,
            [only] => CreationError::Reported(only.clone()),
            [first, .., last] => CreationError::ReportedWithCause { outermost: last.clone(), cause: first.clone() },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cause_is_told_with_the_outermost_error() {
        let line = |report: &CreatorReport| String::from_utf8(crate::protocol::to_line(report)).unwrap();
        let failed = |text: &str| line(&CreatorReport::Failed(text.into()));
        assert_eq!(
            Creator::outcome(&(failed("warning") + &line(&CreatorReport::Created { init: 7 })))
                .expect("it was created"),
            7
        );
        let refusal = |text: &str| Creator::outcome(text).unwrap_err().to_string();
        assert_eq!(refusal(&(failed("no such mount") + &failed("create failed"))), "create failed (no such mount)");
        assert!(refusal("").contains("without a word"));
    }
}
