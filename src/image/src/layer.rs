//! Layers: made from trees, imported, exported, found again by their content.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::digest::Hashing;
use crate::entry::shown;
use crate::extract::{HalfMadeTree, fill};
use crate::files::{self, NewFile};
use crate::gzip::{self, Failed};
use crate::store::{MAX_DOCUMENT, json};
use crate::tar_reader::TarReader;
use crate::tar_writer::TarWriter;
use crate::tree::Packer;
use crate::{Digest, Error, Limits, Refusal, Store};

/// A layer in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LayerInfo {
    /// Of the compressed blob.
    pub digest: Digest,
    /// Of the tar stream inside.
    pub diff_id: Digest,
    /// Bytes of the compressed blob.
    pub size: u64,
    /// Bytes of the tar stream inside: about what the extracted tree takes. 0 when not known.
    #[serde(default)]
    pub unpacked: u64,
}

/// How a file tree becomes a layer.
#[derive(Debug, Clone)]
pub struct TreeOptions {
    /// Subtracted from every owner and group: the first host id of the user namespace the tree was made in.
    /// Ids below it (files the daemon itself put there) become 0.
    pub uid_offset: u32,
    /// What to leave out: globs of paths relative to the root (`*` and `?` within one name, `**` across names),
    /// or of bare names at any depth (`*.log`) when there is no slash. What is left out is left out with all
    /// below it; `var/cache/*` keeps the directory itself.
    pub exclude: Vec<String>,
    /// The tree is the upper directory of an overlay mount: its marks for deletions become whiteouts.
    pub overlay_upper: bool,
    /// Which modification times are recorded.
    pub mtime: Mtime,
    /// gzip level, 1 (fast) to 9 (small).
    pub level: u32,
}

/// Modification times in a layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mtime {
    /// All the same: seconds since 1970.
    Fixed(u64),
    /// Each file's own, but none later than this. For trees whose files carry dates that mean something and are
    /// reproducible, such as an unpacked Debian package: Python throws away a `.pyc` whose source has another
    /// time than the one it recorded.
    Clamp(u64),
}

impl Default for TreeOptions {
    fn default() -> Self {
        Self {
            uid_offset: 0,
            exclude: Vec::new(),
            overlay_upper: false,
            mtime: Mtime::Fixed(0),
            level: 6,
        }
    }
}

impl Store {
    /// Packs a file tree into a layer. The same tree with the same options gives the same layer, whoever's
    /// directory order, inode numbers and clock it has.
    ///
    /// Symbolic links are packed, never followed; sockets are left out. The tree's root itself has no entry.
    pub fn layer_from_tree(&self, tree: &Path, options: &TreeOptions) -> Result<LayerInfo, Error> {
        let _hold = self.hold()?;
        let blob = self.new_blob()?;
        let packed = gzip::compress(Hashing::new(&blob), options.level, |output| {
            let mut packer = Packer::new(TarWriter::new(Hashing::new(output)), options);
            packer.pack(tree)?;
            let finished = packer
                .finish()
                .map_err(|error| Error::file("pack", tree, error))?;
            let (_, diff_id, unpacked) = finished.finish();
            Ok((diff_id, unpacked))
        });
        let (output, (diff_id, unpacked)) = packed.map_err(|failed| match failed {
            Failed::Output(error) => Error::file("write a layer to", self.images_dir(), error),
            Failed::Fill(error) => error,
        })?;
        let (_, digest, size) = output.finish();
        let layer = LayerInfo {
            digest,
            diff_id,
            size,
            unpacked,
        };
        self.publish_layer(blob, &layer)?;
        Ok(layer)
    }

    /// Copies a `tar.gz` into the store as a layer, and extracts it: in one pass, since decompressing takes longer than all else. Its digest
    /// and diff-id are found on the way.
    pub fn import_layer(&self, archive: &Path) -> Result<LayerInfo, Error> {
        let file = File::open(archive).map_err(|error| Error::file("open", archive, error))?;
        let label = archive.display().to_string();
        let _hold = self.hold()?;
        let tree = HalfMadeTree::create(self.layers_dir())?;
        let read = |copy: &mut Tee<File, Hashing<&NewFile>>| {
            let content =
                gzip::decoder(copy).map_err(|error| Error::file("read", archive, error))?;
            gzip::reading_ahead(content, |content| {
                fill(&tree.path, content, &label, archive)
            })
            .map_err(|error| match error {
                Error::File { source, .. } if is_damage(&source) => malformed(archive, source),
                error => error,
            })
        };
        let layer = self.copy_layer(file, archive, read, |_| Ok(()))?;
        self.appear(tree, &layer.diff_id)?;
        Ok(layer)
    }

