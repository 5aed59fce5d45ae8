//! The public API: participants, readers and writers.

use std::net::{Ipv4Addr, SocketAddr};
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::{Duration, Instant};
use std::{fmt, io};

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use socket2::SockRef;
use tokio::net::UdpSocket;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tracing::Instrument;

use crate::discovery::ParticipantData;
use crate::driver::{DriverState, PORTS, Sockets, drive};
use crate::engine::{BUILTIN, Engine, Settings};
use crate::flow::FlowControl;
use crate::locator::{MULTICAST, Ports};
use crate::network::{InterfaceAddress, InterfaceSelection, InterfaceSet};
use crate::qos::EndpointQos;
use crate::reader::ReaderLimits;
use crate::sequence::SequenceNumber;
use crate::shared::{DiscoveredGraph, DiscoveryServer, EndpointMatches, Sink, TopicDescription};
use crate::{Guid, GuidPrefix, SampleIdentity, VendorId};

/// Network namespace in which a participant has its sockets: a servant's, or the host's.
#[async_trait]
pub trait NetworkNamespace: Send + Sync + 'static {
    /// Binds a UDP socket to this address as seen from inside; port 0 picks a free one. With `shared`, others may bind
    /// to it as well (`SO_REUSEADDR`), for multicast.
    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket>;
    /// Returns the interfaces that are up in the namespace, with their addresses.
    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        Ok(vec![InterfaceAddress::LOOPBACK])
    }
    /// Opens a kernel socket diagnostics socket (`NETLINK_SOCK_DIAG`) in the namespace, with which the fill level of
    /// receive buffers is queried. Without it, samples are sent at a fixed pace.
    async fn open_diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        Ok(None)
    }
}

/// Configuration of a participant.
#[derive(Debug, Clone)]
pub struct Config {
    /// `ROS_DOMAIN_ID`, 0 to 232.
    pub domain: u16,
    /// Name of the participant, shown by DDS tools.
    pub name: String,
    /// User data; ROS 2 uses `enclave=/;`.
    pub user_data: Bytes,
    /// Maximum size of a received sample.
    pub max_sample: usize,
    /// Budget for incomplete samples; those that do not fit are dropped.
    pub budget: Budget,
    /// Time without fragments after which an incomplete sample is dropped.
    pub unfinished: Duration,
    /// Interfaces to use.
    pub interfaces: InterfaceSelection,
    /// Announce by multicast and listen to multicast announcements.
    pub multicast: bool,
    /// Neither announce anything nor listen to others.
    pub alone: bool,
    /// Use the well-known ports, which others try without an announcement (9.6.2.3).
    pub well_known: bool,
    /// Additional addresses to announce to: discovery ports of other participants; with port 0, the first 32 discovery
    /// ports of that machine.
    pub peers: Vec<SocketAddr>,
    /// Fast DDS discovery servers. If there are any, discovery uses only them, neither multicast nor peers.
    pub servers: Vec<DiscoveryServer>,
    /// GUID prefix to use; by default a unique one.
    pub prefix: Option<GuidPrefix>,
    /// Participants that this one replaces and that ended without a farewell: others are told in their names that they
    /// are gone. They had the same lease duration.
    pub predecessors: Vec<GuidPrefix>,
}

impl Config {
    /// Creates the default configuration of a participant in a domain.
    pub fn new(domain: u16, name: impl Into<String>) -> Self {
        Self {
            domain,
            name: name.into(),
            user_data: Bytes::new(),
            max_sample: 256 << 20,
            budget: Budget::without_limit(),
            unfinished: Duration::from_secs(30),
            interfaces: InterfaceSelection::default(),
            multicast: true,
            alone: false,
            well_known: false,
            peers: Vec::new(),
            servers: Vec::new(),
            prefix: None,
            predecessors: Vec::new(),
        }
    }
}

/// Errors of joining a domain.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// Invalid domain id.
    #[error("ROS_DOMAIN_ID {0} is out of range: use 0 to 232")]
    NoSuchDomain(u16),
    /// All ports of the domain are in use.
    #[error("ROS_DOMAIN_ID {0} already has all 120 participants that it can have: stop some of its nodes")]
    Full(u16),
    /// A socket could not be opened.
    #[error("opening a socket for DDS: {0}")]
    Socket(#[from] io::Error),
}

