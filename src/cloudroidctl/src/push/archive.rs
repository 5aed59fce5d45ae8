//! The package as a request body: packed while it is sent, without a temporary file.

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

use crate::client::RequestBody;

/// Size and number of chunks that packing may be ahead of sending.
const CHUNK: usize = 256 << 10;
const CHUNKS_AHEAD: usize = 8;
/// Depth of the search for a package.xml.
const DEPTH: usize = 6;
/// Directories that never belong to a package.
pub(super) const LEFT_OUT: [&str; 5] = [".git", ".hg", ".svn", ".catkin_tools", "__pycache__"];
/// Directories beside `src` of a workspace that catkin or colcon generate.
pub(super) const MADE_OF_IT: [&str; 6] = ["build", "devel", "install", "log", "logs", "build_isolated"];

/// Handle of the thread that packs the archive.
#[derive(Debug)]
pub struct Packing {
    failure: std::sync::mpsc::Receiver<anyhow::Error>,
}

impl Packing {
    /// Returns the error of packing, if it failed.
    pub fn into_error(self) -> Option<anyhow::Error> {
        self.failure.try_recv().ok()
    }
}

/// Returns an empty body, for `--apt`.
pub fn empty_body() -> RequestBody {
    Full::default().map_err(|never| match never {}).boxed_unsync()
}

/// Returns the archive of a directory, or an existing archive, as a body.
pub fn request_body(path: &Path) -> anyhow::Result<(RequestBody, Packing)> {
    let metadata = std::fs::metadata(path).with_context(|| format!("cannot push {}", path.display()))?;
    if metadata.is_dir() && !holds_package(path, DEPTH)? {
        bail!(
            "{} contains no package.xml; push the directory of a ROS package, a workspace or an install space, or a \
                Debian package with --apt NAME",
            path.display()
        );
    }
    let (chunks, received) = mpsc::channel(CHUNKS_AHEAD);
    let (failed, failure) = sync_channel(1);
    let source = path.to_owned();
    std::thread::spawn(move || {
        let outcome = if metadata.is_dir() { pack(&source, &chunks) } else { copy(&source, &chunks) };
        if let Err(error) = outcome {
            let error = error.context(format!("cannot pack {}", source.display()));
            let torn = io::Error::other(error.to_string());
            let _ = failed.try_send(error);
            // The body ends with an error, so that the daemon does not accept a truncated archive.
            let _ = chunks.blocking_send(Err(torn));
        }
    });
    let frames =
        futures_util::stream::unfold(received, |mut received| async move { Some((received.recv().await?, received)) });
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
    let entries = std::fs::read_dir(directory).with_context(|| format!("cannot read {}", directory.display()))?;
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
    let mut sender = ChunkWriter::new(chunks);
    io::copy(&mut file, &mut sender)?;
    sender.flush()?;
    Ok(())
}

fn pack(root: &Path, chunks: &Chunks) -> anyhow::Result<()> {
    let encoder = GzEncoder::new(ChunkWriter::new(chunks), Compression::fast());
    let mut archive = tar::Builder::new(encoder);
    archive.follow_symlinks(false);
    archive.mode(tar::HeaderMode::Deterministic);
    let workspace = root.join("src").is_dir() && !root.join("package.xml").exists();
    add_directory(&mut archive, root, &PathBuf::new(), workspace)?;
    archive.into_inner()?.finish()?.flush()?;
    Ok(())
}

fn add_directory(
    archive: &mut tar::Builder<GzEncoder<ChunkWriter<'_>>>,
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
        archive.append_path_with_name(&path, &inside).with_context(|| format!("{}", path.display()))?;
        if kind.is_dir() {
            add_directory(archive, root, &inside, false)?;
        }
    }
    Ok(())
}

/// Returns whether a link is `src/CMakeLists.txt` of `catkin_init_workspace`, which points to a file of catkin outside
/// of the workspace and contains nothing of the package.
fn is_catkins_toplevel(link: &Path) -> bool {
    std::fs::read_link(link).is_ok_and(|target| target.is_absolute() && target.ends_with("catkin/cmake/toplevel.cmake"))
}

/// Collects writes into chunks and sends them; blocks while too many are pending.
struct ChunkWriter<'a> {
    chunks: &'a Chunks,
    pending: Vec<u8>,
}

impl<'a> ChunkWriter<'a> {
    fn new(chunks: &'a Chunks) -> Self {
        ChunkWriter { chunks, pending: Vec::with_capacity(CHUNK) }
    }
}

impl Write for ChunkWriter<'_> {
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
            .map_err(|_| io::Error::new(io::ErrorKind::BrokenPipe, "the daemon stopped reading"))
    }
}
