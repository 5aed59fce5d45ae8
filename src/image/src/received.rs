//! Import of images from an untrusted OCI image layout (image specification 1.1).

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use foreign::Tree;
use serde::de::DeserializeOwned;

use crate::digest::HashingStream;
use crate::layer::run_as_reader;
use crate::oci::{self, Config, Descriptor, Index, Layout, Manifest};
use crate::{Digest, Error, Image, ImageSpec, LayerInfo, Limits, Store};

/// Maximum size of a document of a layout, in bytes.
const LARGEST: u64 = 16 << 20;
/// Maximum number of layers of an image; an overlay mount supports only a few hundred.
pub(crate) const MOST_LAYERS: usize = 128;

/// A received image.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceivedImage {
    /// The image in the store, untagged: the same content, with documents written by this store. Its digest equals that
    /// of the layout's image if that was written by such a store, too.
    pub image: Image,
    /// Tells for each layer whether it was already in the store.
    pub known: Vec<bool>,
    /// Annotations of the layout's index entry.
    pub annotations: BTreeMap<String, String>,
}

/// Returns whether a tree is an image layout.
pub fn is_layout(tree: &Tree) -> bool {
    tree.has_file("oci-layout") && tree.has_file("index.json")
}

/// Reads a document of an image layout, of at most 16 MiB, and verifies its digest.
///
/// # Errors
/// [`Error::Unreceivable`] if it is missing or has another digest.
pub fn read_layout_document(layout: &Tree, digest: &Digest) -> Result<Vec<u8>, Error> {
    let path = blob_path(digest);
    let bytes = read(layout, &path)?;
    let found = Digest::compute(&bytes);
    if found != *digest {
        return Err(unreceivable_error(format!("its blob {digest} has the content of {found}")));
    }
    Ok(bytes)
}

impl Store {
    /// Imports the single image of an image layout, verifying the digest of each blob and the diff-id of each layer.
    /// Without [`Store::hold`] or a tag, the next [`Store::gc`] removes it.
    ///
    /// # Errors
    /// [`Error::Unreceivable`] for an invalid layout, [`Error::Archive`] if layers exceed `limits` or cannot be read.
    pub fn receive(&self, layout: &Tree, limits: &Limits) -> Result<ReceivedImage, Error> {
        let _hold = self.hold()?;
        let LayoutDocuments { entry, manifest, config } = run_as_reader(|| LayoutDocuments::read(layout))?;
        let mut left = *limits;
        let mut known = Vec::new();
        let mut layers = Vec::new();
        for (named, diff_id) in manifest.layers.iter().zip(&config.rootfs.diff_ids) {
            let there = self.layer(diff_id)?;
            let there = there.filter(|layer| layer.digest == named.digest);
            known.push(there.is_some());
            layers.push(match there {
                // The sender must possess the blob: the known layer may belong to an image that it has no access to.
                Some(layer) => check_blob(layout, &named.digest).map(|()| layer)?,
                None => self.receive_layer(layout, named, diff_id, &mut left)?,
            });
        }
        let spec = ImageSpec::from_documents(layers, config, manifest);
        Ok(ReceivedImage {
            image: Image { digest: self.put_image(&spec)?, spec },
            known,
            annotations: entry.annotations.clone(),
        })
    }

    fn receive_layer(
        &self,
        layout: &Tree,
        named: &Descriptor,
        diff_id: &Digest,
        left: &mut Limits,
    ) -> Result<LayerInfo, Error> {
        if named.media_type != oci::MEDIA_LAYER_GZIP {
            return Err(unreceivable_error(format!(
                "its layer {} has type {:?}; supported is {}",
                named.digest,
                named.media_type,
                oci::MEDIA_LAYER_GZIP
            )));
        }
        let file = open(layout, &blob_path(&named.digest))?;
        let label = PathBuf::from(format!("layer {}", named.digest));
        let is_named = |layer: &LayerInfo| {
            if layer.digest == named.digest && layer.diff_id == *diff_id {
                return Ok(());
            }
            Err(unreceivable_error(format!(
                "its layer {} has the content of {} ({}, not {diff_id}, unpacked)",
                named.digest, layer.digest, layer.diff_id
            )))
        };
        let (layer, entries) = self.import_layer_within(file, &label, left, is_named)?;
        left.bytes -= layer.unpacked;
        // Extended headers may follow the last entry that was checked against the limit.
        left.entries = left.entries.saturating_sub(entries);
        Ok(layer)
    }
}

