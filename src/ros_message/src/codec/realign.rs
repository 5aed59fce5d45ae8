//! Copies a CDR value to an offset with other padding, for fields that arrived in another order than in the definition.

use crate::codec::cdr::WIDE;
use crate::schema::plan::{Count, Kind, Scalar};

/// Copies values out of bytes that this crate has just written, so that their lengths are known to be correct; should
/// one be wrong, the missing bytes are left out.
pub(crate) struct Realign<'a> {
    /// Source bytes, beginning at a multiple of 8 of their body.
    pub(crate) from: &'a [u8],
    /// Offset of the next value, or of its padding, in `from`.
    pub(crate) at: usize,
    pub(crate) out: &'a mut Vec<u8>,
    /// Offset of the body in `out`.
    pub(crate) origin: usize,
}

impl Realign<'_> {
    pub(crate) fn value(&mut self, kind: &Kind) {
        match kind {
            Kind::Scalar(scalar) => self.copy(scalar.size(), scalar.alignment()),
            Kind::Text(text) => {
                let length = self.length(Count::Variable);
                self.copy(length * if text.wide { WIDE } else { 1 }, 1);
            }
            Kind::Bytes(count) => {
                let length = self.length(*count);
                self.copy(length, 1);
            }
            Kind::Scalars(scalar, count) => {
                let length = self.length(*count);
                if length > 0 {
                    self.copy(length * scalar.size(), scalar.alignment());
                }
            }
            Kind::Texts(text, count) => {
                for _ in 0..self.length(*count) {
                    self.value(&Kind::Text(*text));
                }
            }
            Kind::Struct(message) => {
                for member in message.plan.members.list() {
                    self.value(&member.kind);
                }
                if message.plan.placeholder {
                    self.copy(1, 1);
                }
            }
            Kind::Structs(message, count) => {
                let one = Kind::Struct(message.clone());
                for _ in 0..self.length(*count) {
                    self.value(&one);
                }
            }
        }
    }

    fn copy(&mut self, size: usize, alignment: usize) {
        let begin = self.at.next_multiple_of(alignment);
        let length = self.out.len() - self.origin;
        let padding = length.next_multiple_of(alignment) - length;
        self.out.extend_from_slice(&[0; 8][..padding]);
        self.at = begin + size;
        let bytes = self.from.get(begin..self.at).unwrap_or_default();
        self.out.extend_from_slice(bytes);
    }

    fn length(&mut self, count: Count) -> usize {
        if let Count::Fixed(length) = count {
            return length;
        }
        self.copy(Scalar::U32.size(), Scalar::U32.alignment());
        let length = self.out.last_chunk().copied().unwrap_or_default();
        u32::from_le_bytes(length) as usize
    }
}
