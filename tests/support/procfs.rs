//! What the kernel says of processes.

use std::collections::BTreeMap;
use std::fs;

/// The fields of `/proc/PID/status`; none when the process is gone.
pub fn status(pid: i32) -> Option<BTreeMap<String, String>> {
    let text = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    Some(fields(&text))
}

/// Fields of a `status`, each at a line of its own.
pub fn fields(status: &str) -> BTreeMap<String, String> {
    let fields = status.lines().filter_map(|line| line.split_once(':'));
    fields
        .map(|(key, value)| (key.to_owned(), value.trim().to_owned()))
        .collect()
}

/// The command line, arguments separated by spaces.
pub fn command_line(pid: i32) -> Option<String> {
    let bytes = fs::read(format!("/proc/{pid}/cmdline")).ok()?;
    Some(
        String::from_utf8_lossy(&bytes)
            .replace('\0', " ")
            .trim()
            .to_owned(),
    )
}

/// All processes, by pid.
pub fn pids() -> Vec<i32> {
    fs::read_dir("/proc")
        .expect("/proc")
        .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok())
        .collect()
}

/// The identity of a namespace of a process, such as `net:[4026531840]`.
pub fn namespace(pid: i32, kind: &str) -> Option<String> {
    Some(
        fs::read_link(format!("/proc/{pid}/ns/{kind}"))
            .ok()?
            .to_string_lossy()
            .into_owned(),
    )
}
