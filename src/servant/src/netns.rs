//! Network namespaces as values. A servant's namespace contains only `lo`; to talk to its nodes, sockets are opened
//! *in* it and used outside, because a socket stays in the namespace it was created in.

use std::fs::File;
use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};
use std::os::unix::fs::MetadataExt;
use std::sync::{Arc, OnceLock, mpsc};

use caps::Capability;
use nix::sched::{CloneFlags, setns, unshare};
use nix::sys::socket::{SockaddrStorage, bind, setsockopt, sockopt};
use tokio::net::{TcpListener, TcpSocket, TcpStream, UdpSocket};
use tokio::sync::oneshot;

use crate::Error;

/// A network namespace, kept alive by this value. Two values are equal if they are the same namespace.
#[derive(Debug)]
pub struct NetNs {
    file: Arc<OwnedFd>,
    device: u64,
    inode: u64,
}

impl PartialEq for NetNs {
    fn eq(&self, other: &Self) -> bool {
        (self.device, self.inode) == (other.device, other.inode)
    }
}

impl Eq for NetNs {}

impl AsFd for NetNs {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

impl NetNs {
    /// Creates a namespace with `lo` up. It belongs to the host's user namespace, so that not even root in a container
    /// may configure it.
    pub fn create() -> Result<Self, Error> {
        in_own_thread(|| {
            unshare(CloneFlags::CLONE_NEWNET).map_err(Error::nix("unshare of a network namespace"))?;
            bring_lo_up()?;
            Self::current()
        })
    }

    /// Returns the namespace of the calling thread.
    pub fn current() -> Result<Self, Error> {
        Self::from_path("/proc/thread-self/ns/net")
    }

    /// Returns the namespace of a process. The caller ensures, by a pidfd, that the pid still belongs to the process.
    pub fn from_pid(pid: i32) -> Result<Self, Error> {
        Self::from_path(&format!("/proc/{pid}/ns/net"))
    }

    /// Wraps an open file of nsfs.
    pub fn from_fd(fd: OwnedFd) -> Result<Self, Error> {
        let file = File::from(fd);
        let metadata = file.metadata().map_err(Error::call("fstat of a network namespace"))?;
        Ok(Self { device: metadata.dev(), inode: metadata.ino(), file: Arc::new(file.into()) })
    }

    fn from_path(path: &str) -> Result<Self, Error> {
        Self::from_fd(File::open(path).map_err(Error::file("open", path))?.into())
    }

    /// Runs `work` on a separate thread in the namespace.
    pub fn run<T: Send>(&self, work: impl FnOnce() -> T + Send) -> Result<T, Error> {
        in_own_thread(|| {
            setns(self.file.as_fd(), CloneFlags::CLONE_NEWNET).map_err(Error::nix("setns to a network namespace"))?;
            Ok(work())
        })
    }

    /// Moves the calling thread into the namespace for good.
    pub fn enter(&self) -> Result<(), Error> {
        setns(self.file.as_fd(), CloneFlags::CLONE_NEWNET).map_err(Error::nix("setns to a network namespace"))
    }

    /// Connects to `address` as seen from inside. Only the socket is created there; connecting is awaited here.
    pub async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        let stream = self.socket(address, None).await?.connect(address).await?;
        stream.set_nodelay(true)?;
        Ok(stream)
    }

    /// Listens on `address` as seen from inside; port 0 picks a free one.
    pub async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.socket(address, Some(address)).await?.listen(1024)
    }

    /// Opens a UDP socket bound to `address` as seen from inside; port 0 picks a free one. With `shared`, other sockets
    /// may be bound to it, too, for multicast. The receive buffer is 8 MiB, or as much as the host allows.
    pub async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        let fd = self.open(Kind::Datagrams { shared }, Some(address)).await?;
        UdpSocket::from_std(std::net::UdpSocket::from(fd))
    }

    /// Opens a socket for diagnostics of the sockets inside (sock_diag(7)).
    pub async fn open_sock_diag(&self) -> io::Result<OwnedFd> {
        self.open(Kind::Diagnostics, None).await
    }

    /// Opens a TCP socket inside, for the address family of `address`; bound if `bound` is given, which needs a
    /// capability for ports below 1024.
    async fn socket(&self, address: SocketAddr, bound: Option<SocketAddr>) -> io::Result<TcpSocket> {
        let kind = if address.is_ipv4() { Kind::Stream(libc::AF_INET) } else { Kind::Stream(libc::AF_INET6) };
        let fd = self.open(kind, bound).await?;
        Ok(TcpSocket::from_std_stream(std::net::TcpStream::from(fd)))
    }

    async fn open(&self, kind: Kind, bound: Option<SocketAddr>) -> io::Result<OwnedFd> {
        let (answer, answered) = oneshot::channel();
        let order = SocketRequest { namespace: self.file.clone(), kind, bound, answer };
        let gone = || io::Error::other("the thread that opens sockets in namespaces has ended");
        socket_opener().send(order).map_err(|_| gone())?;
        answered.await.map_err(|_| gone())?
    }
}

