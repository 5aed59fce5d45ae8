//! A client of one service: tracks its servers and makes sequential or concurrent calls.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use ros_bus::{BusError, CallFate, ServiceType};
use rtps::{
    EndpointData, EndpointMatches, Guid, GuidPrefix, SampleIdentity, SequenceNumber, TopicDescription, VendorId,
};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::ends::{ReaderEnd, WriterEnd};
use super::replies::{MAX_IN_FLIGHT, PendingReply, Replies, ReplyAddress, ReplyKey};
use super::request_header::RequestHeader;
use super::seen::DiscoverySnapshot;
use super::state::Ros2BusState;
use super::{names, node_ends, services, type_hash};

/// Maximum wait for a server whose endpoints are known but which does not acknowledge ours. One that is there does,
/// within a few milliseconds, or on a busy machine within a second or two; called before, it would answer to nobody, as
/// a server of Fast DDS drops the reply to a reader that it has not matched.
const UNSURE: Duration = Duration::from_secs(20);

/// The servers that a call would reach.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Servers {
    /// Participants with both endpoints of the service.
    remote: Vec<GuidPrefix>,
    /// Participants that can still answer earlier requests: one that ends a service takes no more requests, but may be
    /// about to answer.
    answering: Vec<GuidPrefix>,
    /// True if some of them are known to have matched both endpoints of this client.
    sure: bool,
    /// True if this bus serves the service itself.
    here: bool,
    /// Type of a server whose type differs from this client's.
    other: Option<ServiceType>,
}

impl Servers {
    /// Returns the number of servers.
    pub(super) fn count(&self) -> usize {
        self.remote.len() + usize::from(self.here)
    }

    /// Returns the type of a server that differs from this client's, if there are no other servers.
    fn mismatched_server(&self) -> Option<&ServiceType> {
        self.other.as_ref().filter(|_| self.count() == 0)
    }
}

/// A client of one service.
pub(super) struct ServiceClient {
    bus: Arc<Ros2BusState>,
    service: String,
    of: ServiceType,
    writer: WriterEnd,
    reader: ReaderEnd,
    replies: Arc<Replies>,
    /// Identifies the client towards rmw_cyclonedds.
    number: u64,
    questions: AtomicI64,
    servers: watch::Receiver<Servers>,
    following: AbortHandle,
}

impl Drop for ServiceClient {
    fn drop(&mut self) {
        self.following.abort();
    }
}

