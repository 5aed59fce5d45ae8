//! Extracted layers: one directory each, ready to be the lower directory of an overlay mount.
//!
//! A tree appears under its diff-id only after all of it was written and its digest was right. It is not flushed
//! to the disk before that: waiting for a quarter of a gigabyte costs more than extracting it. Instead a
//! `.volatile` file with the boot's id is there, durable, before the tree is, and goes when a background flush is
//! through; trees that a power failure caught in between are removed by the next `open` and extracted again.

use std::fs::File;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};

use crate::digest::Hashing;
use crate::files::{self, HALF_MADE, Lock};
use crate::layer_writer::LayerWriter;
use crate::pipe::pipe;
use crate::tar_reader::TarReader;
use crate::tar_writer::TarWriter;
use crate::tree::Packer;
use crate::{Digest, Error, LayerInfo, Store, TreeOptions, gzip};

const VOLATILE: &str = "volatile";

impl Store {
    /// The extracted tree of a layer: extracted now if it was not yet. It is shared, and must not be changed.
    ///
    /// Owners and groups are those in the layer when this process is root, otherwise this process's. Whiteouts
    /// are an overlay's: character device 0:0, and `trusted.overlay.opaque` (`user.overlay.opaque` without the
    /// right to set that). Device nodes are left out. Several threads and processes may ask for the same layer.
    pub fn extracted(&self, diff_id: &Digest) -> Result<PathBuf, Error> {
        let tree = self.tree_path(diff_id);
        if tree.exists() {
            return Ok(tree);
        }
        let _hold = self.hold()?;
        let turn = {
            let mut extracting = self
                .extracting
                .lock()
                .unwrap_or_else(PoisonError::into_inner);
            Arc::clone(extracting.entry(*diff_id).or_default())
        };
        let result = {
            let _turn = turn.lock().unwrap_or_else(PoisonError::into_inner);
            if tree.exists() {
                Ok(tree)
            } else {
                self.extract(diff_id, tree)
            }
        };
        self.extracting
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .remove(diff_id);
        result
    }

    pub(crate) fn tree_path(&self, diff_id: &Digest) -> PathBuf {
        self.layers_dir().join(diff_id.hex())
    }

    fn extract(&self, diff_id: &Digest, tree: PathBuf) -> Result<PathBuf, Error> {
        let layer = self.existing_layer(diff_id)?;
        let half_made = HalfMadeTree::create(self.layers_dir())?;
        self.extract_into(&half_made.path, &layer)
            .map_err(|error| error.needing(layer.unpacked))?;
        self.appear(half_made, diff_id)?;
        Ok(tree)
    }

    fn extract_into(&self, tree: &Path, layer: &LayerInfo) -> Result<(), Error> {
        let path = self.blob_path(&layer.digest);
        let label = format!("layer {}", layer.diff_id);
        let blob = File::open(&path).map_err(|error| Error::file("open", &path, error))?;
        let content = gzip::decoder(blob).map_err(|error| Error::file("read", &path, error))?;
        let found = gzip::reading_ahead(content, |content| fill(tree, content, &label, &path))?.0;
        if found != layer.diff_id {
            return Err(Error::Damaged {
                path,
                expected: layer.diff_id,
                found,
            });
        }
        Ok(())
    }

    /// Makes the extracted tree of the layer that [`Store::layer_from_tree`] makes of the same tree with the same
    /// options, without its blob: what is put on top of the layer need not wait until that is compressed. Gives the
    /// layer's diff-id and the bytes of its tar stream.
    ///
    /// Until the blob is there too, no image can have the layer, and [`Store::layer`] does not know it.
    pub fn stage_tree(&self, tree: &Path, options: &TreeOptions) -> Result<(Digest, u64), Error> {
        let _hold = self.hold()?;
        let half_made = HalfMadeTree::create(self.layers_dir())?;
        let pack = |output: &mut dyn std::io::Write| {
            let mut packer = Packer::new(TarWriter::new(output), options);
            packer.pack(tree)?;
            packer
                .finish()
                .map(drop)
                .map_err(|error| Error::file("pack", tree, error))
        };
        let into = &half_made.path;
        let ((), (diff_id, bytes)) =
            pipe(pack, |content| fill(into, content, "the new layer", tree))?;
        self.appear(half_made, &diff_id)?;
        Ok((diff_id, bytes))
    }

    /// Gives a tree that is complete its name.
    pub(crate) fn appear(&self, half_made: HalfMadeTree, diff_id: &Digest) -> Result<(), Error> {
        let tree = self.tree_path(diff_id);
        if tree.exists() {
            return Ok(());
        }
        self.mark_volatile(diff_id)?;
        match std::fs::rename(&half_made.path, &tree) {
            // Another process may have been faster; what it made is the same.
            Err(error) if !tree.exists() => return Err(Error::file("create", &tree, error)),
            _ => self.flush_later(*diff_id),
        }
        Ok(())
    }

    fn volatile_path(&self, diff_id: &Digest) -> PathBuf {
        self.layers_dir()
            .join(format!("{}.{VOLATILE}", diff_id.hex()))
    }

