//! Reception of a push: the archive is unpacked while it arrives, and is never stored as such.

use std::fs::File;
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use api::{PushEvent, Size};
use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::stream::BoxStream;
use image::{ArchiveKind, Refusal};
use rootfs_builder::blocking;
use tokio_util::io::{StreamReader, SyncIoBridge};
use tokio_util::sync::CancellationToken;

use super::patience::{self, BodyRateLimit, StallFlag, TooSlow};
use super::reporter::Reporter;
use crate::Error;
use crate::Options;

/// Interval of progress events.
const TOLD_EVERY: Duration = Duration::from_millis(500);
/// Maximum time to read from a refused client.
const DISCARD_FOR: Duration = Duration::from_secs(60);
/// Maximum depth at which a package.xml is searched.
const DEPTH: usize = 6;
/// Name of an archive that is stored as it is.
const ARCHIVE_NAME: &str = "archive";
/// Maximum size of a package.xml, in bytes.
const MANIFEST: u64 = 1 << 20;

/// Body of an archive, in chunks.
pub type Archive = BoxStream<'static, io::Result<Bytes>>;

/// Next step for an archive that cannot be read.
const PACK_AGAIN: &str = "push a tar archive of a package, workspace or install space whose links stay inside it";
/// Next step for an archive of an image that cannot be read.
const SAVE_AGAIN: &str = "send an archive of podman save, docker save or skopeo copy to oci-archive, or a root file \
    system as tar";

/// Unpacks the archive into `tree`, which is created.
pub(super) async fn unpack(archive: Archive, tree: &Path, limits: &Options, report: &Reporter) -> Result<(), Error> {
    unpack_or_advise(archive, tree, limits, report, PACK_AGAIN).await
}

/// Unpacks the archive of an image into `tree`, which is created.
pub(super) async fn unpack_image(
    archive: Archive,
    tree: &Path,
    limits: &Options,
    report: &Reporter,
) -> Result<(), Error> {
    unpack_or_advise(archive, tree, limits, report, SAVE_AGAIN).await
}

async fn unpack_or_advise(
    archive: Archive,
    tree: &Path,
    limits: &Options,
    report: &Reporter,
    advice: &'static str,
) -> Result<(), Error> {
    let unpacked = image::Limits { entries: limits.entries, bytes: limits.unpacked.0, ..image::Limits::default() };
    let unpack = move |content: &mut dyn Read, inside: &Path| {
        image::unpack(content, inside, &unpacked).map(drop).map_err(|error| refusal(error, advice))
    };
    take(archive, tree, limits, report, unpack).await
}

/// Stores the archive as it is in `directory`, which is created, and returns the path of the file.
pub(super) async fn store(
    archive: Archive,
    directory: &Path,
    limits: &Options,
    report: &Reporter,
) -> Result<PathBuf, Error> {
    let copy = |content: &mut dyn Read, inside: &Path| {
        std::fs::create_dir(inside).map_err(file_error("make", inside))?;
        let path = inside.join(ARCHIVE_NAME);
        let mut file = File::create_new(&path).map_err(file_error("make", &path))?;
        io::copy(content, &mut file).map(drop).map_err(file_error("write", &path))
    };
    take(archive, directory, limits, report, copy).await?;
    Ok(directory.join(ARCHIVE_NAME))
}

/// Waits for the beginning of an archive and returns its kind, and the whole archive.
pub(super) async fn detect_kind(mut archive: Archive, limits: &Options) -> Result<(ArchiveKind, Archive), Error> {
    let mut chunks: Vec<Bytes> = Vec::new();
    let fill = async {
        let mut length = 0;
        while length < image::BEGINNING {
            let Some(chunk) = archive.next().await else { break };
            let chunk = chunk.map_err(|error| body_error(&error))?;
            length += chunk.len();
            chunks.push(chunk);
        }
        Ok::<_, Error>(())
    };
    let filled = tokio::time::timeout(limits.stall, fill).await;
    filled.map_err(|_| too_slow_error(TooSlow::Paused, limits.stall, limits.min_rate))??;
    let mut beginning = chunks.concat();
    beginning.truncate(image::BEGINNING);
    let detect = move || image::detect_archive(&beginning);
    let kind = blocking::spawn_reader(detect).await.map_err(|_| Error::Internal("looking at the archive"))?;
    let first = futures_util::stream::iter(chunks.into_iter().map(Ok));
    Ok((kind, first.chain(archive).boxed()))
}

