//! Atomic files, and locks that end with the process that holds them.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rustix::fs::FlockOperation;
use rustix::io::Errno;

use crate::Error;

/// Prefix of the names of temporary files and trees.
pub(crate) const HALF_MADE: &str = "tmp-";

/// Generates a name that is unique in its directory.
pub(crate) fn temporary_name() -> String {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let time = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    let next = NEXT.fetch_add(1, Ordering::Relaxed);
    format!("{HALF_MADE}{}-{:x}-{next}", std::process::id(), time.as_nanos())
}

/// A lock on a directory or file, held until it is dropped or the process ends.
#[derive(Debug)]
pub(crate) struct Lock {
    _file: File,
}

impl Lock {
    /// Acquires a shared lock, waiting for exclusive holders, unless this thread's work is cancelled.
    pub(crate) fn lock_shared(path: &Path) -> Result<Self, Error> {
        Self::acquire(path, FlockOperation::NonBlockingLockShared)
    }

    /// Acquires an exclusive lock, waiting for all other holders, unless this thread's work is cancelled.
    pub(crate) fn lock_exclusive(path: &Path) -> Result<Self, Error> {
        Self::acquire(path, FlockOperation::NonBlockingLockExclusive)
    }

    /// Tries to acquire an exclusive lock; `None` if it is held by somebody else.
    pub(crate) fn try_lock_exclusive(path: &Path) -> Result<Option<Self>, Error> {
        let file = open(path)?;
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Some(Self { _file: file })),
            Err(Errno::WOULDBLOCK) => Ok(None),
            Err(error) => Err(Error::file("lock", path, error)),
        }
    }

    fn acquire(path: &Path, operation: FlockOperation) -> Result<Self, Error> {
        let file = open(path)?;
        // Polls, because a thread that blocks in the kernel does not notice cancellation.
        let mut pause = Duration::from_millis(1);
        loop {
            match rustix::fs::flock(&file, operation) {
                Ok(()) => return Ok(Self { _file: file }),
                Err(Errno::INTR) => {}
                Err(Errno::WOULDBLOCK) => {
                    foreign::cancel::check()
                        .map_err(|cancelled| Error::file("lock", path, io::Error::from(cancelled)))?;
                    std::thread::sleep(pause);
                    pause = (pause * 2).min(Duration::from_millis(50));
                }
                Err(error) => return Err(Error::file("lock", path, error)),
            }
        }
    }
}

fn open(path: &Path) -> Result<File, Error> {
    // Non-blocking: a foreign FIFO of this name must not block the sweep.
    File::options()
        .read(true)
        .custom_flags(rustix::fs::OFlags::NONBLOCK.bits() as i32)
        .open(path)
        .map_err(|error| Error::file("open", path, error))
}

/// A file with a temporary name, locked so that no sweep removes it, and removed on drop unless published.
#[derive(Debug)]
pub(crate) struct NewFile {
    file: File,
    path: PathBuf,
    published: bool,
}

impl NewFile {
    /// Creates an empty file in `directory`.
    pub(crate) fn create(directory: &Path) -> Result<Self, Error> {
        loop {
            let path = directory.join(temporary_name());
            let file = File::options()
                .read(true)
                .write(true)
                .create_new(true)
                .mode(0o600)
                .open(&path)
                .map_err(|error| Error::file("create", &path, error))?;
            let new = Self { file, path, published: false };
            let locked = rustix::fs::flock(&new.file, FlockOperation::NonBlockingLockExclusive);
            // A sweep may have removed it between creation and locking.
            let there = rustix::fs::fstat(&new.file).is_ok_and(|stat| stat.st_nlink > 0);
            if locked.is_ok() && there {
                return Ok(new);
            }
        }
    }

    #[cfg(test)]
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn file(&self) -> &File {
        &self.file
    }