/// Kind of socket to open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// TCP, of this address family.
    Stream(i32),
    /// UDP, of the address family of the address it is bound to.
    Datagrams {
        /// Allows other sockets on the same address.
        shared: bool,
    },
    /// `NETLINK_SOCK_DIAG`.
    Diagnostics,
}

struct SocketRequest {
    namespace: Arc<OwnedFd>,
    kind: Kind,
    bound: Option<SocketAddr>,
    answer: oneshot::Sender<io::Result<OwnedFd>>,
}

/// Returns the channel to the one thread of the process that enters namespaces and opens sockets there. It never leaves
/// a namespace otherwise, since a failure to return would leave a shared thread in a servant's network.
fn socket_opener() -> &'static mpsc::Sender<SocketRequest> {
    static OPENER: OnceLock<mpsc::Sender<SocketRequest>> = OnceLock::new();
    OPENER.get_or_init(|| {
        let (sender, orders) = mpsc::channel::<SocketRequest>();
        let work = move || {
            // On failure it keeps more than it needs, like all threads of programs other than the daemon.
            let _ = privilege::retain_capabilities(&OPENERS);
            for order in orders {
                let socket = open_socket(order.namespace.as_fd(), order.kind, order.bound);
                // An error means that the caller was cancelled; the socket is then closed.
                let _ = order.answer.send(socket);
            }
        };
        // If no thread can be started, the receiver is dropped and every request is answered with an error.
        privilege::run_sync(|| {
            let _ = std::thread::Builder::new().name("netns-sockets".into()).stack_size(64 * 1024).spawn(work);
        });
        sender
    })
}

/// Capabilities for entering namespaces, for binding to ports below 1024 there, and for larger receive buffers than
/// ordinary users get.
const OPENERS: [Capability; 3] =
    [Capability::CAP_SYS_ADMIN, Capability::CAP_NET_BIND_SERVICE, Capability::CAP_NET_ADMIN];
/// Bytes of the receive buffer of UDP sockets: images arrive faster than they are read.
const DATAGRAMS: usize = 8 << 20;

