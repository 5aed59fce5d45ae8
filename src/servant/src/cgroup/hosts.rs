//! What the host offers, and the place below which servants' cgroups are made.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde::{Deserialize, Serialize};

use crate::Error;

/// Servants' cgroups are below a directory of this name where we choose it ourselves.
const NAME: &str = "cloudroid";
/// The unit whose cgroup is delegated to us.
const UNIT: &str = "cloudroid-servants.service";
/// Controllers that limits or the end of a servant need.
const WANTED_V1: [&str; 3] = ["cpu", "memory", "pids"];
/// Used only for servants whose limits ask for it.
const IF_ASKED_V1: [&str; 2] = ["blkio", "cpuset"];
/// Needed besides where no v2 hierarchy, which can do both, is mounted beside v1. Every hierarchy costs each start a
/// grace period of the kernel (its `cgroup.procs` is written).
const WITHOUT_V2: [&str; 2] = ["cpuacct", "freezer"];
const WANTED_V2: [&str; 5] = ["cpu", "memory", "pids", "io", "cpuset"];

/// Below which directories servants' cgroups are made; found once per engine and handed to each shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parent {
    /// 1, 2, or 0 where no hierarchy can be used.
    pub version: u8,
    /// One for each hierarchy that is used.
    pub(super) hierarchies: Vec<Below>,
    /// Why the version is 0, or a controller is missing; empty when all is well.
    pub reason: String,
}

/// A parent directory in one hierarchy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Below {
    pub(super) controllers: Vec<String>,
    pub(super) directory: PathBuf,
    pub(super) unified: bool,
}

/// A mounted hierarchy and where in it this process is.
#[derive(Debug, Clone, PartialEq)]
struct Mounted {
    controllers: Vec<String>,
    mount: PathBuf,
    own: PathBuf,
    unified: bool,
}

impl Parent {
    /// Finds and, where needed, makes the place.
    pub fn find() -> Result<Self, Error> {
        let read = |path: &str| fs::read_to_string(path).map_err(Error::file("read", path));
        let mounted = parse(&read("/proc/self/mountinfo")?, &read("/proc/self/cgroup")?);
        let uses_v1 = mounted
            .iter()
            .any(|hierarchy| WANTED_V1.iter().any(|name| hierarchy.has(name)));
        match mounted.iter().find(|hierarchy| hierarchy.unified) {
            _ if uses_v1 => Ok(Self::v1(&mounted)),
            Some(unified) => Self::v2(unified),
            None => Ok(Self {
                version: 0,
                hierarchies: vec![],
                reason: "no cgroup hierarchy is mounted".into(),
            }),
        }
    }

    /// Which controllers can be used, sorted.
    pub fn controllers(&self) -> Vec<String> {
        let mut names: Vec<_> = self
            .hierarchies
            .iter()
            .flat_map(|below| below.controllers.clone())
            .collect();
        names.sort();
        names
    }

    /// Removes the place if it is one that we chose and no servant is left in it.
    pub fn remove_if_unused(&self) {
        if let Some(first) = self.hierarchies.first().filter(|_| self.version == 2) {
            // Where earlier versions put all shims; refused while one is in it.
            let shims = first.directory.join("shims");
            let _ = fs::remove_dir(&shims);
            remove_if_unused(&shims);
        }
    }

    fn v1(mounted: &[Mounted]) -> Self {
        let lacks_v2 = !has_kill() || !mounted.iter().any(|hierarchy| hierarchy.unified);
        let wanted = |hierarchy: &&Mounted| {
            let has_any = |names: &[&str]| names.iter().any(|name| hierarchy.has(name));
            hierarchy.unified
                || has_any(&WANTED_V1)
                || has_any(&IF_ASKED_V1)
                || lacks_v2 && has_any(&WITHOUT_V2)
        };
        let below = mounted.iter().filter(wanted).map(|hierarchy| Below {
            controllers: hierarchy.controllers.clone(),
            directory: hierarchy.own.join(NAME),
            unified: hierarchy.unified,
        });
        let parent = Self {
            version: 1,
            hierarchies: below.collect(),
            reason: String::new(),
        };
        let known = parent.controllers();
        let absent: Vec<_> = ["cpu", "memory", "pids"]
            .into_iter()
            .filter(|name| !known.iter().any(|k| k == name))
            .collect();
        let reason = if absent.is_empty() {
            String::new()
        } else {
            format!("cgroup v1 without {}", absent.join(", "))
        };
        Self { reason, ..parent }
    }

    fn v2(unified: &Mounted) -> Result<Self, Error> {
        let directory = choose_v2(unified);
        fs::create_dir_all(&directory).map_err(Error::file("make the cgroup", &directory))?;
        // From the place just above down: each directory hands to the next what it was handed itself.
        let mut reason = String::new();
        let above = directory
            .parent()
            .filter(|above| above.starts_with(&unified.mount));
        for place in above.into_iter().chain([directory.as_path()]) {
            if let Err(error) = enable(place, place == directory) {
                reason = format!(
                    "the controllers of {} cannot be handed down: {error}",
                    place.display()
                );
            }
        }
        let enabled =
            fs::read_to_string(directory.join("cgroup.subtree_control")).unwrap_or_default();
        let controllers = enabled.split_whitespace().map(str::to_owned).collect();
        let below = Below {
            controllers,
            directory,
            unified: true,
        };
        Ok(Self {
            version: 2,
            hierarchies: vec![below],
            reason,
        })
    }
}

