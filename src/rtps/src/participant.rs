//! A participant and its ends, as whoever uses this crate holds them.

use std::collections::BTreeMap;
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

use crate::discovery::{EndpointData, ParticipantData};
use crate::driver::{PORTS, Shared, Sockets, drive};
use crate::engine::{BUILTIN, Engine, Settings};
use crate::flow::Flow;
use crate::locator::{MULTICAST, Ports};
use crate::network::{Interface, Interfaces, Network};
use crate::qos::{EndpointQos, Mismatch};
use crate::reader::Bounds;
use crate::sequence::SequenceNumber;
use crate::time::WireTime;
use crate::{Guid, GuidPrefix, SampleIdentity, VendorId};

/// Where a participant has its sockets: a servant's network namespace, or the host's.
#[async_trait]
pub trait Place: Send + Sync + 'static {
    /// A socket bound to this address as seen from inside; port 0 picks a free one. With `shared` others may be bound to it, too
    /// (`SO_REUSEADDR`), for multicast.
    async fn datagrams(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket>;
    /// The interfaces that are up there, with their addresses: see [`interfaces`](crate::interfaces).
    async fn interfaces(&self) -> io::Result<Vec<Interface>> {
        Ok(vec![Interface::LOOPBACK])
    }
    /// A socket of the kernel's diagnostics of sockets (`NETLINK_SOCK_DIAG`) of this place, by which it is seen how full the
    /// receivers' buffers are; none where it cannot be had, and then samples are sent at a fixed pace.
    async fn diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        Ok(None)
    }
}

/// How to join.
#[derive(Debug, Clone)]
pub struct Config {
    /// `ROS_DOMAIN_ID`: 0 to 232.
    pub domain: u16,
    /// The participant's name, shown by tools of DDS.
    pub name: String,
    /// ROS 2: `enclave=/;`.
    pub user_data: Bytes,
    /// A sample longer than this is not taken.
    pub max_sample: usize,
    /// Where samples that are not whole yet count; what does not fit is not taken.
    pub budget: Budget,
    /// A sample whose fragments stop coming for so long is given up.
    pub unfinished: Duration,
    /// In which networks it takes part: those of this machine's interfaces.
    pub interfaces: Interfaces,
    /// Whether others are told of it, and heard, by multicast.
    pub multicast: bool,
    /// Whether it tells nobody of itself, and hears nobody.
    pub alone: bool,
    /// Whether to take ports that others try without having been told of them (9.6.2.3).
    pub well_known: bool,
    /// Where to announce oneself beside: other participants' ports for discovery; those that the first 32 of a machine have, where the port is 0.
    pub peers: Vec<SocketAddr>,
    /// Servers of discovery of Fast DDS. Where there are some it tells them alone of itself, and hears of others by them: neither by
    /// multicast nor of peers.
    pub servers: Vec<DiscoveryServer>,
    /// Which participant it is to be; one that nobody else is where there is none.
    pub prefix: Option<GuidPrefix>,
    /// Participants in whose place it comes, which ended without a word: others are told in their name that they are gone. They had
    /// the lease that this one has.
    pub predecessors: Vec<GuidPrefix>,
}

/// A server of discovery of Fast DDS, as its clients name it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DiscoveryServer {
    /// Its place in the list of servers, which it is itself told, and is named by.
    pub place: u8,
    /// Where it hears of others.
    pub at: SocketAddr,
}

impl DiscoveryServer {
    /// Its name, by its place: `44.53.PLACE.5f.45.50.52.4f.53.49.4d.41`.
    pub fn prefix(&self) -> GuidPrefix {
        let mut prefix = *b"DS\0_EPROSIMA";
        prefix[2] = self.place;
        GuidPrefix(prefix)
    }
}

