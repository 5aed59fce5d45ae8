//! Changes a pushed tree so that a build sees only what its cache key covers.
//!
//! A compiled layer is found again by a hash of the sources, by whoever pushes the same ones next. So whatever a build
//! could see and the hash does not cover would let one deployer choose what another one gets. The hash covers names, contents,
//! links and who may execute; the rest is made the same for everybody: rights, times, and the directories of version
//! control, which change with every commit, and whose hooks and settings are programs, are taken away.

use std::ffi::OsStr;
use std::path::Path;

use foreign::Visit;
use rustix::fs::{AtFlags, FileType, Mode, Timespec, Timestamps};

use crate::bootstrap::EPOCH;
use crate::error::Error;

/// Names of version control's directories, and of files that point to them.
const LEFT_OUT: [&str; 4] = [".git", ".hg", ".svn", ".bzr"];

/// Seals a pushed tree of sources. Blocking.
pub(crate) fn seal(root: &Path) -> Result<(), Error> {
    let mut left_out = Vec::new();
    foreign::walk(root, |entry| {
        if LEFT_OUT.iter().any(|name| entry.name() == OsStr::new(name)) {
            left_out.push(entry.shown());
            return Ok(Visit::Skip);
        }
        Ok::<_, Error>(Visit::Into)
    })?;
    for path in left_out {
        foreign::remove(&path)?;
    }
    same_for_all(root)
}

/// Every time the same, and rights that differ in nothing but "executable". Files that a program makes in between get
/// another time than these, so that tools which compare times see what was made as newer.
fn same_for_all(root: &Path) -> Result<(), Error> {
    let moment = Timespec {
        tv_sec: EPOCH as i64,
        tv_nsec: 0,
    };
    let times = Timestamps {
        last_access: moment,
        last_modification: moment,
    };
    foreign::walk(root, |entry| {
        let (parent, name) = entry.place();
        let failed = |error: rustix::io::Errno| Error::io("sealing", entry.shown(), error.into());
        let mode = entry.stat.st_mode;
        match entry.kind() {
            FileType::Symlink => {}
            kind => {
                let runs = kind == FileType::Directory || mode & 0o111 != 0;
                let wanted = if runs { 0o755 } else { 0o644 };
                if mode & 0o7777 != wanted {
                    // Of a link this would change what it points to; it is none, and nobody else changes this tree.
                    rustix::fs::chmodat(
                        parent,
                        name,
                        Mode::from_raw_mode(wanted),
                        AtFlags::empty(),
                    )
                    .map_err(failed)?;
                }
            }
        }
        rustix::fs::utimensat(parent, name, &times, AtFlags::SYMLINK_NOFOLLOW).map_err(failed)?;
        Ok::<_, Error>(Visit::Into)
    })
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};

    use super::*;
    use crate::key;

    fn pushed() -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("a directory");
        fs::create_dir_all(root.path().join("src/p")).expect("made");
        fs::write(root.path().join("src/p/CMakeLists.txt"), "project(p)").expect("written");
        root
    }

    /// All properties of a tree that a program can see: names, kinds, modes, times, contents.
    fn visible(root: &Path) -> Vec<String> {
        let mut all = Vec::new();
        foreign::walk(root, |entry| {
            let content = match entry.kind() {
                FileType::RegularFile => fs::read_to_string(entry.shown()).expect("text"),
                FileType::Symlink => format!("{:?}", entry.link().expect("a link")),
                _ => String::new(),
            };
            all.push(format!(
                "{} {:o} {} {content}",
                entry.path.display(),
                entry.stat.st_mode,
                entry.stat.st_mtime
            ));
            Ok::<_, foreign::Error>(Visit::Into)
        })
        .expect("walked");
        all
    }

    #[test]
    fn trees_of_one_key_look_the_same_to_a_build() {
        let (clean, poisoned) = (pushed(), pushed());
        let inside = |path: &str| poisoned.path().join(path);
        fs::create_dir_all(inside(".git/hooks")).expect("made");
        fs::write(inside(".git/config"), "[core] fsmonitor = /bin/evil").expect("written");
        fs::write(inside("src/p/.git"), "gitdir: ../../other").expect("written");
        fs::create_dir_all(inside("src/p/.hg")).expect("made");
        symlink("src", inside(".svn")).expect("linked");
        let file = inside("src/p/CMakeLists.txt");
        fs::set_permissions(&file, fs::Permissions::from_mode(0o606)).expect("set");
        let opened = fs::File::options().write(true).open(&file).expect("opened");
        opened
            .set_modified(std::time::UNIX_EPOCH)
            .expect("another time");
        for root in [clean.path(), poisoned.path()] {
            seal(root).expect("sealed");
        }
        assert_eq!(
            key::sources(clean.path()).expect("hashed"),
            key::sources(poisoned.path()).expect("hashed")
        );
        assert_eq!(visible(clean.path()), visible(poisoned.path()));
    }

    #[test]
    fn what_a_build_can_see_is_in_its_key() {
        let (clean, other) = (pushed(), pushed());
        // Nothing is sealed here: whatever somebody forgets to take away is in the key all the same.
        fs::create_dir(other.path().join(".git")).expect("made");
        fs::write(other.path().join(".git/config"), "x").expect("written");
        assert_ne!(
            key::sources(clean.path()).expect("hashed"),
            key::sources(other.path()).expect("hashed")
        );
    }

    #[test]
    fn programs_stay_programs_and_links_are_not_followed() {
        let (root, outside) = (pushed(), tempfile::tempdir().expect("a directory"));
        let target = outside.path().join("f");
        fs::write(&target, "").expect("written");
        fs::set_permissions(&target, fs::Permissions::from_mode(0o600)).expect("set");
        let script = root.path().join("run.py");
        fs::write(&script, "#!").expect("written");
        fs::set_permissions(&script, fs::Permissions::from_mode(0o700)).expect("set");
        symlink(&target, root.path().join("link")).expect("linked");
        seal(root.path()).expect("sealed");
        let about = |path: &Path| path.metadata().expect("there");
        assert_eq!(about(&script).mode() & 0o777, 0o755);
        assert_eq!(about(&target).mode() & 0o777, 0o600);
        assert_ne!(about(&target).mtime(), EPOCH as i64);
    }
}
