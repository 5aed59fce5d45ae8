//! Reading a log while it is written and rotated.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read};
use std::os::fd::{AsFd, AsRawFd, RawFd};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::mpsc;

use super::{Record, rotated};
use crate::engine::LogLine;

/// Every line of the log at `path`, from the first that is still there or from now on. It ends, after the last line, when
/// `ended` completes: that must not be before the last line was written. The log may be removed meanwhile.
pub fn follow(
    path: PathBuf,
    from_start: bool,
    ended: impl Future<Output = ()> + Send + 'static,
) -> mpsc::Receiver<LogLine> {
    let (sender, receiver) = mpsc::channel(256);
    // Opened here and not in the task: what is written after this function has returned is surely seen.
    let follower = Follower::open(&path, from_start);
    tokio::spawn(async move {
        match follower {
            Ok(follower) => follower.run(&sender, ended).await,
            Err(error) => {
                let line = format!("could not follow {}: {error}", path.display());
                let _ = sender.send(note(line)).await;
            }
        }
    });
    receiver
}

/// What nix lacks: its inotify has no raw descriptor to show.
struct Watch(Inotify);

impl AsRawFd for Watch {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

struct Follower {
    path: PathBuf,
    watch: AsyncFd<Watch>,
    /// Files still to be read, the oldest first; each is opened as soon as it is known, so that a later rotation
    /// cannot take it away.
    files: VecDeque<File>,
    /// What was read of the first file and is not a whole line yet.
    rest: Vec<u8>,
    /// The number that the next line should have; none before the first.
    expected: Option<u64>,
}

impl Follower {
    fn open(path: &Path, from_start: bool) -> io::Result<Self> {
        let inotify = Inotify::init(InitFlags::IN_CLOEXEC | InitFlags::IN_NONBLOCK)?;
        let directory = path.parent().unwrap_or(Path::new("/"));
        let events =
            AddWatchFlags::IN_MODIFY | AddWatchFlags::IN_CREATE | AddWatchFlags::IN_ONLYDIR;
        inotify.add_watch(directory, events)?;
        let watch = {
            // SAFETY: the descriptor is owned by what is registered, and nothing else closes it.
            unsafe { AsyncFd::register_with_interest(Watch(inotify), Interest::READABLE) }?
        };
        let mut follower = Self {
            path: path.into(),
            watch,
            files: VecDeque::new(),
            rest: Vec::new(),
            expected: None,
        };
        follower.discover()?;
        if !from_start {
            follower.skip_all()?;
        }
        Ok(follower)
    }

    /// Opens the files that are new: the current one, and the rotated one when it is younger than what we know.
    fn discover(&mut self) -> io::Result<()> {
        let last = self.files.back().map(inode).transpose()?;
        // A rotation may happen between the two calls: the older file is opened again until both fit together.
        for _ in 0..10 {
            let older = existing(&rotated(&self.path))?;
            let current = existing(&self.path)?;
            let again = existing(&rotated(&self.path))?;
            let ids = |file: &Option<File>| file.as_ref().map(inode).transpose();
            if ids(&older)? != ids(&again)? {
                continue;
            }
            if last.is_some() && ids(&current)? == last {
                return Ok(());
            }
            // Known already when the last we know has just become the older one; its reading goes on.
            let new = older.filter(|file| inode(file).ok() != last);
            self.files.extend(new.into_iter().chain(current));
            return Ok(());
        }
        Ok(())
    }

    fn skip_all(&mut self) -> io::Result<()> {
        use std::io::{Seek, SeekFrom};
        self.files.drain(..self.files.len().saturating_sub(1));
        if let Some(file) = self.files.front_mut() {
            file.seek(SeekFrom::End(0))?;
        }
        Ok(())
    }

    async fn run(mut self, sender: &mpsc::Sender<LogLine>, ended: impl Future<Output = ()>) {
        let mut ended = std::pin::pin!(ended);
        let mut over = false;
        loop {
            match self.read_lines() {
                Ok(lines) if !lines.is_empty() => {
                    for line in lines {
                        if self.send(sender, line).await.is_err() {
                            return;
                        }
                    }
                    continue;
                }
                Ok(_) if over => return,
                Ok(_) => {}
                Err(error) => {
                    let _ = sender
                        .send(note(format!(
                            "could not read {}: {error}",
                            self.path.display()
                        )))
                        .await;
                    return;
                }
            }
            tokio::select! {
                _ = self.watch.readable() => {}
                // One more round reads what was written before the end.
                () = &mut ended => over = true,
                () = sender.closed() => return,
            }
            self.note_changes();
        }
    }

