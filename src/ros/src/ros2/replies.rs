//! Replies to the requests of one client, and who waits for them.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use parking_lot::Mutex;
use rtps::{Guid, Sample, SampleIdentity, SequenceNumber, Sink};
use tokio::sync::oneshot;

use super::request_header::RequestHeader;

/// Calls of one client under way.
pub(super) const MAX_IN_FLIGHT: usize = 1024;
/// Replies that come before it is known which number their request was given.
const MAX_EARLY: usize = 64;

/// By which a reply is known as one to this client.
pub(super) struct OwnEnds {
    pub(super) reader: Guid,
    pub(super) writer: Guid,
    /// Of the client, in headers.
    pub(super) number: u64,
}

/// Which request a reply is to: its number among the samples of our writer, or in the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Key {
    Number(i64),
    Header(i64),
}

/// Replies, and who waits for them.
#[derive(Default)]
pub(super) struct Replies {
    pub(super) own: OnceLock<OwnEnds>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    waiting: HashMap<Key, oneshot::Sender<Bytes>>,
    /// Requests that are being written, so that their numbers are not known yet.
    writing: usize,
    /// Replies that came meanwhile.
    early: Vec<(Key, Bytes)>,
}

impl State {
    fn has_room(&self) -> bool {
        self.waiting.len() + self.writing < MAX_IN_FLIGHT
    }
}

impl Sink for Replies {
    fn sample(&self, sample: Sample) {
        self.take(sample.related, sample.payload);
    }
}

impl Replies {
    /// A reply to somebody: those to all clients of a service come by one topic.
    fn take(&self, related: Option<SampleIdentity>, payload: Bytes) {
        let Some(own) = self.own.get() else { return };
        let (key, response) = match related {
            Some(to) if to.writer == own.reader || to.writer == own.writer => {
                (Key::Number(to.number.0), payload)
            }
            Some(_) => return,
            None => match RequestHeader::split(&payload) {
                Some((header, response)) if header.client == own.number => {
                    (Key::Header(header.number), response)
                }
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

    /// Waits for the reply to a request with this number in its header; none where too many wait.
    pub(super) fn wait(self: &Arc<Self>, key: Key) -> Option<Waiting> {
        let mut state = self.state.lock();
        if !state.has_room() {
            return None;
        }
        let (sender, answer) = oneshot::channel();
        state.waiting.insert(key, sender);
        drop(state);
        let replies = Arc::clone(self);
        Some(Waiting {
            replies,
            key,
            answer,
        })
    }

    /// A request is about to be written; none where too many wait.
    pub(super) fn write(self: &Arc<Self>) -> Option<Writing> {
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
    /// It was given this number.
    pub(super) fn written(self, number: SequenceNumber) -> Waiting {
        let key = Key::Number(number.0);
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
        Waiting {
            replies,
            key,
            answer,
        }
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

/// Waiting for one reply; dropping it gives it up.
pub(super) struct Waiting {
    replies: Arc<Replies>,
    key: Key,
    pub(super) answer: oneshot::Receiver<Bytes>,
}

impl Drop for Waiting {
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
        let own = OwnEnds {
            reader: guid(READER),
            writer: guid(WRITER),
            number: 77,
        };
        assert!(replies.own.set(own).is_ok());
        replies
    }

    fn to(kind: u8, number: i64) -> Option<SampleIdentity> {
        Some(SampleIdentity {
            writer: guid(kind),
            number: SequenceNumber(number),
        })
    }

    #[test]
    fn a_reply_names_our_reader_or_our_writer() {
        let replies = replies();
        for kind in [READER, WRITER] {
            let mut waiting = replies.write().expect("room").written(SequenceNumber(5));
            replies.take(to(kind, 6), Bytes::from_static(b"another"));
            replies.take(to(9, 5), Bytes::from_static(b"of another client"));
            assert!(waiting.answer.try_recv().is_err());
            replies.take(to(kind, 5), Bytes::from_static(b"it"));
            assert_eq!(waiting.answer.try_recv().expect("a reply"), "it");
        }
        assert!(replies.state.lock().waiting.is_empty());
    }

    #[test]
    fn a_reply_may_come_before_the_number_of_its_request_is_known() {
        let replies = replies();
        let (one, two) = (
            replies.write().expect("room"),
            replies.write().expect("room"),
        );
        replies.take(to(READER, 1), Bytes::from_static(b"first"));
        replies.take(to(READER, 2), Bytes::from_static(b"second"));
        let mut second = two.written(SequenceNumber(2));
        let mut first = one.written(SequenceNumber(1));
        assert_eq!(first.answer.try_recv().expect("a reply"), "first");
        assert_eq!(second.answer.try_recv().expect("a reply"), "second");
        // Nobody waits: what comes is of a call that was given up.
        replies.take(to(READER, 3), Bytes::from_static(b"late"));
        assert!(replies.state.lock().early.is_empty());
    }

    #[test]
    fn a_reply_of_cyclone_is_known_by_its_header() {
        let replies = replies();
        let mut waiting = replies.wait(Key::Header(5)).expect("room");
        for (client, number) in [(78, 5), (77, 6)] {
            let header = RequestHeader { client, number };
            replies.take(None, header.join(&[0, 1, 0, 0, 9]).expect("CDR"));
        }
        replies.take(None, Bytes::from_static(b"short"));
        assert!(waiting.answer.try_recv().is_err());
        let header = RequestHeader {
            client: 77,
            number: 5,
        };
        replies.take(None, header.join(&[0, 1, 0, 0, 9]).expect("CDR"));
        assert_eq!(
            waiting.answer.try_recv().expect("a reply"),
            [0, 1, 0, 0, 9][..]
        );
    }

    #[test]
    fn calls_under_way_are_bounded_and_given_up_ones_do_not_count() {
        let replies = replies();
        let mut all: Vec<Waiting> = (0..MAX_IN_FLIGHT as i64)
            .filter_map(|number| replies.wait(Key::Header(number)))
            .collect();
        assert_eq!(all.len(), MAX_IN_FLIGHT);
        assert!(replies.write().is_none() && replies.wait(Key::Header(-1)).is_none());
        all.pop();
        assert!(replies.write().is_some());
    }
}
