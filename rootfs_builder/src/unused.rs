//! Removes from the cache what has not been used for a long time. Everything there can be made or fetched again.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// What was not used for so long is removed.
const KEEP: Duration = Duration::from_secs(90 * 24 * 3600);
/// Uses within this time of each other are noted once, and it is looked for unused files as often.
const NOTED: Duration = Duration::from_secs(24 * 3600);
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
        .is_ok_and(|time| age(time) < NOTED);
    if lately || fs::write(&looked, "").is_err() {
        return;
    }
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
    let unused = |path: &PathBuf| {
        fs::symlink_metadata(path).is_ok_and(|about| {
            about.is_file() && about.modified().is_ok_and(|time| age(time) > KEEP)
        })
    };
    let files = directories.iter().flat_map(|directory| below(directory));
    for path in files.filter(unused) {
        // What is in use by now is made again. Directories stay: something may be about to be put into them.
        let _ = fs::remove_file(path);
    }
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
        let long_ago = SystemTime::now() - KEEP - NOTED;
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
}
