//! User namespaces: the one that a container lives in, whose map its layers have; and one that nobody lives in, to try out
//! whether mounts can be shifted.

use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use caps::CapSet;
use nix::errno::Errno;
use nix::sched::{CloneFlags, unshare};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::wait::waitpid;
use nix::unistd::{ForkResult, Uid, setresuid};

use crate::{Error, bundle, sys};

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

/// Makes the user namespace of a container, whose root is the first id of `range`. The calling process must have one thread.
///
/// What the kernel counts by user (instances of inotify, signals that wait, message queues, locked memory, processes) it counts
/// for the user inside and, with that, for whoever made the namespace. Made by root, each container would use up root's
/// counts of the whole host; so the maker is the first user of the range, who has nothing else. How much all users inside
/// may have together is what the maker may have.
pub(crate) fn user_namespace(range: (u32, u32)) -> Result<OwnedFd, Error> {
    let pair = || nix::unistd::pipe2(nix::fcntl::OFlag::O_CLOEXEC).map_err(Error::nix("pipe"));
    let ((unshared, tell), (wait, release)) = (pair()?, pair()?);
    // SAFETY: the calling process has one thread; the child makes system calls only.
    match unsafe { nix::unistd::fork() }.map_err(Error::nix("fork"))? {
        ForkResult::Child => {
            drop(release);
            let errno = unshare_as(range.0).err().map_or(0, |errno| errno as i32);
            let _ = nix::unistd::write(&tell, &errno.to_ne_bytes());
            let _ = nix::unistd::read(&wait, &mut [0]);
            // SAFETY: ends the child without running what the parent has registered for its own end.
            unsafe { libc::_exit(0) }
        }
        ForkResult::Parent { child } => {
            drop(tell);
            let mut errno = [0; 4];
            let read = nix::unistd::read(&unshared, &mut errno);
            let made = match (read, i32::from_ne_bytes(errno)) {
                (Ok(4), 0) => map(child.as_raw(), range),
                (_, errno) => Err(Error::call("unshare of a user namespace")(
                    io::Error::from_raw_os_error(errno),
                )),
            };
            drop(release);
            let _ = waitpid(child, None);
            made
        }
    }
}

/// Moves the calling process to a user namespace that `user` has made.
fn unshare_as(user: u32) -> nix::Result<()> {
    for (resource, most) in [
        (Resource::RLIMIT_SIGPENDING, bundle::PENDING_SIGNALS),
        (Resource::RLIMIT_MSGQUEUE, bundle::MESSAGE_QUEUES),
    ] {
        let most = getrlimit(resource)?.1.min(most);
        setrlimit(resource, most, most)?;
    }
    // Another user has no effective capability, but may take back those that are permitted. Where hosts let root alone make
    // user namespaces, it takes one.
    let user = Uid::from_raw(user);
    let held = caps::read(None, CapSet::Permitted).map_err(|_| Errno::EPERM)?;
    setresuid(Uid::from_raw(0), user, Uid::from_raw(0))?;
    caps::set(None, CapSet::Effective, &held).map_err(|_| Errno::EPERM)?;
    unshare(CloneFlags::CLONE_NEWUSER)
}

/// A process in a user namespace of its own, which waits to be ended. For programs of several threads: where there is one
/// thread, a fork is enough (see [`user_namespace`]).
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
            command.pre_exec(|| unshare(CloneFlags::CLONE_NEWUSER).map_err(io::Error::from));
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