fn open_socket(namespace: BorrowedFd<'_>, kind: Kind, bound: Option<SocketAddr>) -> io::Result<OwnedFd> {
    setns(namespace, CloneFlags::CLONE_NEWNET)?;
    let (family, of, protocol) = match (kind, bound) {
        (Kind::Stream(family), _) => (family, libc::SOCK_STREAM, 0),
        (Kind::Datagrams { .. }, Some(SocketAddr::V6(_))) => (libc::AF_INET6, libc::SOCK_DGRAM, 0),
        (Kind::Datagrams { .. }, _) => (libc::AF_INET, libc::SOCK_DGRAM, 0),
        (Kind::Diagnostics, _) => (libc::AF_NETLINK, libc::SOCK_RAW, libc::NETLINK_SOCK_DIAG),
    };
    let flags = libc::SOCK_NONBLOCK | libc::SOCK_CLOEXEC;
    // SAFETY: no pointers.
    let fd = unsafe { libc::socket(family, of | flags, protocol) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: just opened, owned by nobody else.
    let socket = unsafe { OwnedFd::from_raw_fd(fd) };
    if let Kind::Datagrams { .. } = kind {
        let forced = setsockopt(&socket, sockopt::RcvBufForce, &DATAGRAMS);
        forced.or_else(|_| setsockopt(&socket, sockopt::RcvBuf, &DATAGRAMS))?;
    }
    if let Some(address) = bound {
        // For UDP it allows several sockets on one port.
        let reuse = !matches!(kind, Kind::Datagrams { shared: false });
        setsockopt(&socket, sockopt::ReuseAddr, &reuse)?;
        bind(fd, &SockaddrStorage::from(address))?;
    }
    Ok(socket)
}

fn in_own_thread<T: Send>(work: impl FnOnce() -> Result<T, Error> + Send) -> Result<T, Error> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new()
            .name("netns".into())
            .stack_size(256 * 1024)
            .spawn_scoped(scope, work)
            .map_err(Error::call("starting a thread"))?;
        thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Sets `IFF_UP` on `lo` in the calling thread's namespace (netdevice(7)).
fn bring_lo_up() -> Result<(), Error> {
    // SAFETY: no pointers.
    let fd = unsafe { libc::socket(libc::AF_INET, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0) };
    if fd < 0 {
        return Err(Error::call("opening a socket to bring lo up")(io::Error::last_os_error()));
    }
    // SAFETY: just opened, owned by nobody else.
    let socket = unsafe { OwnedFd::from_raw_fd(fd) };
    // SAFETY: an all-zero ifreq is valid.
    let mut request: libc::ifreq = unsafe { std::mem::zeroed() };
    request.ifr_name[0] = b'l' as libc::c_char;
    request.ifr_name[1] = b'o' as libc::c_char;
    request.ifr_ifru.ifru_flags = (libc::IFF_UP | libc::IFF_RUNNING) as libc::c_short;
    // SAFETY: the request is a live ifreq, which is what SIOCSIFFLAGS reads.
    if unsafe { libc::ioctl(socket.as_raw_fd(), libc::SIOCSIFFLAGS, &request) } != 0 {
        return Err(Error::call("bringing lo up")(io::Error::last_os_error()));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    #[tokio::test]
    async fn sockets_made_inside_meet_there_and_nowhere_else() {
        let (one, two) = (NetNs::create().unwrap(), NetNs::create().unwrap());
        let listener = one.listen((Ipv4Addr::LOCALHOST, 0).into()).await.unwrap();
        let address = listener.local_addr().unwrap();
        let mut near = one.connect(address).await.unwrap();
        let (mut far, _) = listener.accept().await.unwrap();
        near.write_all(b"hello").await.unwrap();
        let mut text = [0; 5];
        far.read_exact(&mut text).await.unwrap();
        assert_eq!(&text, b"hello");
        assert!(near.nodelay().unwrap());
        let refused = two.connect(address).await.unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::ConnectionRefused);
        assert!(TcpStream::connect(address).await.is_err(), "the host must not see it");
    }

    #[tokio::test]
    async fn datagrams_meet_inside_and_the_kernel_tells_of_them() {
        let (one, two) = (NetNs::create().unwrap(), NetNs::create().unwrap());
        let loopback = || SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let far = one.bind_udp(loopback(), false).await.unwrap();
        let address = far.local_addr().unwrap();
        let near = one.bind_udp(loopback(), false).await.unwrap();
        near.send_to(b"hello", address).await.unwrap();
        let mut text = [0; 8];
        assert_eq!(far.recv_from(&mut text).await.unwrap().0, 5);
        assert!(one.bind_udp(address, false).await.is_err(), "the port is taken there");
        two.bind_udp(address, false).await.expect("it is free elsewhere");
        one.open_sock_diag().await.expect("a socket of the kernel's diagnostics");
        let room = nix::sys::socket::getsockopt(&far, sockopt::RcvBuf).unwrap();
        assert_eq!(room, 2 * DATAGRAMS, "the kernel counts twice what is asked for");
    }

    #[test]
    fn namespaces_are_compared_by_what_they_are() {
        let (one, two) = (NetNs::create().unwrap(), NetNs::create().unwrap());
        let own = NetNs::current().unwrap();
        assert_eq!(one.run(|| NetNs::current().unwrap()).unwrap(), one);
        assert_ne!(one, two);
        assert_ne!(one, own);
        assert_eq!(NetNs::current().unwrap(), own, "the calling thread stays where it was");
    }
}
