//! Reading of a log while it is written and rotated.
//!
//! Two tasks: one opens each file as soon as it exists and never waits; the other reads them in order, as slowly as its
//! receiver wants. So neither a rotation nor the removal of the log loses unread lines at once. A reader slower than
//! two rotations continues with the newest file and is told how many lines are missing, since removed files that are
//! open still occupy the disk.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use tokio::sync::{mpsc, watch};

use super::rotated_path;
use super::tail::seek_to_last;
use super::watches::{DirectoryWatch, DirectoryWatches};
use crate::engine::{LogLine, LogStart};

/// Number of lines buffered for the receiver.
const AHEAD: usize = 16;
/// Number of files that may wait to be read: as many as a log has.
const UNREAD: usize = 2;
/// Bytes per read.
const BLOCK: usize = 64 * 1024;

/// Streams the lines of the log at `path`, from `start` on. The stream ends after the last line when `ended` completes,
/// which must not be before the last line was written. Once `guard` is dropped, the log may be removed.
pub fn follow(
    watches: &Arc<DirectoryWatches>,
    path: PathBuf,
    start: LogStart,
    ended: impl Future<Output = ()> + Send + 'static,
    guard: impl Send + 'static,
) -> mpsc::Receiver<LogLine> {
    let (sender, receiver) = mpsc::channel(AHEAD);
    let opened = Arc::new(UnreadFiles::default());
    let changes = watch::Sender::new(());
    let changed = changes.subscribe();
    // Opened here and not in the task, so that nothing written after this function has returned is missed. Files are
    // opened with the engine's privileges, but untrusted content is parsed on other threads.
    let log = path.clone();
    let watches = Arc::clone(watches);
    let files = Arc::clone(&opened);
    let discovering = privilege::run_sync(move || {
        let directory = log.parent().unwrap_or(Path::new("/"));
        let watch = watches.watch(directory)?;
        let discovery = Discovery::open(&log, start, watch, Arc::clone(&files))?;
        // Existing files are read first, however soon others appear.
        let first = [files.take(), files.take()];
        tokio::spawn(async move {
            discovery.run(&changes, ended).await;
            drop(guard);
        });
        Ok::<_, io::Error>(first)
    });
    match discovering {
        Ok([file, younger]) => {
            let reader = LogReader { file, younger, opened, changed, sender };
            tokio::spawn(reader.run(start));
        }
        Err(error) => {
            // The channel is empty, so there is room for one line.
            let _ = sender.try_send(log_note(format!("could not follow {}: {error}", path.display())));
        }
    }
    receiver
}

/// Files that are open and not read yet: only the newest few.
#[derive(Default)]
struct UnreadFiles(Mutex<UnreadQueue>);

#[derive(Default)]
struct UnreadQueue {
    files: VecDeque<File>,
    /// True if a file was skipped since the last one was taken.
    has_skipped: bool,
}

impl UnreadFiles {
    fn queue(&self) -> MutexGuard<'_, UnreadQueue> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, file: File) {
        let mut queue = self.queue();
        if queue.files.len() >= UNREAD {
            queue.files.pop_front();
            queue.has_skipped = true;
        }
        queue.files.push_back(file);
    }

    fn take(&self) -> Option<File> {
        let mut queue = self.queue();
        queue.has_skipped = false;
        queue.files.pop_front()
    }

    fn has_skipped(&self) -> bool {
        self.queue().has_skipped
    }
}

struct Discovery {
    path: PathBuf,
    watch: DirectoryWatch,
    files: Arc<UnreadFiles>,
    /// The newest known file. Held open, so that its inode cannot be reused by another file.
    last: Option<File>,
}

impl Discovery {
    fn open(path: &Path, start: LogStart, watch: DirectoryWatch, files: Arc<UnreadFiles>) -> io::Result<Self> {
        let mut discovery = Self { path: path.into(), watch, files, last: None };
        if start != LogStart::Now {
            discovery.scan()?;
        } else if let Some(mut file) = open_if_exists(path)? {
            file.seek(SeekFrom::End(0))?;
            discovery.enqueue(file)?;
        }
        Ok(discovery)
    }

    async fn run(mut self, changes: &watch::Sender<()>, ended: impl Future<Output = ()>) {
        let mut ended = std::pin::pin!(ended);
        loop {
            let over = tokio::select! {
                () = self.watch.next_change() => false,
                () = &mut ended => true,
                () = changes.closed() => return,
            };
            // The directory is scanned; the watch only says when. A failure to open a file shows as a gap in the
            // numbers.
            let _ = self.scan();
            if over {
                return;
            }
            changes.send_replace(());
        }
    }

    /// Enqueues new files: the current one, and the rotated one if it is newer than the last known.
    fn scan(&mut self) -> io::Result<()> {
        let last = self.last.as_ref().map(inode).transpose()?;
        // A rotation may happen between the calls: they are repeated until they are consistent.
        for _ in 0..10 {
            let older = open_if_exists(&rotated_path(&self.path))?;
            let current = open_if_exists(&self.path)?;
            let again = open_if_exists(&rotated_path(&self.path))?;
            let id = |file: &Option<File>| file.as_ref().map(inode).transpose();
            if id(&older)? != id(&again)? {
                continue;
            }
            if last.is_some() && id(&current)? == last {
                return Ok(());
            }
            for file in older.into_iter().chain(current) {
                if Some(inode(&file)?) != last {
                    self.enqueue(file)?;
                }
            }
            return Ok(());
        }
        Ok(())
    }