/// Takes an archive while it arrives: `consume` reads it on a thread that may write nowhere but below the path that it
/// is given, which becomes `tree`.
async fn take(
    archive: Archive,
    tree: &Path,
    limits: &Options,
    report: &Reporter,
    consume: impl FnOnce(&mut dyn Read, &Path) -> Result<(), Error> + Send + 'static,
) -> Result<(), Error> {
    let received = Arc::new(AtomicU64::new(0));
    // Cancels the reading thread however this function is left.
    let ended = CancellationToken::new();
    let _ended = ended.clone().drop_guard();
    let stalled = StallFlag::default();
    let patience = BodyRateLimit { pause: limits.stall, rate: limits.min_rate.0 };
    let chunks = patience::timed_chunks(archive, patience, stalled.clone(), ended);
    let stream = StreamReader::new(chunks.boxed());
    let mut counted = CountingReader {
        inner: SyncIoBridge::new(stream),
        received: Arc::clone(&received),
        limit: limits.archive.0,
        exceeded: false,
    };
    let (limit, slowest) = (limits.archive, limits.min_rate);
    let destination = tree.to_owned();
    let place = privilege::spawn_blocking(move || UnpackDirectory::create(&destination))
        .await
        .map_err(|_| Error::Internal("creating a directory for the archive"))??;
    let inside = place.confined_path();
    let work = blocking::spawn(move || {
        let outcome = consume(&mut counted, &inside);
        if counted.exceeded {
            return Err(Error::TooLarge { limit });
        }
        if let Some(why) = stalled.reason() {
            return Err(too_slow_error(why, patience.pause, slowest));
        }
        outcome
    });
    let told = async {
        let mut ticks = tokio::time::interval(TOLD_EVERY);
        loop {
            ticks.tick().await;
            let done = received.load(Ordering::Relaxed);
            if done > 0 {
                report.event(PushEvent::Progress { unit: "bytes".to_owned(), done, total: None }).await;
            }
        }
    };
    tokio::select! {
        outcome = work => outcome.map_err(|_| Error::Internal("unpacking the archive"))?,
        () = told => Ok(()),
    }?;
    let done = blocking::cancel_with_caller(move || place.finish());
    privilege::spawn_blocking(done).await.map_err(|_| Error::Internal("moving the unpacked files"))?
}

/// Directory into which an archive is unpacked by threads that may write nowhere else. It is owned by them, and they
/// access it by its file descriptor, since they have no access to its path.
struct UnpackDirectory {
    /// Open handle of the directory.
    opened: File,
    path: PathBuf,
    /// Final path of the tree.
    tree: PathBuf,
}

/// Name of the tree in the directory.
const TREE_NAME: &str = "tree";

impl UnpackDirectory {
    fn create(tree: &Path) -> Result<Self, Error> {
        let parent = tree.parent().unwrap_or(tree);
        let path = parent.join("received");
        let failed = file_error("make", &path);
        store::private::make_directory(&path).map_err(failed)?;
        let opened = File::open(&path).map_err(file_error("open", &path))?;
        if let Some(account) = privilege::confined_account() {
            std::os::unix::fs::fchown(&opened, Some(account.user), Some(account.group))
                .map_err(file_error("give away", &path))?;
        }
        Ok(Self { opened, path, tree: tree.to_owned() })
    }

    /// Returns the path of the tree for those threads.
    fn confined_path(&self) -> PathBuf {
        PathBuf::from(format!("/proc/self/fd/{}/{TREE_NAME}", self.opened.as_raw_fd()))
    }

    /// Takes ownership of the tree and moves it to its final path.
    fn finish(self) -> Result<(), Error> {
        let found = self.path.join(TREE_NAME);
        if privilege::confined_account().is_some() {
            let failed = file_error("take over", &found);
            chown_tree(&found).map_err(|error| failed(io::Error::other(error)))?;
        }
        std::fs::rename(&found, &self.tree).map_err(file_error("move", &found))?;
        std::fs::remove_dir(&self.path).map_err(file_error("remove", &self.path))
    }
}

/// Changes the owner of all files of a tree to this user, without following links.
fn chown_tree(tree: &Path) -> Result<(), foreign::Error> {
    let (user, group) = (rustix::process::geteuid(), rustix::process::getegid());
    let ours = |error: rustix::io::Errno| foreign::Error::File {
        action: "take over",
        path: tree.to_owned(),
        source: error.into(),
    };
    // Top-down: once a directory is owned by this user, nobody else can change its entries.
    let no_link = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
    rustix::fs::chownat(rustix::fs::CWD, tree, Some(user), Some(group), no_link).map_err(ours)?;
    foreign::walk(tree, |entry| {
        let (parent, name) = entry.parent_and_name();
        rustix::fs::chownat(parent, name, Some(user), Some(group), no_link).map_err(ours)?;
        Ok(foreign::Visit::Into)
    })
}

