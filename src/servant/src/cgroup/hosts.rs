//! Cgroup hierarchies of the host, and the parent directory of servants' cgroups.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde::{Deserialize, Serialize};

use crate::Error;

/// Name of the parent directory of servants' cgroups where we choose it ourselves.
const NAME: &str = "cloudroid";
/// Unit whose cgroup is delegated to us.
const UNIT: &str = "cloudroid-servants.service";
/// Controllers needed for limits or for the termination of a servant.
const WANTED_V1: [&str; 3] = ["cpu", "memory", "pids"];
/// Controllers used only for servants whose limits ask for them.
const IF_ASKED_V1: [&str; 2] = ["blkio", "cpuset"];
/// Controllers needed additionally if no v2 hierarchy, which can do the work of both, is mounted beside v1. Every
/// hierarchy costs each start an RCU grace period of the kernel (when `cgroup.procs` is written).
const WITHOUT_V2: [&str; 2] = ["cpuacct", "freezer"];
const WANTED_V2: [&str; 5] = ["cpu", "memory", "pids", "io", "cpuset"];

/// Parent directories of servants' cgroups; found once per engine and passed to each shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CgroupParent {
    /// Cgroup version, 1 or 2; 0 if no hierarchy can be used.
    pub version: u8,
    /// One directory for each hierarchy in use.
    pub(super) hierarchies: Vec<ParentDirectory>,
    /// Reason why the version is 0 or a controller is missing; empty if neither is the case.
    pub reason: String,
}

/// A parent directory in one hierarchy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct ParentDirectory {
    pub(super) controllers: Vec<String>,
    pub(super) directory: PathBuf,
    pub(super) unified: bool,
}

/// A mounted hierarchy and our own cgroup in it.
#[derive(Debug, Clone, PartialEq)]
struct MountedHierarchy {
    controllers: Vec<String>,
    mount: PathBuf,
    own: PathBuf,
    unified: bool,
}

impl CgroupParent {
    /// Finds the parent directories, and creates them if needed.
    pub fn find() -> Result<Self, Error> {
        let read = |path: &str| fs::read_to_string(path).map_err(Error::file("read", path));
        let mounted = parse_hierarchies(&read("/proc/self/mountinfo")?, &read("/proc/self/cgroup")?);
        let uses_v1 = mounted.iter().any(|hierarchy| WANTED_V1.iter().any(|name| hierarchy.has_controller(name)));
        match mounted.iter().find(|hierarchy| hierarchy.unified) {
            _ if uses_v1 => Ok(Self::v1(&mounted)),
            Some(unified) => Self::v2(unified),
            None => Ok(Self { version: 0, hierarchies: vec![], reason: "no cgroup hierarchy is mounted".into() }),
        }
    }

    /// Returns the available controllers, sorted.
    pub fn controllers(&self) -> Vec<String> {
        let mut names: Vec<_> = self.hierarchies.iter().flat_map(|below| below.controllers.clone()).collect();
        names.sort();
        names
    }

    /// Removes the parent directories if they are ours and no servant is left in them.
    pub fn remove_if_unused(&self) {
        if let Some(first) = self.hierarchies.first().filter(|_| self.version == 2) {
            // Directory of earlier versions for all shims; not removed while one is in it.
            let shims = first.directory.join("shims");
            let _ = fs::remove_dir(&shims);
            remove_if_unused(&shims);
        }
    }

    fn v1(mounted: &[MountedHierarchy]) -> Self {
        let lacks_v2 = !has_cgroup_kill() || !mounted.iter().any(|hierarchy| hierarchy.unified);
        let wanted = |hierarchy: &&MountedHierarchy| {
            let has_any = |names: &[&str]| names.iter().any(|name| hierarchy.has_controller(name));
            hierarchy.unified || has_any(&WANTED_V1) || has_any(&IF_ASKED_V1) || lacks_v2 && has_any(&WITHOUT_V2)
        };
        let below = mounted.iter().filter(wanted).map(|hierarchy| ParentDirectory {
            controllers: hierarchy.controllers.clone(),
            directory: hierarchy.own.join(NAME),
            unified: hierarchy.unified,
        });
        let parent = Self { version: 1, hierarchies: below.collect(), reason: String::new() };
        let known = parent.controllers();
        let absent: Vec<_> =
            ["cpu", "memory", "pids"].into_iter().filter(|name| !known.iter().any(|k| k == name)).collect();
        let reason = if absent.is_empty() { String::new() } else { format!("cgroup v1 without {}", absent.join(", ")) };
        Self { reason, ..parent }
    }

