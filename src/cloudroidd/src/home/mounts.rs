//! File systems that are mounted below a directory of the home. No daemon of this version mounts anything there; one that was killed by an
//! earlier version during a bootstrap has left /proc, /sys and the host's own /dev/shm in the half-made base.

use std::ffi::OsString;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, umount2};

use super::{HomeError, io};

/// The mounts that the calling thread sees.
const TABLE: &str = "/proc/thread-self/mountinfo";

/// Detaches all that is mounted below `directory`, but not what is mounted at it.
pub(super) fn detach_below(directory: &Path) -> Result<(), HomeError> {
    let directory = directory.canonicalize().map_err(io("resolve", directory))?;
    let table = std::fs::read(TABLE).map_err(io("read", Path::new(TABLE)))?;
    // The last one first: what is mounted on another mount comes after it.
    for point in points_below(&table, &directory).into_iter().rev() {
        tracing::warn!(
            "detaching what an earlier daemon left mounted at {}",
            point.display()
        );
        let flags = MntFlags::MNT_DETACH | MntFlags::UMOUNT_NOFOLLOW;
        umount2(&point, flags).map_err(|errno| io("detach", &point)(errno.into()))?;
    }
    Ok(())
}

/// Mount points below a directory by the text of /proc/self/mountinfo (proc_pid_mountinfo(5)), in the order of that.
fn points_below(table: &[u8], directory: &Path) -> Vec<PathBuf> {
    let lines = table.split(|&byte| byte == b'\n');
    let points = lines.filter_map(|line| line.split(|&byte| byte == b' ').nth(4));
    points
        .map(unescaped)
        .filter(|point| point != directory && point.starts_with(directory))
        .collect()
}

/// A path as it is: spaces, tabs, line ends and backslashes are written `\NNN`, in octal.
fn unescaped(mut written: &[u8]) -> PathBuf {
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
        let found = points_below(table, Path::new("/h/build"));
        assert_eq!(found, [Path::new("/h/build/a b\\/sys")]);
    }

    /// Does `work` on a thread whose mounts nobody else sees.
    fn apart(work: impl FnOnce() + Send) {
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
        apart(|| {
            let bind = MsFlags::MS_BIND;
            mount(Some(&hosts), &point, None::<&str>, bind, None::<&str>).expect("mounted");
            // On that one, another.
            let below = point.join("below");
            std::fs::create_dir(&below).expect("made");
            let (kind, no_flags) = (Some("tmpfs"), MsFlags::empty());
            mount(Some("none"), &below, kind, no_flags, None::<&str>).expect("mounted");
            super::super::sweep_builds(&home.half_made_builds());
            assert!(!build.exists(), "it is swept");
        });
        assert!(hosts.join("theirs").exists(), "the host's files stay");
    }
}
