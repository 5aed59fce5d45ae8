//! Processes by more than their number.

use std::fs;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

use crate::sys;
pub use crate::sys::give_back_memory;

/// A process that is named in a file: its number alone may be somebody else's by the time it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// Process id on the host.
    pub pid: i32,
    /// Clock ticks from boot to its start (proc(5), /proc/PID/stat, field 22).
    pub start: u64,
    /// Which boot: the first half of its random id (proc(5), /proc/sys/kernel/random/boot_id). 0, in records of earlier
    /// versions, is any.
    #[serde(default)]
    pub boot: u64,
}

/// The first half of this boot's id; 0 where `/proc` does not tell.
fn boot() -> u64 {
    static BOOT: OnceLock<u64> = OnceLock::new();
    *BOOT.get_or_init(|| {
        let text = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        let digits = text.chars().filter(char::is_ascii_hexdigit);
        u64::from_str_radix(&digits.take(16).collect::<String>(), 16).unwrap_or(0)
    })
}

impl Identity {
    /// That of a running process.
    pub fn of(pid: i32) -> io::Result<Self> {
        let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
        // The name, in parentheses, may hold anything; fields are counted after its end.
        let start = stat
            .rsplit_once(") ")
            .and_then(|(_, fields)| fields.split(' ').nth(19)?.parse().ok());
        let start = start.ok_or_else(|| io::Error::from(io::ErrorKind::InvalidData))?;
        Ok(Self {
            pid,
            start,
            boot: boot(),
        })
    }

    /// Whether a record is of the same process as another.
    fn is(&self, found: &Self) -> bool {
        let boots_known = self.boot != 0 && found.boot != 0;
        (self.pid, self.start) == (found.pid, found.start)
            && (!boots_known || self.boot == found.boot)
    }

    /// Holds on to it; none when it has ended.
    pub fn open(&self) -> io::Result<Option<OwnedFd>> {
        let pidfd = match sys::pidfd_open(self.pid) {
            Err(error) if error.raw_os_error() == Some(libc::ESRCH) => return Ok(None),
            result => result?,
        };
        // Compared after it was opened: from here on the number is surely that of the process held.
        match Self::of(self.pid) {
            Ok(found) if self.is(&found) && !has_ended(&pidfd) => Ok(Some(pidfd)),
            Ok(_) => Ok(None),
            Err(error) if is_of_nobody(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

/// Whether reading below `/proc/PID` failed because the process is gone: its directory is not there, or was opened before it went.
fn is_of_nobody(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::NotFound || error.raw_os_error() == Some(libc::ESRCH)
}

/// Whether a process has ended, reaped or not: its pidfd is readable then.
pub(crate) fn has_ended(pidfd: &OwnedFd) -> bool {
    let mut watched = [nix::poll::PollFd::new(
        pidfd.as_fd(),
        nix::poll::PollFlags::POLLIN,
    )];
    nix::poll::poll(&mut watched, nix::poll::PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}

/// The number on the host of a process held by its pidfd (proc(5), /proc/PID/fdinfo).
pub(crate) fn pid_of(pidfd: &OwnedFd) -> Option<i32> {
    use std::os::fd::AsRawFd;
    let text = fs::read_to_string(format!("/proc/self/fdinfo/{}", pidfd.as_raw_fd())).ok()?;
    text.lines()
        .find_map(|line| line.strip_prefix("Pid:")?.trim().parse().ok())
        .filter(|pid| *pid > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_found_and_another_with_its_number_is_not() {
        let mut child = std::process::Command::new("cat")
            .stdin(std::process::Stdio::piped())
            .spawn()
            .unwrap();
        let identity = Identity::of(child.id() as i32).unwrap();
        let pidfd = identity.open().unwrap().expect("it runs");
        assert_eq!(pid_of(&pidfd), Some(identity.pid));
        assert!(!has_ended(&pidfd));
        let stranger = Identity {
            start: identity.start + 1,
            ..identity
        };
        let of_another_boot = Identity {
            boot: identity.boot ^ 1,
            ..identity
        };
        for other in [stranger, of_another_boot] {
            assert!(other.open().unwrap().is_none(), "{other:?}");
        }
        // What an earlier version wrote.
        let text = format!(r#"{{"pid":{},"start":{}}}"#, identity.pid, identity.start);
        let earlier: Identity = serde_json::from_str(&text).unwrap();
        assert!(earlier.open().unwrap().is_some());
        drop(child.stdin.take());
        child.wait().unwrap();
        assert!(identity.open().unwrap().is_none());
        assert!(has_ended(&pidfd));
    }
}
