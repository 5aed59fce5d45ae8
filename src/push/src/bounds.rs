//! Limits of one push: how many run at a time, how long it takes, and the bytes of its files.
//!
//! Memory, processes and cores of its containers are limits of their cgroups. Files have no such thing where file
//! systems are mounted without quotas, so the directory of the build is measured, often enough that a build which
//! writes without end is ended long before the disk is full.

use std::collections::{HashMap, HashSet};
use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use api::Size;
use foreign::Visit;
use nix::sys::statvfs::statvfs;
use package::interface::Interface;
use parking_lot::Mutex;
use tokio::sync::{OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};
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

/// Limits the number of pushes that are built at a time and that wait, and lets those of one service follow one
/// another.
///
/// Whoever has a place never waits for a turn, so that a place is always given back: a push that learns only from what
/// it has built which service it is of gives its place back while it waits.
pub(super) struct Places {
    free: Arc<Semaphore>,
    turns: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
    waiting: AtomicUsize,
    at_once: usize,
    queue: usize,
}

/// The right to change a service, until it is dropped.
pub(super) type Turn = OwnedMutexGuard<()>;

/// A push's place, and its turn once its service is known. Both are given back when this is dropped.
pub(super) struct Admitted<'a> {
    places: &'a Places,
    turn: Option<(String, Turn)>,
    place: Option<OwnedSemaphorePermit>,
}

impl Places {
    pub(super) fn new(options: &Options) -> Places {
        Places {
            free: Arc::new(Semaphore::new(options.at_once)),
            turns: Mutex::default(),
            waiting: AtomicUsize::new(0),
            at_once: options.at_once,
            queue: options.queue,
        }
    }

    /// Waits for the turn of a service, where it is known, and then for a place.
    pub(super) async fn enter(
        &self,
        service: Option<&str>,
        tell: &Tell,
    ) -> Result<Admitted<'_>, Error> {
        let mut waiting = None;
        let turn = match service {
            None => None,
            Some(name) => {
                let turn = match self.turn_of(name).try_lock_owned() {
                    Ok(turn) => turn,
                    Err(_) => {
                        waiting = Some(self.wait()?);
                        self.turn_told(name, tell).await
                    }
                };
                Some((name.to_owned(), turn))
            }
        };
        let place = match Arc::clone(&self.free).try_acquire_owned() {
            Ok(place) => place,
            Err(_) => {
                let waiting = match waiting {
                    Some(waiting) => waiting,
                    None => self.wait()?,
                };
                self.place_told(&waiting, tell).await?
            }
        };
        Ok(Admitted {
            places: self,
            turn,
            place: Some(place),
        })
    }

    /// Waits for the turn of a service, without a place.
    pub(super) async fn turn(&self, service: &str) -> Turn {
        self.turn_of(service).lock_owned().await
    }

    fn turn_of(&self, service: &str) -> Arc<tokio::sync::Mutex<()>> {
        let mut turns = self.turns.lock();
        turns.retain(|_, turn| Arc::strong_count(turn) > 1);
        Arc::clone(turns.entry(service.to_owned()).or_default())
    }

    async fn turn_told(&self, service: &str, tell: &Tell) -> Turn {
        tell.step(&format!(
            "waiting: {service} is being pushed or changed already"
        ))
        .await;
        self.turn(service).await
    }

    async fn place_told(
        &self,
        waiting: &Waiting<'_>,
        tell: &Tell,
    ) -> Result<OwnedSemaphorePermit, Error> {
        tell.step(&format!(
            "waiting: {} pushes are being built, and {} wait before this one",
            self.at_once, waiting.before
        ))
        .await;
        let place = Arc::clone(&self.free).acquire_owned().await;
        place.map_err(|_| Error::Ending)
    }

    /// Counts as waiting, if another may.
    fn wait(&self) -> Result<Waiting<'_>, Error> {
        let waiting = Waiting::among(&self.waiting);
        if waiting.before >= self.queue {
            return Err(Error::Failed {
                message: format!(
                    "{} pushes are being built, and {} wait already",
                    self.at_once, waiting.before
                ),
                next: Some(
                    "push again later, or raise at_once or queue in [push] of the optionsuration"
                        .to_owned(),
                ),
                log: Vec::new(),
            });
        }
        Ok(waiting)
    }
}

