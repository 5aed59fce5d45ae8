//! The disk for the homes of stories: an ext4 with a journal in a sparse file, which is unlinked once it is mounted, in
//! a mount namespace of the run. However the run ends, the kernel removes both with its last process.
//!
//! A separate file system is used because ext4 without a journal, which test machines often have, does not reuse an
//! inode that was deleted in the last seconds: while homes come and go, half of the suite's processor time was spent
//! searching for free inodes.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

use crate::deployer::{path_str, run};

/// Prefix of the names of the files.
const PREFIX: &str = "stories-disk-";
/// Age after which a file with a name counts as a leftover.
const LEFTOVER_AGE: Duration = Duration::from_secs(600);
/// Maximum size of the file in GiB; homes of a run take up to 12 GiB at a time.
const SIZE: u64 = 32;
/// Space to leave free on the underlying disk, in GiB.
const RESERVE: u64 = 4;
/// Minimum size for a run, in GiB.
const MIN_GIB: u64 = 8;

/// Gives this process and its children a private mount namespace. Must be called before the process has threads.
///
/// # Errors
/// If this process may not mount.
pub fn enter_namespace() -> anyhow::Result<()> {
    unshare(CloneFlags::CLONE_NEWNS).context("cannot make a mount namespace")?;
    let none: Option<&str> = None;
    let private = MsFlags::MS_PRIVATE | MsFlags::MS_REC;
    mount(none, "/", none, private, none).context("cannot make mounts private")
}

/// Mounts a new disk on `place`, from a file in the directory `parent`.
///
/// # Errors
/// If there is no space, no loop device, or no permission to mount.
pub fn mount_on(place: &Path, parent: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(parent)?;
    remove_forgotten(parent);
    let free = free_bytes(parent)? >> 30;
    ensure!(free >= MIN_GIB + RESERVE, "{} has {free} GB free, and {} are needed", parent.display(), MIN_GIB + RESERVE);
    let file = tempfile::Builder::new().prefix(PREFIX).tempfile_in(parent)?;
    file.as_file().set_len(SIZE.min(free - RESERVE) << 30)?;
    let path = path_str(file.path());
    let format =
        ["-q", "-F", "-m", "0", "-O", "has_journal", "-E", "lazy_itable_init=1,lazy_journal_init=1,nodiscard", path];
    run(Command::new("mke2fs").args(["-t", "ext4"]).args(format))?.expect_success()?;
    // The content need not survive a power cut, so no write waits for the underlying disk.
    let options = "loop,noatime,nobarrier,data=writeback";
    run(Command::new("mount").args(["-t", "ext4", "-o", options, path, path_str(place)]))?.expect_success()?;
    let _ = std::fs::remove_dir(place.join("lost+found"));
    Ok(())
}

/// Removes files of runs that were killed before they could unlink them, which takes some seconds.
fn remove_forgotten(parent: &Path) {
    let entries = std::fs::read_dir(parent).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX)) {
        let made = entry.metadata().and_then(|about| about.modified());
        let age = made.ok().and_then(|made| made.elapsed().ok());
        if age.is_some_and(|age| age > LEFTOVER_AGE) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Returns the free space in bytes of the file system of a directory.
///
/// # Errors
/// If the kernel does not report it.
pub fn free_bytes(directory: &Path) -> anyhow::Result<u64> {
    let about = nix::sys::statvfs::fstatvfs(File::open(directory)?)?;
    Ok(about.blocks_available() * about.fragment_size())
}
