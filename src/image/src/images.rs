//! Images and their tags.

use std::collections::{BTreeMap, BTreeSet};

use crate::oci::{self, Config, Descriptor, History, Process, REF_NAME, RootFs};
use crate::store::json;
use crate::{Digest, Error, LayerInfo, Store};

/// Every image's date: a true one would give equal images different digests. umoci fails without one.
const EPOCH: &str = "1970-01-01T00:00:00Z";

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

impl ImageSpec {
    /// What configuration and manifest say, of these layers.
    pub(crate) fn read(layers: Vec<LayerInfo>, config: Config, manifest: oci::Manifest) -> Self {
        let process = config.config;
        let env = process.env.iter().filter_map(|pair| pair.split_once('='));
        ImageSpec {
            layers,
            env: env
                .map(|(name, value)| (name.to_owned(), value.to_owned()))
                .collect(),
            cmd: process.cmd,
            working_dir: process.working_dir,
            labels: process.labels,
            annotations: manifest.annotations,
        }
    }
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
    /// Digest of the manifest.
    pub digest: Digest,
    /// For `Content-Type`.
    pub media_type: String,
    /// The document.
    pub bytes: Vec<u8>,
}

impl Store {
    /// Writes an image; its manifest's digest is its name. Its layers must be in the store.
    ///
    /// It has no tag yet: without [`Store::hold`] or a tag, the next [`Store::gc`] removes it.
    pub fn put_image(&self, spec: &ImageSpec) -> Result<Digest, Error> {
        let _hold = self.hold()?;
        for layer in &spec.layers {
            if !self.blob_path(&layer.digest).exists() {
                return Err(Error::UnknownLayer {
                    diff_id: layer.diff_id,
                    store: self.images_dir().to_owned(),
                });
            }
        }
        let config = json(&configuration(spec));
        let config = Descriptor::new(
            oci::MEDIA_CONFIG,
            self.put_blob(&config)?,
            config.len() as u64,
        );
        let manifest = json(&manifest(spec, config));
        let digest = self.put_blob(&manifest)?;
        let descriptor = Descriptor::new(oci::MEDIA_MANIFEST, digest, manifest.len() as u64);
        self.change_index(|index| {
            let there = index.manifests.iter().any(|entry| entry.digest == digest);
            if !there {
                index.manifests.push(descriptor);
            }
            Ok((!there, digest))
        })
    }

    /// Reads an image.
    pub fn image(&self, image: &Digest) -> Result<Image, Error> {
        let unknown = || Error::UnknownImage {
            digest: *image,
            store: self.images_dir().to_owned(),
        };
        let manifest = self.read_manifest(image)?.ok_or_else(unknown)?;
        let config = self
            .read_config(&manifest.config.digest)?
            .ok_or_else(unknown)?;
        let layers = manifest
            .layers
            .iter()
            .zip(&config.rootfs.diff_ids)
            .map(|(blob, &diff_id)| {
                let unpacked = self
                    .layer_record(&diff_id)?
                    .map_or(0, |record| record.unpacked);
                Ok(LayerInfo {
                    digest: blob.digest,
                    diff_id,
                    size: blob.size,
                    unpacked,
                })
            })
            .collect::<Result<_, Error>>()?;
        Ok(Image {
            digest: *image,
            spec: ImageSpec::read(layers, config, manifest),
        })
    }

    /// All images, tagged or not.
    pub fn images(&self) -> Result<BTreeSet<Digest>, Error> {
        Ok(self
            .index()?
            .unwrap_or_default()
            .manifests
            .iter()
            .map(|entry| entry.digest)
            .collect())
    }

