//! Matching of local and remote endpoints: same topic, same type and compatible QoS (8.4.15).

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use super::Engine;
use crate::discovery::EndpointData;
use crate::qos::Mismatch;
use crate::shared::EndpointMatches;
use crate::writer::SendRequests;
use crate::{EntityId, Guid};

impl Engine {
    /// Handles a new or changed remote endpoint.
    pub(super) fn on_endpoint_discovered(&mut self, now: Instant, told: Arc<EndpointData>) {
        let guid = told.guid;
        let known = if guid.entity.is_writer() { &mut self.discovered.writers } else { &mut self.discovered.readers };
        if known.get(&guid).is_some_and(|before| *before == told) {
            return;
        }
        let again = known.insert(guid, Arc::clone(&told)).is_some();
        self.discovered_changed = true;
        if again {
            self.unmatch(guid);
        }
        if guid.entity.is_writer() {
            let ours: Vec<EntityId> = self
                .readers
                .iter()
                .filter(|(_, reader)| is_same_topic(&reader.state.own, &told))
                .map(|(entity, _)| *entity)
                .collect();
            for entity in ours {
                self.match_reader(now, entity, &told);
            }
        } else {
            let ours: Vec<EntityId> = self
                .writers
                .iter()
                .filter(|(_, writer)| is_same_topic(&writer.state.own, &told))
                .map(|(entity, _)| *entity)
                .collect();
            for entity in ours {
                self.match_writer(now, entity, &told);
            }
        }
    }

    pub(super) fn on_endpoint_lost(&mut self, guid: Guid) {
        let known = if guid.entity.is_writer() { &mut self.discovered.writers } else { &mut self.discovered.readers };
        if known.remove(&guid).is_some() {
            self.discovered_changed = true;
            self.unmatch(guid);
        }
    }

    fn unmatch(&mut self, guid: Guid) {
        let Engine { readers, writers, changed_ends, .. } = self;
        for (entity, reader) in readers {
            let refused = reader.ends.borrow().refused.iter().any(|(end, _)| end.guid == guid);
            if reader.state.remove_writer(guid) || refused {
                changed_ends.insert(*entity);
            }
        }
        for (entity, writer) in writers {
            let refused = writer.ends.borrow().refused.iter().any(|(end, _)| end.guid == guid);
            if writer.state.remove_reader(guid) || refused {
                changed_ends.insert(*entity);
            }
        }
    }

    pub(super) fn match_own_writer(&mut self, now: Instant, entity: EntityId) {
        let Some(own) = self.writers.get(&entity).map(|writer| writer.state.own.clone()) else {
            return;
        };
        let theirs: Vec<_> = self.discovered.readers.values().filter(|end| is_same_topic(&own, end)).cloned().collect();
        for end in theirs {
            self.match_writer(now, entity, &end);
        }
    }

    pub(super) fn match_own_reader(&mut self, now: Instant, entity: EntityId) {
        let Some(own) = self.readers.get(&entity).map(|reader| reader.state.own.clone()) else {
            return;
        };
        let theirs: Vec<_> = self.discovered.writers.values().filter(|end| is_same_topic(&own, end)).cloned().collect();
        for end in theirs {
            self.match_reader(now, entity, &end);
        }
    }

    /// Matches a local writer with a reader.
    fn match_writer(&mut self, now: Instant, entity: EntityId, reader: &Arc<EndpointData>) {
        let Some(address) = self.endpoint_address(reader) else {
            return;
        };
        self.changed_ends.insert(entity);
        let mut wanted = SendRequests::default();
        if let Some(ours) = self.writers.get_mut(&entity) {
            if ours.state.own.qos.mismatches(&reader.qos).is_empty() {
                ours.state.add_reader(now, Arc::clone(reader), address, &mut wanted);
            }
        }
        self.enqueue(entity, wanted);
        self.wake(now);
    }

    /// Matches a local reader with a writer.
    fn match_reader(&mut self, now: Instant, entity: EntityId, writer: &Arc<EndpointData>) {
        let Some(address) = self.endpoint_address(writer) else {
            return;
        };
        let vendor = self.vendor_of(writer.guid.prefix);
        self.changed_ends.insert(entity);
        if let Some(ours) = self.readers.get_mut(&entity) {
            if writer.qos.mismatches(&ours.state.own.qos).is_empty() {
                ours.state.add_writer(now, Arc::clone(writer), address, vendor);
            }
        }
        self.wake(now);
    }

    /// Returns the address at which a remote endpoint receives.
    fn endpoint_address(&self, end: &EndpointData) -> Option<SocketAddr> {
        let remote = self.remotes.get(&end.guid.prefix)?;
        let own = self.network.choose_address(&end.unicast, Some(remote.user.ip()));
        Some(own.unwrap_or(remote.user))
    }

    /// Publishes to the watchers what has changed since the last call.
    pub(super) fn publish_changes(&mut self) {
        for entity in std::mem::take(&mut self.changed_ends) {
            if let Some(writer) = self.writers.get(&entity) {
                let refused = |end: &Arc<EndpointData>| writer.state.own.qos.mismatches(&end.qos);
                let theirs = self.discovered.readers.values().filter(|end| is_same_topic(&writer.state.own, end));
                writer.ends.send_replace(Arc::new(collect_matches(writer.state.readers(), theirs, refused)));
            } else if let Some(reader) = self.readers.get(&entity) {
                let refused = |end: &Arc<EndpointData>| end.qos.mismatches(&reader.state.own.qos);
                let theirs = self.discovered.writers.values().filter(|end| is_same_topic(&reader.state.own, end));
                let mut ends = collect_matches(reader.state.writers(), theirs, refused);
                ends.kept = reader.state.kept_samples().collect();
                reader.ends.send_replace(Arc::new(ends));
            }
        }
        if std::mem::take(&mut self.discovered_changed) {
            self.discovered.generation += 1;
            self.told.send_replace(Arc::new(self.discovered.clone()));
        }
    }
}

fn collect_matches<'a>(
    matched: impl Iterator<Item = (&'a Arc<EndpointData>, bool)>,
    theirs: impl Iterator<Item = &'a Arc<EndpointData>>,
    mismatches: impl Fn(&Arc<EndpointData>) -> Vec<Mismatch>,
) -> EndpointMatches {
    let mut ends = EndpointMatches::default();
    for (end, confirmed) in matched {
        ends.matched.push(Arc::clone(end));
        ends.confirmed.extend(confirmed.then_some(end.guid));
    }
    let refused = theirs.map(|end| (Arc::clone(end), mismatches(end))).filter(|(_, why)| !why.is_empty());
    ends.refused = refused.collect();
    ends
}

/// Returns whether two endpoints have the same topic and type.
fn is_same_topic(ours: &EndpointData, theirs: &EndpointData) -> bool {
    ours.topic == theirs.topic && ours.type_name == theirs.type_name
}
