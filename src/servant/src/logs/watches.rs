//! Notifies followers of logs of changes in a log's directory. All share one inotify instance: a user may have 128 on
//! the whole host (`fs.inotify.max_user_instances`), and other programs of root need theirs.

use std::collections::HashMap;
use std::io;
use std::os::fd::{AsFd, AsRawFd, RawFd};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify, WatchDescriptor};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::watch;
use tokio::task::AbortHandle;

/// Events that are watched in a directory.
const EVENTS: AddWatchFlags = AddWatchFlags::IN_MODIFY.union(AddWatchFlags::IN_CREATE).union(AddWatchFlags::IN_ONLYDIR);

/// The watched directories. The inotify instance exists while there are any.
#[derive(Debug, Default)]
pub struct DirectoryWatches {
    instance: Mutex<Weak<InotifyInstance>>,
}

/// Senders that notify of changes, by directory.
type Directories = Arc<Mutex<HashMap<WatchDescriptor, watch::Sender<()>>>>;

#[derive(Debug)]
struct InotifyInstance {
    inotify: Arc<AsyncFd<InotifyFd>>,
    directories: Directories,
    telling: AbortHandle,
}

/// Gives `Inotify` a raw descriptor, which nix's type lacks.
#[derive(Debug)]
struct InotifyFd(Inotify);

impl AsRawFd for InotifyFd {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

/// A follower's watch of a directory.
#[derive(Debug)]
pub struct DirectoryWatch {
    instance: Arc<InotifyInstance>,
    directory: WatchDescriptor,
    changed: watch::Receiver<()>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl DirectoryWatches {
    /// Watches a directory from now on.
    pub fn watch(&self, directory: &Path) -> io::Result<DirectoryWatch> {
        let instance = self.instance()?;
        // Under the lock, so that a concurrent drop of the last watch of this directory cannot remove the new one.
        let mut directories = lock(&instance.directories);
        let watched = instance.inotify.get_ref().0.add_watch(directory, EVENTS)?;
        let changed = directories.entry(watched).or_default().subscribe();
        drop(directories);
        Ok(DirectoryWatch { instance, directory: watched, changed })
    }

    fn instance(&self) -> io::Result<Arc<InotifyInstance>> {
        let mut kept = lock(&self.instance);
        if let Some(instance) = kept.upgrade() {
            return Ok(instance);
        }
        let inotify = Inotify::init(InitFlags::IN_CLOEXEC | InitFlags::IN_NONBLOCK)?;
        // SAFETY: the descriptor is owned by the registration, and nothing else closes it.
        let registered = unsafe { AsyncFd::register_with_interest(InotifyFd(inotify), Interest::READABLE) };
        let inotify = Arc::new(registered?);
        let directories = Directories::default();
        let telling = tokio::spawn(notify_changes(Arc::clone(&inotify), Arc::clone(&directories)));
        let instance = Arc::new(InotifyInstance { inotify, directories, telling: telling.abort_handle() });
        *kept = Arc::downgrade(&instance);
        Ok(instance)
    }
}

impl Drop for InotifyInstance {
    fn drop(&mut self) {
        self.telling.abort();
    }
}

/// Forwards events to the followers forever.
async fn notify_changes(inotify: Arc<AsyncFd<InotifyFd>>, directories: Directories) {
    loop {
        let Ok(mut ready) = inotify.readable().await else {
            return;
        };
        let read = |inotify: &AsyncFd<InotifyFd>| {
            let events = inotify.get_ref().0.read_events();
            events.map_err(io::Error::from)
        };
        // Would block: the next round waits for more.
        let Ok(Ok(events)) = ready.try_io(read) else {
            continue;
        };
        let mut directories = lock(&directories);
        for event in events {
            if event.mask.contains(AddWatchFlags::IN_Q_OVERFLOW) {
                // It is unknown whose events were lost.
                directories.values().for_each(|told| told.send_replace(()));
            } else if event.mask.contains(AddWatchFlags::IN_IGNORED) {
                // The directory is gone, and its descriptor is not reused.
                directories.remove(&event.wd);
            } else if let Some(told) = directories.get(&event.wd) {
                told.send_replace(());
            }
        }
    }
}

impl DirectoryWatch {
    /// Returns when something has changed since the last call, or since the directory is watched. Never returns once
    /// the directory is gone.
    pub async fn next_change(&mut self) {
        if self.changed.changed().await.is_err() {
            std::future::pending().await
        }
    }
}

impl Drop for DirectoryWatch {
    fn drop(&mut self) {
        let mut directories = lock(&self.instance.directories);
        let told = directories.get(&self.directory);
        // Only its own receiver is left.
        if told.is_some_and(|told| told.receiver_count() <= 1) {
            directories.remove(&self.directory);
            // Fails if the directory is gone already.
            let inotify = &self.instance.inotify.get_ref().0;
            let _ = inotify.rm_watch(self.directory);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// Returns the number of inotify instances of this process.
    fn instances() -> usize {
        let open = fs::read_dir("/proc/self/fd").expect("descriptors").flatten();
        open.filter_map(|entry| fs::read_link(entry.path()).ok())
            .filter(|target| target.to_string_lossy().contains("inotify"))
            .count()
    }

    #[tokio::test]
    async fn followers_of_many_directories_share_one_instance_and_are_told_of_their_own() {
        let home = tempfile::tempdir().expect("a directory");
        let directories: Vec<_> = (0..200).map(|number| home.path().join(number.to_string())).collect();
        let watches = DirectoryWatches::default();
        let mut held = Vec::new();
        for directory in &directories {
            fs::create_dir(directory).expect("made");
            held.push(watches.watch(directory).expect("watched"));
        }
        let mut beside = watches.watch(&directories[7]).expect("watched twice");
        // Concurrent tests in this process have one each.
        assert!(instances() < 50, "{} instances", instances());
        fs::write(directories[7].join("log"), "1").expect("written");
        held[7].next_change().await;
        beside.next_change().await;
        assert!(!held[8].changed.has_changed().expect("watched"));
        // A remaining watch is still notified.
        drop(held);
        fs::write(directories[7].join("log"), "2").expect("written");
        beside.next_change().await;
        let instance = Arc::downgrade(&beside.instance);
        drop(beside);
        assert!(instance.upgrade().is_none(), "it is closed");
        watches.watch(&directories[7]).expect("and made again");
    }

    #[tokio::test]
    async fn a_directory_that_is_gone_changes_no_more_and_hinders_no_other() {
        let home = tempfile::tempdir().expect("a directory");
        let (gone, other) = (home.path().join("gone"), home.path().join("other"));
        fs::create_dir(&gone).expect("made");
        fs::create_dir(&other).expect("made");
        let watches = DirectoryWatches::default();
        let mut of_gone = watches.watch(&gone).expect("watched");
        let mut of_other = watches.watch(&other).expect("watched");
        fs::remove_dir(&gone).expect("removed");
        fs::write(other.join("log"), "1").expect("written");
        tokio::select! {
            biased;
            () = of_gone.next_change() => panic!("of what is gone"),
            () = of_other.next_change() => {}
        }
        watches.watch(&gone).expect_err("it is not there");
    }
}
