//! File systems that are mounted below a directory of the home. This version of the daemon mounts nothing there; an
//! earlier version that was killed during a bootstrap has left /proc, /sys and the host's own /dev/shm in the
//! unfinished base.

use std::ffi::OsString;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, umount2};

use super::{HomeError, io_error};

/// Mount table of the calling thread.
const TABLE: &str = "/proc/thread-self/mountinfo";

/// Detaches everything that is mounted below `directory`, but not what is mounted at `directory` itself.
pub(super) fn detach_below(directory: &Path) -> Result<(), HomeError> {
    let directory = directory.canonicalize().map_err(io_error("resolve", directory))?;
    let table = std::fs::read(TABLE).map_err(io_error("read", Path::new(TABLE)))?;
    // In reverse order: a mount on another mount comes after it in the table.
    for point in mount_points_below(&table, &directory).into_iter().rev() {
        tracing::warn!("detaching the mount of a previous daemon at {}", point.display());
        let flags = MntFlags::MNT_DETACH | MntFlags::UMOUNT_NOFOLLOW;
        umount2(&point, flags).map_err(|errno| io_error("detach", &point)(errno.into()))?;
    }
    Ok(())
}

/// Returns the mount points below a directory, in the order of the text of /proc/self/mountinfo
/// (proc_pid_mountinfo(5)).
fn mount_points_below(table: &[u8], directory: &Path) -> Vec<PathBuf> {
    let lines = table.split(|&byte| byte == b'\n');
    let points = lines.filter_map(|line| line.split(|&byte| byte == b' ').nth(4));
    points.map(unescape).filter(|point| point != directory && point.starts_with(directory)).collect()
}

/// Decodes a path of the table: spaces, tabs, newlines and backslashes are written as `\NNN`, in octal.
fn unescape(mut written: &[u8]) -> PathBuf {
    let mut path = Vec::with_capacity(written.len());
    while let Some((&byte, rest)) = written.split_first() {
        let digits = rest.get(..3).filter(|_| byte == b'\\');
        let digits = digits.and_then(|digits| std::str::from_utf8(digits).ok());
        match digits.and_then(|digits| u8::from_str_radix(digits, 8).ok()) {
            Some(escaped) => {
                path.push(escaped);
                written = &rest[3..];
            }
            None => {
                path.push(byte);
                written = rest;
            }
        }
    }
    OsString::from_vec(path).into()
}

#[cfg(test)]
mod tests {
    use nix::mount::{MsFlags, mount};
    use nix::sched::{CloneFlags, unshare};

    use super::*;
    use crate::home::Home;

    #[test]
    fn mounts_below_a_directory_are_found() {
        let table = b"20 1 8:1 / / rw - ext4 /dev/sda1 rw\n\
            21 20 8:2 / /h/build rw - ext4 /dev/sdb1 rw\n\
            22 21 0:5 / /h/build/a\\040b\\134/sys rw - sysfs sysfs rw\n\
            23 20 0:6 / /h/builds/c rw - tmpfs none rw\n";
        let found = mount_points_below(table, Path::new("/h/build"));
        assert_eq!(found, [Path::new("/h/build/a b\\/sys")]);
    }

    /// Runs `work` on a thread in a private mount namespace.
    fn in_private_mount_namespace(work: impl FnOnce() + Send) {
        std::thread::scope(|scope| {
            let apart = scope.spawn(|| {
                unshare(CloneFlags::CLONE_NEWNS).expect("a mount namespace; run this test as root");
                let flags = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
                mount(None::<&str>, "/", None::<&str>, flags, None::<&str>).expect("private");
                work();
            });
            apart.join().expect("no panic");
        });
    }

    #[test]
    fn a_sweep_detaches_what_is_mounted_and_removes_nothing_of_it() {
        let parent = tempfile::tempdir().expect("a directory");
        let (home, hosts) = (parent.path().join("home"), parent.path().join("shm"));
        let home = Home::open(&home).expect("free");
        std::fs::create_dir(&hosts).expect("made");
        std::fs::write(hosts.join("theirs"), "").expect("written");
        let build = home.path().join("build/push 1");
        let point = build.join("base-1/tree/dev/shm");
        std::fs::create_dir_all(&point).expect("made");
        in_private_mount_namespace(|| {
            let bind = MsFlags::MS_BIND;
            mount(Some(&hosts), &point, None::<&str>, bind, None::<&str>).expect("mounted");
            // Another mount, on top of that one.
            let below = point.join("below");
            std::fs::create_dir(&below).expect("made");
            let (kind, no_flags) = (Some("tmpfs"), MsFlags::empty());
            mount(Some("none"), &below, kind, no_flags, None::<&str>).expect("mounted");
            super::super::sweep_builds(&home.leftover_builds());
            assert!(!build.exists(), "it is swept");
        });
        assert!(hosts.join("theirs").exists(), "the host's files stay");
    }
}
