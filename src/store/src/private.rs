//! Files and directories that only this user can read: environments of servants, hashes of tokens, pushed sources, logs of
//! builds (docs/adr/033).

use std::fs::{DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;

/// Rights of groups and others.
const OTHERS: u32 = 0o077;

/// Makes a directory with all above it that is missing.
pub fn make_directory(path: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(path)
}

/// Opens a file for reading and writing, made where it is missing.
pub fn open(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .open(path)?;
    close(path)?;
    Ok(file)
}

/// Writes a file, whole or not at all, with the directory that it is in.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
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

/// Removes the rights of group and others on a file or directory. Links, and paths that do not exist, are skipped.
pub fn close(path: &Path) -> io::Result<()> {
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

/// The same for a directory and its entries, down to a number of levels; deeper entries cannot be reached through it
/// anyway. Entries that `leave` names are skipped.
pub fn close_below(path: &Path, levels: usize, leave: &dyn Fn(&Path) -> bool) -> io::Result<()> {
    close(path)?;
    if levels == 0 || !path.symlink_metadata().is_ok_and(|about| about.is_dir()) {
        return Ok(());
    }
    for entry in std::fs::read_dir(path)? {
        let path = entry?.path();
        if !leave(&path) {
            close_below(&path, levels - 1, leave)?;
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
        for (name, rights) in [
            ("a", 0o755),
            ("a/b", 0o711),
            ("a/b/c", 0o755),
            ("a/b/program", 0o755),
            ("outside", 0o644),
        ] {
            std::fs::set_permissions(path(name), Permissions::from_mode(rights)).expect("set");
        }
        close_below(&path("a"), 2, &|path| path.ends_with("c")).expect("closed");
        assert_eq!(mode(&path("a")), 0o700);
        assert_eq!(mode(&path("a/b")), 0o700);
        assert_eq!(mode(&path("a/b/program")), 0o700);
        assert_eq!(mode(&path("a/b/c")), 0o755, "left alone");
        assert_eq!(mode(&path("outside")), 0o644, "behind a link");
        close(&path("gone")).expect("nothing to do");
    }

    #[test]
    fn a_file_is_replaced_whole_and_is_its_owners_alone() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("a/file.pem");
        // What a daemon left that was ended meanwhile.
        std::fs::create_dir(place.path().join("a")).expect("made");
        std::fs::write(path.with_extension("begun"), "much longer").expect("made");
        for text in ["first", "2nd"] {
            replace(&path, text.as_bytes()).expect("replaced");
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
