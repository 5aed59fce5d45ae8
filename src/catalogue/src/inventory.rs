//! Inventories of the images of revisions, recorded at publication. For a revision published by an earlier version of
//! this program the inventory is recorded when it is first requested.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Weak};

use image::Store;
use package::inventory::{Inventory, SearchHints};
use parking_lot::Mutex;
use ros::flavour::Flavour;
use ros::schema::Registry;
use store::{RevisionRecord, State};

use crate::{Catalogue, Error, blocking};

/// Image label that names the base.
const BASE: &str = "org.cloudroid.base";

/// Inventory and message definitions of a revision.
#[derive(Debug, Clone, Default)]
pub struct RevisionContents {
    /// Inventory of the revision's image.
    pub inventory: Arc<Inventory>,
    /// Message definitions known to its servants: those of the interface, and those in the image.
    pub registry: Arc<Registry>,
}

/// Cached contents of revisions in use, by service and revision number.
pub(crate) type ContentsCache = Mutex<HashMap<(String, u64), (Weak<Inventory>, Weak<Registry>)>>;

impl Catalogue {
    /// Returns the contents of a revision.
    pub async fn revision_contents(&self, revision: &RevisionRecord) -> Result<RevisionContents, Error> {
        let key = (revision.service.clone(), revision.number);
        if let Some((inventory, registry)) = self.in_use.lock().get(&key)
            && let (Some(inventory), Some(registry)) = (inventory.upgrade(), registry.upgrade())
        {
            return Ok(RevisionContents { inventory, registry });
        }
        let inventory = Arc::new(self.inventory(revision).await?);
        let registry = Registry::for_version(revision.flavour.ros.ros_version());
        // Definitions of the interface are inserted last and take precedence: they were compared with the running node.
        let texts = inventory.definitions.iter();
        for (key, text) in texts.chain(&revision.interface.definitions) {
            if let Err(error) = registry.insert(key, text) {
                tracing::debug!("invalid message definition {key} of {}: {error}", revision.service);
            }
        }
        let registry = Arc::new(registry);
        let mut in_use = self.in_use.lock();
        in_use.retain(|_, (_, registry)| registry.strong_count() > 0);
        let weak = (Arc::downgrade(&inventory), Arc::downgrade(&registry));
        in_use.insert(key, weak);
        Ok(RevisionContents { inventory, registry })
    }

    /// Records the missing inventories of current revisions that were published by an earlier version of this program,
    /// so that no robot has to wait for it.
    pub async fn record_missing_inventories(&self) -> Result<(), Error> {
        for line in self.state.revisions_without_inventory()? {
            if let Some(revision) = self.state.revision(&line.service, line.number)?
                && let Err(error) = self.inventory(&revision).await
            {
                tracing::warn!("cannot inspect the image of revision {} of {}: {error}", line.number, line.service);
            }
        }
        Ok(())
    }

    async fn inventory(&self, revision: &RevisionRecord) -> Result<Inventory, Error> {
        if let Some(inventory) = self.state.inventory(&revision.service, revision.number)? {
            return Ok(inventory);
        }
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        let revision = revision.clone();
        blocking("inspecting an image", move || take_inventory(&state, &store, &revision)).await
    }
}

/// Takes the inventory of a revision's image and records it. Blocking.
fn take_inventory(state: &State, store: &Store, revision: &RevisionRecord) -> Result<Inventory, Error> {
    let nodes = revision.plan.nodes.iter();
    let commands: Vec<&[String]> = nodes.map(|node| node.argv.as_slice()).collect();
    let of = SearchHints { package: &revision.package, environment: &revision.plan.environment, commands: &commands };
    let layers = layers(store, &revision.image)?;
    let taken = privilege::run_as_reader(|| Inventory::scan(&layers, of));
    let inventory = taken.map_err(Error::Inventory)?;
    let labels = store.image(&digest(&revision.image)?)?.spec.labels;
    let mut flavour = Flavour::default();
    flavour.base = labels.get(BASE).cloned().unwrap_or(flavour.base);
    // A failure is not fatal: the inventory is taken again at the next request.
    if let Err(error) = state.record_inventory(&revision.service, revision.number, &flavour, &inventory) {
        tracing::warn!("cannot record the contents of the image of {}: {error}", revision.service);
    }
    Ok(inventory)
}

/// Returns the extracted layers of an image, lowest first.
pub(crate) fn layers(store: &Store, image: &str) -> Result<Vec<PathBuf>, Error> {
    let layers = store.image(&digest(image)?)?.spec.layers;
    Ok(layers.iter().map(|layer| store.ensure_extracted(&layer.diff_id)).collect::<Result<_, _>>()?)
}

