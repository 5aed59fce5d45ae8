//! Disk usage of the images of one owner.

use std::collections::BTreeMap;
use std::sync::Arc;

use image::{Digest, Store};

use crate::inventory::digest;
use crate::{Catalogue, Error, blocking};

impl Catalogue {
    /// Returns the compressed size of the layers of all images of a deployer's services and underlays, counting each
    /// layer once, including those of `image`, which need not be published yet.
    pub async fn owner_image_bytes(&self, owner: &str, image: Option<&str>) -> Result<u64, Error> {
        let (state, images) = (Arc::clone(&self.state), Arc::clone(&self.images));
        let (owner, image) = (owner.to_owned(), image.map(str::to_owned));
        blocking("counting a deployer's images", move || {
            let mut layers = BTreeMap::new();
            for service in state.service_names()? {
                let of = state.service_owner(&service)?.flatten();
                if of.as_deref() != Some(owner.as_str()) {
                    continue;
                }
                for revision in state.revisions(&service)? {
                    add_layers(&images, &revision.image, &mut layers)?;
                }
            }
            for underlay in state.underlays()?.iter().filter(|one| one.owner.as_deref() == Some(owner.as_str())) {
                add_layers(&images, &underlay.image, &mut layers)?;
            }
            if let Some(image) = image {
                add_layers(&images, &image, &mut layers)?;
            }
            Ok(layers.values().sum())
        })
        .await
    }
}

/// Adds the layers of an image, if it exists.
fn add_layers(store: &Store, image: &str, layers: &mut BTreeMap<Digest, u64>) -> Result<(), Error> {
    match store.image(&digest(image)?) {
        Ok(found) => {
            let of_it = found.spec.layers.iter();
            layers.extend(of_it.map(|layer| (layer.digest, layer.size)));
            Ok(())
        }
        Err(image::Error::UnknownImage { .. }) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use image::{ImageSpec, TreeOptions};
    use package::inventory::Inventory;

    use super::*;
    use crate::inventory::tests::catalogue;

    #[tokio::test]
    async fn each_layer_of_a_deployers_services_counts_once() {
        let place = tempfile::tempdir().expect("a directory");
        let (catalogue, revision) = catalogue(place.path());
        let images = catalogue.images();
        let first = images.image(&digest(&revision.image).expect("one"));
        let shared = first.expect("there").spec.layers[0];
        // Another image on top of the same layer.
        let tree = place.path().join("other");
        std::fs::create_dir_all(tree.join("opt")).expect("made");
        let own = images.layer_from_tree(&tree, &TreeOptions::default());
        let own = own.expect("packed");
        let spec = ImageSpec { layers: vec![shared, own], ..ImageSpec::default() };
        let other = images.put_image(&spec).expect("written").to_string();
        let taken = async |owner: &str, image: Option<&str>| {
            let bytes = catalogue.owner_image_bytes(owner, image).await;
            bytes.expect("counted")
        };
        for (service, owner) in [("nobodys", None), ("two", Some("ben")), ("one", Some("ann"))] {
            assert_eq!(taken("ann", None).await, 0, "{service} is another's");
            let mut record = revision.clone();
            record.service = service.to_owned();
            record.owner = owner.map(str::to_owned);
            let published = catalogue.publish(record, Inventory::default()).await;
            published.expect("published");
        }
        assert_eq!(taken("ann", None).await, shared.size);
        assert_eq!(taken("ann", Some(&other)).await, shared.size + own.size);
        // Earlier revisions count as well.
        let mut record = revision.clone();
        (record.service, record.image) = ("one".to_owned(), other);
        let published = catalogue.publish(record, Inventory::default()).await;
        assert_eq!(published.expect("published"), 2);
        assert_eq!(taken("ann", None).await, shared.size + own.size);
        assert_eq!(taken("ben", None).await, shared.size);
    }
}
