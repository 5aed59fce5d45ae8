//! The last lines of a log, read backwards from the end of its files.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::rotated_path;
use crate::engine::LogLine;

/// Bytes per read, from the end of the file.
const BLOCK: usize = 64 * 1024;

/// Reads the last lines like [`last_lines`], without blocking the caller on the disk.
pub async fn read_last(path: PathBuf, count: usize, node: Option<String>) -> Vec<LogLine> {
    // Files are opened with the engine's privileges, but untrusted content is parsed on other threads.
    let Ok(files) = privilege::spawn_blocking(move || open_newest_first(&path)).await else {
        return Vec::new();
    };
    let read = move || last_lines(files, count, node.as_deref());
    tokio::task::spawn_blocking(read).await.unwrap_or_default()
}

/// Opens the files of the log at `path`, the newest first.
fn open_newest_first(path: &Path) -> Vec<File> {
    let current = File::open(path).ok();
    let inode = |file: &File| file.metadata().map(|data| (data.dev(), data.ino())).ok();
    // If the log was rotated in between, both are the same file.
    let same = current.as_ref().and_then(inode);
    let older = File::open(rotated_path(path)).ok();
    let older = older.filter(|older| same.is_none() || inode(older) != same);
    current.into_iter().chain(older).collect()
}

/// Returns the last `count` lines of a log, oldest first; of one node only if `node` is given. Malformed lines are
/// skipped. No more of the files is read than needed.
fn last_lines(files: Vec<File>, count: usize, node: Option<&str>) -> Vec<LogLine> {
    let mut newest_first = Vec::new();
    for file in files {
        // A read error ends the lines of this file.
        let _ = for_each_line_backwards(file, |line| {
            if newest_first.len() >= count {
                return false;
            }
            let entry = serde_json::from_slice::<LogLine>(line).ok();
            newest_first.extend(entry.filter(|entry| node.is_none_or(|node| node == entry.node)));
            true
        });
    }
    newest_first.reverse();
    newest_first
}

/// Returns the files, oldest first, that contain the log's last `count` lines, each positioned at the first of these
/// lines.
pub(super) fn seek_to_last(files: Vec<File>, count: usize) -> Vec<File> {
    let mut wanted = count;
    let mut newest_first = Vec::new();
    for mut file in files.into_iter().rev() {
        // Unreadable files are skipped.
        let Ok(found) = seek_before_last(&mut file, wanted) else {
            continue;
        };
        newest_first.push(file);
        wanted -= found;
        if wanted == 0 {
            break;
        }
    }
    newest_first.reverse();
    newest_first
}

/// Positions a file at the first of its last `count` complete lines, and returns how many of them there are.
fn seek_before_last(file: &mut File, count: usize) -> io::Result<usize> {
    let mut start = file.metadata()?.len();
    let mut ends = 0;
    let mut block = vec![0; BLOCK];
    while start > 0 {
        let length = start.min(BLOCK as u64);
        start -= length;
        let block = &mut block[..length as usize];
        file.seek(SeekFrom::Start(start))?;
        file.read_exact(block)?;
        let ends_before = block.iter().enumerate().rev();
        for (place, _) in ends_before.filter(|(_, byte)| **byte == b'\n') {
            if ends == count {
                file.seek(SeekFrom::Start(start + place as u64 + 1))?;
                return Ok(count);
            }
            ends += 1;
        }
    }
    file.rewind()?;
    Ok(ends)
}

/// Calls `more` for the lines of a file from the last to the first, until it returns false.
fn for_each_line_backwards(mut file: File, mut more: impl FnMut(&[u8]) -> bool) -> io::Result<()> {
    let mut start = file.metadata()?.len();
    // Bytes read and not passed on yet: the first line may start before them.
    let mut rest = Vec::new();
    while start > 0 {
        let length = start.min(BLOCK as u64);
        start -= length;
        file.seek(SeekFrom::Start(start))?;
        let mut block = vec![0; length as usize];
        file.read_exact(&mut block)?;
        block.append(&mut rest);
        rest = block;
        let first = match rest.iter().position(|byte| *byte == b'\n') {
            Some(end) if start > 0 => end + 1,
            None if start > 0 => continue,
            _ => 0,
        };
        for line in rest[first..].rsplit(|byte| *byte == b'\n') {
            if !more(line) {
                return Ok(());
            }
        }
        rest.truncate(first.saturating_sub(1));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    fn line(node: &str, text: &str) -> String {
        let entry = LogLine {
            number: None,
            time: SystemTime::UNIX_EPOCH,
            node: node.into(),
            stream: "stdout".into(),
            line: text.into(),
        };
        serde_json::to_string(&entry).expect("plain data") + "\n"
    }

    #[test]
    fn the_last_lines_are_found_across_the_rotation() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("log.jsonl");
        let texts = |count, node| -> Vec<String> {
            last_lines(open_newest_first(&path), count, node).into_iter().map(|line| line.line).collect()
        };
        assert!(texts(5, None).is_empty(), "no log yet");
        std::fs::write(rotated_path(&path), line("/a", "1") + &line("/b", "2")).expect("written");
        std::fs::write(&path, line("/a", "3") + "{torn").expect("written");
        assert_eq!(texts(2, None), ["2", "3"]);
        assert_eq!(texts(9, Some("/a")), ["1", "3"]);
        assert!(texts(0, None).is_empty());
    }

    #[test]
    fn a_long_log_is_read_from_its_end_and_no_further_than_needed() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("log.jsonl");
        let long = "x".repeat(BLOCK / 3);
        let all: Vec<String> = (0..20).map(|number| format!("{number} {long}")).collect();
        let text: String = all.iter().map(|text| line("/a", text)).collect();
        std::fs::write(&path, &text).expect("written");
        for count in [1, 2, 7, 20, 30] {
            let seen = last_lines(open_newest_first(&path), count, None).into_iter().map(|line| line.line);
            let expected = &all[20 - count.min(20)..];
            assert!(seen.eq(expected.iter().cloned()), "the last {count}");
        }
        let mut given = 0;
        for_each_line_backwards(File::open(&path).expect("it is there"), |_| {
            given += 1;
            given < 3
        })
        .expect("readable");
        assert_eq!(given, 3);
    }
}
