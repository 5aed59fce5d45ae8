//! Creating the container, in a process that exits when it is done.
//!
//! libcontainer must run in a process with one thread, changes that process's working directory and dumpable flag, and
//! uses memory that would otherwise stay for the servant's whole life. So the shim forks, the child creates the container as
//! its own *sibling* (init's parent is the shim), and ends. The mount namespace in which the layers were put together ends
//! with it too; the container has its own copy.
//!
//! Moving a process into a cgroup can take the kernel as long as all the rest of ours (it waits for an RCU grace period
//! before the first move in a while), so the shim moves the creator while that puts the layers together:
//!
//! ```text
//!   shim      fork ── move the creator ──▶ gate ── event loop
//!   creator     └──── layers, config ───▶ gate ── libcontainer, in the cgroup ── end
//! ```

use std::collections::HashMap;
use std::ffi::CString;
use std::fs::File;
use std::io::Write;
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use libcontainer::container::builder::ContainerBuilder;
use libcontainer::syscall::syscall::SyscallType;
use libcontainer::workload::{
    Executor, ExecutorError, ExecutorSetEnvsError, ExecutorValidationError,
};
use nix::sys::socket::{AddressFamily, MsgFlags, SockFlag, SockType, send, socketpair};
use nix::sys::stat::{Mode, umask};
use nix::unistd::ForkResult;
use serde::{Deserialize, Serialize};

use crate::Error;
use crate::bundle;
use crate::launch::Launch;
use crate::rootfs::{Rootfs, make_skeleton};

/// A line of the creator's report. The last one counts.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Report {
    /// Init runs.
    Created {
        /// Its pid on the host.
        init: i32,
    },
    /// Something went wrong; maybe not the last words.
    Failed(String),
}

/// The creating process.
#[derive(Debug)]
pub(super) struct Creator {
    /// Where it reports.
    pub(super) report: OwnedFd,
}

/// The creating process, before it has made any process: that waits until it is in its cgroup.
#[derive(Debug)]
pub(super) struct Waiting {
    pub(super) pid: u32,
    report: OwnedFd,
    /// Closed without a word it ends.
    go: OwnedFd,
}

impl Waiting {
    /// Ends it. Once this returns it writes nothing any more, so that the servant's directory can be removed.
    pub(super) fn end(self) {
        let pid = nix::unistd::Pid::from_raw(self.pid as i32);
        // Our own child, not reaped yet: the number is surely its own.
        let _ = nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGKILL);
        let _ = nix::sys::wait::waitpid(pid, None);
    }

    /// Lets it go on.
    pub(super) fn go_on(self) -> Creator {
        // Where nobody listens it has failed and ended, and says so in its report. That must not end us too (SIGPIPE).
        let _ = send(self.go.as_raw_fd(), b".", MsgFlags::MSG_NOSIGNAL);
        Creator {
            report: self.report,
        }
    }
}

/// Forks it. The calling process must have one thread.
pub(super) fn fork(directory: &Path, launch: &Launch, socket: OwnedFd) -> Result<Waiting, Error> {
    let (report, write) =
        nix::unistd::pipe2(nix::fcntl::OFlag::O_CLOEXEC).map_err(Error::nix("pipe"))?;
    let (wait, go) = socketpair(
        AddressFamily::Unix,
        SockType::Stream,
        None,
        SockFlag::SOCK_CLOEXEC,
    )
    .map_err(Error::nix("socketpair for the creator"))?;
    // SAFETY: one thread, so that the child may do whatever its parent might.
    match unsafe { nix::unistd::fork() }.map_err(Error::nix("fork of the creator"))? {
        ForkResult::Parent { child } => Ok(Waiting {
            pid: child.as_raw() as u32,
            report,
            go,
        }),
        ForkResult::Child => {
            drop((report, go));
            let write = Arc::new(File::from(write));
            // Errors that libcontainer meets in its own children are only logged.
            let _ = tracing::subscriber::set_global_default(Complaints(write.clone()));
            let outcome = match stage(directory, launch)
                .and_then(|staged| create(directory, launch, staged, socket, wait))
            {
                Ok(init) => Report::Created { init },
                Err(reason) => Report::Failed(reason),
            };
            report_line(&write, &outcome);
            // SAFETY: ends the child without running what the parent has registered for its own end.
            unsafe { libc::_exit(0) }
        }
    }
}

