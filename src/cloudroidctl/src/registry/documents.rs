//! Manifests and indexes (OCI image specification 1.1; Docker's image manifest, version 2, schema 2). What they are is
//! told by their content, which has a digest, and not by what the registry calls it.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, bail, ensure};
use serde::Deserialize;

use super::digest::Digest;

/// Media types of the documents that are understood.
pub const MEDIA_TYPES: [&str; 4] = [
    "application/vnd.oci.image.index.v1+json",
    "application/vnd.oci.image.manifest.v1+json",
    "application/vnd.docker.distribution.manifest.list.v2+json",
    "application/vnd.docker.distribution.manifest.v2+json",
];

/// Maximum size of a document in bytes: what registries have to accept (OCI distribution specification 1.1), and what
/// none exceeds.
pub const LARGEST_DOCUMENT: u64 = 4 << 20;
/// Maximum number of layers, and of entries of an index.
const MOST_ENTRIES: usize = 1000;

/// A document or a layer by its digest and its size in bytes.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct BlobDescriptor {
    pub digest: Digest,
    pub size: u64,
}

/// A document that stands for an image.
#[derive(Debug, PartialEq, Eq)]
pub enum ImageDocument {
    /// An image for several architectures: the manifest of one.
    Index(BlobDescriptor),
    /// An image.
    Manifest(ImageManifest),
}

/// Parts of an image.
#[derive(Debug, PartialEq, Eq)]
pub struct ImageManifest {
    pub config: BlobDescriptor,
    /// Layers, lowest first; some may occur several times.
    pub layers: Vec<BlobDescriptor>,
    /// Media type, as in the document.
    pub media_type: String,
}

/// Any of these documents.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct AnyDocument {
    #[serde(default)]
    media_type: Option<String>,
    manifests: Option<Vec<IndexEntry>>,
    config: Option<BlobDescriptor>,
    layers: Option<Vec<BlobDescriptor>>,
}

#[derive(Deserialize)]
struct IndexEntry {
    #[serde(flatten)]
    descriptor: BlobDescriptor,
    platform: Option<Platform>,
    annotations: Option<BTreeMap<String, String>>,
}

#[derive(Deserialize)]
struct Platform {
    #[serde(default)]
    architecture: String,
    #[serde(default)]
    os: String,
}

impl ImageDocument {
    /// Parses a document; of an index, the entry for this architecture (in the terms of Go) is taken.
    ///
    /// # Errors
    /// For a document that is neither, and for an index without an image for the architecture.
    pub fn parse(bytes: &[u8], architecture: &str) -> anyhow::Result<ImageDocument> {
        let document: AnyDocument = serde_json::from_slice(bytes).context("its manifest cannot be read")?;
        let AnyDocument { media_type, manifests, config, layers } = document;
        let count = manifests.as_ref().map_or(0, Vec::len).max(layers.as_ref().map_or(0, Vec::len));
        ensure!(count <= MOST_ENTRIES, "its manifest has {count} entries; the limit is {MOST_ENTRIES}");
        match (manifests, config, layers) {
            (Some(manifests), None, None) => choose_entry(manifests, architecture).map(ImageDocument::Index),
            (None, Some(config), Some(layers)) => {
                ensure!(!layers.is_empty(), "it has no layers");
                let is_too_large = config.size > LARGEST_DOCUMENT;
                ensure!(!is_too_large, "its config has {} bytes; the limit is {LARGEST_DOCUMENT}", config.size);
                let media_type = media_type.unwrap_or_else(|| MEDIA_TYPES[1].to_owned());
                Ok(ImageDocument::Manifest(ImageManifest { config, layers, media_type }))
            }
            _ => bail!("it is no image: its manifest has neither a list of images nor a config and layers"),
        }
    }
}

impl ImageManifest {
    /// Returns the config and the layers, each once.
    pub fn blobs(&self) -> Vec<&BlobDescriptor> {
        let mut seen = BTreeSet::new();
        let all = std::iter::once(&self.config).chain(&self.layers);
        all.filter(|blob| seen.insert(blob.digest.hex())).collect()
    }
}

