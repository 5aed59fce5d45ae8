//! What evaluations have left that were ended by force: robots' places, daemons with their servants, files. A later one takes it away; what
//! belongs to a process that is still there is left alone.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use support::daemon::Setup;
use support::procfs;

use crate::place;

/// Of the directories that evaluations work in, below the directory for temporary files.
pub const PREFIX: &str = "cloudroid-eval-";
/// In each: whose it is.
const OWNER: &str = "owner";
/// For a daemon to end with its servants.
const END: Duration = Duration::from_secs(60);

/// Notes that a directory is this process's.
pub fn claim(directory: &Path) -> Result<()> {
    let own = std::process::id();
    let text = format!("{own} {}", started(own as i32).unwrap_or_default());
    Ok(fs::write(directory.join(OWNER), text)?)
}

/// Takes away what is left of evaluations that are over; tells what, each in a line. What cannot be taken away is told, too.
pub fn all() -> Vec<String> {
    let mut told: Vec<String> = abandoned(&std::env::temp_dir())
        .iter()
        .map(|directory| match home(directory) {
            Ok(()) => format!("{}: taken away", directory.display()),
            Err(error) => format!("{} is left: {error:#}", directory.display()),
        })
        .collect();
    told.extend(place::sweep());
    told
}

/// Directories of evaluations whose process is no more.
fn abandoned(temporary: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(temporary).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX));
    let over = |directory: &PathBuf| {
        let text = fs::read_to_string(directory.join(OWNER)).ok();
        text.is_some_and(|text| !is_there(&text))
    };
    named.map(|entry| entry.path()).filter(over).collect()
}

/// Whether the process that has written this is there.
fn is_there(owner: &str) -> bool {
    let (pid, since) = owner.split_once(' ').unwrap_or((owner, ""));
    pid.parse()
        .is_ok_and(|pid| started(pid).is_some_and(|now| now == since))
}

/// When a process started, in ticks since the machine did: pids come again (proc(5): field 22 of `stat`).
fn started(pid: i32) -> Option<String> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let rest = stat.rsplit_once(") ")?.1;
    rest.split(' ').nth(19).map(str::to_owned)
}

/// Ends the daemon of an evaluation, with its servants, and removes the directory.
fn home(directory: &Path) -> Result<()> {
    let home = directory.join("home");
    if home.exists() {
        // One that has died has left its servants to the next of the same home.
        match daemon_of(&home) {
            Some(pid) => ends(pid)?,
            None => drop(Setup::new(&home).start()?.ends()?),
        }
    }
    fs::remove_dir_all(directory).with_context(|| directory.display().to_string())
}

fn daemon_of(home: &Path) -> Option<i32> {
    let wanted = format!("cloudroidd --home {} ", home.display());
    let is = |pid: &i32| procfs::command_line(*pid).is_some_and(|line| line.contains(&wanted));
    procfs::pids().into_iter().find(is)
}

fn ends(pid: i32) -> Result<()> {
    kill(Pid::from_raw(pid), Signal::SIGTERM)?;
    let begun = Instant::now();
    let is_there = || {
        // Somebody else is to reap it.
        let state = procfs::status(pid).and_then(|status| status.get("State").cloned());
        state.is_some_and(|state| !state.starts_with(['Z', 'X']))
    };
    while is_there() {
        ensure!(begun.elapsed() < END, "its daemon {pid} does not end");
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// Runs `ip`, whatever comes of it.
pub(crate) fn ip(words: &[&str]) {
    let _ = Command::new("ip").args(words).output();
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
        claim(&made("ours")).expect("it is ours");
        made("unknown");
        let ended = made("ended");
        fs::write(ended.join(OWNER), "999999999 7").expect("a file");
        // The same pid, but of a process that started at another time.
        let again = made("again");
        fs::write(again.join(OWNER), format!("{} 1", std::process::id())).expect("a file");
        let mut found = abandoned(temporary.path());
        found.sort();
        assert_eq!(found, [again, ended.clone()]);
        home(&ended).expect("there is no daemon");
        assert!(!ended.exists());
    }
}
