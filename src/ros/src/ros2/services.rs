//! Services that this node serves.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use rtps::{EndpointQos, Guid, History, Sample, SampleIdentity, Sink, VendorId};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::bus::Inner;
use super::ends::{ReaderEnd, WriterEnd};
use super::request_header::RequestHeader;
use super::{names, type_hash};
use crate::bus::{BusError, ServiceHandler, ServiceType};

/// Requests of one service that wait until there is room.
const QUEUED: usize = 1024;
/// Requests of one service that are answered at the same time.
const ANSWERED: usize = 1024;
/// For answers to arrive before the ends that have sent them are withdrawn.
const LINGER: Duration = Duration::from_millis(300);
/// For the client's reader of replies to be found: its request may come first.
const MATCH: Duration = Duration::from_secs(1);

/// How the ends of services treat samples. Those of rmw keep 10, which is for readers that are asked for what they have read;
/// nothing of a service may be lost because many call it at once.
pub(super) fn qos() -> EndpointQos {
    EndpointQos {
        history: History::KeepLast(QUEUED as u32),
        ..EndpointQos::default()
    }
}

/// One service.
pub(super) struct Served {
    pub(super) of: ServiceType,
    pub(super) handler: Arc<dyn ServiceHandler>,
    /// It is another system's, and gives way to who serves it here.
    pub(super) lent: bool,
}

/// What serves a service here.
pub(super) fn here(bus: &Inner, service: &str) -> Option<Arc<Served>> {
    bus.services.lock().get(service).cloned()
}

/// Serves until the guard is dropped; what was asked until then is answered.
pub(super) fn serve(
    bus: &Arc<Inner>,
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let lent = false;
    begin(bus, service, Served { of, handler, lent })
}

/// Serves a service of another system, unless it is served here.
pub(super) fn lend(
    bus: &Arc<Inner>,
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let lent = true;
    begin(bus, service, Served { of, handler, lent })
}

fn begin(
    bus: &Arc<Inner>,
    service: &str,
    served: Served,
) -> Result<Box<dyn Send + Sync>, BusError> {
    let of = &served.of;
    let request = bus.loans.labelled(names::request(service, of)?);
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
    let sink = Requests {
        service: Arc::clone(&service),
        queue,
    };
    // Whoever finds the reader of requests is to find the writer of replies, too.
    let writer = WriterEnd::open(bus, &reply, qos());
    let reader = ReaderEnd::open(bus, &request, qos(), Arc::new(sink));
    let answering = Answering {
        bus: Arc::clone(bus),
        service: Arc::clone(&service),
        served: Arc::clone(&served),
        writer,
    };
    let (end, ended) = oneshot::channel();
    bus.spawn(answer_all(Arc::new(answering), requests, ended));
    bus.served.send_modify(|number| *number += 1);
    Ok(Box::new(Guard {
        bus: Arc::clone(bus),
        service,
        served,
        end: Some((end, reader)),
    }))
}

struct Guard {
    bus: Arc<Inner>,
    service: Arc<str>,
    served: Arc<Served>,
    /// Whom the reader is left to, so that it is withdrawn with the last answer: without it clients take the server for gone.
    end: Option<(oneshot::Sender<ReaderEnd>, ReaderEnd)>,
}

impl Drop for Guard {
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

/// Takes requests.
struct Requests {
    service: Arc<str>,
    queue: mpsc::Sender<Sample>,
}

impl Sink for Requests {
    fn sample(&self, sample: Sample) {
        if let Err(TrySendError::Full(_)) = self.queue.try_send(sample) {
            tracing::warn!(
                service = &*self.service,
                "a request was not taken: {ANSWERED} are being answered and {QUEUED} wait"
            );
        }
    }
}

struct Answering {
    bus: Arc<Inner>,
    service: Arc<str>,
    served: Arc<Served>,
    writer: WriterEnd,
}

async fn answer_all(
    answering: Arc<Answering>,
    mut requests: mpsc::Receiver<Sample>,
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
        calls.spawn(async move { answering.answer(sample).await });
    }
    while calls.try_join_next().is_some() {}
    let late = !calls.is_empty();
    while calls.join_next().await.is_some() {}
    if late {
        sleep(LINGER).await;
    }
    drop(last);
}

/// How a client knows the answer to its request.
#[derive(Debug, Clone, Copy)]
enum Asker {
    /// By inline QoS.
    Identity(SampleIdentity),
    /// By what stands before the reply.
    Header(RequestHeader),
}

