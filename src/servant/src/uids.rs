//! Each servant has 65536 user ids that nothing else on the host uses. A range is taken by locking one byte of a file
//! that all engines of the host share; the lock is held by the shim and ends with it, however that ends.

use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;

use crate::{Error, sys};

/// Ids in a range.
pub const RANGE: u32 = 65536;

/// Uids that Linux leaves alone end below this one (systemd, docs/UIDS-GIDS.md).
const END: u32 = 0x7ffe_0000;

const FILE: &str = "/run/cloudroid/uid-ranges";

/// Takes a free range from `base` on: its first uid, and the lock to keep.
pub fn take(base: u32) -> Result<(u32, OwnedFd), Error> {
    let path = Path::new(FILE);
    let directory = path.parent().unwrap_or(path);
    fs::create_dir_all(directory).map_err(Error::file("make", directory))?;
    let file: OwnedFd = open(path).map_err(Error::file("open", path))?.into();
    let first = base.div_ceil(RANGE);
    let end = if base < END {
        END / RANGE
    } else {
        u32::MAX / RANGE
    };
    for range in first..end {
        if sys::lock_byte(file.as_fd(), i64::from(range)).map_err(Error::file("lock", path))? {
            return Ok((range * RANGE, file));
        }
    }
    Err(Error::NoUidRange {
        base,
        ranges: end.saturating_sub(first),
    })
}

/// For this user alone: whoever can open it can hold any range, by a lock that only reads.
fn open(path: &Path) -> io::Result<File> {
    let file = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .read(true)
        .mode(0o600)
        .open(path)?;
    // An earlier version made it for all to read.
    file.set_permissions(fs::Permissions::from_mode(0o600))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_is_taken_once_and_free_again_after_its_lock() {
        // Far from where engines look, so that no other test's servant is in the way.
        let base = 0x7ffd_0000 - RANGE;
        let (one, lock) = take(base).unwrap();
        let (two, _other) = take(base).unwrap();
        assert_eq!((one, two), (base, base + RANGE));
        assert!(matches!(
            take(base),
            Err(Error::NoUidRange { ranges: 2, .. })
        ));
        drop(lock);
        assert_eq!(take(base).unwrap().0, base);
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
