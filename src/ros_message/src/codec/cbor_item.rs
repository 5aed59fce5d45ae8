//! CBOR item heads, and the length of an item.

use crate::cbor_head::{ARRAY, BYTES, MAP, SIMPLE, TAG, TEXT};
use crate::codec::fault::{CodecError, CodecErrorKind};

/// Maximum nesting where no message type limits it.
pub(crate) const MAX_NESTING: usize = 128;

/// The head of an item.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ItemHead {
    /// Major type, shifted into place.
    pub(crate) major: u8,
    /// Additional information (low five bits): 24 to 27 give the width of `value`, 31 an indefinite length.
    pub(crate) info: u8,
    /// Number, length, count or tag; for a float, its bits.
    pub(crate) value: u64,
    /// Size of the head in bytes.
    pub(crate) size: usize,
}

/// `info` of an item of indefinite length, and of the break that ends it.
pub(crate) const INDEFINITE: u8 = 31;

impl ItemHead {
    /// Reads the head at the beginning of `input`.
    #[inline]
    pub(crate) fn read(input: &[u8]) -> Result<ItemHead, &'static str> {
        let Some((&first, rest)) = input.split_first() else {
            return Err("the input ends here");
        };
        let (major, info) = (first & 0xe0, first & 0x1f);
        let (value, width) = match info {
            0..=23 => (Some(u64::from(info)), 0),
            24 => (rest.first_chunk().map(|bytes| u8::from_be_bytes(*bytes).into()), 1),
            25 => (rest.first_chunk().map(|bytes| u16::from_be_bytes(*bytes).into()), 2),
            26 => (rest.first_chunk().map(|bytes| u32::from_be_bytes(*bytes).into()), 4),
            27 => (rest.first_chunk().map(|bytes| u64::from_be_bytes(*bytes)), 8),
            INDEFINITE if matches!(major, BYTES | TEXT | ARRAY | MAP | SIMPLE) => (Some(0), 0),
            _ => return Err("a reserved head"),
        };
        let value = value.ok_or("the input ends here")?;
        Ok(ItemHead { major, info, value, size: 1 + width })
    }

    pub(crate) fn is_break(self) -> bool {
        self.major == SIMPLE && self.info == INDEFINITE
    }
}

/// Returns the length of the CBOR item at the beginning of `input`, without building it. Items may nest 128 deep.
pub fn cbor_item_len(input: &[u8]) -> Result<usize, CodecError> {
    let fail = |at, reason| CodecError::from_input(CodecErrorKind::Cbor { at, reason });
    // Remaining items at each level; `None` if they end with a break.
    let mut open: Vec<OpenItem> = Vec::new();
    let mut at = 0;
    loop {
        let head = ItemHead::read(&input[at..]).map_err(|reason| fail(at, reason))?;
        let indefinite = head.info == INDEFINITE;
        let chunk_of = open.last().and_then(|level| level.chunks);
        if chunk_of.is_some_and(|major| !head.is_break() && (head.major != major || indefinite)) {
            return Err(fail(at, "a string's chunk is of another type"));
        }
        let start = at;
        at += head.size;
        let opened = match head.major {
            _ if head.is_break() => {
                let ended = open.pop();
                if !ended.is_some_and(|level| level.left.is_none() && !(level.map && level.odd)) {
                    return Err(fail(start, "a break where nothing is to be ended"));
                }
                None
            }
            BYTES | TEXT if indefinite => {
                Some(OpenItem { left: None, chunks: Some(head.major), ..OpenItem::default() })
            }
            BYTES | TEXT => {
                let length = usize::try_from(head.value).unwrap_or(usize::MAX);
                if length > input.len() - at {
                    return Err(fail(start, "a string longer than the input"));
                }
                at += length;
                None
            }
            ARRAY | MAP if indefinite => Some(OpenItem { left: None, map: head.major == MAP, ..OpenItem::default() }),
            ARRAY => Some(OpenItem { left: Some(head.value), ..OpenItem::default() }),
            MAP => Some(OpenItem { left: Some(head.value.saturating_mul(2)), ..OpenItem::default() }),
            TAG => Some(OpenItem { left: Some(1), ..OpenItem::default() }),
            _ => None,
        };
        if let Some(level) = opened {
            if open.len() >= MAX_NESTING {
                return Err(CodecError::from_input(CodecErrorKind::TooDeep(MAX_NESTING)));
            }
            open.push(level);
            if level.left != Some(0) {
                continue;
            }
            open.pop();
        }
        if close_complete(&mut open) {
            return Ok(at);
        }
    }
}

/// A nesting level.
#[derive(Debug, Clone, Copy, Default)]
struct OpenItem {
    /// Number of remaining items; `None` if they end with a break.
    left: Option<u64>,
    /// Major type required of the chunks of a string.
    chunks: Option<u8>,
    /// True for a map of indefinite length.
    map: bool,
    /// True between a key and its value.
    odd: bool,
}

/// Counts an item that just ended, and the containers that end with it; returns true when nothing is open any more.
fn close_complete(open: &mut Vec<OpenItem>) -> bool {
    loop {
        let Some(level) = open.last_mut() else {
            return true;
        };
        match &mut level.left {
            None => {
                level.odd = !level.odd;
                return false;
            }
            Some(left) => {
                *left -= 1;
                if *left > 0 {
                    return false;
                }
                open.pop();
            }
        }
    }
}
