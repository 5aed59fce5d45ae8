//! Removal of a tree of any depth.
//!
//! The standard library's `remove_dir_all` recurses for each level and keeps a file open for each: fifteen thousand
//! nested directories overflow a thread's stack, which ends the process. Here the way back to the parent is `..`,
//! checked against the directory from which it was entered, so that a level costs only some bytes of the heap.

use std::ffi::{CStr, CString};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, FileType, Mode, OFlags, ResolveFlags, Stat};
use rustix::io::Errno;

use crate::Error;
use crate::tree::DIRECTORY;
use crate::walk::names;

/// Resolves below the directory only, through no link, and not into mounts.
const HERE: ResolveFlags = ResolveFlags::BENEATH
    .union(ResolveFlags::NO_SYMLINKS)
    .union(ResolveFlags::NO_MAGICLINKS)
    .union(ResolveFlags::NO_XDEV);

/// Removes `path` and everything below it. Links are removed, not followed. A path that does not exist is not an error.
/// Directories that their owner may not write are made writable first.
///
/// # Errors
/// [`Error::Mounted`] if a file system is mounted in the tree; [`Error::File`] if directories are moved meanwhile, or a
/// system call fails.
pub fn remove(path: &Path) -> Result<(), Error> {
    let failed = |action, error: Errno| Error::file(action, path, error);
    let above = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let Some(name) = path.file_name() else {
        return Err(failed("remove", Errno::INVAL));
    };
    let name = CString::new(name.as_encoded_bytes()).map_err(|_| failed("remove", Errno::INVAL))?;
    // The path to the tree is trusted.
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let parent = match rustix::fs::open(above, flags, Mode::empty()) {
        Ok(parent) => parent,
        Err(Errno::NOENT) => return Ok(()),
        Err(error) => return Err(failed("open the directory of", error)),
    };
    Remover { root: path }.run(parent, name)
}

struct Remover<'a> {
    root: &'a Path,
}

/// A directory that is being emptied.
struct RemovalLevel {
    name: CString,
    /// Device and inode of its parent directory.
    above: (u64, u64),
    /// Subdirectories still to be removed; everything else in it is gone.
    left: Vec<CString>,
}

