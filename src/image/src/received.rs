//! Images that come from elsewhere: an image layout (OCI image specification 1.1) in a tree that somebody has sent.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use foreign::Tree;
use serde::de::DeserializeOwned;

use crate::digest::Hashing;
use crate::oci::{self, Config, Descriptor, Index, Layout, Manifest};
use crate::{Digest, Error, Image, ImageSpec, LayerInfo, Limits, Store};

/// The largest document of a layout, in bytes.
const LARGEST: u64 = 16 << 20;
/// Layers of an image at most: an overlay mount takes no more than some hundreds.
const MOST_LAYERS: usize = 128;

/// An image that was received.
#[derive(Debug, Clone, PartialEq)]
pub struct Received {
    /// As it is in the store now, untagged: equal content, made by this store. Its digest is that of the layout's image where
    /// this store wrote that, too.
    pub image: Image,
    /// Of each layer: whether it was there already.
    pub known: Vec<bool>,
    /// Annotations of the layout's entry.
    pub annotations: BTreeMap<String, String>,
}

/// Whether a tree is an image layout.
pub fn is_layout(tree: &Tree) -> bool {
    tree.has_file("oci-layout") && tree.has_file("index.json")
}

/// A document of an image layout, whose digest is as its name says; of at most 16 MiB.
///
/// # Errors
/// [`Error::Unreceivable`] where it is not there or is another.
pub fn document(layout: &Tree, digest: &Digest) -> Result<Vec<u8>, Error> {
    let path = blob_path(digest);
    let bytes = read(layout, &path)?;
    let found = Digest::of(&bytes);
    if found != *digest {
        return Err(unreceivable(format!(
            "its blob {digest} has the content of {found}"
        )));
    }
    Ok(bytes)
}

impl Store {
    /// Takes in the one image of an image layout: each blob is compared with its digest, each layer with its diff-id. Without
    /// [`Store::hold`] or a tag, the next [`Store::gc`] removes it.
    ///
    /// # Errors
    /// [`Error::Unreceivable`], [`Error::Archive`] where layers hold more than `limits` or cannot be read.
    pub fn receive(&self, layout: &Tree, limits: &Limits) -> Result<Received, Error> {
        let _hold = self.hold()?;
        let version: Layout = parsed("oci-layout", &read(layout, "oci-layout")?)?;
        if version.image_layout_version != oci::LAYOUT_VERSION {
            return Err(unreceivable(format!(
                "its layout is of version {:?}, and {} is read here",
                version.image_layout_version,
                oci::LAYOUT_VERSION
            )));
        }
        let index: Index = parsed("index.json", &read(layout, "index.json")?)?;
        let [entry] = &index.manifests[..] else {
            return Err(unreceivable(format!(
                "it holds {} images, and one is expected",
                index.manifests.len()
            )));
        };
        if entry.media_type != oci::MEDIA_MANIFEST {
            return Err(unreceivable(format!(
                "its image is of type {:?}, and {} is expected",
                entry.media_type,
                oci::MEDIA_MANIFEST
            )));
        }
        let manifest: Manifest = parsed("its manifest", &document(layout, &entry.digest)?)?;
        let config: Config = parsed("its config", &document(layout, &manifest.config.digest)?)?;
        let diff_ids = &config.rootfs.diff_ids;
        if manifest.layers.len() != diff_ids.len() || diff_ids.len() > MOST_LAYERS {
            return Err(unreceivable(format!(
                "it has {} layers and {} diff-ids; as many are expected, and at most {MOST_LAYERS}",
                manifest.layers.len(),
                diff_ids.len()
            )));
        }
        // An overlay takes each once, and each is read and compared.
        let distinct: BTreeSet<&Digest> = diff_ids.iter().collect();
        if distinct.len() != diff_ids.len() {
            return Err(unreceivable("it lists the same layer twice".to_owned()));
        }
        let (architecture, _) = oci::platform();
        if config.architecture != architecture {
            return Err(unreceivable(format!(
                "it is for {}, and this machine is {architecture}",
                config.architecture
            )));
        }
        let mut left = *limits;
        let mut known = Vec::new();
        let mut layers = Vec::new();
        for (named, diff_id) in manifest.layers.iter().zip(diff_ids) {
            let there = self.layer(diff_id)?;
            let there = there.filter(|layer| layer.digest == named.digest);
            known.push(there.is_some());
            layers.push(match there {
                // Whoever names it must have it: it may be of an image that is none of theirs.
                Some(layer) => has_blob(layout, &named.digest).map(|()| layer)?,
                None => self.receive_layer(layout, named, diff_id, &mut left)?,
            });
        }
        let spec = ImageSpec::read(layers, config, manifest);
        Ok(Received {
            image: Image {
                digest: self.put_image(&spec)?,
                spec,
            },
            known,
            annotations: entry.annotations.clone(),
        })
    }

