//! Detection of the cgroup controllers that can limit servants.

use std::path::Path;

use api::{Check, CheckStatus};

const NAME: &str = "cgroup";

const FIX: &str = "boot with systemd.unified_cgroup_hierarchy=1, and delegate the controllers to the daemon \
    (Delegate=yes)";

/// Available cgroup controllers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CgroupSupport {
    /// cgroup version, 1 or 2; 0 if no controller can be used.
    pub version: u8,
    /// Limits that cannot be set. Socket buffers are not included: they are reported, but are no reason not to start.
    pub missing: Vec<String>,
    /// Reason for people.
    pub why: String,
}

/// Runs the check for people.
pub fn check() -> Check {
    let found = detect();
    if found.version == 1 && found.missing.is_empty() && !counts_sockets() {
        return Check {
            name: NAME.to_owned(),
            status: CheckStatus::Warning,
            found: "version 1: cpu, memory and pids can be limited, but this kernel does not account for socket \
                buffers: unread messages between servants may use up the machine's memory"
                .to_owned(),
            fix: Some(FIX.to_owned()),
        };
    }
    let status = match (found.version, found.missing.is_empty()) {
        (_, true) => CheckStatus::Ok,
        _ => CheckStatus::Warning,
    };
    let text = match (found.version, found.missing.is_empty()) {
        (0, _) => format!("no controller is usable, servants are not limited: {}", found.why),
        (1, true) => {
            "version 1: cpu, memory and pids can be limited, socket buffers separately from memory; memory.high is not \
                available"
                .to_owned()
        }
        (version, true) => format!("version {version}: cpu, memory and pids can be limited"),
        (version, false) => format!("version {version}, without {}: {}", found.missing.join(", "), found.why),
    };
    let fix = (status != CheckStatus::Ok).then(|| FIX.to_owned());
    Check { name: NAME.to_owned(), status, found: text, fix }
}

/// Returns whether socket buffers can be limited, on version 1 beside memory.
fn counts_sockets() -> bool {
    let mounts = std::fs::read_to_string("/proc/self/mounts").unwrap_or_default();
    let place = memory_hierarchy(&mounts);
    place.is_some_and(|place| servant::cgroup::counts_sockets(Path::new(place)))
}

/// Returns the mount point of the version 1 hierarchy that limits memory.
fn memory_hierarchy(mounts: &str) -> Option<&str> {
    mounts.lines().find_map(|line| {
        let fields: Vec<&str> = line.split(' ').collect();
        let [_, place, "cgroup", options, ..] = fields[..] else {
            return None;
        };
        options.split(',').any(|option| option == "memory").then_some(place)
    })
}

/// Inspects the mounted hierarchies.
pub fn detect() -> CgroupSupport {
    let mounts = std::fs::read_to_string("/proc/self/mounts").unwrap_or_default();
    let unified = std::fs::read_to_string("/sys/fs/cgroup/cgroup.controllers").ok();
    classify(&mounts, unified.as_deref())
}

/// Limits, by the names of the v1 hierarchies or v2 controllers that set them.
const LIMITS: [&str; 3] = ["cpu", "memory", "pids"];

fn classify(mounts: &str, unified: Option<&str>) -> CgroupSupport {
    if let Some(controllers) = unified {
        let there: Vec<&str> = controllers.split_whitespace().collect();
        return build_support(
            2,
            |limit| there.contains(&limit),
            "the controller is not enabled at the root of the hierarchy",
        );
    }
    let hierarchies: Vec<&str> = mounts
        .lines()
        .filter_map(|line| {
            let mut fields = line.split(' ');
            let (_, _, kind, options) = (fields.next()?, fields.next()?, fields.next()?, fields.next()?);
            (kind == "cgroup" && options.split(',').any(|option| option == "rw")).then_some(options)
        })
        .collect();
    let mounted = |limit: &str| hierarchies.iter().any(|options| options.split(',').any(|option| option == limit));
    if LIMITS.iter().any(|limit| mounted(limit)) {
        return build_support(1, mounted, "the controller's hierarchy is not mounted");
    }
    build_support(0, |_| false, "no usable hierarchy in /sys/fs/cgroup, of version 1 or 2")
}

fn build_support(version: u8, there: impl Fn(&str) -> bool, why: &str) -> CgroupSupport {
    let missing: Vec<String> = LIMITS.iter().filter(|limit| !there(limit)).map(|limit| (*limit).to_owned()).collect();
    let why = if missing.is_empty() { String::new() } else { why.to_owned() };
    CgroupSupport { version, missing, why }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_versions_are_told_apart() {
        let hybrid = "cgroup /sys/fs/cgroup/cpu cgroup rw,relatime,cpu 0 0\n\
                      cgroup /sys/fs/cgroup/memory cgroup rw,relatime,memory 0 0\n\
                      cgroup /sys/fs/cgroup/pids cgroup ro,relatime,pids 0 0\n\
                      cgroup2 /sys/fs/cgroup/unified cgroup2 rw 0 0\n";
        assert_eq!(memory_hierarchy(hybrid), Some("/sys/fs/cgroup/memory"));
        assert_eq!(memory_hierarchy("cgroup2 /sys/fs/cgroup cgroup2 rw 0 0\n"), None);
        let v1 = classify(hybrid, None);
        assert_eq!((v1.version, v1.missing), (1, vec!["pids".to_owned()]));
        let v2 = classify("cgroup2 /sys/fs/cgroup cgroup2 rw 0 0\n", Some("cpuset cpu io memory pids\n"));
        assert_eq!((v2.version, v2.missing.len()), (2, 0));
        let none = classify("proc /proc proc rw 0 0\n", None);
        assert_eq!((none.version, none.missing.len()), (0, 3));
    }
}
