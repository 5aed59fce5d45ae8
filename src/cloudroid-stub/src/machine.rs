//! Identity of this machine, with which a server distinguishes two robots that use the same id.

use std::path::Path;

use ros::bus::{Bus, ParamValue};
use sha1::{Digest, Sha1};

/// Files that identify a machine. Machines cloned from one disk image share the first two; no two share a boot id.
const IDS: [&str; 3] = ["/etc/machine-id", "/var/lib/dbus/machine-id", "/proc/sys/kernel/random/boot_id"];

/// Returns an id that distinguishes this machine, since its last boot, from others without revealing which it is.
pub fn id() -> String {
    digest_ids(IDS.map(|path| std::fs::read_to_string(Path::new(path)).unwrap_or_default()))
}

fn digest_ids(ids: [String; 3]) -> String {
    let mut digest = Sha1::new();
    for id in ids {
        digest.update(id.trim());
        digest.update("\n");
    }
    let digest = digest.finalize();
    let short = digest.iter().take(8);
    short.map(|byte| format!("{byte:02x}")).collect()
}

/// Returns the host name, for messages.
pub fn host() -> String {
    let name = nix::unistd::gethostname().ok();
    let name = name.and_then(|name| name.into_string().ok());
    name.unwrap_or_default()
}

/// Returns the run id of the ROS Master, or an empty string if there is none. Several machines with one Master are one
/// robot.
pub async fn roscore_id(bus: &dyn Bus) -> String {
    match bus.parameter("/run_id").await {
        Ok(ParamValue::String(id)) => id,
        _ => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_of_one_disk_are_told_apart() {
        let ids = |machine: &str, boot: &str| [machine.into(), String::new(), boot.into()];
        assert_eq!(digest_ids(ids("a\n", "1")), digest_ids(ids("a", "1")));
        assert_ne!(digest_ids(ids("a", "1")), digest_ids(ids("a", "2")), "one disk, two machines");
        assert_ne!(digest_ids(ids("a", "1")), digest_ids(ids("b", "1")));
        assert_eq!(id(), id());
    }
}
