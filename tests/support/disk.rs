//! The disk that homes of stories are on: an ext4 with a journal, in a sparse file that has no name once it is mounted, in a mount namespace of
//! the run's own. Whatever ends the run, the kernel takes both away with its last process.
//!
//! A file system of its own, because ext4 without a journal, which machines for tests often have, never takes an inode that was deleted in the
//! last seconds: while homes come and go, half of the suite's processor time was its search for another one.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

use crate::deployer::{path_str, run};

/// Files' names begin with this.
const PREFIX: &str = "stories-disk-";
/// A file that has had a name for longer was forgotten.
const FORGOTTEN: Duration = Duration::from_secs(600);
/// As large as the file may grow, in GiB; homes of a run take up to 12 at a time.
const SIZE: u64 = 32;
/// What must be left of the disk that the file is on, in GiB.
const RESERVE: u64 = 4;
/// Less than this, in GiB, is too little for a run.
const LEAST: u64 = 8;

/// Gives this process, and those that it starts, mounts of their own. To be called before it has threads.
///
/// # Errors
/// When this process may not mount.
pub fn enter_namespace() -> anyhow::Result<()> {
    unshare(CloneFlags::CLONE_NEWNS).context("cannot make a mount namespace")?;
    let none: Option<&str> = None;
    let private = MsFlags::MS_PRIVATE | MsFlags::MS_REC;
    mount(none, "/", none, private, none).context("cannot make mounts private")
}

/// Mounts a new disk on `place`, from a file in the directory `parent`.
///
/// # Errors
/// When there is no room, or no loop device, or this process may not mount.
pub fn mount_on(place: &Path, parent: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(parent)?;
    remove_forgotten(parent);
    let free = free_bytes(parent)? >> 30;
    ensure!(
        free >= LEAST + RESERVE,
        "{} has {free} GB free, and {} are needed",
        parent.display(),
        LEAST + RESERVE
    );
    let file = tempfile::Builder::new()
        .prefix(PREFIX)
        .tempfile_in(parent)?;
    file.as_file().set_len(SIZE.min(free - RESERVE) << 30)?;
    let path = path_str(file.path());
    let format = [
        "-q",
        "-F",
        "-m",
        "0",
        "-O",
        "has_journal",
        "-E",
        "lazy_itable_init=1,lazy_journal_init=1,nodiscard",
        path,
    ];
    run(Command::new("mke2fs").args(["-t", "ext4"]).args(format))?.succeeded()?;
    // What is on it outlives no power cut, so nothing waits for the disk below.
    let options = "loop,noatime,nobarrier,data=writeback";
    run(Command::new("mount").args(["-t", "ext4", "-o", options, path, path_str(place)]))?
        .succeeded()?;
    let _ = std::fs::remove_dir(place.join("lost+found"));
    Ok(())
}

/// Removes files of runs that were killed before their disk was mounted: a file has a name for some seconds only.
fn remove_forgotten(parent: &Path) {
    let entries = std::fs::read_dir(parent).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX)) {
        let made = entry.metadata().and_then(|about| about.modified());
        let age = made.ok().and_then(|made| made.elapsed().ok());
        if age.is_some_and(|age| age > FORGOTTEN) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Bytes that are free on the disk of a directory.
///
/// # Errors
/// When the kernel does not tell.
pub fn free_bytes(directory: &Path) -> anyhow::Result<u64> {
    let about = nix::sys::statvfs::fstatvfs(File::open(directory)?)?;
    Ok(about.blocks_available() * about.fragment_size())
}
