//! Giving up what is not needed once the container runs.
//!
//! From then on the shim hears what its servant's nodes say: the ROS Master in it answers them by HTTP and XML-RPC. Whoever made
//! it do something else would find a process of root without capabilities, which could still open what belongs to root, and
//! be root before the sockets of the daemon and of other services of the host. So there is:
//!
//! | what | by |
//! |---|---|
//! | no capability but CAP_KILL, since init has another user id; no new privileges | [`drop_all_but_kill`] |
//! | no file but those of the servant's directory and cgroups, and `/proc` to read | Landlock, where the kernel has it |
//! | no program, no socket but of IPv4 and IPv6, which the network namespace bounds; none of the calls that a servant may not make | seccomp |

use std::io;
use std::path::Path;

use caps::errors::CapsError;
use caps::{CapSet, Capability, CapsHashSet};
use landlock::{
    ABI, Access, AccessFs, BitFlags, CompatLevel, Compatible, Ruleset, RulesetAttr,
    RulesetCreatedAttr, RulesetError, path_beneath_rules,
};
use libseccomp::error::SeccompError;
use libseccomp::{ScmpAction, ScmpArgCompare, ScmpCompareOp, ScmpFilterContext, ScmpSyscall};

use crate::cgroup::Cgroup;
use crate::{Error, seccomp};

/// Everything of the above. `directory` is the servant's; the shim's thread, which must be the only one, is in `cgroups`, or
/// limits and removes them.
pub(super) fn confine(directory: &Path, cgroups: [&Cgroup; 2]) -> Result<(), Error> {
    drop_all_but_kill()?;
    keep_to_files(directory, cgroups)
        .map_err(|error| Error::call("keeping the shim to its files")(io::Error::other(error)))?;
    filter_calls()
        .map_err(|error| Error::call("filtering the shim's calls")(io::Error::other(error)))
}

/// Whether the kernel can keep a process to some files.
pub(super) fn can_keep_to_files() -> bool {
    let asked = Ruleset::default()
        .set_compatibility(CompatLevel::HardRequirement)
        .handle_access(AccessFs::from_all(ABI::V1));
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

/// Opens nothing else from here on. Does nothing where the kernel does not know Landlock.
fn keep_to_files(directory: &Path, cgroups: [&Cgroup; 2]) -> Result<(), RulesetError> {
    let all = AccessFs::from_all(ABI::V3);
    let read: BitFlags<AccessFs> = AccessFs::ReadFile | AccessFs::ReadDir;
    let change = read | AccessFs::WriteFile | AccessFs::Truncate;
    let cgroups = || cgroups.into_iter().flat_map(Cgroup::directories);
    Ruleset::default()
        .handle_access(all)?
        .create()?
        .add_rules(path_beneath_rules([directory], all & !AccessFs::Execute))?
        .add_rules(path_beneath_rules(cgroups(), change))?
        // To remove a directory is a right on the one above.
        .add_rules(path_beneath_rules(
            cgroups().filter_map(Path::parent),
            AccessFs::RemoveDir,
        ))?
        // Numbers of processes on the host, from descriptors of them.
        .add_rules(path_beneath_rules(["/proc"], read))?
        .restrict_self()?;
    Ok(())
}

/// Refuses with `EPERM` what the shim does not do any more once its descriptors are open.
fn filter_calls() -> Result<(), SeccompError> {
    let refused = ScmpAction::Errno(libc::EPERM);
    let mut filter = ScmpFilterContext::new(ScmpAction::Allow)?;
    // Of a name that the library does not know, a kernel as old knows no call.
    let known = |name: &str| ScmpSyscall::from_name(name).ok();
    let programs = ["execve", "execveat", "socketpair"];
    for call in seccomp::refused().chain(programs).filter_map(known) {
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
