//! A quota for the images of each deployer.

use api::Size;

use crate::{Error, Pusher};

impl Pusher {
    /// Rejects a push of a deployer whose images exceed the quota, including `image` if it has been built. Operators
    /// have no quota. Concurrent pushes are not counted yet.
    pub(super) async fn check_quota(&self, owner: Option<&str>, image: Option<&str>) -> Result<(), Error> {
        let most = self.options.per_deployer;
        let Some(owner) = owner.filter(|_| most.0 > 0) else {
            return Ok(());
        };
        let taken = self.catalogue.owner_image_bytes(owner, image).await?;
        check_within_quota(owner, taken, most)
    }
}

fn check_within_quota(owner: &str, taken: u64, most: Size) -> Result<(), Error> {
    if taken <= most.0 {
        return Ok(());
    }
    Err(Error::Failed {
        message: format!(
            "the images of all services of {owner} would take {} MB; the limit per deployer is {most}",
            taken >> 20
        ),
        next: Some(
            "remove unused services with all their revisions (cloudroidctl rm NAME), or ask an operator to raise \
                per_deployer in [push] of the configuration"
                .to_owned(),
        ),
        log: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_deployers_images_take_no_more_than_allowed() {
        let most = Size(1 << 30);
        check_within_quota("ann", 1 << 30, most).expect("just as much");
        let refused = check_within_quota("ann", (1 << 30) + 1, most).expect_err("more").message_and_advice();
        for part in ["ann", "1024 MB", "1G", "rm NAME", "per_deployer"] {
            assert!(refused.contains(part), "{part}: {refused}");
        }
    }
}
