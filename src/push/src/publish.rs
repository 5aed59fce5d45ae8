//! Publishing, rolling back and removing services: the catalogue changes, then servants and warm containers follow.

use std::sync::Arc;

use api::rollout::{RolloutState, RolloutTerms};
use catalogue::RollbackResult;
use package::inventory::Inventory;
use store::{NewEvent, RevisionRecord};

use super::Pusher;
use super::reporter::Reporter;
use crate::Error;

impl Pusher {
    /// Returns the number of the current revision if it is the same as the pushed one. A push with rollout terms, or
    /// during a canary, is always published, since it shall move robots to its revision.
    pub(super) async fn find_unchanged(
        &self,
        record: &RevisionRecord,
        terms: Option<RolloutTerms>,
    ) -> Result<Option<u64>, Error> {
        let rollout = self.choreographer.rollout(&record.service);
        if terms.is_some() || rollout.is_ok_and(|rollout| rollout.state == RolloutState::Canary) {
            return Ok(None);
        }
        Ok(self.catalogue.find_unchanged(record).await?)
    }

    /// Publishes the revision on these terms and refills the warm pool. A failure after publication is only a warning,
    /// since the revision is published.
    pub(super) async fn publish_and_rollout(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
        terms: Option<RolloutTerms>,
        report: &Reporter,
    ) -> Result<(), Error> {
        let service = record.service.clone();
        let before = match self.catalogue.service_package(&service)? {
            Some(_) => Some(self.catalogue.current_revision(&service)?.number),
            None => None,
        };
        let terms = terms.filter(|_| before.is_some());
        let beside = terms.is_some_and(|terms| terms.canary.is_some());
        if beside {
            self.choreographer.check_canary(&record)?;
        }
        let published = if beside {
            self.catalogue.publish_inactive(record, inventory).await
        } else {
            self.catalogue.publish(record, inventory).await
        };
        self.choreographer.refill_warm_pool();
        let number = published?;
        let about = NewEvent { service: Some(&service), ..NewEvent::default() };
        let words = format!("{service} is published, revision {number}");
        self.journal.info("published", &words, &about);
        let choreographer = &self.choreographer;
        let followed = match terms {
            Some(terms) => choreographer.begin_rollout(&service, before, number, terms).await.map(|_| ()),
            None => choreographer.revision_changed(&service, number).await,
        };
        if let Err(error) = followed {
            report.try_warning(format!("{words}, but its servants were not updated: {error}"));
        }
        Ok(())
    }

    /// Makes an earlier revision the current one.
    pub async fn rollback(&self, name: &str, wanted: Option<u64>) -> Result<u64, Error> {
        let _turn = self.places.lock_service(name).await;
        let RollbackResult { from, to } = self.catalogue.rollback(name, wanted).await?;
        self.choreographer.refill_warm_pool();
        self.choreographer.revision_changed(name, to).await?;
        let about = NewEvent { service: Some(name), ..NewEvent::default() };
        let message = format!("{name} was changed from revision {from} to revision {to}");
        self.journal.info("rolled-back", &message, &about);
        Ok(to)
    }

    /// Removes a service, its servants and its images; returns the ids of the servants.
    pub async fn remove(&self, name: &str) -> Result<Vec<String>, Error> {
        let _turn = self.places.lock_service(name).await;
        let withdrawn = self.catalogue.withdraw(name)?;
        let stopped = self.choreographer.stop("its service was removed", |handle| handle.service() == name).await;
        self.choreographer.forget_rollout(name).await;
        self.choreographer.end_stale_warm().await?;
        self.catalogue.untag(withdrawn).await?;
        self.collect_garbage().await;
        let about = NewEvent { service: Some(name), ..NewEvent::default() };
        self.journal.info("removed", &format!("{name} was removed"), &about);
        Ok(stopped)
    }

    /// Removes unused images from the store. A failure is only logged.
    pub async fn collect_garbage(&self) {
        let builder = Arc::clone(&self.builder);
        let mut keep = privilege::spawn_blocking(move || builder.layers_to_keep()).await.unwrap_or_default();
        let in_use = self.choreographer.images_in_use();
        keep.extend(in_use.iter().filter_map(|image| image.parse::<image::Digest>().ok()));
        self.catalogue.collect_garbage(keep).await;
    }
}