/// What the creator has prepared.
struct Ready {
    /// The static init, opened before anything of the servant was mounted.
    init: File,
    /// Where libcontainer keeps its records. Nobody needs them later, and on a disk their writing took as long as a
    /// fifth of the creation: this is in memory, and goes with the creator's mount namespace.
    records: PathBuf,
    /// The configuration names it by its number.
    _user_namespace: OwnedFd,
}

/// Everything that libcontainer is to find: root, volumes, configuration.
fn stage(directory: &Path, launch: &Launch) -> Result<Ready, String> {
    let text = |error: &dyn std::error::Error| chain(error);
    // Roots of containers are for their own users to read, whatever is usual in the shim.
    umask(Mode::from_bits_truncate(0o022));
    let init = File::open(&launch.init)
        .map_err(|error| format!("could not open {}: {error}", launch.init.display()))?;
    let skeleton = directory.join("skeleton");
    make_skeleton(
        &skeleton,
        &launch.spec.id,
        &launch.spec.layers,
        &launch.spec.mounts,
        &launch.spec.hosts,
    )
    .map_err(|error| text(&error))?;
    let rootfs = Rootfs {
        layers: &launch.spec.layers,
        skeleton: &skeleton,
        upper: launch.spec.writable.as_deref(),
        uid_range: launch.uid_range,
    };
    let staged = rootfs
        .mount(&launch.spec.mounts)
        .map_err(|error| text(&error))?;
    rootfs
        .make_owned(&staged.root, &launch.spec.owned_directories)
        .map_err(|error| text(&error))?;
    let config =
        bundle::config(&launch.spec, &staged, &launch.quotas()).map_err(|error| text(&error))?;
    let file = directory.join("config.json");
    let json = serde_json::to_vec(&config).map_err(|error| text(&error))?;
    let mut options = File::options();
    options.write(true).create(true).truncate(true).mode(0o600);
    options
        .open(&file)
        .and_then(|mut file| file.write_all(&json))
        .map_err(|error| format!("could not write {}: {error}", file.display()))?;
    Ok(Ready {
        init,
        records: staged.root.with_file_name("records"),
        _user_namespace: staged.user_namespace,
    })
}

/// Creates and starts the container; init's pid on the host.
fn create(
    directory: &Path,
    launch: &Launch,
    staged: Ready,
    socket: OwnedFd,
    wait: OwnedFd,
) -> Result<i32, String> {
    let text = |error: &dyn std::error::Error| chain(error);
    if nix::unistd::read(&wait, &mut [0]) != Ok(1) {
        return Err("the shim did not move its creator into the cgroup".into());
    }
    let null = || {
        File::options()
            .read(true)
            .write(true)
            .open("/dev/null")
            .map_err(|error| text(&error))
    };
    let mut container = ContainerBuilder::new(launch.spec.id.clone(), SyscallType::default())
        .with_root_path(&staged.records)
        .map_err(|error| text(&error))?
        .with_executor(RunInit {
            init: Arc::new(staged.init),
        })
        .with_stdin(socket)
        .with_stdout(null()?)
        .with_stderr(null()?)
        .validate_id()
        .map_err(|error| text(&error))?
        .as_init(directory)
        .with_systemd(false)
        .with_detach(true)
        .as_sibling(true)
        .build()
        .map_err(|error| text(&error))?;
    container.start().map_err(|error| text(&error))?;
    container
        .pid()
        .map(|pid| pid.as_raw())
        .ok_or_else(|| "libcontainer does not know init's pid".into())
}

/// An error with all its causes.
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

