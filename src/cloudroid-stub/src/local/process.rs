//! Process of the original: in the stub's process group, so that roslaunch's signals reach it, too.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::process::{Child, Command};
use tokio::time::timeout;

use super::private_system::Variables;

/// Signals and waiting times as in roslaunch, but shorter: the robot's application does not depend on it any more.
const ESCALATION: [(Signal, Duration); 2] =
    [(Signal::SIGINT, Duration::from_secs(5)), (Signal::SIGTERM, Duration::from_secs(2))];

/// Program of the original.
#[derive(Debug, Clone)]
pub struct OriginalProgram {
    /// The executable.
    pub path: PathBuf,
    /// Arguments of the executable.
    pub argv: Vec<String>,
    /// Environment variables that differ from the stub's.
    pub environment: Vec<(&'static str, OsString)>,
}

impl OriginalProgram {
    /// Starts it in the ROS system of these variables. It is killed when the returned handle is dropped, and by the
    /// kernel when the calling thread ends without that: a stub that is killed leaves no useless process behind. So the
    /// calling thread must live as long as the stub.
    #[allow(unsafe_code)]
    pub fn spawn(&self, place: &Variables) -> anyhow::Result<Child> {
        let mut command = Command::new(&self.path);
        command
            .args(&self.argv)
            .envs(self.environment.iter().map(|(name, value)| (name, value)))
            .stdin(std::process::Stdio::null())
            .kill_on_drop(true);
        for (name, value) in place {
            match value {
                Some(value) => command.env(name, value),
                None => command.env_remove(name),
            };
        }
        let stub = nix::unistd::getpid();
        // SAFETY: two system calls are made between fork and exec, both async-signal-safe, and nothing is allocated.
        unsafe {
            command.pre_exec(move || {
                nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
                // The stub may have ended before the death signal was set.
                if nix::unistd::getppid() == stub { Ok(()) } else { Err(std::io::ErrorKind::Interrupted.into()) }
            });
        }
        command.spawn().with_context(|| format!("the local original {} cannot be executed", self.path.display()))
    }
}

/// Ends the process as roslaunch would.
pub async fn terminate(child: &mut Child) {
    for (signal, patience) in ESCALATION {
        let Some(pid) = child.id().and_then(|pid| i32::try_from(pid).ok()) else {
            return;
        };
        // The process is not reaped yet, so the pid is still its own.
        let _ = kill(Pid::from_raw(pid), signal);
        if timeout(patience, child.wait()).await.is_ok() {
            return;
        }
    }
    let _ = child.kill().await;
}

/// Describes how a process ended.
pub fn describe_exit(status: std::io::Result<std::process::ExitStatus>) -> String {
    match status {
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    }
}
