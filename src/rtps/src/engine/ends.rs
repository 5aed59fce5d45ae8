//! Our readers and writers: made, written with, and taken back.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use tokio::sync::watch;

use super::{Engine, LocalReader, LocalWriter};
use crate::discovery::EndpointData;
use crate::participant::{Ends, Sink, Topic};
use crate::qos::EndpointQos;
use crate::reader::ReaderState;
use crate::writer::{Change, Wanted, WriterState};
use crate::{EntityId, Guid, SampleIdentity, SequenceNumber};

/// A writer that was dropped is kept so long at most, until its readers have all that it wrote.
const LINGER: Duration = Duration::from_secs(2);
/// How often it is looked whether they have.
const LINGER_LOOK: Duration = Duration::from_millis(10);

impl Engine {
    pub fn add_writer(
        &mut self,
        now: Instant,
        topic: &Topic,
        qos: EndpointQos,
    ) -> (Guid, watch::Receiver<Arc<Ends>>) {
        let entity = EntityId::user_writer(self.take_entity());
        let own = self.endpoint(entity, topic, qos);
        let ends = watch::Sender::new(Arc::default());
        let receiver = ends.subscribe();
        let guid = own.guid;
        self.writers.insert(
            entity,
            LocalWriter {
                state: WriterState::new(own.clone()),
                ends,
                leaves: None,
            },
        );
        self.match_own_writer(now, entity);
        self.announce_end(now, &own);
        self.tell();
        (guid, receiver)
    }

    pub fn add_reader(
        &mut self,
        now: Instant,
        topic: &Topic,
        qos: EndpointQos,
        sink: Arc<dyn Sink>,
    ) -> (Guid, watch::Receiver<Arc<Ends>>) {
        let entity = EntityId::user_reader(self.take_entity());
        let own = self.endpoint(entity, topic, qos);
        let ends = watch::Sender::new(Arc::default());
        let receiver = ends.subscribe();
        let guid = own.guid;
        let state = ReaderState::new(own.clone(), self.bounds.clone());
        self.readers.insert(
            entity,
            LocalReader {
                state,
                ends,
                sink: Some(sink),
            },
        );
        self.match_own_reader(now, entity);
        self.announce_end(now, &own);
        self.tell();
        (guid, receiver)
    }

    /// Takes an end of ours back; others are told. What is returned is to be dropped when nobody holds the engine.
    #[must_use]
    pub fn remove_end(&mut self, now: Instant, entity: EntityId) -> impl Sized + use<> {
        if let Some(writer) = self.writers.get_mut(&entity) {
            writer.leaves = Some(now + LINGER);
            self.let_go(now);
        }
        let reader = self.readers.remove(&entity);
        if reader.is_some() {
            self.withdraw_end(now, entity);
        }
        reader.map(|reader| reader.sink)
    }

    /// Takes those writers back that were dropped and have nothing left to send, or have had their time.
    pub(super) fn let_go(&mut self, now: Instant) {
        let Engine { writers, paths, .. } = self;
        let done = |(entity, writer): (&EntityId, &LocalWriter)| {
            let leaves = writer.leaves?;
            let sent = writer.state.is_settled() && !paths.values().any(|path| path.holds(*entity));
            (sent || leaves <= now).then_some(*entity)
        };
        let done: Vec<EntityId> = writers.iter().filter_map(done).collect();
        for entity in done {
            self.writers.remove(&entity);
            self.paths.values_mut().for_each(|path| path.forget(entity));
            self.withdraw_end(now, entity);
        }
        if self.writers.values().any(|writer| writer.leaves.is_some()) {
            self.wake(now + LINGER_LOOK);
        }
    }

    fn take_entity(&mut self) -> u32 {
        // Three bytes of key; nobody makes so many ends at the same time.
        let number = self.next_entity;
        self.next_entity = (number + 1) & 0xff_ffff;
        number
    }

    fn endpoint(&self, entity: EntityId, topic: &Topic, qos: EndpointQos) -> EndpointData {
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

    /// Writes a sample of one of our writers.
    pub fn write(
        &mut self,
        now: Instant,
        entity: EntityId,
        payload: Bytes,
        related: Option<SampleIdentity>,
    ) -> SequenceNumber {
        let change = Change {
            payload,
            related,
            written: SystemTime::now().into(),
            status: 0,
            key: None,
        };
        self.publish(now, entity, change)
    }

    pub(super) fn publish(
        &mut self,
        now: Instant,
        entity: EntityId,
        mut change: Change,
    ) -> SequenceNumber {
        let mut wanted = Wanted::default();
        let Some(next) = self.writers.get(&entity).map(|it| it.state.last().next()) else {
            return SequenceNumber::UNKNOWN;
        };
        change.related = self.identity(entity, next).or(change.related);
        let Some(writer) = self.writers.get_mut(&entity) else {
            return SequenceNumber::UNKNOWN;
        };
        let number = writer.state.publish(now, change, &mut wanted);
        let ask_at = writer.state.ask_at();
        self.enqueue(entity, wanted);
        self.tick_at = self.tick_at.min(ask_at.unwrap_or(self.tick_at));
        number
    }

    /// Samples of this writer that were given up before all reliable readers had acknowledged them.
    pub fn dropped(&self, entity: EntityId) -> u64 {
        self.writers
            .get(&entity)
            .map_or(0, |writer| writer.state.dropped)
    }
}
