//! Archives as request bodies: packed while they are sent, without a temporary file.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, sync_channel};

use anyhow::{Context, ensure};
use bytes::Bytes;
use flate2::Compression;
use flate2::write::GzEncoder;
use futures_util::StreamExt;
use http_body_util::{BodyExt, StreamBody};
use hyper::body::Frame;
use tokio::sync::mpsc;

use super::selection::{self, Selection};
use crate::client::RequestBody;
use crate::output;

/// Size and number of chunks that packing may be ahead of sending.
const CHUNK: usize = 256 << 10;
const CHUNKS_AHEAD: usize = 8;

/// Handle of who packs the archive.
#[derive(Debug)]
pub struct Packing {
    failure: std::sync::mpsc::Receiver<anyhow::Error>,
}

impl Packing {
    /// Creates a handle, and where the error goes if packing fails.
    pub fn channel() -> (SyncSender<anyhow::Error>, Packing) {
        let (failed, failure) = sync_channel(1);
        (failed, Packing { failure })
    }

    /// Returns the error of packing, if it failed.
    pub fn into_error(self) -> Option<anyhow::Error> {
        self.failure.try_recv().ok()
    }
}

/// Content of a push on this machine.
#[derive(Debug)]
pub enum PushSource {
    /// Files of a directory.
    Directory(PathBuf, Selection),
    /// An archive.
    Archive(PathBuf),
    /// Directory of an OCI image layout, of which only files of the specification are sent.
    Layout(PathBuf),
}

impl PushSource {
    /// Selects the files to send of a directory, or takes a file as an archive. What the deployer should know of a
    /// directory is printed.
    pub async fn open(path: PathBuf) -> anyhow::Result<PushSource> {
        let source = tokio::task::spawn_blocking(move || open_source(path)).await??;
        if let PushSource::Directory(_, selection) = &source {
            for note in &selection.notes {
                output::eprint_line(&format!("note: {note}"));
            }
        }
        Ok(source)
    }

    /// Returns the time of the newest source in seconds since 1970, or `SOURCE_DATE_EPOCH`
    /// (<https://reproducible-builds.org/specs/source-date-epoch/>), which becomes the creation time of the image: what
    /// is sent has no times. `None` for an archive.
    pub fn find_creation_time(&self) -> Option<u64> {
        let PushSource::Directory(_, selection) = self else {
            return None;
        };
        let given = std::env::var("SOURCE_DATE_EPOCH").ok().and_then(|text| text.parse().ok());
        given.or(selection.newest)
    }

    /// Returns it as a body.
    pub fn into_body(self) -> (RequestBody, Packing) {
        let (body, chunks) = new_body();
        let (failed, packing) = Packing::channel();
        std::thread::spawn(move || {
            let (path, outcome) = match &self {
                PushSource::Directory(path, selection) => (path, pack(selection, &chunks)),
                PushSource::Archive(path) => (path, copy(path, &chunks)),
                PushSource::Layout(path) => (path, pack_layout(path, &chunks)),
            };
            if let Err(error) = outcome {
                let error = error.context(format!("cannot pack {}", path.display()));
                let torn = io::Error::other(error.to_string());
                let _ = failed.try_send(error);
                // The body ends with an error, so that the daemon does not accept a truncated archive.
                let _ = chunks.blocking_send(Err(torn));
            }
        });
        (body, packing)
    }
}

/// Receiver of a body's chunks. An error ends the body with a failure.
pub type Chunks = mpsc::Sender<io::Result<Bytes>>;

/// Creates a body of chunks that are yet to come.
pub fn new_body() -> (RequestBody, Chunks) {
    let (chunks, received) = mpsc::channel(CHUNKS_AHEAD);
    let frames =
        futures_util::stream::unfold(received, |mut received| async move { Some((received.recv().await?, received)) });
    let body = StreamBody::new(frames.map(|chunk: io::Result<Bytes>| chunk.map(Frame::data)));
    (body.boxed_unsync(), chunks)
}

/// Selects the files to send. Blocking.
fn open_source(path: PathBuf) -> anyhow::Result<PushSource> {
    let metadata = std::fs::metadata(&path).with_context(|| format!("cannot push {}", path.display()))?;
    if !metadata.is_dir() {
        return Ok(PushSource::Archive(path));
    }
    let selection = selection::select_files(&path)?;
    ensure!(
        selection.has_package,
        "{} contains no package.xml; push the directory of a ROS package, a workspace or an install space, or a \
         Debian package with --apt NAME",
        path.display()
    );
    Ok(PushSource::Directory(path, selection))
}