    /// Gives an image a name such as `opencv_apps:3`, taking it from another image if that had it.
    pub fn tag(&self, name: &str, image: &Digest) -> Result<(), Error> {
        check_tag(name)?;
        self.change_index(|index| {
            let Some(known) = index.manifests.iter().find(|entry| entry.digest == *image) else {
                return Err(Error::UnknownImage {
                    digest: *image,
                    store: self.images_dir().to_owned(),
                });
            };
            let mut of_image = index.manifests.iter().filter(|it| it.digest == *image);
            if of_image.any(|entry| entry.tag() == Some(name)) {
                return Ok((false, ()));
            }
            let mut tagged = known.clone();
            tagged
                .annotations
                .insert(REF_NAME.to_owned(), name.to_owned());
            let loser = index
                .manifests
                .iter()
                .find(|entry| entry.tag() == Some(name))
                .map(|entry| entry.digest);
            // The entry that only said that the image is there has done its duty.
            index.manifests.retain(|entry| {
                entry.tag() != Some(name) && !(entry.digest == *image && entry.tag().is_none())
            });
            index.manifests.push(tagged);
            if let Some(loser) = loser {
                keep_listed(index, loser, self)?;
            }
            sort(index);
            Ok((true, ()))
        })
    }

    /// Takes a name away; false if there was none such. The image stays until [`Store::gc`].
    pub fn untag(&self, name: &str) -> Result<bool, Error> {
        self.change_index(|index| {
            let Some(at) = index
                .manifests
                .iter()
                .position(|entry| entry.tag() == Some(name))
            else {
                return Ok((false, false));
            };
            let loser = index.manifests.remove(at).digest;
            keep_listed(index, loser, self)?;
            sort(index);
            Ok((true, true))
        })
    }

    /// All names.
    pub fn tags(&self) -> Result<BTreeMap<String, Digest>, Error> {
        let index = self.index()?.unwrap_or_default();
        let tagged = index
            .manifests
            .iter()
            .filter_map(|entry| Some((entry.tag()?.to_owned(), entry.digest)));
        Ok(tagged.collect())
    }

    /// The image with this tag or digest; none if there is none, or only a blob of that digest.
    pub fn resolve(&self, reference: &str) -> Result<Option<Digest>, Error> {
        let index = self.index()?.unwrap_or_default();
        let digest = reference.parse::<Digest>().ok();
        let mut entries = index.manifests.iter();
        let found =
            entries.find(|entry| Some(entry.digest) == digest || entry.tag() == Some(reference));
        Ok(found.map(|entry| entry.digest))
    }

    /// The manifest with this tag or digest, as `/v2/NAME/manifests/REFERENCE` serves it.
    pub fn manifest(&self, reference: &str) -> Result<Option<Manifest>, Error> {
        let Some(digest) = self.resolve(reference)? else {
            return Ok(None);
        };
        let Some(bytes) = self.document(&digest)? else {
            return Ok(None);
        };
        let index = self.index()?.unwrap_or_default();
        let media_type = index
            .manifests
            .into_iter()
            .find(|entry| entry.digest == digest);
        let media_type =
            media_type.map_or_else(|| oci::MEDIA_MANIFEST.to_owned(), |entry| entry.media_type);
        Ok(Some(Manifest {
            digest,
            media_type,
            bytes,
        }))
    }

    /// Whether a blob is one of an image's: its manifest, its configuration or one of its layers. Digests elsewhere in the manifest, such
    /// as in annotations, are what whoever pushed it has written.
    pub fn has_blob(&self, image: &Digest, blob: &Digest) -> Result<bool, Error> {
        if image == blob {
            return Ok(true);
        }
        let manifest = self.read_manifest(image)?;
        Ok(manifest.is_some_and(|manifest| {
            let mut parts = manifest.layers.iter().chain([&manifest.config]);
            parts.any(|part| part.digest == *blob)
        }))
    }

    pub(crate) fn read_manifest(&self, digest: &Digest) -> Result<Option<oci::Manifest>, Error> {
        self.parsed(digest)
    }

    pub(crate) fn read_config(&self, digest: &Digest) -> Result<Option<Config>, Error> {
        self.parsed(digest)
    }

    fn parsed<T: serde::de::DeserializeOwned>(&self, digest: &Digest) -> Result<Option<T>, Error> {
        let Some(bytes) = self.document(digest)? else {
            return Ok(None);
        };
        let parsed = serde_json::from_slice(&bytes);
        parsed.map(Some).map_err(|source| Error::Json {
            path: self.blob_path(digest),
            source,
        })
    }
}