/// A participant of a domain. Clones refer to the same participant. When the last one and all its endpoints are
/// dropped, it leaves without a farewell, which [`Participant::close`] sends.
#[derive(Clone)]
pub struct Participant {
    running: Arc<ParticipantTask>,
}

struct ParticipantTask {
    shared: Arc<DriverState>,
    task: AbortHandle,
    /// Task that watches the interfaces.
    looking: Option<AbortHandle>,
    guid: Guid,
}

impl ParticipantTask {
    fn stop(&self) {
        self.task.abort();
        if let Some(looking) = &self.looking {
            looking.abort();
        }
    }
}

impl Drop for ParticipantTask {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Lease duration announced to others.
const LEASE: Duration = Duration::from_secs(10);

impl Participant {
    /// Joins a domain. Must be called within a tokio runtime, on which a task serves the participant from then on.
    ///
    /// # Errors
    /// The domain id is invalid, or no socket could be opened.
    pub async fn join(place: Arc<dyn NetworkNamespace>, config: Config) -> Result<Participant, JoinError> {
        Self::join_with_port_interval(place, config, PORTS).await
    }

    /// Joins a domain; bound ports are checked at the interval `ports_each`.
    pub(crate) async fn join_with_port_interval(
        place: Arc<dyn NetworkNamespace>,
        config: Config,
        ports_each: Duration,
    ) -> Result<Participant, JoinError> {
        let ports = Ports::for_domain(config.domain).ok_or(JoinError::NoSuchDomain(config.domain))?;
        let network = current_interfaces(&*place, &config.interfaces).await;
        let here = match &config.interfaces {
            InterfaceSelection::These(these) if these.len() == 1 => these[0],
            _ => Ipv4Addr::UNSPECIFIED,
        };
        let (discovery, user) = if config.well_known {
            bind_well_known(&*place, &config, ports, here).await?
        } else {
            let any = SocketAddr::from((here, 0));
            (place.bind_udp(any, false).await?, place.bind_udp(any, false).await?)
        };
        let by_itself = !config.alone && config.servers.is_empty();
        let multicast = if config.multicast && by_itself { bind_multicast(&*place, ports).await } else { None };
        let diagnostics = place.open_diagnostics().await.unwrap_or_else(|error| {
            tracing::debug!(%error, "cannot read how full the receive buffers of DDS are");
            None
        });
        let flow = FlowControl::new(diagnostics);
        let own = participant_data(&config, &network, &discovery, &user)?;
        let mut announce_to = peer_addresses(&config.peers, ports);
        if multicast.is_some() {
            announce_to.push(SocketAddr::from((MULTICAST, ports.discovery_multicast())));
        }
        if !flow.has_diagnostics() {
            let here = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
            announce_to.extend(peer_addresses(&[here], ports));
        }
        if !by_itself {
            announce_to.clear();
        }
        let bounds =
            ReaderLimits { max_sample: config.max_sample, budget: config.budget, unfinished: config.unfinished };
        let engine = Engine::new(
            Instant::now(),
            Settings {
                own,
                ports,
                bounds,
                announce_to,
                servers: config.servers,
                network: network.clone(),
                alone: config.alone,
                predecessors: config.predecessors,
            },
        );
        let guid = engine.guid();
        let sockets = Sockets {
            discovery: discovery.into_std()?,
            user: user.into_std()?,
            multicast: multicast.map(UdpSocket::into_std).transpose()?,
        };
        let shared = DriverState::new(engine, flow, sockets, network)?;
        let driving = drive(Arc::clone(&shared), ports_each);
        let task = tokio::spawn(driving.in_current_span()).abort_handle();
        let looking = (!config.interfaces.is_loopback()).then(|| {
            let looking = watch_interfaces(Arc::clone(&shared), place, config.interfaces);
            tokio::spawn(looking.in_current_span()).abort_handle()
        });
        Ok(Participant { running: Arc::new(ParticipantTask { shared, task, looking, guid }) })
    }

    /// Returns the GUID of the participant.
    pub fn guid(&self) -> Guid {
        self.running.guid
    }

