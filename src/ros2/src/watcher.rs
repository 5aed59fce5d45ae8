//! Tracks discovery and the announcements of participants, publishes the graph, and announces this node's endpoints.

use std::collections::HashMap;
use std::future::pending;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rtps::Guid;
use tokio::time::sleep_until;

use super::entities::{self, DiscoveredNode, GidSize};
use super::other_types::TypeMismatchLog;
use super::seen::DiscoverySnapshot;
use super::state::Ros2BusState;
use super::{calls, graph};

/// Time for a ROS participant to announce the node of an endpoint. Until then its messages are held, and it is not
/// shown.
const PATIENCE: Duration = Duration::from_millis(500);

/// Tracks one bus's graph.
pub(super) struct Watcher {
    bus: Arc<Ros2BusState>,
    /// Announces this node, and the nodes it represents.
    teller: rtps::DataWriter,
    /// Last announcement.
    told: Option<(Vec<DiscoveredNode>, GidSize)>,
    /// Endpoints whose node is not known yet, and since when.
    unnamed: HashMap<Guid, Instant>,
    /// Time at which the next of them counts as late.
    late_at: Option<Instant>,
    other_types: TypeMismatchLog,
}

impl Watcher {
    /// Creates a watcher with the writer for announcements.
    pub(super) fn new(bus: Arc<Ros2BusState>, teller: rtps::DataWriter) -> Self {
        Self {
            bus,
            teller,
            told: None,
            unnamed: HashMap::new(),
            late_at: None,
            other_types: TypeMismatchLog::default(),
        }
    }

    /// Runs forever.
    pub(super) async fn run(mut self) {
        let mut discovered = self.bus.participant.watch_discovered();
        let mut told = self.bus.told.changes();
        let mut own = self.bus.own.changes();
        loop {
            discovered.mark_unchanged();
            told.mark_unchanged();
            own.mark_unchanged();
            self.refresh();
            let late = self.late_at;
            let late = async {
                match late {
                    Some(late) => sleep_until(late.into()).await,
                    None => pending().await,
                }
            };
            let changed = tokio::select! {
                () = late => continue,
                changed = discovered.changed() => changed,
                changed = told.changed() => changed,
                changed = own.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
        }
    }

    /// Publishes the current state.
    pub(super) fn refresh(&mut self) {
        let bus = &self.bus;
        let (discovered, told) = bus.told.snapshot(&bus.participant.watch_discovered());
        let mut seen = DiscoverySnapshot::new(discovered, &told);
        self.wait_for_names(&mut seen);
        let seen = Arc::new(seen);
        let bus = &self.bus;
        let own = bus.own.ends();
        let nodes = bus.own.announced_nodes(&own, &bus.node);
        self.announce(nodes, seen.gids);
        let bus = &self.bus;
        let mut now = graph::build(&seen, &own, (bus.node.as_str(), bus.participant.guid()));
        // A task woken by the discovery snapshot (to name the publisher of a message, say) sees the new graph, and one
        // woken by the graph sees the new snapshot.
        let mut news = false;
        bus.graph.send_if_modified(|before| {
            now.generation = before.generation;
            news = **before != now;
            if news {
                now.generation += 1;
                *before = Arc::new(now);
            }
            false
        });
        bus.seen.send_replace(Arc::clone(&seen));
        calls::drop_unserved_clients(bus, &seen);
        let services = bus.services.lock();
        let served = services.iter().map(|(name, served)| (name.as_str(), &served.of));
        self.other_types.log_new(served, &seen);
        drop(services);
        bus.graph.send_if_modified(|_| news);
    }

    /// Waits for the nodes of endpoints; those not announced in time count as late.
    fn wait_for_names(&mut self, seen: &mut DiscoverySnapshot) {
        let now = Instant::now();
        let mut unnamed = HashMap::new();
        for end in seen.unnamed_endpoints() {
            unnamed.insert(end, self.unnamed.get(&end).copied().unwrap_or(now));
        }
        let due = unnamed.iter().map(|(end, since)| (*end, *since + PATIENCE));
        let (late, waited_for): (Vec<_>, Vec<_>) = due.partition(|(_, due)| *due <= now);
        seen.late = late.into_iter().map(|(end, _)| end).collect();
        self.late_at = waited_for.into_iter().map(|(_, due)| due).min();
        self.unnamed = unnamed;
    }

    fn announce(&mut self, nodes: Vec<DiscoveredNode>, size: GidSize) {
        let now = (nodes, size);
        if self.told.as_ref() != Some(&now) {
            let participant = self.bus.participant.guid();
            self.teller.write(entities::encode(participant, &now.0, size));
            self.told = Some(now);
        }
    }
}
