//! The disk whose I/O is limited for a servant: the one that holds its layers, since all I/O that is not in memory goes
//! there.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Returns `MAJOR:MINOR` of the whole disk that holds `path`; `None` if that is not a disk (an overlay, a tmpfs, a
/// network).
pub(super) fn whole_disk(path: &Path) -> Option<String> {
    let device = fs::metadata(path).ok()?.dev();
    let number = format!("{}:{}", libc::major(device), libc::minor(device));
    let entry = Path::new("/sys/dev/block").join(&number).canonicalize().ok()?;
    // A limit is set on the disk, not on one of its partitions.
    if entry.join("partition").exists() {
        let whole = fs::read_to_string(entry.parent()?.join("dev")).ok()?;
        return Some(whole.trim().to_owned());
    }
    Some(number)
}
