//! Encoding of the records that the two ends of a link exchange.
//!
//! | first byte | then |
//! |---|---|
//! | 0 control | JSON, [`FromRobot`](crate::control::FromRobot) or [`FromCloud`](crate::control::FromCloud) |
//! | 1 data | channel u32 · flags u8 · born i64 · left i64 · serialise u32 · answered (optional) · message |
//! | 2 call | id u32 · service u32 · request |
//! | 3 answer | id u32 · ok u8 · taken i64 · given i64 · response, or the reason why there is none |
//!
//! where answered, present if its flag is set, is: born i64 · serialise u32 · left i64 · taken i64 · given i64

use bytes::{Buf, BufMut, Bytes, BytesMut, TryGetError};
use ros::bus::FailureReason;

use crate::Error;

const CONTROL: u8 = 0;
const DATA: u8 = 1;
const CALL: u8 = 2;
const ANSWER: u8 = 3;

pub(crate) const ENCODED: u8 = 1;
const ANSWERED: u8 = 2;
const LATCHING: u8 = 4;
/// Offset of `left` in the header of a data record.
pub(crate) const LEFT_AT: usize = 14;
/// Offsets of `flags` and `serialise`.
pub(crate) const FLAGS_AT: usize = 5;
pub(crate) const SERIALISE_AT: usize = 22;

/// A record. `C` is the content of a control record: JSON on the wire, a parsed message above the session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Record<C = Bytes> {
    /// A control message.
    Control(C),
    /// A topic message.
    Data(Data),
    /// A service call.
    Call(Call),
    /// The response to a call.
    Answer {
        /// Id of the call.
        id: u32,
        /// Time at which the call was received, on the clock of the answering end.
        taken: i64,
        /// Time at which the response was available, on the same clock.
        given: i64,
        /// Serialized response, or the reason why there is none.
        response: Result<Bytes, FailureReason>,
    },
}

/// A service call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Call {
    /// Id chosen by the caller's end.
    pub id: u32,
    /// Channel of the service.
    pub service: u32,
    /// Serialized request.
    pub request: Bytes,
}

/// A topic message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Data {
    /// Channel announced by `Open` or `Graph`.
    pub channel: u32,
    /// The message is an encoded frame.
    pub encoded: bool,
    /// The publisher is latching: new subscribers receive the last message.
    pub latching: bool,
    /// Time at which the sender received it from ROS, on the sender's clock.
    pub born: i64,
    /// Time at which its first byte was given to the socket, on the sender's clock.
    pub left: i64,
    /// Encoding time in microseconds.
    pub serialise: u32,
    /// Input to which this may be the response, in records from the cloud.
    pub answered: Option<InputTiming>,
    /// Serialized message.
    pub message: Bytes,
}

/// Timing of an input on its way through the cloud.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InputTiming {
    /// Value of `born` of the input, on the robot's clock; identifies the input.
    pub born: i64,
    /// The robot's encoding time in microseconds.
    pub serialise: u32,
    /// Time at which its first byte was given to the socket, on the robot's clock.
    pub left: i64,
    /// Time at which it had been received completely, on the cloud's clock.
    pub taken: i64,
    /// Time at which it was given to the node, on the cloud's clock.
    pub given: i64,
}

impl InputTiming {
    fn get(bytes: &mut Bytes) -> Result<Self, TryGetError> {
        Ok(Self {
            born: bytes.try_get_i64_le()?,
            serialise: bytes.try_get_u32_le()?,
            left: bytes.try_get_i64_le()?,
            taken: bytes.try_get_i64_le()?,
            given: bytes.try_get_i64_le()?,
        })
    }
}

/// Returns whether a record that begins with these bytes is a control record.
pub(crate) fn is_control(bytes: &[u8]) -> bool {
    bytes.first() == Some(&CONTROL)
}

impl Record {
    /// Returns header and payload, in this order on the wire.
    pub fn to_parts(&self) -> (BytesMut, Bytes) {
        let mut head = BytesMut::with_capacity(64);
        let payload = match self {
            Record::Control(json) => {
                head.put_u8(CONTROL);
                json.clone()
            }
            Record::Data(data) => {
                head.put_u8(DATA);
                head.put_u32_le(data.channel);
                let answered = if data.answered.is_some() { ANSWERED } else { 0 };
                let latching = if data.latching { LATCHING } else { 0 };
                head.put_u8(answered | latching | if data.encoded { ENCODED } else { 0 });
                head.put_i64_le(data.born);
                debug_assert_eq!(head.len(), LEFT_AT, "where left is patched");
                head.put_i64_le(data.left);
                head.put_u32_le(data.serialise);
                if let Some(answered) = &data.answered {
                    head.put_i64_le(answered.born);
                    head.put_u32_le(answered.serialise);
                    head.put_i64_le(answered.left);
                    head.put_i64_le(answered.taken);
                    head.put_i64_le(answered.given);
                }
                data.message.clone()
            }
            Record::Call(Call { id, service, request }) => {
                head.put_u8(CALL);
                head.put_u32_le(*id);
                head.put_u32_le(*service);
                request.clone()
            }
            Record::Answer { id, taken, given, response } => {
                head.put_u8(ANSWER);
                head.put_u32_le(*id);
                head.put_u8(u8::from(response.is_ok()));
                head.put_i64_le(*taken);
                head.put_i64_le(*given);
                match response {
                    Ok(response) => response.clone(),
                    Err(reason) => Bytes::copy_from_slice(reason.as_str().as_bytes()),
                }
            }
        };
        (head, payload)
    }