impl Admitted<'_> {
    /// Takes the turn of the service, which may be known only now: then the place is given back while another push of
    /// it is built, and taken again. That is never refused, since the work is done.
    pub(super) async fn named(&mut self, service: &str, tell: &Tell) -> Result<(), Error> {
        if self.turn.as_ref().is_some_and(|(name, _)| name == service) {
            return Ok(());
        }
        // Of another name that the package goes by.
        self.turn = None;
        let turn = match self.places.turn_of(service).try_lock_owned() {
            Ok(turn) => turn,
            Err(_) => {
                let waiting = Waiting::among(&self.places.waiting);
                self.place = None;
                let turn = self.places.turn_told(service, tell).await;
                self.place = Some(self.places.place_told(&waiting, tell).await?);
                turn
            }
        };
        self.turn = Some((service.to_owned(), turn));
        Ok(())
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

/// What a push may still use. Waiting does not count.
pub(super) struct Left<'a> {
    options: &'a Options,
    directory: PathBuf,
    time: Duration,
}

impl Left<'_> {
    /// Of a push that works in `directory`.
    pub(super) fn new(options: &Options, directory: PathBuf) -> Left<'_> {
        Left {
            options,
            directory,
            time: options.time,
        }
    }

    /// Does a part of the push, within what is left; ended where that is exceeded.
    pub(super) async fn during<T>(
        &mut self,
        work: impl Future<Output = Result<T, Error>>,
    ) -> Result<T, Error> {
        let began = Instant::now();
        let outcome = tokio::select! {
            outcome = work => outcome,
            error = exceeded(self.options, self.time, &self.directory) => Err(error),
        };
        self.time = self.time.saturating_sub(began.elapsed());
        outcome
    }
}

/// Returns when the push that works in `directory` has exceeded a limit, with the error for its client. `time`: what is
/// left of the limit.
async fn exceeded(options: &Options, time: Duration, directory: &Path) -> Error {
    let (what, next) = tokio::select! {
        () = tokio::time::sleep(time) => (
            format!("it took longer than {} s", options.time.as_secs()),
            "push only what is needed, or raise time in [push] of the optionsuration",
        ),
        what = overfull(options.disk, directory) => (
            what,
            "push only what is needed, or raise disk in [push] of the optionsuration",
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
        let first = places.enter(None, &tell).await.expect("free");
        let (again, tell_again) = (Arc::clone(&places), tell.clone());
        let second = tokio::spawn(async move { again.enter(None, &tell_again).await.map(drop) });
        let Some(api::PushEvent::Step { title }) = told.recv().await else {
            panic!("nothing was told");
        };
        assert!(title.contains("1 pushes are being built"), "{title}");
        let refused = places.enter(None, &tell).await.map(drop);
        let refused = words(refused.expect_err("the queue is full"));
        assert!(
            refused.contains("1 wait already") && refused.contains("at_once"),
            "{refused}"
        );
        drop(first);
        second.await.expect("no panic").expect("its turn");
        drop(places.enter(None, &tell).await.expect("free again"));
    }

    #[tokio::test]
    async fn who_waits_for_a_service_holds_no_place() {
        let options = Options {
            at_once: 2,
            queue: 2,
            ..options()
        };
        let places = Arc::new(Places::new(&options));
        let (sender, mut told) = mpsc::channel(16);
        let tell = Tell(sender);
        let first = places.enter(Some("a"), &tell).await.expect("free");
        let (again, tell_again) = (Arc::clone(&places), tell.clone());
        let named = tokio::spawn(async move {
            let second = again.enter(Some("a"), &tell_again).await;
            second.map(drop)
        });
        let waits = |event| match event {
            Some(api::PushEvent::Step { title }) => {
                assert!(title.contains("a is being pushed"), "{title}");
            }
            other => panic!("{other:?}"),
        };
        waits(told.recv().await);
        // One that is told its service when it is built.
        let (again, tell_again) = (Arc::clone(&places), tell.clone());
        let unnamed = tokio::spawn(async move {
            let mut second = again.enter(None, &tell_again).await?;
            second.named("a", &tell_again).await
        });
        waits(told.recv().await);
        // Two wait, and there is a place for a third.
        let other = places.enter(Some("b"), &tell).await.expect("a place");
        drop((first, other));
        for waiting in [named, unnamed] {
            waiting.await.expect("no panic").expect("its turn");
        }
    }

    #[tokio::test]
    async fn a_build_that_writes_too_much_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let directory = place.path().join("push-1");
        let options = options();
        let exceeded = exceeded(&options, options.time, &directory);
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
        let told = words(exceeded(&options, options.time, &directory).await);
        assert!(told.contains("directories deep"), "{told}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_push_that_takes_too_long_is_told_so() {
        let place = tempfile::tempdir().expect("a directory");
        let told = words(exceeded(&options(), options().time, &place.path().join("none")).await);
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
