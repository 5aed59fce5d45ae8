//! Datagrams with attached file descriptors (`SCM_RIGHTS`, unix(7)).

use std::io;
use std::os::fd::RawFd;

/// Maximum number of file descriptors in one message.
pub const MAX_FDS: usize = 4;

const CONTROL: usize = 64;

#[repr(C, align(8))]
struct ControlBuffer([u8; CONTROL]);

/// Sends one message. Interrupted calls are repeated; a closed peer is an error, not a signal.
pub fn send(socket: RawFd, bytes: &[u8], fds: &[RawFd]) -> io::Result<usize> {
    let mut vector = libc::iovec { iov_base: bytes.as_ptr().cast_mut().cast(), iov_len: bytes.len() };
    let mut control = ControlBuffer([0; CONTROL]);
    // SAFETY: an all-zero msghdr is valid; every pointer put into it outlives the call.
    let mut message: libc::msghdr = unsafe { std::mem::zeroed() };
    message.msg_iov = &mut vector;
    message.msg_iovlen = 1;
    if !fds.is_empty() {
        let payload = std::mem::size_of_val(fds);
        assert!(fds.len() <= MAX_FDS, "at most {MAX_FDS} file descriptors fit beside a message");
        message.msg_control = control.0.as_mut_ptr().cast();
        // SAFETY: pure arithmetic.
        message.msg_controllen = unsafe { libc::CMSG_SPACE(payload as u32) } as _;
        // SAFETY: the control buffer is aligned and large enough for MAX_FDS descriptors, so that the first header and
        // its data lie within it.
        unsafe {
            let header = libc::CMSG_FIRSTHDR(&message);
            (*header).cmsg_level = libc::SOL_SOCKET;
            (*header).cmsg_type = libc::SCM_RIGHTS;
            (*header).cmsg_len = libc::CMSG_LEN(payload as u32) as _;
            std::ptr::copy_nonoverlapping(fds.as_ptr().cast::<u8>(), libc::CMSG_DATA(header), payload);
        }
    }
    loop {
        // SAFETY: `message` points to live buffers of the given lengths.
        let sent = unsafe { libc::sendmsg(socket, &message, libc::MSG_NOSIGNAL) };
        if sent >= 0 {
            return Ok(sent as usize);
        }
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
    }
}

/// Receives one message; returns the number of bytes and of file descriptors (close-on-exec, now owned by the caller).
/// Neither bytes nor descriptors mean that the peer has closed. A message longer than `bytes` is an error.
pub fn receive(socket: RawFd, bytes: &mut [u8], fds: &mut [RawFd; MAX_FDS]) -> io::Result<(usize, usize)> {
    let mut vector = libc::iovec { iov_base: bytes.as_mut_ptr().cast(), iov_len: bytes.len() };
    let mut control = ControlBuffer([0; CONTROL]);
    // SAFETY: an all-zero msghdr is valid; every pointer put into it outlives the calls.
    let mut message: libc::msghdr = unsafe { std::mem::zeroed() };
    message.msg_iov = &mut vector;
    message.msg_iovlen = 1;
    message.msg_control = control.0.as_mut_ptr().cast();
    message.msg_controllen = CONTROL as _;
    let received = loop {
        // SAFETY: `message` points to live, writable buffers of the given lengths.
        let received = unsafe { libc::recvmsg(socket, &mut message, libc::MSG_CMSG_CLOEXEC) };
        if received >= 0 {
            break received as usize;
        }
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
    };
    let mut count = 0;
    // SAFETY: the kernel filled the control buffer; the CMSG macros stay within msg_controllen.
    unsafe {
        let mut header = libc::CMSG_FIRSTHDR(&message);
        while !header.is_null() {
            if (*header).cmsg_level == libc::SOL_SOCKET && (*header).cmsg_type == libc::SCM_RIGHTS {
                let payload = (*header).cmsg_len as usize - libc::CMSG_LEN(0) as usize;
                let data = libc::CMSG_DATA(header).cast::<RawFd>();
                for index in 0..payload / size_of::<RawFd>() {
                    let fd = data.add(index).read_unaligned();
                    if count < MAX_FDS {
                        fds[count] = fd;
                        count += 1;
                    } else {
                        libc::close(fd);
                    }
                }
            }
            header = libc::CMSG_NXTHDR(&message, header);
        }
    }
    if message.msg_flags & (libc::MSG_TRUNC | libc::MSG_CTRUNC) != 0 {
        for fd in &fds[..count] {
            // SAFETY: just received, owned by nobody else.
            unsafe { libc::close(*fd) };
        }
        return Err(io::Error::from_raw_os_error(libc::EMSGSIZE));
    }
    Ok((received, count))
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
    use std::os::unix::net::{UnixDatagram, UnixStream};

    use super::*;

    #[test]
    fn a_descriptor_arrives_beside_its_message() {
        let (left, right) = UnixDatagram::pair().unwrap();
        let (mut near, far) = UnixStream::pair().unwrap();
        send(left.as_raw_fd(), b"hello", &[far.as_raw_fd()]).unwrap();
        drop(far);
        let (mut bytes, mut fds) = ([0; 16], [-1; MAX_FDS]);
        assert_eq!(receive(right.as_raw_fd(), &mut bytes, &mut fds).unwrap(), (5, 1));
        // SAFETY: received just now and owned by nobody else.
        let received = unsafe { OwnedFd::from_raw_fd(fds[0]) };
        UnixStream::from(received).write_all(b"through").unwrap();
        let mut text = String::new();
        near.read_to_string(&mut text).unwrap();
        assert_eq!((&bytes[..5], text.as_str()), (&b"hello"[..], "through"));
    }

    #[test]
    fn a_message_too_long_is_an_error_not_a_fragment() {
        let (left, right) = UnixDatagram::pair().unwrap();
        send(left.as_raw_fd(), &[7; 32], &[]).unwrap();
        let error = receive(right.as_raw_fd(), &mut [0; 16], &mut [-1; MAX_FDS]).unwrap_err();
        assert_eq!(error.raw_os_error(), Some(libc::EMSGSIZE));
    }
}
