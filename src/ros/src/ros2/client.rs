//! A client of one service: its servers, and one call after the other or many at a time.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use rtps::{EndpointData, Ends, Guid, GuidPrefix, SampleIdentity, SequenceNumber, Topic, VendorId};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::bus::Inner;
use super::ends::{ReaderEnd, WriterEnd};
use super::replies::{Key, MAX_IN_FLIGHT, OwnEnds, Replies, Waiting};
use super::request_header::RequestHeader;
use super::seen::Seen;
use super::{names, node_ends, services, type_hash};
use crate::bus::{BusError, CallFate, ServiceType};

/// A server whose ends are known may not say that it knows ours; then a call waits only so long.
const UNSURE: Duration = Duration::from_millis(200);

/// The servers to which a call would go.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Servers {
    /// Participants with both ends of the service.
    remote: Vec<GuidPrefix>,
    /// Participants that can still answer what they were asked: one that ends a service takes no requests any more, but may
    /// be about to answer.
    answering: Vec<GuidPrefix>,
    /// Some of them are known to know both ends of this client.
    sure: bool,
    /// This bus serves it itself.
    here: bool,
    /// The type of a server that has another than this client.
    other: Option<ServiceType>,
}

impl Servers {
    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.remote.len() + usize::from(self.here)
    }

    /// The type of a server that has another than this client, where there are no others.
    fn only_other(&self) -> Option<&ServiceType> {
        self.other.as_ref().filter(|_| self.count() == 0)
    }
}

/// A client of one service.
pub(super) struct Client {
    bus: Arc<Inner>,
    service: String,
    of: ServiceType,
    writer: WriterEnd,
    reader: ReaderEnd,
    replies: Arc<Replies>,
    /// By which rmw_cyclonedds tells clients apart.
    number: u64,
    questions: AtomicI64,
    servers: watch::Receiver<Servers>,
    following: AbortHandle,
}

impl Drop for Client {
    fn drop(&mut self) {
        self.following.abort();
    }
}

impl Client {
    pub(super) fn open(
        bus: &Arc<Inner>,
        service: &str,
        of: &ServiceType,
    ) -> Result<Self, BusError> {
        let (request, reply) = (names::request(service, of)?, names::reply(service, of)?);
        let replies = Arc::new(Replies::default());
        // Whoever finds the writer of requests is to find the reader of replies, too.
        let reader = ReaderEnd::open(bus, &reply, services::qos(), Arc::clone(&replies) as _);
        let writer = WriterEnd::open(bus, &request, services::qos());
        let mut hasher = DefaultHasher::new();
        writer.guid().bytes().hash(&mut hasher);
        let number = hasher.finish();
        let own = OwnEnds {
            reader: reader.guid(),
            writer: writer.guid(),
            number,
        };
        let _ = replies.own.set(own);
        let (shown, servers) = watch::channel(Servers::default());
        let following = Following {
            bus: Arc::clone(bus),
            service: service.to_owned(),
            of: of.clone(),
            request,
            requests: writer.ends(),
            replies: reader.ends(),
            shown,
        };
        Ok(Self {
            bus: Arc::clone(bus),
            service: service.to_owned(),
            of: of.clone(),
            writer,
            reader,
            replies,
            number,
            questions: AtomicI64::new(1),
            servers,
            following: bus.spawn(following.run()),
        })
    }

    /// The servers to which a call would go, now and later.
    pub(super) fn servers(&self) -> watch::Receiver<Servers> {
        self.servers.clone()
    }

    /// The type of its server, where that is another than this client's.
    pub(super) fn other_type(&self) -> Option<ServiceType> {
        self.servers.borrow().only_other().cloned()
    }

    /// Returns once a call would reach a server and be answered.
    pub(super) async fn ready(&self, patience: Duration) -> Result<(), BusError> {
        let found = timeout(patience, self.found()).await;
        found.unwrap_or_else(|_| Err(self.late(patience)))
    }

    /// Calls once: a request and a response are CDR with its header. A server that goes is noticed at once.
    pub(super) async fn call(&self, request: Bytes, time: Duration) -> Result<Bytes, BusError> {
        let answer = timeout(time, self.ask(request)).await;
        answer.unwrap_or_else(|_| Err(self.late(time)))
    }

    fn late(&self, after: Duration) -> BusError {
        BusError::Timeout {
            what: format!("service {}", self.service),
            after,
        }
    }

    fn failed(&self, reason: impl Into<String>, fate: CallFate) -> BusError {
        BusError::CallFailed {
            service: self.service.clone(),
            reason: reason.into(),
            fate,
        }
    }

    /// Waits for a server that knows both ends of this client, or seems to.
    async fn found(&self) -> Result<(), BusError> {
        let mut servers = self.servers.clone();
        let is_there = |servers: &Servers| servers.count() > 0 || servers.other.is_some();
        let there = servers.wait_for(is_there).await;
        let other = there.map(|servers| servers.only_other().cloned());
        if let Some(theirs) = other.map_err(|_| BusError::Closed)? {
            return Err(theirs.not(&self.of, format!("service {}", self.service)));
        }
        let is_sure = servers.wait_for(|servers| servers.sure || servers.here);
        let _ = timeout(UNSURE, is_sure).await;
        Ok(())
    }

