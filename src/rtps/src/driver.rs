//! Moves datagrams between the sockets and the engine and calls the engine when its timer expires. One task per
//! participant.

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
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create, timerfd_settime,
};
use socket2::SockRef;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::Notify;

use crate::engine::{Datagram, Engine};
use crate::flow::FlowControl;
use crate::locator::MULTICAST;
use crate::network::InterfaceSet;

/// Minimum duration of the kernel timer, which a duration of zero would disarm. Timers of tokio have a resolution of a
/// millisecond, in which a receiver's buffer runs empty several times.
const SHORTEST: Duration = Duration::from_micros(10);
/// Interval at which bound ports are checked.
pub(crate) const PORTS: Duration = Duration::from_millis(200);
/// Maximum number of datagrams read from one socket before others get their turn.
const AT_ONCE: usize = 32;
/// Retry interval for sending if waiting for room in the socket buffer is not possible.
const NO_ROOM: Duration = Duration::from_millis(1);
/// Maximum length of a datagram.
const LONGEST: usize = 65_536;
/// Length below which a datagram is copied out of the buffer; a longer one takes the buffer with it.
const MAX_COPIED: usize = 16 << 10;

/// State protected by one lock.
pub(crate) struct Core {
    pub engine: Engine,
    flow: FlowControl,
    /// Interfaces through which multicast datagrams are sent.
    network: InterfaceSet,
    /// A datagram for which the sending socket had no room.
    stalled: Option<Datagram>,
}

/// A socket registered for readability only. Writability would be reported after each datagram sent and wake the
/// participant's task once more per message.
type ReadableSocket = AsyncFd<UdpSocket>;

/// State shared by a participant, its endpoints and its task.
pub(crate) struct DriverState {
    core: Mutex<Core>,
    wake: Notify,
    /// Receives discovery data of endpoints.
    discovery: ReadableSocket,
    /// Receives samples; everything is sent from here.
    user: ReadableSocket,
    /// Receives multicast announcements of participants.
    multicast: Option<ReadableSocket>,
}

/// The non-blocking sockets of a participant.
pub(crate) struct Sockets {
    pub discovery: UdpSocket,
    pub user: UdpSocket,
    pub multicast: Option<UdpSocket>,
}

/// Result of a flush: what sending waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FlushOutcome {
    Nothing,
    /// Receivers have no room; the time after which to check again.
    Receivers(Duration),
    /// The sending socket has no room.
    Socket,
}

impl DriverState {
    pub fn new(engine: Engine, flow: FlowControl, sockets: Sockets, network: InterfaceSet) -> io::Result<Arc<Self>> {
        let Sockets { discovery, user, multicast } = sockets;
        let core = Mutex::new(Core { engine, flow, network: InterfaceSet::new(Vec::new()), stalled: None });
        let shared = Self {
            core,
            wake: Notify::new(),
            discovery: register_readable(discovery)?,
            user: register_readable(user)?,
            multicast: multicast.map(register_readable).transpose()?,
        };
        shared.join_groups(&mut shared.core.lock(), network);
        Ok(Arc::new(shared))
    }

    /// Sets the current interfaces of this machine.
    pub fn set_network(&self, network: InterfaceSet) {
        let mut core = self.core.lock();
        if core.network != network {
            tracing::debug!(?network, "the networks of a DDS participant have changed");
            core.engine.set_network(Instant::now(), network.clone());
            self.join_groups(&mut core, network);
            self.wake.notify_one();
        }
    }

    /// Joins the multicast group on each interface.
    fn join_groups(&self, core: &mut Core, network: InterfaceSet) {
        core.flow.set_local_addresses(network.addresses());
        if let Some(socket) = &self.multicast {
            let socket = SockRef::from(socket.get_ref());
            for address in network.addresses() {
                match socket.join_multicast_v4(&MULTICAST, &address) {
                    Ok(()) => {}
                    // It had this address before and has it again.
                    Err(error) if error.kind() == io::ErrorKind::AddrInUse => {}
                    Err(error) => {
                        tracing::debug!(%error, %address, "cannot receive DDS multicast there");
                    }
                }
            }
        }
        core.network = network;
    }