    fn receive_layer(
        &self,
        layout: &Tree,
        named: &Descriptor,
        diff_id: &Digest,
        left: &mut Limits,
    ) -> Result<LayerInfo, Error> {
        if named.media_type != oci::MEDIA_LAYER_GZIP {
            return Err(unreceivable(format!(
                "its layer {} is of type {:?}, and {} is read here",
                named.digest,
                named.media_type,
                oci::MEDIA_LAYER_GZIP
            )));
        }
        let file = open(layout, &blob_path(&named.digest))?;
        let label = PathBuf::from(format!("layer {}", named.digest));
        let is_named = |layer: &LayerInfo| {
            if layer.digest == named.digest && layer.diff_id == *diff_id {
                return Ok(());
            }
            Err(unreceivable(format!(
                "its layer {} has the content of {} ({}, not {diff_id}, unpacked)",
                named.digest, layer.digest, layer.diff_id
            )))
        };
        let (layer, entries) = self.import_layer_within(file, &label, left, is_named)?;
        left.bytes -= layer.unpacked;
        left.entries -= entries;
        Ok(layer)
    }
}

fn blob_path(digest: &Digest) -> String {
    format!("blobs/sha256/{}", digest.hex())
}

/// Refuses a layout that lacks a blob, or has another in its place.
fn has_blob(layout: &Tree, digest: &Digest) -> Result<(), Error> {
    let path = blob_path(digest);
    let mut content = Hashing::new(open(layout, &path)?);
    io::copy(&mut content, &mut io::sink())
        .map_err(|error| Error::file("read", Path::new(&path), error))?;
    let (_, found, _) = content.finish();
    match found == *digest {
        true => Ok(()),
        false => Err(unreceivable(format!(
            "its blob {digest} has the content of {found}"
        ))),
    }
}

fn open(layout: &Tree, path: &str) -> Result<File, Error> {
    let file = layout.open_file(path).map_err(unfit)?;
    file.map(File::from).ok_or_else(|| missing(path))
}

fn read(layout: &Tree, path: &str) -> Result<Vec<u8>, Error> {
    let file = layout.file(path, LARGEST).map_err(unfit)?;
    Ok(file.ok_or_else(|| missing(path))?.bytes)
}

fn parsed<T: DeserializeOwned>(what: &str, bytes: &[u8]) -> Result<T, Error> {
    serde_json::from_slice(bytes)
        .map_err(|error| unreceivable(format!("{what} cannot be read: {error}")))
}

fn missing(path: &str) -> Error {
    unreceivable(format!("{path} is missing"))
}

fn unfit(error: foreign::Error) -> Error {
    unreceivable(error.to_string())
}