    fn enqueue(&mut self, file: File) -> io::Result<()> {
        self.last = Some(file.try_clone()?);
        self.files.add(file);
        Ok(())
    }
}

/// Reads the files in order. If its receiver is too slow, it continues with the newest.
struct LogReader {
    /// File being read.
    file: Option<File>,
    /// File to be read next.
    younger: Option<File>,
    opened: Arc<UnreadFiles>,
    changed: watch::Receiver<()>,
    sender: mpsc::Sender<LogLine>,
}

impl LogReader {
    /// Reads until the end of the log, or until nobody receives any more.
    async fn run(mut self, start: LogStart) {
        if let LogStart::Last(count) = start {
            let files = self.file.take().into_iter().chain(self.younger.take());
            let files = files.collect();
            let placed = tokio::task::spawn_blocking(move || seek_to_last(files, count)).await;
            let mut placed = placed.unwrap_or_default().into_iter();
            (self.file, self.younger) = (placed.next(), placed.next());
        }
        let mut cutter = LogLineDecoder::default();
        loop {
            self.changed.mark_unchanged();
            // Checked before the file is read: nothing is written to it afterwards, so its end is final.
            let is_complete = self.changed.has_changed().is_err();
            let lines = match self.file.as_mut().map(|file| cutter.read(file)) {
                None => Vec::new(),
                Some(Ok(lines)) => lines,
                Some(Err(error)) => {
                    self.file = None;
                    vec![log_note(format!("the log could not be read any further: {error}"))]
                }
            };
            if !lines.is_empty() {
                for line in lines {
                    if !self.send(line).await {
                        return;
                    }
                }
                continue;
            }
            // End of the file for now. Nothing more is written to a file once a newer one exists, which was the case
            // before the last read.
            if let Some(younger) = self.younger.take() {
                self.file = Some(younger);
                cutter.rest.clear();
                continue;
            }
            self.younger = self.opened.take();
            if self.younger.is_some() {
                continue;
            }
            if is_complete {
                return;
            }
            tokio::select! {
                // An error means that the log is complete, which the next round notices.
                _ = self.changed.changed() => {}
                () = self.sender.closed() => return,
            }
        }
    }

    /// Sends a line; while the receiver does not take it, closes files that were rotated away: they are deleted, and
    /// only open descriptors keep them on the disk. Returns false if nobody receives any more.
    async fn send(&mut self, line: LogLine) -> bool {
        let mut is_open = true;
        loop {
            tokio::select! {
                biased;
                permit = self.sender.reserve() => {
                    return permit.map(|permit| permit.send(line)).is_ok();
                }
                changed = self.changed.changed(), if is_open => {
                    is_open = changed.is_ok();
                    if self.opened.has_skipped() {
                        (self.file, self.younger) = (None, None);
                    }
                }
            }
        }
    }
}

/// Decodes blocks of a log into lines.
#[derive(Default)]
struct LogLineDecoder {
    /// Bytes read that are not a complete line yet.
    rest: Vec<u8>,
    /// Number expected for the next line; `None` before the first.
    expected: Option<u64>,
}

impl LogLineDecoder {
    /// Reads the next block and returns its complete lines; none at the end of the file.
    fn read(&mut self, file: &mut File) -> io::Result<Vec<LogLine>> {
        let mut block = vec![0; BLOCK];
        loop {
            let length = file.read(&mut block)?;
            if length == 0 {
                return Ok(Vec::new());
            }
            self.rest.extend_from_slice(&block[..length]);
            let Some(end) = self.rest.iter().rposition(|byte| *byte == b'\n') else {
                continue;
            };
            let whole: Vec<u8> = self.rest.drain(..=end).collect();
            let mut lines = Vec::new();
            for text in whole.split(|byte| *byte == b'\n') {
                // A line in another format was written by hand; it is skipped.
                let Ok(line) = serde_json::from_slice::<LogLine>(text) else {
                    continue;
                };
                let Some(number) = line.number else {
                    continue;
                };
                let missed = self.expected.map_or(0, |expected| number.saturating_sub(expected));
                self.expected = Some(number + 1);
                if missed > 0 {
                    lines.push(log_note(format!(
                        "{missed} lines were lost here: the log was rotated before they were read"
                    )));
                }
                lines.push(line);
            }
            if !lines.is_empty() {
                return Ok(lines);
            }
        }
    }
}

fn open_if_exists(path: &Path) -> io::Result<Option<File>> {
    match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        result => result.map(Some),
    }
}

fn inode(file: &File) -> io::Result<(u64, u64)> {
    file.metadata().map(|metadata| (metadata.dev(), metadata.ino()))
}

fn log_note(line: String) -> LogLine {
    LogLine { number: None, time: SystemTime::now(), node: "cloudroid".into(), stream: "stderr".into(), line }
}

#[cfg(test)]
mod tests;
