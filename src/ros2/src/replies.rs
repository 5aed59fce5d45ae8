//! Replies to the requests of one client, and the calls waiting for them.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{Guid, ReceivedSample, SampleIdentity, SequenceNumber, Sink};
use tokio::sync::oneshot;

use super::request_header::RequestHeader;

/// Maximum number of pending calls of one client.
pub(super) const MAX_IN_FLIGHT: usize = 1024;
/// Maximum number of replies kept until the number of their request is known.
const MAX_EARLY: usize = 64;

/// Identifies a reply as one to this client.
pub(super) struct ReplyAddress {
    pub(super) reader: Guid,
    pub(super) writer: Guid,
    /// Number of the client in request headers.
    pub(super) number: u64,
}

/// The request that a reply belongs to: its sequence number at our writer, or the number in its header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum ReplyKey {
    Number(i64),
    Header(i64),
}

/// Replies and the calls waiting for them.
#[derive(Default)]
pub(super) struct Replies {
    pub(super) own: OnceLock<ReplyAddress>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    waiting: HashMap<ReplyKey, oneshot::Sender<Bytes>>,
    /// Number of requests being written, whose sequence numbers are not known yet.
    writing: usize,
    /// Replies that arrived meanwhile.
    early: Vec<(ReplyKey, Bytes)>,
}

impl State {
    fn has_room(&self) -> bool {
        self.waiting.len() + self.writing < MAX_IN_FLIGHT
    }
}

impl Sink for Replies {
    fn on_sample(&self, sample: ReceivedSample) {
        self.dispatch(sample.related, sample.payload);
    }
}

impl Replies {
    /// Processes a reply, possibly to another client: all clients of a service share one reply topic.
    fn dispatch(&self, related: Option<SampleIdentity>, payload: Bytes) {
        let Some(own) = self.own.get() else { return };
        let (key, response) = match related {
            Some(to) if to.writer == own.reader || to.writer == own.writer => (ReplyKey::Number(to.number.0), payload),
            Some(_) => return,
            None => match RequestHeader::split(&payload) {
                Some((header, response)) if header.client == own.number => (ReplyKey::Header(header.number), response),
                _ => return,
            },
        };
        let mut state = self.state.lock();
        if let Some(waiting) = state.waiting.remove(&key) {
            let _ = waiting.send(response);
        } else if state.writing > 0 && state.early.len() < MAX_EARLY {
            state.early.push((key, response));
        }
    }

    /// Waits for the reply to a request with this number in its header; `None` if too many calls are pending.
    pub(super) fn wait(self: &Arc<Self>, key: ReplyKey) -> Option<PendingReply> {
        let mut state = self.state.lock();
        if !state.has_room() {
            return None;
        }
        let (sender, answer) = oneshot::channel();
        state.waiting.insert(key, sender);
        drop(state);
        let replies = Arc::clone(self);
        Some(PendingReply { replies, key, answer })
    }

    /// Prepares to write a request; `None` if too many calls are pending.
    pub(super) fn begin_write(self: &Arc<Self>) -> Option<Writing> {
        let mut state = self.state.lock();
        if !state.has_room() {
            return None;
        }
        state.writing += 1;
        Some(Writing(Arc::clone(self)))
    }
}

/// A request that is being written.
pub(super) struct Writing(Arc<Replies>);

impl Writing {
    /// Sets the sequence number of the request and waits for its reply.
    pub(super) fn with_number(self, number: SequenceNumber) -> PendingReply {
        let key = ReplyKey::Number(number.0);
        let (sender, answer) = oneshot::channel();
        let mut state = self.0.state.lock();
        match state.early.iter().position(|(early, _)| *early == key) {
            Some(at) => {
                let (_, response) = state.early.swap_remove(at);
                let _ = sender.send(response);
            }
            None => drop(state.waiting.insert(key, sender)),
        }
        drop(state);
        let replies = Arc::clone(&self.0);
        PendingReply { replies, key, answer }
    }
}

