//! Makes a revision the current one, goes back to an earlier one, takes a service away, and keeps image store and
//! database of one mind. The database decides; tags follow it.

use std::collections::BTreeSet;
use std::sync::Arc;

use image::{Digest, Store};
use package::inventory::Inventory;
use store::{RevisionLine, RevisionRecord};

use crate::inventory::digest;
use crate::{Catalogue, Error, blocking};

/// A service that went back (or on) to another revision.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RolledBack {
    /// The revision that was the current one.
    pub from: u64,
    /// The revision that is the current one now.
    pub to: u64,
}

/// A service that is not in the database any more, and whose images are still tagged.
#[derive(Debug)]
pub struct Withdrawn {
    service: String,
    revisions: Vec<RevisionLine>,
}

impl Catalogue {
    /// Writes the revision; from here on it is what new servants are started from. Gives its number.
    pub async fn publish(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
    ) -> Result<u64, Error> {
        self.publish_as(record, inventory, true).await
    }

    /// Writes the revision beside the one that new servants are started from. Gives its number.
    pub async fn publish_beside(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
    ) -> Result<u64, Error> {
        self.publish_as(record, inventory, false).await
    }

    async fn publish_as(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
        current: bool,
    ) -> Result<u64, Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        blocking("publishing", move || {
            let number = match current {
                true => state.publish(&record, &inventory)?,
                false => state.publish_beside(&record, &inventory)?,
            };
            // A crash before these is repaired at the next start.
            tag(&store, &record.service, number, &record.image)?;
            if let Some(current) = state.current(&record.service)? {
                tag_current(&store, &record.service, &current.image)?;
            }
            Ok(number)
        })
        .await
    }

    /// Makes the revision of the number `wanted` the current one; without a number the one before.
    pub async fn rollback(&self, name: &str, wanted: Option<u64>) -> Result<RolledBack, Error> {
        let current = self.current(name)?;
        let revisions = self.state.revisions(name)?;
        let target = match wanted {
            Some(number) => revisions.iter().find(|revision| revision.number == number),
            None => revisions
                .iter()
                .find(|revision| revision.number < current.number),
        };
        let Some(target) = target.cloned() else {
            return Err(Error::UnknownRevision {
                service: name.to_owned(),
                revision: wanted.map_or_else(
                    || format!("before {}", current.number),
                    |number| number.to_string(),
                ),
                exists: revisions
                    .iter()
                    .map(|revision| revision.number.to_string())
                    .collect(),
            });
        };
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        let to = target.number;
        blocking("rolling back", move || {
            state.set_current(&target.service, target.number)?;
            tag_current(&store, &target.service, &target.image)
        })
        .await?;
        Ok(RolledBack {
            from: current.number,
            to,
        })
    }

    /// Makes revision `to` the current one where `from` is it, or `to` itself; false where another one is, which stays.
    pub async fn promote(&self, service: &str, from: u64, to: u64) -> Result<bool, Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        let service = service.to_owned();
        blocking("promoting a revision", move || {
            let target = state.revision(&service, to)?;
            let Some(target) = target else {
                return Ok(false);
            };
            if !state.replace_current(&service, from, to)? {
                return Ok(false);
            }
            tag_current(&store, &service, &target.image)?;
            Ok(true)
        })
        .await
    }

    /// Takes a service out of the database: nobody is given a servant of it any more. Its images stay until
    /// [`untag`](Self::untag).
    pub fn withdraw(&self, service: &str) -> Result<Withdrawn, Error> {
        let revisions = self.state.revisions(service)?;
        self.state.remove_service(service)?;
        Ok(Withdrawn {
            service: service.to_owned(),
            revisions,
        })
    }

    /// Gives up the images of a service that was withdrawn, and whose servants have ended.
    pub async fn untag(&self, withdrawn: Withdrawn) -> Result<(), Error> {
        let store = Arc::clone(&self.images);
        blocking("removing a service", move || {
            let Withdrawn { service, revisions } = withdrawn;
            store.untag(&service)?;
            for revision in revisions {
                store.untag(&format!("{service}:{}", revision.number))?;
            }
            Ok(())
        })
        .await
    }

    /// Makes the tags say what the database says: a crash may have come between.
    pub async fn repair(&self) -> Result<(), Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        blocking("repairing the image store", move || {
            let tagged = store.tags()?;
            // Each change of a tag writes the index anew, and robots wait for all of them.
            let keep = |name: &str, image: &str| match tagged.get(name) {
                Some(known) if *known == digest(image)? => Ok(()),
                _ => set_tag(&store, name, image),
            };
            let mut wanted = BTreeSet::new();
            for revision in state.all_revisions()? {
                let name = format!("{}:{}", revision.service, revision.number);
                keep(&name, &revision.image)?;
                wanted.insert(name);
            }
            for service in state.service_names()? {
                if let Some(current) = state.current(&service)? {
                    keep(&service, &current.image)?;
                }
                wanted.insert(service);
            }
            for tag in tagged.keys().filter(|tag| !wanted.contains(*tag)) {
                store.untag(tag)?;
            }
            Ok(())
        })
        .await
    }

    /// Removes what nothing needs: what has no tag and is not in `keep`. A failure is logged alone.
    pub async fn collect_garbage(&self, keep: BTreeSet<Digest>) {
        let store = Arc::clone(&self.images);
        match blocking("collecting garbage", move || Ok(store.gc(&keep)?)).await {
            Ok(swept) if swept.blobs + swept.trees + swept.leftovers > 0 => {
                tracing::info!(
                    "removed {} blobs and {} trees that nothing needs",
                    swept.blobs,
                    swept.trees
                );
            }
            Ok(_) => {}
            Err(error) => tracing::warn!("garbage could not be collected: {error}"),
        }
    }
}

/// A tag that cannot be set because its image is gone is told, and is no reason not to start.
fn tag(store: &Store, service: &str, number: u64, image: &str) -> Result<(), Error> {
    set_tag(store, &format!("{service}:{number}"), image)
}

fn tag_current(store: &Store, service: &str, image: &str) -> Result<(), Error> {
    set_tag(store, service, image)
}

fn set_tag(store: &Store, name: &str, image: &str) -> Result<(), Error> {
    match store.tag(name, &digest(image)?) {
        Err(error @ image::Error::UnknownImage { .. }) => {
            tracing::error!("{name} cannot be served: {error}");
            Ok(())
        }
        outcome => Ok(outcome?),
    }
}
