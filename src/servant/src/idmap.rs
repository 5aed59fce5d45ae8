//! Mounts with shifted user ids: a user namespace that nobody lives in gives its map to them.

use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use crate::{Error, sys};

/// Tries it on the file system that holds `directory`: a detached copy of the mount is made, shifted, and dropped. Nobody
/// sees it.
///
/// # Errors
/// The file system or the kernel does not know shifted ids, or this process may not use them.
pub fn try_on(directory: &Path) -> Result<(), Error> {
    let holder = Holder::new().map_err(Error::call("unshare of a user namespace"))?;
    let namespace = map(holder.0.id() as i32, (100_000, 65_536))?;
    let mount = sys::clone_mount(directory).map_err(Error::file("copy the mount of", directory))?;
    sys::shift_mount(mount.as_fd(), namespace.as_fd())
        .map_err(Error::file("shift the user ids of", directory))
}

/// Gives the user namespace of a process its map, from 0 to `count` ids from `first` on; the namespace.
pub(crate) fn map(pid: i32, (first, count): (u32, u32)) -> Result<OwnedFd, Error> {
    for file in ["uid_map", "gid_map"] {
        let path = format!("/proc/{pid}/{file}");
        fs::write(&path, format!("0 {first} {count}\n")).map_err(Error::file("write", &path))?;
    }
    let path = format!("/proc/{pid}/ns/user");
    Ok(File::open(&path)
        .map_err(Error::file("open", &path))?
        .into())
}

/// A process in a user namespace of its own, which waits to be ended. For programs of several threads: where there is one
/// thread, a fork is enough (see `rootfs::stage`).
struct Holder(Child);

impl Holder {
    fn new() -> io::Result<Self> {
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
        command.spawn().map(Self)
    }
}

impl Drop for Holder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
