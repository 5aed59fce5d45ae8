//! Merging of extracted layers into a directory, like an overlay mount.

use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

use foreign::Visit;

use crate::error::{Error, IoContext};
use crate::modes::set_mode;

/// Copies `tree` over the content of `target`. Files are hard-linked if possible, so they must not be modified
/// afterwards. Deletions of the tree are applied. Blocking.
pub(crate) fn overlay_tree(tree: &Path, target: &Path) -> Result<(), Error> {
    let mut directories = Vec::new();
    foreign::walk(tree, |entry| {
        if entry.path.as_os_str().is_empty() {
            return Ok(Visit::Into);
        }
        let (from, to) = (entry.display_path(), target.join(entry.path));
        let from = from.as_path();
        let about = from.symlink_metadata().io_context("reading", from)?;
        let kind = about.file_type();
        let there = to.symlink_metadata().ok().map(|there| there.is_dir());
        if kind.is_dir() {
            let hides = is_opaque(from);
            if there.is_some_and(|directory| !directory || hides) {
                remove(&to)?;
            }
            if hides || there != Some(true) {
                fs::create_dir(&to).io_context("making", &to)?;
            }
            std::os::unix::fs::lchown(&to, Some(about.uid()), Some(about.gid()))
                .io_context("changing the owner of", &to)?;
            directories.push((to, about));
            return Ok(Visit::Into);
        }
        if there.is_some() {
            remove(&to)?;
        }
        if kind.is_char_device() && about.rdev() == 0 {
            return Ok(Visit::Into);
        }
        if kind.is_symlink() {
            let link = fs::read_link(from).io_context("reading", from)?;
            std::os::unix::fs::symlink(link, &to).io_context("linking", &to)?;
            std::os::unix::fs::lchown(&to, Some(about.uid()), Some(about.gid()))
                .io_context("changing the owner of", &to)?;
        } else if kind.is_file() {
            link(from, &to)?;
        }
        Ok::<_, Error>(Visit::Into)
    })?;
    // Last, since writing into a directory changes its time and may need its permissions.
    for (path, about) in directories.iter().rev() {
        set_mode(path, about.mode() & 0o7777)?;
        let time = about.modified().io_context("reading", path)?;
        let opened = fs::File::open(path).io_context("opening", path)?;
        opened.set_modified(time).io_context("changing the time of", path)?;
    }
    Ok(())
}

fn link(from: &Path, to: &Path) -> Result<(), Error> {
    if fs::hard_link(from, to).is_ok() {
        return Ok(());
    }
    let about = from.metadata().io_context("reading", from)?;
    fs::copy(from, to).io_context("copying", from)?;
    std::os::unix::fs::lchown(to, Some(about.uid()), Some(about.gid())).io_context("changing the owner of", to)?;
    set_mode(to, about.mode() & 0o7777)?;
    let time = about.modified().io_context("reading", from)?;
    let opened = fs::File::options().write(true).open(to).io_context("opening", to)?;
    opened.set_modified(time).io_context("changing the time of", to)
}

fn remove(path: &Path) -> Result<(), Error> {
    let directory = path.symlink_metadata().is_ok_and(|about| about.is_dir());
    if directory { Ok(foreign::remove(path)?) } else { fs::remove_file(path).io_context("removing", path) }
}

/// Returns whether a directory hides the lower layers.
fn is_opaque(path: &Path) -> bool {
    ["trusted.overlay.opaque", "user.overlay.opaque"].iter().any(|name| {
        let mut value = [0; 1];
        matches!(rustix::fs::getxattr(path, *name, &mut value[..]), Ok(1)) && value == *b"y"
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn write(root: &Path, path: &str, text: &str) {
        let path = root.join(path);
        fs::create_dir_all(path.parent().expect("below")).expect("made");
        fs::write(path, text).expect("written");
    }

    fn opaque(path: &Path) {
        let set = |name: &str| rustix::fs::setxattr(path, name, b"y", rustix::fs::XattrFlags::empty());
        set("trusted.overlay.opaque").or_else(|_| set("user.overlay.opaque")).expect("marked");
    }

    #[test]
    fn the_last_one_counts_and_deletions_delete() {
        let place = tempfile::tempdir().expect("a directory");
        let (one, two, all) = (place.path().join("1"), place.path().join("2"), place.path().join("all"));
        for (path, text) in
            [("a/same", "1"), ("a/gone", "1"), ("a/was_directory/x", "1"), ("a/was_file", "1"), ("new_again/old", "1")]
        {
            write(&one, path, text);
        }
        write(&two, "a/same", "2");
        write(&two, "a/was_file/inner", "2");
        write(&two, "a/was_directory", "2");
        write(&two, "new_again/new", "2");
        symlink("same", two.join("a/link")).expect("linked");
        opaque(&two.join("new_again"));
        set_mode(&two.join("a/same"), 0o755).expect("set");
        set_mode(&two.join("new_again"), 0o500).expect("set");
        // Only root can create an overlay's deletion mark.
        let mark = rustix::fs::mknodat(
            rustix::fs::CWD,
            two.join("a/gone"),
            rustix::fs::FileType::CharacterDevice,
            rustix::fs::Mode::empty(),
            0,
        );
        fs::create_dir(&all).expect("made");
        for tree in [&one, &two] {
            overlay_tree(tree, &all).expect("laid over");
        }
        let read = |path: &str| fs::read_to_string(all.join(path)).ok();
        assert_eq!(read("a/same").as_deref(), Some("2"));
        assert_eq!(read("a/link").as_deref(), Some("2"));
        assert_eq!(read("a/was_file/inner").as_deref(), Some("2"));
        assert_eq!(read("a/was_directory").as_deref(), Some("2"));
        assert_eq!((read("new_again/old"), read("new_again/new").as_deref()), (None, Some("2")));
        assert_eq!(read("a/gone").is_some(), mark.is_err());
        let mode = |path: &str| all.join(path).metadata().expect("there").mode() & 0o777;
        assert_eq!((mode("a/same"), mode("new_again")), (0o755, 0o500));
        // The source trees are unchanged.
        assert_eq!(fs::read_to_string(one.join("a/same")).expect("there"), "1");
    }
}
