//! The header that rmw_cyclonedds puts between the CDR header and a request or reply: the client, and the number of the
//! request. rmw_fastrtps has both in the sample's inline QoS (`related_sample_identity`), and nothing in the payload.

use bytes::Bytes;

/// Size of the CDR header.
const REPRESENTATION: usize = 4;
/// Size: two numbers of eight bytes, in the payload's byte order. Without it the rest of the message stays aligned.
const SIZE: usize = 16;

/// The client and the number of its request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RequestHeader {
    /// Identifies the client.
    pub(super) client: u64,
    /// Sequence number of the client's request.
    pub(super) number: i64,
}

impl RequestHeader {
    /// Splits a payload into the header and the rest; `None` if there is no header.
    pub(super) fn split(payload: &Bytes) -> Option<(Self, Bytes)> {
        let (representation, body) = payload.split_first_chunk::<REPRESENTATION>()?;
        let (header, message) = body.split_first_chunk::<SIZE>()?;
        let big = representation[1] & 1 == 0;
        let number = |at: usize| -> Option<u64> {
            let bytes: [u8; 8] = header.get(at..at + 8)?.try_into().ok()?;
            Some(if big { u64::from_be_bytes(bytes) } else { u64::from_le_bytes(bytes) })
        };
        let header = Self { client: number(0)?, number: number(8)? as i64 };
        Some((header, [&representation[..], message].concat().into()))
    }

    /// Inserts the header into a payload; `None` if that is not CDR.
    pub(super) fn join(self, payload: &[u8]) -> Option<Bytes> {
        let (representation, message) = payload.split_first_chunk::<REPRESENTATION>()?;
        let big = representation[1] & 1 == 0;
        let number = |number: u64| {
            if big { number.to_be_bytes() } else { number.to_le_bytes() }
        };
        let (client, number) = (number(self.client), number(self.number as u64));
        Some([&representation[..], &client, &number, message].concat().into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_is_read_as_it_was_written() {
        let header = RequestHeader { client: 0x0102_0304_0506_0708, number: -2 };
        let little = header.join(&[0, 1, 0, 0, 9, 9]).expect("CDR");
        assert_eq!(little[4..12], [8, 7, 6, 5, 4, 3, 2, 1]);
        let big = header.join(&[0, 0, 0, 0, 9, 9]).expect("CDR");
        assert_eq!(big[4..12], [1, 2, 3, 4, 5, 6, 7, 8]);
        for (with, without) in [(little, [0, 1, 0, 0, 9, 9]), (big, [0, 0, 0, 0, 9, 9])] {
            let (read, payload) = RequestHeader::split(&with).expect("a header");
            assert_eq!((read, &payload[..]), (header, &without[..]));
        }
    }

    #[test]
    fn what_is_too_short_has_none() {
        for length in 0..20 {
            assert!(RequestHeader::split(&Bytes::from(vec![0; length])).is_none());
        }
        assert!(RequestHeader { client: 0, number: 0 }.join(&[0, 1, 0]).is_none());
    }
}
