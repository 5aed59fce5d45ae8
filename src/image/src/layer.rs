//! Layers: creation from trees, import, export, and lookup by content.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::digest::HashingStream;
use crate::entry::display_name;
use crate::extract::{TemporaryTree, extract_stream};
use crate::files::{self, NewFile};
use crate::gzip::{self, CompressError};
use crate::store::{MAX_DOCUMENT, to_json};
use crate::tar_reader::TarReader;
use crate::tar_writer::TarWriter;
use crate::tree::Packer;
use crate::{Digest, Error, Limits, Refusal, Store};

/// A layer in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LayerInfo {
    /// Digest of the compressed blob.
    pub digest: Digest,
    /// Digest of the uncompressed tar stream.
    pub diff_id: Digest,
    /// Size of the compressed blob in bytes.
    pub size: u64,
    /// Size of the tar stream in bytes, which is about the size of the extracted tree; 0 if unknown.
    #[serde(default)]
    pub unpacked: u64,
}

/// Options for packing a file tree into a layer.
#[derive(Debug, Clone)]
pub struct TreeOptions {
    /// First host id of the user namespace that the tree was created in; subtracted from every owner and group. Ids
    /// below it (files created by the daemon itself) become 0.
    pub uid_offset: u32,
    /// Exclusion patterns: globs of paths relative to the root (`*` and `?` within a component, `**` across
    /// components), or of bare names at any depth (`*.log`) if there is no slash. An excluded directory is excluded
    /// with all its content; `var/cache/*` keeps the directory itself.
    pub exclude: Vec<String>,
    /// True if the tree is the upper directory of an overlay mount: its deletion marks become whiteouts.
    pub overlay_upper: bool,
    /// Modification times to record.
    pub mtime: Mtime,
    /// gzip level, 1 (fast) to 9 (small).
    pub level: u32,
}

/// Modification times in a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mtime {
    /// A fixed time for all files, in seconds since 1970.
    Fixed(u64),
    /// The time of each file, but not later than this. For trees with meaningful and reproducible times, such as
    /// unpacked Debian packages: Python discards a `.pyc` whose source has another time than the recorded one.
    Clamp(u64),
}

impl Default for TreeOptions {
    fn default() -> Self {
        Self { uid_offset: 0, exclude: Vec::new(), overlay_upper: false, mtime: Mtime::Fixed(0), level: 6 }
    }
}

impl Store {
    /// Packs a file tree into a layer. The same tree with the same options gives the same layer, regardless of
    /// directory order, inode numbers and clock.
    ///
    /// Symbolic links are packed, never followed; sockets are left out. The root directory itself has no entry.
    pub fn layer_from_tree(&self, tree: &Path, options: &TreeOptions) -> Result<LayerInfo, Error> {
        let _hold = self.hold()?;
        let blob = self.new_blob()?;
        let packed = gzip::compress(HashingStream::new(&blob), options.level, |output| {
            let mut packer = Packer::new(TarWriter::new(HashingStream::new(output)), options);
            packer.pack(tree)?;
            let finished = packer.finish().map_err(|error| Error::file("pack", tree, error))?;
            let (_, diff_id, unpacked) = finished.finish();
            Ok((diff_id, unpacked))
        });
        let (output, (diff_id, unpacked)) = packed.map_err(|failed| match failed {
            CompressError::Output(error) => Error::file("write a layer to", self.images_dir(), error),
            CompressError::Fill(error) => error,
        })?;
        let (_, digest, size) = output.finish();
        let layer = LayerInfo { digest, diff_id, size, unpacked };
        self.publish_layer(blob, &layer)?;
        Ok(layer)
    }

    /// Imports a `tar.gz` as a layer and extracts it in a single pass, since decompression takes most of the time. Its
    /// digest and diff-id are computed on the way.
    pub fn import_layer(&self, archive: &Path) -> Result<LayerInfo, Error> {
        let file = File::open(archive).map_err(|error| Error::file("open", archive, error))?;
        let label = archive.display().to_string();
        let _hold = self.hold()?;
        let tree = TemporaryTree::create(self.layers_dir())?;
        let read = |copy: &mut Tee<File, HashingStream<&NewFile>>| {
            let content = gzip::decoder(copy).map_err(|error| Error::file("read", archive, error))?;
            gzip::read_ahead(content, |content| extract_stream(&tree.path, content, &label, archive)).map_err(|error| {
                match error {
                    Error::File { source, .. } if is_corruption(&source) => malformed_archive(archive, source),
                    error => error,
                }
            })
        };
        let layer = self.copy_layer(file, archive, read, |_| Ok(()))?;
        self.publish_tree(tree, &layer.diff_id)?;
        Ok(layer)
    }

