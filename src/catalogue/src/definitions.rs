//! Message definitions in images: those that a client may speak of beyond the recorded interface, such as a type
//! it advertises itself. Read once per image.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use foreign::{Found, Tree};
use parking_lot::Mutex;
use ros::schema::Registry;
use store::RevisionRecord;

use crate::Error;

type Texts = Arc<BTreeMap<String, String>>;

/// Definitions by image.
#[derive(Default)]
pub struct Definitions {
    images: Mutex<HashMap<String, Texts>>,
}

impl Definitions {
    /// All definitions that a servant of `revision` knows: its interface's, and those in its image.
    pub async fn registry(
        &self,
        store: &Arc<image::Store>,
        revision: &RevisionRecord,
    ) -> Arc<Registry> {
        let registry = Registry::new();
        let image = self.of_image(store, &revision.image).await;
        // The interface's own come last and win: they were compared with the running node.
        for (key, text) in image.iter().chain(&revision.interface.definitions) {
            if let Err(error) = registry.insert(key, text) {
                tracing::debug!(
                    "the definition {key} of {} is unusable: {error}",
                    revision.service
                );
            }
        }
        Arc::new(registry)
    }

    /// Reads those of an image before they are needed.
    pub async fn read(&self, store: &Arc<image::Store>, image: &str) {
        self.of_image(store, image).await;
    }

    async fn of_image(&self, store: &Arc<image::Store>, image: &str) -> Texts {
        if let Some(known) = self.images.lock().get(image) {
            return Arc::clone(known);
        }
        let (store, digest) = (Arc::clone(store), image.to_owned());
        let read = tokio::task::spawn_blocking(move || read_image(&store, &digest)).await;
        match read {
            Ok(Ok(texts)) => Arc::clone(
                self.images
                    .lock()
                    .entry(image.to_owned())
                    .or_insert_with(|| Arc::new(texts)),
            ),
            Ok(Err(error)) => {
                tracing::warn!("the definitions in image {image} cannot be read: {error}");
                Texts::default()
            }
            Err(_) => Texts::default(),
        }
    }

    /// Forgets all images but those.
    pub fn keep_only(&self, images: &BTreeSet<String>) {
        self.images.lock().retain(|image, _| images.contains(image));
    }
}

fn read_image(store: &image::Store, image: &str) -> Result<BTreeMap<String, String>, Error> {
    let layers = layers(store, image)?;
    let shares = shares(&layers);
    package::definitions::read(&layers, &shares).map_err(Error::Definitions)
}

/// The extracted layers of an image, lowest first.
pub(crate) fn layers(store: &image::Store, image: &str) -> Result<Vec<PathBuf>, Error> {
    let digest = image.parse().map_err(|_| Error::UnknownImage {
        what: image.to_owned(),
    })?;
    let layers = store.image(&digest)?.spec.layers;
    Ok(layers
        .iter()
        .map(|layer| store.extracted(&layer.diff_id))
        .collect::<Result<_, _>>()?)
}

/// Where ROS packages keep what they share: install spaces below `/opt` before the distribution. (Those that are none
/// are no harm: nothing is found in them.)
fn shares(layers: &[PathBuf]) -> Vec<String> {
    let mut shares = BTreeSet::new();
    for layer in layers {
        for space in directories(layer, "opt") {
            shares.extend(
                directories(layer, &space)
                    .into_iter()
                    .map(|below| format!("{below}/share")),
            );
            shares.insert(format!("{space}/share"));
        }
    }
    let trees: Vec<Tree> = layers
        .iter()
        .filter_map(|layer| Tree::open(layer).ok())
        .collect();
    shares.retain(|share| trees.iter().any(|tree| is_directory(tree, share)));
    shares.into_iter().chain(["usr/share".to_owned()]).collect()
}

/// Directories below `parent` in a layer, behind no link: an absolute link in a layer points into the host.
pub(crate) fn directories(layer: &Path, parent: &str) -> Vec<String> {
    let Ok(Found::Directory(parent_directory)) =
        Tree::open(layer).and_then(|tree| tree.directory(parent))
    else {
        return Vec::new();
    };
    let names = parent_directory.names().unwrap_or_default();
    let below = names.iter().filter_map(|name| name.to_str());
    below
        .filter(|name| is_directory(&parent_directory, name))
        .map(|name| format!("{parent}/{name}"))
        .collect()
}

fn is_directory(tree: &Tree, path: &str) -> bool {
    matches!(tree.directory(path), Ok(Found::Directory(_)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn install_spaces_are_found_in_every_layer() {
        let place = tempfile::tempdir().expect("a directory");
        let (base, package) = (place.path().join("base"), place.path().join("package"));
        for directory in [
            base.join("usr/share/std_msgs"),
            base.join("opt/ros/noetic/share"),
            package.join("opt/mine/share/a"),
        ] {
            std::fs::create_dir_all(directory).expect("made");
        }
        std::os::unix::fs::symlink("/usr", package.join("opt/linked")).expect("a link");
        // Of a layer whose /opt is a link to the host's root, nothing is listed.
        let linked = place.path().join("linked");
        std::fs::create_dir(&linked).expect("made");
        std::os::unix::fs::symlink("/", linked.join("opt")).expect("a link");
        assert_eq!(directories(&linked, "opt"), Vec::<String>::new());
        assert_eq!(
            shares(&[base, package, linked]),
            ["opt/mine/share", "opt/ros/noetic/share", "usr/share"]
        );
    }
}
