//! Publishes revisions, rolls back, removes services, and keeps the image store consistent with the database. The
//! database is authoritative; tags follow it.

use std::collections::BTreeSet;
use std::sync::Arc;

use image::{Digest, Store};
use package::inventory::Inventory;
use store::{RevisionRecord, RevisionSummary};

use crate::inventory::digest;
use crate::underlays::tag_name;
use crate::{Catalogue, Error, blocking};

/// Result of a rollback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RollbackResult {
    /// Revision that was current before.
    pub from: u64,
    /// Revision that is current now.
    pub to: u64,
}

/// A service that has been removed from the database and whose images are still tagged.
#[derive(Debug)]
pub struct WithdrawnService {
    service: String,
    revisions: Vec<RevisionSummary>,
}

impl Catalogue {
    /// Publishes a revision and makes it the current one, from which new servants are started. Returns its number.
    pub async fn publish(&self, record: RevisionRecord, inventory: Inventory) -> Result<u64, Error> {
        self.publish_revision(record, inventory, true).await
    }

    /// Publishes a revision without making it the current one. Returns its number.
    pub async fn publish_inactive(&self, record: RevisionRecord, inventory: Inventory) -> Result<u64, Error> {
        self.publish_revision(record, inventory, false).await
    }

    async fn publish_revision(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
        current: bool,
    ) -> Result<u64, Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        blocking("publishing", move || {
            let number = if current {
                state.publish(&record, &inventory)?
            } else {
                state.publish_inactive(&record, &inventory)?
            };
            // If the daemon crashes before these, the tags are repaired at the next start.
            tag(&store, &record.service, number, &record.image)?;
            if let Some(current) = state.current_revision(&record.service)? {
                tag_current(&store, &record.service, &current.image)?;
            }
            Ok(number)
        })
        .await
    }

    /// Makes revision `wanted` the current one, or the previous revision if `None`.
    pub async fn rollback(&self, name: &str, wanted: Option<u64>) -> Result<RollbackResult, Error> {
        let current = self.current_revision(name)?;
        let revisions = self.state.revisions(name)?;
        let target = match wanted {
            Some(number) => revisions.iter().find(|revision| revision.number == number),
            None => revisions.iter().find(|revision| revision.number < current.number),
        };
        let Some(target) = target.cloned() else {
            return Err(Error::UnknownRevision {
                service: name.to_owned(),
                revision: wanted.map_or_else(|| format!("before {}", current.number), |number| number.to_string()),
                exists: revisions.iter().map(|revision| revision.number.to_string()).collect(),
            });
        };
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        let to = target.number;
        blocking("rolling back", move || {
            state.set_current_revision(&target.service, target.number)?;
            tag_current(&store, &target.service, &target.image)
        })
        .await?;
        Ok(RollbackResult { from: current.number, to })
    }

    /// Makes revision `to` the current one if the current one is `from` or `to`; otherwise changes nothing and returns
    /// false.
    pub async fn promote(&self, service: &str, from: u64, to: u64) -> Result<bool, Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        let service = service.to_owned();
        blocking("promoting a revision", move || {
            let target = state.revision(&service, to)?;
            let Some(target) = target else {
                return Ok(false);
            };
            if !state.replace_current_revision(&service, from, to)? {
                return Ok(false);
            }
            tag_current(&store, &service, &target.image)?;
            Ok(true)
        })
        .await
    }

    /// Removes a service from the database, so that no new servants of it are started. Its images stay until
    /// [`untag`](Self::untag).
    pub fn withdraw(&self, service: &str) -> Result<WithdrawnService, Error> {
        let revisions = self.state.revisions(service)?;
        self.state.remove_service(service)?;
        Ok(WithdrawnService { service: service.to_owned(), revisions })
    }

    /// Removes the tags of a withdrawn service whose servants have ended.
    pub async fn untag(&self, withdrawn: WithdrawnService) -> Result<(), Error> {
        let store = Arc::clone(&self.images);
        blocking("removing a service", move || {
            let WithdrawnService { service, revisions } = withdrawn;
            store.untag(&service)?;
            for revision in revisions {
                store.untag(&format!("{service}:{}", revision.number))?;
            }
            Ok(())
        })
        .await
    }

    /// Makes the tags consistent with the database after a crash.
    pub async fn repair_tags(&self) -> Result<(), Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.images));
        blocking("repairing the image store", move || {
            let tagged = store.tags()?;
            // Every change of a tag rewrites the index, which delays the start for all robots.
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
                if let Some(current) = state.current_revision(&service)? {
                    keep(&service, &current.image)?;
                }
                wanted.insert(service);
            }
            for underlay in state.underlays()? {
                let name = tag_name(&underlay.name);
                keep(&name, &underlay.image)?;
                wanted.insert(name);
            }
            for tag in tagged.keys().filter(|tag| !wanted.contains(*tag)) {
                store.untag(tag)?;
            }
            Ok(())
        })
        .await
    }

    /// Removes images that have no tag and are not in `keep`. A failure is only logged.
    pub async fn collect_garbage(&self, keep: BTreeSet<Digest>) {
        let store = Arc::clone(&self.images);
        match blocking("collecting garbage", move || Ok(store.gc(&keep)?)).await {
            Ok(swept) if swept.blobs + swept.trees + swept.leftovers > 0 => {
                tracing::info!("removed {} unused blobs and {} unused trees", swept.blobs, swept.trees);
            }
            Ok(_) => {}
            Err(error) => tracing::warn!("cannot collect garbage: {error}"),
        }
    }
}

/// A tag that cannot be set because its image is missing is logged; it does not prevent the daemon from starting.
fn tag(store: &Store, service: &str, number: u64, image: &str) -> Result<(), Error> {
    set_tag(store, &format!("{service}:{number}"), image)
}

fn tag_current(store: &Store, service: &str, image: &str) -> Result<(), Error> {
    set_tag(store, service, image)
}

pub(crate) fn set_tag(store: &Store, name: &str, image: &str) -> Result<(), Error> {
    match store.tag(name, &digest(image)?) {
        Err(error @ image::Error::UnknownImage { .. }) => {
            tracing::error!("{name} cannot be served: {error}");
            Ok(())
        }
        outcome => Ok(outcome?),
    }
}