impl ServiceClient {
    pub(super) fn open(bus: &Arc<Ros2BusState>, service: &str, of: &ServiceType) -> Result<Self, BusError> {
        let (request, reply) = (names::request(service, of)?, names::reply(service, of)?);
        let replies = Arc::new(Replies::default());
        // A server that discovers the writer of requests must also discover the reader of replies.
        let reader = ReaderEnd::open(bus, &reply, services::qos(), Arc::clone(&replies) as _);
        let writer = WriterEnd::open(bus, &request, services::qos());
        let mut hasher = DefaultHasher::new();
        writer.guid().bytes().hash(&mut hasher);
        let number = hasher.finish();
        let own = ReplyAddress { reader: reader.guid(), writer: writer.guid(), number };
        let _ = replies.own.set(own);
        let (shown, servers) = watch::channel(Servers::default());
        let following = ServerWatcher {
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

    /// Returns the servers that a call would reach, updated as they change.
    pub(super) fn servers(&self) -> watch::Receiver<Servers> {
        self.servers.clone()
    }

    /// Returns the type of the server if it differs from this client's.
    pub(super) fn mismatched_type(&self) -> Option<ServiceType> {
        self.servers.borrow().mismatched_server().cloned()
    }

    /// Waits until a call would reach a server and be answered.
    pub(super) async fn wait_until_ready(&self, patience: Duration) -> Result<(), BusError> {
        let found = timeout(patience, self.wait_for_server()).await;
        found.unwrap_or_else(|_| Err(self.timeout_error(patience)))
    }

    /// Calls the service once; request and response are CDR with its header. The disappearance of the server is noticed
    /// at once.
    pub(super) async fn call(&self, request: Bytes, time: Duration) -> Result<Bytes, BusError> {
        let answer = timeout(time, self.send_and_wait(request)).await;
        answer.unwrap_or_else(|_| Err(self.timeout_error(time)))
    }

    fn timeout_error(&self, after: Duration) -> BusError {
        BusError::Timeout { what: format!("service {}", self.service), after }
    }

    fn call_error(&self, reason: impl Into<String>, fate: CallFate) -> BusError {
        BusError::CallFailed { service: self.service.clone(), reason: reason.into(), fate }
    }

    /// Waits for a server that has matched both endpoints of this client, or appears to have.
    async fn wait_for_server(&self) -> Result<(), BusError> {
        let mut servers = self.servers.clone();
        let is_there = |servers: &Servers| servers.count() > 0 || servers.other.is_some();
        let there = servers.wait_for(is_there).await;
        let other = there.map(|servers| servers.mismatched_server().cloned());
        if let Some(theirs) = other.map_err(|_| BusError::Closed)? {
            return Err(theirs.mismatch(&self.of, format!("service {}", self.service)));
        }
        let is_sure = servers.wait_for(|servers| servers.sure || servers.here);
        let _ = timeout(UNSURE, is_sure).await;
        Ok(())
    }

    async fn send_and_wait(&self, request: Bytes) -> Result<Bytes, BusError> {
        self.wait_for_server().await?;
        if let Some(served) = services::local_service(&self.bus, &self.service) {
            let answer = served.handler.call(request, &self.bus.node).await;
            return answer.map_err(|reason| self.call_error(reason, CallFate::Answered));
        }
        let mut servers = self.servers.clone();
        let asked = servers.borrow_and_update().remote.clone();
        let Some(mut waiting) = self.send(request, &asked) else {
            let reason = format!("{MAX_IN_FLIGHT} calls of it are under way");
            return Err(self.call_error(reason, CallFate::NotTaken));
        };
        let gone = servers.wait_for(|now| !asked.iter().any(|server| now.answering.contains(server)));
        tokio::select! {
            biased;
            answer = &mut waiting.answer => answer.map_err(|_| BusError::Closed),
            gone = gone => Err(match gone {
                Ok(_) => self.call_error("its server went away before it answered", CallFate::Unknown),
                Err(_) => BusError::Closed,
            }),
        }
    }

    /// Writes the request in the form that the servers expect.
    fn send(&self, request: Bytes, servers: &[GuidPrefix]) -> Option<PendingReply> {
        let discovered = self.bus.discovery();
        let of_cyclone = |server: &GuidPrefix| {
            let server = discovered.participants.get(server);
            server.is_some_and(|server| server.vendor == VendorId::CYCLONE)
        };
        if servers.iter().any(of_cyclone) {
            let header = RequestHeader { client: self.number, number: self.questions.fetch_add(1, Ordering::Relaxed) };
            let payload = header.join(&request)?;
            let waiting = self.replies.wait(ReplyKey::Header(header.number))?;
            self.writer.write(payload);
            return Some(waiting);
        }
        let related = SampleIdentity { writer: self.reader.guid(), number: SequenceNumber::UNKNOWN };
        let writing = self.replies.begin_write()?;
        let number = self.writer.write_related(request, related);
        Some(writing.with_number(number))
    }
}

/// Tracks the servers of a client.
struct ServerWatcher {
    bus: Arc<Ros2BusState>,
    service: String,
    of: ServiceType,
    /// Name and type in DDS.
    request: TopicDescription,
    requests: watch::Receiver<Arc<EndpointMatches>>,
    replies: watch::Receiver<Arc<EndpointMatches>>,
    shown: watch::Sender<Servers>,
}

impl ServerWatcher {
    async fn run(mut self) {
        let mut served = self.bus.served.subscribe();
        let mut seen = self.bus.seen.subscribe();
        loop {
            served.mark_unchanged();
            let all = Arc::clone(&seen.borrow_and_update());
            let now = self.find_servers(&all);
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

    fn find_servers(&mut self, seen: &DiscoverySnapshot) -> Servers {
        let requests = Arc::clone(&self.requests.borrow_and_update());
        let replies = Arc::clone(&self.replies.borrow_and_update());
        let here = services::local_service(&self.bus, &self.service);
        let mut servers =
            Servers { answering: replies.matched.iter().map(|it| it.guid.prefix).collect(), ..Servers::default() };
        match here {
            Some(served) if served.of.matches(&self.of) => servers.here = true,
            Some(served) => servers.other = Some(served.of.clone()),
            None => {}
        }
        // Endpoints with another type name do not match at all.
        let strangers = seen.readers(&self.request.name).iter();
        for end in strangers.filter(|end| end.type_name != self.request.type_name) {
            servers.other = self.service_type(seen, end).or(servers.other);
        }
        for end in &requests.matched {
            let prefix = end.guid.prefix;
            let mut answers = replies.matched.iter().filter(|it| it.guid.prefix == prefix);
            if answers.next().is_none() || servers.remote.contains(&prefix) {
                continue;
            }
            let theirs = type_hash::message_hash(&end.user_data);
            if !theirs.is_compatible_with(&self.of.request) {
                servers.other = self.service_type(seen, end).or(servers.other);
                continue;
            }
            let knows = |guid: &Guid| guid.prefix == prefix;
            servers.sure |= requests.confirmed.contains(&end.guid) && replies.confirmed.iter().any(knows);
            servers.remote.push(prefix);
        }
        servers
    }
    /// Returns the type served by the server with this endpoint.
    fn service_type(&self, seen: &DiscoverySnapshot, end: &EndpointData) -> Option<ServiceType> {
        node_ends::service_type(seen, end, &self.service, false)
    }
}
