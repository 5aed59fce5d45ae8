//! Local readers and writers: creation, writing and removal.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use tokio::sync::watch;

use super::{Engine, LocalReader, LocalWriter};
use crate::discovery::EndpointData;
use crate::qos::EndpointQos;
use crate::reader::ReaderState;
use crate::shared::{EndpointMatches, Sink, TopicDescription};
use crate::writer::{CacheChange, SendRequests, WriterState};
use crate::{EntityId, Guid, SampleIdentity, SequenceNumber};

/// Maximum time for which a dropped writer is kept until its readers have received everything.
const LINGER: Duration = Duration::from_secs(2);
/// Interval at which this is checked.
const LINGER_LOOK: Duration = Duration::from_millis(10);

impl Engine {
    pub fn add_writer(
        &mut self,
        now: Instant,
        topic: &TopicDescription,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<EndpointMatches>>) {
        let entity = EntityId::user_writer(self.next_entity_number());
        let own = self.endpoint_data(entity, topic, qos);
        let ends = watch::Sender::new(Arc::default());
        let receiver = ends.subscribe();
        let guid = own.guid;
        self.writers.insert(entity, LocalWriter { state: WriterState::new(own.clone()), ends, leaves: None });
        self.match_own_writer(now, entity);
        self.announce_endpoint(now, &own);
        self.publish_changes();
        (guid, receiver)
    }

    pub fn add_reader(
        &mut self,
        now: Instant,
        topic: &TopicDescription,
        qos: EndpointQos,
        sink: Arc<dyn Sink>,
    ) -> (Guid, watch::Receiver<Arc<EndpointMatches>>) {
        let entity = EntityId::user_reader(self.next_entity_number());
        let own = self.endpoint_data(entity, topic, qos);
        let ends = watch::Sender::new(Arc::default());
        let receiver = ends.subscribe();
        let guid = own.guid;
        let state = ReaderState::new(own.clone(), self.bounds.clone());
        self.readers.insert(entity, LocalReader { state, ends, sink: Some(sink) });
        self.match_own_reader(now, entity);
        self.announce_endpoint(now, &own);
        self.publish_changes();
        (guid, receiver)
    }

    /// Removes a local endpoint and announces it. The returned value must be dropped while the engine is not locked.
    #[must_use]
    pub fn remove_endpoint(&mut self, now: Instant, entity: EntityId) -> impl Sized + use<> {
        if let Some(writer) = self.writers.get_mut(&entity) {
            writer.leaves = Some(now + LINGER);
            self.remove_finished_writers(now);
        }
        let reader = self.readers.remove(&entity);
        if reader.is_some() {
            self.withdraw_endpoint(now, entity);
        }
        reader.map(|reader| reader.sink)
    }

    /// Removes dropped writers that have nothing left to send or have exceeded their time.
    pub(super) fn remove_finished_writers(&mut self, now: Instant) {
        let Engine { writers, paths, .. } = self;
        let done = |(entity, writer): (&EntityId, &LocalWriter)| {
            let leaves = writer.leaves?;
            let sent = writer.state.is_settled() && !paths.values().any(|path| path.has_pending(*entity));
            (sent || leaves <= now).then_some(*entity)
        };
        let done: Vec<EntityId> = writers.iter().filter_map(done).collect();
        for entity in done {
            self.writers.remove(&entity);
            self.paths.values_mut().for_each(|path| path.forget(entity));
            self.withdraw_endpoint(now, entity);
        }
        if self.writers.values().any(|writer| writer.leaves.is_some()) {
            self.wake(now + LINGER_LOOK);
        }
    }

    fn next_entity_number(&mut self) -> u32 {
        // Three bytes of key; there are never that many endpoints at the same time.
        let number = self.next_entity;
        self.next_entity = (number + 1) & 0xff_ffff;
        number
    }

    fn endpoint_data(&self, entity: EntityId, topic: &TopicDescription, qos: EndpointQos) -> EndpointData {
        EndpointData {
            guid: Guid::new(self.own.prefix, entity),
            topic: topic.name.clone(),
            type_name: topic.type_name.clone(),
            qos,
            user_data: topic.user_data.clone(),
            unicast: self.own.user.clone(),
            expects_inline_qos: false,
        }
    }

    /// Writes a sample to a local writer.
    pub fn write(
        &mut self,
        now: Instant,
        entity: EntityId,
        payload: Bytes,
        related: Option<SampleIdentity>,
    ) -> SequenceNumber {
        let change = CacheChange { payload, related, written: SystemTime::now().into(), status: 0, key: None };
        self.publish(now, entity, change)
    }

    pub(super) fn publish(&mut self, now: Instant, entity: EntityId, mut change: CacheChange) -> SequenceNumber {
        let mut wanted = SendRequests::default();
        let Some(next) = self.writers.get(&entity).map(|it| it.state.last().next()) else {
            return SequenceNumber::UNKNOWN;
        };
        change.related = self.announcement_identity(entity, next).or(change.related);
        let Some(writer) = self.writers.get_mut(&entity) else {
            return SequenceNumber::UNKNOWN;
        };
        let number = writer.state.publish(now, change, &mut wanted);
        let ask_at = writer.state.next_heartbeat_at();
        self.enqueue(entity, wanted);
        self.tick_at = self.tick_at.min(ask_at.unwrap_or(self.tick_at));
        number
    }

    /// Sets how many samples of a transient-local writer are given to new readers.
    pub fn set_kept(&mut self, entity: EntityId, samples: usize) {
        if let Some(writer) = self.writers.get_mut(&entity) {
            writer.state.set_kept(samples);
        }
    }

    /// Returns the number of samples of a writer that were dropped before all reliable readers had acknowledged them.
    pub fn dropped_samples(&self, entity: EntityId) -> u64 {
        self.writers.get(&entity).map_or(0, |writer| writer.state.dropped)
    }
}
