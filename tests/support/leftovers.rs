//! Finds leftovers after everything has ended; there should be none.

use std::fs;
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, umount2};

use crate::procfs;

/// Describes processes and mounts that refer to files in `home`; empty if there are none.
pub fn find_leftovers(home: &Path) -> Vec<String> {
    let mut found: Vec<String> = processes_of(home)
        .into_iter()
        .map(|pid| {
            let command = procfs::command_line(pid).unwrap_or_default();
            format!("process {pid}: {command}")
        })
        .collect();
    found.extend(mounts_below(home).iter().map(|mount| format!("mount {}", mount.display())));
    found
}

/// Returns processes that have a path below `home` in their command line, as working directory or as mount.
pub fn processes_of(home: &Path) -> Vec<i32> {
    let own = std::process::id() as i32;
    let namespace = procfs::namespace(own, "mnt");
    let home = home.to_string_lossy().into_owned();
    let refers = |pid: &i32| {
        let command = procfs::command_line(*pid).unwrap_or_default();
        let directory = fs::read_link(format!("/proc/{pid}/cwd")).unwrap_or_default();
        let mounted = fs::read_to_string(format!("/proc/{pid}/mountinfo")).unwrap_or_default();
        names_directory(&command, &home)
            || directory.starts_with(&home)
            // Processes in this mount namespace see the same mounts without using them.
            || (procfs::namespace(*pid, "mnt") != namespace && mounted.contains(&format!("{home}/")))
    };
    procfs::pids().into_iter().filter(|pid| *pid != own).filter(refers).collect()
}

/// Returns whether a command line names a directory or something below it, and not only another one whose name begins
/// with its name.
fn names_directory(command: &str, directory: &str) -> bool {
    let continues = |next: char| next.is_alphanumeric() || ['-', '_', '.'].contains(&next);
    command.match_indices(directory).any(|(at, _)| !command[at + directory.len()..].starts_with(continues))
}

/// Detaches all mounts below a directory in this mount namespace, the innermost first.
pub fn unmount_below(directory: &Path) {
    for mount in mounts_below(directory).iter().rev() {
        let _ = umount2(mount, MntFlags::MNT_DETACH);
    }
}

/// Returns the mount points below `home` in this mount namespace, in mount order (proc(5), field 5 of `mountinfo`).
fn mounts_below(home: &Path) -> Vec<PathBuf> {
    let mounts = fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    mounts
        .lines()
        .filter_map(|line| Some(PathBuf::from(line.split(' ').nth(4)?)))
        .filter(|mount| mount.starts_with(home) && mount != home)
        .collect()
}

/// Returns the cgroup directories that are named after these servants.
pub fn cgroups(ids: &[String]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut pending = vec![PathBuf::from("/sys/fs/cgroup")];
    while let Some(directory) = pending.pop() {
        let Ok(entries) = fs::read_dir(&directory) else {
            continue;
        };
        for entry in entries.flatten() {
            if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                continue;
            }
            let name = entry.file_name().to_string_lossy().into_owned();
            if ids.iter().any(|id| name.contains(id.as_str())) {
                found.push(entry.path());
            }
            pending.push(entry.path());
        }
    }
    found
}
