//! Which disk a servant's input and output are limited on: the one that holds its layers, where all of it goes that is
//! not in memory.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// `MAJOR:MINOR` of the whole disk below `path`; none where that is no disk (an overlay, a tmpfs, a network).
pub(super) fn of(path: &Path) -> Option<String> {
    let device = fs::metadata(path).ok()?.dev();
    let number = format!("{}:{}", libc::major(device), libc::minor(device));
    let entry = Path::new("/sys/dev/block")
        .join(&number)
        .canonicalize()
        .ok()?;
    // A limit is set on the disk, not on a partition of it.
    if entry.join("partition").exists() {
        let whole = fs::read_to_string(entry.parent()?.join("dev")).ok()?;
        return Some(whole.trim().to_owned());
    }
    Some(number)
}
