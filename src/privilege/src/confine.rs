//! Dropping of privileges, for the calling thread alone and irrevocably.

use std::io;

use caps::{CapSet, Capability, CapsHashSet};
use nix::unistd::User;

use crate::Error;

/// Default user and group of threads without capabilities. One of the numbers that systemd's list of user ids
/// (UIDS-GIDS.md) assigns to nobody; servants use numbers from 0x70000000 on.
pub const DEFAULT_USER: u32 = 65521;

/// Capabilities that the daemon keeps for the engine's threads and the programs that these start.
pub const KEPT_CAPABILITIES: [Capability; 16] = [
    // Trees of builds and layers: owners, modes, set-user-id bits and file capabilities of packages.
    Capability::CAP_CHOWN,
    Capability::CAP_DAC_OVERRIDE,
    Capability::CAP_DAC_READ_SEARCH,
    Capability::CAP_FOWNER,
    Capability::CAP_FSETID,
    Capability::CAP_SETFCAP,
    // Whiteouts of overlays, devices of base images.
    Capability::CAP_MKNOD,
    // Killing containers, and finding the namespaces of shims.
    Capability::CAP_KILL,
    Capability::CAP_SYS_PTRACE,
    // User ids of containers and of apt's downloads; dropping capabilities.
    Capability::CAP_SETUID,
    Capability::CAP_SETGID,
    Capability::CAP_SETPCAP,
    // Namespaces, mounts, device filters of cgroups; lo in containers; ports below 1024.
    Capability::CAP_SYS_ADMIN,
    Capability::CAP_SYS_CHROOT,
    Capability::CAP_NET_ADMIN,
    Capability::CAP_NET_BIND_SERVICE,
];

/// Capability kept by the engine's threads that read untrusted files.
pub(crate) const READING: Capability = Capability::CAP_DAC_READ_SEARCH;

/// Kept if the process has it, but not required: for limits of open files of servants.
const KEPT_IF_THERE: Capability = Capability::CAP_SYS_RESOURCE;

/// User and group that determine the file permissions of a thread without capabilities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Account {
    /// User id; never root's.
    pub user: u32,
    /// Group id; never root's.
    pub group: u32,
}

impl Default for Account {
    fn default() -> Self {
        Self { user: DEFAULT_USER, group: DEFAULT_USER }
    }
}

impl Account {
    /// Looks up a user by name or number. A number need not have a name.
    pub fn find(written: &str) -> Result<Self, Error> {
        let unknown = || Error::Unknown { written: written.to_owned() };
        let account = match written.parse::<u32>() {
            Ok(number) => Self { user: number, group: number },
            Err(_) => {
                let found = User::from_name(written).ok().flatten();
                let found = found.ok_or_else(unknown)?;
                Self { user: found.uid.as_raw(), group: found.gid.as_raw() }
            }
        };
        // The largest number means "unchanged" to setresuid(2).
        let real = |number| number != 0 && number != u32::MAX;
        if real(account.user) && real(account.group) { Ok(account) } else { Err(unknown()) }
    }
}

fn capabilities_error(action: &'static str) -> impl FnOnce(caps::errors::CapsError) -> Error {
    move |source| Error::Capabilities { action, source }
}

/// Removes all capabilities but [`KEPT_CAPABILITIES`] from the calling thread and the threads it starts; programs they
/// execute cannot regain others. Must be called before the process has other threads.
pub fn limit_capabilities() -> Result<(), Error> {
    let kept: CapsHashSet = KEPT_CAPABILITIES.into_iter().chain([KEPT_IF_THERE]).collect();
    set_capabilities(&kept)
}

/// Restricts the calling thread to `capabilities`.
pub fn retain_capabilities(capabilities: &[Capability]) -> Result<(), Error> {
    set_capabilities(&capabilities.iter().copied().collect())
}

