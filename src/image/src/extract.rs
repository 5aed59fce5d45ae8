//! Extracted layers: one directory each, usable as the lower directory of an overlay mount.
//!
//! A tree is renamed to its diff-id only after it was written completely and its digest was verified. It is not flushed
//! to the disk before that, since flushing a quarter of a gigabyte takes longer than extracting it. Instead, a
//! `.volatile` file with the boot id is durable before the tree appears, and is removed when a background flush is
//! complete; trees caught in between by a power failure are removed by the next `open` and extracted again.

use std::fs::File;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};

use crate::digest::HashingStream;
use crate::files::{self, HALF_MADE, Lock};
use crate::layer_writer::LayerWriter;
use crate::pipe::pipe;
use crate::tar_reader::TarReader;
use crate::tar_writer::TarWriter;
use crate::tree::Packer;
use crate::{Digest, Error, LayerInfo, Store, TreeOptions, gzip};

const VOLATILE: &str = "volatile";

impl Store {
    /// Returns the extracted tree of a layer, extracting it if needed. The tree is shared and must not be modified.
    ///
    /// Owners and groups are those in the layer if this process is root, otherwise those of this process. Whiteouts are
    /// in overlay format: character device 0:0, and `trusted.overlay.opaque` (or `user.overlay.opaque` without the
    /// privilege to set that). Device nodes are left out. Several threads and processes may request the same layer.
    pub fn ensure_extracted(&self, diff_id: &Digest) -> Result<PathBuf, Error> {
        let tree = self.tree_path(diff_id);
        if tree.exists() {
            return Ok(tree);
        }
        let _hold = self.hold()?;
        let turn = {
            let mut extracting = self.extracting.lock().unwrap_or_else(PoisonError::into_inner);
            Arc::clone(extracting.entry(*diff_id).or_default())
        };
        let result = {
            let _turn = turn.lock().unwrap_or_else(PoisonError::into_inner);
            if tree.exists() { Ok(tree) } else { self.extract(diff_id, tree) }
        };
        self.extracting.lock().unwrap_or_else(PoisonError::into_inner).remove(diff_id);
        result
    }

    pub(crate) fn tree_path(&self, diff_id: &Digest) -> PathBuf {
        self.layers_dir().join(diff_id.hex())
    }

    fn extract(&self, diff_id: &Digest, tree: PathBuf) -> Result<PathBuf, Error> {
        let layer = self.existing_layer(diff_id)?;
        let half_made = TemporaryTree::create(self.layers_dir())?;
        self.extract_into(&half_made.path, &layer).map_err(|error| error.with_needed_bytes(layer.unpacked))?;
        self.publish_tree(half_made, diff_id)?;
        Ok(tree)
    }

    fn extract_into(&self, tree: &Path, layer: &LayerInfo) -> Result<(), Error> {
        let path = self.blob_path(&layer.digest);
        let label = format!("layer {}", layer.diff_id);
        let blob = File::open(&path).map_err(|error| Error::file("open", &path, error))?;
        let content = gzip::decoder(blob).map_err(|error| Error::file("read", &path, error))?;
        let found = gzip::read_ahead(content, |content| extract_stream(tree, content, &label, &path))?.0;
        if found != layer.diff_id {
            return Err(Error::Damaged { path, expected: layer.diff_id, found });
        }
        Ok(())
    }

    /// Creates the extracted tree of the layer that [`Store::layer_from_tree`] would create of the same tree with the
    /// same options, without its blob, so that further layers need not wait for the compression. Returns the diff-id of
    /// the layer and the size of its tar stream.
    ///
    /// Until the blob exists as well, no image can use the layer, and [`Store::layer`] does not find it.
    pub fn stage_tree(&self, tree: &Path, options: &TreeOptions) -> Result<(Digest, u64), Error> {
        let _hold = self.hold()?;
        let half_made = TemporaryTree::create(self.layers_dir())?;
        let pack = |output: &mut dyn std::io::Write| {
            let mut packer = Packer::new(TarWriter::new(output), options);
            packer.pack(tree)?;
            packer.finish().map(drop).map_err(|error| Error::file("pack", tree, error))
        };
        let into = &half_made.path;
        let ((), (diff_id, bytes)) = pipe(pack, |content| extract_stream(into, content, "the new layer", tree))?;
        self.publish_tree(half_made, &diff_id)?;
        Ok((diff_id, bytes))
    }

    /// Renames a complete tree to its final name.
    pub(crate) fn publish_tree(&self, half_made: TemporaryTree, diff_id: &Digest) -> Result<(), Error> {
        let tree = self.tree_path(diff_id);
        if tree.exists() {
            return Ok(());
        }
        self.mark_volatile(diff_id)?;
        match std::fs::rename(&half_made.path, &tree) {
            // Another process may have been faster; its result is the same.
            Err(error) if !tree.exists() => return Err(Error::file("create", &tree, error)),
            _ => self.flush_later(*diff_id),
        }
        Ok(())
    }

