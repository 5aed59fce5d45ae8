//! Encoding of the WebSocket messages of a link. All numbers are little-endian.
//!
//! | first byte | then |
//! |---|---|
//! | 0 open | JSON: [`Hello`](crate::control::Hello), [`Welcome`](crate::control::Welcome) |
//! | 1 whole | number u64 · record |
//! | 2 begin | stream u32 · number u64 · total u32 · first bytes of a record |
//! | 3 more | stream u32 · more bytes of it |
//! | 4 ping | sent i64 · received u64 · bytes u64 |
//! | 5 pong | sent i64 · arrived i64 · left i64 · received u64 · bytes u64 |
//! | 6 ack | received u64 · bytes u64 |
//! | 7 damaged | channel u32 · born i64 |
//!
//! A record with a number other than 0 is kept by its sender until the peer has acknowledged it; after a lost
//! connection it is sent again or counted as dropped. `received` acknowledges all numbers up to and including its
//! value. `bytes` is the total number of bytes received, from which the sender computes the throughput of the link.
//! Times are nanoseconds since the Unix epoch on the clock of the end that wrote them.

use bytes::{Buf, BufMut, Bytes, BytesMut, TryGetError};

use crate::Error;

const OPEN: u8 = 0;
const WHOLE: u8 = 1;
const BEGIN: u8 = 2;
const MORE: u8 = 3;
const PING: u8 = 4;
const PONG: u8 = 5;
const ACK: u8 = 6;
const DAMAGED: u8 = 7;

/// A WebSocket message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Frame {
    /// The first message in each direction.
    Open(Bytes),
    /// A record in one piece.
    Whole {
        /// Record number; 0: not acknowledged.
        number: u64,
        /// The record.
        record: Bytes,
    },
    /// The beginning of a record in several pieces.
    Begin {
        /// Identifies the record until it is complete.
        stream: u32,
        /// Record number; 0: not acknowledged.
        number: u64,
        /// Total length of the record.
        total: u32,
        /// The first bytes of the record.
        bytes: Bytes,
    },
    /// A continuation of a record.
    More {
        /// Stream of the record.
        stream: u32,
        /// The next bytes of the record.
        bytes: Bytes,
    },
    /// A request for a pong.
    Ping {
        /// Time at which the ping was sent.
        sent: i64,
        /// Receive progress of the sender.
        received: ReceiveProgress,
    },
    /// The reply to a ping.
    Pong {
        /// Time at which the ping was sent, copied from it.
        sent: i64,
        /// Time at which the ping was received.
        arrived: i64,
        /// Time at which the pong was sent.
        left: i64,
        /// Receive progress of the sender.
        received: ReceiveProgress,
    },
    /// An acknowledgement.
    Ack(ReceiveProgress),
    /// A message of the channel was received and its encoded frame does not decode to the original.
    Damaged {
        /// Channel number of the sender.
        channel: u32,
        /// Value of `born` in the message.
        born: i64,
    },
}

/// Receive progress of an end.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ReceiveProgress {
    /// All record numbers up to and including this one have been received.
    pub number: u64,
    /// Bytes of records received in the session.
    pub bytes: u64,
}

impl ReceiveProgress {
    fn put(self, out: &mut BytesMut) {
        out.put_u64_le(self.number);
        out.put_u64_le(self.bytes);
    }

    fn get(bytes: &mut Bytes) -> Result<Self, TryGetError> {
        Ok(Self { number: bytes.try_get_u64_le()?, bytes: bytes.try_get_u64_le()? })
    }
}

impl Frame {
    /// Encodes the frame as a WebSocket message.
    pub fn encode(&self) -> Bytes {
        let mut out = BytesMut::with_capacity(64);
        match self {
            Frame::Open(json) => {
                out.put_u8(OPEN);
                out.put_slice(json);
            }
            Frame::Whole { number, record } => {
                out.put_u8(WHOLE);
                out.put_u64_le(*number);
                out.put_slice(record);
            }
            Frame::Begin { stream, number, total, bytes } => {
                out.put_u8(BEGIN);
                out.put_u32_le(*stream);
                out.put_u64_le(*number);
                out.put_u32_le(*total);
                out.put_slice(bytes);
            }
            Frame::More { stream, bytes } => {
                out.put_u8(MORE);
                out.put_u32_le(*stream);
                out.put_slice(bytes);
            }
            Frame::Ping { sent, received } => {
                out.put_u8(PING);
                out.put_i64_le(*sent);
                received.put(&mut out);
            }
            Frame::Pong { sent, arrived, left, received } => {
                out.put_u8(PONG);
                out.put_i64_le(*sent);
                out.put_i64_le(*arrived);
                out.put_i64_le(*left);
                received.put(&mut out);
            }
            Frame::Ack(received) => {
                out.put_u8(ACK);
                received.put(&mut out);
            }
            Frame::Damaged { channel, born } => {
                out.put_u8(DAMAGED);
                out.put_u32_le(*channel);
                out.put_i64_le(*born);
            }
        }
        out.freeze()
    }

