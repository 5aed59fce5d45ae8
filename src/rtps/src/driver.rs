//! Moves datagrams between sockets and the engine, and calls it when its time comes. One task for each participant.

#[cfg(test)]
mod tests;

use std::io;
use std::net::UdpSocket;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create,
    timerfd_settime,
};
use socket2::SockRef;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::Notify;

use crate::engine::{Datagram, Engine};
use crate::flow::Flow;
use crate::locator::MULTICAST;
use crate::network::Network;

/// Timers of tokio count in milliseconds, in which a receiver's buffer runs empty several times; hence a timer of the kernel, which
/// zero would stop.
const SHORTEST: Duration = Duration::from_micros(10);
/// How often it is looked which ports are bound.
pub(crate) const PORTS: Duration = Duration::from_millis(200);
/// Datagrams that are taken at once from one socket, before others have their turn.
const AT_ONCE: usize = 32;
/// How long until it is tried again to send where it cannot be awaited that there is room.
const NO_ROOM: Duration = Duration::from_millis(1);
/// The longest datagram.
const LONGEST: usize = 65_536;
/// A shorter datagram is copied out of the buffer, a longer one takes the buffer with it.
const COPIED: usize = 16 << 10;

/// What is locked together.
pub(crate) struct Core {
    pub engine: Engine,
    flow: Flow,
    /// Out of which interfaces is sent what is said to all.
    network: Network,
    /// A datagram for which the sending socket had no room.
    stalled: Option<Datagram>,
}

/// A socket of which is told that something has come, and not that it has room: it would be told after each datagram that was sent, and a
/// message would wake its participant's task once more.
type Incoming = AsyncFd<UdpSocket>;

/// What a participant, its ends and its task share.
pub(crate) struct Shared {
    core: Mutex<Core>,
    wake: Notify,
    /// Where ends are announced.
    discovery: Incoming,
    /// Where samples come in, and all goes out.
    user: Incoming,
    /// Where participants announce themselves to all.
    multicast: Option<Incoming>,
}

/// The sockets of a participant, which do not block.
pub(crate) struct Sockets {
    pub discovery: UdpSocket,
    pub user: UdpSocket,
    pub multicast: Option<UdpSocket>,
}

/// Why something waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Waits {
    Nothing,
    /// Receivers have no room; when to look again.
    Receivers(Duration),
    /// The sending socket has none.
    Socket,
}

impl Shared {
    pub fn new(
        engine: Engine,
        flow: Flow,
        sockets: Sockets,
        network: Network,
    ) -> io::Result<Arc<Self>> {
        let Sockets {
            discovery,
            user,
            multicast,
        } = sockets;
        let core = Mutex::new(Core {
            engine,
            flow,
            network: Network::new(Vec::new()),
            stalled: None,
        });
        let shared = Self {
            core,
            wake: Notify::new(),
            discovery: incoming(discovery)?,
            user: incoming(user)?,
            multicast: multicast.map(incoming).transpose()?,
        };
        shared.join_groups(&mut shared.core.lock(), network);
        Ok(Arc::new(shared))
    }

    /// The interfaces of this machine, as they are now.
    pub fn network_is(&self, network: Network) {
        let mut core = self.core.lock();
        if core.network != network {
            tracing::debug!(?network, "the networks of a DDS participant have changed");
            core.engine.network_changed(Instant::now(), network.clone());
            self.join_groups(&mut core, network);
            self.wake.notify_one();
        }
    }

    /// Hears what is said to all in each of these networks.
    fn join_groups(&self, core: &mut Core, network: Network) {
        core.flow.set_own(network.addresses());
        if let Some(socket) = &self.multicast {
            let socket = SockRef::from(socket.get_ref());
            for address in network.addresses() {
                match socket.join_multicast_v4(&MULTICAST, &address) {
                    Ok(()) => {}
                    // It had this address before, and has it again.
                    Err(error) if error.kind() == io::ErrorKind::AddrInUse => {}
                    Err(error) => {
                        tracing::debug!(%error, %address, "DDS participants are not heard by multicast there");
                    }
                }
            }
        }
        core.network = network;
    }