fn set_capabilities(kept: &CapsHashSet) -> Result<(), Error> {
    let bounding = caps::read(None, CapSet::Bounding).map_err(capabilities_error("read the bounding set"))?;
    // Without this capability nothing can be removed from the bounding set; nor can an executed program gain from the
    // set what this thread does not have.
    let may = caps::has_cap(None, CapSet::Effective, Capability::CAP_SETPCAP);
    if may.map_err(capabilities_error("read the effective capabilities"))? {
        for capability in bounding.difference(kept) {
            caps::drop(None, CapSet::Bounding, *capability)
                .map_err(capabilities_error("give up a capability for good"))?;
        }
    }
    let held = caps::read(None, CapSet::Permitted).map_err(capabilities_error("read the capabilities"))?;
    let kept: CapsHashSet = held.intersection(kept).copied().collect();
    caps::clear(None, CapSet::Ambient).map_err(capabilities_error("clear the ambient capabilities"))?;
    caps::clear(None, CapSet::Inheritable).map_err(capabilities_error("clear the inheritable capabilities"))?;
    caps::set(None, CapSet::Effective, &kept).map_err(capabilities_error("give up capabilities"))?;
    caps::set(None, CapSet::Permitted, &kept).map_err(capabilities_error("give up capabilities"))
}

/// Removes all privileges from the calling thread, irrevocably: it keeps no capability and no group but `account`'s,
/// all its user ids (real, effective, saved, file system) become `account`'s, and programs it executes gain nothing.
/// The result is verified by reading it back. Does nothing more to a thread that is confined already.
pub fn confine(account: Account) -> Result<(), Error> {
    confine_to(account, &CapsHashSet::new())
}

/// Confines the calling thread like [`confine`], but leaves it the right to read every file.
pub(crate) fn confine_to_reading(account: Account) -> Result<(), Error> {
    let failed =
        |errno: nix::errno::Errno| Error::Account { user: account.user, group: account.group, source: errno.into() };
    // Otherwise changing the user id would clear the capabilities.
    nix::sys::prctl::set_keepcaps(true).map_err(failed)?;
    confine_to(account, &CapsHashSet::from([READING]))?;
    nix::sys::prctl::set_keepcaps(false).map_err(failed)
}

fn confine_to(account: Account, kept: &CapsHashSet) -> Result<(), Error> {
    let failed_for_account = |source| Error::Account { user: account.user, group: account.group, source };
    let user = nix::unistd::geteuid().as_raw();
    if user != account.user {
        // The bounding set goes first: changing it needs a capability.
        let bounding = caps::read(None, CapSet::Bounding).map_err(capabilities_error("read the bounding set"))?;
        for capability in bounding.difference(kept) {
            caps::drop(None, CapSet::Bounding, *capability)
                .map_err(capabilities_error("give up a capability for good"))?;
        }
        become_account(account).map_err(failed_for_account)?;
    }
    set_capabilities(kept)?;
    nix::sys::prctl::set_no_new_privs().map_err(|errno| failed_for_account(errno.into()))?;
    verify_confined(account, kept)
}

/// Changes the ids of this thread by system calls; the C library's functions of the same names would change all threads
/// of the process.
fn become_account(account: Account) -> io::Result<()> {
    let Account { user, group } = account;
    let done = |outcome: libc::c_long| match outcome {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    };
    // SAFETY: an empty list of groups, which is not read.
    done(unsafe { libc::syscall(libc::SYS_setgroups, 0_usize, std::ptr::null::<u32>()) })?;
    // SAFETY: no pointers.
    done(unsafe { libc::syscall(libc::SYS_setresgid, group, group, group) })?;
    // SAFETY: no pointers.
    done(unsafe { libc::syscall(libc::SYS_setresuid, user, user, user) })
}

/// Verifies with the kernel that the calling thread has nothing beyond `kept`.
fn verify_confined(account: Account, kept: &CapsHashSet) -> Result<(), Error> {
    let left = |left: String| Err(Error::Left { left });
    for set in [CapSet::Effective, CapSet::Permitted, CapSet::Inheritable, CapSet::Ambient, CapSet::Bounding] {
        let held = caps::read(None, set).map_err(capabilities_error("read the capabilities"))?;
        let more = held.difference(kept).count();
        if more > 0 {
            return left(format!("{more} capabilities ({set:?})"));
        }
    }
    let users = nix::unistd::getresuid().map_err(io::Error::from);
    let groups = nix::unistd::getresgid().map_err(io::Error::from);
    if let (Ok(users), Ok(groups)) = (users, groups) {
        let users = [users.real, users.effective, users.saved];
        let groups = [groups.real, groups.effective, groups.saved];
        if users.iter().any(|user| user.as_raw() != account.user)
            || groups.iter().any(|group| group.as_raw() != account.group)
        {
            return left("another user".to_owned());
        }
    }
    match nix::unistd::getgroups() {
        Ok(groups) if groups.is_empty() => Ok(()),
        _ => left("supplementary groups".to_owned()),
    }
}

#[cfg(test)]
mod tests;