    /// Imports an untrusted `tar.gz`, called `label` in messages, which may not exceed `limits`; also returns the
    /// number of its entries. The layer is discarded unless `accept` succeeds.
    pub(crate) fn import_layer_within(
        &self,
        file: File,
        label: &Path,
        limits: &Limits,
        accept: impl FnOnce(&LayerInfo) -> Result<(), Error>,
    ) -> Result<(LayerInfo, u64), Error> {
        let mut entries = 0;
        let read = |copy: &mut Tee<File, HashingStream<&NewFile>>| {
            let (digest, bytes, counted) = run_as_reader(|| {
                let content = gzip::decoder(copy).map_err(|error| Error::file("read", label, error))?;
                gzip::read_ahead(content, |content| scan_layer(content, label, limits))
            })?;
            entries = counted;
            Ok((digest, bytes))
        };
        let layer = self.copy_layer(file, label, read, accept)?;
        Ok((layer, entries))
    }

    /// Copies what `read` consumes, which returns the digest and size of the content; the layer is discarded unless
    /// `accept` succeeds.
    pub(crate) fn copy_layer(
        &self,
        file: File,
        archive: &Path,
        read: impl FnOnce(&mut Tee<File, HashingStream<&NewFile>>) -> Result<(Digest, u64), Error>,
        accept: impl FnOnce(&LayerInfo) -> Result<(), Error>,
    ) -> Result<LayerInfo, Error> {
        let _hold = self.hold()?;
        let needed = file.metadata().map_or(0, |metadata| metadata.len());
        check_gzip(&file, archive)?;
        let blob = self.new_blob()?;
        let mut copy = Tee::new(file, HashingStream::new(&blob));
        let read = read(&mut copy);
        if let Some(error) = copy.failure() {
            return Err(Error::file("write a layer to", self.images_dir(), error).with_needed_bytes(needed));
        }
        // Blob and tree are written at the same time: either may be the first to find no room.
        let (diff_id, unpacked) = read.map_err(|error| error.with_needed_bytes(needed))?;
        let (_, digest, size) = copy.to.finish();
        let layer = LayerInfo { digest, diff_id, size, unpacked };
        accept(&layer)?;
        self.publish_layer(blob, &layer)?;
        Ok(layer)
    }

    /// Exports a layer as a `tar.gz`, atomically.
    pub fn export_layer(&self, diff_id: &Digest, to: &Path) -> Result<(), Error> {
        let _hold = self.hold()?;
        let layer = self.existing_layer(diff_id)?;
        let from = self.blob_path(&layer.digest);
        let mut file = File::open(&from).map_err(|error| Error::file("open", &from, error))?;
        let new = NewFile::create(files::directory_of(to))?;
        // The kernel copies from file to file, or shares the blocks.
        io::copy(&mut file, &mut new.file())
            .map_err(|error| Error::file("write", to, error).with_needed_bytes(layer.size))?;
        new.publish(to)
    }

    /// Returns the layer with this diff-id, if it is in the store.
    pub fn layer(&self, diff_id: &Digest) -> Result<Option<LayerInfo>, Error> {
        if let Some(layer) = self.layer_record(diff_id)? {
            let blob = std::fs::metadata(self.blob_path(&layer.digest));
            if blob.is_ok_and(|blob| blob.len() == layer.size) {
                return Ok(Some(layer));
            }
        }
        // The directory of layers may have been emptied, or another tool may have added the image.
        for image in self.images()? {
            let Some(manifest) = self.read_manifest(&image)? else {
                continue;
            };
            let Some(config) = self.read_config(&manifest.config.digest)? else {
                continue;
            };
            let at = config.rootfs.diff_ids.iter().position(|found| found == diff_id);
            if let Some(blob) = at.and_then(|at| manifest.layers.get(at)) {
                if self.blob_path(&blob.digest).exists() {
                    return Ok(Some(LayerInfo {
                        digest: blob.digest,
                        diff_id: *diff_id,
                        size: blob.size,
                        unpacked: 0,
                    }));
                }
            }
        }
        Ok(None)
    }

    pub(crate) fn existing_layer(&self, diff_id: &Digest) -> Result<LayerInfo, Error> {
        let unknown = || Error::UnknownLayer { diff_id: *diff_id, store: self.images_dir().to_owned() };
        self.layer(diff_id)?.ok_or_else(unknown)
    }

    /// Returns the path of the record that maps a layer to its blob.
    pub(crate) fn record_path(&self, diff_id: &Digest) -> PathBuf {
        self.layers_dir().join(format!("{}.json", diff_id.hex()))
    }

