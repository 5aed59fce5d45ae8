//! Services that this node serves.

use std::sync::Arc;
use std::task::{Context, Waker};
use std::time::Duration;

use bytes::Bytes;
use ros_bus::{BusError, ServiceHandler, ServiceType};
use rtps::{EndpointQos, Guid, HistoryKind, ReceivedSample, SampleIdentity, Sink, VendorId};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::ends::{ReaderEnd, WriterEnd};
use super::request_header::RequestHeader;
use super::state::Ros2BusState;
use super::{names, type_hash};

/// Maximum number of queued requests per service.
const QUEUED: usize = 1024;
/// Maximum number of concurrent requests per service.
const ANSWERED: usize = 1024;
/// Time for answers to arrive before the endpoints that sent them are withdrawn.
const LINGER: Duration = Duration::from_millis(300);
/// Time for the client's reader of replies to be discovered: its request may arrive first.
const MATCH: Duration = Duration::from_secs(1);

/// Returns the QoS of service endpoints. Those of rmw keep 10 samples, which is meant for readers that are polled; here
/// no request or reply may be lost because many clients call at once.
pub(super) fn qos() -> EndpointQos {
    EndpointQos { history: HistoryKind::KeepLast(QUEUED as u32), ..EndpointQos::default() }
}

/// One service.
pub(super) struct ServedService {
    pub(super) of: ServiceType,
    pub(super) handler: Arc<dyn ServiceHandler>,
    /// True for a service of another system, which yields to one served here.
    pub(super) lent: bool,
}

/// Returns the service of this name that is served here.
pub(super) fn local_service(bus: &Ros2BusState, service: &str) -> Option<Arc<ServedService>> {
    bus.services.lock().get(service).cloned()
}

/// Serves until the guard is dropped; requests received before are still answered.
pub(super) fn serve(
    bus: &Arc<Ros2BusState>,
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let lent = false;
    start(bus, service, ServedService { of, handler, lent })
}

/// Serves a service of another system, unless it is served here.
pub(super) fn lend(
    bus: &Arc<Ros2BusState>,
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let lent = true;
    start(bus, service, ServedService { of, handler, lent })
}

fn start(bus: &Arc<Ros2BusState>, service: &str, served: ServedService) -> Result<Box<dyn Send + Sync>, BusError> {
    let of = &served.of;
    let request = bus.loans.add_label(names::request(service, of)?);
    let reply = names::reply(service, of)?;
    let served = Arc::new(served);
    {
        let mut services = bus.services.lock();
        let known = services.get(service);
        if known.is_some_and(|known| served.lent || !known.lent) {
            return Err(BusError::AlreadyServed(service.to_owned()));
        }
        services.insert(service.to_owned(), Arc::clone(&served));
    }
    let (queue, requests) = mpsc::channel(QUEUED);
    let service: Arc<str> = service.into();
    let sink = RequestSink { service: Arc::clone(&service), queue };
    // A client that discovers the reader of requests must also discover the writer of replies.
    let writer = WriterEnd::open(bus, &reply, qos());
    let reader = ReaderEnd::open(bus, &request, qos(), Arc::new(sink));
    let answering =
        ServiceResponder { bus: Arc::clone(bus), service: Arc::clone(&service), served: Arc::clone(&served), writer };
    let (end, ended) = oneshot::channel();
    bus.spawn(answer_all(Arc::new(answering), requests, ended));
    bus.served.send_modify(|number| *number += 1);
    Ok(Box::new(ServerGuard { bus: Arc::clone(bus), service, served, end: Some((end, reader)) }))
}

struct ServerGuard {
    bus: Arc<Ros2BusState>,
    service: Arc<str>,
    served: Arc<ServedService>,
    /// The reader and the channel that hands it over, so that it is withdrawn together with the last answer: without it
    /// clients take the server for gone.
    end: Option<(oneshot::Sender<ReaderEnd>, ReaderEnd)>,
}

impl Drop for ServerGuard {
    fn drop(&mut self) {
        let mut services = self.bus.services.lock();
        let current = services.get(&*self.service);
        if current.is_some_and(|served| Arc::ptr_eq(served, &self.served)) {
            services.remove(&*self.service);
        }
        drop(services);
        self.bus.served.send_modify(|number| *number += 1);
        if let Some((end, reader)) = self.end.take() {
            let _ = end.send(reader);
        }
    }
}

/// Receives requests.
struct RequestSink {
    service: Arc<str>,
    queue: mpsc::Sender<ReceivedSample>,
}

impl Sink for RequestSink {
    fn on_sample(&self, sample: ReceivedSample) {
        if let Err(TrySendError::Full(_)) = self.queue.try_send(sample) {
            tracing::warn!(
                service = &*self.service,
                "a request was rejected: {ANSWERED} are being answered and {QUEUED} wait"
            );
        }
    }
}

struct ServiceResponder {
    bus: Arc<Ros2BusState>,
    service: Arc<str>,
    served: Arc<ServedService>,
    writer: WriterEnd,
}

async fn answer_all(
    answering: Arc<ServiceResponder>,
    mut requests: mpsc::Receiver<ReceivedSample>,
    mut ended: oneshot::Receiver<ReaderEnd>,
) {
    let mut calls = JoinSet::new();
    let mut last = None;
    loop {
        let sample = tokio::select! {
            biased;
            sample = requests.recv() => sample,
            reader = &mut ended, if last.is_none() => {
                last = Some(reader);
                requests.close();
                continue;
            }
        };
        let Some(sample) = sample else { break };
        while calls.try_join_next().is_some() {}
        if calls.len() >= ANSWERED {
            calls.join_next().await;
        }
        let answering = Arc::clone(&answering);
        let mut call = Box::pin(async move { answering.answer(sample).await });
        // Calls begin in the order of their requests; tasks would not.
        if call.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending() {
            calls.spawn(call);
        }
    }
    while calls.try_join_next().is_some() {}
    let late = !calls.is_empty();
    while calls.join_next().await.is_some() {}
    if late {
        sleep(LINGER).await;
    }
    drop(last);
}