impl Answering {
    async fn answer(&self, sample: Sample) {
        let client = sample.writer;
        let service = &*self.service;
        // Whoever asks was discovered, though perhaps not seen by the watcher yet.
        let discovered = self.bus.discovered();
        let asked = discovered.writers.get(&client);
        let theirs = asked.map(|end| type_hash::of_message(&end.user_data));
        let ours = &self.served.of.request;
        if let Some(theirs) = theirs.filter(|theirs| !theirs.agrees(ours)) {
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
        let written = SampleIdentity {
            writer: client,
            number: sample.number,
        };
        let Some((asker, request)) = asker(payload, related, written, of_cyclone) else {
            tracing::debug!(service, "a request without the header of rmw_cyclonedds");
            return;
        };
        let caller = self.caller(client).await;
        let response = match self.served.handler.call(request, &caller).await {
            Ok(response) => response,
            Err(reason) => {
                // ROS 2 has no answer that says so.
                tracing::warn!(service, reason, "a request is not answered");
                return;
            }
        };
        self.matched(client, asker).await;
        match asker {
            Asker::Identity(identity) => {
                self.writer.write_related(response, identity);
            }
            Asker::Header(header) => {
                if let Some(payload) = header.join(&response) {
                    self.writer.write(payload);
                }
            }
        }
    }

    /// The node that asks. One that has just come tells its name in a moment.
    async fn caller(&self, client: Guid) -> Arc<str> {
        let mut seen = self.bus.seen.subscribe();
        let _ = timeout(MATCH, seen.wait_for(|seen| seen.is_named(client))).await;
        let seen = seen.borrow();
        seen.node(client)
    }

    /// Waits until the client's reader of replies is known, and this writer to it. It is gone if it never is.
    async fn matched(&self, client: Guid, asker: Asker) {
        let known = match asker {
            Asker::Identity(identity) if !identity.writer.entity.is_writer() => {
                Some(identity.writer)
            }
            _ => None,
        };
        let is_it = |guid: &Guid| match known {
            Some(known) => *guid == known,
            None => guid.prefix == client.prefix,
        };
        let mut ends = self.writer.ends();
        let _ = timeout(
            MATCH,
            ends.wait_for(|ends| ends.confirmed.iter().any(is_it)),
        )
        .await;
    }
}

/// Who asks, and the request without what rmw adds: `written` is which sample it is, `related` what its inline QoS says.
fn asker(
    payload: Bytes,
    related: Option<SampleIdentity>,
    written: SampleIdentity,
    of_cyclone: bool,
) -> Option<(Asker, Bytes)> {
    if of_cyclone {
        let (header, request) = RequestHeader::split(&payload)?;
        return Some((Asker::Header(header), request));
    }
    // rmw_fastrtps puts the client's reader of replies there, by which its server waits for it.
    let related = related.map(|related| related.writer);
    let reader = related.filter(|guid| *guid != Guid::default());
    let identity = SampleIdentity {
        writer: reader.unwrap_or(written.writer),
        ..written
    };
    Some((Asker::Identity(identity), payload))
}

#[cfg(test)]
mod tests {
    use rtps::SequenceNumber;

    use super::*;

    fn identity(end: u8, number: i64) -> SampleIdentity {
        SampleIdentity {
            writer: Guid::from([end; 16]),
            number: SequenceNumber(number),
        }
    }

    #[test]
    fn a_reply_is_to_the_reader_that_a_request_names() {
        let payload = || Bytes::from_static(&[0, 1, 0, 0, 9]);
        let named = Some(identity(4, SequenceNumber::UNKNOWN.0));
        for (related, expected) in [
            (named, identity(4, 8)),
            (None, identity(3, 8)),
            (Some(identity(0, -1)), identity(3, 8)),
        ] {
            let found = asker(payload(), related, identity(3, 8), false);
            let Some((Asker::Identity(to), request)) = found else {
                panic!("{related:?} should be answered by inline QoS");
            };
            assert_eq!((to, request), (expected, payload()));
        }
    }

    #[test]
    fn a_request_of_cyclone_has_a_header() {
        let header = RequestHeader {
            client: 7,
            number: 8,
        };
        let payload = header.join(&[0, 1, 0, 0, 9]).expect("CDR");
        let found = asker(payload, None, identity(3, 1), true);
        let Some((Asker::Header(read), request)) = found else {
            panic!("it should be answered by a header");
        };
        assert_eq!((read, &request[..]), (header, &[0, 1, 0, 0, 9][..]));
        let short = Bytes::from_static(&[0, 1, 0, 0, 9]);
        assert!(asker(short, None, identity(3, 1), true).is_none());
    }
}