    /// Flushes the content, renames the file to `target`, and flushes the directory.
    pub(crate) fn publish(mut self, target: &Path) -> Result<(), Error> {
        self.file.sync_data().map_err(|error| Error::file("flush", target, error))?;
        std::fs::rename(&self.path, target).map_err(|error| Error::file("create", target, error))?;
        self.published = true;
        sync_directory(directory_of(target))
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if !self.published {
            // It may be gone already; a sweep removes the rest.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

impl Write for &NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        (&self.file).write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Returns the directory of a file; a bare name is in the working directory.
pub(crate) fn directory_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if parent.as_os_str().is_empty() => Path::new("."),
        Some(parent) => parent,
        None => Path::new("/"),
    }
}

/// Flushes the entries of a directory.
pub(crate) fn sync_directory(directory: &Path) -> Result<(), Error> {
    open(directory)?.sync_all().map_err(|error| Error::file("flush", directory, error))
}

/// Writes a small file of mode 0600 atomically and durably: content and name are flushed.
///
/// # Errors
/// If the file cannot be written; with the bytes needed and free if the disk is full.
pub fn write_atomically(target: &Path, bytes: &[u8]) -> Result<(), Error> {
    let new = NewFile::create(directory_of(target))?;
    (&new)
        .write_all(bytes)
        .map_err(|error| Error::file("write", target, error).with_needed_bytes(bytes.len() as u64))?;
    new.publish(target)
}

/// Reads a small file; `None` if it does not exist. Fails if it is longer than `most` bytes.
pub(crate) fn read_limited(path: &Path, most: u64) -> Result<Option<Vec<u8>>, Error> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(Error::file("open", path, error)),
    };
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes).map_err(|error| Error::file("read", path, error))?;
    if bytes.len() as u64 > most {
        let error = io::Error::new(io::ErrorKind::InvalidData, format!("it is longer than {most} bytes"));
        return Err(Error::file("read", path, error));
    }
    Ok(Some(bytes))
}

/// Creates a directory that only its owner can access, and its missing parents.
pub(crate) fn make_private_directory(path: &Path) -> Result<(), Error> {
    std::fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(path)
        .map_err(|error| Error::file("create", path, error))
}

/// Removes a tree of any depth, even if its directories are not writable. It is not an error if it does not exist.
pub(crate) fn remove_tree(path: &Path) -> Result<(), Error> {
    foreign::remove(path).map_err(|error| Error::file("remove", path, io::Error::from(error)))
}

/// Removes leftovers of a crash in `directory`: temporary files and trees that no running process has locked.
pub(crate) fn sweep_temporary(directory: &Path) -> Result<u64, Error> {
    let mut swept = 0;
    for entry in list(directory)? {
        let name = entry.file_name();
        if !name.as_encoded_bytes().starts_with(HALF_MADE.as_bytes()) {
            continue;
        }
        let path = entry.path();
        // Unreadable or removed meanwhile: not ours.
        let Ok(Some(_lock)) = Lock::try_lock_exclusive(&path) else {
            continue;
        };
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            remove_tree(&path)?;
        } else {
            match std::fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(Error::file("remove", &path, error));
                }
                _ => {}
            }
        }
        tracing::info!(path = %path.display(), "removed an unfinished leftover");
        swept += 1;
    }
    Ok(swept)
}

/// Returns the entries of a directory.
pub(crate) fn list(directory: &Path) -> Result<Vec<std::fs::DirEntry>, Error> {
    std::fs::read_dir(directory).and_then(Iterator::collect).map_err(|error| Error::file("list", directory, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unpublished_file_leaves_nothing() {
        let directory = tempfile::tempdir().unwrap();
        drop(NewFile::create(directory.path()).unwrap());
        assert!(list(directory.path()).unwrap().is_empty());
    }

    #[test]
    fn a_sweep_takes_leftovers_and_spares_what_is_being_written() {
        let directory = tempfile::tempdir().unwrap();
        let being_written = NewFile::create(directory.path()).unwrap();
        std::fs::write(directory.path().join("tmp-dead"), "half").unwrap();
        std::fs::create_dir_all(directory.path().join("tmp-tree/usr")).unwrap();
        std::fs::write(directory.path().join("other"), "whole").unwrap();
        assert_eq!(sweep_temporary(directory.path()).unwrap(), 2);
        assert!(being_written.path().exists());
        being_written.publish(&directory.path().join("done")).unwrap();
        let mut names: Vec<_> = list(directory.path()).unwrap().iter().map(|e| e.file_name()).collect();
        names.sort();
        assert_eq!(names, ["done", "other"]);
    }

    #[test]
    fn waiting_for_a_lock_ends_when_it_is_cancelled() {
        let directory = tempfile::tempdir().unwrap();
        let _held = Lock::lock_exclusive(directory.path()).unwrap();
        let cancel = foreign::cancel::Cancel::default();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| cancel.run(|| Lock::lock_shared(directory.path())));
            cancel.cancel();
            waiting.join().unwrap().unwrap_err();
        });
    }

    #[test]
    fn a_shared_lock_keeps_others_from_holding_it_alone() {
        let directory = tempfile::tempdir().unwrap();
        let first = Lock::lock_shared(directory.path()).unwrap();
        let _second = Lock::lock_shared(directory.path()).unwrap();
        assert!(Lock::try_lock_exclusive(directory.path()).unwrap().is_none());
        drop(first);
        assert!(Lock::try_lock_exclusive(directory.path()).unwrap().is_none());
        drop(_second);
        assert!(Lock::try_lock_exclusive(directory.path()).unwrap().is_some());
    }
}