    fn mark_volatile(&self, diff_id: &Digest) -> Result<(), Error> {
        files::write_whole(&self.volatile_path(diff_id), boot_id()?.as_bytes())
    }

    /// Flushes the file system in the background. Nothing is lost if that never ends: the mark stays.
    fn flush_later(&self, diff_id: Digest) {
        let (mark, layers) = (self.volatile_path(&diff_id), self.layers_dir().to_owned());
        let flush = move || {
            let flushed =
                File::open(&layers).and_then(|directory| Ok(rustix::fs::syncfs(&directory)?));
            match flushed.and_then(|()| std::fs::remove_file(&mark)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    tracing::warn!(path = %layers.display(), %error, "an extracted layer could not be flushed");
                }
                _ => {}
            }
        };
        if let Err(error) = std::thread::Builder::new()
            .name("flush layers".to_owned())
            .spawn(flush)
        {
            tracing::warn!(%error, "no thread to flush an extracted layer");
        }
    }

    /// Trees that were not flushed when the machine went down may hold anything: they go.
    pub(crate) fn settle_volatile_trees(&self) -> Result<(), Error> {
        let this_boot = boot_id()?;
        for entry in files::list(self.layers_dir())? {
            let path = entry.path();
            let name = entry.file_name();
            let Some(hex) = name
                .to_str()
                .and_then(|name| name.strip_suffix(".volatile"))
            else {
                continue;
            };
            let Some(diff_id) = Digest::from_hex(hex) else {
                continue;
            };
            let tree = self.tree_path(&diff_id);
            // A flush that is through takes the mark away, perhaps just now: then the tree is whole.
            let Some(boot) = files::read_whole(&path, 4096)? else {
                continue;
            };
            if boot == this_boot.as_bytes() {
                if tree.exists() {
                    self.flush_later(diff_id);
                }
                continue;
            }
            tracing::info!(path = %tree.display(), "removing an extracted layer that had not reached the disk");
            self.discard_tree(&diff_id)?;
        }
        Ok(())
    }

    /// Removes an extracted layer, so that at no time part of it is there under its name.
    pub(crate) fn discard_tree(&self, diff_id: &Digest) -> Result<(), Error> {
        let tree = self.tree_path(diff_id);
        let doomed = self.layers_dir().join(files::half_made_name());
        match std::fs::rename(&tree, &doomed) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(Error::file("remove", &tree, error));
            }
            Err(_) => {}
            Ok(()) => {
                files::sync_directory(self.layers_dir())?;
                files::remove_tree(&doomed)?;
            }
        }
        match std::fs::remove_file(self.volatile_path(diff_id)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(Error::file("remove", self.volatile_path(diff_id), error))
            }
            _ => Ok(()),
        }
    }
}

/// Writes the entries of a tar stream below `tree`; gives the digest and the bytes of the stream. `label` and `path` are
/// where it came from, for messages.
pub(crate) fn fill(
    tree: &Path,
    content: &mut dyn std::io::Read,
    label: &str,
    path: &Path,
) -> Result<(Digest, u64), Error> {
    let mut reader = TarReader::new(Hashing::new(content));
    let mut writer = LayerWriter::new(tree)?;
    loop {
        let entry = reader
            .next_entry()
            .map_err(|stop| Error::stopped(label, path, stop))?;
        let Some(entry) = entry else { break };
        writer
            .entry(&entry, &mut reader)
            .map_err(|failed| failed.into_error(label, tree, &reader))?;
    }
    writer.finish()?;
    let mut rest = reader.into_inner();
    std::io::copy(&mut rest, &mut std::io::sink())
        .map_err(|error| Error::file("read", path, error))?;
    let (_, digest, bytes) = rest.finish();
    Ok((digest, bytes))
}

/// Changes with every start of the kernel.
fn boot_id() -> Result<String, Error> {
    let path = "/proc/sys/kernel/random/boot_id";
    std::fs::read_to_string(path).map_err(|error| Error::file("read", path, error))
}

/// A directory under a temporary name, locked while it is filled, and removed unless it was renamed.
pub(crate) struct HalfMadeTree {
    pub(crate) path: PathBuf,
    _lock: Lock,
}

impl HalfMadeTree {
    pub(crate) fn create(directory: &Path) -> Result<Self, Error> {
        loop {
            let path = directory.join(files::half_made_name());
            debug_assert!(
                path.file_name()
                    .is_some_and(|name| name.to_string_lossy().starts_with(HALF_MADE))
            );
            std::fs::DirBuilder::new()
                .mode(0o700)
                .create(&path)
                .map_err(|error| Error::file("create", &path, error))?;
            // A sweep may come between the two; then the next name has better luck.
            if let Ok(lock) = Lock::alone(&path) {
                if path.exists() {
                    return Ok(Self { path, _lock: lock });
                }
            }
        }
    }
}

impl Drop for HalfMadeTree {
    fn drop(&mut self) {
        // After the rename there is nothing under this name.
        if let Err(error) = files::remove_tree(&self.path) {
            tracing::warn!(%error, "a half-made tree remains until the next start");
        }
    }
}