fn choose_entry(entries: Vec<IndexEntry>, architecture: &str) -> anyhow::Result<BlobDescriptor> {
    let mut others = BTreeSet::new();
    for entry in entries {
        // Signatures and build records that buildkit lists beside images.
        if entry.annotations.is_some_and(|annotations| annotations.contains_key("vnd.docker.reference.type")) {
            continue;
        }
        match entry.platform {
            Some(platform) if !matches!(platform.os.as_str(), "" | "linux") => {}
            Some(platform) if !platform.architecture.is_empty() && platform.architecture != architecture => {
                others.insert(platform.architecture);
            }
            _ => return Ok(entry.descriptor),
        }
    }
    let others: Vec<String> = others.into_iter().take(20).collect();
    let others = if others.is_empty() { "no Linux at all".to_owned() } else { others.join(", ") };
    bail!("it is for {others}, but the server is {architecture}")
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn blob(text: &str) -> Value {
        json!({ "digest": Digest::compute(text.as_bytes()).to_string(), "size": text.len() })
    }

    fn parse(document: &Value) -> anyhow::Result<ImageDocument> {
        ImageDocument::parse(document.to_string().as_bytes(), "amd64")
    }

    fn entry(text: &str, more: Value) -> Value {
        let mut entry = blob(text);
        entry.as_object_mut().expect("an object").extend(more.as_object().expect("an object").clone());
        entry
    }

    #[test]
    fn of_an_index_the_image_for_the_server_is_taken() {
        let platform = |os: &str, architecture: &str| json!({"platform": {"os": os, "architecture": architecture}});
        let record = json!({"platform": {"os": "linux", "architecture": "amd64"},
            "annotations": {"vnd.docker.reference.type": "attestation-manifest"}});
        let entries = [
            entry("record", record),
            entry("arm", platform("linux", "arm64")),
            entry("windows", platform("windows", "amd64")),
            entry("ours", platform("linux", "amd64")),
        ];
        let chosen = parse(&json!({ "manifests": entries })).expect("an index");
        assert!(matches!(chosen, ImageDocument::Index(chosen) if chosen.digest == Digest::compute(b"ours")));
        let refused = parse(&json!({ "manifests": &entries[..3] })).expect_err("none for amd64").to_string();
        assert!(refused.contains("arm64") && refused.contains("amd64"), "{refused}");
        parse(&json!({ "manifests": [entry("only", json!({}))] })).expect("without a platform");
    }

    #[test]
    fn an_image_has_a_config_and_layers() {
        let layers = [blob("empty"), blob("system"), blob("empty")];
        let parsed = parse(&json!({ "config": blob("{}"), "layers": layers })).expect("an image");
        let ImageDocument::Manifest(manifest) = parsed else { panic!("{parsed:?}") };
        assert_eq!((manifest.layers.len(), manifest.blobs().len()), (3, 3));
        assert_eq!(manifest.media_type, MEDIA_TYPES[1]);
    }

    #[test]
    fn what_is_no_image_is_refused() {
        let large = json!({ "digest": Digest::compute(b"x").to_string(), "size": LARGEST_DOCUMENT + 1 });
        let many: Vec<Value> = (0..=MOST_ENTRIES).map(|number| blob(&number.to_string())).collect();
        for (document, words) in [
            (json!([]), "cannot be read"),
            (json!({ "schemaVersion": 1, "fsLayers": [] }), "it is no image"),
            (json!({ "config": blob("{}"), "layers": [] }), "no layers"),
            (json!({ "config": large, "layers": [blob("x")] }), "the limit is"),
            (json!({ "config": blob("{}"), "layers": many }), "1001 entries"),
            (json!({ "manifests": [], "config": blob("{}"), "layers": [blob("x")] }), "it is no image"),
            (json!({ "manifests": [] }), "no Linux"),
            (json!({ "config": { "digest": "sha512:00", "size": 1 }, "layers": [] }), "cannot be read"),
            (json!({ "config": { "digest": "../../x", "size": 1 }, "layers": [] }), "cannot be read"),
            (json!({ "config": blob("{}"), "layers": [{ "digest": blob("x")["digest"], "size": -1 }] }), "be read"),
        ] {
            let refused = parse(&document).expect_err(words);
            assert!(format!("{refused:#}").contains(words), "{refused:#}");
        }
    }
}