    /// Decodes a WebSocket message. Payloads are slices of it, not copies.
    pub fn decode(mut bytes: Bytes) -> Result<Self, Error> {
        Ok(match bytes.try_get_u8()? {
            OPEN => Frame::Open(bytes),
            WHOLE => Frame::Whole { number: bytes.try_get_u64_le()?, record: bytes },
            BEGIN => Frame::Begin {
                stream: bytes.try_get_u32_le()?,
                number: bytes.try_get_u64_le()?,
                total: bytes.try_get_u32_le()?,
                bytes,
            },
            MORE => Frame::More { stream: bytes.try_get_u32_le()?, bytes },
            PING => Frame::Ping { sent: bytes.try_get_i64_le()?, received: ReceiveProgress::get(&mut bytes)? },
            PONG => Frame::Pong {
                sent: bytes.try_get_i64_le()?,
                arrived: bytes.try_get_i64_le()?,
                left: bytes.try_get_i64_le()?,
                received: ReceiveProgress::get(&mut bytes)?,
            },
            ACK => Frame::Ack(ReceiveProgress::get(&mut bytes)?),
            DAMAGED => Frame::Damaged { channel: bytes.try_get_u32_le()?, born: bytes.try_get_i64_le()? },
            _ => return Err(Error::Protocol("a frame of unknown kind")),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_round_trip() {
        let received = ReceiveProgress { number: 7, bytes: 1 << 40 };
        let bytes = Bytes::from_static(b"abc");
        for frame in [
            Frame::Open(bytes.clone()),
            Frame::Whole { number: 1, record: bytes.clone() },
            Frame::Begin { stream: 2, number: 0, total: 9, bytes: bytes.clone() },
            Frame::More { stream: 2, bytes },
            Frame::Ping { sent: -1, received },
            Frame::Pong { sent: 1, arrived: 2, left: i64::MAX, received },
            Frame::Ack(received),
            Frame::Damaged { channel: 3, born: -4 },
        ] {
            assert_eq!(Frame::decode(frame.encode()).unwrap(), frame);
        }
    }

    /// The bytes that deployed stubs send. If this test fails, see [`SUBPROTOCOL`](crate::SUBPROTOCOL).
    #[test]
    fn the_bytes_of_frames_are_those_of_this_version() {
        assert_eq!(crate::SUBPROTOCOL, "cloudroid-link.v2");
        let received = ReceiveProgress { number: 7, bytes: 0x0102_0304_0506_0708 };
        let bytes = Bytes::from_static(b"abc");
        let pinned = [
            (Frame::Open(bytes.clone()), "00 616263"),
            (Frame::Whole { number: 1, record: bytes.clone() }, "01 0100000000000000 616263"),
            (
                Frame::Begin { stream: 2, number: 3, total: 9, bytes: bytes.clone() },
                "02 02000000 0300000000000000 09000000 616263",
            ),
            (Frame::More { stream: 2, bytes }, "03 02000000 616263"),
            (Frame::Ping { sent: -1, received }, "04 ffffffffffffffff 0700000000000000 0807060504030201"),
            (
                Frame::Pong { sent: 1, arrived: 2, left: 3, received },
                "05 0100000000000000 0200000000000000 0300000000000000 0700000000000000 0807060504030201",
            ),
            (Frame::Ack(received), "06 0700000000000000 0807060504030201"),
            (Frame::Damaged { channel: 3, born: 4 }, "07 03000000 0400000000000000"),
        ];
        for (frame, expected) in pinned {
            let encoded = frame.encode();
            let hex: String = encoded.iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(hex, expected.replace(' ', ""), "{frame:?}");
            assert_eq!(Frame::decode(encoded).unwrap(), frame);
        }
    }

    #[test]
    fn broken_frames_are_refused() {
        assert!(Frame::decode(Bytes::new()).is_err());
        for kind in 0..=255_u8 {
            let frame = Frame::decode(Bytes::copy_from_slice(&[kind]));
            assert_eq!(frame.is_ok(), kind == OPEN, "{kind}");
        }
    }
}
