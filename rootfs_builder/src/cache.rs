//! Layers by what they were made from: a file per key that names the layer, and the layer itself as `tar.gz`, so
//! that another daemon's store imports it instead of making it again.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{LayerInfo, Store};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::error::{Error, IoAt};
use crate::unused;

/// The cache and the store that it fills.
#[derive(Clone)]
pub(crate) struct Layers {
    directory: PathBuf,
    notes: PathBuf,
    store: Arc<Store>,
}

/// What is known of a layer besides its bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Entry {
    /// The layer; none where its inputs make no difference to what is below.
    pub(crate) layer: Option<LayerInfo>,
    /// For people: what went in.
    pub(crate) made_from: Vec<String>,
}

impl Layers {
    pub(crate) fn new(cache: &Path, store: Arc<Store>) -> Result<Self, Error> {
        let (directory, notes) = (cache.join("layers"), cache.join("notes"));
        for path in [&directory, &notes] {
            fs::create_dir_all(path).at("making", path)?;
        }
        Ok(Self {
            directory,
            notes,
            store,
        })
    }

    pub(crate) fn store(&self) -> &Arc<Store> {
        &self.store
    }

    /// The directory of everything cached.
    pub(crate) fn cache(&self) -> &Path {
        self.directory.parent().unwrap_or(&self.directory)
    }

    /// Whether [`Layers::get`] would find a layer, which then need not be in the store yet. Blocking.
    pub(crate) fn has(&self, key: &str) -> bool {
        let (about, archive) = self.paths(key);
        let entry = fs::read(&about)
            .ok()
            .and_then(|text| serde_json::from_slice::<Entry>(&text).ok());
        match entry.map(|entry| entry.layer) {
            None => false,
            Some(None) => true,
            Some(Some(layer)) => {
                archive.is_file() || matches!(self.store.layer(&layer.diff_id), Ok(Some(_)))
            }
        }
    }

    fn paths(&self, key: &str) -> (PathBuf, PathBuf) {
        (
            self.directory.join(format!("{key}.json")),
            self.directory.join(format!("{key}.tar.gz")),
        )
    }

    /// The layer of this key, in the store now. Damaged or half-removed entries count as absent. Blocking.
    pub(crate) fn get(&self, key: &str) -> Result<Option<Entry>, Error> {
        let (about, archive) = self.paths(key);
        let Ok(text) = fs::read(&about) else {
            return Ok(None);
        };
        let Ok(entry) = serde_json::from_slice::<Entry>(&text) else {
            return Ok(None);
        };
        let Some(layer) = entry.layer else {
            return Ok(Some(entry));
        };
        unused::used(&about);
        unused::used(&archive);
        if self.store.layer(&layer.diff_id)?.is_some() {
            return Ok(Some(entry));
        }
        if !archive.is_file() {
            return Ok(None);
        }
        match self.store.import_layer(&archive) {
            Ok(found) if found.diff_id == layer.diff_id => Ok(Some(Entry {
                layer: Some(found),
                ..entry
            })),
            Ok(_) | Err(image::Error::Archive { .. }) => {
                tracing::warn!(path = %archive.display(), "a cached layer is damaged and will be made again");
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// A small result that took long to find.
    pub(crate) fn note<T: DeserializeOwned>(&self, key: &str) -> Option<T> {
        let path = self.notes.join(key);
        let value = serde_json::from_slice(&fs::read(&path).ok()?).ok()?;
        unused::used(&path);
        Some(value)
    }

    /// Keeps one.
    pub(crate) fn keep_note<T: Serialize>(&self, key: &str, value: &T) -> Result<(), Error> {
        write_whole(
            &self.notes.join(key),
            &serde_json::to_vec(value).unwrap_or_default(),
        )
    }

    /// Keeps a layer that is in the store. Blocking.
    pub(crate) fn put(&self, key: &str, entry: &Entry) -> Result<(), Error> {
        let (about, archive) = self.paths(key);
        if let Some(layer) = &entry.layer {
            self.store.export_layer(&layer.diff_id, &archive)?;
        }
        write_whole(
            &about,
            &serde_json::to_vec_pretty(entry).unwrap_or_default(),
        )
    }
}

/// Writes a file that appears whole or not at all.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    Ok(image::write_whole(path, bytes)?)
}