    async fn ask(&self, request: Bytes) -> Result<Bytes, BusError> {
        self.found().await?;
        if let Some(served) = services::here(&self.bus, &self.service) {
            let answer = served.handler.call(request, &self.bus.node).await;
            return answer.map_err(|reason| self.failed(reason, CallFate::Answered));
        }
        let mut servers = self.servers.clone();
        let asked = servers.borrow_and_update().remote.clone();
        let Some(mut waiting) = self.send(request, &asked) else {
            let reason = format!("{MAX_IN_FLIGHT} calls of it are under way");
            return Err(self.failed(reason, CallFate::NotTaken));
        };
        let gone =
            servers.wait_for(|now| !asked.iter().any(|server| now.answering.contains(server)));
        tokio::select! {
            biased;
            answer = &mut waiting.answer => answer.map_err(|_| BusError::Closed),
            gone = gone => Err(match gone {
                Ok(_) => self.failed("its server went away before it answered", CallFate::Unknown),
                Err(_) => BusError::Closed,
            }),
        }
    }

    /// Writes the request as the servers expect it.
    fn send(&self, request: Bytes, servers: &[GuidPrefix]) -> Option<Waiting> {
        let discovered = self.bus.discovered();
        let of_cyclone = |server: &GuidPrefix| {
            let server = discovered.participants.get(server);
            server.is_some_and(|server| server.vendor == VendorId::CYCLONE)
        };
        if servers.iter().any(of_cyclone) {
            let header = RequestHeader {
                client: self.number,
                number: self.questions.fetch_add(1, Ordering::Relaxed),
            };
            let payload = header.join(&request)?;
            let waiting = self.replies.wait(Key::Header(header.number))?;
            self.writer.write(payload);
            return Some(waiting);
        }
        let related = SampleIdentity {
            writer: self.reader.guid(),
            number: SequenceNumber::UNKNOWN,
        };
        let writing = self.replies.write()?;
        let number = self.writer.write_related(request, related);
        Some(writing.written(number))
    }
}

/// Looks which servers there are.
struct Following {
    bus: Arc<Inner>,
    service: String,
    of: ServiceType,
    /// As DDS has it.
    request: Topic,
    requests: watch::Receiver<Arc<Ends>>,
    replies: watch::Receiver<Arc<Ends>>,
    shown: watch::Sender<Servers>,
}

impl Following {
    async fn run(mut self) {
        let mut served = self.bus.served.subscribe();
        let mut seen = self.bus.seen.subscribe();
        loop {
            served.mark_unchanged();
            let all = Arc::clone(&seen.borrow_and_update());
            let now = self.look(&all);
            self.shown.send_if_modified(|before| {
                let news = *before != now;
                *before = now;
                news
            });
            let changed = tokio::select! {
                changed = self.requests.changed() => changed,
                changed = self.replies.changed() => changed,
                changed = served.changed() => changed,
                changed = seen.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
        }
    }

    fn look(&mut self, seen: &Seen) -> Servers {
        let requests = Arc::clone(&self.requests.borrow_and_update());
        let replies = Arc::clone(&self.replies.borrow_and_update());
        let here = services::here(&self.bus, &self.service);
        let mut servers = Servers {
            answering: replies.matched.iter().map(|it| it.guid.prefix).collect(),
            ..Servers::default()
        };
        match here {
            Some(served) if served.of.is(&self.of) => servers.here = true,
            Some(served) => servers.other = Some(served.of.clone()),
            None => {}
        }
        // Ends of a type with another name do not meet at all.
        let strangers = seen.readers(&self.request.name).iter();
        for end in strangers.filter(|end| end.type_name != self.request.type_name) {
            servers.other = self.type_of(seen, end).or(servers.other);
        }
        for end in &requests.matched {
            let prefix = end.guid.prefix;
            let mut answers = replies.matched.iter().filter(|it| it.guid.prefix == prefix);
            if answers.next().is_none() || servers.remote.contains(&prefix) {
                continue;
            }
            let theirs = type_hash::of_message(&end.user_data);
            if !theirs.agrees(&self.of.request) {
                servers.other = self.type_of(seen, end).or(servers.other);
                continue;
            }
            let knows = |guid: &Guid| guid.prefix == prefix;
            servers.sure |=
                requests.confirmed.contains(&end.guid) && replies.confirmed.iter().any(knows);
            servers.remote.push(prefix);
        }
        servers
    }
    /// What the server with this end serves.
    fn type_of(&self, seen: &Seen, end: &EndpointData) -> Option<ServiceType> {
        node_ends::service_type(seen, end, &self.service, false)
    }
}
