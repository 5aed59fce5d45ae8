//! Whether a file system can be mounted with shifted user ids, tried for real: a detached copy of the mount is made,
//! shifted, and dropped. Nobody sees it.

#![allow(unsafe_code, reason = "system calls without a wrapper")]

use std::ffi::CString;
use std::fs::File;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// Tries it on the file system that holds `directory`.
pub fn try_on(directory: &Path) -> io::Result<()> {
    let namespace = UserNamespace::new()?;
    let mount = copy_of_mount(directory)?;
    let mut attributes = libc::mount_attr {
        attr_set: libc::MOUNT_ATTR_IDMAP,
        attr_clr: 0,
        propagation: 0,
        userns_fd: namespace.file.as_raw_fd() as u64,
    };
    // SAFETY: the path is an empty C string, the attributes are a live structure whose size is given with it, and
    // both descriptors are open.
    let outcome = unsafe {
        libc::syscall(
            libc::SYS_mount_setattr,
            mount.as_raw_fd(),
            c"".as_ptr(),
            libc::AT_EMPTY_PATH,
            &raw mut attributes,
            size_of::<libc::mount_attr>(),
        )
    };
    if outcome == 0 {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}

fn copy_of_mount(directory: &Path) -> io::Result<OwnedFd> {
    let path = CString::new(directory.as_os_str().as_bytes())?;
    // SAFETY: the path is a live C string.
    let fd = unsafe {
        libc::syscall(
            libc::SYS_open_tree,
            libc::AT_FDCWD,
            path.as_ptr(),
            libc::OPEN_TREE_CLONE | libc::OPEN_TREE_CLOEXEC,
        )
    };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the kernel gave this descriptor just now; nobody else owns it.
    Ok(unsafe { OwnedFd::from_raw_fd(fd as i32) })
}

/// A user namespace with some mapping, held by a process that waits to be ended.
struct UserNamespace {
    holder: Child,
    file: File,
}

impl UserNamespace {
    fn new() -> io::Result<UserNamespace> {
        let mut command = Command::new("/bin/cat");
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        // SAFETY: unshare is safe to call between fork and exec.
        unsafe {
            command.pre_exec(|| {
                nix::sched::unshare(nix::sched::CloneFlags::CLONE_NEWUSER).map_err(io::Error::from)
            });
        }
        let holder = command.spawn()?;
        let of = |file: &str| format!("/proc/{}/{file}", holder.id());
        let opened = std::fs::write(of("uid_map"), "0 100000 65536")
            .and_then(|()| std::fs::write(of("gid_map"), "0 100000 65536"))
            .and_then(|()| File::open(of("ns/user")));
        match opened {
            Ok(file) => Ok(UserNamespace { holder, file }),
            Err(error) => {
                end(holder);
                Err(error)
            }
        }
    }
}

impl Drop for UserNamespace {
    fn drop(&mut self) {
        let _ = self.holder.kill();
        let _ = self.holder.wait();
    }
}

fn end(mut holder: Child) {
    let _ = holder.kill();
    let _ = holder.wait();
}
