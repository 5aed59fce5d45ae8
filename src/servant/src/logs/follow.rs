//! Reading a log while it is written and rotated.
//!
//! Two tasks: one opens each file as soon as it is there and never waits for anybody; the other reads them in order, as
//! slowly as its receiver likes. So neither a rotation nor the removal of the log takes away at once what was not read yet. Who is slower
//! than two rotations goes on with the newest and is told how many lines are missing, since files that are removed and open take the disk.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use tokio::sync::{mpsc, watch};

use super::rotated;
use super::tail::seek_to_last;
use super::watches::{Watch, Watches};
use crate::engine::{LogLine, LogStart};

/// Lines that may wait for the receiver.
const AHEAD: usize = 16;
/// Files that may wait to be read: as many as there are of a log.
const UNREAD: usize = 2;
/// Bytes read at once.
const BLOCK: usize = 64 * 1024;

/// Lines of the log at `path`, from `start` on. They end, after the last line, when
/// `ended` completes: that must not be before the last line was written. From when `guard` is dropped on, the log may be removed.
pub fn follow(
    watches: &Arc<Watches>,
    path: PathBuf,
    start: LogStart,
    ended: impl Future<Output = ()> + Send + 'static,
    guard: impl Send + 'static,
) -> mpsc::Receiver<LogLine> {
    let (sender, receiver) = mpsc::channel(AHEAD);
    let opened = Arc::new(Opened::default());
    let changes = watch::Sender::new(());
    let changed = changes.subscribe();
    // Opened here and not in the task: what is written after this function has returned is surely seen. Files are opened
    // where that may be, and what servants printed is parsed elsewhere.
    let log = path.clone();
    let watches = Arc::clone(watches);
    let files = Arc::clone(&opened);
    let discovering = privilege::now(move || {
        let directory = log.parent().unwrap_or(Path::new("/"));
        let watch = watches.watch(directory)?;
        let discovery = Discovery::open(&log, start, watch, Arc::clone(&files))?;
        // Those that are there are read first, however soon there are others.
        let first = [files.take(), files.take()];
        tokio::spawn(async move {
            discovery.run(&changes, ended).await;
            drop(guard);
        });
        Ok::<_, io::Error>(first)
    });
    match discovering {
        Ok([file, younger]) => {
            let reader = Reader {
                file,
                younger,
                opened,
                changed,
                sender,
            };
            tokio::spawn(reader.run(start));
        }
        Err(error) => {
            // The channel is empty: there is room for the one line.
            let _ = sender.try_send(note(format!(
                "could not follow {}: {error}",
                path.display()
            )));
        }
    }
    receiver
}

/// Files that are known and not read yet, the newest few of them.
#[derive(Default)]
struct Opened(Mutex<Queue>);

#[derive(Default)]
struct Queue {
    files: VecDeque<File>,
    /// Whether one was left out since one was taken.
    has_skipped: bool,
}

impl Opened {
    fn queue(&self) -> MutexGuard<'_, Queue> {
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
    watch: Watch,
    files: Arc<Opened>,
    /// The youngest file that is known. Held open, so that its inode cannot become another file's.
    last: Option<File>,
}

impl Discovery {
    fn open(path: &Path, start: LogStart, watch: Watch, files: Arc<Opened>) -> io::Result<Self> {
        let mut discovery = Self {
            path: path.into(),
            watch,
            files,
            last: None,
        };
        if start != LogStart::Now {
            discovery.look()?;
        } else if let Some(mut file) = existing(path)? {
            file.seek(SeekFrom::End(0))?;
            discovery.pass_on(file)?;
        }
        Ok(discovery)
    }

    async fn run(mut self, changes: &watch::Sender<()>, ended: impl Future<Output = ()>) {
        let mut ended = std::pin::pin!(ended);
        loop {
            let over = tokio::select! {
                () = self.watch.changed() => false,
                () = &mut ended => true,
                () = changes.closed() => return,
            };
            // What happened is looked up in the directory; the watch only says when. A failure to open shows as a gap in the numbers.
            let _ = self.look();
            if over {
                return;
            }
            changes.send_replace(());
        }
    }

