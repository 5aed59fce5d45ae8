//! Removes from the cache what has not been used for a long time, and beyond its size what was not used for longest. Everything there can
//! be made or fetched again.

use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// What was not used for so long is removed.
const KEEP: Duration = Duration::from_secs(90 * 24 * 3600);
/// Uses within this time of each other are noted once.
const NOTED: Duration = Duration::from_secs(60);
/// How often it is looked for what was not used for long.
const LOOKED_EVERY: Duration = Duration::from_secs(24 * 3600);
/// What was used within this time stays, however much there is: a build may be about to read it.
const IN_USE: Duration = Duration::from_secs(15 * 60);
/// Tells when it was looked last.
const LOOKED: &str = "unused-looked-for";

/// Notes that a file of the cache is in use: its time of modification is now.
pub(crate) fn used(path: &Path) {
    let note = || {
        let file = File::open(path)?;
        let noted = file.metadata()?.modified()?;
        if age(noted) > NOTED {
            file.set_modified(SystemTime::now())?;
        }
        Ok::<_, std::io::Error>(())
    };
    // It may be gone; that costs making it again.
    let _ = note();
}

/// Removes what was not used for long, once a day. Blocking.
pub(crate) fn sweep(cache: &Path) {
    let looked = cache.join(LOOKED);
    let lately = fs::metadata(&looked)
        .and_then(|about| about.modified())
        .is_ok_and(|time| age(time) < LOOKED_EVERY);
    if lately || fs::write(&looked, "").is_err() {
        return;
    }
    for file in files(cache).iter().filter(|file| age(file.used) > KEEP) {
        // What is in use by now is made again. Directories stay: something may be about to be put into them.
        let _ = fs::remove_file(&file.path);
    }
}

/// Removes files that were not used for longest, until those that are left take at most `most` bytes. Blocking.
pub(crate) fn shrink(cache: &Path, most: u64) {
    let mut files = files(cache);
    let mut total: u64 = files.iter().map(|file| file.bytes).sum();
    if total <= most {
        return;
    }
    files.sort_by_key(|file| file.used);
    let before = total;
    for file in files {
        if total <= most || age(file.used) < IN_USE {
            break;
        }
        if fs::remove_file(&file.path).is_ok() {
            total -= file.bytes;
        }
    }
    tracing::info!(
        "removed {} MB of the cache {}, of which {most} bytes are kept at most",
        (before - total) >> 20,
        cache.display()
    );
}

/// A file that may be removed.
struct Cached {
    path: PathBuf,
    /// When it was used last.
    used: SystemTime,
    /// On the disk.
    bytes: u64,
}

/// All files of the cache that can be made again one by one.
fn files(cache: &Path) -> Vec<Cached> {
    let mut directories: Vec<PathBuf> = ["layers", "notes"].map(|name| cache.join(name)).into();
    for name in ["chains", crate::wheels::DOWNLOADS] {
        directories.extend(below(&cache.join(name)));
    }
    for archive in below(&cache.join("apt")) {
        directories.extend(below(&archive).into_iter().filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name == "archives" || name.starts_with("members-") || name.starts_with("imports-")
        }));
    }
    let cached = |path: PathBuf| {
        let about = fs::symlink_metadata(&path).ok()?;
        about.is_file().then_some(())?;
        Some(Cached {
            used: about.modified().ok()?,
            bytes: about.blocks() * 512,
            path,
        })
    };
    let files = directories.iter().flat_map(|directory| below(directory));
    files.filter_map(cached).collect()
}

fn below(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

/// Nothing for a time in the future.
fn age(time: SystemTime) -> Duration {
    time.elapsed().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_used_for_long_is_removed() {
        let cache = tempfile::tempdir().expect("a directory");
        let long_ago = SystemTime::now() - KEEP - LOOKED_EVERY;
        let file = |path: &str| {
            let path = cache.path().join(path);
            fs::create_dir_all(path.parent().expect("below")).expect("made");
            fs::write(&path, "").expect("written");
            let file = File::open(&path).expect("there");
            file.set_modified(long_ago).expect("set");
            path
        };
        let kinds = [
            "chains/ground",
            "wheels/list",
            "apt/lab/members-1",
            "apt/lab/imports-1",
            "apt/lab/archives",
            "layers",
            "notes",
        ];
        let old = kinds.map(|kind| file(&format!("{kind}/old")));
        let again = kinds.map(|kind| file(&format!("{kind}/used-again")));
        for path in &again {
            used(path);
        }
        // Not by itself, but as a part of what apt keeps.
        let list = file("apt/lab/state/lists/list");
        let earlier = file("apt/lab/members-0/old");
        let lock = file("apt/lab/lock");
        sweep(cache.path());
        assert!(old.iter().all(|path| !path.exists()), "{old:?}");
        assert!(again.iter().all(|path| path.exists()), "{again:?}");
        assert!(list.exists() && lock.exists());
        assert!(!earlier.exists());
        // It is looked once a day.
        let old = file("notes/old");
        sweep(cache.path());
        assert!(old.exists());
    }

    #[test]
    fn beyond_its_size_the_cache_loses_what_was_not_used_for_longest() {
        let cache = tempfile::tempdir().expect("a directory");
        let now = SystemTime::now();
        let file = |path: &str, hours: u32| {
            let path = cache.path().join(path);
            fs::create_dir_all(path.parent().expect("below")).expect("made");
            fs::write(&path, vec![1; 1 << 20]).expect("written");
            let file = File::open(&path).expect("there");
            let time = now - Duration::from_secs(3600) * hours;
            file.set_modified(time).expect("set");
            // Else its blocks may not be counted yet.
            file.sync_all().expect("on the disk");
            path
        };
        let oldest = file("apt/lab/archives/oldest.deb", 30);
        let older = file("layers/older.tar.gz", 20);
        let newer = file("chains/ground/newer", 10);
        // Used again since.
        let again = file("layers/again.tar.gz", 40);
        used(&again);
        let all = [&oldest, &older, &newer, &again];
        let left = || all.map(|path| path.exists());
        shrink(cache.path(), 5 << 20);
        assert_eq!(left(), [true; 4], "they fit");
        shrink(cache.path(), (5 << 20) / 2);
        assert_eq!(left(), [false, false, true, true]);
        shrink(cache.path(), 0);
        assert_eq!(left(), [false, false, false, true], "it is in use");
    }
}
