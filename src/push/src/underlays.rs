//! Underlays: which there are for whom, and their publication and removal.

use api::PushOptions;
use rootfs_builder::{BuiltUnderlay, UnderlayContents};
use store::{NewEvent, StandingService, UnderlayRecord};

use super::reporter::Reporter;
use super::{Deployer, Error, Pusher, UnderlayUse, api_layer};

/// Maximum number of services that are named.
const MAX_NAMED_SERVICES: usize = 10;

/// Returns the name under which pushes of an underlay are serialized; no service has it.
pub(super) fn lock_name(name: &str) -> String {
    format!("underlay {name}")
}

impl Pusher {
    /// Returns the underlays that a push names, with their contents.
    ///
    /// # Errors
    /// [`Error::UnknownUnderlay`], also for one that the deployer may not see.
    pub(super) fn find_underlays(
        &self,
        names: &[String],
        by: &Deployer,
    ) -> Result<Vec<(UnderlayRecord, UnderlayContents)>, Error> {
        let find = |name: &String| {
            let record = self.catalogue.underlay(name)?.filter(|record| can_stand_on(by, record));
            let Some(record) = record else {
                let exists = self.visible_underlays(by)?.into_iter().map(|record| record.name).collect();
                return Err(Error::UnknownUnderlay { name: name.clone(), exists });
            };
            let contents = read_contents(&record)?;
            Ok((record, contents))
        };
        names.iter().map(find).collect()
    }

    /// Checks whether the deployer may publish or remove an underlay of this name.
    pub(super) fn check_may_publish_underlay(&self, name: &str, by: &Deployer) -> Result<(), Error> {
        let existing = self.catalogue.underlay(name)?;
        let owner = existing.as_ref().map(|record| record.owner.as_deref());
        (by.may_use_underlay)(UnderlayUse::Publish, name, owner)
    }

    fn visible_underlays(&self, by: &Deployer) -> Result<Vec<UnderlayRecord>, Error> {
        let mut all = self.catalogue.underlays()?;
        all.retain(|record| can_stand_on(by, record));
        Ok(all)
    }

    /// Returns the underlays that the caller may see, with the services on them that it may see.
    pub async fn list_underlays(&self, by: &Deployer) -> Result<Vec<api::Underlay>, Error> {
        let mut listed = Vec::new();
        for record in self.visible_underlays(by)? {
            listed.push(self.describe_underlay(record, by).await?);
        }
        Ok(listed)
    }

    async fn describe_underlay(&self, record: UnderlayRecord, by: &Deployer) -> Result<api::Underlay, Error> {
        let bytes = self.catalogue.underlay_bytes(&record).await?;
        let contents = read_contents(&record)?;
        let mut standing = self.catalogue.services_on_underlays()?.remove(&record.name).unwrap_or_default();
        standing.retain(|one| (by.may_see)(&one.service));
        Ok(api::Underlay {
            name: record.name,
            revision: record.number,
            base: record.flavour.base.clone(),
            ros: record.flavour.ros.ros_version().number(),
            distribution: record.flavour.distribution.clone(),
            packages: contents.packages.into_keys().collect(),
            bytes: api::Size(bytes),
            published: record.published,
            source: record.source,
            services: standing
                .into_iter()
                .map(|StandingService { service, on }| api::StandingService { service, on })
                .collect(),
        })
    }