/// An image that lost its last tag stays in the index without one.
fn keep_listed(index: &mut oci::Index, image: Digest, store: &Store) -> Result<(), Error> {
    if index.manifests.iter().any(|entry| entry.digest == image) {
        return Ok(());
    }
    if let Some(bytes) = store.document(&image)? {
        index.manifests.push(Descriptor::new(
            oci::MEDIA_MANIFEST,
            image,
            bytes.len() as u64,
        ));
    }
    Ok(())
}

/// The index says the same whatever the order of the calls was.
fn sort(index: &mut oci::Index) {
    index
        .manifests
        .sort_by(|a, b| (a.tag(), a.digest).cmp(&(b.tag(), b.digest)));
}

/// `ref.name` of the image layout specification, a little wider: ROS names may hold `__`.
fn check_tag(name: &str) -> Result<(), Error> {
    let fits = |c: char| c.is_ascii_alphanumeric() || "._:@+/-".contains(c);
    let begins = name.starts_with(|c: char| c.is_ascii_alphanumeric());
    // A tag that reads as a digest would hide that digest.
    if begins && name.len() <= 255 && name.chars().all(fits) && name.parse::<Digest>().is_err() {
        return Ok(());
    }
    Err(Error::BadTag {
        name: name.to_owned(),
    })
}

fn configuration(spec: &ImageSpec) -> Config {
    let (architecture, variant) = oci::platform();
    Config {
        created: Some(EPOCH.to_owned()),
        architecture: architecture.to_owned(),
        variant: variant.map(str::to_owned),
        os: "linux".to_owned(),
        config: Process {
            env: spec
                .env
                .iter()
                .map(|(name, value)| format!("{name}={value}"))
                .collect(),
            cmd: spec.cmd.clone(),
            working_dir: spec.working_dir.clone(),
            labels: spec.labels.clone(),
        },
        rootfs: RootFs {
            kind: "layers".to_owned(),
            diff_ids: spec.layers.iter().map(|layer| layer.diff_id).collect(),
        },
        history: spec
            .layers
            .iter()
            .map(|_| History {
                created: EPOCH.to_owned(),
                created_by: "cloudroid".to_owned(),
            })
            .collect(),
    }
}

fn manifest(spec: &ImageSpec, config: Descriptor) -> oci::Manifest {
    oci::Manifest {
        schema_version: 2,
        media_type: oci::MEDIA_MANIFEST.to_owned(),
        config,
        layers: spec
            .layers
            .iter()
            .map(|layer| Descriptor::new(oci::MEDIA_LAYER_GZIP, layer.digest, layer.size))
            .collect(),
        annotations: spec.annotations.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TreeOptions;

    #[test]
    fn what_a_manifest_only_mentions_is_not_part_of_its_image() {
        let place = tempfile::tempdir().expect("a directory");
        let store = Store::open(&place.path().join("images"), &place.path().join("layers"));
        let store = store.expect("a store");
        let layer = |name: &str| {
            let tree = place.path().join(name);
            std::fs::create_dir_all(tree.join(name)).expect("made");
            let layer = store.layer_from_tree(&tree, &TreeOptions::default());
            layer.expect("a layer")
        };
        let (own, other) = (layer("own"), layer("other"));
        let annotations = BTreeMap::from([("note".to_owned(), other.digest.to_string())]);
        let spec = ImageSpec {
            layers: vec![own],
            annotations,
            ..ImageSpec::default()
        };
        let image = store.put_image(&spec).expect("an image");
        let manifest = store.manifest(&image.to_string()).expect("read");
        let text = String::from_utf8(manifest.expect("there").bytes).expect("text");
        assert!(text.contains(&other.digest.to_string()), "{text}");
        let config = store.read_manifest(&image).expect("read");
        let config = config.expect("there").config.digest;
        for part in [image, config, own.digest] {
            assert!(store.has_blob(&image, &part).expect("read"), "{part}");
        }
        assert!(!store.has_blob(&image, &other.digest).expect("read"));
        // An image that is gone has itself alone.
        assert!(!store.has_blob(&own.diff_id, &own.digest).expect("read"));
    }
}
