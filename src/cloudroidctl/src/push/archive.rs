//! The package as the body of a request: packed while it is sent, nothing of it kept.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::sync_channel;

use anyhow::{Context, bail};
use bytes::Bytes;
use flate2::Compression;
use flate2::write::GzEncoder;
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full, StreamBody};
use hyper::body::Frame;
use tokio::sync::mpsc;

use crate::client::Body;

/// How far packing may run ahead of sending.
const CHUNK: usize = 256 << 10;
const CHUNKS_AHEAD: usize = 8;
/// How deep a package.xml is looked for.
const DEPTH: usize = 6;
/// Directories that hold nothing of a package.
const LEFT_OUT: [&str; 5] = [".git", ".hg", ".svn", ".catkin_tools", "__pycache__"];
/// Beside `src` of a workspace: what catkin or colcon made of it.
const MADE_OF_IT: [&str; 6] = ["build", "devel", "install", "log", "logs", "build_isolated"];

/// The packing under way.
#[derive(Debug)]
pub struct Packing {
    failure: std::sync::mpsc::Receiver<anyhow::Error>,
}

impl Packing {
    /// Why it failed, if it did.
    pub fn error(self) -> Option<anyhow::Error> {
        self.failure.try_recv().ok()
    }
}

/// No package: `--apt`.
pub fn nothing() -> Body {
    Full::default()
        .map_err(|never| match never {})
        .boxed_unsync()
}

/// The archive of a directory, or an archive as it is.
pub fn of(path: &Path) -> anyhow::Result<(Body, Packing)> {
    let metadata =
        std::fs::metadata(path).with_context(|| format!("cannot push {}", path.display()))?;
    if metadata.is_dir() && !holds_package(path, DEPTH)? {
        bail!(
            "{} holds no package.xml; push the directory of a ROS package, a workspace or an install space, \
             or take a packaged one with --apt NAME",
            path.display()
        );
    }
    let (chunks, received) = mpsc::channel(CHUNKS_AHEAD);
    let (failed, failure) = sync_channel(1);
    let source = path.to_owned();
    std::thread::spawn(move || {
        let outcome = if metadata.is_dir() {
            pack(&source, &chunks)
        } else {
            copy(&source, &chunks)
        };
        if let Err(error) = outcome {
            let error = error.context(format!("cannot pack {}", source.display()));
            let torn = io::Error::other(error.to_string());
            let _ = failed.try_send(error);
            // The body ends in an error, so the daemon does not take a torn archive for a whole one.
            let _ = chunks.blocking_send(Err(torn));
        }
    });
    let frames = futures_util::stream::unfold(received, |mut received| async move {
        Some((received.recv().await?, received))
    });
    let body = StreamBody::new(frames.map(|chunk: io::Result<Bytes>| chunk.map(Frame::data)));
    Ok((body.boxed_unsync(), Packing { failure }))
}

type Chunks = mpsc::Sender<io::Result<Bytes>>;

fn holds_package(directory: &Path, depth: usize) -> anyhow::Result<bool> {
    if directory.join("package.xml").exists() {
        return Ok(true);
    }
    if depth == 0 {
        return Ok(false);
    }
    let entries = std::fs::read_dir(directory)
        .with_context(|| format!("cannot read {}", directory.display()))?;
    for entry in entries {
        let entry = entry?;
        let skipped = LEFT_OUT.iter().any(|name| entry.file_name() == *name);
        if !skipped && entry.file_type()?.is_dir() && holds_package(&entry.path(), depth - 1)? {
            return Ok(true);
        }
    }
    Ok(false)
}

fn copy(archive: &Path, chunks: &Chunks) -> anyhow::Result<()> {
    let mut file = std::fs::File::open(archive)?;
    let mut sender = Sender::new(chunks);
    io::copy(&mut file, &mut sender)?;
    sender.flush()?;
    Ok(())
}

fn pack(root: &Path, chunks: &Chunks) -> anyhow::Result<()> {
    let encoder = GzEncoder::new(Sender::new(chunks), Compression::fast());
    let mut archive = tar::Builder::new(encoder);
    archive.follow_symlinks(false);
    archive.mode(tar::HeaderMode::Deterministic);
    let workspace = root.join("src").is_dir() && !root.join("package.xml").exists();
    add(&mut archive, root, &PathBuf::new(), workspace)?;
    archive.into_inner()?.finish()?.flush()?;
    Ok(())
}

fn add(
    archive: &mut tar::Builder<GzEncoder<Sender<'_>>>,
    root: &Path,
    relative: &Path,
    workspace: bool,
) -> anyhow::Result<()> {
    let directory = root.join(relative);
    let mut entries = std::fs::read_dir(&directory)
        .and_then(Iterator::collect::<io::Result<Vec<_>>>)
        .with_context(|| format!("cannot read {}", directory.display()))?;
    entries.sort_by_key(std::fs::DirEntry::file_name);
    for entry in entries {
        let name = entry.file_name();
        let left_out = LEFT_OUT.iter().any(|left_out| name == *left_out)
            || (workspace && MADE_OF_IT.iter().any(|made| name == *made));
        if left_out {
            continue;
        }
        let inside = relative.join(&name);
        let path = entry.path();
        let kind = entry.file_type()?;
        if kind.is_symlink() && is_catkins_toplevel(&path) {
            continue;
        }
        archive
            .append_path_with_name(&path, &inside)
            .with_context(|| format!("{}", path.display()))?;
        if kind.is_dir() {
            add(archive, root, &inside, false)?;
        }
    }
    Ok(())
}

/// `catkin_init_workspace` links `src/CMakeLists.txt` to a file of catkin's own, out of the tree; nothing of the
/// package is in it.
fn is_catkins_toplevel(link: &Path) -> bool {
    std::fs::read_link(link)
        .is_ok_and(|target| target.is_absolute() && target.ends_with("catkin/cmake/toplevel.cmake"))
}

/// Gathers writes into chunks and sends them, waiting while too many are under way.
struct Sender<'a> {
    chunks: &'a Chunks,
    pending: Vec<u8>,
}

impl<'a> Sender<'a> {
    fn new(chunks: &'a Chunks) -> Self {
        Sender {
            chunks,
            pending: Vec::with_capacity(CHUNK),
        }
    }
}

impl Write for Sender<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.pending.extend_from_slice(bytes);
        if self.pending.len() >= CHUNK {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.pending.is_empty() {
            return Ok(());
        }
        let chunk = std::mem::replace(&mut self.pending, Vec::with_capacity(CHUNK));
        self.chunks
            .blocking_send(Ok(chunk.into()))
            .map_err(|_| io::Error::new(io::ErrorKind::BrokenPipe, "the daemon takes no more"))
    }
}
