//! Allocation of user ids: each servant has 65536 that nothing else on the host uses. A range is taken by locking one
//! byte of a file shared by all engines of the host; the shim holds the lock, which ends with it, however that ends.
//!
//! A deleted file keeps the locks of those who have it open, and its successor does not know them: so an engine also
//! checks its servants' records.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;

use crate::{Error, launch, sys};

/// Number of ids in a range.
pub const RANGE: u32 = 65536;

/// End of the uids that Linux leaves alone (systemd, docs/UIDS-GIDS.md).
const END: u32 = 0x7ffe_0000;

/// File shared by all engines of the host.
pub const LOCKS: &str = "/run/cloudroid/uid-ranges";

/// Takes a free range from `base` on, by a lock in the file `path`; returns its first uid, and the lock to keep. Ranges
/// whose first uid is in `held` are skipped, whatever their locks.
pub fn lock_free_range(path: &Path, base: u32, held: &BTreeSet<u32>) -> Result<(u32, OwnedFd), Error> {
    let directory = path.parent().unwrap_or(path);
    fs::create_dir_all(directory).map_err(Error::file("make", directory))?;
    let file: OwnedFd = open(path).map_err(Error::file("open", path))?.into();
    let first = base.div_ceil(RANGE);
    let end = if base < END { END / RANGE } else { u32::MAX / RANGE };
    for range in (first..end).filter(|range| !held.contains(&(range * RANGE))) {
        if sys::lock_byte(file.as_fd(), i64::from(range)).map_err(Error::file("lock", path))? {
            return Ok((range * RANGE, file));
        }
    }
    Err(Error::NoUidRange { base, ranges: end.saturating_sub(first) })
}

/// Returns the first uids of the ranges in the records below `servants`, whether their shims run or not: processes of a
/// servant whose shim was killed may remain for as long as its directory exists.
pub fn claimed_ranges(servants: &Path) -> Result<BTreeSet<u32>, Error> {
    /// The part that both records have in common.
    #[derive(serde::Deserialize)]
    struct UidRangeRecord {
        uid_range: (u32, u32),
    }
    let mut held = BTreeSet::new();
    for entry in fs::read_dir(servants).map_err(Error::file("read", servants))? {
        let directory = entry.map_err(Error::file("read", servants))?.path();
        // An unreadable record was just being written: nothing uses those ids yet.
        let record = |name| launch::read_record::<UidRangeRecord>(&directory.join(name)).ok().flatten();
        let record = record(launch::RUNTIME).or_else(|| record(launch::SPEC));
        held.extend(record.map(|record| record.uid_range.0));
    }
    Ok(held)
}

/// Opens the lock file for this user alone: anybody who can open it could hold any range, even by a read lock.
fn open(path: &Path) -> io::Result<File> {
    let file = File::options().create(true).truncate(false).write(true).read(true).mode(0o600).open(path)?;
    // An earlier version made it readable for all.
    file.set_permissions(fs::Permissions::from_mode(0o600))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_is_taken_once_and_free_again_after_its_lock() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("uid-ranges");
        let base = END - 2 * RANGE;
        let nobody = BTreeSet::new();
        let (one, lock) = lock_free_range(&path, base, &nobody).unwrap();
        let (two, _other) = lock_free_range(&path, base, &nobody).unwrap();
        assert_eq!((one, two), (base, base + RANGE));
        assert!(matches!(lock_free_range(&path, base, &nobody), Err(Error::NoUidRange { ranges: 2, .. })));
        drop(lock);
        assert_eq!(lock_free_range(&path, base, &nobody).unwrap().0, base);
    }

    #[test]
    fn ranges_that_records_name_are_passed_over_without_their_locks() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("uid-ranges");
        let servants = place.path().join("servants");
        let base = END - 4 * RANGE;
        for (index, (id, file)) in [("a", launch::RUNTIME), ("b", launch::SPEC)].into_iter().enumerate() {
            let record = servants.join(id).join(file);
            fs::create_dir_all(record.parent().unwrap()).unwrap();
            let first = base + index as u32 * RANGE;
            let record_text = serde_json::json!({ "uid_range": [first, RANGE] });
            fs::write(record, record_text.to_string()).unwrap();
        }
        fs::create_dir(servants.join("half-made")).unwrap();
        let held = claimed_ranges(&servants).unwrap();
        assert_eq!(held, BTreeSet::from([base, base + RANGE]));
        assert_eq!(lock_free_range(&path, base, &held).unwrap().0, base + 2 * RANGE);
    }

    #[test]
    fn nobody_else_can_hold_a_range() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("uid-ranges");
        let mode = || path.metadata().unwrap().permissions().mode() & 0o777;
        drop(open(&path).unwrap());
        assert_eq!(mode(), 0o600);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
        drop(open(&path).unwrap());
        assert_eq!(mode(), 0o600);
    }
}
