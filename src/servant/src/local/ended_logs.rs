//! Logs that are kept of ended servants: one directory per servant, with the log's files and the record of the servant.
//! The record is written last: a directory without one is incomplete.

use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;

use api::{KeptLog, Size};

use crate::launch;
use crate::{Error, logs};

/// File of the [`KeptLog`].
const ABOUT_FILE: &str = "about.json";

/// Moves the log of the servant in `directory` to the logs in `kept`, and returns `about` with its size. If this was
/// begun before and broke off, it is completed.
pub(super) async fn keep_log(kept: &Path, directory: &Path, about: KeptLog) -> Result<KeptLog, Error> {
    let (kept, directory) = (kept.to_owned(), directory.to_owned());
    let work = privilege::spawn_blocking(move || keep_log_blocking(&kept, &directory, about));
    work.await.unwrap_or_else(|panic| std::panic::resume_unwind(panic.into_panic()))
}

fn keep_log_blocking(kept: &Path, directory: &Path, mut about: KeptLog) -> Result<KeptLog, Error> {
    let target = kept.join(&about.servant);
    let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(&target);
    made.map_err(Error::file("make", &target))?;
    let current = Path::new(logs::FILE);
    let mut bytes = 0;
    for name in [logs::rotated_path(current).as_path(), current] {
        let (from, to) = (directory.join(name), target.join(name));
        match fs::rename(&from, &to) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            moved => moved.map_err(Error::file("keep", &from))?,
        }
        bytes += fs::metadata(&to).map_or(0, |data| data.len());
    }
    about.bytes = Size(bytes);
    if let Err(error) = launch::write_record(&target.join(ABOUT_FILE), &about) {
        // Without its record it would count for no quota, and take the space that is missing.
        let _ = remove_log(&target);
        return Err(error);
    }
    Ok(about)
}

/// Lists the logs in `kept`, and removes incomplete ones unless their servant, in `servants`, is still to be swept.
pub(super) fn list_logs(kept: &Path, servants: &Path) -> Result<Vec<KeptLog>, Error> {
    let entries = match fs::read_dir(kept) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(Error::file("read", kept))?,
    };
    let mut logs = Vec::new();
    for entry in entries {
        let directory = entry.map_err(Error::file("read", kept))?.path();
        let Some(id) = directory.file_name().filter(|_| directory.is_dir()) else {
            continue;
        };
        // Looked at first: a servant's directory is removed after the record is written.
        let is_ending = servants.join(id).exists();
        let record: Option<KeptLog> = launch::read_record(&directory.join(ABOUT_FILE)).unwrap_or_default();
        match record.filter(|about| id == about.servant.as_str()) {
            Some(about) => logs.push(about),
            None if is_ending => {}
            None => remove_log(&directory)?,
        }
    }
    Ok(logs)
}

/// Removes a kept log. It is no error if there is none.
pub(super) fn remove_log(directory: &Path) -> Result<(), Error> {
    match fs::remove_dir_all(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result.map_err(Error::file("remove", directory)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample_log(servant: &str) -> KeptLog {
        KeptLog {
            servant: servant.into(),
            service: "greeter".into(),
            revision: 1,
            robot: "rover".into(),
            created: 1,
            ended: 2,
            failed: false,
            reason: "it was stopped".into(),
            bytes: Size(0),
        }
    }

    #[test]
    fn a_kept_log_has_both_files_and_is_listed_until_it_is_removed() {
        let home = tempfile::tempdir().expect("a directory");
        let (kept, servants) = (home.path().join("ended"), home.path().join("servants"));
        let servant = servants.join("s-1");
        fs::create_dir_all(&servant).expect("made");
        fs::write(servant.join("log.jsonl"), "new\n").expect("written");
        fs::write(servant.join("log.jsonl.1"), "older\n").expect("written");
        assert_eq!(list_logs(&kept, &servants).expect("no logs yet"), []);
        let known = keep_log_blocking(&kept, &servant, sample_log("s-1")).expect("kept");
        assert_eq!(known, KeptLog { bytes: Size(10), ..sample_log("s-1") });
        assert!(!servant.join("log.jsonl").exists());
        // Broken off after the files were moved, it is kept all the same.
        assert_eq!(keep_log_blocking(&kept, &servant, sample_log("s-1")).expect("kept"), known);
        assert_eq!(list_logs(&kept, &servants).expect("readable"), [known]);
        assert_eq!(fs::read_to_string(kept.join("s-1/log.jsonl.1")).expect("kept"), "older\n");
        remove_log(&kept.join("s-1")).expect("removed");
        remove_log(&kept.join("s-1")).expect("nothing to remove");
        assert_eq!(list_logs(&kept, &servants).expect("readable"), []);
    }

    #[test]
    fn a_log_whose_record_cannot_be_written_takes_no_space() {
        let home = tempfile::tempdir().expect("a directory");
        let (kept, servant) = (home.path().join("ended"), home.path().join("servants/s-1"));
        fs::create_dir_all(&servant).expect("made");
        fs::write(servant.join("log.jsonl"), "new\n").expect("written");
        fs::create_dir_all(kept.join("s-1/about.json/full")).expect("made");
        keep_log_blocking(&kept, &servant, sample_log("s-1")).expect_err("a directory is in the way");
        assert!(!kept.join("s-1").exists());
    }

    #[test]
    fn what_a_killed_daemon_left_incomplete_is_removed_unless_it_is_still_completed() {
        let home = tempfile::tempdir().expect("a directory");
        let (kept, servants) = (home.path().join("ended"), home.path().join("servants"));
        for id in ["half-1", "half-2"] {
            fs::create_dir_all(kept.join(id)).expect("made");
        }
        fs::create_dir_all(servants.join("half-2")).expect("made");
        assert_eq!(list_logs(&kept, &servants).expect("readable"), []);
        assert!(!kept.join("half-1").exists() && kept.join("half-2").exists());
    }
}