    /// Does something with the engine, and sends at once what can be sent.
    pub fn with<T>(&self, work: impl FnOnce(Instant, &mut Engine) -> T) -> T {
        let mut core = self.core.lock();
        let before = core.engine.tick_at();
        let result = work(Instant::now(), &mut core.engine);
        let waits = self.flush(&mut core);
        if waits != Waits::Nothing || core.engine.tick_at() < before {
            self.wake.notify_one();
        }
        result
    }

    /// Only looks at it.
    pub fn look<T>(&self, look: impl FnOnce(&Engine) -> T) -> T {
        look(&self.core.lock().engine)
    }

    fn flush(&self, core: &mut Core) -> Waits {
        let Core {
            engine,
            flow,
            network,
            stalled,
        } = core;
        flow.take_wait();
        loop {
            let next = stalled.take().or_else(|| {
                engine
                    .transmit(&mut |to, length, again| flow.room(Instant::now(), to, length, again))
            });
            let Some(datagram) = next else {
                return flow.take_wait().map_or(Waits::Nothing, Waits::Receivers);
            };
            if datagram.to.ip().is_multicast() {
                self.send_to_all(&datagram, network);
                continue;
            }
            let socket = SockRef::from(self.user.get_ref());
            match socket.send_to_vectored(&datagram.parts(), &datagram.to.into()) {
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    *stalled = Some(datagram);
                    return Waits::Socket;
                }
                // A network that is gone, or a receiver that is not there: as if it was lost on the way.
                Err(error) => tracing::trace!(%error, to = %datagram.to, "a datagram was not sent"),
            }
        }
    }

    /// Sends a datagram out of each interface. One that cannot be sent is said again with the next announcement.
    fn send_to_all(&self, datagram: &Datagram, network: &Network) {
        let socket = SockRef::from(self.user.get_ref());
        for address in network.addresses() {
            let sent = socket
                .set_multicast_if_v4(&address)
                .and_then(|()| socket.send_to_vectored(&datagram.parts(), &datagram.to.into()));
            if let Err(error) = sent {
                tracing::trace!(%error, %address, "nothing was said to all there");
            }
        }
    }

    /// Takes what has come on a socket.
    fn take(&self, socket: &Incoming, buffer: &mut Vec<u8>) {
        let mut came = Vec::with_capacity(AT_ONCE);
        while came.len() < AT_ONCE {
            buffer.resize(LONGEST, 0);
            let received = socket.try_io(Interest::READABLE, |socket| socket.recv_from(buffer));
            let Ok((length, source)) = received else {
                break;
            };
            let datagram = if length <= COPIED {
                Bytes::copy_from_slice(&buffer[..length])
            } else {
                buffer.truncate(length);
                Bytes::from(std::mem::take(buffer))
            };
            came.push((source.ip(), datagram));
        }
        if came.is_empty() {
            return;
        }
        let deliveries = {
            let mut core = self.core.lock();
            let now = Instant::now();
            for (source, datagram) in &came {
                core.engine.receive(now, *source, datagram);
            }
            if core.engine.tick_at() <= now {
                core.engine.tick(now);
            }
            core.engine.take_deliveries()
        };
        for (sink, sample) in deliveries {
            sink.sample(sample);
        }
    }

    fn tick(&self) {
        let deliveries = {
            let mut core = self.core.lock();
            core.engine.tick(Instant::now());
            core.engine.take_deliveries()
        };
        for (sink, sample) in deliveries {
            sink.sample(sample);
        }
    }

    /// Looks which ports are bound without waiting until it is time to.
    pub fn look_now(&self) {
        self.look_at_ports();
        // Newcomers are told of us.
        self.wake.notify_one();
    }

    /// Looks which ports are bound: who has come, and who is gone.
    fn look_at_ports(&self) {
        let mut core = self.core.lock();
        let Core { engine, flow, .. } = &mut *core;
        if !flow.sees() {
            return;
        }
        let now = Instant::now();
        flow.tidy(now);
        match flow.bound(engine.ports_to_look_at()) {
            Ok(bound) => engine.ports_bound(now, &bound),
            Err(error) => tracing::debug!(%error, "the ports of a network namespace are not known"),
        }
    }
}

