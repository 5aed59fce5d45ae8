//! Documents of images that other tools wrote: of the OCI image specification 1.1, docker's image manifest V2 (schema
//! 2), and docker's image specification 1.2 (`manifest.json`). Only what is needed is read, and `null` means absent.

use std::collections::{BTreeMap, BTreeSet};

use foreign::Tree;
use serde::Deserialize;

use crate::received::{MOST_LAYERS, blob_path, is_layout, parse_json, read, read_layout_document, unreceivable_error};
use crate::{Digest, Error, oci};

/// Maximum number of lists in lists: an index of tags, one of architectures, and one to spare.
const MAX_NESTED_LISTS: usize = 3;
/// Maximum number of images in a layout, and of names in a message.
const MOST_IMAGES: usize = 100;
/// Maximum number of lists that are read: the entries of each may all name the same list, and so on.
const MOST_INDEXES: usize = 100;
/// Maximum length of an image's name in characters.
const LONGEST_NAME: usize = 256;
/// Maximum total size of the environment in bytes.
const LARGEST_ENVIRONMENT: usize = 64 << 10;

const MANIFESTS: [&str; 2] = [oci::MEDIA_MANIFEST, "application/vnd.docker.distribution.manifest.v2+json"];
const INDEXES: [&str; 2] = [oci::MEDIA_INDEX, "application/vnd.docker.distribution.manifest.list.v2+json"];

/// An image before its layers are read.
#[derive(Debug)]
pub(super) struct SavedDocuments {
    /// Layers, lowest first.
    layers: Vec<SavedLayer>,
    pub(super) env: BTreeMap<String, String>,
    pub(super) name: String,
}

/// A layer in an unpacked archive.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SavedLayer {
    /// Path of the file in the archive.
    pub(super) path: String,
    /// Digest of its uncompressed content.
    pub(super) diff_id: Digest,
}

#[derive(Deserialize)]
struct SavedIndex {
    manifests: Vec<SavedEntry>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct SavedEntry {
    #[serde(default)]
    media_type: Option<String>,
    digest: Digest,
    platform: Option<SavedPlatform>,
    annotations: Option<BTreeMap<String, String>>,
}

#[derive(Deserialize)]
struct SavedPlatform {
    #[serde(default)]
    architecture: String,
    #[serde(default)]
    os: String,
}

#[derive(Deserialize)]
struct SavedManifest {
    config: SavedBlob,
    layers: Vec<SavedBlob>,
}

#[derive(Deserialize)]
struct SavedBlob {
    digest: Digest,
}

#[derive(Deserialize)]
struct SavedConfig {
    #[serde(default)]
    architecture: String,
    config: Option<SavedProcess>,
    rootfs: oci::RootFs,
}

#[derive(Deserialize)]
struct SavedProcess {
    #[serde(rename = "Env")]
    env: Option<Vec<String>>,
}

/// Entry of docker's `manifest.json`.
#[derive(Deserialize)]
#[serde(rename_all = "PascalCase")]
struct DockerImage {
    config: String,
    repo_tags: Option<Vec<String>>,
    layers: Vec<String>,
}

impl SavedDocuments {
    /// Reads and validates the documents of an unpacked archive; layers are not read.
    pub(super) fn read(archive: &Tree) -> Result<Self, Error> {
        if is_layout(archive) {
            return Self::read_layout(archive);
        }
        if archive.has_file("manifest.json") {
            return Self::read_docker(archive);
        }
        Err(unreceivable_error(
            "the archive has neither oci-layout and index.json nor manifest.json at its root; write it with podman \
                save, docker save, or skopeo copy docker://NAME oci-archive:FILE"
                .to_owned(),
        ))
    }

    fn read_layout(layout: &Tree) -> Result<Self, Error> {
        let index: SavedIndex = parse_json("index.json", &read(layout, "index.json")?)?;
        let mut found = FoundImages::default();
        found.collect(layout, index, "", MAX_NESTED_LISTS)?;
        let images = found.images;
        if images.is_empty() {
            return Err(several_images(std::iter::empty()));
        }
        let (architecture, _) = oci::platform();
        let own = |image: &FoundImage| image.architecture.as_deref().is_none_or(|its| its == architecture);
        let wanted: BTreeSet<Digest> = images.iter().filter(|image| own(image)).map(|image| image.digest).collect();
        let Some(image) = images.iter().find(|image| own(image)) else {
            let others: BTreeSet<&str> = images.iter().filter_map(|image| image.architecture.as_deref()).collect();
            return Err(wrong_architecture(&others.into_iter().collect::<Vec<_>>().join(", ")));
        };
        if wanted.len() > 1 {
            let names: BTreeSet<&str> = images.iter().filter(|image| own(image)).map(FoundImage::label).collect();
            return Err(several_images(names.into_iter()));
        }
        let manifest: SavedManifest = parse_json("its manifest", &read_layout_document(layout, &image.digest)?)?;
        let config: SavedConfig = parse_json("its config", &read_layout_document(layout, &manifest.config.digest)?)?;
        let paths = manifest.layers.iter().map(|layer| blob_path(&layer.digest)).collect();
        Self::from_parts(config, paths, image.name.clone())
    }