    /// The same of a file that strangers have written, called `label`, which may not hold more than `limits`; gives the number of its
    /// entries, too. Nothing of it is kept unless `accept` takes it.
    pub(crate) fn import_layer_within(
        &self,
        file: File,
        label: &Path,
        limits: &Limits,
        accept: impl FnOnce(&LayerInfo) -> Result<(), Error>,
    ) -> Result<(LayerInfo, u64), Error> {
        let mut entries = 0;
        let read = |copy: &mut Tee<File, Hashing<&NewFile>>| {
            let (digest, bytes, counted) = by_reader(|| {
                let content =
                    gzip::decoder(copy).map_err(|error| Error::file("read", label, error))?;
                gzip::reading_ahead(content, |content| walk(content, label, limits))
            })?;
            entries = counted;
            Ok((digest, bytes))
        };
        let layer = self.copy_layer(file, label, read, accept)?;
        Ok((layer, entries))
    }

    /// Copies what `read` reads, which finds the digest and the bytes of the content, and keeps it if `accept` takes it.
    pub(crate) fn copy_layer(
        &self,
        file: File,
        archive: &Path,
        read: impl FnOnce(&mut Tee<File, Hashing<&NewFile>>) -> Result<(Digest, u64), Error>,
        accept: impl FnOnce(&LayerInfo) -> Result<(), Error>,
    ) -> Result<LayerInfo, Error> {
        let _hold = self.hold()?;
        let needed = file.metadata().map_or(0, |metadata| metadata.len());
        check_gzip(&file, archive)?;
        let blob = self.new_blob()?;
        let mut copy = Tee {
            from: file,
            to: Hashing::new(&blob),
            failed: None,
        };
        let read = read(&mut copy);
        if let Some(error) = copy.failed.take() {
            return Err(Error::file("write a layer to", self.images_dir(), error).needing(needed));
        }
        let (diff_id, unpacked) = read?;
        let (_, digest, size) = copy.to.finish();
        let layer = LayerInfo {
            digest,
            diff_id,
            size,
            unpacked,
        };
        accept(&layer)?;
        self.publish_layer(blob, &layer)?;
        Ok(layer)
    }

    /// Copies a layer out of the store as a `tar.gz`; appears whole or not at all.
    pub fn export_layer(&self, diff_id: &Digest, to: &Path) -> Result<(), Error> {
        let _hold = self.hold()?;
        let layer = self.existing_layer(diff_id)?;
        let from = self.blob_path(&layer.digest);
        let mut file = File::open(&from).map_err(|error| Error::file("open", &from, error))?;
        let new = NewFile::create(files::directory_of(to))?;
        // From file to file the kernel copies, or shares the blocks.
        io::copy(&mut file, &mut new.file())
            .map_err(|error| Error::file("write", to, error).needing(layer.size))?;
        new.publish(to)
    }

