//! A simulated network with configurable loss, in which time passes when nothing else happens.

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
use crate::network::InterfaceSet;
use crate::qos::{DurabilityKind, EndpointQos, HistoryKind, ReliabilityKind};
use crate::reader::ReaderLimits;
use crate::shared::{EndpointMatches, ReceivedSample, Sink, TopicDescription};
use crate::{Guid, GuidPrefix, VendorId};

/// Collects the samples of a reader.
#[derive(Default)]
pub(super) struct SampleRecorder(pub(super) Mutex<Vec<ReceivedSample>>);

impl Sink for SampleRecorder {
    fn on_sample(&self, sample: ReceivedSample) {
        self.0.lock().push(sample);
    }
}

impl SampleRecorder {
    pub(super) fn lengths(&self) -> Vec<usize> {
        self.0.lock().iter().map(|sample| sample.payload.len()).collect()
    }

    /// Returns the first byte after the header of each sample.
    pub(super) fn marks(&self) -> Vec<u8> {
        self.0.lock().iter().map(|sample| sample.payload[4]).collect()
    }
}

/// Decides by number and bytes of a datagram whether it is lost.
pub(super) type LossFilter = Box<dyn FnMut(usize, &[u8]) -> bool>;

pub(super) struct NetworkWorld {
    pub(super) now: Instant,
    pub(super) engines: Vec<Engine>,
    /// Killed participants, which neither send nor receive any more.
    pub(super) killed: BTreeSet<usize>,
    /// Decides which datagrams are lost, by their number.
    pub(super) loses: LossFilter,
    sent: usize,
    /// Bytes that receivers accept at a time; `None`: unlimited.
    pub(super) room: Option<usize>,
    /// Budget for incomplete samples.
    pub(super) budget: budget::Budget,
}

pub(super) const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

/// Returns the addresses of ports on this machine.
pub(super) fn bound_ports<const N: usize>(ports: [u16; N]) -> BTreeSet<SocketAddrV4> {
    let at = |port| SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
    ports.into_iter().map(at).collect()
}

pub(super) fn discovery_port(index: usize) -> u16 {
    7410 + 2 * index as u16
}

impl NetworkWorld {
    pub(super) fn with_participants(participants: usize) -> Self {
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

    /// Adds a participant that replaces these.
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
            discovery: at(discovery_port(index)),
            user: at(discovery_port(index) + 1),
            builtin: BUILTIN,
            lease: Some(Duration::from_secs(10)),
        };
        let bounds =
            ReaderLimits { max_sample: 16 << 20, budget: self.budget.clone(), unfinished: Duration::from_secs(30) };
        let announce_to = (0..4).map(|other| SocketAddr::from(([127, 0, 0, 1], discovery_port(other)))).collect();
        let ports = Ports::for_domain(0).expect("a domain");
        self.engines.push(Engine::new(
            self.now,
            Settings {
                own,
                ports,
                bounds,
                announce_to,
                servers: Vec::new(),
                network: InterfaceSet::new(Vec::new()),
                alone: false,
                predecessors: predecessors.to_vec(),
            },
        ));
    }

    /// Delivers all queued datagrams once; returns whether there were any.
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
                let bytes: Bytes = datagram.parts().iter().flat_map(|part| part.to_vec()).collect();
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
                sink.on_sample(sample);
            }
        }
        carried
    }

    /// Lets time pass.
    pub(super) fn advance(&mut self, duration: Duration) {
        let until = self.now + duration;
        for _ in 0..200_000 {
            if self.carry() {
                continue;
            }
            let next = self.engines.iter().map(Engine::tick_at).min().unwrap_or(until);
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

    pub(super) fn writer(&mut self, engine: usize, qos: EndpointQos) -> (Guid, watch::Receiver<Arc<EndpointMatches>>) {
        let now = self.now;
        self.engines[engine].add_writer(now, &topic(), qos)
    }

    pub(super) fn reader(
        &mut self,
        engine: usize,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<EndpointMatches>>, Arc<SampleRecorder>) {
        let now = self.now;
        let read = Arc::new(SampleRecorder::default());
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

pub(super) fn topic() -> TopicDescription {
    TopicDescription {
        name: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        user_data: Bytes::new(),
    }
}

pub(super) fn keep_last_qos(depth: u32) -> EndpointQos {
    EndpointQos { history: HistoryKind::KeepLast(depth), ..EndpointQos::default() }
}

pub(super) fn best_effort_qos() -> EndpointQos {
    EndpointQos { reliability: ReliabilityKind::BestEffort, ..keep_last_qos(10) }
}

pub(super) fn transient_local_qos(depth: u32) -> EndpointQos {
    EndpointQos { durability: DurabilityKind::TransientLocal, ..keep_last_qos(depth) }
}

pub(super) const SECOND: Duration = Duration::from_secs(1);

/// Returns a deterministic pseudo-random number generator.
pub(super) fn pseudo_random(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    }
}