pub(crate) fn digest(image: &str) -> Result<image::Digest, Error> {
    image.parse().map_err(|_| Error::UnknownImage { what: image.to_owned() })
}

#[cfg(test)]
pub(crate) mod tests {
    use std::collections::BTreeMap;
    use std::os::unix::fs::PermissionsExt;
    use std::path::Path;

    use image::{ImageSpec, TreeOptions};
    use servant::spec::NodeSpec;
    use store::Plan;

    use super::*;

    fn write(tree: &Path, path: &str, text: &str, mode: u32) {
        let path = tree.join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(&path, text).expect("written");
        std::fs::set_permissions(path, PermissionsExt::from_mode(mode)).expect("set");
    }

    /// Creates a catalogue with the image of a package, and a revision of it that is not published yet.
    pub(crate) fn catalogue(place: &Path) -> (Catalogue, RevisionRecord) {
        let tree = place.join("tree");
        write(&tree, "usr/share/p/package.xml", "<package/>", 0o644);
        write(&tree, "usr/share/p/msg/Said.msg", "string words\n", 0o644);
        write(&tree, "usr/lib/p/node", "", 0o755);
        let images = Store::open(&place.join("images"), &place.join("layers")).expect("a store");
        let layer = images.layer_from_tree(&tree, &TreeOptions::default()).expect("packed");
        let spec = ImageSpec {
            layers: vec![layer],
            labels: BTreeMap::from([(BASE.to_owned(), "lab-ros1".to_owned())]),
            ..ImageSpec::default()
        };
        let revision = RevisionRecord {
            service: "serves".into(),
            number: 1,
            image: images.put_image(&spec).expect("written").to_string(),
            published: 0,
            package: "p".into(),
            owner: None,
            source: String::new(),
            flavour: Flavour::default(),
            plan: Plan {
                nodes: vec![NodeSpec {
                    name: "/n".into(),
                    argv: vec!["/usr/lib/p/node".into()],
                    environment: Default::default(),
                    directory: String::new(),
                    respawn: false,
                    respawn_delay: 0.0,
                    required: false,
                }],
                ..Plan::default()
            },
            interface: Default::default(),
        };
        let state = State::open(&place.join("cloudroid.db")).expect("a database");
        (Catalogue::new(Arc::new(state), Arc::new(images)), revision)
    }

    #[tokio::test]
    async fn what_is_recorded_is_not_looked_for_again() {
        let place = tempfile::tempdir().expect("a directory");
        let (catalogue, revision) = catalogue(place.path());
        let recorded = Inventory {
            programs: BTreeMap::from([("other".to_owned(), "/opt/other".to_owned())]),
            definitions: BTreeMap::from([("p/msg/Other".to_owned(), "int8 x\n".to_owned())]),
            ..Inventory::default()
        };
        let published = catalogue.publish(revision.clone(), recorded.clone()).await;
        assert_eq!(published.expect("published"), 1);
        // The image has been removed.
        std::fs::remove_dir_all(place.path().join("layers")).expect("removed");
        std::fs::remove_dir_all(place.path().join("images")).expect("removed");
        let known = catalogue.revision_contents(&revision).await.expect("recorded");
        assert_eq!(*known.inventory, recorded);
        known.registry.message("p/Other").expect("defined");
        // Servants of the same revision share its contents.
        let again = catalogue.revision_contents(&revision).await.expect("recorded");
        assert!(Arc::ptr_eq(&known.registry, &again.registry));
    }

    #[tokio::test]
    async fn a_revision_of_an_earlier_version_is_completed_once() {
        let place = tempfile::tempdir().expect("a directory");
        let (catalogue, revision) = catalogue(place.path());
        let published = catalogue.publish(revision, Inventory::default()).await;
        published.expect("published");
        let database = rusqlite::Connection::open(place.path().join("cloudroid.db"));
        database
            .and_then(|database| database.execute("UPDATE revisions SET inventory = NULL, flavour = NULL", []))
            .expect("as it was before");
        catalogue.record_missing_inventories().await.expect("completed");
        let state = &catalogue.state;
        let inventory = state.inventory("serves", 1).expect("readable");
        let inventory = inventory.expect("recorded");
        assert_eq!(inventory.programs["node"], "/usr/lib/p/node");
        assert_eq!(inventory.packages["p"].share, "/usr/share/p");
        assert!(inventory.definitions.contains_key("p/msg/Said"));
        let revision = catalogue.current_revision("serves").expect("there");
        assert_eq!(revision.flavour.base, "lab-ros1");
        assert!(state.revisions_without_inventory().expect("readable").is_empty());
    }
}