impl Config {
    /// A participant of this name in a domain.
    pub fn new(domain: u16, name: impl Into<String>) -> Self {
        Self {
            domain,
            name: name.into(),
            user_data: Bytes::new(),
            max_sample: 256 << 20,
            budget: Budget::unlimited(),
            unfinished: Duration::from_secs(30),
            interfaces: Interfaces::default(),
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

/// Why nothing was joined.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// There is no such domain.
    #[error("ROS_DOMAIN_ID {0} has no ports: give 0 to 232")]
    NoSuchDomain(u16),
    /// All ports of the domain are taken.
    #[error(
        "all 120 participants that fit into ROS_DOMAIN_ID {0} are there: end some of its nodes"
    )]
    Full(u16),
    /// A socket could not be opened.
    #[error("opening a socket for DDS: {0}")]
    Socket(#[from] io::Error),
}

/// Who is there beside us, and with which ends.
#[derive(Debug, Clone, Default)]
pub struct Discovered {
    /// Grows by one with every change.
    pub generation: u64,
    /// The other participants.
    pub participants: BTreeMap<GuidPrefix, Arc<ParticipantData>>,
    /// Their writers.
    pub writers: BTreeMap<Guid, Arc<EndpointData>>,
    /// Their readers.
    pub readers: BTreeMap<Guid, Arc<EndpointData>>,
}

/// The ends of others on the topic of one of ours.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Ends {
    /// Those with which samples pass, in the order in which they came.
    pub matched: Vec<Arc<EndpointData>>,
    /// Those among them that have shown that they know this end, too: what is written from then on reaches them.
    pub confirmed: Vec<Guid>,
    /// Those with which none pass, with the reasons.
    pub refused: Vec<(Arc<EndpointData>, Vec<Mismatch>)>,
}

/// A sample as it came.
#[derive(Debug, Clone)]
pub struct Sample {
    /// CDR with its header of four bytes.
    pub payload: Bytes,
    /// Who wrote it.
    pub writer: Guid,
    /// Its number there.
    pub number: SequenceNumber,
    /// The request that it answers, or by which it wants to be answered (inline QoS).
    pub related: Option<SampleIdentity>,
    /// When it was written, by its writer's clock.
    pub written: Option<WireTime>,
    /// An announcement: the end or participant that is taken back by it.
    pub(crate) withdrawn: Option<Guid>,
}

/// Takes what a reader reads, in the order of each writer. Must not block.
pub trait Sink: Send + Sync + 'static {
    /// A sample.
    fn sample(&self, sample: Sample);
}

/// What a topic is called, and what its samples are.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Topic {
    /// As DDS has it: `rt/chatter`.
    pub name: String,
    /// As DDS has it: `std_msgs::msg::dds_::String_`.
    pub type_name: String,
    /// ROS 2: `typehash=RIHS01_…;`.
    pub user_data: Bytes,
}

/// A participant of a domain. Clones are the same one; when the last one and all its ends are dropped it leaves without a word,
/// which [`Participant::close`] says.
#[derive(Clone)]
pub struct Participant {
    running: Arc<Running>,
}

struct Running {
    shared: Arc<Shared>,
    task: AbortHandle,
    /// Looks which interfaces there are.
    looking: Option<AbortHandle>,
    guid: Guid,
}

impl Running {
    fn stop(&self) {
        self.task.abort();
        if let Some(looking) = &self.looking {
            looking.abort();
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop();
    }
}

/// How long others may hear nothing until they take this participant for gone.
const LEASE: Duration = Duration::from_secs(10);

impl Participant {
    /// Joins a domain. Must be called within a tokio runtime, whose task serves it from then on.
    ///
    /// # Errors
    /// There is no such domain, or no socket could be opened.
    pub async fn join(place: Arc<dyn Place>, config: Config) -> Result<Participant, JoinError> {
        Self::join_looking(place, config, PORTS).await
    }

