//! Moves queued data of a client into its socket as frames: control messages first, long ones in fragments, samples
//! encoded at the last moment.

use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use budget::{Exceeded, UNCOUNTED};
use bytes::Bytes;
use rosbridge::{Compression, Format, StatusLevel};
use tokio::io::{AsyncRead, AsyncWrite};
use ws::frame;

use super::{BridgeConnection, SOCKET_FULL, StopReason, TURN_BYTES};
use crate::cut::Fragmenter;
use crate::outbox::{ControlMessage, Outgoing, TopicKey};
use crate::sample::{EncodedFrame, SampleError, TopicSample};

impl<S: AsyncRead + AsyncWrite + Unpin> BridgeConnection<S> {
    /// Moves queued frames into the socket. Ready when none is left, pending when the socket accepts no more.
    pub(super) fn write(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<Result<(), StopReason>> {
        loop {
            while self.socket.bytes_queued() < SOCKET_FULL && self.moved < TURN_BYTES {
                let next = self.next_frame(now).map_err(|full| StopReason::Close {
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
            if self.socket.bytes_queued() == 0 {
                return Poll::Ready(Ok(()));
            }
            ready!(self.socket.poll_flush(cx))
                .map_err(|error| StopReason::Lost { reason: error.to_string(), heard_all: false })?;
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
                // A control message that would be fragmented as well waits in its queue, which is bounded.
                let whole = |control: &ControlMessage| !Fragmenter::is_long(&control.frame, control.fragment_size);
                let control = self.client.outbox.next_control_if(whole);
                control.map(Outgoing::Control)
            } else {
                self.client.outbox.next(now)
            };
            let frame = match next {
                None => return self.next_fragment(),
                Some(Outgoing::Control(control)) => {
                    self.retain_answer(&control, now);
                    let cut = self.cuts.add_if_long(&control.frame, control.fragment_size, None);
                    (!cut).then_some(control.frame)
                }
                Some(Outgoing::Sample { key, sample, topic, compression, fragment_size }) => {
                    let frame = self.encode(key, &sample, &topic, compression, now);
                    let cut =
                        frame.as_ref().is_some_and(|frame| self.cuts.add_if_long(frame, fragment_size, Some(key)));
                    if cut {
                        self.client.outbox.hold_topic(self.number, key);
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
            self.client.outbox.release_topic(self.number, key);
        }
        // A copy of a part of the message.
        if bytes.len() > UNCOUNTED {
            bytes = self.client.budget.take(bytes.len())?.wrap_bytes(bytes);
        }
        Ok(Some((frame::TEXT, bytes)))
    }

    fn encode(
        &self,
        key: TopicKey,
        sample: &Arc<TopicSample>,
        topic: &Arc<str>,
        compression: Compression,
        now: Instant,
    ) -> Option<EncodedFrame> {
        let shared = &self.client.shared;
        let made = sample.frame(compression, topic, &shared.options, &shared.metrics);
        let held = made.and_then(|frame| {
            // The bytes are shared with other clients; for as long as this client does not read them they count in its
            // budget.
            let held = if frame.is_big() {
                self.client.budget.without_parents().take(frame.bytes.len()).map(Some)
            } else {
                Ok(None)
            };
            match held {
                Ok(permit) => Ok(frame.with_permit(permit)),
                Err(full) => Err(Arc::new(SampleError::NoRoomAtClient(full))),
            }
        });
        match held {
            Ok(frame) => Some(frame),
            Err(reason) => {
                if self.client.outbox.should_report(key, now) {
                    let text = format!("subscribe: topic {topic}: {reason}");
                    self.client.send_status(StatusLevel::Error, None, Format::Json, &text);
                }
                None
            }
        }
    }
}
