//! Free space of the disks that pushes write to.

use std::path::{Path, PathBuf};
use std::time::Duration;

use api::Size;
use nix::sys::statvfs::statvfs;
use tokio::time::MissedTickBehavior;

use crate::Error;

/// Interval at which the free space is checked.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Divisor of the disk size: on small disks 1/20 of the size stays free.
const FREE_DIVISOR: u64 = 20;

/// The disks that pushes write to: those of the state directory and of the build cache.
#[derive(Debug, Clone)]
pub(super) struct Disks {
    directories: Vec<PathBuf>,
    free: Size,
}

impl Disks {
    /// Requires `free` bytes on each disk, or 1/20 of its size if that is less.
    pub(super) fn new(home: &Path, cache: &Path, free: Size) -> Self {
        Self { directories: vec![home.to_owned(), cache.to_owned()], free }
    }

    /// Rejects a push if one of the disks has less free space.
    pub(super) async fn check(&self) -> Result<(), Error> {
        let disks = self.clone();
        let lacking = privilege::spawn_blocking(move || disks.describe_shortage())
            .await
            .map_err(|_| Error::Internal("checking disk space"))?;
        lacking.map_or(Ok(()), |what| Err(no_space_error(what)))
    }

    /// Waits until one of the disks has less free space; returns the error for the push.
    pub(super) async fn wait_until_low(&self) -> Error {
        let mut ticks = tokio::time::interval(LOOK_EVERY);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if let Err(error) = self.check().await {
                return error;
            }
        }
    }

    /// Describes the first disk that has less free space.
    fn describe_shortage(&self) -> Option<String> {
        self.directories.iter().find_map(|directory| {
            let about = statvfs(directory).ok()?;
            let size = about.blocks().saturating_mul(about.fragment_size());
            let left = about.blocks_available().saturating_mul(about.fragment_size());
            let needed = self.free.0.min(size / FREE_DIVISOR);
            (left < needed).then(|| {
                format!(
                    "no space for a push: {} bytes are free on the disk of {}, and {needed} must stay free",
                    left,
                    directory.display()
                )
            })
        })
    }
}

fn no_space_error(message: String) -> Error {
    Error::Failed {
        message,
        next: Some(
            "remove unused services (cloudroidctl rm NAME), ask an operator to free space there, or lower free or \
                cache in [push] of the configuration"
                .to_owned(),
        ),
        log: Vec::new(),
    }
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
        // At most 1/20 of a disk is required.
        let full = left < size / FREE_DIVISOR;
        assert_eq!(disks(u64::MAX).check().await.is_err(), full);
        assert!(!full, "this test needs a disk of which a twentieth is free");
        // A disk that does not exist is not checked.
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
                let before = disks.describe_shortage();
                std::fs::write(small.join("filler"), vec![1; 3900 << 10]).expect("written");
                (before, disks.describe_shortage())
            });
            apart.join().expect("no panic")
        });
        assert_eq!(said.0, None);
        let lacking = said.1.expect("it is full");
        assert!(lacking.contains("no space") && lacking.contains("small"), "{lacking}");
        assert!(lacking.contains(&format!("{} must stay free", (4 << 20) / FREE_DIVISOR)), "{lacking}");
        let words = no_space_error(lacking).message_and_advice();
        assert!(words.contains("lower free or cache"), "{words}");
    }
}