    fn v2(unified: &MountedHierarchy) -> Result<Self, Error> {
        let directory = choose_v2(unified);
        fs::create_dir_all(&directory).map_err(Error::file("make the cgroup", &directory))?;
        // From the directory just above downwards: each directory enables for its children what it was given itself.
        let mut reason = String::new();
        let above = directory.parent().filter(|above| above.starts_with(&unified.mount));
        for place in above.into_iter().chain([directory.as_path()]) {
            if let Err(error) = enable_controllers(place, place == directory) {
                reason = format!("the controllers of {} cannot be handed down: {error}", place.display());
            }
        }
        let enabled = fs::read_to_string(directory.join("cgroup.subtree_control")).unwrap_or_default();
        let controllers = enabled.split_whitespace().map(str::to_owned).collect();
        let below = ParentDirectory { controllers, directory, unified: true };
        Ok(Self { version: 2, hierarchies: vec![below], reason })
    }
}

impl MountedHierarchy {
    fn has_controller(&self, controller: &str) -> bool {
        !self.unified && self.controllers.iter().any(|name| name == controller)
    }
}

/// Chooses the parent: the unit's cgroup if the unit runs or can be started; a directory of our own in the root if
/// systemd does not manage it; otherwise a sibling of our own cgroup. A unit without a process has no directory until
/// we create one.
fn choose_v2(unified: &MountedHierarchy) -> PathBuf {
    let unit = unified.mount.join("system.slice").join(UNIT);
    let own_is_root = unified.own == unified.mount;
    let by_systemd = || Path::new("/run/systemd/system").exists() && (is_unit_active() || start_unit());
    if unit.exists() || !own_is_root && by_systemd() {
        return unit;
    }
    if own_is_root { unified.own.join(NAME) } else { unified.own.with_file_name(NAME) }
}

/// Returns whether the delegated unit is active in systemd.
fn is_unit_active() -> bool {
    let mut command = Command::new("systemctl");
    let status = command.args(["--quiet", "is-active", UNIT]).status();
    status.is_ok_and(|status| status.success())
}

/// Starts the delegated unit by systemd-run if it is not installed.
fn start_unit() -> bool {
    let mut command = Command::new("systemd-run");
    // Otherwise it would notify our own supervisor that it is ready.
    command.env_remove("NOTIFY_SOCKET");
    command.args(["--quiet", "--unit", UNIT, "--description", "Cgroups of Cloudroid's servants"]);
    for property in ["Type=oneshot", "RemainAfterExit=yes", "Delegate=yes", "KillMode=none"] {
        command.args(["--property", property]);
    }
    command.arg("/bin/true");
    command.status().is_ok_and(|status| status.success())
}

/// Enables the controllers of `place` for its children. Above our own directory only missing ones are requested, and a
/// failure is ignored if nothing was missing.
fn enable_controllers(place: &Path, ours: bool) -> io::Result<()> {
    let available = fs::read_to_string(place.join("cgroup.controllers"))?;
    let control = place.join("cgroup.subtree_control");
    let handed = fs::read_to_string(&control)?;
    let mut refused = None;
    for name in WANTED_V2.iter().filter(|name| available.split_whitespace().any(|known| known == **name)) {
        if !handed.split_whitespace().any(|known| known == *name) {
            refused = fs::write(&control, format!("+{name}")).err().or(refused);
        }
    }
    match refused {
        Some(error) if ours => Err(error),
        _ => Ok(()),
    }
}

/// Returns whether this kernel has `cgroup.kill`, which came with 5.14 and which no root directory shows.
fn has_cgroup_kill() -> bool {
    let release = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let mut numbers = release.split(['.', '-']).map_while(|part| part.trim().parse::<u32>().ok());
    (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0)) >= (5, 14)
}

