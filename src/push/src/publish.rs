//! Publishing, rolling back and removing services: the catalogue does it, servants and warm containers follow.

use std::sync::Arc;

use api::rollout::RolloutTerms;
use catalogue::RolledBack;
use package::inventory::Inventory;
use store::{NewEvent, RevisionRecord};

use super::Pusher;
use crate::Error;

impl Pusher {
    /// Publishes the revision on these terms, and has a warm container made of it.
    pub(super) async fn publish(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
        terms: Option<RolloutTerms>,
    ) -> Result<u64, Error> {
        let service = record.service.clone();
        let before = match self.catalogue.package(&service)? {
            Some(_) => Some(self.catalogue.current(&service)?.number),
            None => None,
        };
        let terms = terms.filter(|_| before.is_some());
        let beside = terms.is_some_and(|terms| terms.canary.is_some());
        if beside {
            self.choreographer.check_canary(&record)?;
        }
        let published = match beside {
            true => self.catalogue.publish_beside(record, inventory).await,
            false => self.catalogue.publish(record, inventory).await,
        };
        self.choreographer.refill_warm_pool();
        let number = published?;
        match terms {
            Some(terms) => {
                let choreographer = &self.choreographer;
                choreographer
                    .begin_rollout(&service, before, number, terms)
                    .await?;
            }
            None => {
                let choreographer = &self.choreographer;
                choreographer.revision_changed(&service, number).await?;
            }
        }
        Ok(number)
    }

    /// Makes an earlier revision the current one.
    pub async fn rollback(&self, name: &str, wanted: Option<u64>) -> Result<u64, Error> {
        let _turn = self.places.turn(name).await;
        let RolledBack { from, to } = self.catalogue.rollback(name, wanted).await?;
        self.choreographer.refill_warm_pool();
        self.choreographer.revision_changed(name, to).await?;
        let about = NewEvent {
            service: Some(name),
            ..NewEvent::default()
        };
        let message = format!("{name} was set from revision {from} to revision {to}");
        self.journal.info("rolled-back", &message, &about);
        Ok(to)
    }

    /// Removes a service, its servants and its images; gives the servants' ids.
    pub async fn remove(&self, name: &str) -> Result<Vec<String>, Error> {
        let _turn = self.places.turn(name).await;
        let withdrawn = self.catalogue.withdraw(name)?;
        let stopped = self
            .choreographer
            .stop("its service was removed", |handle| handle.service() == name)
            .await;
        self.choreographer.forget_rollout(name).await;
        self.choreographer.end_stale_warm().await?;
        self.catalogue.untag(withdrawn).await?;
        self.collect_garbage().await;
        let about = NewEvent {
            service: Some(name),
            ..NewEvent::default()
        };
        self.journal
            .info("removed", &format!("{name} was removed"), &about);
        Ok(stopped)
    }

    /// Removes what of the image store nothing needs. A failure is logged alone.
    pub async fn collect_garbage(&self) {
        let builder = Arc::clone(&self.builder);
        let mut keep = privilege::blocking(move || builder.keep())
            .await
            .unwrap_or_default();
        let in_use = self.choreographer.images_in_use();
        keep.extend(
            in_use
                .iter()
                .filter_map(|image| image.parse::<image::Digest>().ok()),
        );
        self.catalogue.collect_garbage(keep).await;
    }
}
