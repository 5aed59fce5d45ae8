//! Detection of pushes that change nothing: their revision is compared with the one that serves.

use std::sync::Arc;

use store::RevisionRecord;

use crate::inventory::digest;
use crate::{Catalogue, Error, blocking};

impl Catalogue {
    /// Returns the number of the current revision if publishing `record` would change nothing for robots: package,
    /// image, launch plan and interface are the same. When the sources were written, and from where they were pushed,
    /// does not count.
    pub async fn find_unchanged(&self, record: &RevisionRecord) -> Result<Option<u64>, Error> {
        let Some(current) = self.state.current_revision(&record.service)? else {
            return Ok(None);
        };
        if !has_same_settings(&current, record) {
            return Ok(None);
        }
        let store = Arc::clone(&self.images);
        let (serving, pushed) = (current.image.clone(), record.image.clone());
        let is_same = blocking("comparing images", move || have_same_content(&store, &serving, &pushed)).await?;
        Ok(is_same.then_some(current.number))
    }
}

fn has_same_settings(one: &RevisionRecord, other: &RevisionRecord) -> bool {
    one.package == other.package
        && one.flavour == other.flavour
        && one.plan == other.plan
        && one.interface == other.interface
}

/// Returns whether two images have the same content. An image that is missing is replaced by a push.
fn have_same_content(store: &image::Store, serving: &str, pushed: &str) -> Result<bool, Error> {
    let serving = match store.image(&digest(serving)?) {
        Err(image::Error::UnknownImage { .. }) => return Ok(false),
        serving => serving?,
    };
    let pushed = store.image(&digest(pushed)?)?;
    Ok(serving.spec.is_same_content(&pushed.spec))
}

#[cfg(test)]
mod tests {
    use image::{ImageSpec, Store};

    use super::*;

    fn record() -> RevisionRecord {
        RevisionRecord {
            service: "s".into(),
            number: 1,
            image: String::new(),
            published: 1,
            package: "p".into(),
            owner: None,
            source: "/p".into(),
            flavour: Default::default(),
            plan: store::Plan::default(),
            interface: Default::default(),
        }
    }

    #[test]
    fn settings_count_and_the_place_of_the_sources_does_not() {
        let (serving, mut pushed) = (record(), record());
        (pushed.number, pushed.published, pushed.source) = (0, 2, "/elsewhere/p".into());
        assert!(has_same_settings(&serving, &pushed));
        pushed.plan.limits.cpus = Some(1.0);
        assert!(!has_same_settings(&serving, &pushed));
    }

    #[test]
    fn an_image_of_older_sources_is_the_same_and_a_missing_one_is_not() {
        let place = tempfile::tempdir().expect("a directory");
        let store = Store::open(&place.path().join("images"), &place.path().join("layers")).expect("a store");
        let put = |created: u64, command: &str| {
            let spec = ImageSpec { created, cmd: vec![command.to_owned()], ..ImageSpec::default() };
            store.put_image(&spec).expect("an image").to_string()
        };
        let (older, newer, other) = (put(1, "a"), put(2, "a"), put(1, "b"));
        let same = |serving: &str, pushed: &str| have_same_content(&store, serving, pushed).expect("compared");
        assert!(same(&older, &newer) && same(&older, &older));
        assert!(!same(&older, &other));
        let missing = format!("sha256:{}", "0".repeat(64));
        assert!(!same(&missing, &newer));
    }
}