fn report_line(mut file: &File, report: &Report) {
    // Nobody reads any more: the shim is gone, and init will see that by itself.
    let _ = file.write_all(&crate::protocol::line(report));
}

/// Executes init from an open file: it needs no place in the container and cannot be found there.
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
        Err(ExecutorError::Other(format!(
            "init could not be executed: {error}"
        )))
    }

    fn validate(
        &self,
        _spec: &libcontainer::oci_spec::runtime::Spec,
    ) -> Result<(), ExecutorValidationError> {
        Ok(())
    }

    fn setup_envs(&self, _variables: HashMap<String, String>) -> Result<(), ExecutorSetEnvsError> {
        // Init needs none, and gives each node its own.
        Ok(())
    }
}

/// Writes what libcontainer logs as errors into the report.
struct Complaints(Arc<File>);

impl tracing::Subscriber for Complaints {
    fn enabled(&self, metadata: &tracing::Metadata<'_>) -> bool {
        *metadata.level() == tracing::Level::ERROR
    }

    fn max_level_hint(&self) -> Option<tracing::level_filters::LevelFilter> {
        Some(tracing::level_filters::LevelFilter::ERROR)
    }

    fn event(&self, event: &tracing::Event<'_>) {
        let mut text = String::new();
        event.record(
            &mut |field: &tracing::field::Field, value: &dyn std::fmt::Debug| {
                let separator = if text.is_empty() { "" } else { ", " };
                let part = if field.name() == "message" {
                    format!("{separator}{value:?}")
                } else {
                    format!("{separator}{}: {value:?}", field.name())
                };
                text += &part;
            },
        );
        report_line(&self.0, &Report::Failed(text));
    }

    fn new_span(&self, _span: &tracing::span::Attributes<'_>) -> tracing::Id {
        tracing::Id::from_u64(1)
    }

    fn record(&self, _span: &tracing::Id, _values: &tracing::span::Record<'_>) {}

    fn record_follows_from(&self, _span: &tracing::Id, _follows: &tracing::Id) {}

    fn enter(&self, _span: &tracing::Id) {}

    fn exit(&self, _span: &tracing::Id) {}
}

impl Creator {
    /// Whether the report, as far as it was read, says that init runs.
    pub(super) fn has_succeeded(text: &[u8]) -> bool {
        let last = text
            .strip_suffix(b"\n")
            .and_then(|whole| whole.rsplit(|byte| *byte == b'\n').next());
        last.is_some_and(|line| matches!(serde_json::from_slice(line), Ok(Report::Created { .. })))
    }

    /// Reads what is left of the report and tells the outcome. `text` is the whole report.
    pub(super) fn outcome(text: &str) -> Result<i32, String> {
        let mut complaints: Vec<String> = Vec::new();
        for line in text.lines() {
            match serde_json::from_str(line) {
                Ok(Report::Created { init }) => return Ok(init),
                Ok(Report::Failed(reason)) if !complaints.contains(&reason) => {
                    complaints.push(reason)
                }
                Ok(Report::Failed(_)) => {}
                Err(_) => complaints.push(line.to_owned()),
            }
        }
        // The outermost error comes last and says least; the first is the cause.
        match complaints.as_slice() {
            [] => Err("the creating process ended without a word: see the kernel's log for an out-of-memory kill".into()),
            [only] => Err(only.clone()),
            [first, .., last] => Err(format!("{last} ({first})")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cause_is_told_with_the_outermost_error() {
        let line = |report: &Report| String::from_utf8(crate::protocol::line(report)).unwrap();
        let failed = |text: &str| line(&Report::Failed(text.into()));
        assert_eq!(
            Creator::outcome(&(failed("warning") + &line(&Report::Created { init: 7 }))),
            Ok(7)
        );
        assert_eq!(
            Creator::outcome(&(failed("no such mount") + &failed("create failed"))).unwrap_err(),
            "create failed (no such mount)"
        );
        assert!(Creator::outcome("").unwrap_err().contains("without a word"));
    }
}
