//! Time of the newest source of a push, which becomes the creation time of the image: the archive that is sent has no
//! times.

use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use super::archive::{LEFT_OUT, MADE_OF_IT};

/// Variable with the time to use instead (<https://reproducible-builds.org/specs/source-date-epoch/>).
const VARIABLE: &str = "SOURCE_DATE_EPOCH";

/// Returns the time of the newest file below a directory, in seconds since 1970, or `SOURCE_DATE_EPOCH`. `None` for an
/// archive, and for files that cannot be read, which packing reports.
pub fn find_newest_source(path: &Path) -> Option<u64> {
    if !path.is_dir() {
        return None;
    }
    let given = std::env::var(VARIABLE).ok().and_then(|text| text.parse().ok());
    given.or_else(|| newest_file(path))
}

fn newest_file(root: &Path) -> Option<u64> {
    let is_workspace = root.join("src").is_dir() && !root.join("package.xml").exists();
    let mut newest = None;
    let mut left: Vec<PathBuf> = vec![root.to_owned()];
    while let Some(directory) = left.pop() {
        let is_top = directory == root;
        for entry in std::fs::read_dir(&directory).ok()?.flatten() {
            let name = entry.file_name();
            let is_generated = is_top && is_workspace && MADE_OF_IT.iter().any(|made| name == *made);
            if is_generated || LEFT_OUT.iter().any(|left_out| name == *left_out) {
                continue;
            }
            let about = entry.metadata().ok()?;
            if about.is_dir() {
                left.push(entry.path());
            } else if about.is_file() {
                let time = about.modified().ok()?.duration_since(UNIX_EPOCH).ok();
                newest = newest.max(time.map(|since| since.as_secs()));
            }
        }
    }
    newest
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn what_is_sent_counts_and_nothing_else() {
        let root = tempfile::tempdir().expect("a directory");
        let write = |path: &str, seconds: u64| {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().expect("below the root")).expect("made");
            let file = std::fs::File::create(path).expect("made");
            file.set_modified(UNIX_EPOCH + Duration::from_secs(seconds)).expect("set");
        };
        write("src/adder/package.xml", 100);
        write("src/adder/scripts/adder.py", 200);
        write("src/adder/.git/index", 300);
        write("build/made", 400);
        assert_eq!(newest_file(root.path()), Some(200));
        // A directory of a package, unlike that of a workspace.
        write("src/adder/build/rules.py", 500);
        assert_eq!(newest_file(root.path()), Some(500));
        assert_eq!(newest_file(&root.path().join("src/adder")), Some(500));
        assert_eq!(newest_file(&root.path().join("missing")), None);
        assert_eq!(find_newest_source(&root.path().join("src/adder/package.xml")), None, "it may be an archive");
    }
}
