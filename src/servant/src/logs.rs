//! Output of the nodes: `log.jsonl` in the servant's directory, one JSON object per line ([`LogLine`] with its number),
//! rotated once to `log.jsonl.1`.
//!
//! The shim writes ([`LogWriter`]), others read ([`follow`], [`read_last`]); neither waits for the other. Lines are
//! numbered, so that a reader that was too slow for a rotation is told how many lines it missed.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

use crate::engine::LogLine;
use crate::quotas::RateLimit;

mod follow;
mod tail;
mod watches;

pub use follow::follow;
pub use tail::read_last;
pub use watches::DirectoryWatches;

/// Name of the file in the servant's directory.
pub const FILE: &str = "log.jsonl";

/// Maximum length of a line in bytes; longer ones are split.
pub const LONGEST_LINE: usize = 16 * 1024;

/// Bytes after which the file is rotated.
pub const ROTATE_AT: u64 = 16 << 20;

/// Approximate bytes of a line in the file beside its text.
const OVERHEAD: usize = 100;

/// Appends lines to the log.
#[derive(Debug)]
pub struct LogWriter {
    path: PathBuf,
    file: File,
    written: u64,
    rotate_at: u64,
    number: u64,
    failed: bool,
    rate: RateLimit,
    /// Lines and bytes that exceeded the rate and are not reported yet.
    dropped: (u64, u64),
}

impl LogWriter {
    /// Creates an empty log at `path`.
    pub fn create(path: &Path, rotate_at: u64, per_second: u64) -> io::Result<Self> {
        let file = open(path)?;
        Ok(Self {
            rate: RateLimit::new(per_second, Instant::now()),
            dropped: (0, 0),
            path: path.into(),
            file,
            written: 0,
            rotate_at,
            number: 0,
            failed: false,
        })
    }

    /// Appends one line, or drops it if lines exceed the rate limit: then the next line let through is preceded by the
    /// number of dropped ones. A full disk must not end a servant: a line that cannot be written is dropped, which
    /// shows as a gap in the numbers, and reported once on standard error.
    pub fn append(&mut self, node: &str, stream: &str, line: &str) {
        let bytes = (line.len() + OVERHEAD) as u64;
        if !self.rate.admits(bytes, Instant::now()) {
            self.dropped.0 += 1;
            self.dropped.1 += line.len() as u64;
            return;
        }
        self.log_dropped();
        self.record(node, stream, line);
    }

    /// Logs the number of lines dropped since the last call.
    pub fn log_dropped(&mut self) {
        let (lines, bytes) = std::mem::take(&mut self.dropped);
        if lines > 0 {
            let told = format!(
                "{lines} lines ({bytes} bytes) are not in this log: they came faster than {} bytes a second (log_rate \
                 in [servant] of the configuration)",
                self.rate.per_second()
            );
            self.record("cloudroid", "stderr", &told);
        }
    }

    fn record(&mut self, node: &str, stream: &str, line: &str) {
        let record = LogLine {
            number: Some(self.number),
            time: SystemTime::now(),
            node: node.into(),
            stream: stream.into(),
            line: line.into(),
        };
        self.number += 1;
        match self.write(&record) {
            Ok(()) => self.failed = false,
            Err(error) if !self.failed => {
                self.failed = true;
                eprintln!("lines are lost: could not write {}: {error}", self.path.display());
            }
            Err(_) => {}
        }
    }

    fn write(&mut self, record: &LogLine) -> io::Result<()> {
        let mut text = serde_json::to_vec(record)?;
        text.push(b'\n');
        if self.written > 0 && self.written + text.len() as u64 > self.rotate_at {
            self.rotate()?;
        }
        // A single write, so that readers never see parts of two lines mixed; a partial line they wait for.
        self.file.write_all(&text)?;
        self.written += text.len() as u64;
        Ok(())
    }

