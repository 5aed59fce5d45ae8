//! Information about processes from the kernel.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

/// Returns the fields of `/proc/PID/status`; `None` if the process is gone.
pub fn status(pid: i32) -> Option<BTreeMap<String, String>> {
    let text = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    Some(fields(&text))
}

/// Parses the fields of a `status` file, one per line.
pub fn fields(status: &str) -> BTreeMap<String, String> {
    let fields = status.lines().filter_map(|line| line.split_once(':'));
    fields.map(|(key, value)| (key.to_owned(), value.trim().to_owned())).collect()
}

/// Returns the command line, with arguments separated by spaces.
pub fn command_line(pid: i32) -> Option<String> {
    let bytes = fs::read(format!("/proc/{pid}/cmdline")).ok()?;
    Some(String::from_utf8_lossy(&bytes).replace('\0', " ").trim().to_owned())
}

/// Returns the pids of all processes.
pub fn pids() -> Vec<i32> {
    fs::read_dir("/proc").expect("/proc").filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok()).collect()
}

/// Returns the identity of a namespace of a process, such as `net:[4026531840]`.
pub fn namespace(pid: i32, kind: &str) -> Option<String> {
    Some(fs::read_link(format!("/proc/{pid}/ns/{kind}")).ok()?.to_string_lossy().into_owned())
}

/// Returns whether a process exists and is not a zombie.
pub fn is_running(pid: i32) -> bool {
    let state = status(pid).and_then(|status| status.get("State").cloned());
    state.is_some_and(|state| !state.starts_with(['Z', 'X']))
}

/// Returns the directories of a process's cgroups, in the hierarchies as mounted on hybrid hosts.
pub fn cgroups(pid: i32) -> Vec<PathBuf> {
    let text = fs::read_to_string(format!("/proc/{pid}/cgroup")).unwrap_or_default();
    text.lines()
        .filter_map(|line| {
            let mut fields = line.splitn(3, ':').skip(1);
            let (controllers, path) = (fields.next()?, fields.next()?);
            let hierarchy = if controllers.is_empty() { "unified" } else { controllers.trim_start_matches("name=") };
            let hierarchy = PathBuf::from("/sys/fs/cgroup").join(hierarchy);
            let root = if hierarchy.exists() { hierarchy } else { PathBuf::from("/sys/fs/cgroup") };
            Some(root.join(path.trim_start_matches('/')))
        })
        .collect()
}

/// Returns these processes with all their descendants.
pub fn with_descendants(pids: &[i32]) -> Vec<i32> {
    let parents: Vec<(i32, i32)> =
        self::pids().into_iter().filter_map(|pid| Some((pid, status(pid)?.get("PPid")?.parse().ok()?))).collect();
    let mut all = pids.to_vec();
    let mut next = 0;
    while next < all.len() {
        let parent = all[next];
        let children = parents.iter().filter(|(_, of)| *of == parent);
        let new: Vec<i32> = children.map(|(pid, _)| *pid).filter(|pid| !all.contains(pid)).collect();
        all.extend(new);
        next += 1;
    }
    all
}

/// Returns the parent of a process, its parent, and so on.
pub fn ancestors(pid: i32) -> Vec<i32> {
    let parent = |pid: &i32| -> Option<i32> {
        let parent = status(*pid)?.get("PPid")?.parse().ok()?;
        (parent > 0).then_some(parent)
    };
    std::iter::successors(parent(&pid), parent).collect()
}
