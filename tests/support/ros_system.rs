//! A robot's ROS system on loopback: a Master of ROS 1, or a domain of ROS 2.

use std::net::SocketAddr;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr as UnixAddress, UnixListener};
use std::process::Command;
use std::sync::Arc;

use anyhow::Context;
use ros::JoinOptions;
use ros::bus::{Bus, RosVersion};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;

/// Number of domains whose ports are not ephemeral ports of the kernel.
const DOMAINS: u32 = 101;

/// Something that has a bus.
pub trait HasBus {
    /// Returns its bus.
    fn bus(&self) -> &dyn Bus;
}

impl HasBus for Ros1Bus {
    fn bus(&self) -> &dyn Bus {
        self
    }
}

impl HasBus for dyn Bus {
    fn bus(&self) -> &dyn Bus {
        self
    }
}

impl<N: HasBus + ?Sized> HasBus for Arc<N> {
    fn bus(&self) -> &dyn Bus {
        (**self).bus()
    }
}

/// A private ROS system.
pub enum RosSystem {
    /// ROS 1.
    Master {
        /// Address of the Master.
        address: SocketAddr,
        /// Task that serves the Master; `None` once it was stopped.
        serving: Option<JoinHandle<()>>,
    },
    /// ROS 2.
    Domain(Domain),
}

/// A domain of ROS 2 that no other test and no stub uses, until drop.
pub struct Domain {
    /// `ROS_DOMAIN_ID`.
    pub id: u16,
    range: DomainRange,
    /// `None` for separate networks, which need no lock.
    _lock: Option<UnixListener>,
}

/// Discovery range of a domain's nodes.
enum DomainRange {
    /// Nodes of this machine.
    Machine,
    /// Nodes of all networks, through these discovery servers, or by multicast.
    Network { servers: Option<String> },
}

impl Domain {
    /// Reserves an unused domain.
    ///
    /// # Errors
    /// If all domains are in use.
    pub fn take() -> anyhow::Result<Self> {
        let first = std::process::id().wrapping_mul(37) % DOMAINS;
        let ids = (0..DOMAINS).map(|number| (first + number) % DOMAINS + 1);
        let taken = ids.into_iter().find_map(|id| {
            // With the same lock as the stubs use.
            let name = format!("cloudroid-domain-{id}");
            let address = UnixAddress::from_abstract_name(name).ok()?;
            let lock = UnixListener::bind_addr(&address).ok()?;
            let id = u16::try_from(id).ok()?;
            Some(Self { id, range: DomainRange::Machine, _lock: Some(lock) })
        });
        taken.context("all domains of ROS 2 are taken; end what is left of earlier runs")
    }

    /// Returns a domain for separate networks, in which processes discover each other through these servers, or by
    /// multicast.
    pub fn for_network(id: u16, servers: Option<&str>) -> Self {
        Self { id, range: DomainRange::Network { servers: servers.map(str::to_owned) }, _lock: None }
    }

    /// Makes a process join the domain.
    pub fn configure(&self, command: &mut Command) {
        command
            .env("ROS_DOMAIN_ID", self.id.to_string())
            .env_remove("ROS_LOCALHOST_ONLY")
            .env_remove("ROS_AUTOMATIC_DISCOVERY_RANGE")
            .env_remove("ROS_DISCOVERY_SERVER")
            .env_remove("ROS_STATIC_PEERS");
        match &self.range {
            DomainRange::Machine => {
                command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
            }
            DomainRange::Network { servers } => {
                let servers = servers.iter();
                command.envs(servers.map(|list| ("ROS_DISCOVERY_SERVER", list)));
            }
        }
    }
}

impl RosSystem {
    /// Creates a system without nodes.
    pub fn new(version: RosVersion, runtime: &Runtime) -> anyhow::Result<Self> {
        match version {
            RosVersion::One => {
                let mut system = Self::Master { address: ([127, 0, 0, 1], 0).into(), serving: None };
                system.start_master(runtime)?;
                Ok(system)
            }
            RosVersion::Two => Ok(Self::Domain(Domain::take()?)),
        }
    }

    /// Returns its version of ROS.
    pub fn version(&self) -> RosVersion {
        match self {
            Self::Master { .. } => RosVersion::One,
            Self::Domain(_) => RosVersion::Two,
        }
    }

    /// Starts a Master, at the address of the previous one if there was one; a domain needs none.
    pub fn start_master(&mut self, runtime: &Runtime) -> anyhow::Result<()> {
        if let Self::Master { address, serving } = self {
            let listener = runtime.block_on(TcpListener::bind(*address))?;
            *address = listener.local_addr()?;
            let master = Master::new(MasterOptions::default());
            let served = async move { master.serve(listener, Arc::new(HostSockets)).await };
            *serving = Some(runtime.spawn(served));
        }
        Ok(())
    }

    /// Stops the Master, which loses all registrations.
    pub fn end_master(&mut self, runtime: &Runtime) {
        let serving = match self {
            Self::Master { serving, .. } => serving.take(),
            Self::Domain(_) => None,
        };
        if let Some(serving) = serving {
            serving.abort();
            let _ = runtime.block_on(serving);
        }
    }

    /// Returns the address of its Master; `None` in ROS 2.
    pub fn master(&self) -> Option<SocketAddr> {
        match self {
            Self::Master { address, .. } => Some(*address),
            Self::Domain(_) => None,
        }
    }

    /// Joins it as a node of this name.
    pub async fn join(&self, name: &str) -> anyhow::Result<Arc<dyn Bus>> {
        let options = match self {
            Self::Master { address, .. } => JoinOptions::new(*address, name),
            Self::Domain(domain) => JoinOptions::in_domain(domain.id, name),
        };
        Ok(ros::connect(self.version(), Arc::new(HostSockets), options).await?)
    }

    /// Makes a process join the system.
    pub fn configure(&self, command: &mut Command) {
        // Those of this machine, if a setup file was sourced; a stub of the other version refuses to run there.
        command.env_remove("ROS_VERSION").env_remove("ROS_DISTRO");
        match self {
            Self::Master { address, .. } => {
                command.env("ROS_MASTER_URI", format!("http://{address}")).env_remove("ROS_NAMESPACE");
            }
            Self::Domain(domain) => domain.configure(command),
        }
    }
}