    pub(crate) fn layer_record(&self, diff_id: &Digest) -> Result<Option<LayerInfo>, Error> {
        let path = self.record_path(diff_id);
        let Some(bytes) = files::read_limited(&path, MAX_DOCUMENT)? else {
            return Ok(None);
        };
        // A record can be recreated; one that cannot be parsed counts as missing.
        Ok(serde_json::from_slice(&bytes).ok().filter(|layer: &LayerInfo| layer.diff_id == *diff_id))
    }

    /// Publishes the blob before the record, so that a record never names a missing blob. An existing record is kept:
    /// other blobs of the same content would change the digests of images built from it later.
    pub(crate) fn publish_layer(&self, blob: NewFile, layer: &LayerInfo) -> Result<(), Error> {
        self.publish_blob(blob, &layer.digest)?;
        let known = self.layer_record(&layer.diff_id)?;
        if known.is_some_and(|known| self.blob_path(&known.digest).exists()) {
            return Ok(());
        }
        files::write_atomically(&self.record_path(&layer.diff_id), &to_json(layer))
    }
}

/// Runs code that parses untrusted data with no other privileges than reading; cancelled together with the caller's
/// work.
pub(crate) fn run_as_reader<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let cancel = foreign::cancel::current().unwrap_or_default();
    privilege::run_as_reader(|| cancel.run(work))
}

/// Reads a layer to its end; returns the digest and size of its tar stream.
pub(crate) fn gunzip_and_hash(archive: impl Read + Send) -> io::Result<(Digest, u64)> {
    let content = gzip::decoder(archive)?;
    gzip::read_ahead(content, |content| {
        let mut content = HashingStream::new(content);
        io::copy(&mut content, &mut io::sink())?;
        let (_, diff_id, bytes) = content.finish();
        Ok((diff_id, bytes))
    })
}

/// Reads the content of an untrusted layer to its end; returns the digest and size of the tar stream and the number of
/// its headers.
pub(crate) fn scan_layer(content: &mut dyn Read, label: &Path, limits: &Limits) -> Result<(Digest, u64, u64), Error> {
    let refused = |problem| Error::Archive { archive: label.display().to_string(), problem };
    let most = limits.bytes.saturating_add(1);
    let mut reader = TarReader::new(HashingStream::new(content.take(most)));
    let mut last = String::new();
    let walked = loop {
        match reader.next_entry() {
            Ok(None) => break Ok(()),
            Ok(Some(entry)) => {
                last = display_name(&entry.name);
                if reader.headers() > limits.entries {
                    return Err(refused(Refusal::TooManyEntries { entry: last, limit: limits.entries }));
                }
            }
            Err(stop) => break Err(Error::from_stop(&label.display().to_string(), label, stop)),
        }
    };
    let headers = reader.headers();
    let mut rest = reader.into_inner();
    // Data after the end mark is part of the digest.
    let read = if walked.is_ok() { io::copy(&mut rest, &mut io::sink()) } else { Ok(0) };
    let (_, digest, bytes) = rest.finish();
    if bytes > limits.bytes {
        return Err(refused(Refusal::TooLarge { entry: last, limit: limits.bytes }));
    }
    walked?;
    read.map_err(|error| malformed_archive(label, error))?;
    Ok((digest, bytes, headers))
}

/// Accepts only gzip, since the media type promises it.
pub(crate) fn check_gzip(file: &File, path: &Path) -> Result<(), Error> {
    let mut start = [0; 2];
    let read = std::os::unix::fs::FileExt::read_at(file, &mut start, 0);
    match read.map_err(|error| Error::file("read", path, error))? {
        2 if start == [0x1f, 0x8b] => Ok(()),
        _ => Err(malformed_archive(path, "it is not gzip")),
    }
}

/// Returns whether an error means corrupt data, as opposed to a failed read.
fn is_corruption(error: &io::Error) -> bool {
    use io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    [UnexpectedEof, InvalidInput, InvalidData].contains(&error.kind())
}

fn malformed_archive(archive: &Path, problem: impl ToString) -> Error {
    let problem = Refusal::Malformed { after: String::new(), problem: problem.to_string() };
    Error::Archive { archive: archive.display().to_string(), problem }
}

/// Reader that copies all it reads to a writer.
pub(crate) struct Tee<R, W> {
    from: R,
    to: W,
    /// Error of the writer; the reader sees it as a failed read.
    failed: Option<io::Error>,
}

impl<R, W> Tee<R, W> {
    pub(crate) fn new(from: R, to: W) -> Self {
        Self { from, to, failed: None }
    }

    /// Returns the error of the writer, if it failed.
    pub(crate) fn failure(&mut self) -> Option<io::Error> {
        self.failed.take()
    }
}

impl<R: Read, W: Write> Read for Tee<R, W> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.from.read(buffer)?;
        if let Err(error) = self.to.write_all(&buffer[..read]) {
            self.failed = Some(error);
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        Ok(read)
    }
}
