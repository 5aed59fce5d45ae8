//! Images and their tags.

use std::collections::{BTreeMap, BTreeSet};

use chrono::{DateTime, SecondsFormat};

use crate::oci::{self, Config, Descriptor, History, Process, REF_NAME, RootFs};
use crate::store::to_json;
use crate::{Digest, Error, LayerInfo, Store};

/// Specification of an image. Equal values give equal digests.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ImageSpec {
    /// Layers, lowest first.
    pub layers: Vec<LayerInfo>,
    /// Environment of its processes.
    pub env: BTreeMap<String, String>,
    /// Default command of a container.
    pub cmd: Vec<String>,
    /// Working directory; empty for `/`.
    pub working_dir: String,
    /// Labels of the configuration.
    pub labels: BTreeMap<String, String>,
    /// Annotations of the manifest.
    pub annotations: BTreeMap<String, String>,
    /// Time of the newest source, in seconds since 1970; it is recorded as the creation date, since the real one would
    /// give equal images different digests.
    pub created: u64,
}

impl ImageSpec {
    /// Returns whether the images have the same content and settings, whenever their sources were written and however
    /// their layers are compressed.
    pub fn is_same_content(&self, other: &ImageSpec) -> bool {
        let settings = |spec: &ImageSpec| ImageSpec { layers: Vec::new(), created: 0, ..spec.clone() };
        let contents = |spec: &ImageSpec| -> Vec<Digest> { spec.layers.iter().map(|layer| layer.diff_id).collect() };
        settings(self) == settings(other) && contents(self) == contents(other)
    }

    /// Creates the specification from a configuration, a manifest and their layers.
    pub(crate) fn from_documents(layers: Vec<LayerInfo>, config: Config, manifest: oci::Manifest) -> Self {
        let process = config.config;
        let env = process.env.iter().filter_map(|pair| pair.split_once('='));
        ImageSpec {
            layers,
            env: env.map(|(name, value)| (name.to_owned(), value.to_owned())).collect(),
            cmd: process.cmd,
            working_dir: process.working_dir,
            labels: process.labels,
            annotations: manifest.annotations,
            created: config.created.as_deref().map_or(0, parse_time),
        }
    }
}

/// Parses a time of RFC 3339 to seconds since 1970; 0 for anything else.
fn parse_time(text: &str) -> u64 {
    let time = DateTime::parse_from_rfc3339(text).ok();
    time.and_then(|time| u64::try_from(time.timestamp()).ok()).unwrap_or(0)
}

/// Returns seconds since 1970 as a time of RFC 3339, which the image specification requires.
fn format_time(seconds: u64) -> String {
    let time = i64::try_from(seconds).ok().and_then(|seconds| DateTime::from_timestamp(seconds, 0));
    time.unwrap_or_default().to_rfc3339_opts(SecondsFormat::Secs, true)
}

/// An image read from the store.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Digest of the manifest.
    pub digest: Digest,
    /// Specification of the image.
    pub spec: ImageSpec,
}

/// A manifest as served by a registry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Manifest {
    /// Digest of the manifest.
    pub digest: Digest,
    /// Media type, for `Content-Type`.
    pub media_type: String,
    /// JSON document.
    pub bytes: Vec<u8>,
}

impl Store {
    /// Writes an image and returns the digest of its manifest. Its layers must be in the store.
    ///
    /// The image has no tag yet: without [`Store::hold`] or a tag, the next [`Store::gc`] removes it.
    pub fn put_image(&self, spec: &ImageSpec) -> Result<Digest, Error> {
        let _hold = self.hold()?;
        for layer in &spec.layers {
            if !self.blob_path(&layer.digest).exists() {
                return Err(Error::UnknownLayer { diff_id: layer.diff_id, store: self.images_dir().to_owned() });
            }
        }
        let config = to_json(&make_config(spec));
        let config = Descriptor::new(oci::MEDIA_CONFIG, self.put_blob(&config)?, config.len() as u64);
        let manifest = to_json(&make_manifest(spec, config));
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
        let unknown = || Error::UnknownImage { digest: *image, store: self.images_dir().to_owned() };
        let manifest = self.read_manifest(image)?.ok_or_else(unknown)?;
        let config = self.read_config(&manifest.config.digest)?.ok_or_else(unknown)?;
        let layers = manifest
            .layers
            .iter()
            .zip(&config.rootfs.diff_ids)
            .map(|(blob, &diff_id)| {
                let unpacked = self.layer_record(&diff_id)?.map_or(0, |record| record.unpacked);
                Ok(LayerInfo { digest: blob.digest, diff_id, size: blob.size, unpacked })
            })
            .collect::<Result<_, Error>>()?;
        Ok(Image { digest: *image, spec: ImageSpec::from_documents(layers, config, manifest) })
    }