impl Drop for Writing {
    fn drop(&mut self) {
        let mut state = self.0.state.lock();
        state.writing -= 1;
        if state.writing == 0 {
            state.early.clear();
        }
    }
}

/// A pending reply; dropping it gives up the call.
pub(super) struct PendingReply {
    replies: Arc<Replies>,
    key: ReplyKey,
    pub(super) answer: oneshot::Receiver<Bytes>,
}

impl Drop for PendingReply {
    fn drop(&mut self) {
        self.replies.state.lock().waiting.remove(&self.key);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const READER: u8 = 4;
    const WRITER: u8 = 3;

    fn guid(kind: u8) -> Guid {
        Guid::from([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 0, 0, 1, kind])
    }

    fn replies() -> Arc<Replies> {
        let replies = Arc::new(Replies::default());
        let own = ReplyAddress { reader: guid(READER), writer: guid(WRITER), number: 77 };
        assert!(replies.own.set(own).is_ok());
        replies
    }

    fn related_to(kind: u8, number: i64) -> Option<SampleIdentity> {
        Some(SampleIdentity { writer: guid(kind), number: SequenceNumber(number) })
    }

    #[test]
    fn a_reply_names_our_reader_or_our_writer() {
        let replies = replies();
        for kind in [READER, WRITER] {
            let mut waiting = replies.begin_write().expect("room").with_number(SequenceNumber(5));
            replies.dispatch(related_to(kind, 6), Bytes::from_static(b"another"));
            replies.dispatch(related_to(9, 5), Bytes::from_static(b"of another client"));
            assert!(waiting.answer.try_recv().is_err());
            replies.dispatch(related_to(kind, 5), Bytes::from_static(b"it"));
            assert_eq!(waiting.answer.try_recv().expect("a reply"), "it");
        }
        assert!(replies.state.lock().waiting.is_empty());
    }

    #[test]
    fn a_reply_may_come_before_the_number_of_its_request_is_known() {
        let replies = replies();
        let (one, two) = (replies.begin_write().expect("room"), replies.begin_write().expect("room"));
        replies.dispatch(related_to(READER, 1), Bytes::from_static(b"first"));
        replies.dispatch(related_to(READER, 2), Bytes::from_static(b"second"));
        let mut second = two.with_number(SequenceNumber(2));
        let mut first = one.with_number(SequenceNumber(1));
        assert_eq!(first.answer.try_recv().expect("a reply"), "first");
        assert_eq!(second.answer.try_recv().expect("a reply"), "second");
        // Nobody waits: a late reply belongs to a call that was given up.
        replies.dispatch(related_to(READER, 3), Bytes::from_static(b"late"));
        assert!(replies.state.lock().early.is_empty());
    }

    #[test]
    fn a_reply_of_cyclone_is_known_by_its_header() {
        let replies = replies();
        let mut waiting = replies.wait(ReplyKey::Header(5)).expect("room");
        for (client, number) in [(78, 5), (77, 6)] {
            let header = RequestHeader { client, number };
            replies.dispatch(None, header.join(&[0, 1, 0, 0, 9]).expect("CDR"));
        }
        replies.dispatch(None, Bytes::from_static(b"short"));
        assert!(waiting.answer.try_recv().is_err());
        let header = RequestHeader { client: 77, number: 5 };
        replies.dispatch(None, header.join(&[0, 1, 0, 0, 9]).expect("CDR"));
        assert_eq!(waiting.answer.try_recv().expect("a reply"), [0, 1, 0, 0, 9][..]);
    }

    #[test]
    fn calls_under_way_are_bounded_and_given_up_ones_do_not_count() {
        let replies = replies();
        let mut all: Vec<PendingReply> =
            (0..MAX_IN_FLIGHT as i64).filter_map(|number| replies.wait(ReplyKey::Header(number))).collect();
        assert_eq!(all.len(), MAX_IN_FLIGHT);
        assert!(replies.begin_write().is_none() && replies.wait(ReplyKey::Header(-1)).is_none());
        all.pop();
        assert!(replies.begin_write().is_some());
    }
}
