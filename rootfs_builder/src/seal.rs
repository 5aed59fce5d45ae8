//! Sealing of a pushed tree, so that a build sees only what its cache key covers.
//!
//! A compiled layer is looked up by a hash of the sources, by anyone who pushes the same ones. So if a build could see
//! anything that the hash does not cover, one deployer could influence what another one gets. The hash covers names,
//! contents, links and execute bits; the rest is made uniform: permissions, times, and the directories of version
//! control, which change with every commit and contain executable hooks and settings, are removed.

use std::ffi::OsStr;
use std::path::Path;

use foreign::Visit;
use rustix::fs::{AtFlags, FileType, Mode, Timespec, Timestamps};

use crate::bootstrap::EPOCH;
use crate::error::Error;

/// Names of version control directories, and of files that point to them.
const VERSION_CONTROL: [&str; 4] = [".git", ".hg", ".svn", ".bzr"];

/// Seals a pushed tree of sources. Blocking.
pub(crate) fn seal(root: &Path) -> Result<(), Error> {
    let mut left_out = Vec::new();
    foreign::walk(root, |entry| {
        if VERSION_CONTROL.iter().any(|name| entry.name() == OsStr::new(name)) {
            left_out.push(entry.display_path());
            return Ok(Visit::Skip);
        }
        Ok::<_, Error>(Visit::Into)
    })?;
    for path in left_out {
        foreign::remove(&path)?;
    }
    normalize_metadata(root)
}

/// Sets all times to the same value, and permissions that depend on "executable" only. Files generated during the build
/// get later times, so that tools which compare times treat them as newer.
fn normalize_metadata(root: &Path) -> Result<(), Error> {
    let moment = Timespec { tv_sec: EPOCH as i64, tv_nsec: 0 };
    let times = Timestamps { last_access: moment, last_modification: moment };
    foreign::walk(root, |entry| {
        let (parent, name) = entry.parent_and_name();
        let failed = |error: rustix::io::Errno| Error::io("sealing", entry.display_path(), error.into());
        let mode = entry.stat.st_mode;
        match entry.kind() {
            FileType::Symlink => {}
            kind => {
                let runs = kind == FileType::Directory || mode & 0o111 != 0;
                let wanted = if runs { 0o755 } else { 0o644 };
                if mode & 0o7777 != wanted {
                    // On a link this would change its target; it is not a link, and nobody else changes this tree.
                    rustix::fs::chmodat(parent, name, Mode::from_raw_mode(wanted), AtFlags::empty()).map_err(failed)?;
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

    fn pushed_tree() -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("a directory");
        fs::create_dir_all(root.path().join("src/p")).expect("made");
        fs::write(root.path().join("src/p/CMakeLists.txt"), "project(p)").expect("written");
        root
    }

    /// Returns all properties of a tree that a program can see: names, types, modes, times, contents.
    fn visible(root: &Path) -> Vec<String> {
        let mut all = Vec::new();
        foreign::walk(root, |entry| {
            let content = match entry.kind() {
                FileType::RegularFile => fs::read_to_string(entry.display_path()).expect("text"),
                FileType::Symlink => format!("{:?}", entry.read_link().expect("a link")),
                _ => String::new(),
            };
            all.push(format!("{} {:o} {} {content}", entry.path.display(), entry.stat.st_mode, entry.stat.st_mtime));
            Ok::<_, foreign::Error>(Visit::Into)
        })
        .expect("walked");
        all
    }

    #[test]
    fn trees_of_one_key_look_the_same_to_a_build() {
        let (clean, poisoned) = (pushed_tree(), pushed_tree());
        let inside = |path: &str| poisoned.path().join(path);
        fs::create_dir_all(inside(".git/hooks")).expect("made");
        fs::write(inside(".git/config"), "[core] fsmonitor = /bin/evil").expect("written");
        fs::write(inside("src/p/.git"), "gitdir: ../../other").expect("written");
        fs::create_dir_all(inside("src/p/.hg")).expect("made");
        symlink("src", inside(".svn")).expect("linked");
        let file = inside("src/p/CMakeLists.txt");
        fs::set_permissions(&file, fs::Permissions::from_mode(0o606)).expect("set");
        let opened = fs::File::options().write(true).open(&file).expect("opened");
        opened.set_modified(std::time::UNIX_EPOCH).expect("another time");
        for root in [clean.path(), poisoned.path()] {
            seal(root).expect("sealed");
        }
        assert_eq!(
            key::hash_sources(clean.path()).expect("hashed"),
            key::hash_sources(poisoned.path()).expect("hashed")
        );
        assert_eq!(visible(clean.path()), visible(poisoned.path()));
    }

    #[test]
    fn what_a_build_can_see_is_in_its_key() {
        let (clean, other) = (pushed_tree(), pushed_tree());
        // Not sealed here: whatever is not removed is part of the key anyway.
        fs::create_dir(other.path().join(".git")).expect("made");
        fs::write(other.path().join(".git/config"), "x").expect("written");
        assert_ne!(key::hash_sources(clean.path()).expect("hashed"), key::hash_sources(other.path()).expect("hashed"));
    }

    #[test]
    fn programs_stay_programs_and_links_are_not_followed() {
        let (root, outside) = (pushed_tree(), tempfile::tempdir().expect("a directory"));
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
