//! Files and directories that only this user can access: servant environments, token hashes, pushed sources, build logs
//! (docs/adr/033).

use std::fs::{DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;

/// Permission bits of group and others.
const OTHERS: u32 = 0o077;

/// Creates a directory and its missing parents.
pub fn make_directory(path: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(path)
}

/// Opens a file for reading and writing, creating it if needed.
pub fn open(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(path)?;
    restrict_to_owner(path)?;
    Ok(file)
}

/// Writes a file atomically, creating its directory if needed.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    if let Some(directory) = path.parent() {
        make_directory(directory)?;
    }
    let begun = path.with_extension("begun");
    let mut file = open(&begun)?;
    file.set_len(0)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    std::fs::rename(&begun, path)
}

/// Removes the permissions of group and others on a file or directory. Links and missing paths are skipped.
pub fn restrict_to_owner(path: &Path) -> io::Result<()> {
    let about = match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        about => about?,
    };
    let mode = about.permissions().mode() & 0o7777;
    if about.is_symlink() || mode & OTHERS == 0 {
        return Ok(());
    }
    match std::fs::set_permissions(path, Permissions::from_mode(mode & !OTHERS)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

/// Removes the permissions of group and others on a directory and its entries, down to the given number of levels;
/// deeper entries cannot be reached through it anyway. Entries for which `leave` returns true are skipped.
pub fn restrict_tree(path: &Path, levels: usize, leave: &dyn Fn(&Path) -> bool) -> io::Result<()> {
    restrict_to_owner(path)?;
    if levels == 0 || !path.symlink_metadata().is_ok_and(|about| about.is_dir()) {
        return Ok(());
    }
    for entry in std::fs::read_dir(path)? {
        let path = entry?.path();
        if !leave(&path) {
            restrict_tree(&path, levels - 1, leave)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(path: &Path) -> u32 {
        path.symlink_metadata().expect("there").permissions().mode() & 0o7777
    }

    #[test]
    fn others_lose_their_rights_and_nobody_else_does() {
        let place = tempfile::tempdir().expect("a directory");
        let path = |name: &str| place.path().join(name);
        std::fs::create_dir_all(path("a/b/c")).expect("made");
        std::fs::write(path("a/b/program"), "").expect("made");
        std::fs::write(path("outside"), "").expect("made");
        std::os::unix::fs::symlink(path("outside"), path("a/link")).expect("made");
        for (name, rights) in
            [("a", 0o755), ("a/b", 0o711), ("a/b/c", 0o755), ("a/b/program", 0o755), ("outside", 0o644)]
        {
            std::fs::set_permissions(path(name), Permissions::from_mode(rights)).expect("set");
        }
        restrict_tree(&path("a"), 2, &|path| path.ends_with("c")).expect("closed");
        assert_eq!(mode(&path("a")), 0o700);
        assert_eq!(mode(&path("a/b")), 0o700);
        assert_eq!(mode(&path("a/b/program")), 0o700);
        assert_eq!(mode(&path("a/b/c")), 0o755, "left alone");
        assert_eq!(mode(&path("outside")), 0o644, "behind a link");
        restrict_to_owner(&path("gone")).expect("nothing to do");
    }

    #[test]
    fn a_file_is_replaced_whole_and_is_its_owners_alone() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("a/file.pem");
        // Left behind by a daemon that was interrupted.
        std::fs::create_dir(place.path().join("a")).expect("made");
        std::fs::write(path.with_extension("begun"), "much longer").expect("made");
        for text in ["first", "2nd"] {
            write_atomically(&path, text.as_bytes()).expect("replaced");
            assert_eq!(std::fs::read_to_string(&path).expect("there"), text);
            assert_eq!(mode(&path), 0o600);
        }
        assert!(!path.with_extension("begun").exists());
    }

    #[test]
    fn a_file_that_others_could_read_is_closed_when_it_is_opened() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("file");
        drop(open(&path).expect("made"));
        assert_eq!(mode(&path), 0o600);
        std::fs::set_permissions(&path, Permissions::from_mode(0o644)).expect("set");
        drop(open(&path).expect("opened"));
        assert_eq!(mode(&path), 0o600);
    }
}