    /// The same; each `ports_each` it is looked which ports are bound.
    pub(crate) async fn join_looking(
        place: Arc<dyn Place>,
        config: Config,
        ports_each: Duration,
    ) -> Result<Participant, JoinError> {
        let ports = Ports::of(config.domain).ok_or(JoinError::NoSuchDomain(config.domain))?;
        let network = look(&*place, &config.interfaces).await;
        let here = match &config.interfaces {
            Interfaces::These(these) if these.len() == 1 => these[0],
            _ => Ipv4Addr::UNSPECIFIED,
        };
        let (discovery, user) = if config.well_known {
            well_known(&*place, &config, ports, here).await?
        } else {
            let any = SocketAddr::from((here, 0));
            (
                place.datagrams(any, false).await?,
                place.datagrams(any, false).await?,
            )
        };
        let by_itself = !config.alone && config.servers.is_empty();
        let multicast = match config.multicast && by_itself {
            true => multicast(&*place, ports).await,
            false => None,
        };
        let diagnostics = place.diagnostics().await.unwrap_or_else(|error| {
            tracing::debug!(%error, "it is not known how full receivers of DDS are");
            None
        });
        let flow = Flow::new(diagnostics);
        let own = own_data(&config, &network, &discovery, &user)?;
        let mut announce_to = peers(&config.peers, ports);
        if multicast.is_some() {
            announce_to.push(SocketAddr::from((MULTICAST, ports.discovery_multicast())));
        }
        if !flow.sees() {
            let here = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
            announce_to.extend(peers(&[here], ports));
        }
        if !by_itself {
            announce_to.clear();
        }
        let bounds = Bounds {
            max_sample: config.max_sample,
            budget: config.budget,
            unfinished: config.unfinished,
        };
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
        let shared = Shared::new(engine, flow, sockets, network)?;
        let task = tokio::spawn(drive(Arc::clone(&shared), ports_each)).abort_handle();
        let looking = (!config.interfaces.is_loopback()).then(|| {
            let looking = look_again(Arc::clone(&shared), place, config.interfaces);
            tokio::spawn(looking).abort_handle()
        });
        Ok(Participant {
            running: Arc::new(Running {
                shared,
                task,
                looking,
                guid,
            }),
        })
    }

    /// Which participant it is.
    pub fn guid(&self) -> Guid {
        self.running.guid
    }

    /// Who is there beside it.
    pub fn discovered(&self) -> watch::Receiver<Arc<Discovered>> {
        self.running.shared.look(Engine::discovered)
    }

    /// Reads a topic until what is returned is dropped.
    pub fn reader(&self, topic: Topic, qos: EndpointQos, sink: Arc<dyn Sink>) -> Reader {
        let (guid, ends) = self
            .running
            .shared
            .with(|now, engine| engine.add_reader(now, &topic, qos, sink));
        Reader {
            end: End {
                running: Arc::clone(&self.running),
                guid,
                ends,
            },
        }
    }

    /// Writes to a topic until what is returned is dropped.
    pub fn writer(&self, topic: Topic, qos: EndpointQos) -> Writer {
        let (guid, ends) = self
            .running
            .shared
            .with(|now, engine| engine.add_writer(now, &topic, qos));
        Writer {
            end: End {
                running: Arc::clone(&self.running),
                guid,
                ends,
            },
        }
    }

    /// A process of this machine is known to have ended: whoever had ports there is gone at once, not when it is time to look at
    /// ports again. Changes nothing where the kernel cannot be asked.
    pub fn look_at_ports(&self) {
        self.running.shared.look_now();
    }