    /// Decodes a record. Its payload is a slice of `bytes`, not a copy.
    pub fn decode(mut bytes: Bytes) -> Result<Self, Error> {
        Ok(match bytes.try_get_u8()? {
            CONTROL => Record::Control(bytes),
            DATA => {
                let (channel, flags) = (bytes.try_get_u32_le()?, bytes.try_get_u8()?);
                Record::Data(Data {
                    channel,
                    encoded: flags & ENCODED != 0,
                    latching: flags & LATCHING != 0,
                    born: bytes.try_get_i64_le()?,
                    left: bytes.try_get_i64_le()?,
                    serialise: bytes.try_get_u32_le()?,
                    answered: (flags & ANSWERED != 0).then(|| InputTiming::get(&mut bytes)).transpose()?,
                    message: bytes,
                })
            }
            CALL => {
                Record::Call(Call { id: bytes.try_get_u32_le()?, service: bytes.try_get_u32_le()?, request: bytes })
            }
            ANSWER => {
                let (id, ok) = (bytes.try_get_u32_le()?, bytes.try_get_u8()? != 0);
                Record::Answer {
                    id,
                    taken: bytes.try_get_i64_le()?,
                    given: bytes.try_get_i64_le()?,
                    response: if ok { Ok(bytes) } else { Err(FailureReason::new(String::from_utf8_lossy(&bytes))) },
                }
            }
            _ => return Err(Error::Protocol("a record of unknown kind")),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hex(bytes: &[u8]) -> String {
        bytes.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The bytes that deployed stubs send. If this test fails, see [`SUBPROTOCOL`](crate::SUBPROTOCOL).
    #[test]
    fn the_bytes_of_records_are_those_of_this_version() {
        assert_eq!(crate::SUBPROTOCOL, "cloudroid-link.v2");
        let data = Data {
            channel: 0x0102_0304,
            encoded: true,
            latching: false,
            born: 0x1112_1314_1516_1718,
            left: -2,
            serialise: 0x2122_2324,
            answered: None,
            message: Bytes::from_static(b"msg"),
        };
        let answered = Data {
            encoded: false,
            latching: true,
            answered: Some(InputTiming { born: 1, serialise: 2, left: 3, taken: 4, given: 5 }),
            ..data.clone()
        };
        let answer = |response| Record::Answer { id: 6, taken: 7, given: 8, response };
        let pinned = [
            (Record::Control(Bytes::from_static(b"{}")), "007b7d"),
            (Record::Data(data), "01 04030201 01 1817161514131211 feffffffffffffff 24232221 6d7367"),
            (
                Record::Data(answered),
                "01 04030201 06 1817161514131211 feffffffffffffff 24232221 0100000000000000 02000000 0300000000000000 \
                 0400000000000000 0500000000000000 6d7367",
            ),
            (
                Record::Call(Call { id: 9, service: 10, request: Bytes::from_static(b"ask") }),
                "02 09000000 0a000000 61736b",
            ),
            (answer(Ok(Bytes::from_static(b"yes"))), "03 06000000 01 0700000000000000 0800000000000000 796573"),
            (answer(Err(FailureReason::new("no"))), "03 06000000 00 0700000000000000 0800000000000000 6e6f"),
        ];
        for (record, expected) in pinned {
            let (mut head, payload) = record.to_parts();
            head.extend_from_slice(&payload);
            assert_eq!(hex(&head), expected.replace(' ', ""), "{record:?}");
            assert_eq!(Record::decode(head.freeze()).unwrap(), record);
        }
    }

    #[test]
    fn records_round_trip() {
        let data = Data {
            channel: 3,
            encoded: true,
            latching: false,
            born: -5,
            left: 1 << 60,
            serialise: 12,
            answered: None,
            message: Bytes::from_static(b"message"),
        };
        let answered = Data {
            encoded: false,
            latching: true,
            answered: Some(InputTiming { born: 1, serialise: 4, left: 5, taken: 2, given: 3 }),
            ..data.clone()
        };
        for record in [
            Record::Control(Bytes::from_static(b"{}")),
            Record::Data(data),
            Record::Data(answered),
            Record::Call(Call { id: 1, service: 2, request: Bytes::new() }),
            Record::Answer { id: 1, taken: 2, given: 3, response: Ok(Bytes::from_static(b"x")) },
            Record::Answer { id: 1, taken: 2, given: 3, response: Err(FailureReason::new("no")) },
        ] {
            let (mut head, payload) = record.to_parts();
            head.extend_from_slice(&payload);
            let whole = head.freeze();
            assert_eq!(Record::decode(whole.clone()).unwrap(), record);
            let cut = whole.slice(..whole.len().min(4).saturating_sub(1));
            assert!(Record::decode(cut).is_err() || matches!(record, Record::Control(_)));
        }
    }
}