    fn read_docker(archive: &Tree) -> Result<Self, Error> {
        let mut images: Vec<DockerImage> = parse_json("manifest.json", &read(archive, "manifest.json")?)?;
        let tag = |image: &DockerImage| image.repo_tags.iter().flatten().next().cloned().unwrap_or_default();
        if images.len() != 1 {
            let names: Vec<String> = images.iter().map(tag).collect();
            return Err(several_images(names.iter().map(String::as_str)));
        }
        let image = images.remove(0);
        let name = tag(&image);
        let config: SavedConfig = parse_json("its config", &read(archive, &image.config)?)?;
        Self::from_parts(config, image.layers, name)
    }

    fn from_parts(config: SavedConfig, paths: Vec<String>, name: String) -> Result<Self, Error> {
        let (architecture, _) = oci::platform();
        if config.architecture != architecture {
            return Err(wrong_architecture(&config.architecture));
        }
        let diff_ids = config.rootfs.diff_ids;
        if paths.is_empty() || paths.len() != diff_ids.len() {
            return Err(unreceivable_error(format!(
                "it has {} layers and {} diff-ids; both must be equal, and not 0",
                paths.len(),
                diff_ids.len()
            )));
        }
        let variables = config.config.and_then(|process| process.env).unwrap_or_default();
        if variables.iter().map(String::len).sum::<usize>() > LARGEST_ENVIRONMENT {
            return Err(unreceivable_error(format!("its environment is longer than {LARGEST_ENVIRONMENT} bytes")));
        }
        let pairs = variables.iter().filter_map(|pair| pair.split_once('='));
        let documents = Self {
            layers: paths.into_iter().zip(diff_ids).map(|(path, diff_id)| SavedLayer { path, diff_id }).collect(),
            env: pairs.map(|(name, value)| (name.to_owned(), value.to_owned())).collect(),
            name: name.chars().filter(|c| !c.is_control()).take(LONGEST_NAME).collect(),
        };
        let distinct = documents.distinct_layers().len();
        if distinct > MOST_LAYERS {
            let words = format!("it has {distinct} layers; the limit is {MOST_LAYERS}: squash it");
            return Err(unreceivable_error(words));
        }
        Ok(documents)
    }

    /// Returns the layers, lowest first. Of one that occurs several times, such as an empty one, the uppermost is kept,
    /// since an overlay accepts each once: what it hides or replaces stays hidden or replaced.
    pub(super) fn distinct_layers(&self) -> Vec<SavedLayer> {
        let mut seen = BTreeSet::new();
        let mut kept: Vec<SavedLayer> =
            self.layers.iter().rev().filter(|layer| seen.insert(layer.diff_id)).cloned().collect();
        kept.reverse();
        kept
    }
}

/// An image in a layout.
struct FoundImage {
    digest: Digest,
    /// Architecture in the terms of Go; `None` if the index does not state it.
    architecture: Option<String>,
    name: String,
}

impl FoundImage {
    fn label(&self) -> &str {
        if self.name.is_empty() { "one without a name" } else { &self.name }
    }
}

/// The images of a layout that were found so far.
#[derive(Default)]
struct FoundImages {
    images: Vec<FoundImage>,
    /// Number of lists that were read.
    indexes: usize,
}

impl FoundImages {
    /// Collects the images of an index and the indexes in it. `name`: that of the index.
    fn collect(&mut self, layout: &Tree, index: SavedIndex, name: &str, depth: usize) -> Result<(), Error> {
        for entry in index.manifests {
            let annotations = entry.annotations.unwrap_or_default();
            // Signatures and build records that buildkit lists beside images.
            if annotations.contains_key("vnd.docker.reference.type") {
                continue;
            }
            let own = annotations.get("io.containerd.image.name").or_else(|| annotations.get(oci::REF_NAME));
            let name = own.map_or(name, String::as_str);
            let media = entry.media_type.as_deref().unwrap_or(oci::MEDIA_MANIFEST);
            if MANIFESTS.contains(&media) {
                if entry.platform.as_ref().is_some_and(|platform| !matches!(platform.os.as_str(), "" | "linux")) {
                    continue;
                }
                if self.images.len() >= MOST_IMAGES {
                    return Err(unreceivable_error(format!("it contains more than {MOST_IMAGES} images; save one")));
                }
                let architecture = entry.platform.map(|platform| platform.architecture).filter(|its| !its.is_empty());
                self.images.push(FoundImage { digest: entry.digest, architecture, name: name.to_owned() });
            } else if INDEXES.contains(&media) && depth > 0 {
                self.indexes += 1;
                if self.indexes > MOST_INDEXES {
                    return Err(unreceivable_error(format!(
                        "it contains more than {MOST_INDEXES} lists; save one image"
                    )));
                }
                let inner: SavedIndex = parse_json("its index", &read_layout_document(layout, &entry.digest)?)?;
                self.collect(layout, inner, name, depth - 1)?;
            }
        }
        Ok(())
    }
}

fn wrong_architecture(others: &str) -> Error {
    let (architecture, _) = oci::platform();
    let others = if others.is_empty() { "an unknown architecture" } else { others };
    unreceivable_error(format!(
        "it is for {others}, but this machine is {architecture}; save the image for it (podman pull --arch \
            {architecture})"
    ))
}

fn several_images<'a>(names: impl Iterator<Item = &'a str>) -> Error {
    let names: Vec<&str> = names.take(MOST_IMAGES).collect();
    match names.len() {
        0 => unreceivable_error("it contains no image".to_owned()),
        _ => unreceivable_error(format!("it contains several images ({}); save one", names.join(", "))),
    }
}
