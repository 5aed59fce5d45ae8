//! The store: its directories, blobs and locks. For images and tags see `images.rs`, for layers `layer.rs`.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use crate::files::{self, Lock, NewFile};
use crate::oci::{self, Index, Layout};
use crate::{Digest, Error};

/// Maximum size of an `index.json`, manifest or configuration.
pub(crate) const MAX_DOCUMENT: u64 = 16 << 20;

/// An OCI image layout and the directory of its extracted layers. Share it in an `Arc`.
///
/// ```text
///   images/  oci-layout  index.json  blobs/sha256/<hex>          exclusive lock while index.json changes
///   layers/  <diff-id hex>/      an extracted layer              exclusive lock by gc, shared lock by all others
///            <diff-id hex>.json  digest of the blob that it comes from
///            <diff-id hex>.volatile  its tree is not yet flushed to disk (see extract.rs)
///   both     tmp-…               being written, locked by its writer; otherwise a leftover
/// ```
#[derive(Debug)]
pub struct Store {
    images: PathBuf,
    layers: PathBuf,
    /// Locks of the layers being extracted in this process.
    pub(crate) extracting: Mutex<HashMap<Digest, Arc<Mutex<()>>>>,
}

/// Guard that restricts [`Store::gc`] to leftovers: keep one from the first layer of a push until its image is tagged.
#[derive(Debug)]
#[must_use = "dropping it lets the garbage collector run"]
pub struct GcHold {
    _lock: Lock,
}

/// A blob, open for reading from its first byte.
#[derive(Debug)]
pub struct Blob {
    /// Open file.
    pub file: File,
    /// Size in bytes.
    pub size: u64,
}

impl Store {
    /// Opens the layout at `images`, creating it if needed, with extracted layers below `layers`, and removes leftovers
    /// of crashes.
    ///
    /// Both directories must be on one file system with nothing else in them.
    pub fn open(images: &Path, layers: &Path) -> Result<Self, Error> {
        files::make_private_directory(images)?;
        files::make_private_directory(layers)?;
        // Extracted layers contain untrusted set-uid files: nobody else on the host may access them.
        for private in [images, layers] {
            rustix::fs::chmod(private, rustix::fs::Mode::RWXU)
                .map_err(|error| Error::file("change the rights of", private, error))?;
        }
        let store = Self { images: images.to_owned(), layers: layers.to_owned(), extracting: Mutex::default() };
        {
            let _lock = Lock::lock_exclusive(images)?;
            store.init_layout()?;
        }
        files::sweep_temporary(images)?;
        files::sweep_temporary(layers)?;
        store.remove_unflushed_trees()?;
        Ok(store)
    }

    /// Creates the missing parts of a layout, and checks the existing ones.
    fn init_layout(&self) -> Result<(), Error> {
        let marker = self.images.join("oci-layout");
        let wrong = |path: &Path, problem: String| Error::NotALayout { path: path.to_owned(), problem };
        match files::read_limited(&marker, MAX_DOCUMENT)? {
            Some(bytes) => {
                let layout: Layout =
                    serde_json::from_slice(&bytes).map_err(|error| wrong(&marker, error.to_string()))?;
                if !layout.image_layout_version.starts_with("1.") {
                    return Err(wrong(&marker, format!("its version is {:?}", layout.image_layout_version)));
                }
            }
            None => {
                // A crash may have occurred before the marker was written; other files are not ours.
                let ours = |name: &str| name == "blobs" || name == "index.json" || name.starts_with(files::HALF_MADE);
                let foreign = files::list(&self.images)?;
                let foreign = foreign.iter().map(|entry| entry.file_name().to_string_lossy().into_owned());
                if let Some(name) = foreign.into_iter().find(|name| !ours(name)) {
                    return Err(wrong(&self.images, format!("it holds {name:?} and no oci-layout")));
                }
                let layout = Layout { image_layout_version: oci::LAYOUT_VERSION.to_owned() };
                files::write_atomically(&marker, &to_json(&layout))?;
            }
        }
        let blobs = self.blobs_dir();
        files::make_private_directory(&blobs)?;
        if self.read_index()?.is_none() {
            self.write_index(&Index::default())?;
        }
        Ok(())
    }