    /// Runs `work` on the engine and sends immediately what can be sent.
    pub fn with_engine<T>(&self, work: impl FnOnce(Instant, &mut Engine) -> T) -> T {
        let mut core = self.core.lock();
        let before = core.engine.tick_at();
        let result = work(Instant::now(), &mut core.engine);
        let waits = self.flush(&mut core);
        if waits != FlushOutcome::Nothing || core.engine.tick_at() < before {
            self.wake.notify_one();
        }
        result
    }

    /// Reads from the engine.
    pub fn read_engine<T>(&self, look: impl FnOnce(&Engine) -> T) -> T {
        look(&self.core.lock().engine)
    }

    fn flush(&self, core: &mut Core) -> FlushOutcome {
        let Core { engine, flow, network, stalled } = core;
        flow.take_wait();
        loop {
            let next = stalled.take().or_else(|| {
                engine.transmit(&mut |to, length, again| flow.try_reserve(Instant::now(), to, length, again))
            });
            let Some(datagram) = next else {
                return flow.take_wait().map_or(FlushOutcome::Nothing, FlushOutcome::Receivers);
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
                    return FlushOutcome::Socket;
                }
                // A network that is gone, or a receiver that does not exist: treated as lost in transit.
                Err(error) => tracing::trace!(%error, to = %datagram.to, "a datagram was not sent"),
            }
        }
    }

    /// Sends a datagram through each interface. A failed one is repeated by the next announcement.
    fn send_to_all(&self, datagram: &Datagram, network: &InterfaceSet) {
        let socket = SockRef::from(self.user.get_ref());
        for address in network.addresses() {
            let sent = socket
                .set_multicast_if_v4(&address)
                .and_then(|()| socket.send_to_vectored(&datagram.parts(), &datagram.to.into()));
            if let Err(error) = sent {
                tracing::trace!(%error, %address, "cannot send DDS multicast there");
            }
        }
    }

    /// Reads the datagrams received by a socket and delivers their samples. If there may be more, the other tasks of
    /// this thread get their turn first: the readiness of a socket does not count in a task's budget, so a socket that
    /// fills as fast as it is read would keep them waiting for as long as it does.
    async fn receive_in_turn(&self, socket: &ReadableSocket, buffer: &mut Vec<u8>) {
        if self.receive_datagrams(socket, buffer) == AT_ONCE {
            tokio::task::yield_now().await;
        }
    }

    /// Reads up to [`AT_ONCE`] datagrams received by a socket and delivers their samples; returns the number of
    /// datagrams.
    fn receive_datagrams(&self, socket: &ReadableSocket, buffer: &mut Vec<u8>) -> usize {
        let mut came = Vec::with_capacity(AT_ONCE);
        while came.len() < AT_ONCE {
            buffer.resize(LONGEST, 0);
            let received = socket.try_io(Interest::READABLE, |socket| socket.recv_from(buffer));
            let Ok((length, source)) = received else {
                break;
            };
            let datagram = if length <= MAX_COPIED {
                Bytes::copy_from_slice(&buffer[..length])
            } else {
                buffer.truncate(length);
                Bytes::from(std::mem::take(buffer))
            };
            came.push((source.ip(), datagram));
        }
        if came.is_empty() {
            return 0;
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
            sink.on_sample(sample);
        }
        came.len()
    }

    fn tick(&self) {
        let deliveries = {
            let mut core = self.core.lock();
            core.engine.tick(Instant::now());
            core.engine.take_deliveries()
        };
        for (sink, sample) in deliveries {
            sink.on_sample(sample);
        }
    }

    /// Checks bound ports immediately.
    pub fn check_ports_now(&self) {
        self.check_ports();
        // Newcomers are sent an announcement.
        self.wake.notify_one();
    }

    /// Checks which ports are bound, to detect participants that appear and disappear.
    fn check_ports(&self) {
        let mut core = self.core.lock();
        let Core { engine, flow, .. } = &mut *core;
        if !flow.has_diagnostics() {
            return;
        }
        let now = Instant::now();
        flow.remove_expired(now);
        match flow.find_bound(engine.watched_ports()) {
            Ok(bound) => engine.set_bound_ports(now, &bound),
            Err(error) => {
                tracing::debug!(%error, "cannot determine the ports of a network namespace")
            }
        }
    }
}

