//! Removes leftovers of evaluations that were killed: sandboxes, daemons with their servants, files. Those of a process
//! that still runs are left alone.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use support::daemon::DaemonSetup;
use support::{claim, procfs};

use crate::place;

/// Prefix of the working directories of evaluations, below the directory for temporary files.
pub const PREFIX: &str = "cloudroid-eval-";
/// Maximum time for a daemon to stop together with its servants.
const END: Duration = Duration::from_secs(60);

/// Removes the leftovers of evaluations that are over; returns a line for each, also for what cannot be removed.
pub fn remove_all() -> Vec<String> {
    let mut told: Vec<String> = claim::find_abandoned(&std::env::temp_dir(), PREFIX)
        .iter()
        .map(|directory| match remove_home(directory) {
            Ok(()) => format!("{}: taken away", directory.display()),
            Err(error) => format!("{} is left: {error:#}", directory.display()),
        })
        .collect();
    told.extend(place::remove_abandoned());
    told
}

/// Stops the daemon of an evaluation with its servants, and removes the directory.
fn remove_home(directory: &Path) -> Result<()> {
    let home = directory.join("home");
    if home.exists() {
        // A daemon that has died has left its servants to the next daemon with the same home.
        match find_daemon(&home) {
            Some(pid) => stop_daemon(pid)?,
            None => drop(DaemonSetup::new(&home).start()?.stop()?),
        }
    }
    fs::remove_dir_all(directory).with_context(|| directory.display().to_string())
}

fn find_daemon(home: &Path) -> Option<i32> {
    let wanted = format!("cloudroidd --home {} ", home.display());
    let is = |pid: &i32| procfs::command_line(*pid).is_some_and(|line| line.contains(&wanted));
    procfs::pids().into_iter().find(is)
}

fn stop_daemon(pid: i32) -> Result<()> {
    kill(Pid::from_raw(pid), Signal::SIGTERM)?;
    let begun = Instant::now();
    // The process is reaped by another parent.
    while procfs::is_running(pid) {
        ensure!(begun.elapsed() < END, "its daemon {pid} does not end");
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_of_nobody_is_taken_away() {
        let temporary = tempfile::tempdir().expect("a directory");
        let made = |name: &str| {
            let directory = temporary.path().join(format!("{PREFIX}{name}"));
            fs::create_dir(&directory).expect("a directory");
            directory
        };
        claim::claim(&made("ours")).expect("it is ours");
        made("unknown");
        let ended = made("ended");
        fs::write(ended.join(claim::OWNER), "999999999 7").expect("a file");
        // The same pid, but of a process with another start time.
        let again = made("again");
        fs::write(again.join(claim::OWNER), format!("{} 1", std::process::id())).expect("a file");
        let mut found = claim::find_abandoned(temporary.path(), PREFIX);
        found.sort();
        assert_eq!(found, [again, ended.clone()]);
        remove_home(&ended).expect("there is no daemon");
        assert!(!ended.exists());
    }
}