    /// Returns the directory of the layout.
    pub fn images_dir(&self) -> &Path {
        &self.images
    }

    /// Returns the directory of the extracted layers.
    pub fn layers_dir(&self) -> &Path {
        &self.layers
    }

    /// Prevents [`Store::gc`], in this process and others, from removing untagged images and layers.
    pub fn hold(&self) -> Result<GcHold, Error> {
        Ok(GcHold { _lock: Lock::lock_shared(&self.layers)? })
    }

    /// Opens a blob, for `/v2/NAME/blobs/DIGEST`.
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

    pub(crate) fn blobs_dir(&self) -> PathBuf {
        self.images.join("blobs/sha256")
    }

    pub(crate) fn blob_path(&self, digest: &Digest) -> PathBuf {
        self.blobs_dir().join(digest.hex())
    }

    /// Creates a file for a blob whose digest is not known yet.
    pub(crate) fn new_blob(&self) -> Result<NewFile, Error> {
        NewFile::create(&self.images)
    }

    /// Renames a written blob to its digest; an existing one is kept.
    pub(crate) fn publish_blob(&self, blob: NewFile, digest: &Digest) -> Result<(), Error> {
        let path = self.blob_path(digest);
        if path.exists() { Ok(()) } else { blob.publish(&path) }
    }

    /// Writes a small blob.
    pub(crate) fn put_blob(&self, bytes: &[u8]) -> Result<Digest, Error> {
        let digest = Digest::compute(bytes);
        let path = self.blob_path(&digest);
        if !path.exists() {
            let blob = self.new_blob()?;
            (&blob)
                .write_all(bytes)
                .map_err(|error| Error::file("write", &path, error).with_needed_bytes(bytes.len() as u64))?;
            blob.publish(&path)?;
        }
        Ok(digest)
    }

    /// Reads a small blob and verifies its digest.
    pub(crate) fn read_document(&self, digest: &Digest) -> Result<Option<Vec<u8>>, Error> {
        let path = self.blob_path(digest);
        let Some(bytes) = files::read_limited(&path, MAX_DOCUMENT)? else {
            return Ok(None);
        };
        let found = Digest::compute(&bytes);
        if found != *digest {
            return Err(Error::Damaged { path, expected: *digest, found });
        }
        Ok(Some(bytes))
    }

    /// Reads `index.json`; `None` if it does not exist.
    pub(crate) fn read_index(&self) -> Result<Option<Index>, Error> {
        let path = self.images.join("index.json");
        let Some(bytes) = files::read_limited(&path, MAX_DOCUMENT)? else {
            return Ok(None);
        };
        serde_json::from_slice(&bytes).map(Some).map_err(|source| Error::Json { path, source })
    }

    /// Modifies `index.json` under an exclusive lock. `change` returns whether it changed anything.
    pub(crate) fn change_index<T>(
        &self,
        change: impl FnOnce(&mut Index) -> Result<(bool, T), Error>,
    ) -> Result<T, Error> {
        let _lock = Lock::lock_exclusive(&self.images)?;
        let mut index = self.read_index()?.unwrap_or_default();
        let (changed, result) = change(&mut index)?;
        if changed {
            self.write_index(&index)?;
        }
        Ok(result)
    }

    fn write_index(&self, index: &Index) -> Result<(), Error> {
        files::write_atomically(&self.images.join("index.json"), &to_json(index))
    }
}

/// Serializes a document of the store.
pub(crate) fn to_json(document: &impl serde::Serialize) -> Vec<u8> {
    serde_json::to_vec(document).expect("the store's documents have string keys only")
}

#[cfg(test)]
mod tests;