    /// Sends one line, and keeps opening new files while the receiver is slow.
    async fn send(
        &mut self,
        sender: &mpsc::Sender<LogLine>,
        record: Record<'static>,
    ) -> Result<(), ()> {
        let missed = self
            .expected
            .map_or(0, |expected| record.number.saturating_sub(expected));
        self.expected = Some(record.number + 1);
        let mut lines = Vec::new();
        if missed > 0 {
            lines.push(note(format!(
                "{missed} lines were lost here: the log was rotated before they were read"
            )));
        }
        lines.push(LogLine {
            time: record.time,
            node: record.node.into_owned(),
            stream: record.stream.into_owned(),
            line: record.line.into_owned(),
        });
        for line in lines {
            let permit = loop {
                tokio::select! {
                    biased;
                    permit = sender.reserve() => break permit.map_err(|_| ())?,
                    _ = self.watch.readable() => self.note_changes(),
                }
            };
            permit.send(line);
        }
        Ok(())
    }

    fn note_changes(&mut self) {
        // What happened is looked up in the directory; the events only say when. Read until there are no more, or the next
        // wait would return at once.
        let read = |watch: &Watch| watch.0.read_events().map_err(io::Error::from);
        while self.watch.try_io(Interest::READABLE, read).is_ok() {}
        // A failure to open shows as a gap in the numbers.
        let _ = self.discover();
    }

    /// The lines that are complete in at most one block of the oldest file.
    fn read_lines(&mut self) -> io::Result<Vec<Record<'static>>> {
        let mut block = vec![0; 64 * 1024];
        loop {
            let Some(file) = self.files.front_mut() else {
                return Ok(Vec::new());
            };
            let length = file.read(&mut block)?;
            if length == 0 {
                if self.files.len() == 1 {
                    return Ok(Vec::new());
                }
                // A younger file was known before this read, so nothing more is written to this one.
                self.files.pop_front();
                self.rest.clear();
                continue;
            }
            self.rest.extend_from_slice(&block[..length]);
            let Some(end) = self.rest.iter().rposition(|byte| *byte == b'\n') else {
                continue;
            };
            let whole: Vec<u8> = self.rest.drain(..=end).collect();
            let lines = whole
                .split(|byte| *byte == b'\n')
                .filter(|line| !line.is_empty());
            let records: Vec<_> = lines.filter_map(parse).collect();
            if !records.is_empty() {
                return Ok(records);
            }
        }
    }
}

fn parse(line: &[u8]) -> Option<Record<'static>> {
    // A line that is not ours was written by hand; it is passed over.
    serde_json::from_slice::<Record<'static>>(line).ok()
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
        let mut writer = Writer::create(&path, 4000).unwrap();
        writer.append("/a", "stdout", "0");
        let (end, ended) = oneshot::channel::<()>();
        let lines = follow(path.clone(), true, async { drop(ended.await) });
        let reader = tokio::spawn(all(lines));
        for number in 1..500 {
            writer.append("/a", "stdout", &number.to_string());
            // Lets the reader run, as it does beside another process.
            tokio::task::yield_now().await;
            tokio::task::yield_now().await;
        }
        end.send(()).unwrap();
        let expected: Vec<_> = (0..500).map(|number| number.to_string()).collect();
        assert_eq!(reader.await.unwrap(), expected);
        assert!(rotated(&path).exists(), "it was rotated");
    }

    #[tokio::test]
    async fn from_now_on_means_from_now_on_and_removal_loses_nothing() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 1 << 20).unwrap();
        writer.append("/a", "stdout", "before");
        let (end, ended) = oneshot::channel::<()>();
        let lines = follow(path.clone(), false, async { drop(ended.await) });
        writer.append("/a", "stderr", "after");
        drop(home);
        end.send(()).unwrap();
        assert_eq!(all(lines).await, ["after"]);
    }

    #[tokio::test]
    async fn a_reader_too_slow_is_told_what_it_missed() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("log.jsonl");
        let mut writer = Writer::create(&path, 400).unwrap();
        writer.append("/a", "stdout", "0");
        let lines = follow(path.clone(), true, std::future::ready(()));
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
