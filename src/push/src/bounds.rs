//! Limits of one push: how many run at a time, how long it takes, and the bytes of its files.
//!
//! Memory, processes and cores of its containers are limits of their cgroups. Files have no such thing where file
//! systems are mounted without quotas, so the directory of the build is measured, often enough that a build which
//! writes without end is ended long before the disk is full.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use api::Size;
use foreign::Visit;
use nix::sys::statvfs::statvfs;
use package::interface::Interface;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, MissedTickBehavior};

use super::request::Tell;
use crate::Error;
use crate::Options;

/// How often it is looked whether the file system fills.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// How often a build is measured although the file system does not fill: somebody else may be making room in it.
const MEASURE_EVERY: Duration = Duration::from_secs(10);
/// Bytes that each file counts at least, for its inode, name and block.
const LEAST: u64 = 4 << 10;

/// Bytes of a topic's, service's, action's or parameter's name.
const LONGEST_NAME: usize = 1024;
/// Of those together.
const MOST_NAMES: usize = 20_000;

/// Limits the number of pushes that are built at a time and that wait.
pub(super) struct Places {
    free: Arc<Semaphore>,
    waiting: AtomicUsize,
    at_once: usize,
    queue: usize,
}

impl Places {
    pub(super) fn new(options: &Options) -> Places {
        Places {
            free: Arc::new(Semaphore::new(options.at_once)),
            waiting: AtomicUsize::new(0),
            at_once: options.at_once,
            queue: options.queue,
        }
    }

    /// Waits for a place; it is given back when what this gives is dropped.
    pub(super) async fn take(&self, tell: &Tell) -> Result<OwnedSemaphorePermit, Error> {
        if let Ok(place) = Arc::clone(&self.free).try_acquire_owned() {
            return Ok(place);
        }
        let waiting = Waiting::among(&self.waiting);
        if waiting.before >= self.queue {
            return Err(Error::Failed {
                message: format!(
                    "{} pushes are being built, and {} wait already",
                    self.at_once, waiting.before
                ),
                next: Some(
                    "push again later, or raise at_once or queue in [push] of the configuration"
                        .to_owned(),
                ),
                log: Vec::new(),
            });
        }
        tell.step(&format!(
            "waiting: {} pushes are being built, and {} wait before this one",
            self.at_once, waiting.before
        ))
        .await;
        let place = Arc::clone(&self.free).acquire_owned().await;
        place.map_err(|_| Error::Ending)
    }
}

/// One that waits, counted until it is dropped.
struct Waiting<'a> {
    count: &'a AtomicUsize,
    before: usize,
}

impl Waiting<'_> {
    fn among(count: &AtomicUsize) -> Waiting<'_> {
        let before = count.fetch_add(1, Ordering::Relaxed);
        Waiting { count, before }
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.count.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Returns when the push that works in `directory` has exceeded a limit, with the error for its client.
pub(super) async fn exceeded(options: &Options, directory: &Path) -> Error {
    let (what, next) = tokio::select! {
        () = tokio::time::sleep(options.time) => (
            format!("it took longer than {} s", options.time.as_secs()),
            "push only what is needed, or raise time in [push] of the configuration",
        ),
        what = overfull(options.disk, directory) => (
            what,
            "push only what is needed, or raise disk in [push] of the configuration",
        ),
    };
    Error::Failed {
        message: format!("the push was ended: {what}"),
        next: Some(next.to_owned()),
        log: Vec::new(),
    }
}

/// Returns when the files of a build exceed their limit, with the reason.
async fn overfull(most: Size, directory: &Path) -> String {
    let mut ticks = tokio::time::interval(LOOK_EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut known = None;
    loop {
        ticks.tick().await;
        let taken = taken(directory);
        if let Some((at, size, then)) = known
            && Instant::now() < at + MEASURE_EVERY
            && size + taken.saturating_sub(then) <= most.0
        {
            // All that the build can have written since shows in the file system's use.
            continue;
        }
        let measured = directory.to_owned();
        // Cancelled with the push.
        match rootfs_builder::blocking::spawn(move || measure(measured, most.0)).await {
            Ok(Ok(size)) if size > most.0 => {
                return format!("its files take more than the {most} that a push may have");
            }
            Ok(Ok(size)) => known = Some((Instant::now(), size, taken)),
            Ok(Err(error @ foreign::Error::TooDeep { .. })) => return error.to_string(),
            // It is being made or removed, or changes faster than it can be looked at.
            Ok(Err(_)) | Err(_) => {}
        }
    }
}

/// Refuses an interface that no robot could use: it is what strangers' nodes registered, and goes into the database, to
/// every client and into stubs.
pub(super) fn check_interface(interface: &Interface) -> Result<(), Error> {
    let topics = interface.topics.iter().map(|topic| &topic.name);
    let services = interface.services.iter().map(|service| &service.name);
    let actions = interface.actions.iter().map(|action| &action.name);
    let parameters = interface.parameters.iter().map(|parameter| &parameter.name);
    let names = topics.chain(services).chain(actions).chain(parameters);
    let refused = |message: String| {
        Err(Error::Failed {
            message,
            next: Some("look at what the nodes register".to_owned()),
            log: Vec::new(),
        })
    };
    let mut count = 0;
    for name in names {
        count += 1;
        if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            return refused(format!(
                "the interface has a name that is not valid: {:?}",
                name.chars().take(100).collect::<String>()
            ));
        }
    }
    if count > MOST_NAMES {
        return refused(format!(
            "the interface has {count} topics, services, actions and parameters, and {MOST_NAMES} are allowed at most"
        ));
    }
    Ok(())
}

