//! Setup from exec to the forked creator, all in one thread.

use std::fs::File;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::Duration;

use init::socket::{self, MAX_FDS};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, socketpair};
use nix::sys::stat::{Mode, umask};

use super::create::{self, Creator};
use crate::cgroup::Cgroup;
use crate::container::OpenedSource;
use crate::engine::{self, ContainerState, EnforcedLimits};
use crate::launch::{self, ExitRecord, LaunchRecord, RuntimeRecord};
use crate::local::Isolation;
use crate::netns::NetNs;
use crate::process::ProcessIdentity;
use crate::protocol::{self, ShimMessage};
use crate::{Error, sys};

/// Time for a cgroup to become empty.
const PATIENCE: Duration = Duration::from_secs(10);

/// Everything that the event loop starts with.
pub(super) struct PreparedShim {
    pub(super) directory: PathBuf,
    pub(super) launch: LaunchRecord,
    pub(super) identity: ProcessIdentity,
    pub(super) cgroup: Cgroup,
    /// Cgroup of the shim itself.
    pub(super) shim_cgroup: Cgroup,
    pub(super) enforced: EnforcedLimits,
    /// Connection of the daemon that started us.
    pub(super) control: UnixStream,
    /// Listener for later daemons.
    pub(super) listener: UnixListener,
    /// Our end of init's socket.
    pub(super) init: OwnedFd,
    pub(super) creator: Creator,
    /// Held for as long as the uids are in use.
    pub(super) _uid_lock: OwnedFd,
}

pub(super) fn begin(directory: &Path) -> Result<PreparedShim, Error> {
    // Fails only for the leader of a process group, such as a shim started by hand from a shell.
    let _ = nix::unistd::setsid();
    // Files written from here on, in particular the log, are for this user alone.
    umask(Mode::from_bits_truncate(0o077));
    let control = take_control()?;
    let ReceivedDescriptors { network, uid_lock, opened } = receive_descriptors(&control)?;
    let path = directory.join(launch::SPEC);
    let mut launch: LaunchRecord = launch::read_record(&path)?
        .ok_or_else(|| Error::Malformed { path: path.clone(), reason: "there is no launch record".into() })?;
    for (index, descriptor) in opened {
        if let Some(mount) = launch.spec.mounts.get_mut(usize::from(index)) {
            mount.opened = Some(descriptor);
        }
    }
    let own = std::process::id() as i32;
    let identity = ProcessIdentity::from_pid(own).map_err(Error::call("reading our own start time"))?;
    let cgroup = Cgroup::for_servant(&launch.parent, &launch.spec);
    let shim_cgroup = Cgroup::for_shim(&launch.parent, &launch.spec.id);
    let runtime = RuntimeRecord {
        shim: identity,
        cgroup: cgroup.clone(),
        shim_cgroup: Some(shim_cgroup.clone()),
        uid_range: launch.uid_range,
    };
    launch::write_record(&directory.join(launch::RUNTIME), &runtime)?;
    let begun = prepare(directory, &launch, [&cgroup, &shim_cgroup], &network);
    // The creator has its own: held here they would keep the file systems they are on from being unmounted.
    for mount in &mut launch.spec.mounts {
        mount.opened = None;
    }
    match begun {
        Ok(PreparedContainer { enforced, init, listener, creator }) => Ok(PreparedShim {
            directory: directory.into(),
            launch,
            identity,
            cgroup,
            shim_cgroup,
            enforced,
            control,
            listener,
            init,
            creator,
            _uid_lock: uid_lock,
        }),
        Err(error) => {
            record_failure(directory, &cgroup, identity, control, &error);
            Err(error)
        }
    }
}

/// Takes the daemon's socket from standard input, replaces it by /dev/null, and closes every other inherited
/// descriptor.
fn take_control() -> Result<UnixStream, Error> {
    // SAFETY: descriptor 0 is open, or the call fails; the result is a new descriptor that nobody else owns.
    let control = unsafe { libc::fcntl(0, libc::F_DUPFD_CLOEXEC, 3) };
    if control < 0 {
        return Err(Error::call("taking the daemon's socket from standard input")(io::Error::last_os_error()));
    }
    // SAFETY: see above.
    let control = unsafe { OwnedFd::from_raw_fd(control) };
    let null = File::open("/dev/null").map_err(Error::file("open", "/dev/null"))?;
    // SAFETY: both are open descriptors.
    if unsafe { libc::dup2(null.as_raw_fd(), 0) } < 0 {
        return Err(Error::call("dup2")(io::Error::last_os_error()));
    }
    drop(null);
    let kept = control.as_raw_fd() as u32;
    sys::close_range(3, kept - 1).map_err(Error::call("close_range"))?;
    sys::close_range(kept + 1, u32::MAX).map_err(Error::call("close_range"))?;
    Ok(UnixStream::from(control))
}

/// Descriptors sent by the daemon.
struct ReceivedDescriptors {
    network: NetNs,
    uid_lock: OwnedFd,
    /// Opened mount sources, with the index of their mount.
    opened: Vec<(u8, OpenedSource)>,
}