/// Removes the parent of a servant's directory if we created it and no servant is left in it.
pub(super) fn remove_if_unused(leaf: &Path) {
    if let Some(parent) = leaf.parent().filter(|parent| parent.ends_with(NAME)) {
        // Not empty: other servants exist.
        let _ = fs::remove_dir(parent);
    }
}

/// Parses the texts of /proc/self/mountinfo and /proc/self/cgroup.
fn parse_hierarchies(mountinfo: &str, cgroup: &str) -> Vec<MountedHierarchy> {
    let mut found: Vec<MountedHierarchy> = Vec::new();
    for line in mountinfo.lines() {
        let Some((left, right)) = line.split_once(" - ") else {
            continue;
        };
        let left: Vec<_> = left.split(' ').collect();
        let right: Vec<_> = right.split(' ').collect();
        let ([_, _, _, root, mount, ..], [kind, _, options, ..]) = (&left[..], &right[..]) else {
            continue;
        };
        let unified = match *kind {
            "cgroup2" => true,
            "cgroup" => false,
            _ => continue,
        };
        let options: Vec<_> = options.split(',').collect();
        let Some((names, path)) = own_path(cgroup, &options, unified) else {
            continue;
        };
        let inside = Path::new(path).strip_prefix(root).or_else(|_| Path::new(path).strip_prefix("/"));
        let own = Path::new(mount).join(inside.unwrap_or(Path::new("")));
        // join() with an empty path adds a slash; only the components matter.
        let own: PathBuf = own.components().collect();
        let known = found.iter().any(|other| other.unified == unified && other.controllers == names);
        if !known {
            found.push(MountedHierarchy { controllers: names, mount: mount.into(), own, unified });
        }
    }
    found
}

/// Finds our line of /proc/self/cgroup for a hierarchy: its controllers and our path.
fn own_path<'a>(cgroup: &'a str, options: &[&str], unified: bool) -> Option<(Vec<String>, &'a str)> {
    cgroup.lines().find_map(|line| {
        let mut fields = line.splitn(3, ':');
        let (_, names, path) = (fields.next()?, fields.next()?, fields.next()?);
        let names: Vec<String> = names.split(',').filter(|name| !name.is_empty()).map(str::to_owned).collect();
        let same = if unified {
            names.is_empty()
        } else {
            !names.is_empty() && names.iter().all(|name| options.contains(&name.as_str()))
        };
        same.then_some((names, path))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hybrid_host_is_understood() {
        let mountinfo = "\
30 24 0:26 / /sys/fs/cgroup/cpu,cpuacct rw,relatime - cgroup cgroup rw,cpu,cpuacct
31 24 0:27 / /sys/fs/cgroup/memory rw,relatime shared:9 - cgroup cgroup rw,memory
32 24 0:28 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw
33 24 0:29 / /proc rw - proc proc rw";
        let cgroup = "4:memory:/private/x\n1:cpu,cpuacct:/\n0::/\n";
        let found = parse_hierarchies(mountinfo, cgroup);
        let owns: Vec<_> = found.iter().map(|one| (one.own.to_str().unwrap(), one.unified)).collect();
        assert_eq!(
            owns,
            [
                ("/sys/fs/cgroup/cpu,cpuacct", false),
                ("/sys/fs/cgroup/memory/private/x", false),
                ("/sys/fs/cgroup/unified", true)
            ]
        );
        let parent = CgroupParent::v1(&found);
        assert_eq!(parent.hierarchies[1].directory, Path::new("/sys/fs/cgroup/memory/private/x/cloudroid"));
        assert_eq!(parent.reason, "cgroup v1 without pids");
    }

    #[test]
    fn a_hierarchy_that_is_mounted_in_part_is_understood() {
        let mountinfo = "31 24 0:27 /docker/abc /sys/fs/cgroup ro,nosuid - cgroup2 cgroup rw";
        let found = parse_hierarchies(mountinfo, "0::/docker/abc/own\n");
        assert_eq!(found[0].own, Path::new("/sys/fs/cgroup/own"));
    }
}
