//! A disk that a story can fill: a file system in memory, below the directory of this run.

use std::fs::File;
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, MsFlags, mount, umount2};

use crate::world::{Directory, world};

/// The disk; unmounted on drop.
pub struct SmallDisk {
    directory: Directory,
}

impl SmallDisk {
    /// Mounts a disk of `size`, such as `64M`, in a directory named `name`.
    pub fn mount(name: &str, size: &str) -> anyhow::Result<SmallDisk> {
        let directory = world().directory(name)?;
        let options = format!("size={size}");
        mount(Some("tmpfs"), directory.path(), Some("tmpfs"), MsFlags::empty(), Some(&*options))?;
        Ok(SmallDisk { directory })
    }

    /// Returns a home for a daemon on it.
    pub fn home(&self) -> PathBuf {
        self.path().join("home")
    }

    /// Fills it completely.
    pub fn fill(&self) -> anyhow::Result<()> {
        let mut filler = File::create(self.filler())?;
        // Ends with an error when the disk is full.
        let _ = std::io::copy(&mut std::io::repeat(1), &mut filler);
        Ok(())
    }

    /// Frees the filled space.
    pub fn make_room(&self) -> anyhow::Result<()> {
        Ok(std::fs::remove_file(self.filler())?)
    }

    fn filler(&self) -> PathBuf {
        self.path().join("filler")
    }

    fn path(&self) -> &Path {
        self.directory.path()
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = umount2(self.path(), MntFlags::MNT_DETACH);
    }
}
