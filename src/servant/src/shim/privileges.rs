//! Giving up what is not needed once the container runs.

use std::io;

use caps::errors::CapsError;
use caps::{CapSet, Capability, CapsHashSet};

use crate::Error;

/// Drops every capability but CAP_KILL, from the bounding set too, and rules out gaining any.
pub(super) fn drop_all_but_kill() -> Result<(), Error> {
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
