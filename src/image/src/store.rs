//! The store: its directories, blobs and locks. Images and tags are in `images.rs`, layers in `layer.rs`.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use crate::files::{self, Lock, NewFile};
use crate::oci::{self, Index, Layout};
use crate::{Digest, Error};

/// The largest `index.json`, manifest or configuration that is read.
pub(crate) const MAX_DOCUMENT: u64 = 16 << 20;

/// An OCI image layout and the directory of its extracted layers. Share it in an `Arc`.
///
/// ```text
///   images/  oci-layout  index.json  blobs/sha256/<hex>          locked alone while index.json changes
///   layers/  <diff-id hex>/      an extracted layer              locked alone by gc, shared by everyone else
///            <diff-id hex>.json  which blob holds it
///            <diff-id hex>.volatile  its tree has not reached the disk yet (see extract.rs)
///   both     tmp-…               being written, locked by its writer; otherwise a leftover
/// ```
#[derive(Debug)]
pub struct Store {
    images: PathBuf,
    layers: PathBuf,
    /// One lock per layer being extracted in this process.
    pub(crate) extracting: Mutex<HashMap<Digest, Arc<Mutex<()>>>>,
}

/// While one lives, [`Store::gc`] removes nothing but leftovers: keep one from the first layer of a push until its
/// image has its tag.
#[derive(Debug)]
#[must_use = "dropping it lets the garbage collector run"]
pub struct Hold {
    _lock: Lock,
}

/// A blob, open for reading from its first byte.
#[derive(Debug)]
pub struct Blob {
    /// The content.
    pub file: File,
    /// Size in bytes.
    pub size: u64,
}

impl Store {
    /// Opens the layout at `images`, made if it is not there, with extracted layers below `layers`, and sweeps
    /// what a crash left half-made.
    ///
    /// Both directories must be on one file system with nothing else in them.
    pub fn open(images: &Path, layers: &Path) -> Result<Self, Error> {
        files::make_private_directory(images)?;
        files::make_private_directory(layers)?;
        // Extracted layers hold untrusted set-uid files: nobody else on the host may reach them.
        for private in [images, layers] {
            rustix::fs::chmod(private, rustix::fs::Mode::RWXU)
                .map_err(|error| Error::file("change the rights of", private, error))?;
        }
        let store = Self {
            images: images.to_owned(),
            layers: layers.to_owned(),
            extracting: Mutex::default(),
        };
        {
            let _lock = Lock::alone(images)?;
            store.lay_out()?;
        }
        files::sweep_half_made(images)?;
        files::sweep_half_made(layers)?;
        store.settle_volatile_trees()?;
        Ok(store)
    }

    /// Writes what a layout needs where it is missing, and checks what is there.
    fn lay_out(&self) -> Result<(), Error> {
        let marker = self.images.join("oci-layout");
        let wrong = |path: &Path, problem: String| Error::NotALayout {
            path: path.to_owned(),
            problem,
        };
        match files::read_whole(&marker, MAX_DOCUMENT)? {
            Some(bytes) => {
                let layout: Layout = serde_json::from_slice(&bytes)
                    .map_err(|error| wrong(&marker, error.to_string()))?;
                if !layout.image_layout_version.starts_with("1.") {
                    return Err(wrong(
                        &marker,
                        format!("its version is {:?}", layout.image_layout_version),
                    ));
                }
            }
            None => {
                // A crash may have come before the marker; anything else in here is somebody else's.
                let ours = |name: &str| {
                    name == "blobs" || name == "index.json" || name.starts_with(files::HALF_MADE)
                };
                let foreign = files::list(&self.images)?;
                let foreign = foreign
                    .iter()
                    .map(|entry| entry.file_name().to_string_lossy().into_owned());
                if let Some(name) = foreign.into_iter().find(|name| !ours(name)) {
                    return Err(wrong(
                        &self.images,
                        format!("it holds {name:?} and no oci-layout"),
                    ));
                }
                let layout = Layout {
                    image_layout_version: oci::LAYOUT_VERSION.to_owned(),
                };
                files::write_whole(&marker, &json(&layout))?;
            }
        }
        let blobs = self.blobs();
        files::make_private_directory(&blobs)?;
        if self.index()?.is_none() {
            self.write_index(&Index::default())?;
        }
        Ok(())
    }