    /// Returns a watch on the other participants.
    pub fn watch_discovered(&self) -> watch::Receiver<Arc<DiscoveredGraph>> {
        self.running.shared.read_engine(Engine::watch_discovered)
    }

    /// Creates a reader of a topic. Dropping it removes the reader.
    pub fn reader(&self, topic: TopicDescription, qos: EndpointQos, sink: Arc<dyn Sink>) -> DataReader {
        let (guid, ends) = self.running.shared.with_engine(|now, engine| engine.add_reader(now, &topic, qos, sink));
        DataReader { end: EndpointHandle { running: Arc::clone(&self.running), guid, ends } }
    }

    /// Creates a writer of a topic. Dropping it removes the writer.
    pub fn writer(&self, topic: TopicDescription, qos: EndpointQos) -> DataWriter {
        let (guid, ends) = self.running.shared.with_engine(|now, engine| engine.add_writer(now, &topic, qos));
        DataWriter { end: EndpointHandle { running: Arc::clone(&self.running), guid, ends } }
    }

    /// Reports that a process of this machine has ended, so that its participant is removed immediately and not at the
    /// next check of bound ports. Has no effect if the kernel cannot be queried.
    pub fn check_ports(&self) {
        self.running.shared.check_ports_now();
    }

    /// Waits until readers have received everything written to them.
    pub async fn wait_acknowledged(&self) {
        while !self.running.shared.read_engine(Engine::is_settled) {
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Announces the departure. Remaining endpoints become inert.
    pub async fn close(&self) {
        self.running.shared.with_engine(|now, engine| engine.close(now));
        self.running.stop();
    }
}

/// Interval at which acknowledgements are checked while somebody waits for them.
const LOOK: Duration = Duration::from_millis(5);

/// Interval at which interfaces are checked.
const INTERFACES: Duration = Duration::from_secs(2);

/// Number of participant numbers to which announcements are sent where bound ports are unknown; as many as ROS 2 nodes
/// try.
const UNSEEN: u16 = 32;

/// Returns the selected interfaces.
async fn current_interfaces(place: &dyn NetworkNamespace, meant: &InterfaceSelection) -> InterfaceSet {
    if let (InterfaceSelection::These(these), true) = (meant, meant.is_loopback()) {
        let loopback = |address: &Ipv4Addr| InterfaceAddress { address: *address, ..InterfaceAddress::LOOPBACK };
        return InterfaceSet::new(these.iter().map(loopback).collect());
    }
    let found = place.interfaces().await.unwrap_or_else(|error| {
        tracing::debug!(%error, "cannot list the network interfaces of this machine");
        Vec::new()
    });
    InterfaceSet::new(meant.filter(found))
}

/// Watches the interfaces of a namespace.
async fn watch_interfaces(shared: Arc<DriverState>, place: Arc<dyn NetworkNamespace>, meant: InterfaceSelection) {
    loop {
        tokio::time::sleep(INTERFACES).await;
        shared.set_network(current_interfaces(&*place, &meant).await);
    }
}

/// Returns the addresses to announce to for these peers.
fn peer_addresses(peers: &[SocketAddr], ports: Ports) -> Vec<SocketAddr> {
    let mut all = Vec::new();
    for peer in peers {
        if peer.port() == 0 {
            let each = (0..UNSEEN).filter_map(|number| ports.discovery(number));
            all.extend(each.map(|port| SocketAddr::new(peer.ip(), port)));
        } else {
            all.push(*peer);
        }
    }
    all
}

/// Binds sockets to the first free pair of well-known ports of the domain (9.6.2.3).
async fn bind_well_known(
    place: &dyn NetworkNamespace,
    config: &Config,
    ports: Ports,
    here: Ipv4Addr,
) -> Result<(UdpSocket, UdpSocket), JoinError> {
    for number in 0.. {
        let (Some(discovery), Some(user)) = (ports.discovery(number), ports.user(number)) else {
            break;
        };
        let discovery = place.bind_udp(SocketAddr::from((here, discovery)), false).await;
        let user = place.bind_udp(SocketAddr::from((here, user)), false).await;
        match (discovery, user) {
            (Ok(discovery), Ok(user)) => return Ok((discovery, user)),
            (Err(error), _) | (_, Err(error)) if error.kind() != io::ErrorKind::AddrInUse => {
                return Err(error.into());
            }
            _ => {}
        }
    }
    Err(JoinError::Full(config.domain))
}

/// Binds the socket for multicast announcements; the driver joins the groups.
async fn bind_multicast(place: &dyn NetworkNamespace, ports: Ports) -> Option<UdpSocket> {
    let at = SocketAddr::from((Ipv4Addr::UNSPECIFIED, ports.discovery_multicast()));
    let opened = place.bind_udp(at, true).await;
    // Multicast through interfaces joined by other sockets of this machine is not for us.
    let opened = opened.and_then(|socket| {
        SockRef::from(&socket).set_multicast_all_v4(false)?;
        Ok(socket)
    });
    opened.map_err(|error| tracing::debug!(%error, "cannot receive DDS multicast")).ok()
}

fn participant_data(
    config: &Config,
    network: &InterfaceSet,
    discovery: &UdpSocket,
    user: &UdpSocket,
) -> io::Result<ParticipantData> {
    let (discovery, user) = (discovery.local_addr()?.port(), user.local_addr()?.port());
    Ok(ParticipantData {
        prefix: config.prefix.unwrap_or_else(GuidPrefix::random),
        vendor: VendorId::OURS,
        version: [2, 3],
        domain: Some(u32::from(config.domain)),
        name: config.name.clone(),
        user_data: config.user_data.clone(),
        discovery: network.locators(discovery),
        user: network.locators(user),
        builtin: BUILTIN,
        lease: Some(LEASE),
    })
}

struct EndpointHandle {
    running: Arc<ParticipantTask>,
    guid: Guid,
    ends: watch::Receiver<Arc<EndpointMatches>>,
}

impl Drop for EndpointHandle {
    fn drop(&mut self) {
        // The returned value is dropped after the engine is unlocked, because a sink may own other endpoints.
        drop(self.running.shared.with_engine(|now, engine| engine.remove_endpoint(now, self.guid.entity)));
    }
}

/// A local reader; dropping it removes it.
pub struct DataReader {
    end: EndpointHandle,
}

impl DataReader {
    /// Returns the GUID of the reader.
    pub fn guid(&self) -> Guid {
        self.end.guid
    }

    /// Returns a watch on the writers of its topic.
    pub fn watch_matches(&self) -> watch::Receiver<Arc<EndpointMatches>> {
        self.end.ends.clone()
    }
}

/// A local writer; dropping it removes it once its readers have received everything, or after two seconds.
pub struct DataWriter {
    end: EndpointHandle,
}

impl DataWriter {
    /// Returns the GUID of the writer.
    pub fn guid(&self) -> Guid {
        self.end.guid
    }

    /// Returns a watch on the readers of its topic.
    pub fn watch_matches(&self) -> watch::Receiver<Arc<EndpointMatches>> {
        self.end.ends.clone()
    }

    /// Writes a sample: CDR with its header of four bytes. Never blocks; returns its sequence number.
    pub fn write(&self, payload: Bytes) -> SequenceNumber {
        self.write_sample(payload, None)
    }

    /// Writes a request or reply with the identity that relates them.
    pub fn write_related(&self, payload: Bytes, related: SampleIdentity) -> SequenceNumber {
        self.write_sample(payload, Some(related))
    }

    fn write_sample(&self, payload: Bytes, related: Option<SampleIdentity>) -> SequenceNumber {
        let entity = self.end.guid.entity;
        self.end.running.shared.with_engine(|now, engine| engine.write(now, entity, payload, related))
    }

    /// Sets how many of its last samples a transient-local writer gives to new readers, at most its depth. Without this
    /// they are given all that it keeps for slow readers.
    pub fn set_kept(&self, samples: usize) {
        self.end.running.shared.with_engine(|_, engine| engine.set_kept(self.end.guid.entity, samples));
    }

    /// Returns the number of samples dropped before all reliable readers had acknowledged them.
    pub fn dropped_samples(&self) -> u64 {
        self.end.running.shared.read_engine(|engine| engine.dropped_samples(self.end.guid.entity))
    }
}

impl fmt::Debug for Participant {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Participant").field("guid", &self.guid()).finish_non_exhaustive()
    }
}
