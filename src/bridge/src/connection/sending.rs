//! From what waits for a client to frames in its socket: control first, long ones in fragments, samples encoded at the
//! last moment.

use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use budget::{Exceeded, UNCOUNTED};
use bytes::Bytes;
use rosbridge::{Compression, Format, Level};
use tokio::io::{AsyncRead, AsyncWrite};
use ws::frame;

use super::{Connection, MOVED, SOCKET_FULL, Stop};
use crate::cut::Cuts;
use crate::outbox::{Control, Outgoing, TopicKey};
use crate::sample::{Frame, Sample};

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<S> {
    /// Moves what waits into the socket. Ready when there is nothing left, pending when the socket takes no more.
    pub(super) fn write(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<Result<(), Stop>> {
        loop {
            while self.socket.queued() < SOCKET_FULL && self.moved < MOVED {
                let next = self.next_frame(now).map_err(|full| Stop::Close {
                    code: 1013,
                    reason: format!("a fragment cannot be sent: {full}"),
                    readable: true,
                })?;
                let Some((opcode, bytes)) = next else {
                    break;
                };
                let metrics = &self.client.shared.metrics;
                metrics.frames_out.add(1);
                metrics.bytes_out.add(bytes.len() as u64);
                self.moved += bytes.len();
                self.socket.queue(opcode, bytes);
            }
            if self.socket.queued() == 0 {
                return Poll::Ready(Ok(()));
            }
            ready!(self.socket.poll_flush(cx)).map_err(|error| Stop::Lost {
                reason: error.to_string(),
                heard_all: false,
            })?;
        }
    }

    fn next_frame(&mut self, now: Instant) -> Result<Option<(u8, Bytes)>, Exceeded> {
        if self.cuts.is_due()
            && let Some(fragment) = self.next_fragment()?
        {
            return Ok(Some(fragment));
        }
        loop {
            let next = if self.cuts.is_full() {
                // One that would be cut, too, waits in its queue, which is bounded.
                let whole =
                    |control: &Control| !Cuts::is_long(&control.frame, control.fragment_size);
                let control = self.client.outbox.next_control_if(whole);
                control.map(Outgoing::Control)
            } else {
                self.client.outbox.next(now)
            };
            let frame = match next {
                None => return self.next_fragment(),
                Some(Outgoing::Control(control)) => {
                    self.remember(&control, now);
                    let cut = self.cuts.cut(&control.frame, control.fragment_size, None);
                    (!cut).then_some(control.frame)
                }
                Some(Outgoing::Sample {
                    key,
                    sample,
                    topic,
                    compression,
                    fragment_size,
                }) => {
                    let frame = self.encode(key, &sample, &topic, compression, now);
                    let cut = frame
                        .as_ref()
                        .is_some_and(|frame| self.cuts.cut(frame, fragment_size, Some(key)));
                    if cut {
                        self.client.outbox.sending_fragments(self.number, key);
                    }
                    frame.filter(|_| !cut)
                }
            };
            if let Some(frame) = frame {
                self.cuts.make_due();
                return Ok(Some((frame.opcode(), frame.bytes)));
            }
        }
    }

    fn next_fragment(&mut self) -> Result<Option<(u8, Bytes)>, Exceeded> {
        let Some((mut bytes, done)) = self.cuts.next() else {
            return Ok(None);
        };
        if let Some(key) = done {
            self.client.outbox.fragments_sent(self.number, key);
        }
        // A copy of a part of the message.
        if bytes.len() > UNCOUNTED {
            bytes = self.client.budget.take(bytes.len())?.around(bytes);
        }
        Ok(Some((frame::TEXT, bytes)))
    }

    fn encode(
        &self,
        key: TopicKey,
        sample: &Arc<Sample>,
        topic: &Arc<str>,
        compression: Compression,
        now: Instant,
    ) -> Option<Frame> {
        let shared = &self.client.shared;
        let made = sample.frame(compression, topic, &shared.options, &shared.metrics);
        let held = made.and_then(|frame| {
            // Its bytes are shared with other clients; as long as this one does not read them it is this one that holds them.
            let held = match frame.is_big() {
                true => self.client.budget.alone().take(frame.bytes.len()).map(Some),
                false => Ok(None),
            };
            match held {
                Ok(permit) => Ok(frame.holding(permit)),
                Err(full) => Err(Arc::from(format!("a message is left out: {full}"))),
            }
        });
        match held {
            Ok(frame) => Some(frame),
            Err(reason) => {
                if self.client.outbox.may_complain(key, now) {
                    let text = format!("subscribe: topic {topic}: {reason}");
                    self.client.status(Level::Error, None, Format::Json, &text);
                }
                None
            }
        }
    }
}
