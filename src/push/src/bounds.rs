//! Limits of one push: its duration and the disk space of its files.
//!
//! Memory, processes and cores of its containers are limited by their cgroups. There is no such limit for files on file
//! systems without quotas, so the build directory is measured, often enough that a build which writes without end is
//! stopped long before the disk is full.

use std::collections::HashSet;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::time::Duration;

use api::Size;
use foreign::Visit;
use nix::sys::statvfs::statvfs;
use rootfs_builder::blocking;
use tokio::time::{Instant, MissedTickBehavior};

use crate::disks::Disks;
use crate::{Error, Options};

/// Interval at which the usage of the file system is checked.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Maximum interval at which a build is measured even if the file system does not fill up, since others may be freeing
/// space in it.
const MEASURE_EVERY: Duration = Duration::from_secs(10);
/// Minimum size counted for each file, in bytes, for its inode, name and block.
const MIN_FILE_SIZE: u64 = 4 << 10;

/// Remaining time and disk space of a push. Time spent waiting does not count.
pub(super) struct PushBudget<'a> {
    options: &'a Options,
    directory: PathBuf,
    disks: &'a Disks,
    time: Duration,
}

impl<'a> PushBudget<'a> {
    /// Creates the budget of a push that works in `directory`.
    pub(super) fn new(options: &'a Options, directory: PathBuf, disks: &'a Disks) -> PushBudget<'a> {
        PushBudget { options, directory, disks, time: options.time }
    }

    /// Runs a part of the push within the remaining budget; cancels it if the budget is exceeded.
    pub(super) async fn run_within<T>(&mut self, work: impl Future<Output = Result<T, Error>>) -> Result<T, Error> {
        let began = Instant::now();
        let outcome = tokio::select! {
            outcome = work => outcome,
            error = wait_until_exceeded(self.options, self.time, &self.directory) => Err(error),
            error = self.disks.wait_until_low() => Err(error),
        };
        self.time = self.time.saturating_sub(began.elapsed());
        outcome
    }
}

/// Waits until the push that works in `directory` has exceeded a limit; returns the error for its client. `time` is the
/// remaining time.
async fn wait_until_exceeded(options: &Options, time: Duration, directory: &Path) -> Error {
    let (what, next) = tokio::select! {
        () = tokio::time::sleep(time) => (
            format!("it took longer than {} s", options.time.as_secs()),
            "push fewer files, or raise time in [push] of the configuration",
        ),
        what = wait_until_overfull(options.disk, directory) => (
            what,
            "push fewer files, or raise disk in [push] of the configuration",
        ),
    };
    Error::Failed { message: format!("the push was aborted: {what}"), next: Some(next.to_owned()), log: Vec::new() }
}

/// Waits until the files of a build exceed their limit; returns the reason.
async fn wait_until_overfull(most: Size, directory: &Path) -> String {
    let mut ticks = tokio::time::interval(LOOK_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut known = None;
    loop {
        ticks.tick().await;
        let of = directory.to_owned();
        let taken = privilege::spawn_blocking(move || used_bytes(&of)).await.unwrap_or(0);
        if let Some((at, size, then)) = known
            && Instant::now() < at + MEASURE_EVERY
            && size + taken.saturating_sub(then) <= most.0
        {
            // The usage of the file system bounds all that the build can have written since.
            continue;
        }
        let measured = directory.to_owned();
        // Cancelled with the push.
        let work = blocking::cancel_with_caller(move || measure_tree(measured, most.0));
        match privilege::spawn_blocking(work).await {
            Ok(Ok(size)) if size > most.0 => {
                return format!("its files exceed the limit of {most} per push");
            }
            Ok(Ok(size)) => known = Some((Instant::now(), size, taken)),
            Ok(Err(error @ foreign::Error::TooDeep { .. })) => return error.to_string(),
            // The directory is being created or removed, or changes faster than it can be walked.
            Ok(Err(_)) | Err(_) => {}
        }
    }
}

/// Returns the number of bytes in use on the file system of a directory.
fn used_bytes(directory: &Path) -> u64 {
    let above = directory.parent().unwrap_or(directory);
    statvfs(above).map_or(0, |about| {
        let blocks = about.blocks().saturating_sub(about.blocks_free());
        blocks.saturating_mul(about.fragment_size())
    })
}

/// Returns the size of the files of a directory without holes, as in a layer. Stops counting shortly after `most`.
fn measure_tree(directory: PathBuf, most: u64) -> Result<u64, foreign::Error> {
    let mut total = 0_u64;
    let mut counted = HashSet::new();
    foreign::walk_changing(&directory, |entry| {
        let stat = &entry.stat;
        let is_directory = entry.kind() == rustix::fs::FileType::Directory;
        if is_directory || stat.st_nlink < 2 || counted.insert((stat.st_dev, stat.st_ino)) {
            let blocks = u64::try_from(stat.st_blocks).unwrap_or(0) * 512;
            let size = match entry.kind() {
                rustix::fs::FileType::RegularFile => u64::try_from(stat.st_size).unwrap_or(0),
                _ => 0,
            };
            total = total.saturating_add(blocks.max(size).max(MIN_FILE_SIZE));
        }
        let enough = total > most;
        Ok::<_, foreign::Error>(if enough { Visit::Skip } else { Visit::Into })
    })?;
    Ok(total)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> Options {
        Options { disk: Size(1 << 20), ..Options::unlimited() }
    }

    #[tokio::test]
    async fn a_build_that_writes_too_much_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("push-1");
        let options = options();
        let exceeded = wait_until_exceeded(&options, options.time, &directory);
        let written = directory.clone();
        tokio::task::spawn_blocking(move || {
            std::fs::create_dir_all(written.join("upper")).expect("made");
            // A sparse file, which grows to its apparent size when it is packed and extracted.
            let file = std::fs::File::create(written.join("upper/sparse")).expect("made");
            file.set_len(2 << 20).expect("set");
        })
        .await
        .expect("no panic");
        let told = exceeded.await.message_and_advice();
        assert!(told.contains("1M") && told.contains("raise disk in [push] of the configuration"), "{told}");
    }

    #[tokio::test]
    async fn a_build_that_nests_without_end_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("push-1");
        std::fs::create_dir_all(directory.join(vec!["d"; 300].join("/"))).expect("made");
        let options = Options { disk: Size(1 << 30), ..options() };
        let told = wait_until_exceeded(&options, options.time, &directory).await.message_and_advice();
        assert!(told.contains("directories deep"), "{told}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_push_that_takes_too_long_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let told =
            wait_until_exceeded(&options(), options().time, &place.path().join("none")).await.message_and_advice();
        assert!(told.contains("longer than 7200 s") && told.contains("raise time"), "{told}");
    }

    #[test]
    fn many_small_files_and_links_of_one_are_counted_for_what_they_are() {
        let place = tempfile::tempdir().expect("a directory");
        for number in 0..10 {
            std::fs::write(place.path().join(number.to_string()), "").expect("written");
        }
        let before = measure_tree(place.path().to_owned(), u64::MAX).expect("measured");
        assert!(before >= 11 * MIN_FILE_SIZE, "{before}");
        let first = place.path().join("0");
        std::fs::write(&first, vec![1; 1 << 20]).expect("written");
        for number in 0..10 {
            std::fs::hard_link(&first, place.path().join(format!("again-{number}"))).expect("linked");
        }
        let after = measure_tree(place.path().to_owned(), u64::MAX).expect("measured");
        let grown = after - before;
        assert!(((1 << 20) - MIN_FILE_SIZE..2 << 20).contains(&grown), "{grown}");
    }
}
