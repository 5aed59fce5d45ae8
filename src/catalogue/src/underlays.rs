//! Underlays: records in the database, and an image for each that keeps its layers.

use std::collections::BTreeMap;
use std::sync::Arc;

use store::{StandingService, UnderlayRecord};

use crate::publish::set_tag;
use crate::{Catalogue, Error, blocking};

/// Returns the tag of an underlay's image; no service has such a name.
pub(crate) fn tag_name(underlay: &str) -> String {
    format!("underlays/{underlay}")
}

impl Catalogue {
    /// Returns an underlay, if it exists.
    pub fn underlay(&self, name: &str) -> Result<Option<UnderlayRecord>, Error> {
        Ok(self.state.underlay(name)?)
    }

    /// Returns all underlays by name.
    pub fn underlays(&self) -> Result<Vec<UnderlayRecord>, Error> {
        Ok(self.state.underlays()?)
    }

    /// Returns, by underlay, the services whose current revision was built on it.
    pub fn services_on_underlays(&self) -> Result<BTreeMap<String, Vec<StandingService>>, Error> {
        Ok(self.state.services_on_underlays()?)
    }

    /// Publishes an underlay in place of its earlier revision; returns its number.
    pub async fn publish_underlay(&self, record: UnderlayRecord) -> Result<u64, Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        blocking("publishing an underlay", move || {
            let number = state.publish_underlay(&record)?;
            // If the daemon crashes before this, the tag is repaired at the next start.
            set_tag(&store, &tag_name(&record.name), &record.image)?;
            Ok(number)
        })
        .await
    }

    /// Removes an underlay; returns false if it does not exist.
    pub async fn remove_underlay(&self, name: &str) -> Result<bool, Error> {
        let (state, store, name) = (Arc::clone(&self.state), Arc::clone(&self.images), name.to_owned());
        blocking("removing an underlay", move || {
            let existed = state.remove_underlay(&name)?;
            store.untag(&tag_name(&name))?;
            Ok(existed)
        })
        .await
    }

    /// Returns the compressed size of an underlay's layers in bytes; 0 if its image is missing.
    pub async fn underlay_bytes(&self, record: &UnderlayRecord) -> Result<u64, Error> {
        let (store, image) = (Arc::clone(&self.images), crate::inventory::digest(&record.image)?);
        blocking("measuring an underlay", move || match store.image(&image) {
            Ok(found) => Ok(found.spec.layers.iter().map(|layer| layer.size).sum()),
            Err(image::Error::UnknownImage { .. }) => Ok(0),
            Err(error) => Err(error.into()),
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::inventory::tests::catalogue;

    #[tokio::test]
    async fn layers_of_an_underlay_stay_until_it_is_removed() {
        let place = tempfile::tempdir().expect("a directory");
        let (catalogue, revision) = catalogue(place.path());
        let record = UnderlayRecord {
            name: "maps".to_owned(),
            number: 0,
            image: revision.image.clone(),
            published: 1,
            owner: Some("ann".to_owned()),
            source: "~/lab_ws".to_owned(),
            flavour: revision.flavour.clone(),
            contents: Default::default(),
        };
        assert_eq!(catalogue.publish_underlay(record.clone()).await.expect("published"), 1);
        let bytes = catalogue.underlay_bytes(&record).await.expect("measured");
        assert!(bytes > 0);
        assert_eq!(catalogue.owner_image_bytes("ann", None).await.expect("counted"), bytes);
        for _ in 0..2 {
            catalogue.repair_tags().await.expect("repaired");
            catalogue.collect_garbage(BTreeSet::new()).await;
            assert_eq!(catalogue.underlay_bytes(&record).await.expect("measured"), bytes);
        }
        assert!(catalogue.remove_underlay("maps").await.expect("removed"));
        assert!(!catalogue.remove_underlay("maps").await.expect("it is gone"));
        catalogue.collect_garbage(BTreeSet::new()).await;
        assert_eq!(catalogue.underlay_bytes(&record).await.expect("measured"), 0);
    }
}
