//! Reading of control files.

use std::fs;
use std::path::Path;

/// Reads the number in a file; `None` for `max`, or if it cannot be read.
pub(super) fn read_number(file: &Path) -> Option<u64> {
    fs::read_to_string(file).ok()?.trim().parse().ok()
}

/// Reads the number after `name` in a file of `name number` lines.
pub(super) fn read_field(file: &Path, name: &str) -> Option<u64> {
    let text = fs::read_to_string(file).ok()?;
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.trim().parse().ok())
}

/// Reads the value of `key` for `device`, in a file of `MAJOR:MINOR key=value …` lines; `None` for `max`.
pub(super) fn read_device_field(file: &Path, device: &str, key: &str) -> Option<u64> {
    let text = fs::read_to_string(file).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix(device)?.strip_prefix(' '))?;
    line.split(' ').find_map(|pair| pair.strip_prefix(key)?.strip_prefix('=')?.parse().ok())
}

/// Reads the processes of a cgroup directory. Those of another pid namespace read as 0, which `kill` interprets as our
/// own process group: they are left out.
pub(super) fn read_pids(directory: &Path) -> Vec<i32> {
    let text = fs::read_to_string(directory.join("cgroup.procs")).unwrap_or_default();
    text.lines().filter_map(|line| line.parse().ok()).filter(|pid| *pid > 0).collect()
}
