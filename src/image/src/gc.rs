//! Garbage collection and verification of the store.

use std::collections::BTreeSet;
use std::fs::File;
use std::io;
use std::path::PathBuf;

use serde_json::Value;

use crate::digest::HashingStream;
use crate::files::{self, Lock};
use crate::layer::gunzip_and_hash;
use crate::store::MAX_DOCUMENT;
use crate::{Digest, Error, Store};

/// Result of [`Store::gc`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GcReport {
    /// Number of manifests, configurations and layers removed.
    pub blobs: u64,
    /// Number of extracted layers removed.
    pub trees: u64,
    /// Number of temporary files and trees removed.
    pub leftovers: u64,
    /// Size of the removed blobs in bytes.
    pub bytes: u64,
    /// True if the store is held by someone, so that only leftovers were removed.
    pub deferred: bool,
}

/// A defect found in the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// File.
    pub path: PathBuf,
    /// Description of the defect.
    pub problem: String,
}

impl Store {
    /// Removes every image without a tag, and every blob and extracted layer that no remaining image references. `keep`
    /// names further images or layers to keep (by digest or diff-id).
    ///
    /// While anyone holds the store (see [`Store::hold`]; every call that writes does), only leftovers of crashes are
    /// removed and `deferred` is set: call again later.
    pub fn gc(&self, keep: &BTreeSet<Digest>) -> Result<GcReport, Error> {
        let leftovers = files::sweep_temporary(self.images_dir())? + files::sweep_temporary(self.layers_dir())?;
        let mut swept = GcReport { leftovers, ..GcReport::default() };
        let Some(_alone) = Lock::try_lock_exclusive(self.layers_dir())? else {
            swept.deferred = true;
            return Ok(swept);
        };
        let listed = self.change_index(|index| {
            let before = index.manifests.len();
            index.manifests.retain(|entry| entry.tag().is_some() || keep.contains(&entry.digest));
            let listed: BTreeSet<_> = index.manifests.iter().map(|entry| entry.digest).collect();
            Ok((index.manifests.len() != before, listed))
        })?;
        let mut needed = BTreeSet::new();
        for digest in listed.iter().chain(keep) {
            self.mark(digest, &mut needed)?;
        }
        self.sweep_blobs(&needed, &mut swept)?;
        self.sweep_trees(&needed, &mut swept)?;
        Ok(swept)
    }

    /// Marks a blob as needed, the blob of a diff-id, and, if the blob is an OCI document, everything that it
    /// references.
    fn mark(&self, digest: &Digest, needed: &mut BTreeSet<Digest>) -> Result<(), Error> {
        if !needed.insert(*digest) {
            return Ok(());
        }
        if let Some(layer) = self.layer_record(digest)? {
            needed.insert(layer.digest);
        }
        let size = std::fs::metadata(self.blob_path(digest)).map_or(0, |metadata| metadata.len());
        if size == 0 || size > MAX_DOCUMENT {
            return Ok(());
        }
        let Some(bytes) = self.read_document(digest)? else {
            return Ok(());
        };
        let Ok(document) = serde_json::from_slice::<Value>(&bytes) else {
            return Ok(());
        };
        for named in named_digests(&document) {
            self.mark(&named, needed)?;
        }
        Ok(())
    }

    fn sweep_blobs(&self, needed: &BTreeSet<Digest>, swept: &mut GcReport) -> Result<(), Error> {
        for entry in files::list(&self.blobs_dir())? {
            // Files with other names are not ours.
            let Some(digest) = entry.file_name().to_str().and_then(Digest::from_hex) else {
                continue;
            };
            if needed.contains(&digest) {
                continue;
            }
            let path = entry.path();
            swept.bytes += entry.metadata().map_or(0, |metadata| metadata.len());
            std::fs::remove_file(&path).map_err(|error| Error::file("remove", &path, error))?;
            swept.blobs += 1;
        }
        Ok(())
    }

