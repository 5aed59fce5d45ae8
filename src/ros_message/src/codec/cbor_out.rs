//! ROS bytes → CBOR (RFC 8949), with numeric arrays as typed arrays (RFC 8746).

use crate::cbor_head::{ARRAY, BYTES, MAP, NEGATIVE, SIMPLE, TAG, TEXT, UNSIGNED, write_head};
use crate::codec::fault::{CodecErrorKind, Fault};
use crate::codec::typed_array::little_endian_tag;
use crate::codec::walk::{OutputFormat, walk};
use crate::codec::{CborOptions, InvalidUtf8};
use crate::schema::MessageType;
use crate::schema::plan::{CodecPlan, Literal, Scalar};

/// Appends the message as a CBOR map.
pub(crate) fn write(
    message: &MessageType,
    bytes: &[u8],
    out: &mut Vec<u8>,
    options: &CborOptions,
) -> Result<(), Fault> {
    let end = out.len().saturating_add(options.max_bytes);
    walk(message, bytes, &mut Cbor { out, options, end })
}

struct Cbor<'a> {
    out: &'a mut Vec<u8>,
    options: &'a CborOptions,
    /// Maximum length of the output buffer.
    end: usize,
}

impl OutputFormat for Cbor<'_> {
    #[inline]
    fn literal(&mut self, plan: &CodecPlan, literal: &Literal) {
        plan.push_cbor(literal, self.out);
    }

    #[inline]
    fn scalar(&mut self, scalar: Scalar, bytes: &[u8]) {
        match scalar {
            Scalar::Bool => self.out.push(SIMPLE | if bytes[0] == 0 { 20 } else { 21 }),
            Scalar::U8 | Scalar::U16 | Scalar::U32 | Scalar::U64 => {
                write_head(self.out, UNSIGNED, read_unsigned(bytes))
            }
            Scalar::I8 | Scalar::I16 | Scalar::I32 | Scalar::I64 => self.integer(read_signed(bytes)),
            Scalar::F32 => self.float::<4, 5>(26, bytes),
            Scalar::F64 => self.float::<8, 9>(27, bytes),
            Scalar::Time => self.time([b"\x64secs", b"\x65nsecs"], [Scalar::U32; 2], bytes),
            Scalar::Duration => self.time([b"\x64secs", b"\x65nsecs"], [Scalar::I32; 2], bytes),
            Scalar::Time2 | Scalar::Duration2 => {
                self.time([b"\x63sec", b"\x67nanosec"], [Scalar::I32, Scalar::U32], bytes)
            }
        }
    }

    fn text(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        let text = match (std::str::from_utf8(bytes), self.options.invalid_utf8) {
            (Ok(text), _) => text,
            (Err(_), InvalidUtf8::Replace) => &*String::from_utf8_lossy(bytes),
            (Err(_), InvalidUtf8::Refuse) => return Err(CodecErrorKind::InvalidUtf8.into()),
        };
        write_head(self.out, TEXT, text.len() as u64);
        self.out.extend_from_slice(text.as_bytes());
        Ok(())
    }

    fn bytes(&mut self, bytes: &[u8]) {
        write_head(self.out, BYTES, bytes.len() as u64);
        self.out.extend_from_slice(bytes);
    }

    fn scalars(&mut self, scalar: Scalar, bytes: &[u8]) {
        match little_endian_tag(scalar) {
            Some(tag) if self.options.typed_arrays => {
                write_head(self.out, TAG, tag);
                self.bytes(bytes);
            }
            _ => {
                self.begin_array(bytes.len() / scalar.size());
                for element in bytes.chunks_exact(scalar.size()) {
                    self.scalar(scalar, element);
                }
            }
        }
    }

    fn begin_array(&mut self, count: usize) {
        write_head(self.out, ARRAY, count as u64);
    }

    fn element(&mut self, _: usize) {}

    fn end_array(&mut self) {}

    #[inline]
    fn check_room(&self, more: usize) -> Result<(), Fault> {
        if self.out.len().saturating_add(more) <= self.end {
            return Ok(());
        }
        Err(CodecErrorKind::TooLarge(self.options.max_bytes).into())
    }
}

impl Cbor<'_> {
    fn integer(&mut self, value: i64) {
        match u64::try_from(value) {
            Ok(value) => write_head(self.out, UNSIGNED, value),
            // CBOR stores -1 - n, which is the complement of n.
            Err(_) => write_head(self.out, NEGATIVE, !value as u64),
        }
    }

    fn time(&mut self, names: [&[u8]; 2], parts: [Scalar; 2], bytes: &[u8]) {
        write_head(self.out, MAP, 2);
        for (index, (name, part)) in names.into_iter().zip(parts).enumerate() {
            self.out.extend_from_slice(name);
            self.scalar(part, &bytes[4 * index..][..4]);
        }
    }

    /// `ITEM` is `WIDTH` + 1.
    #[inline]
    fn float<const WIDTH: usize, const ITEM: usize>(&mut self, info: u8, bytes: &[u8]) {
        let mut item = [SIMPLE | info; ITEM];
        item[1..].copy_from_slice(&bytes[..WIDTH]);
        item[1..].reverse();
        self.out.extend_from_slice(&item);
    }
}

/// Reads up to eight little-endian bytes as an unsigned integer.
#[inline]
fn read_unsigned(bytes: &[u8]) -> u64 {
    let mut wide = [0; 8];
    wide[..bytes.len()].copy_from_slice(bytes);
    u64::from_le_bytes(wide)
}

/// Reads up to eight little-endian bytes as a signed integer, with sign extension.
#[inline]
fn read_signed(bytes: &[u8]) -> i64 {
    let unused = 64 - 8 * bytes.len() as u32;
    ((read_unsigned(bytes) << unused) as i64) >> unused
}