/// Receives the network namespace and the lock on our uids, then the mount sources one by one (see `local/start.rs`).
fn receive_descriptors(control: &UnixStream) -> Result<ReceivedDescriptors, Error> {
    let (count, fds) = receive(control)?;
    let [network, uid_lock] = <[OwnedFd; 2]>::try_from(fds).map_err(|_| daemon_gone_error())?;
    let opened = (0..count).map(|_| {
        let (index, fds) = receive(control)?;
        let [descriptor] = <[OwnedFd; 1]>::try_from(fds).map_err(|_| daemon_gone_error())?;
        Ok((index, OpenedSource::new(descriptor)))
    });
    Ok(ReceivedDescriptors {
        opened: opened.collect::<Result<_, Error>>()?,
        network: NetNs::from_fd(network)?,
        uid_lock,
    })
}

/// Receives one byte and the descriptors attached to it.
fn receive(control: &UnixStream) -> Result<(u8, Vec<OwnedFd>), Error> {
    let (mut byte, mut fds) = ([0], [-1; MAX_FDS]);
    let received = socket::receive(control.as_raw_fd(), &mut byte, &mut fds);
    let (bytes, count) = received.map_err(Error::call("receiving from the daemon"))?;
    // SAFETY: just received, owned by nobody else.
    let own = |fd: &i32| unsafe { OwnedFd::from_raw_fd(*fd) };
    let fds = fds[..count].iter().map(own).collect();
    if bytes == 1 { Ok((byte[0], fds)) } else { Err(daemon_gone_error()) }
}

fn daemon_gone_error() -> Error {
    let error = io::Error::new(io::ErrorKind::UnexpectedEof, "the daemon is gone");
    Error::call("receiving from the daemon")(error)
}

struct PreparedContainer {
    enforced: EnforcedLimits,
    init: OwnedFd,
    listener: UnixListener,
    creator: Creator,
}

/// Prepares the network namespace, the creator, and, while that works, the cgroup with its limits. Moving a process
/// between cgroups takes an RCU grace period of the kernel for each hierarchy: that is the longest wait of a start.
fn prepare(
    directory: &Path,
    launch: &LaunchRecord,
    cgroups: [&Cgroup; 2],
    network: &NetNs,
) -> Result<PreparedContainer, Error> {
    network.enter()?;
    let (ours, theirs) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, SockFlag::SOCK_CLOEXEC)
        .map_err(Error::nix("socketpair for init"))?;
    let listener = listen(directory)?;
    let waiting = create::fork(directory, launch, theirs)?;
    let enforced = match confine(launch, cgroups, waiting.pid) {
        Ok(enforced) => enforced,
        Err(error) => {
            waiting.kill();
            return Err(error);
        }
    };
    Ok(PreparedContainer { enforced, init: ours, listener, creator: waiting.resume() })
}

/// Creates the cgroups, sets their limits, and moves the creator and this process into theirs.
fn confine(launch: &LaunchRecord, [cgroup, own]: [&Cgroup; 2], creator: u32) -> Result<EnforcedLimits, Error> {
    own.create()?;
    let asked = launch.shim_limits_for(&launch.spec.limits);
    let of_shim = own.set_limits(&asked).limits;
    own.add_self()?;
    cgroup.create()?;
    let enforced = EnforcedLimits { shim: of_shim, ..cgroup.set_limits(&launch.spec.limits) };
    let mut missing = engine::missing_limits(&launch.spec.limits, &enforced.limits);
    // A controller that is missing altogether is reported once, for the host.
    let controllers = launch.parent.controllers();
    let has = |name: &str| controllers.iter().any(|known| known == name);
    let of_shim = engine::missing_limits(&asked, &of_shim).into_iter();
    missing.extend(of_shim.filter_map(|name| match name {
        "memory" if has("memory") => Some("the shim's memory"),
        "cpus" if has("cpu") => Some("the shim's cpus"),
        _ => None,
    }));
    if launch.isolation == Isolation::Require && !missing.is_empty() {
        let reason = match launch.parent.reason.as_str() {
            "" => format!("cgroup v{}", launch.parent.version),
            reason => reason.to_owned(),
        };
        return Err(Error::Isolation { missing: missing.join(", "), reason });
    }
    // The container stays in the cgroup in which it was created.
    cgroup.add_process(creator)?;
    Ok(enforced)
}

/// Binds `shim.sock` through a descriptor of its directory, since the path itself may be longer than a socket address
/// allows.
fn listen(directory: &Path) -> Result<UnixListener, Error> {
    let opened = File::open(directory).map_err(Error::file("open", directory))?;
    let path = format!("/proc/self/fd/{}/{}", opened.as_raw_fd(), launch::SOCKET);
    UnixListener::bind(path).map_err(Error::file("listen on", directory.join(launch::SOCKET)))
}

/// Records the failure and leaves nothing else.
fn record_failure(directory: &Path, cgroup: &Cgroup, shim: ProcessIdentity, control: UnixStream, error: &Error) {
    let state = ContainerState::Failed { reason: error.to_string() };
    if let Err(error) = cgroup.destroy(PATIENCE) {
        eprintln!("{error}");
    }
    let exit = ExitRecord { state: state.clone(), nodes: Default::default() };
    if let Err(error) = launch::write_record(&directory.join(launch::EXIT), &exit) {
        eprintln!("{error}");
    }
    let hello = ShimMessage::Hello {
        shim,
        state: state.into(),
        nodes: exit.nodes,
        enforced: EnforcedLimits::default(),
        can_exec: false,
    };
    // If the daemon is gone, exit.json tells the next one.
    let _ = io::Write::write_all(&mut &control, &protocol::to_line(&hello));
}