fn unreceivable(problem: String) -> Error {
    Error::Unreceivable { problem }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Refusal, TreeOptions};

    struct Place {
        root: tempfile::TempDir,
        image: Image,
        store: Store,
    }

    fn store(root: &Path, name: &str) -> Store {
        let place = root.join(name);
        Store::open(&place.join("images"), &place.join("layers")).expect("a store")
    }

    /// A store with an image of two layers.
    fn place() -> Place {
        let root = tempfile::tempdir().expect("a directory");
        let store = store(root.path(), "one");
        let mut layers = Vec::new();
        for name in ["lower", "upper"] {
            let tree = root.path().join(name);
            std::fs::create_dir_all(tree.join("opt")).expect("made");
            std::fs::write(tree.join("opt").join(name), name).expect("written");
            let layer = store.layer_from_tree(&tree, &TreeOptions::default());
            layers.push(layer.expect("a layer"));
        }
        let spec = ImageSpec {
            layers,
            env: BTreeMap::from([("ROS_DISTRO".to_owned(), "noetic".to_owned())]),
            labels: BTreeMap::from([("a".to_owned(), "b".to_owned())]),
            ..ImageSpec::default()
        };
        let digest = store.put_image(&spec).expect("an image");
        store.tag("one:1", &digest).expect("a tag");
        let image = store.image(&digest).expect("it is there");
        Place { root, image, store }
    }

    impl Place {
        fn layout(&self) -> Tree {
            Tree::open(self.store.images_dir()).expect("a layout")
        }

        /// By a store that has nothing yet.
        fn refused(&self, limits: &Limits) -> Error {
            let empty = tempfile::tempdir_in(self.root.path()).expect("a directory");
            let other = store(empty.path(), "other");
            let refused = other.receive(&self.layout(), limits);
            refused.expect_err("it is refused")
        }

        /// Where the blob of the upper layer is.
        fn upper(&self) -> PathBuf {
            let digest = self.image.spec.layers[1].digest;
            self.store.images_dir().join(blob_path(&digest))
        }
    }

    #[test]
    fn an_image_of_another_store_is_the_same_here() {
        let place = place();
        let other = store(place.root.path(), "other");
        assert!(is_layout(&place.layout()));
        let received = other
            .receive(&place.layout(), &Limits::default())
            .expect("good");
        assert_eq!(received.image.digest, place.image.digest);
        assert_eq!(received.image.spec, place.image.spec);
        assert_eq!(received.known, [false, false]);
        assert_eq!(received.annotations[oci::REF_NAME], "one:1");
        for layer in &received.image.spec.layers {
            let tree = other.extracted(&layer.diff_id).expect("extracted");
            assert!(tree.join("opt").is_dir());
        }
        let again = other
            .receive(&place.layout(), &Limits::default())
            .expect("good");
        assert_eq!(again.known, [true, true]);
        // A layer that is there is nobody's who does not send it.
        std::fs::remove_file(place.upper()).expect("removed");
        let refused = other.receive(&place.layout(), &Limits::default());
        let refused = refused.expect_err("it is not sent").to_string();
        assert!(refused.contains("is missing"), "{refused}");
        std::fs::write(place.upper(), "another").expect("written");
        let refused = other.receive(&place.layout(), &Limits::default());
        let refused = refused.expect_err("another is sent").to_string();
        assert!(refused.contains("has the content of"), "{refused}");
    }

    #[test]
    fn a_layout_that_is_not_what_it_says_is_refused_with_the_reason() {
        let place = place();
        let blob = std::fs::read(place.upper()).expect("read");
        let lower = place.image.spec.layers[0].digest;
        let lower = place.store.images_dir().join(blob_path(&lower));
        let set = |content: &[u8]| {
            std::fs::remove_file(place.upper()).expect("removed");
            std::fs::write(place.upper(), content).expect("written");
        };
        set(&std::fs::read(lower).expect("read"));
        let refused = place.refused(&Limits::default()).to_string();
        assert!(refused.contains("has the content of"), "{refused}");
        set(&blob[..blob.len() / 2]);
        let refused = place.refused(&Limits::default());
        assert!(matches!(refused, Error::Archive { .. }), "{refused}");
        std::fs::remove_file(place.upper()).expect("removed");
        let refused = place.refused(&Limits::default()).to_string();
        assert!(refused.contains("is missing"), "{refused}");
        // A link is no blob, wherever it leads.
        std::os::unix::fs::symlink("/etc/passwd", place.upper()).expect("linked");
        let refused = place.refused(&Limits::default());
        assert!(matches!(refused, Error::Unreceivable { .. }), "{refused}");
        let index = place.store.images_dir().join("index.json");
        std::fs::write(index, r#"{"schemaVersion": 2, "manifests": []}"#).expect("written");
        let refused = place.refused(&Limits::default()).to_string();
        assert!(refused.contains("holds 0 images"), "{refused}");
    }

    #[test]
    fn layers_hold_no_more_than_is_allowed() {
        let place = place();
        let of = |limits: Limits| match place.refused(&limits) {
            Error::Archive { problem, .. } => problem,
            other => panic!("{other}"),
        };
        let few = Limits {
            entries: 3,
            ..Limits::default()
        };
        assert!(matches!(of(few), Refusal::TooManyEntries { .. }));
        let small = Limits {
            bytes: 4096,
            ..Limits::default()
        };
        assert!(matches!(of(small), Refusal::TooLarge { .. }));
    }

    #[test]
    fn the_same_layer_twice_is_refused() {
        let root = tempfile::tempdir().expect("a directory");
        let store = store(root.path(), "one");
        let tree = root.path().join("tree");
        std::fs::create_dir_all(tree.join("opt")).expect("made");
        let layer = store.layer_from_tree(&tree, &TreeOptions::default());
        let layer = layer.expect("a layer");
        let twice = ImageSpec {
            layers: vec![layer, layer],
            ..ImageSpec::default()
        };
        let digest = store.put_image(&twice).expect("an image");
        let image = store.image(&digest).expect("it is there");
        let place = Place { root, image, store };
        let refused = place.refused(&Limits::default()).to_string();
        assert!(refused.contains("same layer twice"), "{refused}");
    }

    #[test]
    fn what_is_refused_leaves_no_layer() {
        let place = place();
        let [lower, upper] = place.image.spec.layers[..] else {
            panic!("two layers")
        };
        let of = |layer: &LayerInfo| place.store.images_dir().join(blob_path(&layer.digest));
        std::fs::copy(of(&lower), of(&upper)).expect("another content under its name");
        let other = store(place.root.path(), "other");
        let refused = other.receive(&place.layout(), &Limits::default());
        refused.expect_err("a layer is another");
        assert!(!other.images_dir().join(blob_path(&upper.digest)).exists());
    }

    #[test]
    fn a_layer_in_another_blob_changes_no_image_of_this_store() {
        let place = place();
        let lower = place.image.spec.layers[0];
        let path = place.store.images_dir().join(blob_path(&lower.digest));
        let mut content = Vec::new();
        let archive = std::fs::read(path).expect("a blob");
        io::Read::read_to_end(
            &mut flate2::read::GzDecoder::new(&archive[..]),
            &mut content,
        )
        .expect("a gzip file");
        let again = place.root.path().join("again.tar.gz");
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::none());
        io::Write::write_all(&mut packed, &content).expect("packed");
        std::fs::write(&again, packed.finish().expect("packed")).expect("written");
        let other = place.store.import_layer(&again).expect("a layer");
        assert_eq!(other.diff_id, lower.diff_id);
        assert_ne!(other.digest, lower.digest);
        let known = place.store.layer(&lower.diff_id).expect("it is read");
        assert_eq!(known, Some(lower));
    }
}
