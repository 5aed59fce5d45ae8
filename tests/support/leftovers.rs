//! What stays behind when everything has ended: nothing may.

use std::fs;
use std::path::{Path, PathBuf};

use crate::procfs;

/// Processes, mounts and cgroups that refer to `home`. Empty when all is clean.
pub fn of(home: &Path) -> Vec<String> {
    let home = home.to_string_lossy().into_owned();
    let mut found = Vec::new();
    for pid in procfs::pids() {
        if pid == std::process::id() as i32 {
            continue;
        }
        let command = procfs::command_line(pid).unwrap_or_default();
        let directory = fs::read_link(format!("/proc/{pid}/cwd")).unwrap_or_default();
        let mounted = fs::read_to_string(format!("/proc/{pid}/mountinfo")).unwrap_or_default();
        if command.contains(&home)
            || directory.starts_with(&home)
            || mounted.contains(&format!("{home}/"))
        {
            found.push(format!("process {pid}: {command}"));
        }
    }
    let mounts = fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    found.extend(
        mounts
            .lines()
            .filter(|line| line.contains(&home))
            .map(|line| format!("mount {line}")),
    );
    found
}

/// Cgroup directories whose name says that they are a servant's.
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
