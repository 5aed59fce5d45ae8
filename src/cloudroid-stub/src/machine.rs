//! Which machine this is, as far as a server must know to tell two robots of one id apart.

use std::path::Path;

use ros::bus::{Bus, ParamValue};
use sha1::{Digest, Sha1};

/// What is read. Machines made of one disk image share the first two; no two have booted alike.
const IDS: [&str; 3] = [
    "/etc/machine-id",
    "/var/lib/dbus/machine-id",
    "/proc/sys/kernel/random/boot_id",
];

/// Tells this machine, since it was booted, from others, without telling which it is.
pub fn id() -> String {
    of(IDS.map(|path| std::fs::read_to_string(Path::new(path)).unwrap_or_default()))
}

fn of(ids: [String; 3]) -> String {
    let mut digest = Sha1::new();
    for id in ids {
        digest.update(id.trim());
        digest.update("\n");
    }
    let digest = digest.finalize();
    let short = digest.iter().take(8);
    short.map(|byte| format!("{byte:02x}")).collect()
}

/// Its host name, for messages.
pub fn host() -> String {
    let name = nix::unistd::gethostname().ok();
    let name = name.and_then(|name| name.into_string().ok());
    name.unwrap_or_default()
}

/// The id of the Master's life, where it has one: several machines with one Master are one robot.
pub async fn roscore(bus: &dyn Bus) -> String {
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
        assert_eq!(of(ids("a\n", "1")), of(ids("a", "1")));
        assert_ne!(
            of(ids("a", "1")),
            of(ids("a", "2")),
            "one disk, two machines"
        );
        assert_ne!(of(ids("a", "1")), of(ids("b", "1")));
        assert_eq!(id(), id());
    }
}
