//! Processes identified by more than their pid.

use std::fs;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

use crate::sys;
pub use crate::sys::{allocated_bytes, trim_heap};

/// Identity of a process in a record: its pid alone may have been reused by the time the record is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessIdentity {
    /// Process id on the host.
    pub pid: i32,
    /// Start time in clock ticks since boot (proc(5), /proc/PID/stat, field 22).
    pub start: u64,
    /// First half of the random id of the boot (proc(5), /proc/sys/kernel/random/boot_id). 0, in records of earlier
    /// versions, matches any.
    #[serde(default)]
    pub boot: u64,
}

/// Returns the first half of this boot's id; 0 if `/proc` does not show it.
fn boot_id() -> u64 {
    static BOOT: OnceLock<u64> = OnceLock::new();
    *BOOT.get_or_init(|| {
        let text = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let digits = text.chars().filter(char::is_ascii_hexdigit);
        u64::from_str_radix(&digits.take(16).collect::<String>(), 16).unwrap_or(0)
    })
}

impl ProcessIdentity {
    /// Returns the identity of a running process.
    pub fn from_pid(pid: i32) -> io::Result<Self> {
        let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
        // The name, in parentheses, may contain anything; fields are counted after its end.
        let start = stat.rsplit_once(") ").and_then(|(_, fields)| fields.split(' ').nth(19)?.parse().ok());
        let start = start.ok_or_else(|| io::Error::from(io::ErrorKind::InvalidData))?;
        Ok(Self { pid, start, boot: boot_id() })
    }

    /// Returns whether both are the same process.
    fn matches(&self, found: &Self) -> bool {
        let boots_known = self.boot != 0 && found.boot != 0;
        (self.pid, self.start) == (found.pid, found.start) && (!boots_known || self.boot == found.boot)
    }

    /// Opens a pidfd of the process; `None` if it has ended.
    pub fn open_pidfd(&self) -> io::Result<Option<OwnedFd>> {
        let pidfd = match sys::pidfd_open(self.pid) {
            Err(error) if error.raw_os_error() == Some(libc::ESRCH) => return Ok(None),
            result => result?,
        };
        // Compared after opening: from here on the pid certainly belongs to the process held.
        match Self::from_pid(self.pid) {
            Ok(found) if self.matches(&found) && !has_ended(&pidfd) => Ok(Some(pidfd)),
            Ok(_) => Ok(None),
            Err(error) if is_process_gone(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

/// Returns whether reading below `/proc/PID` failed because the process is gone: its directory does not exist, or was
/// opened before the process ended.
fn is_process_gone(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::NotFound || error.raw_os_error() == Some(libc::ESRCH)
}

/// Returns whether a process has ended, reaped or not: its pidfd is readable then.
pub(crate) fn has_ended(pidfd: &OwnedFd) -> bool {
    let mut watched = [nix::poll::PollFd::new(pidfd.as_fd(), nix::poll::PollFlags::POLLIN)];
    nix::poll::poll(&mut watched, nix::poll::PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}

/// Returns the host pid of the process held by a pidfd (proc(5), /proc/PID/fdinfo).
pub(crate) fn pid_of(pidfd: &OwnedFd) -> Option<i32> {
    use std::os::fd::AsRawFd;
    let text = fs::read_to_string(format!("/proc/self/fdinfo/{}", pidfd.as_raw_fd())).ok()?;
    text.lines().find_map(|line| line.strip_prefix("Pid:")?.trim().parse().ok()).filter(|pid| *pid > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_found_and_another_with_its_number_is_not() {
        let mut child = std::process::Command::new("cat").stdin(std::process::Stdio::piped()).spawn().unwrap();
        let identity = ProcessIdentity::from_pid(child.id() as i32).unwrap();
        let pidfd = identity.open_pidfd().unwrap().expect("it runs");
        assert_eq!(pid_of(&pidfd), Some(identity.pid));
        assert!(!has_ended(&pidfd));
        let stranger = ProcessIdentity { start: identity.start + 1, ..identity };
        let of_another_boot = ProcessIdentity { boot: identity.boot ^ 1, ..identity };
        for other in [stranger, of_another_boot] {
            assert!(other.open_pidfd().unwrap().is_none(), "{other:?}");
        }
        // Record of an earlier version.
        let text = format!(r#"{{"pid":{},"start":{}}}"#, identity.pid, identity.start);
        let earlier: ProcessIdentity = serde_json::from_str(&text).unwrap();
        assert!(earlier.open_pidfd().unwrap().is_some());
        drop(child.stdin.take());
        child.wait().unwrap();
        assert!(identity.open_pidfd().unwrap().is_none());
        assert!(has_ended(&pidfd));
    }
}