/// How a client recognizes the reply to its request.
#[derive(Debug, Clone, Copy)]
enum Requester {
    /// By inline QoS.
    Identity(SampleIdentity),
    /// By the header before the reply.
    Header(RequestHeader),
}

impl ServiceResponder {
    async fn answer(&self, sample: ReceivedSample) {
        let client = sample.writer;
        let service = &*self.service;
        // The client was discovered before its request, though the watcher may not have seen it yet.
        let discovered = self.bus.discovery();
        let asked = discovered.writers.get(&client);
        let theirs = asked.map(|end| type_hash::message_hash(&end.user_data));
        let ours = &self.served.of.request;
        if let Some(theirs) = theirs.filter(|theirs| !theirs.is_compatible_with(ours)) {
            tracing::warn!(
                service,
                client = &*self.bus.seen.borrow().node(client),
                "a request is not answered: its type is {theirs} there and {ours} here"
            );
            return;
        }
        let from = discovered.participants.get(&client.prefix);
        let of_cyclone = from.is_some_and(|from| from.vendor == VendorId::CYCLONE);
        let (payload, related) = (sample.payload, sample.related);
        let written = SampleIdentity { writer: client, number: sample.number };
        let Some((asker, request)) = requester(payload, related, written, of_cyclone) else {
            tracing::debug!(service, "a request without the header of rmw_cyclonedds");
            return;
        };
        let caller = self.caller(client).await;
        let response = match self.served.handler.call(request, &caller).await {
            Ok(response) => response,
            Err(reason) => {
                // ROS 2 has no reply for failures.
                let reason = reason.as_str();
                tracing::warn!(service, reason, "a request is not answered");
                return;
            }
        };
        self.wait_until_matched(client, asker).await;
        match asker {
            Requester::Identity(identity) => {
                self.writer.write_related(response, identity);
            }
            Requester::Header(header) => {
                if let Some(payload) = header.join(&response) {
                    self.writer.write(payload);
                }
            }
        }
    }

    /// Returns the calling node. A new node announces its name in a moment.
    async fn caller(&self, client: Guid) -> Arc<str> {
        let mut seen = self.bus.seen.subscribe();
        let _ = timeout(MATCH, seen.wait_for(|seen| seen.is_named(client))).await;
        let seen = seen.borrow();
        seen.node(client)
    }

    /// Waits until the client's reader of replies and this writer have matched. If they never do, the client is gone.
    async fn wait_until_matched(&self, client: Guid, asker: Requester) {
        let known = match asker {
            Requester::Identity(identity) if !identity.writer.entity.is_writer() => Some(identity.writer),
            _ => None,
        };
        let is_it = |guid: &Guid| match known {
            Some(known) => *guid == known,
            None => guid.prefix == client.prefix,
        };
        let mut ends = self.writer.ends();
        let _ = timeout(MATCH, ends.wait_for(|ends| ends.confirmed.iter().any(is_it))).await;
    }
}

/// Returns the requester, and the request without what rmw adds: `written` identifies the sample, `related` is its
/// inline QoS.
fn requester(
    payload: Bytes,
    related: Option<SampleIdentity>,
    written: SampleIdentity,
    of_cyclone: bool,
) -> Option<(Requester, Bytes)> {
    if of_cyclone {
        let (header, request) = RequestHeader::split(&payload)?;
        return Some((Requester::Header(header), request));
    }
    // rmw_fastrtps puts the client's reader of replies there; the server waits for it before replying.
    let related = related.map(|related| related.writer);
    let reader = related.filter(|guid| *guid != Guid::default());
    let identity = SampleIdentity { writer: reader.unwrap_or(written.writer), ..written };
    Some((Requester::Identity(identity), payload))
}

#[cfg(test)]
mod tests {
    use rtps::SequenceNumber;

    use super::*;

    fn identity(end: u8, number: i64) -> SampleIdentity {
        SampleIdentity { writer: Guid::from([end; 16]), number: SequenceNumber(number) }
    }

    #[test]
    fn a_reply_is_to_the_reader_that_a_request_names() {
        let payload = || Bytes::from_static(&[0, 1, 0, 0, 9]);
        let named = Some(identity(4, SequenceNumber::UNKNOWN.0));
        for (related, expected) in
            [(named, identity(4, 8)), (None, identity(3, 8)), (Some(identity(0, -1)), identity(3, 8))]
        {
            let found = requester(payload(), related, identity(3, 8), false);
            let Some((Requester::Identity(to), request)) = found else {
                panic!("{related:?} should be answered by inline QoS");
            };
            assert_eq!((to, request), (expected, payload()));
        }
    }

    #[test]
    fn a_request_of_cyclone_has_a_header() {
        let header = RequestHeader { client: 7, number: 8 };
        let payload = header.join(&[0, 1, 0, 0, 9]).expect("CDR");
        let found = requester(payload, None, identity(3, 1), true);
        let Some((Requester::Header(read), request)) = found else {
            panic!("it should be answered by a header");
        };
        assert_eq!((read, &request[..]), (header, &[0, 1, 0, 0, 9][..]));
        let short = Bytes::from_static(&[0, 1, 0, 0, 9]);
        assert!(requester(short, None, identity(3, 1), true).is_none());
    }
}
