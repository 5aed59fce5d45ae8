//! Publishing, rolling back and removing services: the catalogue does it, servants and warm containers follow.

use std::sync::Arc;

use api::rollout::RolloutTerms;
use catalogue::RolledBack;
use package::inventory::Inventory;
use store::{NewEvent, RevisionRecord};

use super::Pusher;
use super::request::Reporter;
use crate::Error;

impl Pusher {
    /// Publishes the revision on these terms, and has a warm container made of it. What fails once it is published is a
    /// warning: then it is there.
    pub(super) async fn publish(
        &self,
        record: RevisionRecord,
        inventory: Inventory,
        terms: Option<RolloutTerms>,
        report: &Reporter,
    ) -> Result<(), Error> {
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
        let about = NewEvent {
            service: Some(&service),
            ..NewEvent::default()
        };
        let words = format!("{service} is published, revision {number}");
        self.journal.info("published", &words, &about);
        let choreographer = &self.choreographer;
        let followed = match terms {
            Some(terms) => choreographer
                .begin_rollout(&service, before, number, terms)
                .await
                .map(|_| ()),
            None => choreographer.revision_changed(&service, number).await,
        };
        if let Err(error) = followed {
            report.last_warning(format!("{words}, but its servants do not follow: {error}"));
        }
        Ok(())
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