/// Bytes in use on the file system of a directory.
fn taken(directory: &Path) -> u64 {
    let above = directory.parent().unwrap_or(directory);
    statvfs(above).map_or(0, |about| {
        let blocks = about.blocks().saturating_sub(about.blocks_free());
        blocks.saturating_mul(about.fragment_size())
    })
}

/// Bytes that the files of a directory take, or would take if they had no holes: a layer has none. Counts no further
/// than a little beyond `most`.
fn measure(directory: PathBuf, most: u64) -> Result<u64, foreign::Error> {
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
            total = total.saturating_add(blocks.max(size).max(LEAST));
        }
        let enough = total > most;
        Ok::<_, foreign::Error>(if enough { Visit::Skip } else { Visit::Into })
    })?;
    Ok(total)
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;

    use super::*;

    fn options() -> Options {
        Options {
            at_once: 1,
            queue: 1,
            disk: Size(1 << 20),
            ..Options::wide()
        }
    }

    fn words(error: Error) -> String {
        let Error::Failed { message, next, .. } = error else {
            panic!("it failed");
        };
        format!("{message}; {}", next.unwrap_or_default())
    }

    #[tokio::test]
    async fn pushes_take_turns_and_no_more_wait_than_may() {
        let places = Arc::new(Places::new(&options()));
        let (sender, mut told) = mpsc::channel(16);
        let tell = Tell(sender);
        let first = places.take(&tell).await.expect("free");
        let (again, tell_again) = (Arc::clone(&places), tell.clone());
        let second = tokio::spawn(async move { again.take(&tell_again).await });
        let Some(api::PushEvent::Step { title }) = told.recv().await else {
            panic!("nothing was told");
        };
        assert!(title.contains("1 pushes are being built"), "{title}");
        let refused = words(places.take(&tell).await.expect_err("the queue is full"));
        assert!(
            refused.contains("1 wait already") && refused.contains("at_once"),
            "{refused}"
        );
        drop(first);
        let second = second.await.expect("no panic").expect("its turn");
        drop(second);
        drop(places.take(&tell).await.expect("free again"));
    }

    #[tokio::test]
    async fn a_build_that_writes_too_much_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("push-1");
        let options = options();
        let exceeded = exceeded(&options, &directory);
        let written = directory.clone();
        tokio::task::spawn_blocking(move || {
            std::fs::create_dir_all(written.join("upper")).expect("made");
            // A hole, which becomes as large as it says when it is packed and extracted.
            let file = std::fs::File::create(written.join("upper/sparse")).expect("made");
            file.set_len(2 << 20).expect("set");
        })
        .await
        .expect("no panic");
        let told = words(exceeded.await);
        assert!(told.contains("1M") && told.contains("raise disk"), "{told}");
    }

    #[tokio::test]
    async fn a_build_that_nests_without_end_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("push-1");
        std::fs::create_dir_all(directory.join(vec!["d"; 300].join("/"))).expect("made");
        let options = Options {
            disk: Size(1 << 30),
            ..options()
        };
        let told = words(exceeded(&options, &directory).await);
        assert!(told.contains("directories deep"), "{told}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_push_that_takes_too_long_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let told = words(exceeded(&options(), &place.path().join("none")).await);
        assert!(
            told.contains("longer than 7200 s") && told.contains("raise time"),
            "{told}"
        );
    }

    #[test]
    fn an_interface_of_impossible_names_is_refused() {
        let topic = |name: &str| package::interface::Topic {
            name: name.into(),
            type_name: "p/T".into(),
            md5: String::new(),
            direction: package::interface::Direction::Output,
            nodes: Vec::new(),
            latched: false,
            lazy: false,
        };
        let interface = |topics| Interface {
            topics,
            ..Interface::default()
        };
        check_interface(&interface(vec![topic("/a"), topic("/b/c")])).expect("possible");
        for bad in ["/a\x1b[2J", &"/a".repeat(1000)] {
            let refused = words(check_interface(&interface(vec![topic(bad)])).expect_err(bad));
            assert!(refused.contains("not valid"), "{refused}");
        }
        let many = (0..=MOST_NAMES).map(|number| topic(&format!("/t{number}")));
        let refused = check_interface(&interface(many.collect())).expect_err("too many");
        assert!(words(refused).contains("20001"));
    }

    #[test]
    fn many_small_files_and_links_of_one_are_counted_for_what_they_are() {
        let place = tempfile::tempdir().expect("a directory");
        for number in 0..10 {
            std::fs::write(place.path().join(number.to_string()), "").expect("written");
        }
        let before = measure(place.path().to_owned(), u64::MAX).expect("measured");
        assert!(before >= 11 * LEAST, "{before}");
        let first = place.path().join("0");
        std::fs::write(&first, vec![1; 1 << 20]).expect("written");
        for number in 0..10 {
            std::fs::hard_link(&first, place.path().join(format!("again-{number}")))
                .expect("linked");
        }
        let after = measure(place.path().to_owned(), u64::MAX).expect("measured");
        let grown = after - before;
        assert!(((1 << 20) - LEAST..2 << 20).contains(&grown), "{grown}");
    }
}
