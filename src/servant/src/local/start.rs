//! Starting a servant: directory, uids, network, shim.

use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd, AsRawFd, OwnedFd, RawFd};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;

use init::socket;

use super::handle::{self, LocalServant};
use super::{EngineShared, sweep, validate};
use crate::container::{ContainerSpec, Mount};
use crate::launch::{self, LaunchRecord};
use crate::netns::NetNs;
use crate::process::ProcessIdentity;
use crate::{Error, uids};

pub(super) async fn start(shared: &EngineShared, mut spec: ContainerSpec) -> Result<Arc<LocalServant>, Error> {
    spec.limits = spec.limits.or(shared.config.default_limits);
    validate::validate(&spec)?;
    let id = spec.id.clone();
    let directory = shared.config.home_servants_dir.join(&id);
    match fs::DirBuilder::new().mode(0o700).create(&directory) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            return Err(Error::Exists { id });
        }
        result => result.map_err(Error::file("make", &directory))?,
    }
    let started = start_in(shared, spec, &directory).await;
    if started.is_err() {
        if let Err(error) = sweep::sweep(&id, &directory).await {
            tracing::warn!(%error, id, "a servant that did not start left something");
        }
    }
    started
}

async fn start_in(shared: &EngineShared, spec: ContainerSpec, directory: &Path) -> Result<Arc<LocalServant>, Error> {
    let network = shared.networks.take()?;
    let config = &shared.config;
    let held = uids::claimed_ranges(&config.home_servants_dir)?;
    let (first, lock) = uids::lock_free_range(&config.uid_locks, config.uid_base, &held)?;
    let launch = LaunchRecord {
        uid_range: (first, uids::RANGE),
        parent: shared.parent.clone(),
        shim_limits: shared.config.shim_limits,
        quotas: shared.config.quotas,
        isolation: shared.config.isolation,
        grace: shared.config.grace,
        init: shared.config.init.clone(),
        spec,
    };
    launch::write_record(&directory.join(launch::SPEC), &launch)?;
    let (control, shim) = spawn(shared, directory)?;
    send_descriptors(&control, &network, &lock, &launch.spec.mounts)?;
    // The shim holds the lock from here on.
    drop(lock);
    let kept_logs = &shared.config.kept_logs_dir;
    let place = handle::ServantLocation { id: &launch.spec.id, directory, kept_logs, watches: &shared.watches };
    handle::wait_until_running(&launch, place, network, control, shim).await
}

/// Starts the shim with our socket as its standard input. Nothing runs between fork and exec, so that posix_spawn can
/// be used and the daemon's memory is not copied.
fn spawn(shared: &EngineShared, directory: &Path) -> Result<(UnixStream, ProcessIdentity), Error> {
    let (control, theirs) = UnixStream::pair().map_err(Error::call("socketpair for the shim"))?;
    let path = directory.join(launch::SHIM_LOG);
    let mut options = File::options();
    options.write(true).create(true).truncate(true).mode(0o600);
    let log = options.open(&path).map_err(Error::file("make", &path))?;
    let log_again = log.try_clone().map_err(Error::file("open", &path))?;
    let (program, arguments) = shared.config.shim_command.split_first().ok_or_else(|| Error::Call {
        call: "starting a shim without a shim_command",
        source: io::Error::from(io::ErrorKind::InvalidInput),
    })?;
    let mut command = tokio::process::Command::new(program);
    command.args(arguments).arg(directory).env_clear();
    // There is one process per servant, and each would have its own allocator arenas.
    command.env("MALLOC_ARENA_MAX", "1");
    for name in ["PATH", "RUST_BACKTRACE", "RUST_LOG"] {
        if let Some(value) = std::env::var_os(name) {
            command.env(name, value);
        }
    }
    command.stdin(Stdio::from(OwnedFd::from(theirs))).stdout(log).stderr(log_again);
    let mut child = command.spawn().map_err(Error::file("start the shim", program))?;
    let pid = child.id().unwrap_or_default() as i32;
    let identity = ProcessIdentity::from_pid(pid).map_err(Error::call("looking at the shim just started"))?;
    // The shim outlives the daemon; while the daemon lives, it reaps the shim.
    tokio::spawn(async move {
        let _ = child.wait().await;
    });
    Ok((control, identity))
}

/// Sends the network namespace and the lock with one byte that says how many messages follow; then each opened mount
/// source with the index of its mount.
fn send_descriptors(control: &UnixStream, network: &NetNs, lock: &OwnedFd, mounts: &[Mount]) -> Result<(), Error> {
    let failed = Error::call("sending to the shim");
    let opened: Vec<(u8, RawFd)> = (0..=u8::MAX)
        .zip(mounts)
        .filter_map(|(index, mount)| Some((index, mount.opened.as_ref()?.as_fd().as_raw_fd())))
        .collect();
    let count = opened.len() as u8;
    let send = |byte: u8, fds: &[RawFd]| socket::send(control.as_raw_fd(), &[byte], fds).map(drop);
    send(count, &[network.as_fd().as_raw_fd(), lock.as_raw_fd()])
        .and_then(|()| opened.iter().try_for_each(|(index, fd)| send(*index, &[*fd])))
        .map_err(failed)
}
