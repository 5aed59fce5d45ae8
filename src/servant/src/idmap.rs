//! User namespaces: the one of a container, whose id mapping its layers have; and an empty one to test whether mounts
//! can be idmapped.

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

use crate::{Error, sys};

/// Limit of pending signals per user of a container; each of its timers counts as one, too.
pub const PENDING_SIGNALS: u64 = 4096;

/// Limit of bytes in POSIX message queues per user of a container: the kernel's default.
pub const MESSAGE_QUEUES: u64 = 819_200;

/// Tests idmapped mounts on the file system that holds `directory`: a detached copy of the mount is created, idmapped,
/// and dropped, invisibly to others.
///
/// # Errors
/// Fails if the file system or the kernel does not support idmapped mounts, or this process may not use them.
pub fn check_idmap_support(directory: &Path) -> Result<(), Error> {
    let holder = NamespaceHolder::new().map_err(Error::call("unshare of a user namespace"))?;
    let namespace = write_id_maps(holder.0.id() as i32, (100_000, 65_536))?;
    let mount = sys::clone_mount(directory).map_err(Error::file("copy the mount of", directory))?;
    sys::idmap_mount(mount.as_fd(), namespace.as_fd()).map_err(Error::file("shift the user ids of", directory))
}

/// Writes the id mapping of a process's user namespace, from 0 to `count` ids starting at `first`; returns the
/// namespace.
pub(crate) fn write_id_maps(pid: i32, (first, count): (u32, u32)) -> Result<OwnedFd, Error> {
    for file in ["uid_map", "gid_map"] {
        let path = format!("/proc/{pid}/{file}");
        fs::write(&path, format!("0 {first} {count}\n")).map_err(Error::file("write", &path))?;
    }
    let path = format!("/proc/{pid}/ns/user");
    Ok(File::open(&path).map_err(Error::file("open", &path))?.into())
}

/// Creates the user namespace of a container, whose root is the first id of `range`. The calling process must have one
/// thread.
///
/// The kernel counts some resources per user (inotify instances, pending signals, message queues, locked memory,
/// processes): for the user inside, and also for the creator of the namespace. If root created them, each container
/// would use up root's limits for the whole host; so the creator is the first user of the range, who owns nothing else.
/// The creator's limits bound all users inside together.
pub(crate) fn create_user_namespace(range: (u32, u32)) -> Result<OwnedFd, Error> {
    let pair = || nix::unistd::pipe2(nix::fcntl::OFlag::O_CLOEXEC).map_err(Error::nix("pipe"));
    let ((unshared, tell), (wait, release)) = (pair()?, pair()?);
    // SAFETY: the calling process has one thread; the child only makes system calls.
    match unsafe { nix::unistd::fork() }.map_err(Error::nix("fork"))? {
        ForkResult::Child => {
            drop(release);
            let errno = unshare_as(range.0).err().map_or(0, |errno| errno as i32);
            let _ = nix::unistd::write(&tell, &errno.to_ne_bytes());
            let _ = nix::unistd::read(&wait, &mut [0]);
            // SAFETY: ends the child without running the exit handlers registered by the parent.
            unsafe { libc::_exit(0) }
        }
        ForkResult::Parent { child } => {
            drop(tell);
            let mut errno = [0; 4];
            let read = nix::unistd::read(&unshared, &mut errno);
            let made = match (read, i32::from_ne_bytes(errno)) {
                (Ok(4), 0) => write_id_maps(child.as_raw(), range),
                (_, errno) => Err(Error::call("unshare of a user namespace")(io::Error::from_raw_os_error(errno))),
            };
            drop(release);
            let _ = waitpid(child, None);
            made
        }
    }
}

/// Moves the calling process to a user namespace created by `user`.
fn unshare_as(user: u32) -> nix::Result<()> {
    for (resource, most) in
        [(Resource::RLIMIT_SIGPENDING, PENDING_SIGNALS), (Resource::RLIMIT_MSGQUEUE, MESSAGE_QUEUES)]
    {
        let most = getrlimit(resource)?.1.min(most);
        setrlimit(resource, most, most)?;
    }
    // Changing the user clears the effective capabilities, but the permitted ones can be restored. Hosts that let only
    // root create user namespaces require one.
    let user = Uid::from_raw(user);
    let held = caps::read(None, CapSet::Permitted).map_err(|_| Errno::EPERM)?;
    setresuid(Uid::from_raw(0), user, Uid::from_raw(0))?;
    caps::set(None, CapSet::Effective, &held).map_err(|_| Errno::EPERM)?;
    unshare(CloneFlags::CLONE_NEWUSER)
}

/// A process in its own user namespace that waits to be killed. For programs with several threads; with one thread a
/// fork is enough (see [`create_user_namespace`]).
struct NamespaceHolder(Child);

impl NamespaceHolder {
    fn new() -> io::Result<Self> {
        let mut command = Command::new("/bin/cat");
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        // SAFETY: unshare is safe to call between fork and exec.
        unsafe {
            command.pre_exec(|| unshare(CloneFlags::CLONE_NEWUSER).map_err(io::Error::from));
        }
        command.spawn().map(Self)
    }
}

impl Drop for NamespaceHolder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