    /// Returns all images, tagged or not.
    pub fn images(&self) -> Result<BTreeSet<Digest>, Error> {
        Ok(self.read_index()?.unwrap_or_default().manifests.iter().map(|entry| entry.digest).collect())
    }

    /// Tags an image with a name such as `opencv_apps:3`, which is removed from another image if that had it.
    pub fn tag(&self, name: &str, image: &Digest) -> Result<(), Error> {
        check_tag(name)?;
        self.change_index(|index| {
            let Some(known) = index.manifests.iter().find(|entry| entry.digest == *image) else {
                return Err(Error::UnknownImage { digest: *image, store: self.images_dir().to_owned() });
            };
            let mut of_image = index.manifests.iter().filter(|it| it.digest == *image);
            if of_image.any(|entry| entry.tag() == Some(name)) {
                return Ok((false, ()));
            }
            let mut tagged = known.clone();
            tagged.annotations.insert(REF_NAME.to_owned(), name.to_owned());
            let loser = index.manifests.iter().find(|entry| entry.tag() == Some(name)).map(|entry| entry.digest);
            // The untagged entry of the image is no longer needed.
            index
                .manifests
                .retain(|entry| entry.tag() != Some(name) && !(entry.digest == *image && entry.tag().is_none()));
            index.manifests.push(tagged);
            if let Some(loser) = loser {
                ensure_listed(index, loser, self)?;
            }
            sort_index(index);
            Ok((true, ()))
        })
    }

    /// Removes a tag; returns false if it did not exist. The image stays until [`Store::gc`].
    pub fn untag(&self, name: &str) -> Result<bool, Error> {
        self.change_index(|index| {
            let Some(at) = index.manifests.iter().position(|entry| entry.tag() == Some(name)) else {
                return Ok((false, false));
            };
            let loser = index.manifests.remove(at).digest;
            ensure_listed(index, loser, self)?;
            sort_index(index);
            Ok((true, true))
        })
    }

    /// Returns all tags.
    pub fn tags(&self) -> Result<BTreeMap<String, Digest>, Error> {
        let index = self.read_index()?.unwrap_or_default();
        let tagged = index.manifests.iter().filter_map(|entry| Some((entry.tag()?.to_owned(), entry.digest)));
        Ok(tagged.collect())
    }

    /// Returns the image with this tag or digest; `None` if there is none, or only a blob of that digest.
    pub fn resolve(&self, reference: &str) -> Result<Option<Digest>, Error> {
        let index = self.read_index()?.unwrap_or_default();
        let digest = reference.parse::<Digest>().ok();
        let mut entries = index.manifests.iter();
        let found = entries.find(|entry| Some(entry.digest) == digest || entry.tag() == Some(reference));
        Ok(found.map(|entry| entry.digest))
    }

    /// Returns the manifest with this tag or digest, for `/v2/NAME/manifests/REFERENCE`.
    pub fn manifest(&self, reference: &str) -> Result<Option<Manifest>, Error> {
        let Some(digest) = self.resolve(reference)? else {
            return Ok(None);
        };
        let Some(bytes) = self.read_document(&digest)? else {
            return Ok(None);
        };
        let index = self.read_index()?.unwrap_or_default();
        let media_type = index.manifests.into_iter().find(|entry| entry.digest == digest);
        let media_type = media_type.map_or_else(|| oci::MEDIA_MANIFEST.to_owned(), |entry| entry.media_type);
        Ok(Some(Manifest { digest, media_type, bytes }))
    }

    /// Returns whether a blob is part of an image: its manifest, its configuration or one of its layers. Digests
    /// elsewhere in the manifest, for example in annotations, do not count, since they are chosen by whoever pushed it.
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
        self.parse_document(digest)
    }

    pub(crate) fn read_config(&self, digest: &Digest) -> Result<Option<Config>, Error> {
        self.parse_document(digest)
    }

    fn parse_document<T: serde::de::DeserializeOwned>(&self, digest: &Digest) -> Result<Option<T>, Error> {
        let Some(bytes) = self.read_document(digest)? else {
            return Ok(None);
        };
        let parsed = serde_json::from_slice(&bytes);
        parsed.map(Some).map_err(|source| Error::Json { path: self.blob_path(digest), source })
    }
}