/// Drives a participant until it is aborted. Bound ports are checked at the interval `look`.
pub(crate) async fn drive(shared: Arc<DriverState>, look: Duration) {
    let timer = match create_timer() {
        Ok(timer) => timer,
        Err(error) => {
            tracing::error!(%error, "a DDS participant has no timer and will not be served");
            return;
        }
    };
    let mut buffer = Vec::new();
    let mut ports = tokio::time::interval(look);
    ports.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let sees = shared.core.lock().flow.has_diagnostics();
    loop {
        let (waits, tick_at) = {
            let mut core = shared.core.lock();
            let waits = shared.flush(&mut core);
            (waits, core.engine.tick_at())
        };
        if let FlushOutcome::Receivers(wait) = waits {
            let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
            let once = Itimerspec {
                it_interval: nothing,
                it_value: Timespec::try_from(wait.max(SHORTEST)).unwrap_or(nothing),
            };
            if let Err(error) = timerfd_settime(timer.get_ref(), TimerfdTimerFlags::empty(), &once) {
                tracing::debug!(%error, "a timer was not set");
            }
        }
        let multicast = async {
            match &shared.multicast {
                Some(socket) => wait_readable(socket).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            Ok(socket) = wait_readable(&shared.user) => shared.receive_in_turn(socket, &mut buffer).await,
            Ok(socket) = wait_readable(&shared.discovery) => shared.receive_in_turn(socket, &mut buffer).await,
            Ok(socket) = multicast => shared.receive_in_turn(socket, &mut buffer).await,
            Ok(mut ready) = timer.readable(), if matches!(waits, FlushOutcome::Receivers(_)) => {
                let mut expirations = [0; 8];
                let _ = rustix::io::read(timer.get_ref(), &mut expirations);
                ready.clear_ready();
            }
            () = wait_writable(shared.user.get_ref()), if waits == FlushOutcome::Socket => {}
            () = tokio::time::sleep_until(tick_at.into()) => shared.tick(),
            () = shared.wake.notified() => {}
            _ = ports.tick(), if sees => shared.check_ports(),
        }
    }
}

fn register_readable(socket: UdpSocket) -> io::Result<ReadableSocket> {
    // SAFETY: the returned value is the sole owner of the descriptor and never gives it away, so it is open as long as
    // it is registered.
    Ok(unsafe { AsyncFd::register_with_interest(socket, Interest::READABLE) }?)
}

/// Waits until a socket is readable. The caller then reads until nothing is left.
async fn wait_readable(socket: &ReadableSocket) -> io::Result<&ReadableSocket> {
    socket.readable().await?.retain_ready();
    Ok(socket)
}

/// Waits until a socket has room for a datagram.
async fn wait_writable(socket: &impl AsFd) {
    let waited = async {
        let same = socket.as_fd().try_clone_to_owned()?;
        // SAFETY: as in `register_readable`.
        let same = unsafe { AsyncFd::register_with_interest(same, Interest::WRITABLE) }?;
        same.writable().await?.retain_ready();
        io::Result::Ok(())
    };
    if let Err(error) = waited.await {
        tracing::debug!(%error, "cannot watch for room in the send buffer of a DDS participant's socket");
        tokio::time::sleep(NO_ROOM).await;
    }
}

fn create_timer() -> io::Result<AsyncFd<OwnedFd>> {
    let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
    let timer = timerfd_create(TimerfdClockId::Monotonic, flags)?;
    // SAFETY: the returned value is the sole owner of the descriptor and never gives it away, so it is open as long as
    // it is registered.
    Ok(unsafe { AsyncFd::register(timer) }?)
}
