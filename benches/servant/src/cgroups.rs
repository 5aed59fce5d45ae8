//! Where the peers' containers are counted and limited: below our own cgroup, so that our limits are theirs.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

/// A place for one container's cgroup. What is made on the way to it goes when this is dropped.
pub(crate) struct Cgroups {
    path: String,
    missing: Vec<PathBuf>,
}

impl Cgroups {
    /// A place that nobody else uses.
    pub(crate) fn place() -> Result<Self> {
        let path = format!("{}/cloudroid-bench-{}", own()?, std::process::id());
        let missing = missing(Path::new(&path))?;
        Ok(Self { path, missing })
    }

    /// The cgroup that is above the container's.
    pub(crate) fn parent(&self) -> &str {
        &self.path
    }

    /// The `cgroupsPath` of a container.
    pub(crate) fn of(&self, id: &str) -> String {
        format!("{}/{id}", self.path)
    }
}

impl Drop for Cgroups {
    fn drop(&mut self) {
        for directory in &self.missing {
            // What is not empty is somebody else's by now.
            let _ = fs::remove_dir(directory);
        }
    }
}

/// Where hosts with both versions have version 2.
const UNIFIED: &str = "/sys/fs/cgroup/unified";

/// Does something in a thread for which a host with both versions of cgroups has version 1 alone: crun refuses others ("cgroups in hybrid mode
/// not supported"). The mounts are this thread's, and of what it starts.
pub(crate) fn as_of_one_version<T: Send>(work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    let covered = || {
        unshare(CloneFlags::CLONE_NEWNS).context("a mount namespace for a peer")?;
        if Path::new(UNIFIED).join("cgroup.procs").exists() {
            let empty = Some("tmpfs");
            mount(empty, UNIFIED, empty, MsFlags::empty(), None::<&str>)
                .with_context(|| format!("covering {UNIFIED}"))?;
        }
        work()
    };
    std::thread::scope(|scope| scope.spawn(covered).join())
        .map_err(|_| anyhow!("the thread that starts a peer has panicked"))?
}

/// The directories, the deepest first, that will be made in the hierarchies.
fn missing(path: &Path) -> Result<Vec<PathBuf>> {
    let mut missing = Vec::new();
    let hierarchies = fs::read_dir("/sys/fs/cgroup")?.filter_map(|entry| Some(entry.ok()?.path()));
    for root in hierarchies.chain([PathBuf::from("/sys/fs/cgroup")]) {
        if !root.join("cgroup.procs").exists() {
            continue;
        }
        let places = path.ancestors().filter(|part| part.parent().is_some());
        let places = places.map(|part| root.join(part.strip_prefix("/").unwrap_or(part)));
        missing.extend(places.filter(|place| !place.exists()));
    }
    Ok(missing)
}

/// Where we are in the hierarchy that counts memory.
fn own() -> Result<String> {
    let text = fs::read_to_string("/proc/self/cgroup")?;
    let fields = text
        .lines()
        .filter_map(|line| line.split_once(':')?.1.split_once(':'));
    let fields: Vec<_> = fields.collect();
    let of = |name: &str| {
        let found = fields
            .iter()
            .find(|(controllers, _)| controllers.split(',').any(|one| one == name));
        found.map(|(_, path)| path.trim_end_matches('/').to_owned())
    };
    of("memory").or_else(|| of("")).context("no cgroup")
}
