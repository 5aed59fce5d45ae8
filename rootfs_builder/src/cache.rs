//! Cache of layers by their inputs: a file per key that names the layer, and the layer itself as `tar.gz`, which other
//! daemons import into their store instead of building it again.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{LayerInfo, Store};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::cache_cleanup;
use crate::error::{Error, IoContext};
use crate::packings::Packings;

/// Returns the key of the note with the layers to keep for a base.
pub(crate) fn keep_note_key(base: &str) -> String {
    format!("keep-{base}")
}

/// The layer cache and its image store.
#[derive(Clone)]
pub(crate) struct LayerCache {
    directory: PathBuf,
    notes: PathBuf,
    store: Arc<Store>,
    packings: Packings,
}

/// A cached layer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct LayerEntry {
    /// The layer; `None` if its inputs do not change what is below.
    pub(crate) layer: Option<LayerInfo>,
    /// Human-readable list of the inputs.
    pub(crate) made_from: Vec<String>,
}

impl LayerCache {
    pub(crate) fn new(cache: &Path, store: Arc<Store>) -> Result<Self, Error> {
        let (directory, notes) = (cache.join("layers"), cache.join("notes"));
        for path in [&directory, &notes] {
            fs::create_dir_all(path).io_context("making", path)?;
        }
        Ok(Self { directory, notes, store, packings: Packings::default() })
    }

    /// Returns what packs layers, and can be given up.
    pub(crate) fn packings(&self) -> &Packings {
        &self.packings
    }

    pub(crate) fn store(&self) -> &Arc<Store> {
        &self.store
    }

    /// Returns the directory of the whole cache.
    pub(crate) fn cache(&self) -> &Path {
        self.directory.parent().unwrap_or(&self.directory)
    }

    /// Returns whether [`LayerCache::get`] would find a layer, which need not be in the store yet. Blocking.
    pub(crate) fn contains(&self, key: &str) -> bool {
        let (about, archive) = self.paths(key);
        let entry = fs::read(&about).ok().and_then(|text| serde_json::from_slice::<LayerEntry>(&text).ok());
        match entry.map(|entry| entry.layer) {
            None => false,
            Some(None) => true,
            Some(Some(layer)) => archive.is_file() || matches!(self.store.layer(&layer.diff_id), Ok(Some(_))),
        }
    }

    fn paths(&self, key: &str) -> (PathBuf, PathBuf) {
        (self.directory.join(format!("{key}.json")), self.directory.join(format!("{key}.tar.gz")))
    }

    /// Returns the layer of a key, importing it into the store if needed. Damaged or incomplete entries count as
    /// missing. Blocking.
    pub(crate) fn get(&self, key: &str) -> Result<Option<LayerEntry>, Error> {
        let (about, archive) = self.paths(key);
        let Ok(text) = fs::read(&about) else {
            return Ok(None);
        };
        let Ok(entry) = serde_json::from_slice::<LayerEntry>(&text) else {
            return Ok(None);
        };
        let Some(layer) = entry.layer else {
            return Ok(Some(entry));
        };
        cache_cleanup::mark_used(&about);
        cache_cleanup::mark_used(&archive);
        if self.store.layer(&layer.diff_id)?.is_some() {
            return Ok(Some(entry));
        }
        if !archive.is_file() {
            return Ok(None);
        }
        match self.store.import_layer(&archive) {
            Ok(found) if found.diff_id == layer.diff_id => Ok(Some(LayerEntry { layer: Some(found), ..entry })),
            Ok(_) | Err(image::Error::Archive { .. }) => {
                tracing::warn!(path = %archive.display(), "a cached layer is damaged and will be rebuilt");
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Returns a cached note: a small result that is expensive to compute.
    pub(crate) fn read_note<T: DeserializeOwned>(&self, key: &str) -> Option<T> {
        let path = self.notes.join(key);
        let value = serde_json::from_slice(&fs::read(&path).ok()?).ok()?;
        cache_cleanup::mark_used(&path);
        Some(value)
    }

    /// Stores a note.
    pub(crate) fn write_note<T: Serialize>(&self, key: &str, value: &T) -> Result<(), Error> {
        write_atomically(&self.notes.join(key), &serde_json::to_vec(value).unwrap_or_default())
    }

    /// Removes a note, if it exists.
    pub(crate) fn remove_note(&self, key: &str) -> Result<(), Error> {
        let path = self.notes.join(key);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(Error::io("removing", path, error)),
            _ => Ok(()),
        }
    }

    /// Stores a layer that is in the image store. Blocking.
    pub(crate) fn insert(&self, key: &str, entry: &LayerEntry) -> Result<(), Error> {
        let (about, archive) = self.paths(key);
        if let Some(layer) = &entry.layer {
            self.store.export_layer(&layer.diff_id, &archive)?;
        }
        write_atomically(&about, &serde_json::to_vec_pretty(entry).unwrap_or_default())
    }
}

/// Writes a file atomically.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    Ok(image::write_atomically(path, bytes)?)
}