    fn sweep_trees(&self, needed: &BTreeSet<Digest>, swept: &mut GcReport) -> Result<(), Error> {
        for entry in files::list(self.layers_dir())? {
            let name = entry.file_name();
            let Some(name) = name.to_str() else { continue };
            let (hex, extension) = name.split_once('.').unwrap_or((name, ""));
            let Some(diff_id) = Digest::from_hex(hex) else {
                continue;
            };
            if needed.contains(&diff_id) {
                continue;
            }
            match extension {
                "" => {
                    self.discard_tree(&diff_id)?;
                    swept.trees += 1;
                }
                "json" => {
                    let path = entry.path();
                    std::fs::remove_file(&path).map_err(|error| Error::file("remove", &path, error))?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Verifies all digests and references. Changes nothing; an empty result means that no defects were found.
    pub fn verify(&self) -> Result<Vec<Damage>, Error> {
        let _hold = self.hold()?;
        let mut damages = Vec::new();
        for entry in files::list(&self.blobs_dir())? {
            if let Some(problem) = check_blob(&entry) {
                damages.push(Damage { path: entry.path(), problem });
            }
        }
        for image in self.images()? {
            self.check_image(&image, &mut damages);
        }
        damages.sort_by(|a, b| a.path.cmp(&b.path));
        damages.dedup();
        Ok(damages)
    }

    fn check_image(&self, image: &Digest, damages: &mut Vec<Damage>) {
        let mut damage = |digest: &Digest, problem: String| {
            damages.push(Damage { path: self.blob_path(digest), problem });
        };
        let missing = |what: &str| format!("{what} of image {image} is missing");
        let manifest = match self.read_manifest(image) {
            Ok(Some(manifest)) => manifest,
            Ok(None) => return damage(image, missing("the manifest")),
            // The wrong content was already reported above.
            Err(Error::Damaged { .. }) => return,
            Err(error) => return damage(image, error.to_string()),
        };
        let config = match self.read_config(&manifest.config.digest) {
            Ok(Some(config)) => config,
            Ok(None) => return damage(&manifest.config.digest, missing("the configuration")),
            Err(Error::Damaged { .. }) => return,
            Err(error) => return damage(&manifest.config.digest, error.to_string()),
        };
        if config.rootfs.diff_ids.len() != manifest.layers.len() {
            let counts = (config.rootfs.diff_ids.len(), manifest.layers.len());
            damage(image, format!("it has {} layers, but its configuration names {}", counts.1, counts.0));
        }
        for (layer, diff_id) in manifest.layers.iter().zip(&config.rootfs.diff_ids) {
            let Ok(blob) = File::open(self.blob_path(&layer.digest)) else {
                damage(&layer.digest, missing("a layer"));
                continue;
            };
            match gunzip_and_hash(blob) {
                Ok((found, _)) if found == *diff_id => {}
                Ok((found, _)) => damage(&layer.digest, format!("its content is {found}, not {diff_id}")),
                Err(error) => damage(&layer.digest, format!("it does not unpack: {error}")),
            }
        }
    }
}

/// Returns the digests of the descriptors in a manifest or index.
fn named_digests(document: &Value) -> Vec<Digest> {
    let list = |key: &str| document.get(key).and_then(Value::as_array).into_iter().flatten();
    let single = |key: &str| document.get(key).into_iter();
    let descriptors = list("manifests").chain(list("layers")).chain(single("config")).chain(single("subject"));
    let mut digests: Vec<Digest> =
        descriptors.filter_map(|descriptor| descriptor.get("digest")?.as_str()?.parse().ok()).collect();
    // The extracted layers are referenced by a configuration.
    let diff_ids = document.pointer("/rootfs/diff_ids").and_then(Value::as_array).into_iter().flatten();
    digests.extend(diff_ids.filter_map(|diff_id| diff_id.as_str()?.parse::<Digest>().ok()));
    digests
}

fn check_blob(entry: &std::fs::DirEntry) -> Option<String> {
    let name = entry.file_name();
    let Some(expected) = name.to_str().and_then(Digest::from_hex) else {
        return Some("its name is not a digest".to_owned());
    };
    let hashed = File::open(entry.path()).and_then(|file| {
        let mut file = HashingStream::new(file);
        io::copy(&mut file, &mut io::sink())?;
        Ok(file.finish().1)
    });
    match hashed {
        Ok(found) if found == expected => None,
        Ok(found) => Some(format!("its content is {found}")),
        Err(error) => Some(format!("it cannot be read: {error}")),
    }
}
