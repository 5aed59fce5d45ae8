//! A cursor over received bytes with their byte order.

use bytes::Bytes;

use super::WireError;
use crate::time::{WireDuration, WireTime};
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity, SequenceNumber};

/// Upper limit of sequence numbers, which no writer reaches: 146 years at a billion samples per second.
const MAX_SEQUENCE_NUMBER: i64 = 1 << 62;

/// A cursor over a part of received bytes.
#[derive(Debug, Clone)]
pub(crate) struct WireReader<'a> {
    whole: &'a Bytes,
    /// Position; at most `end`.
    at: usize,
    /// End; at most the length of `whole`.
    end: usize,
    /// Little-endian byte order.
    pub little: bool,
}

impl<'a> WireReader<'a> {
    /// Creates a cursor over all bytes.
    pub fn new(whole: &'a Bytes, little: bool) -> Self {
        Self { whole, at: 0, end: whole.len(), little }
    }

    /// Returns the number of remaining bytes.
    pub fn remaining(&self) -> usize {
        self.end - self.at
    }

    /// Returns the position within the whole.
    pub fn position(&self) -> usize {
        self.at
    }

    /// Reads the next bytes.
    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        let bytes = self.whole[self.at..self.end].first_chunk().ok_or(WireError::Short)?;
        self.at += N;
        Ok(*bytes)
    }

    /// Skips bytes.
    pub fn skip(&mut self, length: usize) -> Result<(), WireError> {
        self.split_to(length).map(drop)
    }

    /// Splits off a cursor over the next bytes.
    pub fn split_to(&mut self, length: usize) -> Result<Self, WireError> {
        if length > self.remaining() {
            return Err(WireError::Short);
        }
        let begin = self.at;
        self.at += length;
        Ok(Self { whole: self.whole, at: begin, end: self.at, little: self.little })
    }

    /// Returns the remaining bytes.
    pub fn rest(&self) -> &'a [u8] {
        &self.whole[self.at..self.end]
    }

    /// Returns the remaining bytes as a slice of the whole, sharing its memory.
    pub fn to_bytes(&self) -> Bytes {
        self.whole.slice(self.at..self.end)
    }

    pub fn byte(&mut self) -> Result<u8, WireError> {
        self.array().map(|[byte]| byte)
    }

    pub fn u16(&mut self) -> Result<u16, WireError> {
        let bytes = self.array()?;
        Ok(if self.little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
    }

    pub fn u32(&mut self) -> Result<u32, WireError> {
        let bytes = self.array()?;
        Ok(if self.little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    pub fn i32(&mut self) -> Result<i32, WireError> {
        self.u32().map(|number| number as i32)
    }

    pub fn prefix(&mut self) -> Result<GuidPrefix, WireError> {
        self.array().map(GuidPrefix)
    }

    pub fn entity(&mut self) -> Result<EntityId, WireError> {
        self.array().map(EntityId)
    }

    pub fn guid(&mut self) -> Result<Guid, WireError> {
        self.array::<16>().map(Guid::from)
    }

    /// Reads any number, including invalid sequence numbers.
    pub fn number(&mut self) -> Result<SequenceNumber, WireError> {
        let (high, low) = (self.i32()?, self.u32()?);
        Ok(SequenceNumber(i64::from(high) << 32 | i64::from(low)))
    }

    /// Reads a sequence number of at least `least` that is low enough for additions not to overflow.
    pub fn number_at_least(&mut self, least: i64) -> Result<SequenceNumber, WireError> {
        let number = self.number()?;
        if (least..MAX_SEQUENCE_NUMBER).contains(&number.0) { Ok(number) } else { Err(WireError::Number(number.0)) }
    }

    /// Reads the sequence number of a sample.
    pub fn sample_number(&mut self) -> Result<SequenceNumber, WireError> {
        self.number_at_least(1)
    }

    pub fn identity(&mut self) -> Result<SampleIdentity, WireError> {
        Ok(SampleIdentity { writer: self.guid()?, number: self.number()? })
    }

    pub fn duration(&mut self) -> Result<WireDuration, WireError> {
        Ok(WireDuration { seconds: self.i32()?, fraction: self.u32()? })
    }

    pub fn time(&mut self) -> Result<WireTime, WireError> {
        Ok(WireTime { seconds: self.u32()?, fraction: self.u32()? })
    }

    /// Reads a CDR sequence or string of bytes, which is preceded by its length.
    pub fn byte_sequence(&mut self) -> Result<&'a [u8], WireError> {
        let length = self.u32()?;
        let length = usize::try_from(length).map_err(|_| WireError::Short)?;
        self.split_to(length).map(|part| part.rest())
    }
}