    /// Passes on the files that are new: the current one, and the rotated one when it is younger than what is known.
    fn look(&mut self) -> io::Result<()> {
        let last = self.last.as_ref().map(inode).transpose()?;
        // A rotation may happen between the calls: they are repeated until they fit together.
        for _ in 0..10 {
            let older = existing(&rotated(&self.path))?;
            let current = existing(&self.path)?;
            let again = existing(&rotated(&self.path))?;
            let id = |file: &Option<File>| file.as_ref().map(inode).transpose();
            if id(&older)? != id(&again)? {
                continue;
            }
            if last.is_some() && id(&current)? == last {
                return Ok(());
            }
            for file in older.into_iter().chain(current) {
                if Some(inode(&file)?) != last {
                    self.pass_on(file)?;
                }
            }
            return Ok(());
        }
        Ok(())
    }

    fn pass_on(&mut self, file: File) -> io::Result<()> {
        self.last = Some(file.try_clone()?);
        self.files.add(file);
        Ok(())
    }
}

/// Reads the files in their order. Where its receiver is too slow for that, it goes on with the newest.
struct Reader {
    /// What is read.
    file: Option<File>,
    /// What is read next.
    younger: Option<File>,
    opened: Arc<Opened>,
    changed: watch::Receiver<()>,
    sender: mpsc::Sender<LogLine>,
}

impl Reader {
    /// Comes back when the log was read to its end, or nobody receives any more.
    async fn run(mut self, start: LogStart) {
        if let LogStart::Last(count) = start {
            let files = self.file.take().into_iter().chain(self.younger.take());
            let files = files.collect();
            let placed = tokio::task::spawn_blocking(move || seek_to_last(files, count)).await;
            let mut placed = placed.unwrap_or_default().into_iter();
            (self.file, self.younger) = (placed.next(), placed.next());
        }
        let mut cutter = Cutter::default();
        loop {
            self.changed.mark_unchanged();
            // Known before the file is read: nothing is written to it afterwards, and its end is the end.
            let is_complete = self.changed.has_changed().is_err();
            let lines = match self.file.as_mut().map(|file| cutter.read(file)) {
                None => Vec::new(),
                Some(Ok(lines)) => lines,
                Some(Err(error)) => {
                    self.file = None;
                    vec![note(format!("the log could not be read on: {error}"))]
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
            // The end, for now. Nothing more is written to a file once a younger one is known, which was so before the last read.
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
                // An error means that the log is complete, which the next round sees.
                _ = self.changed.changed() => {}
                () = self.sender.closed() => return,
            }
        }
    }

    /// Sends a line, and lets go of files that were rotated away while the receiver does not take it: they are removed, and only what reads
    /// them keeps them on the disk. False: nobody receives any more.
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

/// Makes lines of blocks.
#[derive(Default)]
struct Cutter {
    /// What was read and is not a whole line yet.
    rest: Vec<u8>,
    /// The number that the next line should have; none before the first.
    expected: Option<u64>,
}

impl Cutter {
    /// The lines that are whole in the next block; none at the end of the file.
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
                // A line that is not ours was written by hand; it is passed over.
                let Ok(line) = serde_json::from_slice::<LogLine>(text) else {
                    continue;
                };
                let Some(number) = line.number else {
                    continue;
                };
                let missed = self
                    .expected
                    .map_or(0, |expected| number.saturating_sub(expected));
                self.expected = Some(number + 1);
                if missed > 0 {
                    lines.push(note(format!(
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

fn existing(path: &Path) -> io::Result<Option<File>> {
    match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        result => result.map(Some),
    }
}

fn inode(file: &File) -> io::Result<(u64, u64)> {
    file.metadata()
        .map(|metadata| (metadata.dev(), metadata.ino()))
}

fn note(line: String) -> LogLine {
    LogLine {
        number: None,
        time: SystemTime::now(),
        node: "cloudroid".into(),
        stream: "stderr".into(),
        line,
    }
}

#[cfg(test)]
mod tests;
