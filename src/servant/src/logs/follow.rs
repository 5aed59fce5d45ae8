//! Reading a log while it is written and rotated.
//!
//! Two tasks: one opens each file as soon as it is there and never waits for anybody; the other reads them in order, as
//! slowly as its receiver likes. So neither a rotation nor the removal of the log can take away what was not read yet.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::fd::{AsFd, AsRawFd, RawFd};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::mpsc::error::TryRecvError;
use tokio::sync::{mpsc, watch};

use super::{last, rotated};
use crate::engine::LogLine;

/// Lines that may wait for the receiver.
const AHEAD: usize = 256;
/// Bytes read at once.
const BLOCK: usize = 64 * 1024;

/// Every line of the log at `path`, from the first that is still there or from now on. It ends, after the last line, when
/// `ended` completes: that must not be before the last line was written. From when `guard` is dropped on, the log may be removed.
pub fn follow(
    path: PathBuf,
    from_start: bool,
    ended: impl Future<Output = ()> + Send + 'static,
    guard: impl Send + 'static,
) -> mpsc::Receiver<LogLine> {
    let (sender, receiver) = mpsc::channel(AHEAD);
    let (files, opened) = mpsc::unbounded_channel();
    let changes = watch::Sender::new(());
    let changed = changes.subscribe();
    // Opened here and not in the task: what is written after this function has returned is surely seen. Files are opened
    // where that may be, and what servants printed is parsed elsewhere.
    let log = path.clone();
    let discovering = privilege::now(move || {
        let discovery = Discovery::open(&log, from_start, files)?;
        tokio::spawn(async move {
            discovery.run(&changes, ended).await;
            drop(guard);
        });
        Ok::<_, io::Error>(())
    });
    match discovering {
        Ok(()) => drop(tokio::spawn(read(opened, changed, sender))),
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

/// `lines` of the log at `path`, which are followed from now on, behind its last `count` lines until now; none comes twice.
/// From when `guard` is dropped on, the log may be removed.
pub fn with_past(
    path: PathBuf,
    count: usize,
    mut lines: mpsc::Receiver<LogLine>,
    guard: impl Send + 'static,
) -> mpsc::Receiver<LogLine> {
    let (sender, receiver) = mpsc::channel(AHEAD);
    tokio::spawn(async move {
        let past = last(path, count, None).await;
        drop(guard);
        let newest = past.last().and_then(|line| line.number);
        for line in past {
            if sender.send(line).await.is_err() {
                return;
            }
        }
        loop {
            let line = tokio::select! {
                line = lines.recv() => line,
                () = sender.closed() => return,
            };
            let Some(line) = line else { return };
            if is_after(&line, newest) && sender.send(line).await.is_err() {
                return;
            }
        }
    });
    receiver
}

/// Whether a line comes after the one with the number `newest`. Its time says nothing: clocks are set back.
fn is_after(line: &LogLine, newest: Option<u64>) -> bool {
    line.number.is_none() || line.number > newest
}

/// What nix lacks: its inotify has no raw descriptor to show.
struct Watch(Inotify);

impl AsRawFd for Watch {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

struct Discovery {
    path: PathBuf,
    watch: AsyncFd<Watch>,
    files: mpsc::UnboundedSender<File>,
    /// The youngest file that is known. Held open, so that its inode cannot become another file's.
    last: Option<File>,
}

impl Discovery {
    fn open(path: &Path, from_start: bool, files: mpsc::UnboundedSender<File>) -> io::Result<Self> {
        let inotify = Inotify::init(InitFlags::IN_CLOEXEC | InitFlags::IN_NONBLOCK)?;
        let directory = path.parent().unwrap_or(Path::new("/"));
        let events =
            AddWatchFlags::IN_MODIFY | AddWatchFlags::IN_CREATE | AddWatchFlags::IN_ONLYDIR;
        inotify.add_watch(directory, events)?;
        // SAFETY: the descriptor is owned by what is registered, and nothing else closes it.
        let watch = unsafe { AsyncFd::register_with_interest(Watch(inotify), Interest::READABLE) }?;
        let mut discovery = Self {
            path: path.into(),
            watch,
            files,
            last: None,
        };
        if from_start {
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
                _ = self.watch.readable() => false,
                () = &mut ended => true,
                () = changes.closed() => return,
            };
            // What happened is looked up in the directory; the events only say when. Read until there are no more, or the
            // next wait would return at once.
            let read = |watch: &Watch| watch.0.read_events().map_err(io::Error::from);
            while self.watch.try_io(Interest::READABLE, read).is_ok() {}
            // A failure to open shows as a gap in the numbers.
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
        // Nobody reads any more: run ends by itself.
        let _ = self.files.send(file);
        Ok(())
    }
}

/// Reads the files in their order.
async fn read(
    mut opened: mpsc::UnboundedReceiver<File>,
    mut changed: watch::Receiver<()>,
    sender: mpsc::Sender<LogLine>,
) {
    let Some(mut file) = opened.recv().await else {
        return;
    };
    let mut next = None;
    let mut complete = false;
    let mut cutter = Cutter::default();
    loop {
        changed.mark_unchanged();
        let lines = match cutter.read(&mut file) {
            Ok(lines) => lines,
            Err(error) => vec![note(format!("the log could not be read on: {error}"))],
        };
        let Some(lines) = (!lines.is_empty()).then_some(lines) else {
            // The end, for now. Nothing more is written to a file once a younger one is known, nor once the log is complete:
            // but that must have been known before the last read.
            if let Some(younger) = next.take() {
                file = younger;
                cutter.rest.clear();
                continue;
            }
            match opened.try_recv() {
                Ok(younger) => next = Some(younger),
                Err(TryRecvError::Disconnected) if complete => return,
                Err(TryRecvError::Disconnected) => complete = true,
                Err(TryRecvError::Empty) => {
                    tokio::select! {
                        // An error means that the log is complete, which the next round sees.
                        _ = changed.changed() => {}
                        () = sender.closed() => return,
                    }
                }
            }
            continue;
        };
        for line in lines {
            if sender.send(line).await.is_err() {
                return;
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
mod tests {
    use tokio::sync::oneshot;

    use super::*;
    use crate::logs::Writer;

    async fn all(mut lines: mpsc::Receiver<LogLine>) -> Vec<String> {
        let mut seen = Vec::new();
        while let Some(line) = lines.recv().await {
            seen.push(line.line);
        }
        seen
    }

    #[tokio::test]
    async fn every_line_arrives_in_order_across_rotations() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 4000, u64::MAX).unwrap();
        writer.append("/a", "stdout", "0");
        let (end, ended) = oneshot::channel::<()>();
        let lines = follow(path.clone(), true, async { drop(ended.await) }, ());
        for number in 1..500 {
            writer.append("/a", "stdout", &number.to_string());
            // Lets the discovery run, as it does beside another process. Nobody receives yet.
            tokio::task::yield_now().await;
            tokio::task::yield_now().await;
        }
        end.send(()).unwrap();
        let expected: Vec<_> = (0..500).map(|number| number.to_string()).collect();
        assert_eq!(all(lines).await, expected);
        assert!(rotated(&path).exists(), "it was rotated");
    }

    #[tokio::test]
    async fn from_now_on_means_from_now_on_and_removal_loses_nothing() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 1 << 20, u64::MAX).unwrap();
        writer.append("/a", "stdout", "before");
        let (end, ended) = oneshot::channel::<()>();
        let lines = follow(path.clone(), false, async { drop(ended.await) }, ());
        writer.append("/a", "stderr", "after");
        drop(home);
        end.send(()).unwrap();
        assert_eq!(all(lines).await, ["after"]);
    }

    #[tokio::test]
    async fn the_past_and_what_follows_come_once_each_by_their_place_and_not_by_their_time() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 1 << 20, u64::MAX).unwrap();
        for number in 0..3 {
            writer.append("/a", "stdout", &number.to_string());
        }
        let (sender, following) = mpsc::channel(4);
        let lines = with_past(path, 2, following, ());
        let line = |number, text: &str| LogLine {
            number,
            // The clock was set back.
            time: SystemTime::UNIX_EPOCH,
            line: text.into(),
            ..note(String::new())
        };
        // Printed between the beginning of the following and the look back, and after it.
        sender.send(line(Some(2), "2")).await.unwrap();
        sender.send(line(Some(3), "3")).await.unwrap();
        sender.send(line(None, "of the log itself")).await.unwrap();
        drop(sender);
        assert_eq!(all(lines).await, ["1", "2", "3", "of the log itself"]);
    }

    #[tokio::test]
    async fn once_the_guard_is_dropped_the_log_may_go() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 200, u64::MAX).unwrap();
        writer.append("/a", "stdout", "first");
        let guards = watch::Sender::new(());
        let (end, ended) = oneshot::channel::<()>();
        let lines = follow(
            path.clone(),
            true,
            async { drop(ended.await) },
            guards.subscribe(),
        );
        writer.append("/a", "stdout", "second, rotated");
        end.send(()).unwrap();
        guards.closed().await;
        drop(home);
        assert_eq!(all(lines).await, ["first", "second, rotated"]);
    }

    #[tokio::test]
    async fn a_reader_too_slow_is_told_what_it_missed() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 400, u64::MAX).unwrap();
        writer.append("/a", "stdout", "0");
        let lines = follow(path.clone(), true, std::future::ready(()), ());
        for number in 1..100 {
            writer.append("/a", "stdout", &number.to_string());
        }
        let seen = all(lines).await;
        assert_eq!(seen[0], "0");
        assert!(
            seen.iter()
                .any(|line| line.contains("lines were lost here")),
            "{seen:?}"
        );
        assert_eq!(seen.last().unwrap(), "99");
    }
}
