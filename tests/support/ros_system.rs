//! A robot's ROS system: a Master of ROS 1, or a domain of ROS 2, on loopback.

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

/// The domains whose ports are nobody else's: beyond them are those that the kernel gives away.
const DOMAINS: u32 = 101;

/// Something that is on a bus.
pub trait Node {
    /// Its bus.
    fn bus(&self) -> &dyn Bus;
}

impl Node for Ros1Bus {
    fn bus(&self) -> &dyn Bus {
        self
    }
}

impl Node for dyn Bus {
    fn bus(&self) -> &dyn Bus {
        self
    }
}

impl<N: Node + ?Sized> Node for Arc<N> {
    fn bus(&self) -> &dyn Bus {
        (**self).bus()
    }
}

/// A ROS system of one's own.
pub enum RosSystem {
    /// ROS 1.
    Master {
        /// Where it listens.
        address: SocketAddr,
        /// Serves it, unless it has been ended.
        serving: Option<JoinHandle<()>>,
    },
    /// ROS 2.
    Domain(Domain),
}

/// A domain of ROS 2 that no other test and no stub takes, until it is dropped.
pub struct Domain {
    /// `ROS_DOMAIN_ID`.
    pub id: u16,
    range: Range,
    /// Networks of a test's own need none.
    _lock: Option<UnixListener>,
}

/// Whom a domain's nodes look for.
enum Range {
    /// Those of this machine.
    Machine,
    /// Those of all networks, by these discovery servers, or by multicast.
    Network { servers: Option<String> },
}

impl Domain {
    /// One that is free.
    ///
    /// # Errors
    /// All are taken.
    pub fn take() -> anyhow::Result<Self> {
        let first = std::process::id().wrapping_mul(37) % DOMAINS;
        let ids = (0..DOMAINS).map(|number| (first + number) % DOMAINS + 1);
        let taken = ids.into_iter().find_map(|id| {
            // As stubs take theirs.
            let name = format!("cloudroid-domain-{id}");
            let address = UnixAddress::from_abstract_name(name).ok()?;
            let lock = UnixListener::bind_addr(&address).ok()?;
            let id = u16::try_from(id).ok()?;
            Some(Self {
                id,
                range: Range::Machine,
                _lock: Some(lock),
            })
        });
        taken.context("all domains of ROS 2 are taken; end what is left of earlier runs")
    }

    /// One of networks of a test's own, where processes find each other by these discovery servers, or by multicast.
    pub fn of_network(id: u16, servers: Option<&str>) -> Self {
        Self {
            id,
            range: Range::Network {
                servers: servers.map(str::to_owned),
            },
            _lock: None,
        }
    }

    /// Has a process join it.
    pub fn is_of(&self, command: &mut Command) {
        command
            .env("ROS_DOMAIN_ID", self.id.to_string())
            .env_remove("ROS_LOCALHOST_ONLY")
            .env_remove("ROS_AUTOMATIC_DISCOVERY_RANGE")
            .env_remove("ROS_DISCOVERY_SERVER")
            .env_remove("ROS_STATIC_PEERS");
        match &self.range {
            Range::Machine => {
                command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
            }
            Range::Network { servers } => {
                let servers = servers.iter();
                command.envs(servers.map(|list| ("ROS_DISCOVERY_SERVER", list)));
            }
        }
    }
}

impl RosSystem {
    /// One with nobody in it.
    pub fn new(version: RosVersion, runtime: &Runtime) -> anyhow::Result<Self> {
        match version {
            RosVersion::One => {
                let mut system = Self::Master {
                    address: ([127, 0, 0, 1], 0).into(),
                    serving: None,
                };
                system.start_master(runtime)?;
                Ok(system)
            }
            RosVersion::Two => Ok(Self::Domain(Domain::take()?)),
        }
    }

    /// Which ROS it is.
    pub fn version(&self) -> RosVersion {
        match self {
            Self::Master { .. } => RosVersion::One,
            Self::Domain(_) => RosVersion::Two,
        }
    }

    /// Starts a Master, where the last one was if there was one; a domain needs none.
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

    /// Ends the Master; what was registered there is forgotten.
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

    /// Where its Master listens; nowhere in ROS 2.
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

    /// Has a process join it.
    pub fn is_of(&self, command: &mut Command) {
        match self {
            Self::Master { address, .. } => {
                command
                    .env("ROS_MASTER_URI", format!("http://{address}"))
                    .env_remove("ROS_NAMESPACE");
            }
            Self::Domain(domain) => domain.is_of(command),
        }
    }
}