    /// Returns once readers have all that was written to them.
    pub async fn settled(&self) {
        while !self.running.shared.look(Engine::is_settled) {
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Says good-bye. Ends that are still held become inert.
    pub async fn close(&self) {
        self.running.shared.with(|now, engine| engine.close(now));
        self.running.stop();
    }
}

/// How often it is looked whether all has come, where somebody waits for that.
const LOOK: Duration = Duration::from_millis(5);

/// How often it is looked which interfaces there are: a network that comes is used after this time.
const INTERFACES: Duration = Duration::from_secs(2);

/// Where nobody tells which participants a machine has, those with the first numbers are told of us; as many as ROS 2's nodes try.
const UNSEEN: u16 = 32;

/// The interfaces that are meant, as they are now.
async fn look(place: &dyn Place, meant: &Interfaces) -> Network {
    if let (Interfaces::These(these), true) = (meant, meant.is_loopback()) {
        let loopback = |address: &Ipv4Addr| Interface {
            address: *address,
            ..Interface::LOOPBACK
        };
        return Network::new(these.iter().map(loopback).collect());
    }
    let found = place.interfaces().await.unwrap_or_else(|error| {
        tracing::debug!(%error, "the interfaces of this machine are not known");
        Vec::new()
    });
    Network::new(meant.among(found))
}

/// Follows the interfaces of a place.
async fn look_again(shared: Arc<Shared>, place: Arc<dyn Place>, meant: Interfaces) {
    loop {
        tokio::time::sleep(INTERFACES).await;
        shared.network_is(look(&*place, &meant).await);
    }
}

/// Where to announce oneself to these.
fn peers(peers: &[SocketAddr], ports: Ports) -> Vec<SocketAddr> {
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

/// Sockets at the first free pair of the ports that participants of a domain have (9.6.2.3).
async fn well_known(
    place: &dyn Place,
    config: &Config,
    ports: Ports,
    here: Ipv4Addr,
) -> Result<(UdpSocket, UdpSocket), JoinError> {
    for number in 0.. {
        let (Some(discovery), Some(user)) = (ports.discovery(number), ports.user(number)) else {
            break;
        };
        let discovery = place
            .datagrams(SocketAddr::from((here, discovery)), false)
            .await;
        let user = place.datagrams(SocketAddr::from((here, user)), false).await;
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

/// A socket that hears announcements to all, where it is told to in which networks.
async fn multicast(place: &dyn Place, ports: Ports) -> Option<UdpSocket> {
    let at = SocketAddr::from((Ipv4Addr::UNSPECIFIED, ports.discovery_multicast()));
    let opened = place.datagrams(at, true).await;
    // What comes by networks of others of this machine is not for us.
    let opened = opened.and_then(|socket| {
        SockRef::from(&socket).set_multicast_all_v4(false)?;
        Ok(socket)
    });
    opened
        .map_err(|error| tracing::debug!(%error, "DDS participants are not heard by multicast"))
        .ok()
}

fn own_data(
    config: &Config,
    network: &Network,
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

struct End {
    running: Arc<Running>,
    guid: Guid,
    ends: watch::Receiver<Arc<Ends>>,
}

impl Drop for End {
    fn drop(&mut self) {
        // What is taken out is dropped when the engine is free again: a sink may hold other ends.
        drop(
            self.running
                .shared
                .with(|now, engine| engine.remove_end(now, self.guid.entity)),
        );
    }
}

/// A reader of ours; dropping it withdraws it.
pub struct Reader {
    end: End,
}

impl Reader {
    /// Which end it is.
    pub fn guid(&self) -> Guid {
        self.end.guid
    }

    /// The writers of its topic, now and later.
    pub fn ends(&self) -> watch::Receiver<Arc<Ends>> {
        self.end.ends.clone()
    }
}

/// A writer of ours; dropping it withdraws it once its readers have what was written, or after two seconds.
pub struct Writer {
    end: End,
}

impl Writer {
    /// Which end it is.
    pub fn guid(&self) -> Guid {
        self.end.guid
    }

    /// The readers of its topic, now and later.
    pub fn ends(&self) -> watch::Receiver<Arc<Ends>> {
        self.end.ends.clone()
    }

    /// Writes a sample: CDR with its header of four bytes. Never waits; its number.
    pub fn write(&self, payload: Bytes) -> SequenceNumber {
        self.put(payload, None)
    }

    /// The same, of a request or reply: with the identity by which both are known.
    pub fn write_related(&self, payload: Bytes, related: SampleIdentity) -> SequenceNumber {
        self.put(payload, Some(related))
    }

    fn put(&self, payload: Bytes, related: Option<SampleIdentity>) -> SequenceNumber {
        let entity = self.end.guid.entity;
        self.end
            .running
            .shared
            .with(|now, engine| engine.write(now, entity, payload, related))
    }

    /// Samples that were given up before all reliable readers had acknowledged them.
    pub fn dropped(&self) -> u64 {
        self.end
            .running
            .shared
            .look(|engine| engine.dropped(self.end.guid.entity))
    }
}

impl fmt::Debug for Participant {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Participant")
            .field("guid", &self.guid())
            .finish_non_exhaustive()
    }
}