fn copy(archive: &Path, chunks: &Chunks) -> anyhow::Result<()> {
    let mut file = std::fs::File::open(archive)?;
    let mut sender = ChunkWriter::new(chunks);
    io::copy(&mut file, &mut sender)?;
    sender.flush()?;
    Ok(())
}

fn pack(selection: &Selection, chunks: &Chunks) -> anyhow::Result<()> {
    let encoder = GzEncoder::new(ChunkWriter::new(chunks), Compression::fast());
    let mut archive = tar::Builder::new(encoder);
    archive.follow_symlinks(false);
    archive.mode(tar::HeaderMode::Deterministic);
    // The daemon reads no maps of holes: they are sent as zeros, which compress to almost nothing.
    archive.sparse(false);
    for entry in &selection.entries {
        let added = archive.append_path_with_name(&entry.source, &entry.inside);
        added.with_context(|| entry.source.display().to_string())?;
    }
    archive.into_inner()?.finish()?.flush()?;
    Ok(())
}

/// Packs an image layout as skopeo's `oci-archive` does. Its layers are compressed already.
fn pack_layout(layout: &Path, chunks: &Chunks) -> anyhow::Result<()> {
    let mut archive = tar::Builder::new(ChunkWriter::new(chunks));
    archive.mode(tar::HeaderMode::Deterministic);
    archive.sparse(false);
    for name in ["oci-layout", "index.json"] {
        archive.append_path_with_name(layout.join(name), name).with_context(|| name.to_owned())?;
    }
    let blobs = Path::new("blobs/sha256");
    let mut names = Vec::new();
    for entry in std::fs::read_dir(layout.join(blobs)).context("blobs/sha256")? {
        names.push(entry?.file_name());
    }
    names.sort();
    for name in names.iter().filter(|name| name.len() == 64) {
        let inside = blobs.join(name);
        archive.append_path_with_name(layout.join(&inside), &inside).with_context(|| inside.display().to_string())?;
    }
    archive.into_inner()?.flush()?;
    Ok(())
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

#[cfg(test)]
mod tests {
    use std::os::unix::fs::FileExt;

    use super::*;

    #[test]
    fn of_a_layout_its_documents_and_blobs_are_packed() {
        let place = tempfile::tempdir().expect("a directory");
        let blob = format!("blobs/sha256/{}", "a".repeat(64));
        for (name, text) in [("oci-layout", "{}"), ("index.json", "[]"), (&blob, "layer"), ("blobs/sha256/tmp-1", "x")]
        {
            let path = place.path().join(name);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let (chunks, mut received) = mpsc::channel(1 << 10);
        pack_layout(place.path(), &chunks).expect("packed");
        drop(chunks);
        let mut packed = Vec::new();
        while let Some(chunk) = received.blocking_recv() {
            packed.extend_from_slice(&chunk.expect("data"));
        }
        let mut archive = tar::Archive::new(&packed[..]);
        let names = archive.entries().expect("a tar").map(|entry| {
            let entry = entry.expect("an entry");
            entry.path().expect("a path").display().to_string()
        });
        assert_eq!(names.collect::<Vec<_>>(), ["oci-layout", "index.json", blob.as_str()]);
    }

    #[test]
    fn a_sparse_file_is_packed_with_its_holes_as_zeros() {
        let place = tempfile::tempdir().expect("a directory");
        std::fs::write(place.path().join("package.xml"), "<package/>").expect("written");
        let file = std::fs::File::create(place.path().join("map.db")).expect("made");
        file.write_all_at(b"end", 3 << 20).expect("written");
        let selection = selection::select_files(place.path()).expect("selected");
        let (chunks, mut received) = mpsc::channel(1 << 10);
        pack(&selection, &chunks).expect("packed");
        drop(chunks);
        let mut packed = Vec::new();
        while let Some(chunk) = received.blocking_recv() {
            packed.extend_from_slice(&chunk.expect("data"));
        }
        let mut archive = tar::Archive::new(flate2::read::GzDecoder::new(&packed[..]));
        let entries = archive.entries().expect("an archive").map(|entry| {
            let entry = entry.expect("whole");
            let path = entry.path().expect("a name").display().to_string();
            (path, entry.header().entry_type(), entry.size())
        });
        let entries: Vec<_> = entries.collect();
        let regular = tar::EntryType::Regular;
        let expected = [("map.db".to_owned(), regular, (3_u64 << 20) + 3), ("package.xml".to_owned(), regular, 10_u64)];
        assert_eq!(entries, expected);
    }
}