/// Drives a participant until it is aborted. Each `look` it is looked which ports are bound.
pub(crate) async fn drive(shared: Arc<Shared>, look: Duration) {
    let timer = match timer() {
        Ok(timer) => timer,
        Err(error) => {
            tracing::error!(%error, "a DDS participant has no timer and will not be served");
            return;
        }
    };
    let mut buffer = Vec::new();
    let mut ports = tokio::time::interval(look);
    ports.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let sees = shared.core.lock().flow.sees();
    loop {
        let (waits, tick_at) = {
            let mut core = shared.core.lock();
            let waits = shared.flush(&mut core);
            (waits, core.engine.tick_at())
        };
        if let Waits::Receivers(wait) = waits {
            let nothing = Timespec {
                tv_sec: 0,
                tv_nsec: 0,
            };
            let once = Itimerspec {
                it_interval: nothing,
                it_value: Timespec::try_from(wait.max(SHORTEST)).unwrap_or(nothing),
            };
            if let Err(error) = timerfd_settime(timer.get_ref(), TimerfdTimerFlags::empty(), &once)
            {
                tracing::debug!(%error, "a timer was not set");
            }
        }
        let multicast = async {
            match &shared.multicast {
                Some(socket) => readable(socket).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            Ok(socket) = readable(&shared.user) => shared.take(socket, &mut buffer),
            Ok(socket) = readable(&shared.discovery) => shared.take(socket, &mut buffer),
            Ok(socket) = multicast => shared.take(socket, &mut buffer),
            Ok(mut ready) = timer.readable(), if matches!(waits, Waits::Receivers(_)) => {
                let mut expirations = [0; 8];
                let _ = rustix::io::read(timer.get_ref(), &mut expirations);
                ready.clear_ready();
            }
            () = room(shared.user.get_ref()), if waits == Waits::Socket => {}
            () = tokio::time::sleep_until(tick_at.into()) => shared.tick(),
            () = shared.wake.notified() => {}
            _ = ports.tick(), if sees => shared.look_at_ports(),
        }
    }
}

fn incoming(socket: UdpSocket) -> io::Result<Incoming> {
    // SAFETY: the descriptor belongs to what is returned alone, which never gives it away: it is open as long as it is registered.
    Ok(unsafe { AsyncFd::register_with_interest(socket, Interest::READABLE) }?)
}

/// Waits until something has come on a socket, which is then read until nothing is left.
async fn readable(socket: &Incoming) -> io::Result<&Incoming> {
    socket.readable().await?.retain_ready();
    Ok(socket)
}

/// Waits until a socket has room for a datagram.
async fn room(socket: &impl AsFd) {
    let waited = async {
        let same = socket.as_fd().try_clone_to_owned()?;
        // SAFETY: as with `incoming`.
        let same = unsafe { AsyncFd::register_with_interest(same, Interest::WRITABLE) }?;
        same.writable().await?.retain_ready();
        io::Result::Ok(())
    };
    if let Err(error) = waited.await {
        tracing::debug!(%error, "it is not told when a DDS participant's socket has room");
        tokio::time::sleep(NO_ROOM).await;
    }
}

fn timer() -> io::Result<AsyncFd<OwnedFd>> {
    let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
    let timer = timerfd_create(TimerfdClockId::Monotonic, flags)?;
    // SAFETY: the descriptor belongs to what is returned alone, which never gives it away: it is open as long as it is registered.
    Ok(unsafe { AsyncFd::register(timer) }?)
}
