//! What is published: making a revision the current one, going back to an earlier one, taking a service away, and
//! keeping image store and database of one mind. The database decides; tags follow it.

use std::collections::BTreeSet;
use std::sync::Arc;

use image::Store;

use super::{Pusher, blocking};
use crate::errors::Error;
use crate::views;
use store::{NewEvent, RevisionRecord};

impl Pusher {
    /// Writes the revision; from here on it is what new servants are started from.
    pub(super) async fn publish(&self, record: RevisionRecord) -> Result<u64, Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.store));
        let published = blocking("publishing", move || {
            let number = state.publish(&record)?;
            // A crash before these is mended at the next start.
            tag(&store, &record.service, number, &record.image)?;
            tag_current(&store, &record.service, &record.image)?;
            Ok(number)
        })
        .await;
        self.choreographer.look_at_spares();
        published
    }

    /// Makes an earlier revision the current one.
    pub async fn rollback(&self, name: &str, wanted: Option<u64>) -> Result<u64, Error> {
        let _turn = self.turn(name).await;
        let current = views::current(&self.state, name)?;
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
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.store));
        let number = target.number;
        blocking("rolling back", move || {
            state.set_current(&target.service, target.number)?;
            tag_current(&store, &target.service, &target.image)
        })
        .await?;
        self.choreographer.look_at_spares();
        let about = NewEvent {
            service: Some(name),
            ..NewEvent::default()
        };
        let message = format!(
            "{name} was set from revision {} to revision {number}",
            current.number
        );
        self.journal.info("rolled-back", &message, &about);
        Ok(number)
    }

    /// Removes a service, its servants and its images; gives the servants' ids.
    pub async fn remove(&self, name: &str) -> Result<Vec<String>, Error> {
        let _turn = self.turn(name).await;
        let revisions = self.state.revisions(name)?;
        self.state.remove_service(name)?;
        let stopped = self
            .choreographer
            .stop("its service was removed", |handle| handle.service() == name)
            .await;
        self.choreographer.end_stale_spares().await?;
        let (store, service) = (Arc::clone(&self.store), name.to_owned());
        blocking("removing a service", move || {
            store.untag(&service)?;
            for revision in revisions {
                store.untag(&format!("{service}:{}", revision.number))?;
            }
            Ok(())
        })
        .await?;
        self.collect_garbage().await;
        let about = NewEvent {
            service: Some(name),
            ..NewEvent::default()
        };
        self.journal
            .info("removed", &format!("{name} was removed"), &about);
        Ok(stopped)
    }

    /// Makes the tags say what the database says (a crash may have come between), then removes what nothing needs.
    pub async fn mend(&self) -> Result<(), Error> {
        let (state, store) = (Arc::clone(&self.state), Arc::clone(&self.store));
        blocking("mending the image store", move || {
            let mut wanted = BTreeSet::new();
            for revision in state.all_revisions()? {
                tag(&store, &revision.service, revision.number, &revision.image)?;
                wanted.insert(format!("{}:{}", revision.service, revision.number));
            }
            for service in state.service_names()? {
                if let Some(current) = state.current(&service)? {
                    tag_current(&store, &service, &current.image)?;
                }
                wanted.insert(service);
            }
            for tag in store
                .tags()?
                .into_keys()
                .filter(|tag| !wanted.contains(tag))
            {
                store.untag(&tag)?;
            }
            Ok(())
        })
        .await?;
        self.collect_garbage().await;
        Ok(())
    }

    pub(super) async fn collect_garbage(&self) {
        let mut keep = self.builder.keep();
        let in_use = self.choreographer.images_in_use();
        keep.extend(
            in_use
                .iter()
                .filter_map(|image| image.parse::<image::Digest>().ok()),
        );
        let store = Arc::clone(&self.store);
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
        if let Ok(revisions) = self.state.all_revisions() {
            let images = revisions
                .into_iter()
                .map(|revision| revision.image)
                .collect();
            self.choreographer.keep_definitions(&images);
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
    let digest = image.parse().map_err(|_| Error::UnknownImage {
        what: image.to_owned(),
    })?;
    match store.tag(name, &digest) {
        Err(error @ image::Error::UnknownImage { .. }) => {
            tracing::error!("{name} cannot be served: {error}");
            Ok(())
        }
        outcome => Ok(outcome?),
    }
}
