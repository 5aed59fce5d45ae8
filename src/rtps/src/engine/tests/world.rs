//! A network that loses what it is told to lose, where time passes when nothing else happens.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;

use crate::discovery::ParticipantData;
use crate::engine::{BUILTIN, Engine, Settings};
use crate::locator::{Locator, Ports};
use crate::network::Network;
use crate::participant::{Ends, Sample, Sink, Topic};
use crate::qos::{Durability, EndpointQos, History, Reliability};
use crate::reader::Bounds;
use crate::{Guid, GuidPrefix, VendorId};

/// What a reader has read.
#[derive(Default)]
pub(super) struct Read(pub(super) Mutex<Vec<Sample>>);

impl Sink for Read {
    fn sample(&self, sample: Sample) {
        self.0.lock().push(sample);
    }
}

impl Read {
    pub(super) fn lengths(&self) -> Vec<usize> {
        self.0
            .lock()
            .iter()
            .map(|sample| sample.payload.len())
            .collect()
    }

    /// The first byte behind the header of each.
    pub(super) fn marks(&self) -> Vec<u8> {
        self.0
            .lock()
            .iter()
            .map(|sample| sample.payload[4])
            .collect()
    }
}

/// Says of a datagram, by its number and bytes, whether it is lost.
pub(super) type Loses = Box<dyn FnMut(usize, &[u8]) -> bool>;

pub(super) struct World {
    pub(super) now: Instant,
    pub(super) engines: Vec<Engine>,
    /// Which of them were killed: nothing comes from them, or to them, any more.
    pub(super) killed: BTreeSet<usize>,
    /// Which of all datagrams are lost, by their number.
    pub(super) loses: Loses,
    sent: usize,
    /// What receivers take at a time, in bytes; all if none.
    pub(super) room: Option<usize>,
    /// Of samples that are not whole yet.
    pub(super) budget: budget::Budget,
}

pub(super) const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

/// Ports of this machine.
pub(super) fn bound<const N: usize>(ports: [u16; N]) -> BTreeSet<SocketAddrV4> {
    let at = |port| SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
    ports.into_iter().map(at).collect()
}

pub(super) fn discovery_of(index: usize) -> u16 {
    7410 + 2 * index as u16
}

impl World {
    pub(super) fn of(participants: usize) -> Self {
        let mut world = Self {
            now: Instant::now(),
            engines: Vec::new(),
            killed: BTreeSet::new(),
            loses: Box::new(|_, _| false),
            sent: 0,
            room: None,
            budget: budget::Budget::new("samples", 1 << 30),
        };
        (0..participants).for_each(|_| world.join());
        world
    }

    pub(super) fn join(&mut self) {
        self.join_after(&[]);
    }

    /// One joins in the place of these.
    pub(super) fn join_after(&mut self, predecessors: &[GuidPrefix]) {
        let index = self.engines.len();
        let at = |port: u16| vec![Locator::from((Ipv4Addr::LOCALHOST, port))];
        let own = ParticipantData {
            prefix: GuidPrefix([index as u8 + 1; 12]),
            vendor: VendorId::OURS,
            version: [2, 3],
            domain: Some(0),
            name: format!("participant {index}"),
            user_data: Bytes::new(),
            discovery: at(discovery_of(index)),
            user: at(discovery_of(index) + 1),
            builtin: BUILTIN,
            lease: Some(Duration::from_secs(10)),
        };
        let bounds = Bounds {
            max_sample: 16 << 20,
            budget: self.budget.clone(),
            unfinished: Duration::from_secs(30),
        };
        let announce_to = (0..4)
            .map(|other| SocketAddr::from(([127, 0, 0, 1], discovery_of(other))))
            .collect();
        let ports = Ports::of(0).expect("a domain");
        self.engines.push(Engine::new(
            self.now,
            Settings {
                own,
                ports,
                bounds,
                announce_to,
                servers: Vec::new(),
                network: Network::new(Vec::new()),
                alone: false,
                predecessors: predecessors.to_vec(),
            },
        ));
    }

    /// Carries what there is to carry, once; whether there was anything.
    pub(super) fn carry(&mut self) -> bool {
        let mut carried = false;
        for index in 0..self.engines.len() {
            let mut left = self.room.unwrap_or(usize::MAX);
            let mut out = Vec::new();
            while let Some(datagram) = self.engines[index].transmit(&mut |_, length, _| {
                let fits = left >= length;
                left -= if fits { length } else { 0 };
                fits
            }) {
                out.push(datagram);
            }
            carried |= !out.is_empty();
            if self.killed.contains(&index) {
                continue;
            }
            for datagram in out {
                let bytes: Bytes = datagram
                    .parts()
                    .iter()
                    .flat_map(|part| part.to_vec())
                    .collect();
                self.sent += 1;
                if (self.loses)(self.sent, &bytes) {
                    continue;
                }
                let to = usize::from((datagram.to.port() - 7410) / 2);
                let there = self.engines.get_mut(to);
                if let Some(engine) = there.filter(|_| !self.killed.contains(&to)) {
                    engine.receive(self.now, HERE, &bytes);
                }
            }
        }
        for engine in &mut self.engines {
            for (sink, sample) in engine.take_deliveries() {
                sink.sample(sample);
            }
        }
        carried
    }

    /// Lets the world go on for so long.
    pub(super) fn pass(&mut self, duration: Duration) {
        let until = self.now + duration;
        for _ in 0..200_000 {
            if self.carry() {
                continue;
            }
            let next = self
                .engines
                .iter()
                .map(Engine::tick_at)
                .min()
                .unwrap_or(until);
            if next > until {
                break;
            }
            self.now = self.now.max(next);
            for engine in &mut self.engines {
                if engine.tick_at() <= self.now {
                    engine.tick(self.now);
                }
            }
        }
        self.now = until;
    }

    pub(super) fn writer(
        &mut self,
        engine: usize,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<Ends>>) {
        let now = self.now;
        self.engines[engine].add_writer(now, &topic(), qos)
    }

    pub(super) fn reader(
        &mut self,
        engine: usize,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<Ends>>, Arc<Read>) {
        let now = self.now;
        let read = Arc::new(Read::default());
        let (guid, ends) = self.engines[engine].add_reader(now, &topic(), qos, read.clone());
        (guid, ends, read)
    }

    pub(super) fn write(&mut self, writer: Guid, mark: u8, length: usize) {
        let now = self.now;
        let mut payload = vec![mark; length];
        payload[..4].copy_from_slice(&[0, 1, 0, 0]);
        let index = usize::from(writer.prefix.0[0]) - 1;
        self.engines[index].write(now, writer.entity, payload.into(), None);
    }
}

pub(super) fn topic() -> Topic {
    Topic {
        name: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        user_data: Bytes::new(),
    }
}

pub(super) fn keep(depth: u32) -> EndpointQos {
    EndpointQos {
        history: History::KeepLast(depth),
        ..EndpointQos::default()
    }
}

pub(super) fn best_effort() -> EndpointQos {
    EndpointQos {
        reliability: Reliability::BestEffort,
        ..keep(10)
    }
}

pub(super) fn transient(depth: u32) -> EndpointQos {
    EndpointQos {
        durability: Durability::TransientLocal,
        ..keep(depth)
    }
}

pub(super) const SECOND: Duration = Duration::from_secs(1);

/// Numbers that look random and are the same every time.
pub(super) fn scattered(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed;
    move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    }
}
