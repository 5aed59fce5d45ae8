//! Answers that were sent, kept until the client is known to have them. A broken socket loses what is in its buffers; a
//! call must still be answered when the client comes back.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use budget::{Budget, Permit};

use crate::outbox::ControlMessage;

/// Maximum number of answers kept.
const MAX_ANSWERS: usize = 1024;
/// Maximum bytes of those answers; the latest is always kept.
const MAX_KEPT_BYTES: usize = 32 << 20;
/// Bytes that are kept only until the next ping: beyond this it is sent at once.
const PING_BYTES: usize = 4 << 20;
/// Delay before an answer gets its own ping. Most are followed by another ping earlier.
const PATIENCE: Duration = Duration::from_secs(1);

/// Answers sent and not acknowledged, oldest first.
pub(crate) struct Acks {
    kept: VecDeque<UnackedAnswer>,
    /// Bytes of the answers kept.
    bytes: usize,
    /// Bytes of the answers kept that have no permit of their own, and the permit for them.
    small: usize,
    permit: Permit,
    /// Bytes of answers not followed by a ping yet.
    unasked: usize,
    /// Number of the last ping.
    pings: u64,
}

struct UnackedAnswer {
    control: ControlMessage,
    at: Instant,
    /// Number of the ping that follows it: its pong acknowledges the answer.
    ping: u64,
}

impl Acks {
    /// Creates an empty queue for a client with this budget.
    pub(crate) fn new(budget: &Budget) -> Self {
        Self { kept: VecDeque::new(), bytes: 0, small: 0, permit: budget.permit(), unasked: 0, pings: 0 }
    }

    /// Records an answer that is being sent.
    pub(crate) fn record_sent(&mut self, control: ControlMessage, at: Instant) {
        let size = control.frame.bytes.len();
        self.bytes += size;
        self.small += control.small_bytes();
        self.unasked += size;
        while self.kept.len() >= MAX_ANSWERS || self.bytes > MAX_KEPT_BYTES || self.permit.count(self.small).is_err() {
            let Some(oldest) = self.kept.pop_front() else {
                break;
            };
            self.bytes -= oldest.control.frame.bytes.len();
            self.small -= oldest.control.small_bytes();
        }
        self.kept.push_back(UnackedAnswer { control, at, ping: self.pings + 1 });
    }

    /// Returns when a ping should follow the answers sent.
    pub(crate) fn ping_due(&self) -> Option<Instant> {
        let unpinged = self.kept.partition_point(|sent| sent.ping <= self.pings);
        let patience = if self.unasked > PING_BYTES { Duration::ZERO } else { PATIENCE };
        self.kept.get(unpinged).map(|sent| sent.at + patience)
    }

    /// Returns the payload of a ping that is sent now.
    pub(crate) fn next_ping(&mut self) -> [u8; 8] {
        self.pings += 1;
        self.unasked = 0;
        self.pings.to_be_bytes()
    }

    /// Handles a pong.
    pub(crate) fn on_pong(&mut self, payload: &[u8]) {
        if let Ok(number) = payload.try_into().map(u64::from_be_bytes) {
            let known = self.kept.partition_point(|sent| sent.ping <= number);
            for gone in self.kept.drain(..known) {
                self.bytes -= gone.control.frame.bytes.len();
                self.small -= gone.control.small_bytes();
            }
            // Shrinking always succeeds.
            let _ = self.permit.count(self.small);
        }
    }

    /// Takes all answers that were not acknowledged.
    pub(crate) fn take_unacked(&mut self) -> impl DoubleEndedIterator<Item = ControlMessage> + use<> {
        self.bytes = 0;
        self.small = 0;
        self.unasked = 0;
        let _ = self.permit.count(0);
        std::mem::take(&mut self.kept).into_iter().map(|sent| sent.control)
    }
}

#[cfg(test)]
mod tests {
    use rosbridge::Format;

    use super::*;
    use crate::sample::EncodedFrame;

    fn answer(name: &'static str) -> ControlMessage {
        let frame = EncodedFrame { format: Format::Json, bytes: name.into() };
        ControlMessage { frame, fragment_size: None, answer: true }
    }

    #[test]
    fn what_is_kept_is_bounded_and_big_answers_are_asked_about_at_once() {
        let now = Instant::now();
        let big = |size| ControlMessage {
            frame: EncodedFrame { format: Format::Json, bytes: vec![0; size].into() },
            ..answer("")
        };
        let mut acks = Acks::new(&Budget::without_limit());
        acks.record_sent(big(5 << 20), now);
        assert_eq!(acks.ping_due(), Some(now));
        acks.next_ping();
        assert_eq!(acks.ping_due(), None);
        for _ in 0..100 {
            acks.record_sent(big(5 << 20), now);
        }
        assert_eq!((acks.kept.len(), acks.bytes), (6, 30 << 20));
        acks.record_sent(big(100 << 20), now);
        assert_eq!((acks.kept.len(), acks.bytes), (1, 100 << 20));
        let last = acks.next_ping();
        acks.on_pong(&last);
        assert_eq!((acks.kept.len(), acks.bytes), (0, 0));
    }

    #[test]
    fn a_pong_acknowledges_what_was_sent_before_its_ping() {
        let now = Instant::now();
        let mut acks = Acks::new(&Budget::without_limit());
        assert_eq!(acks.ping_due(), None);
        acks.record_sent(answer("a"), now);
        assert_eq!(acks.ping_due(), Some(now + PATIENCE));
        let first = acks.next_ping();
        assert_eq!(acks.ping_due(), None);
        acks.record_sent(answer("b"), now);
        acks.on_pong(b"other");
        acks.on_pong(&first);
        assert_eq!(acks.ping_due(), Some(now + PATIENCE));
        let left: Vec<_> = acks.take_unacked().map(|control| control.frame.bytes).collect();
        assert_eq!(left, ["b"]);
        assert_eq!(acks.take_unacked().count(), 0);
    }
}
