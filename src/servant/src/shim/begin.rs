//! From exec to the forked creator, all in one thread.

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
use crate::container::Opened;
use crate::engine::{self, ContainerState, Enforced};
use crate::launch::{self, Exit, Launch, Runtime};
use crate::local::Isolation;
use crate::netns::NetNs;
use crate::process::Identity;
use crate::protocol::{self, FromShim};
use crate::{Error, sys};

/// How long a cgroup may take to become empty.
const PATIENCE: Duration = Duration::from_secs(10);

/// What the event loop starts with.
pub(super) struct Begun {
    pub(super) directory: PathBuf,
    pub(super) launch: Launch,
    pub(super) identity: Identity,
    pub(super) cgroup: Cgroup,
    /// The cgroup of the shim itself.
    pub(super) shim_cgroup: Cgroup,
    pub(super) enforced: Enforced,
    /// The daemon that started us.
    pub(super) control: UnixStream,
    /// Later daemons.
    pub(super) listener: UnixListener,
    /// Our end of init's socket.
    pub(super) init: OwnedFd,
    pub(super) creator: Creator,
    /// Held for as long as the uids are in use.
    pub(super) _uid_lock: OwnedFd,
}

pub(super) fn begin(directory: &Path) -> Result<Begun, Error> {
    // Fails only for the leader of a process group, such as a shim started by hand from a shell.
    let _ = nix::unistd::setsid();
    // What is written from here on, the log above all, is for this user alone.
    umask(Mode::from_bits_truncate(0o077));
    let control = take_control()?;
    let Received {
        network,
        uid_lock,
        opened,
    } = receive_descriptors(&control)?;
    let path = directory.join(launch::SPEC);
    let mut launch: Launch = launch::read(&path)?.ok_or_else(|| Error::Malformed {
        path: path.clone(),
        reason: "there is no launch record".into(),
    })?;
    for (index, descriptor) in opened {
        if let Some(mount) = launch.spec.mounts.get_mut(usize::from(index)) {
            mount.opened = Some(descriptor);
        }
    }
    let own = std::process::id() as i32;
    let identity = Identity::of(own).map_err(Error::call("reading our own start time"))?;
    let cgroup = Cgroup::planned(&launch.parent, &launch.spec);
    let shim_cgroup = Cgroup::of_shim(&launch.parent, &launch.spec.id);
    let runtime = Runtime {
        shim: identity,
        cgroup: cgroup.clone(),
        shim_cgroup: Some(shim_cgroup.clone()),
        uid_range: launch.uid_range,
    };
    launch::write(&directory.join(launch::RUNTIME), &runtime)?;
    let begun = prepare(directory, &launch, [&cgroup, &shim_cgroup], &network);
    // The creator has its own: held here they would keep what they are on from being unmounted.
    for mount in &mut launch.spec.mounts {
        mount.opened = None;
    }
    match begun {
        Ok(Prepared {
            enforced,
            init,
            listener,
            creator,
        }) => Ok(Begun {
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
            give_up(directory, &cgroup, identity, control, &error);
            Err(error)
        }
    }
}

/// Standard input is the daemon's socket; it becomes /dev/null, and every other descriptor that we were started with is
/// closed.
fn take_control() -> Result<UnixStream, Error> {
    // SAFETY: descriptor 0 is open, or the call fails; the result is a new descriptor that nobody else owns.
    let control = unsafe { libc::fcntl(0, libc::F_DUPFD_CLOEXEC, 3) };
    if control < 0 {
        return Err(Error::call(
            "taking the daemon's socket from standard input",
        )(io::Error::last_os_error()));
    }
    // SAFETY: as above.
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

/// What the daemon hands over.
struct Received {
    network: NetNs,
    uid_lock: OwnedFd,
    /// What was opened to be mounted, by the number of its mount.
    opened: Vec<(u8, Opened)>,
}

/// The network namespace and the lock on our uids come first, then what is to be mounted, one by one (`local/start.rs`).
fn receive_descriptors(control: &UnixStream) -> Result<Received, Error> {
    let (count, fds) = receive(control)?;
    let [network, uid_lock] = <[OwnedFd; 2]>::try_from(fds).map_err(|_| gone())?;
    let opened = (0..count).map(|_| {
        let (index, fds) = receive(control)?;
        let [descriptor] = <[OwnedFd; 1]>::try_from(fds).map_err(|_| gone())?;
        Ok((index, Opened::new(descriptor)))
    });
    Ok(Received {
        opened: opened.collect::<Result<_, Error>>()?,
        network: NetNs::from_fd(network)?,
        uid_lock,
    })
}

/// One byte, and the descriptors beside it.
fn receive(control: &UnixStream) -> Result<(u8, Vec<OwnedFd>), Error> {
    let (mut byte, mut fds) = ([0], [-1; MAX_FDS]);
    let received = socket::receive(control.as_raw_fd(), &mut byte, &mut fds);
    let (bytes, count) = received.map_err(Error::call("receiving from the daemon"))?;
    // SAFETY: received just now, owned by nobody else.
    let own = |fd: &i32| unsafe { OwnedFd::from_raw_fd(*fd) };
    let fds = fds[..count].iter().map(own).collect();
    if bytes == 1 {
        Ok((byte[0], fds))
    } else {
        Err(gone())
    }
}

fn gone() -> Error {
    let error = io::Error::new(io::ErrorKind::UnexpectedEof, "the daemon has gone");
    Error::call("receiving from the daemon")(error)
}

struct Prepared {
    enforced: Enforced,
    init: OwnedFd,
    listener: UnixListener,
    creator: Creator,
}

/// Network namespace, creator, and, while that works, the cgroup with its limits. Processes are moved between cgroups only
/// after a grace period of the kernel, for each hierarchy: that is what a start waits for longest.
fn prepare(
    directory: &Path,
    launch: &Launch,
    cgroups: [&Cgroup; 2],
    network: &NetNs,
) -> Result<Prepared, Error> {
    network.enter()?;
    let (ours, theirs) = socketpair(
        AddressFamily::Unix,
        SockType::SeqPacket,
        None,
        SockFlag::SOCK_CLOEXEC,
    )
    .map_err(Error::nix("socketpair for init"))?;
    let listener = listen(directory)?;
    let waiting = create::fork(directory, launch, theirs)?;
    let enforced = match confine(launch, cgroups, waiting.pid) {
        Ok(enforced) => enforced,
        Err(error) => {
            waiting.end();
            return Err(error);
        }
    };
    Ok(Prepared {
        enforced,
        init: ours,
        listener,
        creator: waiting.go_on(),
    })
}

/// Makes the cgroups, sets their limits, and moves the creator and this process into theirs.
fn confine(launch: &Launch, [cgroup, own]: [&Cgroup; 2], creator: u32) -> Result<Enforced, Error> {
    own.create()?;
    let asked = launch.limits_of_shim(&launch.spec.limits);
    let of_shim = own.set(&asked).limits;
    own.enter_alone()?;
    cgroup.create()?;
    let enforced = Enforced {
        shim: of_shim,
        ..cgroup.set(&launch.spec.limits)
    };
    let mut missing = engine::missing(&launch.spec.limits, &enforced.limits);
    // Where a controller is lacking altogether, that is told of the host, once.
    let controllers = launch.parent.controllers();
    let has = |name: &str| controllers.iter().any(|known| known == name);
    let of_shim = engine::missing(&asked, &of_shim).into_iter();
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
        return Err(Error::Isolation {
            missing: missing.join(", "),
            reason,
        });
    }
    // The container stays where it was made.
    cgroup.enter(creator)?;
    Ok(enforced)
}

/// Binds `shim.sock` through a descriptor of its directory: the path itself may be longer than an address can be.
fn listen(directory: &Path) -> Result<UnixListener, Error> {
    let opened = File::open(directory).map_err(Error::file("open", directory))?;
    let path = format!("/proc/self/fd/{}/{}", opened.as_raw_fd(), launch::SOCKET);
    UnixListener::bind(path).map_err(Error::file("listen on", directory.join(launch::SOCKET)))
}

/// Leaves word, and nothing else.
fn give_up(directory: &Path, cgroup: &Cgroup, shim: Identity, control: UnixStream, error: &Error) {
    let state = ContainerState::Failed {
        reason: error.to_string(),
    };
    if let Err(error) = cgroup.destroy(PATIENCE) {
        eprintln!("{error}");
    }
    let exit = Exit {
        state: state.clone(),
        nodes: Default::default(),
    };
    if let Err(error) = launch::write(&directory.join(launch::EXIT), &exit) {
        eprintln!("{error}");
    }
    let hello = FromShim::Hello {
        shim,
        state: state.into(),
        nodes: exit.nodes,
        enforced: Enforced::default(),
    };
    // When the daemon has gone, exit.json tells the next one.
    let _ = io::Write::write_all(&mut &control, &protocol::line(&hello));
}
