//! Cgroups of the peers' containers: below our own cgroup, so that our limits apply to them.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

/// A path for one container's cgroup. Parent cgroups that are created for it are removed on drop.
pub(crate) struct BenchCgroup {
    path: String,
    missing: Vec<PathBuf>,
}

impl BenchCgroup {
    /// Reserves a path that is not in use.
    pub(crate) fn reserve() -> Result<Self> {
        let path = format!("{}/cloudroid-bench-{}", own_cgroup()?, std::process::id());
        let missing = missing_directories(Path::new(&path))?;
        Ok(Self { path, missing })
    }

    /// Returns the parent cgroup of the container.
    pub(crate) fn parent(&self) -> &str {
        &self.path
    }

    /// Returns the `cgroupsPath` of a container.
    pub(crate) fn container_path(&self, id: &str) -> String {
        format!("{}/{id}", self.path)
    }
}

impl Drop for BenchCgroup {
    fn drop(&mut self) {
        for directory in &self.missing {
            // A cgroup that is not empty is in use by others by now.
            let _ = fs::remove_dir(directory);
        }
    }
}

/// Mount point of cgroup version 2 on hosts with both versions.
const UNIFIED: &str = "/sys/fs/cgroup/unified";

/// Runs `work` in a thread that sees only version 1 where both versions are mounted, because crun refuses hybrid mode.
pub(crate) fn with_only_version_1<T: Send>(work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
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

/// Returns the directories to be created in the hierarchies, the deepest first.
fn missing_directories(path: &Path) -> Result<Vec<PathBuf>> {
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

/// Returns our own cgroup in the hierarchy of the memory controller.
fn own_cgroup() -> Result<String> {
    let text = fs::read_to_string("/proc/self/cgroup")?;
    let fields = text.lines().filter_map(|line| line.split_once(':')?.1.split_once(':'));
    let fields: Vec<_> = fields.collect();
    let of = |name: &str| {
        let found = fields.iter().find(|(controllers, _)| controllers.split(',').any(|one| one == name));
        found.map(|(_, path)| path.trim_end_matches('/').to_owned())
    };
    of("memory").or_else(|| of("")).context("no cgroup")
}