fn body_error(error: &io::Error) -> Error {
    Error::Failed { message: format!("the archive did not arrive: {error}"), next: None, log: Vec::new() }
}

fn file_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.display().to_string();
    move |error| Error::Failed { message: format!("cannot {action} {path}: {error}"), next: None, log: Vec::new() }
}

fn too_slow_error(why: TooSlow, pause: Duration, rate: Size) -> Error {
    let (message, next) = match why {
        TooSlow::Paused => (
            format!("no data of the archive arrived for {} s", pause.as_secs()),
            "check the connection and push again, or raise stall in [push] of the configuration",
        ),
        TooSlow::Trickled => (
            format!("the archive arrived at less than {rate} per second"),
            "push over a faster connection, or lower min_rate in [push] of the configuration",
        ),
    };
    Error::Failed { message, next: Some(next.to_owned()), log: Vec::new() }
}

fn refusal(error: image::Error, advice: &str) -> Error {
    let next = match &error {
        image::Error::Archive { problem: Refusal::TooManyEntries { .. }, .. } => {
            Some("push fewer files, or raise entries in [push] of the configuration".to_owned())
        }
        image::Error::Archive { problem: Refusal::TooLarge { .. }, .. } => {
            Some("push fewer files, or raise unpacked in [push] of the configuration".to_owned())
        }
        image::Error::Archive { problem: Refusal::LinkLeaves { .. }, .. } => Some(
            "replace the link with a copy; build install spaces without 'colcon build --symlink-install'".to_owned(),
        ),
        image::Error::Archive { .. } => Some(advice.to_owned()),
        _ => None,
    };
    Error::Failed { message: error.to_string(), next, log: Vec::new() }
}

/// Reads what a refused client still sends, for a while.
pub(super) async fn discard(mut archive: Archive, limit: Size, ending: CancellationToken) {
    let read = async {
        let mut seen = 0;
        while let Some(Ok(chunk)) = archive.next().await {
            seen += chunk.len() as u64;
            if seen > limit.0 {
                break;
            }
        }
    };
    tokio::select! {
        _ = tokio::time::timeout(DISCARD_FOR, read) => {}
        () = ending.cancelled() => {}
    }
}

/// Returns the names of the packages in a tree, as far as they can be parsed; that of the root first. (The build parses
/// them strictly; this is for early errors.)
pub(super) fn package_names(tree: &Path) -> Vec<String> {
    let mut names = Vec::new();
    collect_packages(tree, DEPTH, &mut names);
    names
}

fn collect_packages(directory: &Path, depth: usize, names: &mut Vec<String>) {
    let manifest = foreign::Tree::open(directory).and_then(|tree| tree.read_file_following("package.xml", MANIFEST));
    if let Ok(Some(file)) = manifest {
        names.extend(parse_name(&String::from_utf8_lossy(&file.bytes)));
        return;
    }
    if depth == 0 {
        return;
    }
    let Ok(entries) = std::fs::read_dir(directory) else {
        return;
    };
    let mut below: Vec<_> = entries
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path())
        .collect();
    below.sort();
    for directory in below {
        collect_packages(&directory, depth - 1, names);
    }
}

fn parse_name(manifest: &str) -> Option<String> {
    let (_, rest) = manifest.split_once("<name>")?;
    let (name, _) = rest.split_once("</name>")?;
    Some(name.trim().to_owned())
}

/// Reader that counts bytes and fails beyond a limit.
struct CountingReader<R> {
    inner: R,
    received: Arc<AtomicU64>,
    limit: u64,
    exceeded: bool,
}

