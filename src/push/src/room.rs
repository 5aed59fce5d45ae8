//! Room for what pushes leave behind: free space of the disks that they write to, and bytes of the images of one deployer.

use std::path::{Path, PathBuf};
use std::time::Duration;

use api::Size;
use nix::sys::statvfs::statvfs;
use tokio::time::MissedTickBehavior;

use crate::{Error, Pusher};

/// How often it is looked how much is free.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Of a small disk as much as this part of it stays free.
const PART: u64 = 20;

/// The disks that pushes write to: that of the state directory, and that of the cache of builds.
#[derive(Debug, Clone)]
pub(super) struct Disks {
    directories: Vec<PathBuf>,
    free: Size,
}

impl Disks {
    /// With at least `free` bytes left on each, or a twentieth of it.
    pub(super) fn new(home: &Path, cache: &Path, free: Size) -> Self {
        Self {
            directories: vec![home.to_owned(), cache.to_owned()],
            free,
        }
    }

    /// Refuses a push where one of them has less left.
    pub(super) async fn check(&self) -> Result<(), Error> {
        let disks = self.clone();
        let lacking = privilege::blocking(move || disks.lacking())
            .await
            .map_err(|_| Error::Internal("looking at the disks"))?;
        lacking.map_or(Ok(()), |what| Err(refused(what)))
    }

    /// Returns when one of them has less left, with the error of the push that is ended.
    pub(super) async fn low(&self) -> Error {
        let mut ticks = tokio::time::interval(LOOK_EVERY);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if let Err(error) = self.check().await {
                return error;
            }
        }
    }

    /// What is said of the first that has less left.
    fn lacking(&self) -> Option<String> {
        self.directories.iter().find_map(|directory| {
            let about = statvfs(directory).ok()?;
            let size = about.blocks().saturating_mul(about.fragment_size());
            let left = about
                .blocks_available()
                .saturating_mul(about.fragment_size());
            let needed = self.free.0.min(size / PART);
            (left < needed).then(|| {
                format!(
                    "there is no space for a push: {} bytes are free on the disk of {}, and {needed} are to stay free",
                    left,
                    directory.display()
                )
            })
        })
    }
}

fn refused(message: String) -> Error {
    Error::Failed {
        message,
        next: Some(
            "remove services that nobody needs (cloudroidctl rm NAME), have an operator make room there, or lower free or cache in [push] of \
             the configuration"
                .to_owned(),
        ),
        log: Vec::new(),
    }
}

impl Pusher {
    /// Refuses a push of a deployer whose images, with `image` if that is made already, take more than one may have. Operators are not
    /// bounded. What is pushed at the same time is not counted yet.
    pub(super) async fn check_quota(
        &self,
        owner: Option<&str>,
        image: Option<&str>,
    ) -> Result<(), Error> {
        let most = self.options.per_deployer;
        let Some(owner) = owner.filter(|_| most.0 > 0) else {
            return Ok(());
        };
        let taken = self.catalogue.bytes_of(owner, image).await?;
        within_quota(owner, taken, most)
    }
}

fn within_quota(owner: &str, taken: u64, most: Size) -> Result<(), Error> {
    if taken <= most.0 {
        return Ok(());
    }
    Err(Error::Failed {
        message: format!(
            "the images of all services of {owner} would take {} MB, and a deployer's may take {most}",
            taken >> 20
        ),
        next: Some(
            "remove services that are not needed, with all their revisions (cloudroidctl rm NAME), or have an operator raise per_deployer \
             in [push] of the configuration"
                .to_owned(),
        ),
        log: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_disk_with_less_left_than_is_to_stay_free_takes_no_push() {
        let place = tempfile::tempdir().expect("a directory");
        let about = statvfs(place.path()).expect("a disk");
        let size = about.blocks() * about.fragment_size();
        let left = about.blocks_available() * about.fragment_size();
        let disks = |free| Disks::new(place.path(), place.path(), Size(free));
        disks(0).check().await.expect("nothing is to stay free");
        // More than a twentieth is asked of no disk.
        let full = left < size / PART;
        assert_eq!(disks(u64::MAX).check().await.is_err(), full);
        assert!(!full, "this test needs a disk of which a twentieth is free");
        // Of a disk that is not there nothing is known.
        let nowhere = place.path().join("nowhere");
        let disks = Disks::new(&nowhere, &nowhere, Size(u64::MAX));
        disks.check().await.expect("not known");
    }

    #[test]
    fn a_disk_that_fills_is_named_with_what_is_left() {
        let place = tempfile::tempdir().expect("a directory");
        let small = place.path().join("small");
        std::fs::create_dir(&small).expect("made");
        let said = std::thread::scope(|scope| {
            let apart = scope.spawn(|| {
                use nix::mount::{MsFlags, mount};
                use nix::sched::{CloneFlags, unshare};
                unshare(CloneFlags::CLONE_NEWNS).expect("a mount namespace; run this test as root");
                let flags = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
                mount(None::<&str>, "/", None::<&str>, flags, None::<&str>).expect("private");
                let (kind, size) = (Some("tmpfs"), Some("size=4M"));
                mount(kind, &small, kind, MsFlags::empty(), size).expect("mounted");
                let disks = Disks::new(place.path(), &small, Size(1 << 30));
                let before = disks.lacking();
                std::fs::write(small.join("filler"), vec![1; 3900 << 10]).expect("written");
                (before, disks.lacking())
            });
            apart.join().expect("no panic")
        });
        assert_eq!(said.0, None);
        let lacking = said.1.expect("it is full");
        assert!(
            lacking.contains("no space") && lacking.contains("small"),
            "{lacking}"
        );
        assert!(
            lacking.contains(&format!("{} are to stay free", (4 << 20) / PART)),
            "{lacking}"
        );
        let words = refused(lacking).words();
        assert!(words.contains("lower free or cache"), "{words}");
    }

    #[test]
    fn a_deployers_images_take_no_more_than_allowed() {
        let most = Size(1 << 30);
        within_quota("ann", 1 << 30, most).expect("just as much");
        let refused = within_quota("ann", (1 << 30) + 1, most)
            .expect_err("more")
            .words();
        for part in ["ann", "1024 MB", "1G", "rm NAME", "per_deployer"] {
            assert!(refused.contains(part), "{part}: {refused}");
        }
    }
}