/// The documents of a layout with a single image.
struct LayoutDocuments {
    /// Index entry of the image.
    entry: Descriptor,
    manifest: Manifest,
    config: Config,
}

impl LayoutDocuments {
    /// Reads and validates the documents; layers are not read.
    fn read(layout: &Tree) -> Result<Self, Error> {
        let version: Layout = parse_json("oci-layout", &read(layout, "oci-layout")?)?;
        if version.image_layout_version != oci::LAYOUT_VERSION {
            return Err(unreceivable_error(format!(
                "its layout has version {:?}; supported is {}",
                version.image_layout_version,
                oci::LAYOUT_VERSION
            )));
        }
        let mut index: Index = parse_json("index.json", &read(layout, "index.json")?)?;
        let images = index.manifests.len();
        let (1, Some(entry)) = (images, index.manifests.pop()) else {
            return Err(unreceivable_error(format!("it contains {images} images instead of one")));
        };
        if entry.media_type != oci::MEDIA_MANIFEST {
            return Err(unreceivable_error(format!(
                "its image has type {:?} instead of {}",
                entry.media_type,
                oci::MEDIA_MANIFEST
            )));
        }
        let manifest: Manifest = parse_json("its manifest", &read_layout_document(layout, &entry.digest)?)?;
        let config: Config = parse_json("its config", &read_layout_document(layout, &manifest.config.digest)?)?;
        let diff_ids = &config.rootfs.diff_ids;
        if manifest.layers.len() != diff_ids.len() || diff_ids.len() > MOST_LAYERS {
            return Err(unreceivable_error(format!(
                "it has {} layers and {} diff-ids; both must be equal, and at most {MOST_LAYERS}",
                manifest.layers.len(),
                diff_ids.len()
            )));
        }
        // An overlay accepts each layer once, and each is read and verified.
        let distinct: BTreeSet<&Digest> = diff_ids.iter().collect();
        if distinct.len() != diff_ids.len() {
            return Err(unreceivable_error("it lists the same layer twice".to_owned()));
        }
        let (architecture, _) = oci::platform();
        if config.architecture != architecture {
            return Err(unreceivable_error(format!(
                "it is for {}, but this machine is {architecture}",
                config.architecture
            )));
        }
        Ok(Self { entry, manifest, config })
    }
}

pub(crate) fn blob_path(digest: &Digest) -> String {
    format!("blobs/sha256/{}", digest.hex())
}

/// Rejects a layout in which a blob is missing or has other content.
fn check_blob(layout: &Tree, digest: &Digest) -> Result<(), Error> {
    let path = blob_path(digest);
    let mut content = HashingStream::new(open(layout, &path)?);
    io::copy(&mut content, &mut io::sink()).map_err(|error| Error::file("read", Path::new(&path), error))?;
    let (_, found, _) = content.finish();
    if found == *digest {
        Ok(())
    } else {
        Err(unreceivable_error(format!("its blob {digest} has the content of {found}")))
    }
}

fn open(layout: &Tree, path: &str) -> Result<File, Error> {
    let file = layout.open_file(path).map_err(tree_error)?;
    file.map(File::from).ok_or_else(|| missing_file(path))
}

pub(crate) fn read(layout: &Tree, path: &str) -> Result<Vec<u8>, Error> {
    let file = layout.read_file(path, LARGEST).map_err(tree_error)?;
    Ok(file.ok_or_else(|| missing_file(path))?.bytes)
}

pub(crate) fn parse_json<T: DeserializeOwned>(what: &str, bytes: &[u8]) -> Result<T, Error> {
    serde_json::from_slice(bytes).map_err(|error| unreceivable_error(format!("{what} cannot be read: {error}")))
}

fn missing_file(path: &str) -> Error {
    unreceivable_error(format!("{path} is missing"))
}

fn tree_error(error: foreign::Error) -> Error {
    unreceivable_error(error.to_string())
}

pub(crate) fn unreceivable_error(problem: String) -> Error {
    Error::Unreceivable { problem }
}

#[cfg(test)]
mod tests;
