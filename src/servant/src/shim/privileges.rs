//! Dropping of the privileges that are not needed once the container runs.
//!
//! From then on the shim processes data from its servant's nodes: the ROS Master in it answers them by HTTP and
//! XML-RPC. An attacker who took it over would control a process of root without capabilities, which could still open
//! root's files, and be root to the sockets of the daemon and of other services of the host. Therefore:
//!
//! | restriction | by |
//! |---|---|
//! | no capability but CAP_KILL (init has another user id), no new privileges | [`drop_all_but_kill`] |
//! | no file but those of the servant's directory and cgroups, and `/proc` read-only | Landlock, if supported |
//! | no program, no call refused to servants; only IPv4 and IPv6 sockets, bounded by the network namespace | seccomp |

use std::io;
use std::path::Path;

use caps::errors::CapsError;
use caps::{CapSet, Capability, CapsHashSet};
use landlock::{
    ABI, Access, AccessFs, BitFlags, CompatLevel, Compatible, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetError,
    path_beneath_rules,
};
use libseccomp::error::SeccompError;
use libseccomp::{ScmpAction, ScmpArgCompare, ScmpCompareOp, ScmpFilterContext, ScmpSyscall};

use crate::cgroup::Cgroup;
use crate::{Error, seccomp};

/// Applies all of the restrictions. `directory` is the servant's; the shim's thread, which must be the only one, is in
/// `cgroups`, or limits and removes them.
pub(super) fn confine(directory: &Path, cgroups: [&Cgroup; 2]) -> Result<(), Error> {
    drop_all_but_kill()?;
    restrict_files(directory, cgroups)
        .map_err(|error| Error::call("keeping the shim to its files")(io::Error::other(error)))?;
    install_seccomp_filter().map_err(|error| Error::call("filtering the shim's calls")(io::Error::other(error)))
}

/// Returns whether the kernel supports restricting a process to some files (Landlock).
pub(super) fn can_restrict_files() -> bool {
    let asked =
        Ruleset::default().set_compatibility(CompatLevel::HardRequirement).handle_access(AccessFs::from_all(ABI::V1));
    asked.is_ok()
}

/// Drops every capability but CAP_KILL, from the bounding set too, and rules out gaining any.
fn drop_all_but_kill() -> Result<(), Error> {
    let kept = CapsHashSet::from([Capability::CAP_KILL]);
    let dropped = || -> Result<(), CapsError> {
        for capability in caps::runtime::thread_all_supported().difference(&kept) {
            caps::drop(None, CapSet::Bounding, *capability)?;
        }
        caps::clear(None, CapSet::Ambient)?;
        caps::clear(None, CapSet::Inheritable)?;
        caps::set(None, CapSet::Effective, &kept)?;
        caps::set(None, CapSet::Permitted, &kept)
    };
    let failed = |error| Error::call("dropping capabilities")(io::Error::other(error));
    dropped().map_err(failed)?;
    nix::sys::prctl::set_no_new_privs().map_err(Error::nix("ruling out new privileges"))
}

/// Restricts this process to its own files from here on. Does nothing if the kernel does not support Landlock.
fn restrict_files(directory: &Path, cgroups: [&Cgroup; 2]) -> Result<(), RulesetError> {
    let all = AccessFs::from_all(ABI::V3);
    let read: BitFlags<AccessFs> = AccessFs::ReadFile | AccessFs::ReadDir;
    let change = read | AccessFs::WriteFile | AccessFs::Truncate;
    let cgroups = || cgroups.into_iter().flat_map(Cgroup::directories);
    Ruleset::default()
        .handle_access(all)?
        .create()?
        .add_rules(path_beneath_rules([directory], all & !AccessFs::Execute))?
        .add_rules(path_beneath_rules(cgroups(), change))?
        // Removing a directory needs a right on its parent.
        .add_rules(path_beneath_rules(cgroups().filter_map(Path::parent), AccessFs::RemoveDir))?
        // Host pids of processes, which are read from their pidfds.
        .add_rules(path_beneath_rules(["/proc"], read))?
        .restrict_self()?;
    Ok(())
}

/// Refuses with `EPERM` the calls that the shim no longer needs once its descriptors are open.
fn install_seccomp_filter() -> Result<(), SeccompError> {
    let refused = ScmpAction::Errno(libc::EPERM);
    let mut filter = ScmpFilterContext::new(ScmpAction::Allow)?;
    // A call whose name the library does not know does not exist in a kernel of that age.
    let known = |name: &str| ScmpSyscall::from_name(name).ok();
    let programs = ["execve", "execveat", "socketpair"];
    for call in seccomp::refused_calls().chain(programs).filter_map(known) {
        filter.add_rule(refused, call)?;
    }
    if let Some(socket) = known("socket") {
        let family = |compare, family| ScmpArgCompare::new(0, compare, family);
        let (v4, v6) = (libc::AF_INET as u64, libc::AF_INET6 as u64);
        for other in (0..v6).filter(|other| *other != v4) {
            let is_other = family(ScmpCompareOp::Equal, other);
            filter.add_rule_conditional(refused, socket, &[is_other])?;
        }
        let is_greater = family(ScmpCompareOp::Greater, v6);
        filter.add_rule_conditional(refused, socket, &[is_greater])?;
    }
    filter.load()
}
