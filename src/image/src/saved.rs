//! Import of images that other tools saved, and of root file systems: their layers, as they are, and the environment of
//! their processes.
//!
//! ```text
//!   OCI image layout (podman, skopeo, buildah, docker)  ─┐
//!   docker archive (docker save, podman save)           ─┼─▶ layers, with the digests of their content; environment
//!   root file system (tar, mmdebstrap)                  ─┘
//! ```
//!
//! [`crate::Store::receive`] is for images of another such store, which it keeps byte by byte. Here only the content of
//! a layer is kept: one that is not compressed, or by zstd, is compressed by gzip, which does not change its diff-id.

mod documents;
mod kind;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use foreign::Tree;

use crate::digest::HashingStream;
use crate::gzip::{self, CompressError};
use crate::layer::{Tee, check_gzip, run_as_reader, scan_layer};
use crate::received::unreceivable_error;
use crate::{Digest, Error, LayerInfo, Limits, Store};

use documents::SavedDocuments;
pub use kind::{ArchiveKind, BEGINNING, detect_archive};

/// gzip level of layers that arrive uncompressed: four times as fast as the default, and 20 % larger.
const LEVEL: u32 = 1;

/// An image that another tool saved, in the store, untagged.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedImage {
    /// Layers, lowest first, each once.
    pub layers: Vec<LayerInfo>,
    /// Environment of its processes.
    pub env: BTreeMap<String, String>,
    /// Name and tag, such as `docker.io/library/ros:jazzy`; empty if it has none.
    pub name: String,
}

impl Store {
    /// Imports the image in the unpacked archive that another tool has saved: an OCI image layout, or a docker archive.
    /// Of an image for several architectures, that of this machine is taken. Without [`Store::hold`], the next
    /// [`Store::gc`] removes its layers.
    ///
    /// # Errors
    /// [`Error::Unreceivable`] for an invalid archive, one of several images, or one for other machines;
    /// [`Error::Archive`] if layers exceed `limits` or cannot be read.
    pub fn receive_saved(&self, archive: &Tree, limits: &Limits) -> Result<SavedImage, Error> {
        let _hold = self.hold()?;
        let documents = run_as_reader(|| SavedDocuments::read(archive))?;
        let mut left = *limits;
        let mut layers = Vec::new();
        for layer in documents.distinct_layers() {
            let missing = || unreceivable_error(format!("its layer {} is missing", layer.path));
            let opened = archive.open_file_following(&layer.path);
            let file = opened.map_err(|error| unreceivable_error(error.to_string()))?.ok_or_else(missing)?;
            let label = PathBuf::from(format!("layer {}", layer.diff_id));
            layers.push(self.import_content(file.into(), &label, Some(&layer.diff_id), &mut left)?);
        }
        Ok(SavedImage { layers, env: documents.env, name: documents.name })
    }

    /// Imports a root file system, a tar archive (plain, gzip or zstd), as a layer. Without [`Store::hold`], the next
    /// [`Store::gc`] removes it.
    ///
    /// # Errors
    /// [`Error::Archive`] if it exceeds `limits` or cannot be read.
    pub fn receive_root(&self, archive: File, limits: &Limits) -> Result<LayerInfo, Error> {
        let mut left = *limits;
        self.import_content(archive, Path::new("the archive"), None, &mut left)
    }

    /// Imports the content of a layer, called `label` in messages, which must have the digest `expected`.
    fn import_content(
        &self,
        file: File,
        label: &Path,
        expected: Option<&Digest>,
        left: &mut Limits,
    ) -> Result<LayerInfo, Error> {
        let check = |layer: &LayerInfo| match expected {
            Some(expected) if layer.diff_id != *expected => Err(unreceivable_error(format!(
                "its {} has the content of {}; save the image again",
                label.display(),
                layer.diff_id
            ))),
            _ => Ok(()),
        };
        let (layer, entries) = if check_gzip(&file, label).is_ok() {
            self.import_layer_within(file, label, left, check)?
        } else {
            self.compress_within(file, label, left, check)?
        };
        left.bytes = left.bytes.saturating_sub(layer.unpacked);
        left.entries = left.entries.saturating_sub(entries);
        // The store may have the content in another blob already.
        Ok(self.layer(&layer.diff_id)?.unwrap_or(layer))
    }

    /// Compresses an untrusted tar archive (plain or zstd) into a layer; also returns the number of its entries. The
    /// layer is discarded unless `accept` succeeds.
    fn compress_within(
        &self,
        file: File,
        label: &Path,
        limits: &Limits,
        accept: impl FnOnce(&LayerInfo) -> Result<(), Error>,
    ) -> Result<(LayerInfo, u64), Error> {
        let _hold = self.hold()?;
        let blob = self.new_blob()?;
        let packed = gzip::compress(HashingStream::new(&blob), LEVEL, |output| {
            run_as_reader(|| {
                let content = gzip::decoder(file).map_err(|error| Error::file("read", label, error))?;
                gzip::read_ahead(content, |content| {
                    let mut copy = Tee::new(content, output);
                    let scanned = scan_layer(&mut copy as &mut dyn Read, label, limits);
                    match copy.failure() {
                        Some(error) => Err(Error::file("write a layer to", self.images_dir(), error)),
                        None => scanned,
                    }
                })
            })
        });
        let (output, (diff_id, unpacked, entries)) = packed.map_err(|failed| match failed {
            CompressError::Output(error) => Error::file("write a layer to", self.images_dir(), error),
            CompressError::Fill(error) => error,
        })?;
        let (_, digest, size) = output.finish();
        let layer = LayerInfo { digest, diff_id, size, unpacked };
        accept(&layer)?;
        self.publish_layer(blob, &layer)?;
        Ok((layer, entries))
    }
}

#[cfg(test)]
mod tests;
