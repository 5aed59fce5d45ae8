//! Supplementary groups of the process at the other end of a Unix socket.

#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsFd, AsRawFd};

/// Socket option (unix(7), since Linux 4.13), which libc does not define; the number holds for all architectures
/// except SPARC and PA-RISC.
const SO_PEERGROUPS: libc::c_int = 59;
/// Maximum number of groups of a process (setgroups(2)).
const MAX_GROUPS: usize = 65_536;

/// Returns the groups that the process had when it connected.
pub fn peer_groups(stream: &impl AsFd) -> io::Result<Vec<libc::gid_t>> {
    let mut groups: Vec<libc::gid_t> = vec![0; 32];
    loop {
        let room = size_of_val(groups.as_slice());
        let mut length = room as libc::socklen_t;
        // SAFETY: `groups` has `length` bytes to write to, and the kernel writes no more; any bits are a gid_t.
        let outcome = unsafe {
            libc::getsockopt(
                stream.as_fd().as_raw_fd(),
                libc::SOL_SOCKET,
                SO_PEERGROUPS,
                groups.as_mut_ptr().cast(),
                &raw mut length,
            )
        };
        let needed = length as usize / size_of::<libc::gid_t>();
        if outcome == 0 {
            groups.truncate(needed);
            return Ok(groups);
        }
        let error = io::Error::last_os_error();
        // If the buffer is too small, the kernel returns the size needed.
        if error.raw_os_error() != Some(libc::ERANGE) || needed <= groups.len() || needed > MAX_GROUPS {
            return Err(error);
        }
        groups.resize(needed, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_those_of_the_process_that_connected() {
        let (one, other) = std::os::unix::net::UnixStream::pair().expect("a pair");
        let mut told = peer_groups(&one).expect("told");
        assert_eq!(told, peer_groups(&other).expect("told"));
        let mut own: Vec<_> =
            nix::unistd::getgroups().expect("told").into_iter().map(nix::unistd::Gid::as_raw).collect();
        told.sort_unstable();
        own.sort_unstable();
        assert_eq!(told, own);
    }
}