/// Keeps an image that has lost its last tag in the index without a tag.
fn ensure_listed(index: &mut oci::Index, image: Digest, store: &Store) -> Result<(), Error> {
    if index.manifests.iter().any(|entry| entry.digest == image) {
        return Ok(());
    }
    if let Some(bytes) = store.read_document(&image)? {
        index.manifests.push(Descriptor::new(oci::MEDIA_MANIFEST, image, bytes.len() as u64));
    }
    Ok(())
}

/// Sorts the index, so that it does not depend on the order of calls.
fn sort_index(index: &mut oci::Index) {
    index.manifests.sort_by(|a, b| (a.tag(), a.digest).cmp(&(b.tag(), b.digest)));
}

/// Validates a tag: `ref.name` of the image layout specification, extended because ROS names may contain `__`.
fn check_tag(name: &str) -> Result<(), Error> {
    let fits = |c: char| c.is_ascii_alphanumeric() || "._:@+/-".contains(c);
    let begins = name.starts_with(|c: char| c.is_ascii_alphanumeric());
    // A tag in the form of a digest would hide that digest.
    if begins && name.len() <= 255 && name.chars().all(fits) && name.parse::<Digest>().is_err() {
        return Ok(());
    }
    Err(Error::BadTag { name: name.to_owned() })
}

fn make_config(spec: &ImageSpec) -> Config {
    let (architecture, variant) = oci::platform();
    let created = format_time(spec.created);
    Config {
        created: Some(created.clone()),
        architecture: architecture.to_owned(),
        variant: variant.map(str::to_owned),
        os: "linux".to_owned(),
        config: Process {
            env: spec.env.iter().map(|(name, value)| format!("{name}={value}")).collect(),
            cmd: spec.cmd.clone(),
            working_dir: spec.working_dir.clone(),
            labels: spec.labels.clone(),
        },
        rootfs: RootFs { kind: "layers".to_owned(), diff_ids: spec.layers.iter().map(|layer| layer.diff_id).collect() },
        history: spec
            .layers
            .iter()
            .map(|_| History { created: created.clone(), created_by: "cloudroid".to_owned() })
            .collect(),
    }
}

fn make_manifest(spec: &ImageSpec, config: Descriptor) -> oci::Manifest {
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
    fn an_image_is_as_old_as_its_newest_source() {
        for (seconds, text) in [(0, "1970-01-01T00:00:00Z"), (1_700_000_000, "2023-11-14T22:13:20Z")] {
            assert_eq!(format_time(seconds), text);
            assert_eq!(parse_time(text), seconds);
        }
        assert_eq!(parse_time("2023-11-14T23:13:20.5+01:00"), 1_700_000_000);
        for unknown in ["", "yesterday", "1969-12-31T23:59:59Z", "2023-11-14"] {
            assert_eq!(parse_time(unknown), 0, "{unknown}");
        }
        assert_eq!(format_time(u64::MAX), "1970-01-01T00:00:00Z");
    }

    #[test]
    fn the_time_of_the_sources_is_no_content() {
        let place = tempfile::tempdir().expect("a directory");
        let store = Store::open(&place.path().join("images"), &place.path().join("layers")).expect("a store");
        let image = |created: u64, command: &str| {
            let spec = ImageSpec { created, cmd: vec![command.to_owned()], ..ImageSpec::default() };
            let digest = store.put_image(&spec).expect("an image");
            store.image(&digest).expect("there")
        };
        let (first, touched, other) = (image(1_700_000_000, "a"), image(1_800_000_000, "a"), image(1_700_000_000, "b"));
        assert_eq!(first.spec.created, 1_700_000_000);
        assert_ne!(first.digest, touched.digest);
        assert!(first.spec.is_same_content(&touched.spec));
        assert!(!first.spec.is_same_content(&other.spec));
    }

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
        let spec = ImageSpec { layers: vec![own], annotations, ..ImageSpec::default() };
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
        // A missing image contains only itself.
        assert!(!store.has_blob(&own.diff_id, &own.digest).expect("read"));
    }
}