impl<R: Read> Read for CountingReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        let total = self.received.fetch_add(read as u64, Ordering::Relaxed) + read as u64;
        if total > self.limit {
            self.exceeded = true;
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, "the archive is too big"));
        }
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;

    use super::*;

    fn archive(files: &[(&str, &str)]) -> Vec<u8> {
        let mut builder = tar::Builder::new(Vec::new());
        for (name, text) in files {
            let mut header = tar::Header::new_gnu();
            header.set_size(text.len() as u64);
            header.set_mode(0o644);
            header.set_uid(0);
            header.set_gid(0);
            header.set_mtime(0);
            builder.append_data(&mut header, name, text.as_bytes()).expect("into memory");
        }
        builder.into_inner().expect("into memory")
    }

    async fn unpack_archive(bytes: Vec<u8>, limits: &Options) -> Result<Vec<String>, Error> {
        let place = tempfile::tempdir().expect("a directory");
        let tree = place.path().join("build/pushed");
        let (sender, _receiver) = mpsc::channel(16);
        let whole = futures_util::stream::iter([Ok(Bytes::from(bytes))]).boxed();
        unpack(whole, &tree, limits, &Reporter::new(sender)).await?;
        Ok(package_names(&tree))
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn an_archive_becomes_a_tree() {
        let bytes = archive(&[
            ("src/one/package.xml", "<package><name> one </name></package>"),
            ("src/two/package.xml", "<package><name>two</name></package>"),
            ("src/two/test/package.xml", "<package><name>not counted</name></package>"),
        ]);
        assert_eq!(unpack_archive(bytes, &Options::unlimited()).await.expect("good"), ["one", "two"]);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn an_archive_over_the_limit_is_refused() {
        let bytes = archive(&[("package.xml", &"x".repeat(10_000))]);
        let limits = Options { archive: Size(2000), ..Options::unlimited() };
        let refused = unpack_archive(bytes, &limits).await.expect_err("too big");
        assert!(matches!(refused, Error::TooLarge { .. }), "{refused}");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_body_that_stops_coming_is_not_waited_for() {
        let place = tempfile::tempdir().expect("a directory");
        let tree = place.path().join("build/pushed");
        let (sender, _receiver) = mpsc::channel(16);
        let beginning = archive(&[("package.xml", &"x".repeat(10_000))])[..2000].to_vec();
        let chunks = futures_util::stream::iter([Ok(Bytes::from(beginning))]);
        let body = chunks.chain(futures_util::stream::pending()).boxed();
        let limits = Options { stall: Duration::from_millis(50), ..Options::unlimited() };
        let refused = unpack(body, &tree, &limits, &Reporter::new(sender)).await.expect_err("it never ends");
        assert!(refused.to_string().contains("no data of the archive arrived"), "{refused}");
        assert!(!tree.exists());
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn the_thread_that_unpacks_ends_with_the_push() {
        let place = tempfile::tempdir().expect("a directory");
        let tree = place.path().join("build/pushed");
        let (sender, _receiver) = mpsc::channel(16);
        // The reader of the thread is dropped when it ends.
        let (held, dropped) = tokio::sync::oneshot::channel::<()>();
        let (asked, waiting) = tokio::sync::oneshot::channel::<()>();
        let mut asked = Some(asked);
        let never = futures_util::stream::poll_fn(move |_| {
            let _ = &held;
            asked.take().map(|asked| asked.send(()));
            std::task::Poll::<Option<io::Result<Bytes>>>::Pending
        });
        let push = tokio::spawn(async move {
            let body = never.boxed();
            unpack(body, &tree, &Options::unlimited(), &Reporter::new(sender)).await
        });
        waiting.await.expect("it reads");
        push.abort();
        dropped.await.expect_err("the body is let go");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn an_archive_of_a_system_is_kept_as_it_was_sent() {
        let place = tempfile::tempdir().expect("a directory");
        std::fs::create_dir(place.path().join("build")).expect("made");
        let bytes = archive(&[("etc/hostname", "robot"), ("usr/big", &"x".repeat(200_000))]);
        let sent = || {
            let chunks: Vec<_> = bytes.chunks(1000).map(|chunk| Ok(Bytes::copy_from_slice(chunk))).collect();
            futures_util::stream::iter(chunks).boxed()
        };
        let (sender, _receiver) = mpsc::channel(16);
        let report = Reporter::new(sender);
        let limits = Options::unlimited();
        let (kind, whole) = detect_kind(sent(), &limits).await.expect("good");
        assert_eq!(kind, ArchiveKind::Root);
        let stored = store(whole, &place.path().join("build/taken"), &limits, &report).await.expect("stored");
        assert_eq!(std::fs::read(stored).expect("there"), bytes);
        let small = Options { archive: Size(2000), ..Options::unlimited() };
        let refused = store(sent(), &place.path().join("build/more"), &small, &report).await.expect_err("too big");
        assert!(matches!(refused, Error::TooLarge { .. }), "{refused}");
        // A sender that stops after a few bytes is not waited for.
        let begun = futures_util::stream::iter([Ok(Bytes::from_static(b"x"))]).chain(futures_util::stream::pending());
        let impatient = Options { stall: Duration::from_millis(50), ..Options::unlimited() };
        let refused = detect_kind(begun.boxed(), &impatient).await.map(|(kind, _)| kind).expect_err("it never ends");
        assert!(refused.to_string().contains("no data of the archive arrived"), "{refused}");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn what_is_no_archive_is_refused() {
        let refused =
            unpack_archive(b"hello, this is no archive".repeat(100), &Options::unlimited()).await.expect_err("text");
        assert!(matches!(refused, Error::Failed { .. }), "{refused}");
        assert!(refused.to_string().contains("archive"), "{refused}");
    }
}