    /// The layer with this content, if it is in the store.
    pub fn layer(&self, diff_id: &Digest) -> Result<Option<LayerInfo>, Error> {
        if let Some(layer) = self.layer_record(diff_id)? {
            let blob = std::fs::metadata(self.blob_path(&layer.digest));
            if blob.is_ok_and(|blob| blob.len() == layer.size) {
                return Ok(Some(layer));
            }
        }
        // The directory of layers may have been emptied, or another tool have brought the image.
        for image in self.images()? {
            let Some(manifest) = self.read_manifest(&image)? else {
                continue;
            };
            let Some(config) = self.read_config(&manifest.config.digest)? else {
                continue;
            };
            let at = config
                .rootfs
                .diff_ids
                .iter()
                .position(|found| found == diff_id);
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
        let unknown = || Error::UnknownLayer {
            diff_id: *diff_id,
            store: self.images_dir().to_owned(),
        };
        self.layer(diff_id)?.ok_or_else(unknown)
    }

    /// Where the record of which blob holds a layer is.
    pub(crate) fn record_path(&self, diff_id: &Digest) -> PathBuf {
        self.layers_dir().join(format!("{}.json", diff_id.hex()))
    }

    pub(crate) fn layer_record(&self, diff_id: &Digest) -> Result<Option<LayerInfo>, Error> {
        let path = self.record_path(diff_id);
        let Some(bytes) = files::read_whole(&path, MAX_DOCUMENT)? else {
            return Ok(None);
        };
        // A record can be made again; one that does not parse is as good as none.
        Ok(serde_json::from_slice(&bytes)
            .ok()
            .filter(|layer: &LayerInfo| layer.diff_id == *diff_id))
    }

    /// The blob first: a record never names a blob that is not there. One that is there stays: the same content in other blobs would change
    /// the digests of images that are made of it later.
    fn publish_layer(&self, blob: NewFile, layer: &LayerInfo) -> Result<(), Error> {
        self.publish_blob(blob, &layer.digest)?;
        let known = self.layer_record(&layer.diff_id)?;
        if known.is_some_and(|known| self.blob_path(&known.digest).exists()) {
            return Ok(());
        }
        files::write_whole(&self.record_path(&layer.diff_id), &json(layer))
    }
}

/// Does what parses strangers' bytes on a thread that may read and do nothing else; it ends with the work that calls this.
pub(crate) fn by_reader<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let cancel = foreign::cancel::current().unwrap_or_default();
    privilege::reading(|| cancel.during(work))
}

/// Reads a layer to its end: digest and bytes of the tar stream inside.
pub(crate) fn gunzip_and_hash(archive: impl Read + Send) -> io::Result<(Digest, u64)> {
    let content = gzip::decoder(archive)?;
    gzip::reading_ahead(content, |content| {
        let mut content = Hashing::new(content);
        io::copy(&mut content, &mut io::sink())?;
        let (_, diff_id, bytes) = content.finish();
        Ok((diff_id, bytes))
    })
}

/// The same of the content of a layer that strangers have written, with the number of its headers.
fn walk(
    content: &mut dyn Read,
    label: &Path,
    limits: &Limits,
) -> Result<(Digest, u64, u64), Error> {
    let refused = |problem| Error::Archive {
        archive: label.display().to_string(),
        problem,
    };
    let most = limits.bytes.saturating_add(1);
    let mut reader = TarReader::new(Hashing::new(content.take(most)));
    let mut last = String::new();
    let walked = loop {
        match reader.next_entry() {
            Ok(None) => break Ok(()),
            Ok(Some(entry)) => {
                last = shown(&entry.name);
                if reader.headers() > limits.entries {
                    return Err(refused(Refusal::TooManyEntries {
                        entry: last,
                        limit: limits.entries,
                    }));
                }
            }
            Err(stop) => break Err(Error::stopped(&label.display().to_string(), label, stop)),
        }
    };
    let headers = reader.headers();
    let mut rest = reader.into_inner();
    // What follows the end mark counts for the digest.
    let read = match walked.is_ok() {
        true => io::copy(&mut rest, &mut io::sink()),
        false => Ok(0),
    };
    let (_, digest, bytes) = rest.finish();
    if bytes > limits.bytes {
        return Err(refused(Refusal::TooLarge {
            entry: last,
            limit: limits.bytes,
        }));
    }
    walked?;
    read.map_err(|error| malformed(label, error))?;
    Ok((digest, bytes, headers))
}

/// The media type promises gzip, so nothing else is let in.
fn check_gzip(file: &File, path: &Path) -> Result<(), Error> {
    let mut start = [0; 2];
    let read = std::os::unix::fs::FileExt::read_at(file, &mut start, 0);
    match read.map_err(|error| Error::file("read", path, error))? {
        2 if start == [0x1f, 0x8b] => Ok(()),
        _ => Err(malformed(path, "it is not gzip")),
    }
}

/// Tells if what was read is wrong, and not the reading of it.
fn is_damage(error: &io::Error) -> bool {
    use io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    [UnexpectedEof, InvalidInput, InvalidData].contains(&error.kind())
}

fn malformed(archive: &Path, problem: impl ToString) -> Error {
    let problem = Refusal::Malformed {
        after: String::new(),
        problem: problem.to_string(),
    };
    Error::Archive {
        archive: archive.display().to_string(),
        problem,
    }
}

/// Writes down all that is read from it.
pub(crate) struct Tee<R, W> {
    from: R,
    to: W,
    /// Writing failed, which the reader sees as a failure to read.
    failed: Option<io::Error>,
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