    /// Where the layout is.
    pub fn images_dir(&self) -> &Path {
        &self.images
    }

    /// Where the extracted layers are.
    pub fn layers_dir(&self) -> &Path {
        &self.layers
    }

    /// Keeps [`Store::gc`], in this process and others, from removing what no tag keeps yet.
    pub fn hold(&self) -> Result<Hold, Error> {
        Ok(Hold {
            _lock: Lock::shared(&self.layers)?,
        })
    }

    /// A blob, as `/v2/NAME/blobs/DIGEST` serves it.
    pub fn blob(&self, digest: &Digest) -> Result<Option<Blob>, Error> {
        let path = self.blob_path(digest);
        let failed = |error| Error::file("open", &path, error);
        match File::open(&path) {
            Ok(file) => {
                let size = file.metadata().map_err(failed)?.len();
                Ok(Some(Blob { file, size }))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(failed(error)),
        }
    }

    pub(crate) fn blobs(&self) -> PathBuf {
        self.images.join("blobs/sha256")
    }

    pub(crate) fn blob_path(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(digest.hex())
    }

    /// A place to write a blob whose digest is not known yet.
    pub(crate) fn new_blob(&self) -> Result<NewFile, Error> {
        NewFile::create(&self.images)
    }

    /// Gives a written blob its name. One that is there already stays.
    pub(crate) fn publish_blob(&self, blob: NewFile, digest: &Digest) -> Result<(), Error> {
        let path = self.blob_path(digest);
        if path.exists() {
            Ok(())
        } else {
            blob.publish(&path)
        }
    }

    /// Writes a small blob.
    pub(crate) fn put_blob(&self, bytes: &[u8]) -> Result<Digest, Error> {
        let digest = Digest::of(bytes);
        let path = self.blob_path(&digest);
        if !path.exists() {
            let blob = self.new_blob()?;
            (&blob)
                .write_all(bytes)
                .map_err(|error| Error::file("write", &path, error).needing(bytes.len() as u64))?;
            blob.publish(&path)?;
        }
        Ok(digest)
    }

    /// A small blob's bytes, checked against its name.
    pub(crate) fn document(&self, digest: &Digest) -> Result<Option<Vec<u8>>, Error> {
        let path = self.blob_path(digest);
        let Some(bytes) = files::read_whole(&path, MAX_DOCUMENT)? else {
            return Ok(None);
        };
        let found = Digest::of(&bytes);
        if found != *digest {
            return Err(Error::Damaged {
                path,
                expected: *digest,
                found,
            });
        }
        Ok(Some(bytes))
    }

    /// `index.json`; none when it is not there.
    pub(crate) fn index(&self) -> Result<Option<Index>, Error> {
        let path = self.images.join("index.json");
        let Some(bytes) = files::read_whole(&path, MAX_DOCUMENT)? else {
            return Ok(None);
        };
        serde_json::from_slice(&bytes)
            .map(Some)
            .map_err(|source| Error::Json { path, source })
    }

    /// Changes `index.json`, alone among threads and processes. `change` says whether it changed anything.
    pub(crate) fn change_index<T>(
        &self,
        change: impl FnOnce(&mut Index) -> Result<(bool, T), Error>,
    ) -> Result<T, Error> {
        let _lock = Lock::alone(&self.images)?;
        let mut index = self.index()?.unwrap_or_default();
        let (changed, result) = change(&mut index)?;
        if changed {
            self.write_index(&index)?;
        }
        Ok(result)
    }

    fn write_index(&self, index: &Index) -> Result<(), Error> {
        files::write_whole(&self.images.join("index.json"), &json(index))
    }
}

/// A document of the store.
pub(crate) fn json(document: &impl serde::Serialize) -> Vec<u8> {
    serde_json::to_vec(document).expect("the store's documents have string keys only")
}

#[cfg(test)]
mod tests;
