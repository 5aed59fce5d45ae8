//! The store.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};

use crate::{Digest, Error, LayerInfo, TreeOptions};

/// An OCI image layout and the directory of its extracted layers. Share it in an `Arc`.
#[derive(Debug)]
pub struct Store {
    images: PathBuf,
    layers: PathBuf,
}

/// While one lives, [`Store::gc`] removes nothing but leftovers: keep one from the first layer of a push until its
/// image has its tag.
#[derive(Debug)]
#[must_use = "dropping it lets the garbage collector run"]
pub struct Hold {
    _lock: File,
}

/// What to make an image of. The same values always give the same digest.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ImageSpec {
    /// Lowest first.
    pub layers: Vec<LayerInfo>,
    /// Environment of its processes.
    pub env: BTreeMap<String, String>,
    /// What a container runs by default.
    pub cmd: Vec<String>,
    /// Where it runs; empty for `/`.
    pub working_dir: String,
    /// Labels of the configuration.
    pub labels: BTreeMap<String, String>,
    /// Annotations of the manifest.
    pub annotations: BTreeMap<String, String>,
}

/// An image of the store, read back.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Of the manifest.
    pub digest: Digest,
    /// What it was made of.
    pub spec: ImageSpec,
}

/// A manifest as it is served.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Manifest {
    /// Its name.
    pub digest: Digest,
    /// For `Content-Type`.
    pub media_type: String,
    /// The document.
    pub bytes: Vec<u8>,
}

/// A blob, open for reading from its first byte.
#[derive(Debug)]
pub struct Blob {
    /// The content.
    pub file: File,
    /// Its bytes.
    pub size: u64,
}

/// What [`Store::gc`] removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Swept {
    /// Manifests, configurations and layers.
    pub blobs: u64,
    /// Extracted layers.
    pub trees: u64,
    /// Half-made files and trees.
    pub leftovers: u64,
    /// Bytes of the blobs.
    pub bytes: u64,
    /// Someone holds the store: only leftovers were looked for.
    pub deferred: bool,
}

/// Something wrong in the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub problem: String,
}

macro_rules! unfinished {
    ($self:ident) => {
        Err(Error::NotALayout {
            path: $self.images.clone(),
            problem: "unfinished".into(),
        })
    };
}

impl Store {
    /// Opens the layout at `images`, made if it is not there, with extracted layers below `layers`, and sweeps
    /// what a crash left half-made.
    pub fn open(images: &Path, layers: &Path) -> Result<Self, Error> {
        Ok(Self {
            images: images.to_owned(),
            layers: layers.to_owned(),
        })
    }

    /// Where the layout is.
    pub fn images_dir(&self) -> &Path {
        &self.images
    }

    /// Where the extracted layers are.
    pub fn layers_dir(&self) -> &Path {
        &self.layers
    }

    /// Keeps [`Store::gc`] from removing what no tag keeps yet.
    pub fn hold(&self) -> Result<Hold, Error> {
        unfinished!(self)
    }

    /// Packs a file tree into a layer. The same tree with the same options gives the same layer.
    pub fn layer_from_tree(
        &self,
        _tree: &Path,
        _options: &TreeOptions,
    ) -> Result<LayerInfo, Error> {
        unfinished!(self)
    }

    /// Copies a `tar.gz` into the store as a layer.
    pub fn import_layer(&self, _archive: &Path) -> Result<LayerInfo, Error> {
        unfinished!(self)
    }

    /// Copies a layer out of the store as a `tar.gz`; appears whole or not at all.
    pub fn export_layer(&self, _diff_id: &Digest, _to: &Path) -> Result<(), Error> {
        unfinished!(self)
    }

    /// The layer with this content, if it is in the store.
    pub fn layer(&self, _diff_id: &Digest) -> Result<Option<LayerInfo>, Error> {
        unfinished!(self)
    }

    /// The extracted tree of a layer, which must not be changed: extracted now if it was not yet.
    pub fn extracted(&self, _diff_id: &Digest) -> Result<PathBuf, Error> {
        unfinished!(self)
    }

    /// Writes an image; its manifest's digest is its name. Its layers must be in the store.
    pub fn put_image(&self, _spec: &ImageSpec) -> Result<Digest, Error> {
        unfinished!(self)
    }

    /// Reads an image.
    pub fn image(&self, _image: &Digest) -> Result<Image, Error> {
        unfinished!(self)
    }

    /// All images, tagged or not.
    pub fn images(&self) -> Result<BTreeSet<Digest>, Error> {
        unfinished!(self)
    }

    /// Gives an image a name such as `opencv_apps:3`, taking it from another image if that had it.
    pub fn tag(&self, _name: &str, _image: &Digest) -> Result<(), Error> {
        unfinished!(self)
    }

    /// Takes a name away; false if there was none such.
    pub fn untag(&self, _name: &str) -> Result<bool, Error> {
        unfinished!(self)
    }

    /// All names.
    pub fn tags(&self) -> Result<BTreeMap<String, Digest>, Error> {
        unfinished!(self)
    }

    /// The image with this tag or digest.
    pub fn resolve(&self, _reference: &str) -> Result<Option<Digest>, Error> {
        unfinished!(self)
    }

    /// The manifest with this tag or digest, as `/v2/NAME/manifests/REFERENCE` serves it.
    pub fn manifest(&self, _reference: &str) -> Result<Option<Manifest>, Error> {
        unfinished!(self)
    }

    /// A blob, as `/v2/NAME/blobs/DIGEST` serves it.
    pub fn blob(&self, _digest: &Digest) -> Result<Option<Blob>, Error> {
        unfinished!(self)
    }

    /// Removes every image without a tag, and every blob and extracted layer that no remaining image needs.
    /// `keep` names what stays besides: images or layers (by digest or diff-id).
    pub fn gc(&self, _keep: &BTreeSet<Digest>) -> Result<Swept, Error> {
        unfinished!(self)
    }

    /// Hashes everything again. Changes nothing.
    pub fn verify(&self) -> Result<Vec<Damage>, Error> {
        unfinished!(self)
    }
}