impl Remover<'_> {
    fn run(&self, parent: OwnedFd, name: CString) -> Result<(), Error> {
        let mut stack: Vec<RemovalLevel> = Vec::new();
        let mut at = parent;
        let mut next = Some(name);
        loop {
            if let Some(name) = next.take() {
                if let Some((directory, left)) = self.enter(&at, &name, &stack)? {
                    let above = identity(&self.stat(&at, &stack)?);
                    at = directory;
                    stack.push(RemovalLevel { name, above, left });
                }
            }
            let Some(level) = stack.last_mut() else {
                return Ok(());
            };
            if let Some(below) = level.left.pop() {
                next = Some(below);
                continue;
            }
            let Some(level) = stack.pop() else {
                return Ok(());
            };
            let up = rustix::fs::openat(&at, c"..", DIRECTORY, Mode::empty())
                .map_err(|error| self.error_at("leave", &stack, &[&level.name], error))?;
            if identity(&self.stat(&up, &stack)?) != level.above {
                return Err(self.error_at("leave", &stack, &[&level.name], Errno::STALE));
            }
            at = up;
            match rustix::fs::unlinkat(&at, &level.name, AtFlags::REMOVEDIR) {
                Ok(()) | Err(Errno::NOENT) => {}
                Err(error) => return Err(self.error_at("remove", &stack, &[&level.name], error)),
            }
        }
    }

    /// Removes `name` unless it is a directory; in a directory, removes everything but subdirectories. Returns the
    /// directory and the names of its subdirectories.
    fn enter(
        &self,
        at: &OwnedFd,
        name: &CString,
        stack: &[RemovalLevel],
    ) -> Result<Option<(OwnedFd, Vec<CString>)>, Error> {
        let failed = |action, error| self.error_at(action, stack, &[name], error);
        match rustix::fs::statat(at, name, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) if FileType::from_raw_mode(stat.st_mode) == FileType::Directory => {}
            Ok(_) => {
                return match rustix::fs::unlinkat(at, name, AtFlags::empty()) {
                    Ok(()) | Err(Errno::NOENT) => Ok(None),
                    Err(error) => Err(failed("remove", error)),
                };
            }
            Err(Errno::NOENT) => return Ok(None),
            Err(error) => return Err(failed("look at", error)),
        }
        let open = || rustix::fs::openat2(at, name, DIRECTORY, Mode::empty(), HERE);
        let directory = match open() {
            Err(Errno::ACCESS) => {
                // Only users other than root are ever refused; the second attempt tells whether permissions were the
                // cause.
                let _ = rustix::fs::chmodat(at, name, Mode::RWXU, AtFlags::empty());
                open()
            }
            opened => opened,
        };
        let directory = match directory {
            Ok(directory) => directory,
            Err(Errno::NOENT) => return Ok(None),
            Err(error) => return Err(failed("open", error)),
        };
        let mut left = Vec::new();
        for entry in names(&directory).map_err(|error| failed("list", error))? {
            let mut removed = rustix::fs::unlinkat(&directory, &entry, AtFlags::empty());
            if removed == Err(Errno::ACCESS) {
                let _ = rustix::fs::fchmod(&directory, Mode::RWXU);
                removed = rustix::fs::unlinkat(&directory, &entry, AtFlags::empty());
            }
            match removed {
                Ok(()) | Err(Errno::NOENT) => {}
                // Linux answers EISDIR for a directory, POSIX EPERM.
                Err(Errno::ISDIR | Errno::PERM) => left.push(entry),
                Err(error) => return Err(self.error_at("remove", stack, &[name, &entry], error)),
            }
        }
        // Removing a directory needs write permission on its parent.
        if !left.is_empty() && self.stat(&directory, stack)?.st_mode & 0o700 != 0o700 {
            let _ = rustix::fs::fchmod(&directory, Mode::RWXU);
        }
        Ok(Some((directory, left)))
    }

    fn stat(&self, directory: &OwnedFd, stack: &[RemovalLevel]) -> Result<Stat, Error> {
        rustix::fs::fstat(directory).map_err(|error| self.error_at("look at", stack, &[c"."], error))
    }

    /// Builds the error of a system call on the path made of `names`, below the directories of the stack.
    fn error_at(&self, action: &'static str, stack: &[RemovalLevel], names: &[&CStr], error: Errno) -> Error {
        use std::os::unix::ffi::OsStrExt;
        let mut path = PathBuf::from(self.root);
        let above = stack.iter().map(|level| level.name.as_c_str());
        // The first name is that of the root itself.
        for name in above.chain(names.iter().copied()).skip(1) {
            path.push(std::ffi::OsStr::from_bytes(name.to_bytes()));
        }
        match error {
            // XDEV for a directory, BUSY for a file that something is mounted on.
            Errno::XDEV | Errno::BUSY => Error::Mounted { path },
            error => Error::file(action, &path, error),
        }
    }
}

