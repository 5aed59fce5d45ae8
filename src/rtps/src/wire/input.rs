//! Bytes that are read from front to back, in the byte order that they say.

use bytes::Bytes;

use super::WireError;
use crate::time::{WireDuration, WireTime};
use crate::{EntityId, Guid, GuidPrefix, SampleIdentity, SequenceNumber};

/// No writer comes to this number: at a thousand million samples a second it takes 146 years.
const MOST: i64 = 1 << 62;

/// A part of some bytes of which what is in front has been read.
#[derive(Debug, Clone)]
pub(crate) struct Input<'a> {
    whole: &'a Bytes,
    /// At most `end`.
    at: usize,
    /// At most the length of `whole`.
    end: usize,
    /// The least significant byte of a number is its first.
    pub little: bool,
}

impl<'a> Input<'a> {
    /// All of these.
    pub fn new(whole: &'a Bytes, little: bool) -> Self {
        Self {
            whole,
            at: 0,
            end: whole.len(),
            little,
        }
    }

    /// How many bytes are left.
    pub fn left(&self) -> usize {
        self.end - self.at
    }

    /// How many bytes of the whole are before what is left.
    pub fn position(&self) -> usize {
        self.at
    }

    /// The next ones.
    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        let bytes = self.whole[self.at..self.end]
            .first_chunk()
            .ok_or(WireError::Short)?;
        self.at += N;
        Ok(*bytes)
    }

    /// Passes over so many.
    pub fn skip(&mut self, length: usize) -> Result<(), WireError> {
        self.part(length).map(drop)
    }

    /// The next ones, to be read by themselves.
    pub fn part(&mut self, length: usize) -> Result<Self, WireError> {
        if length > self.left() {
            return Err(WireError::Short);
        }
        let begin = self.at;
        self.at += length;
        Ok(Self {
            whole: self.whole,
            at: begin,
            end: self.at,
            little: self.little,
        })
    }

    /// The rest, as it is.
    pub fn rest(&self) -> &'a [u8] {
        &self.whole[self.at..self.end]
    }

    /// The rest as a slice of the whole.
    pub fn shared(&self) -> Bytes {
        self.whole.slice(self.at..self.end)
    }

    pub fn byte(&mut self) -> Result<u8, WireError> {
        self.array().map(|[byte]| byte)
    }

    pub fn u16(&mut self) -> Result<u16, WireError> {
        let bytes = self.array()?;
        Ok(if self.little {
            u16::from_le_bytes(bytes)
        } else {
            u16::from_be_bytes(bytes)
        })
    }

    pub fn u32(&mut self) -> Result<u32, WireError> {
        let bytes = self.array()?;
        Ok(if self.little {
            u32::from_le_bytes(bytes)
        } else {
            u32::from_be_bytes(bytes)
        })
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

    /// Any number, also one that no sample has.
    pub fn number(&mut self) -> Result<SequenceNumber, WireError> {
        let (high, low) = (self.i32()?, self.u32()?);
        Ok(SequenceNumber(i64::from(high) << 32 | i64::from(low)))
    }

    /// The number of a sample, or one beside: at least `least`, and so far from the largest that sums do not overflow.
    pub fn number_from(&mut self, least: i64) -> Result<SequenceNumber, WireError> {
        let number = self.number()?;
        if (least..MOST).contains(&number.0) {
            Ok(number)
        } else {
            Err(WireError::Number(number.0))
        }
    }

    /// The number of a sample.
    pub fn sample(&mut self) -> Result<SequenceNumber, WireError> {
        self.number_from(1)
    }

    pub fn identity(&mut self) -> Result<SampleIdentity, WireError> {
        Ok(SampleIdentity {
            writer: self.guid()?,
            number: self.number()?,
        })
    }

    pub fn duration(&mut self) -> Result<WireDuration, WireError> {
        Ok(WireDuration {
            seconds: self.i32()?,
            fraction: self.u32()?,
        })
    }

    pub fn time(&mut self) -> Result<WireTime, WireError> {
        Ok(WireTime {
            seconds: self.u32()?,
            fraction: self.u32()?,
        })
    }

    /// Bytes with their number before them, of a sequence or string of CDR.
    pub fn counted(&mut self) -> Result<&'a [u8], WireError> {
        let length = self.u32()?;
        let length = usize::try_from(length).map_err(|_| WireError::Short)?;
        self.part(length).map(|part| part.rest())
    }
}
