//! Where the peers' containers are counted and limited: below our own cgroup, so that our limits are theirs.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

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
