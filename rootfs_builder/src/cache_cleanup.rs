//! Cleanup of the cache: removes what has not been used for a long time, and the least recently used files beyond its
//! maximum size. Everything in the cache can be built or fetched again.

use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Time after which unused files are removed.
const KEEP: Duration = Duration::from_secs(90 * 24 * 3600);
/// Interval within which repeated uses are recorded only once.
const USE_INTERVAL: Duration = Duration::from_secs(60);
/// Interval of the search for unused files.
const LOOKED_EVERY: Duration = Duration::from_secs(24 * 3600);
/// Files used within this time are kept regardless of the size, since a build may be about to read them.
const IN_USE: Duration = Duration::from_secs(15 * 60);
/// File whose time is that of the last search.
const SEARCH_MARK: &str = "unused-looked-for";

/// Directory of downloaded wheels in the cache, with a subdirectory for each list of requirements.
pub(crate) const DOWNLOADS: &str = "wheels";

/// Marks a file of the cache as used, by setting its modification time.
pub(crate) fn mark_used(path: &Path) {
    let note = || {
        let file = File::open(path)?;
        let noted = file.metadata()?.modified()?;
        if age(noted) > USE_INTERVAL {
            file.set_modified(SystemTime::now())?;
        }
        Ok::<_, std::io::Error>(())
    };
    // It may have been removed; then it is built again.
    let _ = note();
}

/// Removes files that have not been used for long, once a day. Blocking.
pub(crate) fn sweep(cache: &Path) {
    let looked = cache.join(SEARCH_MARK);
    let lately = fs::metadata(&looked).and_then(|about| about.modified()).is_ok_and(|time| age(time) < LOOKED_EVERY);
    if lately || fs::write(&looked, "").is_err() {
        return;
    }
    for file in cache_files(cache).iter().filter(|file| age(file.used) > KEEP) {
        // A file that came into use meanwhile is built again. Directories are kept, since a file may be about to be
        // created in them.
        let _ = fs::remove_file(&file.path);
    }
}

/// Removes the least recently used files until the rest takes at most `most` bytes. Blocking.
pub(crate) fn shrink(cache: &Path, most: u64) {
    let mut files = cache_files(cache);
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
    tracing::info!("removed {} MB of the cache {}; its limit is {most} bytes", (before - total) >> 20, cache.display());
}

/// A file that may be removed.
struct CachedFile {
    path: PathBuf,
    /// Time of the last use.
    used: SystemTime,
    /// Disk usage in bytes.
    bytes: u64,
}

/// Returns all files of the cache that can be rebuilt individually.
fn cache_files(cache: &Path) -> Vec<CachedFile> {
    let mut directories: Vec<PathBuf> = ["layers", "notes"].map(|name| cache.join(name)).into();
    for name in ["chains", DOWNLOADS] {
        directories.extend(list_directory(&cache.join(name)));
    }
    for archive in list_directory(&cache.join("apt")) {
        directories.extend(list_directory(&archive).into_iter().filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name == "archives" || name.starts_with("members-") || name.starts_with("imports-")
        }));
    }
    let cached = |path: PathBuf| {
        let about = fs::symlink_metadata(&path).ok()?;
        about.is_file().then_some(())?;
        Some(CachedFile { used: about.modified().ok()?, bytes: about.blocks() * 512, path })
    };
    let files = directories.iter().flat_map(|directory| list_directory(directory));
    files.filter_map(cached).collect()
}

fn list_directory(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

/// Returns the age of a time; zero for a time in the future.
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
            mark_used(path);
        }
        // Not removed by itself, but as a part of apt's directory.
        let list = file("apt/lab/state/lists/list");
        let earlier = file("apt/lab/members-0/old");
        let lock = file("apt/lab/lock");
        sweep(cache.path());
        assert!(old.iter().all(|path| !path.exists()), "{old:?}");
        assert!(again.iter().all(|path| path.exists()), "{again:?}");
        assert!(list.exists() && lock.exists());
        assert!(!earlier.exists());
        // The search takes place once a day.
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
            // Otherwise its blocks may not be counted yet.
            file.sync_all().expect("on the disk");
            path
        };
        let oldest = file("apt/lab/archives/oldest.deb", 30);
        let older = file("layers/older.tar.gz", 20);
        let newer = file("chains/ground/newer", 10);
        // Used again meanwhile.
        let again = file("layers/again.tar.gz", 40);
        mark_used(&again);
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
