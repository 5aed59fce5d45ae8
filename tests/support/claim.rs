//! Directories owned by a run: each names its owner process, so that a later run can remove the directories of a killed
//! one and leaves those of a running one alone.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::{leftovers, procfs};

/// File in each directory that names its owner: a pid and the start time of that process.
pub const OWNER: &str = "owner";
/// Maximum time for killed processes to disappear.
const END: Duration = Duration::from_secs(60);

/// Records this process as the owner of a directory.
///
/// # Errors
/// If the file cannot be written.
pub fn claim(directory: &Path) -> std::io::Result<()> {
    fs::write(directory.join(OWNER), own_note())
}

/// Returns the note by which a later run recognises this process: its pid and start time.
pub fn own_note() -> String {
    let own = std::process::id();
    format!("{own} {}", start_time(own as i32).unwrap_or_default())
}

/// Returns the directories in `parent` whose names start with `prefix` and whose owner no longer exists.
pub fn find_abandoned(parent: &Path, prefix: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(parent).into_iter().flatten().flatten();
    let named = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix));
    let is_abandoned = |directory: &PathBuf| {
        let owner = fs::read_to_string(directory.join(OWNER)).ok();
        owner.is_some_and(|owner| !is_alive(&owner))
    };
    named.map(|entry| entry.path()).filter(is_abandoned).collect()
}

/// Ends the processes that use an abandoned directory, and removes their cgroups, their mounts in this namespace, and
/// the directory.
///
/// # Errors
/// With the first thing that could not be removed.
pub fn remove_abandoned(directory: &Path) -> anyhow::Result<()> {
    end_users(directory)?;
    leftovers::unmount_below(directory);
    match fs::remove_dir_all(directory) {
        // Another run may be doing the same.
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        removed => removed.with_context(|| directory.display().to_string()),
    }
}

/// Ends the processes that use a directory, except this process and its ancestors, and removes their cgroups.
///
/// # Errors
/// With the first thing that could not be removed.
pub fn end_users(directory: &Path) -> anyhow::Result<()> {
    // Processes in a servant's mount namespace need not refer to the directory visibly: they are found through their
    // parents.
    let own = procfs::ancestors(std::process::id() as i32);
    let mut users = leftovers::processes_of(directory);
    users.retain(|pid| !own.contains(pid));
    let pids = procfs::with_descendants(&users);
    let mut cgroups: Vec<PathBuf> = pids
        .iter()
        .flat_map(|pid| procfs::cgroups(*pid))
        .filter(|path| path.parent().is_some_and(|parent| parent.ends_with("cloudroid")))
        .collect();
    cgroups.sort();
    cgroups.dedup();
    for pid in &pids {
        let _ = kill(Pid::from_raw(*pid), Signal::SIGKILL);
    }
    let begun = Instant::now();
    while let Some(pid) = pids.iter().find(|pid| procfs::is_running(**pid)) {
        ensure!(begun.elapsed() < END, "process {pid} does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
    for cgroup in &cgroups {
        // A process that has just ended is charged to the cgroup for a moment longer.
        while fs::remove_dir(cgroup).is_err_and(|error| error.kind() == std::io::ErrorKind::ResourceBusy) {
            ensure!(begun.elapsed() < END, "{} stays busy", cgroup.display());
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    Ok(())
}

/// Returns whether the process that wrote this note still exists.
pub fn is_alive(owner: &str) -> bool {
    let (pid, start) = owner.split_once(' ').unwrap_or((owner, ""));
    pid.parse().is_ok_and(|pid| start_time(pid).is_some_and(|now| now == start))
}

/// Returns the start time of a process in ticks since boot, because pids are reused (proc(5), field 22 of `stat`).
fn start_time(pid: i32) -> Option<String> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let rest = stat.rsplit_once(") ")?.1;
    rest.split(' ').nth(19).map(str::to_owned)
}