    fn volatile_path(&self, diff_id: &Digest) -> PathBuf {
        self.layers_dir().join(format!("{}.{VOLATILE}", diff_id.hex()))
    }

    fn mark_volatile(&self, diff_id: &Digest) -> Result<(), Error> {
        files::write_atomically(&self.volatile_path(diff_id), boot_id()?.as_bytes())
    }

    /// Flushes the file system in the background. Nothing is lost if that never completes, since the marker remains.
    fn flush_later(&self, diff_id: Digest) {
        let (mark, layers) = (self.volatile_path(&diff_id), self.layers_dir().to_owned());
        let span = tracing::Span::current();
        let flush = move || {
            let _entered = span.entered();
            let flushed = File::open(&layers).and_then(|directory| Ok(rustix::fs::syncfs(&directory)?));
            match flushed.and_then(|()| std::fs::remove_file(&mark)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    tracing::warn!(path = %layers.display(), %error, "cannot flush an extracted layer to disk");
                }
                _ => {}
            }
        };
        if let Err(error) = std::thread::Builder::new().name("flush layers".to_owned()).spawn(flush) {
            tracing::warn!(%error, "cannot start a thread to flush an extracted layer");
        }
    }

    /// Removes trees that had not been flushed when the machine went down, since their content is undefined.
    pub(crate) fn remove_unflushed_trees(&self) -> Result<(), Error> {
        let this_boot = boot_id()?;
        for entry in files::list(self.layers_dir())? {
            let path = entry.path();
            let name = entry.file_name();
            let Some(hex) = name.to_str().and_then(|name| name.strip_suffix(".volatile")) else {
                continue;
            };
            let Some(diff_id) = Digest::from_hex(hex) else {
                continue;
            };
            let tree = self.tree_path(&diff_id);
            // A concurrent flush may have just removed the marker; then the tree is complete.
            let Some(boot) = files::read_limited(&path, 4096)? else {
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

    /// Removes an extracted layer atomically: no partial tree is ever visible under its name.
    pub(crate) fn discard_tree(&self, diff_id: &Digest) -> Result<(), Error> {
        let tree = self.tree_path(diff_id);
        let doomed = self.layers_dir().join(files::temporary_name());
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

/// Extracts a tar stream below `tree`; returns the digest and size of the stream. `label` and `path` describe its
/// source in messages.
pub(crate) fn extract_stream(
    tree: &Path,
    content: &mut dyn std::io::Read,
    label: &str,
    path: &Path,
) -> Result<(Digest, u64), Error> {
    let mut reader = TarReader::new(HashingStream::new(content));
    let mut writer = LayerWriter::new(tree)?;
    loop {
        let entry = reader.next_entry().map_err(|stop| Error::from_stop(label, path, stop))?;
        let Some(entry) = entry else { break };
        writer.write_entry(&entry, &mut reader).map_err(|failed| failed.into_error(label, tree, &reader))?;
    }
    writer.finish()?;
    let mut rest = reader.into_inner();
    std::io::copy(&mut rest, &mut std::io::sink()).map_err(|error| Error::file("read", path, error))?;
    let (_, digest, bytes) = rest.finish();
    Ok((digest, bytes))
}

/// Returns the boot id of the kernel.
fn boot_id() -> Result<String, Error> {
    let path = "/proc/sys/kernel/random/boot_id";
    std::fs::read_to_string(path).map_err(|error| Error::file("read", path, error))
}

/// A directory with a temporary name, locked while it is filled, and removed on drop unless it was renamed.
pub(crate) struct TemporaryTree {
    pub(crate) path: PathBuf,
    _lock: Lock,
}

impl TemporaryTree {
    pub(crate) fn create(directory: &Path) -> Result<Self, Error> {
        loop {
            let path = directory.join(files::temporary_name());
            debug_assert!(path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(HALF_MADE)));
            std::fs::DirBuilder::new()
                .mode(0o700)
                .create(&path)
                .map_err(|error| Error::file("create", &path, error))?;
            // A sweep may have removed it before it was locked; then another name is tried.
            if let Ok(lock) = Lock::lock_exclusive(&path) {
                if path.exists() {
                    return Ok(Self { path, _lock: lock });
                }
            }
        }
    }
}

impl Drop for TemporaryTree {
    fn drop(&mut self) {
        // After the rename nothing exists under this name.
        if let Err(error) = files::remove_tree(&self.path) {
            tracing::warn!(%error, "an unfinished tree remains until the next start");
        }
    }
}