    /// Publishes an underlay; returns its layers, what it is now, and whether it is the same as before. Tells which
    /// services stand on an earlier revision.
    pub(super) async fn publish_underlay(
        &self,
        options: &PushOptions,
        built: BuiltUnderlay,
        (by, report): (&Deployer, &Reporter),
    ) -> Result<(Vec<api::push::Layer>, api::Underlay, bool), Error> {
        let name = options.as_underlay.clone().unwrap_or(built.package);
        // Pushes of one underlay are serialized, so its owner does not change until this one is done.
        self.check_may_publish_underlay(&name, by)?;
        let image = built.image.to_string();
        self.check_quota(by.owner.as_deref(), Some(&image)).await?;
        let layers = built.layers.iter().map(api_layer).collect();
        let contents = serde_json::to_value(&built.contents)
            .map_err(|source| Error::UnderlayRecord { name: name.clone(), source })?;
        report.step(api::push::PUBLISHING).await;
        // From here on the push cannot be cancelled.
        report.publishing.cancel();
        if let Some(existing) = self.catalogue.underlay(&name)?
            && existing.contents == contents
            && existing.flavour == built.flavour
        {
            return Ok((layers, self.describe_underlay(existing, by).await?, true));
        }
        let mut record = UnderlayRecord {
            name: name.clone(),
            number: 0,
            image,
            published: store::now(),
            owner: by.owner.clone(),
            source: options.source.clone(),
            flavour: built.flavour,
            contents,
        };
        let number = self.catalogue.publish_underlay(record.clone()).await?;
        record.number = number;
        let words = format!("underlay {name} is published, revision {number}");
        self.journal.info("underlay-published", &words, &NewEvent::default());
        let standing = self.catalogue.services_on_underlays()?.remove(&name).unwrap_or_default();
        if let Some(services) = name_services(&standing, by) {
            report.try_warning(format!(
                "{services} stand on an earlier revision of {name}; push them again to build them on revision {number}"
            ));
        }
        Ok((layers, self.describe_underlay(record, by).await?, false))
    }

    /// Removes an underlay, unless services stand on it.
    ///
    /// # Errors
    /// [`Error::UnknownUnderlay`], [`Error::NotAllowed`], and [`Error::UnderlayInUse`].
    pub async fn remove_underlay(&self, name: &str, by: &Deployer) -> Result<api::Underlay, Error> {
        let _turn = self.places.lock_service(&lock_name(name)).await;
        // First, so that names beyond the caller's scope are not told apart.
        self.check_may_publish_underlay(name, by)?;
        let Some((record, _)) = self.find_underlays(&[name.to_owned()], by)?.pop() else {
            return Err(Error::Internal("removing an underlay"));
        };
        let standing = self.catalogue.services_on_underlays()?.remove(name).unwrap_or_default();
        if let Some(services) = name_services(&standing, by) {
            return Err(Error::UnderlayInUse { name: name.to_owned(), services });
        }
        let removed = self.describe_underlay(record, by).await?;
        self.catalogue.remove_underlay(name).await?;
        self.collect_garbage().await;
        self.journal.info("underlay-removed", &format!("underlay {name} was removed"), &NewEvent::default());
        Ok(removed)
    }
}

fn can_stand_on(by: &Deployer, record: &UnderlayRecord) -> bool {
    (by.may_use_underlay)(UnderlayUse::StandOn, &record.name, Some(record.owner.as_deref())).is_ok()
}

fn read_contents(record: &UnderlayRecord) -> Result<UnderlayContents, Error> {
    serde_json::from_value(record.contents.clone())
        .map_err(|source| Error::UnderlayRecord { name: record.name.clone(), source })
}

/// Names services with the revisions that they stand on, those of others only by their number; `None` without any.
fn name_services(standing: &[StandingService], by: &Deployer) -> Option<String> {
    let (known, others): (Vec<_>, Vec<_>) = standing.iter().partition(|one| (by.may_see)(&one.service));
    let mut names: Vec<String> =
        known.iter().take(MAX_NAMED_SERVICES).map(|one| format!("{} (on revision {})", one.service, one.on)).collect();
    let more = others.len() + known.len().saturating_sub(MAX_NAMED_SERVICES);
    if more > 0 {
        names.push(api::count(more as u64, "other service"));
    }
    (!names.is_empty()).then(|| names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn deployer() -> Deployer {
        Deployer {
            name: "ada".to_owned(),
            owner: None,
            may: Box::new(|_| Ok(())),
            may_see: Box::new(|name| name != "secret"),
            may_use_underlay: Box::new(|_, _, _| Ok(())),
            over: Box::new(|| Box::pin(std::future::pending())),
        }
    }

    #[test]
    fn services_of_others_are_counted_but_not_named() {
        let on = |service: &str| StandingService { service: service.to_owned(), on: 3 };
        assert_eq!(name_services(&[], &deployer()), None);
        let named = name_services(&[on("nav"), on("secret"), on("slam")], &deployer());
        assert_eq!(named.as_deref(), Some("nav (on revision 3), slam (on revision 3), 1 other service"));
        let many: Vec<StandingService> = (0..12).map(|number| on(&format!("s{number}"))).collect();
        assert!(name_services(&many, &deployer()).is_some_and(|text| text.ends_with(", 2 other services")));
    }
}
