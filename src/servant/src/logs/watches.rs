//! Tells followers of logs when something in a log's directory has changed. All share one instance of inotify: a user has 128 of them on the
//! whole host (`fs.inotify.max_user_instances`), and root's are needed by others.

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

/// What is told of a directory.
const EVENTS: AddWatchFlags = AddWatchFlags::IN_MODIFY
    .union(AddWatchFlags::IN_CREATE)
    .union(AddWatchFlags::IN_ONLYDIR);

/// The directories that are watched. The instance of inotify is there while any is.
#[derive(Debug, Default)]
pub struct Watches {
    instance: Mutex<Weak<Instance>>,
}

/// By directory: who is told of its changes.
type Directories = Arc<Mutex<HashMap<WatchDescriptor, watch::Sender<()>>>>;

#[derive(Debug)]
struct Instance {
    inotify: Arc<AsyncFd<Descriptor>>,
    directories: Directories,
    telling: AbortHandle,
}

/// What nix lacks: its inotify has no raw descriptor to show.
#[derive(Debug)]
struct Descriptor(Inotify);

impl AsRawFd for Descriptor {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

/// One follower's interest in a directory.
#[derive(Debug)]
pub struct Watch {
    instance: Arc<Instance>,
    directory: WatchDescriptor,
    changed: watch::Receiver<()>,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Watches {
    /// Watches a directory from now on.
    pub fn watch(&self, directory: &Path) -> io::Result<Watch> {
        let instance = self.instance()?;
        // Under the lock, so that nobody who stops watching the same directory takes this watch away.
        let mut directories = locked(&instance.directories);
        let watched = instance.inotify.get_ref().0.add_watch(directory, EVENTS)?;
        let changed = directories.entry(watched).or_default().subscribe();
        drop(directories);
        Ok(Watch {
            instance,
            directory: watched,
            changed,
        })
    }

    fn instance(&self) -> io::Result<Arc<Instance>> {
        let mut kept = locked(&self.instance);
        if let Some(instance) = kept.upgrade() {
            return Ok(instance);
        }
        let inotify = Inotify::init(InitFlags::IN_CLOEXEC | InitFlags::IN_NONBLOCK)?;
        // SAFETY: the descriptor is owned by what is registered, and nothing else closes it.
        let registered =
            unsafe { AsyncFd::register_with_interest(Descriptor(inotify), Interest::READABLE) };
        let inotify = Arc::new(registered?);
        let directories = Directories::default();
        let telling = tokio::spawn(tell(Arc::clone(&inotify), Arc::clone(&directories)));
        let instance = Arc::new(Instance {
            inotify,
            directories,
            telling: telling.abort_handle(),
        });
        *kept = Arc::downgrade(&instance);
        Ok(instance)
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        self.telling.abort();
    }
}

/// Tells of changes for ever.
async fn tell(inotify: Arc<AsyncFd<Descriptor>>, directories: Directories) {
    loop {
        let Ok(mut ready) = inotify.readable().await else {
            return;
        };
        let read = |inotify: &AsyncFd<Descriptor>| {
            let events = inotify.get_ref().0.read_events();
            events.map_err(io::Error::from)
        };
        // Would block: the next round waits for more.
        let Ok(Ok(events)) = ready.try_io(read) else {
            continue;
        };
        let mut directories = locked(&directories);
        for event in events {
            if event.mask.contains(AddWatchFlags::IN_Q_OVERFLOW) {
                // Of whom they were is not known.
                directories.values().for_each(|told| told.send_replace(()));
            } else if event.mask.contains(AddWatchFlags::IN_IGNORED) {
                // The directory is gone, and its number is given to no other.
                directories.remove(&event.wd);
            } else if let Some(told) = directories.get(&event.wd) {
                told.send_replace(());
            }
        }
    }
}

impl Watch {
    /// Comes back when something has changed since the last time, or since the directory is watched. Never comes back once the directory
    /// is gone.
    pub async fn changed(&mut self) {
        if self.changed.changed().await.is_err() {
            std::future::pending().await
        }
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        let mut directories = locked(&self.instance.directories);
        let told = directories.get(&self.directory);
        // Its own receiver is the last.
        if told.is_some_and(|told| told.receiver_count() <= 1) {
            directories.remove(&self.directory);
            // It fails where the directory is gone already.
            let inotify = &self.instance.inotify.get_ref().0;
            let _ = inotify.rm_watch(self.directory);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// Instances of inotify that this process has.
    fn instances() -> usize {
        let open = fs::read_dir("/proc/self/fd")
            .expect("descriptors")
            .flatten();
        open.filter_map(|entry| fs::read_link(entry.path()).ok())
            .filter(|target| target.to_string_lossy().contains("inotify"))
            .count()
    }

    #[tokio::test]
    async fn followers_of_many_directories_share_one_instance_and_are_told_of_their_own() {
        let home = tempfile::tempdir().expect("a directory");
        let directories: Vec<_> = (0..200)
            .map(|number| home.path().join(number.to_string()))
            .collect();
        let watches = Watches::default();
        let mut held = Vec::new();
        for directory in &directories {
            fs::create_dir(directory).expect("made");
            held.push(watches.watch(directory).expect("watched"));
        }
        let mut beside = watches.watch(&directories[7]).expect("watched twice");
        // Others of this process, in tests that run beside this one, have one each.
        assert!(instances() < 50, "{} instances", instances());
        fs::write(directories[7].join("log"), "1").expect("written");
        held[7].changed().await;
        beside.changed().await;
        assert!(!held[8].changed.has_changed().expect("watched"));
        // Who stays is told on.
        drop(held);
        fs::write(directories[7].join("log"), "2").expect("written");
        beside.changed().await;
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
        let watches = Watches::default();
        let mut of_gone = watches.watch(&gone).expect("watched");
        let mut of_other = watches.watch(&other).expect("watched");
        fs::remove_dir(&gone).expect("removed");
        fs::write(other.join("log"), "1").expect("written");
        tokio::select! {
            biased;
            () = of_gone.changed() => panic!("of what is gone"),
            () = of_other.changed() => {}
        }
        watches.watch(&gone).expect_err("it is not there");
    }
}
