//! Images that come from elsewhere: an image layout (OCI image specification 1.1) in a tree that somebody has sent.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use foreign::Tree;
use serde::de::DeserializeOwned;

use crate::digest::Hashing;
use crate::layer::by_reader;
use crate::oci::{self, Config, Descriptor, Index, Layout, Manifest};
use crate::{Digest, Error, Image, ImageSpec, LayerInfo, Limits, Store};

/// The largest document of a layout, in bytes.
const LARGEST: u64 = 16 << 20;
/// Layers of an image at most: an overlay mount takes no more than some hundreds.
const MOST_LAYERS: usize = 128;

/// An image that was received.
#[derive(Debug, Clone, PartialEq)]
pub struct Received {
    /// As it is in the store now, untagged: equal content, made by this store. Its digest is that of the layout's image where
    /// this store wrote that, too.
    pub image: Image,
    /// Of each layer: whether it was there already.
    pub known: Vec<bool>,
    /// Annotations of the layout's entry.
    pub annotations: BTreeMap<String, String>,
}

/// Whether a tree is an image layout.
pub fn is_layout(tree: &Tree) -> bool {
    tree.has_file("oci-layout") && tree.has_file("index.json")
}

/// A document of an image layout, whose digest is as its name says; of at most 16 MiB.
///
/// # Errors
/// [`Error::Unreceivable`] where it is not there or is another.
pub fn document(layout: &Tree, digest: &Digest) -> Result<Vec<u8>, Error> {
    let path = blob_path(digest);
    let bytes = read(layout, &path)?;
    let found = Digest::of(&bytes);
    if found != *digest {
        return Err(unreceivable(format!(
            "its blob {digest} has the content of {found}"
        )));
    }
    Ok(bytes)
}

impl Store {
    /// Takes in the one image of an image layout: each blob is compared with its digest, each layer with its diff-id. Without
    /// [`Store::hold`] or a tag, the next [`Store::gc`] removes it.
    ///
    /// # Errors
    /// [`Error::Unreceivable`], [`Error::Archive`] where layers hold more than `limits` or cannot be read.
    pub fn receive(&self, layout: &Tree, limits: &Limits) -> Result<Received, Error> {
        let _hold = self.hold()?;
        let Documents {
            entry,
            manifest,
            config,
        } = by_reader(|| Documents::read(layout))?;
        let mut left = *limits;
        let mut known = Vec::new();
        let mut layers = Vec::new();
        for (named, diff_id) in manifest.layers.iter().zip(&config.rootfs.diff_ids) {
            let there = self.layer(diff_id)?;
            let there = there.filter(|layer| layer.digest == named.digest);
            known.push(there.is_some());
            layers.push(match there {
                // Whoever names it must have it: it may be of an image that is none of theirs.
                Some(layer) => has_blob(layout, &named.digest).map(|()| layer)?,
                None => self.receive_layer(layout, named, diff_id, &mut left)?,
            });
        }
        let spec = ImageSpec::read(layers, config, manifest);
        Ok(Received {
            image: Image {
                digest: self.put_image(&spec)?,
                spec,
            },
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
            return Err(unreceivable(format!(
                "its layer {} is of type {:?}, and {} is read here",
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
            Err(unreceivable(format!(
                "its layer {} has the content of {} ({}, not {diff_id}, unpacked)",
                named.digest, layer.digest, layer.diff_id
            )))
        };
        let (layer, entries) = self.import_layer_within(file, &label, left, is_named)?;
        left.bytes -= layer.unpacked;
        // Extended headers may follow the last entry that was compared with the limit.
        left.entries = left.entries.saturating_sub(entries);
        Ok(layer)
    }
}

/// What a layout says of its one image.
struct Documents {
    /// The image in the layout's index.
    entry: Descriptor,
    manifest: Manifest,
    config: Config,
}

impl Documents {
    /// Reads and checks them; no layer is looked at.
    fn read(layout: &Tree) -> Result<Self, Error> {
        let version: Layout = parsed("oci-layout", &read(layout, "oci-layout")?)?;
        if version.image_layout_version != oci::LAYOUT_VERSION {
            return Err(unreceivable(format!(
                "its layout is of version {:?}, and {} is read here",
                version.image_layout_version,
                oci::LAYOUT_VERSION
            )));
        }
        let mut index: Index = parsed("index.json", &read(layout, "index.json")?)?;
        let images = index.manifests.len();
        let (1, Some(entry)) = (images, index.manifests.pop()) else {
            return Err(unreceivable(format!(
                "it holds {images} images, and one is expected"
            )));
        };
        if entry.media_type != oci::MEDIA_MANIFEST {
            return Err(unreceivable(format!(
                "its image is of type {:?}, and {} is expected",
                entry.media_type,
                oci::MEDIA_MANIFEST
            )));
        }
        let manifest: Manifest = parsed("its manifest", &document(layout, &entry.digest)?)?;
        let config: Config = parsed("its config", &document(layout, &manifest.config.digest)?)?;
        let diff_ids = &config.rootfs.diff_ids;
        if manifest.layers.len() != diff_ids.len() || diff_ids.len() > MOST_LAYERS {
            return Err(unreceivable(format!(
                "it has {} layers and {} diff-ids; as many are expected, and at most {MOST_LAYERS}",
                manifest.layers.len(),
                diff_ids.len()
            )));
        }
        // An overlay takes each once, and each is read and compared.
        let distinct: BTreeSet<&Digest> = diff_ids.iter().collect();
        if distinct.len() != diff_ids.len() {
            return Err(unreceivable("it lists the same layer twice".to_owned()));
        }
        let (architecture, _) = oci::platform();
        if config.architecture != architecture {
            return Err(unreceivable(format!(
                "it is for {}, and this machine is {architecture}",
                config.architecture
            )));
        }
        Ok(Self {
            entry,
            manifest,
            config,
        })
    }
}

fn blob_path(digest: &Digest) -> String {
    format!("blobs/sha256/{}", digest.hex())
}

/// Refuses a layout that lacks a blob, or has another in its place.
fn has_blob(layout: &Tree, digest: &Digest) -> Result<(), Error> {
    let path = blob_path(digest);
    let mut content = Hashing::new(open(layout, &path)?);
    io::copy(&mut content, &mut io::sink())
        .map_err(|error| Error::file("read", Path::new(&path), error))?;
    let (_, found, _) = content.finish();
    match found == *digest {
        true => Ok(()),
        false => Err(unreceivable(format!(
            "its blob {digest} has the content of {found}"
        ))),
    }
}

fn open(layout: &Tree, path: &str) -> Result<File, Error> {
    let file = layout.open_file(path).map_err(unfit)?;
    file.map(File::from).ok_or_else(|| missing(path))
}

fn read(layout: &Tree, path: &str) -> Result<Vec<u8>, Error> {
    let file = layout.file(path, LARGEST).map_err(unfit)?;
    Ok(file.ok_or_else(|| missing(path))?.bytes)
}

fn parsed<T: DeserializeOwned>(what: &str, bytes: &[u8]) -> Result<T, Error> {
    serde_json::from_slice(bytes)
        .map_err(|error| unreceivable(format!("{what} cannot be read: {error}")))
}

fn missing(path: &str) -> Error {
    unreceivable(format!("{path} is missing"))
}

fn unfit(error: foreign::Error) -> Error {
    unreceivable(error.to_string())
}

fn unreceivable(problem: String) -> Error {
    Error::Unreceivable { problem }
}

#[cfg(test)]
mod tests;
