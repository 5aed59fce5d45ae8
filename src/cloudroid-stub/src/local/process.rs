//! The original's process: in the stub's process group, so roslaunch's signals reach it, too.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::process::{Child, Command};
use tokio::time::timeout;

use super::private_system::Variables;

/// roslaunch's order and patience, shorter: the robot's application is not concerned any more.
const ESCALATION: [(Signal, Duration); 2] = [
    (Signal::SIGINT, Duration::from_secs(5)),
    (Signal::SIGTERM, Duration::from_secs(2)),
];

/// What is run.
#[derive(Debug, Clone)]
pub struct Program {
    /// The executable.
    pub path: PathBuf,
    /// Arguments of the executable.
    pub argv: Vec<String>,
    /// Variables that differ from the stub's own.
    pub environment: Vec<(&'static str, OsString)>,
}

impl Program {
    /// Starts it in the system that these variables tell of. It is killed when what is returned is dropped, and by the kernel when the calling thread ends
    /// without that: a stub that is killed leaves nobody behind who computes for no one. So the caller is a thread that
    /// lasts as long as the stub does.
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
        // SAFETY: between fork and exec two system calls are made, both of which a signal handler may make, and nothing
        // is allocated.
        unsafe {
            command.pre_exec(move || {
                nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
                // It may have ended before it was to be told of.
                if nix::unistd::getppid() == stub {
                    Ok(())
                } else {
                    Err(std::io::ErrorKind::Interrupted.into())
                }
            });
        }
        command.spawn().with_context(|| {
            format!(
                "the local original {} cannot be executed",
                self.path.display()
            )
        })
    }
}

/// Ends it as roslaunch would.
pub async fn end(child: &mut Child) {
    for (signal, patience) in ESCALATION {
        let Some(pid) = child.id().and_then(|pid| i32::try_from(pid).ok()) else {
            return;
        };
        // It is not reaped yet, so the number is still its own.
        let _ = kill(Pid::from_raw(pid), signal);
        if timeout(patience, child.wait()).await.is_ok() {
            return;
        }
    }
    let _ = child.kill().await;
}

/// How a process ended, in words.
pub fn ended(status: std::io::Result<std::process::ExitStatus>) -> String {
    match status {
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    }
}
