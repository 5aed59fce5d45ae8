//! Removes what a servant left: its processes, its cgroup, its directories. Works the same if it ended on request, its
//! shim was killed, or the daemon died while creating it.

use std::fs;
use std::io;
use std::os::fd::AsFd;
use std::path::Path;
use std::time::Duration;

use crate::cgroup::Cgroup;
use crate::launch::{self, LaunchRecord, RuntimeRecord};
use crate::{Error, process, rootfs, sys};

/// Time for killed processes to disappear.
const PATIENCE: Duration = Duration::from_secs(10);

/// Removes everything that can be removed, then returns the first error. It is no error if there is nothing to remove.
pub(super) async fn sweep(id: &str, directory: &Path) -> Result<(), Error> {
    let (id, directory) = (id.to_owned(), directory.to_owned());
    let work = privilege::spawn_blocking(move || sweep_blocking(&id, &directory));
    work.await.unwrap_or_else(|panic| std::panic::resume_unwind(panic.into_panic()))
}

fn sweep_blocking(id: &str, directory: &Path) -> Result<(), Error> {
    // An unreadable record was just being written: then nothing that it names exists yet.
    let runtime: Option<RuntimeRecord> = launch::read_record(&directory.join(launch::RUNTIME)).unwrap_or_default();
    let launch: Option<LaunchRecord> = launch::read_record(&directory.join(launch::SPEC)).unwrap_or_default();
    let mut outcomes = Vec::new();
    if let Some(runtime) = runtime {
        outcomes.push(end_shim(&runtime));
        outcomes.push(runtime.cgroup.destroy(PATIENCE));
        let shim = runtime.shim_cgroup.as_ref();
        outcomes.extend(shim.map(|cgroup| cgroup.destroy(PATIENCE)));
        if runtime.cgroup.exists() || shim.is_some_and(Cgroup::exists) {
            outcomes.push(Err(Error::LeftOver { id: id.to_owned(), what: "a cgroup".into() }));
        }
    }
    if let Some(upper) = launch.and_then(|launch| launch.spec.writable) {
        outcomes.push(remove(&rootfs::work_directory(&upper)));
    }
    outcomes.push(remove(directory));
    outcomes.into_iter().collect()
}

/// Kills a running shim and waits for its end.
fn end_shim(runtime: &RuntimeRecord) -> Result<(), Error> {
    let Some(pidfd) = runtime.shim.open_pidfd().map_err(Error::call("looking for a shim"))? else {
        return Ok(());
    };
    let _ = sys::pidfd_send_signal(pidfd.as_fd(), libc::SIGKILL);
    let mut watched = [nix::poll::PollFd::new(pidfd.as_fd(), nix::poll::PollFlags::POLLIN)];
    let milliseconds = nix::poll::PollTimeout::try_from(PATIENCE).unwrap_or(nix::poll::PollTimeout::MAX);
    let _ = nix::poll::poll(&mut watched, milliseconds);
    if process::has_ended(&pidfd) {
        return Ok(());
    }
    let source = io::Error::from(io::ErrorKind::TimedOut);
    Err(Error::Call { call: "killing a shim", source })
}

fn remove(directory: &Path) -> Result<(), Error> {
    match fs::remove_dir_all(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result.map_err(Error::file("remove", directory)),
    }
}