fn identity(stat: &Stat) -> (u64, u64) {
    (stat.st_dev, stat.st_ino)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};
    use std::process::Command;

    #[test]
    fn a_tree_of_any_depth_is_removed() {
        let place = tempfile::tempdir().expect("a directory");
        let root = place.path().join("root");
        std::fs::create_dir(&root).expect("made");
        let mut at = rustix::fs::open(&root, DIRECTORY, Mode::empty()).expect("opened");
        for _ in 0..15_000 {
            rustix::fs::mkdirat(&at, "d", Mode::RWXU).expect("made");
            at = rustix::fs::openat(&at, "d", DIRECTORY, Mode::empty()).expect("opened");
        }
        drop(at);
        // With a small stack, so that one frame per level would not fit.
        let removed = root.clone();
        std::thread::Builder::new()
            .stack_size(128 << 10)
            .spawn(move || remove(&removed))
            .expect("a thread")
            .join()
            .expect("no panic")
            .expect("removed");
        assert!(!root.exists());
    }

    #[test]
    fn all_kinds_of_entries_go_and_what_links_point_to_stays() {
        let place = tempfile::tempdir().expect("a directory");
        let (root, outside) = (place.path().join("root"), place.path().join("outside"));
        std::fs::create_dir_all(root.join("a/b")).expect("made");
        std::fs::create_dir_all(root.join("a/c")).expect("made");
        std::fs::create_dir(&outside).expect("made");
        std::fs::write(outside.join("f"), "").expect("written");
        std::fs::write(root.join("a/b/f"), "").expect("written");
        symlink(&outside, root.join("a/link")).expect("linked");
        symlink("nowhere", root.join("dangling")).expect("linked");
        std::fs::set_permissions(root.join("a/b"), PermissionsExt::from_mode(0o500)).expect("set");
        std::fs::set_permissions(root.join("a/c"), PermissionsExt::from_mode(0o000)).expect("set");
        remove(&root).expect("removed");
        assert!(!root.exists() && outside.join("f").exists());
        remove(&root).expect("gone already");
        remove(&root.join("below/nothing")).expect("gone already");
    }

    /// The test runs itself once more in its own mount namespace, where only it sees the mounts.
    #[test]
    fn what_is_mounted_in_a_tree_stays_and_is_named() {
        const PLACE_VARIABLE: &str = "CLOUDROID_FOREIGN_PLACE";
        let Some(place) = std::env::var_os(PLACE_VARIABLE) else {
            let place = tempfile::tempdir().expect("a directory");
            let told = Command::new("unshare")
                .args(["--map-root-user", "--mount"])
                .arg(std::env::current_exe().expect("this test"))
                .args(["--exact", "remove::tests::what_is_mounted_in_a_tree_stays_and_is_named"])
                .env(PLACE_VARIABLE, place.path())
                .output()
                .expect("unshare, of util-linux");
            let said = String::from_utf8_lossy(&told.stdout);
            assert!(told.status.success() && said.contains("1 passed"), "{said}");
            return;
        };
        let place = PathBuf::from(place);
        let (root, outside) = (place.join("root"), place.join("outside"));
        std::fs::create_dir_all(root.join("a/sys")).expect("made");
        std::fs::create_dir(&outside).expect("made");
        std::fs::write(outside.join("f"), "the host's").expect("written");
        for (what, point) in [(&outside, "a/sys"), (&outside.join("f"), "f")] {
            // Entries that are not directories are removed first.
            std::fs::write(root.join("f"), "").expect("written");
            let point = root.join(point);
            let mounted = Command::new("mount").arg("--bind").arg(what).arg(&point).status();
            assert!(mounted.expect("mount, of util-linux").success());
            let refused = remove(&root).expect_err("something is mounted there").to_string();
            let expected = format!("a file system is mounted at {}; detach it", point.display());
            assert!(refused.starts_with(&expected), "{refused}");
            assert!(outside.join("f").exists());
            let detached = Command::new("umount").arg(&point).status();
            assert!(detached.expect("umount, of util-linux").success());
        }
        remove(&root).expect("removed");
    }

    #[test]
    fn a_link_in_the_trees_place_is_removed_itself() {
        let place = tempfile::tempdir().expect("a directory");
        let (root, outside) = (place.path().join("root"), place.path().join("outside"));
        std::fs::create_dir_all(outside.join("d")).expect("made");
        symlink(&outside, &root).expect("linked");
        remove(&root).expect("removed");
        assert!(!root.is_symlink() && outside.join("d").exists());
    }
}
