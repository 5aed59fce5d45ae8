//! Answers that were sent, until the client is known to have them. A socket that dies takes with it what lay in its
//! buffers; a call must be answered all the same when the client comes back.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::outbox::Control;

/// Answers kept.
const MAX_KEPT: usize = 1024;
/// How long an answer waits for a ping of its own. Most are followed by something else before that.
const PATIENCE: Duration = Duration::from_secs(1);

/// Sent and not acknowledged, oldest first.
#[derive(Default)]
pub(crate) struct Acks {
    kept: VecDeque<Sent>,
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
    /// An answer goes out.
    pub(crate) fn sent(&mut self, control: Control, at: Instant) {
        if self.kept.len() >= MAX_KEPT {
            self.kept.pop_front();
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
        self.kept.get(unpinged).map(|sent| sent.at + PATIENCE)
    }

    /// The payload of a ping that goes out now.
    pub(crate) fn ping(&mut self) -> [u8; 8] {
        self.pings += 1;
        self.pings.to_be_bytes()
    }

    /// A pong came.
    pub(crate) fn pong(&mut self, payload: &[u8]) {
        if let Ok(number) = payload.try_into().map(u64::from_be_bytes) {
            let known = self.kept.partition_point(|sent| sent.ping <= number);
            self.kept.drain(..known);
        }
    }

    /// What was never acknowledged.
    pub(crate) fn take(&mut self) -> impl DoubleEndedIterator<Item = Control> + use<> {
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
    fn a_pong_acknowledges_what_was_sent_before_its_ping() {
        let now = Instant::now();
        let mut acks = Acks::default();
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
