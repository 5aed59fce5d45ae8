//! What the images of revisions hold, as recorded when they were published. Of a revision that an earlier version of this
//! program published it is recorded when it is first asked for.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Weak};

use image::Store;
use package::inventory::{Inventory, Published};
use parking_lot::Mutex;
use ros::flavour::Flavour;
use ros::schema::Registry;
use store::{RevisionRecord, State};

use crate::{Catalogue, Error, blocking};

/// The image's label that names its base.
const BASE: &str = "org.cloudroid.base";

/// What is known of a revision beyond its record.
#[derive(Debug, Clone, Default)]
pub struct Known {
    /// What its image holds.
    pub inventory: Arc<Inventory>,
    /// All message definitions that its servants know: its interface's, and those in its image.
    pub registry: Arc<Registry>,
}

/// Of revisions in use, by service and number.
pub(crate) type InUse = Mutex<HashMap<(String, u64), (Weak<Inventory>, Weak<Registry>)>>;

impl Catalogue {
    /// What is known of a revision.
    pub async fn known(&self, revision: &RevisionRecord) -> Result<Known, Error> {
        let key = (revision.service.clone(), revision.number);
        if let Some((inventory, registry)) = self.in_use.lock().get(&key)
            && let (Some(inventory), Some(registry)) = (inventory.upgrade(), registry.upgrade())
        {
            return Ok(Known {
                inventory,
                registry,
            });
        }
        let inventory = Arc::new(self.inventory(revision).await?);
        let registry = Registry::of(revision.flavour.ros.bus());
        // The interface's own come last and win: they were compared with the running node.
        let texts = inventory.definitions.iter();
        for (key, text) in texts.chain(&revision.interface.definitions) {
            if let Err(error) = registry.insert(key, text) {
                tracing::debug!(
                    "the definition {key} of {} is unusable: {error}",
                    revision.service
                );
            }
        }
        let registry = Arc::new(registry);
        let mut in_use = self.in_use.lock();
        in_use.retain(|_, (_, registry)| registry.strong_count() > 0);
        let weak = (Arc::downgrade(&inventory), Arc::downgrade(&registry));
        in_use.insert(key, weak);
        Ok(Known {
            inventory,
            registry,
        })
    }

    /// Records what the images of current revisions hold where an earlier version of this program did not, so that no
    /// robot waits for that.
    pub async fn complete(&self) -> Result<(), Error> {
        for line in self.state.incomplete()? {
            if let Some(revision) = self.state.revision(&line.service, line.number)?
                && let Err(error) = self.inventory(&revision).await
            {
                tracing::warn!(
                    "what the image of revision {} of {} holds cannot be found out: {error}",
                    line.number,
                    line.service
                );
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
        blocking("looking into an image", move || {
            found(&state, &store, &revision)
        })
        .await
    }
}

/// Looks into the image of a revision, and records what is there. Blocking.
fn found(state: &State, store: &Store, revision: &RevisionRecord) -> Result<Inventory, Error> {
    let nodes = revision.plan.nodes.iter();
    let commands: Vec<&[String]> = nodes.map(|node| node.argv.as_slice()).collect();
    let of = Published {
        package: &revision.package,
        environment: &revision.plan.environment,
        commands: &commands,
    };
    let layers = layers(store, &revision.image)?;
    let taken = privilege::reading(|| Inventory::take(&layers, of));
    let inventory = taken.map_err(Error::Inventory)?;
    let labels = store.image(&digest(&revision.image)?)?.spec.labels;
    let mut flavour = Flavour::default();
    flavour.base = labels.get(BASE).cloned().unwrap_or(flavour.base);
    // It serves all the same; the next one looks again.
    if let Err(error) = state.complete(&revision.service, revision.number, &flavour, &inventory) {
        tracing::warn!(
            "what the image of {} holds is not recorded: {error}",
            revision.service
        );
    }
    Ok(inventory)
}

/// The extracted layers of an image, lowest first.
pub(crate) fn layers(store: &Store, image: &str) -> Result<Vec<PathBuf>, Error> {
    let layers = store.image(&digest(image)?)?.spec.layers;
    Ok(layers
        .iter()
        .map(|layer| store.extracted(&layer.diff_id))
        .collect::<Result<_, _>>()?)
}

pub(crate) fn digest(image: &str) -> Result<image::Digest, Error> {
    image.parse().map_err(|_| Error::UnknownImage {
        what: image.to_owned(),
    })
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

    /// A catalogue with the image of a package, and a revision of it that is not published yet.
    pub(crate) fn catalogue(place: &Path) -> (Catalogue, RevisionRecord) {
        let tree = place.join("tree");
        write(&tree, "usr/share/p/package.xml", "<package/>", 0o644);
        write(&tree, "usr/share/p/msg/Said.msg", "string words\n", 0o644);
        write(&tree, "usr/lib/p/node", "", 0o755);
        let images = Store::open(&place.join("images"), &place.join("layers")).expect("a store");
        let layer = images
            .layer_from_tree(&tree, &TreeOptions::default())
            .expect("packed");
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
        // Nothing of the image is there any more.
        std::fs::remove_dir_all(place.path().join("layers")).expect("removed");
        std::fs::remove_dir_all(place.path().join("images")).expect("removed");
        let known = catalogue.known(&revision).await.expect("recorded");
        assert_eq!(*known.inventory, recorded);
        known.registry.message("p/Other").expect("defined");
        // Servants of a revision share what is known of it.
        let again = catalogue.known(&revision).await.expect("recorded");
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
            .and_then(|database| {
                database.execute("UPDATE revisions SET inventory = NULL, flavour = NULL", [])
            })
            .expect("as it was before");
        catalogue.complete().await.expect("completed");
        let state = &catalogue.state;
        let inventory = state.inventory("serves", 1).expect("readable");
        let inventory = inventory.expect("recorded");
        assert_eq!(inventory.programs["node"], "/usr/lib/p/node");
        assert_eq!(inventory.packages["p"].share, "/usr/share/p");
        assert!(inventory.definitions.contains_key("p/msg/Said"));
        let revision = catalogue.current("serves").expect("there");
        assert_eq!(revision.flavour.base, "lab-ros1");
        assert!(state.incomplete().expect("readable").is_empty());
    }
}
