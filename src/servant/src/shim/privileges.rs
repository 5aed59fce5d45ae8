//! Giving up what is not needed once the container runs.

use std::io;

use crate::Error;

/// CAP_KILL (linux/capability.h).
const KILL: u32 = 5;

#[repr(C)]
struct Header {
    version: u32,
    pid: i32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Sets {
    effective: u32,
    permitted: u32,
    inheritable: u32,
}

/// _LINUX_CAPABILITY_VERSION_3: two words for each set.
const VERSION: u32 = 0x2008_0522;

/// Drops every capability but CAP_KILL, from the bounding set too, and rules out gaining any.
pub(super) fn drop_all_but_kill() -> Result<(), Error> {
    let failed = |call| Err(Error::call(call)(io::Error::last_os_error()));
    // SAFETY: numbers only; the loop ends at the first capability that the kernel does not know.
    unsafe {
        for capability in 0..64 {
            if libc::prctl(libc::PR_CAPBSET_READ, capability, 0, 0, 0) < 0 {
                break;
            }
            if capability != KILL && libc::prctl(libc::PR_CAPBSET_DROP, capability, 0, 0, 0) != 0 {
                return failed("dropping a capability");
            }
        }
        if libc::prctl(
            libc::PR_CAP_AMBIENT,
            libc::PR_CAP_AMBIENT_CLEAR_ALL,
            0,
            0,
            0,
        ) != 0
        {
            return failed("clearing ambient capabilities");
        }
        if libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0 {
            return failed("ruling out new privileges");
        }
    }
    let header = Header {
        version: VERSION,
        pid: 0,
    };
    let kept = Sets {
        effective: 1 << KILL,
        permitted: 1 << KILL,
        inheritable: 0,
    };
    let sets = [kept, Sets::default()];
    // SAFETY: live structures laid out as capset(2) says for this version.
    if unsafe { libc::syscall(libc::SYS_capset, &header, sets.as_ptr()) } != 0 {
        return failed("dropping capabilities");
    }
    Ok(())
}
