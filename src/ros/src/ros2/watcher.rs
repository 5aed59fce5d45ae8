//! Follows what is discovered and what participants tell of their nodes, shows the graph, and tells the others what this node
//! has.

use std::collections::HashMap;
use std::future::pending;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rtps::Guid;
use tokio::time::sleep_until;

use super::bus::Inner;
use super::entities::{self, GidSize, Node};
use super::other_types::OtherTypes;
use super::seen::Seen;
use super::{calls, graph};

/// A participant of ROS has so long to tell whose an end is. Until then what it sends is kept, and it is not shown.
const PATIENCE: Duration = Duration::from_millis(500);

/// Follows one bus's graph.
pub(super) struct Watcher {
    bus: Arc<Inner>,
    /// Tells of this node, and of those that it stands for.
    teller: rtps::Writer,
    /// What was told last.
    told: Option<(Vec<Node>, GidSize)>,
    /// Ends of nobody yet, and since when.
    unnamed: HashMap<Guid, Instant>,
    /// When the next of them will be late.
    late_at: Option<Instant>,
    other_types: OtherTypes,
}

impl Watcher {
    /// With the writer by which it tells of this node.
    pub(super) fn new(bus: Arc<Inner>, teller: rtps::Writer) -> Self {
        Self {
            bus,
            teller,
            told: None,
            unnamed: HashMap::new(),
            late_at: None,
            other_types: OtherTypes::default(),
        }
    }

    /// Follows for ever.
    pub(super) async fn run(mut self) {
        let mut discovered = self.bus.participant.discovered();
        let mut told = self.bus.told.changes();
        let mut own = self.bus.own.changes();
        loop {
            discovered.mark_unchanged();
            told.mark_unchanged();
            own.mark_unchanged();
            self.look();
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

    /// Shows what is there now.
    pub(super) fn look(&mut self) {
        let bus = &self.bus;
        let (discovered, told) = bus.told.of(&bus.participant.discovered());
        let mut seen = Seen::new(discovered, &told);
        self.wait_for_names(&mut seen);
        let seen = Arc::new(seen);
        let bus = &self.bus;
        let own = bus.own.ends();
        let nodes = bus.own.told(&own, &bus.node);
        self.tell(nodes, seen.gids);
        let bus = &self.bus;
        let mut now = graph::build(&seen, &own, (bus.node.as_str(), bus.participant.guid()));
        // Whoever is woken by what is seen (a message is named by it, say) finds the graph as new; whoever is woken by the graph, what is seen.
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
        calls::forget_unserved(bus, &seen);
        let services = bus.services.lock();
        let served = services
            .iter()
            .map(|(name, served)| (name.as_str(), &served.of));
        self.other_types.look(served, &seen);
        drop(services);
        bus.graph.send_if_modified(|_| news);
    }

    /// Ends that were not named in time are late from then on.
    fn wait_for_names(&mut self, seen: &mut Seen) {
        let now = Instant::now();
        let mut unnamed = HashMap::new();
        for end in seen.unnamed() {
            unnamed.insert(end, self.unnamed.get(&end).copied().unwrap_or(now));
        }
        let due = unnamed.iter().map(|(end, since)| (*end, *since + PATIENCE));
        let (late, waited_for): (Vec<_>, Vec<_>) = due.partition(|(_, due)| *due <= now);
        seen.late = late.into_iter().map(|(end, _)| end).collect();
        self.late_at = waited_for.into_iter().map(|(_, due)| due).min();
        self.unnamed = unnamed;
    }

    fn tell(&mut self, nodes: Vec<Node>, size: GidSize) {
        let now = (nodes, size);
        if self.told.as_ref() != Some(&now) {
            let participant = self.bus.participant.guid();
            self.teller
                .write(entities::encode(participant, &now.0, size));
            self.told = Some(now);
        }
    }
}