impl Mounted {
    fn has(&self, controller: &str) -> bool {
        !self.unified && self.controllers.iter().any(|name| name == controller)
    }
}

/// The unit's cgroup when the unit runs or can be started; our own place in the root when no systemd manages it;
/// otherwise a place beside us. A unit without a process has no directory until we make one.
fn choose_v2(unified: &Mounted) -> PathBuf {
    let unit = unified.mount.join("system.slice").join(UNIT);
    let own_is_root = unified.own == unified.mount;
    let by_systemd = || Path::new("/run/systemd/system").exists() && (unit_runs() || start_unit());
    if unit.exists() || !own_is_root && by_systemd() {
        return unit;
    }
    if own_is_root {
        unified.own.join(NAME)
    } else {
        unified.own.with_file_name(NAME)
    }
}

/// Whether systemd has the delegated unit.
fn unit_runs() -> bool {
    let mut command = Command::new("systemctl");
    let status = command.args(["--quiet", "is-active", UNIT]).status();
    status.is_ok_and(|status| status.success())
}

/// Asks systemd for the delegated unit where it was not installed.
fn start_unit() -> bool {
    let mut command = Command::new("systemd-run");
    // It would tell our own supervisor that it is ready.
    command.env_remove("NOTIFY_SOCKET");
    command.args([
        "--quiet",
        "--unit",
        UNIT,
        "--description",
        "Cgroups of Cloudroid's servants",
    ]);
    for property in [
        "Type=oneshot",
        "RemainAfterExit=yes",
        "Delegate=yes",
        "KillMode=none",
    ] {
        command.args(["--property", property]);
    }
    command.arg("/bin/true");
    command.status().is_ok_and(|status| status.success())
}

/// Hands the controllers that `place` has to its children. Above our own place only what is lacking is asked for, and
/// a refusal counts for nothing when it turns out that nothing was lacking.
fn enable(place: &Path, ours: bool) -> io::Result<()> {
    let available = fs::read_to_string(place.join("cgroup.controllers"))?;
    let control = place.join("cgroup.subtree_control");
    let handed = fs::read_to_string(&control)?;
    let mut refused = None;
    for name in WANTED_V2
        .iter()
        .filter(|name| available.split_whitespace().any(|known| known == **name))
    {
        if !handed.split_whitespace().any(|known| known == *name) {
            refused = fs::write(&control, format!("+{name}")).err().or(refused);
        }
    }
    match refused {
        Some(error) if ours => Err(error),
        _ => Ok(()),
    }
}

/// Whether this kernel has `cgroup.kill`, which came with 5.14 and which no root directory shows.
fn has_kill() -> bool {
    let release = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let mut numbers = release
        .split(['.', '-'])
        .map_while(|part| part.trim().parse::<u32>().ok());
    (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0)) >= (5, 14)
}

/// Removes the directory above a servant's when it is one that we chose and no servant is left in it.
pub(super) fn remove_if_unused(leaf: &Path) {
    if let Some(parent) = leaf.parent().filter(|parent| parent.ends_with(NAME)) {
        // Not empty: other servants live.
        let _ = fs::remove_dir(parent);
    }
}

/// From the texts of /proc/self/mountinfo and /proc/self/cgroup.
fn parse(mountinfo: &str, cgroup: &str) -> Vec<Mounted> {
    let mut found: Vec<Mounted> = Vec::new();
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
        let inside = Path::new(path)
            .strip_prefix(root)
            .or_else(|_| Path::new(path).strip_prefix("/"));
        let own = Path::new(mount).join(inside.unwrap_or(Path::new("")));
        // join() of an empty path adds a slash; the components are what counts.
        let own: PathBuf = own.components().collect();
        let known = found
            .iter()
            .any(|other| other.unified == unified && other.controllers == names);
        if !known {
            found.push(Mounted {
                controllers: names,
                mount: mount.into(),
                own,
                unified,
            });
        }
    }
    found
}

/// Our line of /proc/self/cgroup for a hierarchy: its controllers and our path.
fn own_path<'a>(
    cgroup: &'a str,
    options: &[&str],
    unified: bool,
) -> Option<(Vec<String>, &'a str)> {
    cgroup.lines().find_map(|line| {
        let mut fields = line.splitn(3, ':');
        let (_, names, path) = (fields.next()?, fields.next()?, fields.next()?);
        let names: Vec<String> = names
            .split(',')
            .filter(|name| !name.is_empty())
            .map(str::to_owned)
            .collect();
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
        let found = parse(mountinfo, cgroup);
        let owns: Vec<_> = found
            .iter()
            .map(|one| (one.own.to_str().unwrap(), one.unified))
            .collect();
        assert_eq!(
            owns,
            [
                ("/sys/fs/cgroup/cpu,cpuacct", false),
                ("/sys/fs/cgroup/memory/private/x", false),
                ("/sys/fs/cgroup/unified", true)
            ]
        );
        let parent = Parent::v1(&found);
        assert_eq!(
            parent.hierarchies[1].directory,
            Path::new("/sys/fs/cgroup/memory/private/x/cloudroid")
        );
        assert_eq!(parent.reason, "cgroup v1 without pids");
    }

    #[test]
    fn a_hierarchy_that_is_mounted_in_part_is_understood() {
        let mountinfo = "31 24 0:27 /docker/abc /sys/fs/cgroup ro,nosuid - cgroup2 cgroup rw";
        let found = parse(mountinfo, "0::/docker/abc/own\n");
        assert_eq!(found[0].own, Path::new("/sys/fs/cgroup/own"));
    }
}
