//! Answers that were sent, until the client is known to have them. A socket that dies takes with it what lay in its
//! buffers; a call must be answered all the same when the client comes back.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use budget::{Budget, Permit};

use crate::outbox::Control;

/// Answers kept.
const MAX_KEPT: usize = 1024;
/// Bytes of those; the latest is always kept.
const MAX_KEPT_BYTES: usize = 32 << 20;
/// Bytes that are kept for no longer than it takes to ask whether they have arrived.
const ASKED_ABOUT: usize = 4 << 20;
/// How long an answer waits for a ping of its own. Most are followed by something else before that.
const PATIENCE: Duration = Duration::from_secs(1);

/// Sent and not acknowledged, oldest first.
pub(crate) struct Acks {
    kept: VecDeque<Sent>,
    /// Bytes of those.
    bytes: usize,
    /// Of those, bytes of answers that have no permit of their own, and the permit for them.
    small: usize,
    permit: Permit,
    /// Bytes of those with no ping behind them yet.
    unasked: usize,
    /// The number of the last ping.
    pings: u64,
}

struct Sent {
    control: Control,
    at: Instant,
    /// The ping behind it: its pong acknowledges.
    ping: u64,
}

impl Acks {
    /// Nothing yet, of a client with this budget.
    pub(crate) fn new(budget: &Budget) -> Self {
        Self {
            kept: VecDeque::new(),
            bytes: 0,
            small: 0,
            permit: budget.permit(),
            unasked: 0,
            pings: 0,
        }
    }

    /// An answer goes out.
    pub(crate) fn sent(&mut self, control: Control, at: Instant) {
        let size = control.frame.bytes.len();
        self.bytes += size;
        self.small += control.small();
        self.unasked += size;
        while self.kept.len() >= MAX_KEPT
            || self.bytes > MAX_KEPT_BYTES
            || self.permit.count(self.small).is_err()
        {
            let Some(oldest) = self.kept.pop_front() else {
                break;
            };
            self.bytes -= oldest.control.frame.bytes.len();
            self.small -= oldest.control.small();
        }
        self.kept.push_back(Sent {
            control,
            at,
            ping: self.pings + 1,
        });
    }

    /// When a ping should follow what was sent.
    pub(crate) fn ping_due(&self) -> Option<Instant> {
        let unpinged = self.kept.partition_point(|sent| sent.ping <= self.pings);
        let patience = match self.unasked > ASKED_ABOUT {
            true => Duration::ZERO,
            false => PATIENCE,
        };
        self.kept.get(unpinged).map(|sent| sent.at + patience)
    }

    /// The payload of a ping that goes out now.
    pub(crate) fn ping(&mut self) -> [u8; 8] {
        self.pings += 1;
        self.unasked = 0;
        self.pings.to_be_bytes()
    }

    /// A pong came.
    pub(crate) fn pong(&mut self, payload: &[u8]) {
        if let Ok(number) = payload.try_into().map(u64::from_be_bytes) {
            let known = self.kept.partition_point(|sent| sent.ping <= number);
            for gone in self.kept.drain(..known) {
                self.bytes -= gone.control.frame.bytes.len();
                self.small -= gone.control.small();
            }
            // Less always fits.
            let _ = self.permit.count(self.small);
        }
    }

    /// What was never acknowledged.
    pub(crate) fn take(&mut self) -> impl DoubleEndedIterator<Item = Control> + use<> {
        self.bytes = 0;
        self.small = 0;
        self.unasked = 0;
        let _ = self.permit.count(0);
        std::mem::take(&mut self.kept)
            .into_iter()
            .map(|sent| sent.control)
    }
}

#[cfg(test)]
mod tests {
    use rosbridge::Format;

    use super::*;
    use crate::sample::Frame;

    fn answer(name: &'static str) -> Control {
        let frame = Frame {
            format: Format::Json,
            bytes: name.into(),
        };
        Control {
            frame,
            fragment_size: None,
            answer: true,
        }
    }

    #[test]
    fn what_is_kept_is_bounded_and_big_answers_are_asked_about_at_once() {
        let now = Instant::now();
        let big = |size| Control {
            frame: Frame {
                format: Format::Json,
                bytes: vec![0; size].into(),
            },
            ..answer("")
        };
        let mut acks = Acks::new(&Budget::unlimited());
        acks.sent(big(5 << 20), now);
        assert_eq!(acks.ping_due(), Some(now));
        acks.ping();
        assert_eq!(acks.ping_due(), None);
        for _ in 0..100 {
            acks.sent(big(5 << 20), now);
        }
        assert_eq!((acks.kept.len(), acks.bytes), (6, 30 << 20));
        acks.sent(big(100 << 20), now);
        assert_eq!((acks.kept.len(), acks.bytes), (1, 100 << 20));
        let last = acks.ping();
        acks.pong(&last);
        assert_eq!((acks.kept.len(), acks.bytes), (0, 0));
    }

    #[test]
    fn a_pong_acknowledges_what_was_sent_before_its_ping() {
        let now = Instant::now();
        let mut acks = Acks::new(&Budget::unlimited());
        assert_eq!(acks.ping_due(), None);
        acks.sent(answer("a"), now);
        assert_eq!(acks.ping_due(), Some(now + PATIENCE));
        let first = acks.ping();
        assert_eq!(acks.ping_due(), None);
        acks.sent(answer("b"), now);
        acks.pong(b"other");
        acks.pong(&first);
        assert_eq!(acks.ping_due(), Some(now + PATIENCE));
        let left: Vec<_> = acks.take().map(|control| control.frame.bytes).collect();
        assert_eq!(left, ["b"]);
        assert_eq!(acks.take().count(), 0);
    }
}