    fn rotate(&mut self) -> io::Result<()> {
        fs::rename(&self.path, rotated_path(&self.path))?;
        self.file = open(&self.path)?;
        self.written = 0;
        Ok(())
    }
}

/// Returns the path of the older, rotated file.
pub fn rotated_path(path: &Path) -> PathBuf {
    path.with_extension("jsonl.1")
}

fn open(path: &Path) -> io::Result<File> {
    File::options().create(true).append(true).open(path)
}

/// Splits the output of a process into lines.
#[derive(Debug, Default)]
pub struct LineSplitter {
    rest: Vec<u8>,
}

impl LineSplitter {
    /// Adds output, and calls `each` for every complete line.
    pub fn push(&mut self, mut bytes: &[u8], mut each: impl FnMut(&str)) {
        while let Some(end) = bytes.iter().position(|byte| *byte == b'\n') {
            self.rest.extend_from_slice(&bytes[..end]);
            bytes = &bytes[end + 1..];
            self.flush(&mut each);
        }
        for part in bytes.chunks(LONGEST_LINE) {
            self.rest.extend_from_slice(part);
            if self.rest.len() >= LONGEST_LINE {
                self.flush(&mut each);
            }
        }
    }

    /// Calls `each` for the rest if it has no line end.
    pub fn finish(mut self, mut each: impl FnMut(&str)) {
        if !self.rest.is_empty() {
            self.flush(&mut each);
        }
    }

    fn flush(&mut self, each: &mut impl FnMut(&str)) {
        let line = self.rest.strip_suffix(b"\r").unwrap_or(&self.rest);
        each(&String::from_utf8_lossy(line));
        self.rest.clear();
        // Releases the memory of a long line, which would otherwise be held for the life of the servant.
        self.rest.shrink_to(1024);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_that_come_too_fast_are_left_out_and_that_is_said() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = LogWriter::create(&path, 1 << 20, 1024).unwrap();
        let line = "x".repeat(1000);
        for _ in 0..1000 {
            writer.append("/n", "stdout", &line);
        }
        writer.log_dropped();
        writer.log_dropped();
        let text = fs::read_to_string(&path).unwrap();
        let lines: Vec<LogLine> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        // Ten seconds' worth, and what was admitted while this ran.
        let (told, kept): (Vec<_>, Vec<_>) = lines.iter().partition(|line| line.node == "cloudroid");
        assert!((9..500).contains(&kept.len()), "{}", kept.len());
        let count = |line: &LogLine| line.line.split(' ').next()?.parse::<usize>().ok();
        let left_out: usize = told.iter().filter_map(|line| count(line)).sum();
        assert_eq!(kept.len() + left_out, 1000);
        assert!(told[0].line.contains("log_rate"), "{}", told[0].line);
        // No number is missing, which would be reported as lost lines.
        let numbers = lines.iter().map(|line| line.number.unwrap());
        assert!(numbers.eq(0..lines.len() as u64));
    }

    #[test]
    fn lines_come_whole_however_they_are_read() {
        let text = "one\r\n\ntwo \u{e9}\nrest";
        for size in 1..text.len() {
            let (mut lines, mut seen) = (LineSplitter::default(), Vec::new());
            for part in text.as_bytes().chunks(size) {
                lines.push(part, |line| seen.push(line.to_owned()));
            }
            lines.finish(|line| seen.push(line.to_owned()));
            assert_eq!(seen, ["one", "", "two \u{e9}", "rest"], "read {size} bytes at a time");
        }
    }

    #[test]
    fn a_line_without_an_end_is_cut() {
        let (mut lines, mut lengths) = (LineSplitter::default(), Vec::new());
        lines.push(&[b'x'; LONGEST_LINE * 2 + 7], |line| lengths.push(line.len()));
        lines.finish(|line| lengths.push(line.len()));
        assert_eq!(lengths, [LONGEST_LINE, LONGEST_LINE, 7]);
    }
}
