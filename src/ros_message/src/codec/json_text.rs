//! JSON text: what needs escaping, what an escape means, where a value ends.

use crate::codec::cbor_item::MAX_NESTING;
use crate::codec::fault::{CodecError, CodecErrorKind};

const ONES: u64 = u64::MAX / 255;
const HIGHS: u64 = ONES * 0x80;

/// Returns the length of the prefix of printable ASCII other than `"` and `\`, scanning eight bytes at a time.
#[inline]
pub(crate) fn plain_prefix(bytes: &[u8]) -> usize {
    scan::<true>(bytes)
}

/// Like [`plain_prefix`], for text known to be UTF-8: bytes from 0x80 stand for themselves.
#[inline]
fn unescaped_prefix(bytes: &[u8]) -> usize {
    scan::<false>(bytes)
}

#[inline]
fn scan<const ASCII: bool>(bytes: &[u8]) -> usize {
    let mut at = 0;
    while let Some(chunk) = bytes[at..].first_chunk::<8>() {
        let word = u64::from_le_bytes(*chunk);
        // Each term has the high bit set in every byte that matches; above the first match there may be false ones,
        // which do not matter.
        let control = word.wrapping_sub(ONES * 0x20);
        let quote = (word ^ (ONES * u64::from(b'"'))).wrapping_sub(ONES);
        let backslash = (word ^ (ONES * u64::from(b'\\'))).wrapping_sub(ONES);
        let mut found = (control | quote | backslash) & !word & HIGHS;
        if ASCII {
            found |= word & HIGHS;
        }
        if found != 0 {
            return at + (found.trailing_zeros() / 8) as usize;
        }
        at += 8;
    }
    let special = |byte: &u8| *byte < 0x20 || *byte == b'"' || *byte == b'\\' || (ASCII && *byte >= 0x80);
    at + bytes[at..].iter().position(special).unwrap_or(bytes.len() - at)
}

/// Appends text with JSON's escapes, without enclosing quotes.
pub(crate) fn push_escaped(out: &mut Vec<u8>, text: &str) {
    const HEX: &[u8; 16] = b"0123456789abcdef";
    let mut rest = text.as_bytes();
    loop {
        let (plain, special) = rest.split_at(unescaped_prefix(rest));
        out.extend_from_slice(plain);
        let Some((byte, after)) = special.split_first() else {
            return;
        };
        match byte {
            b'"' => out.extend_from_slice(b"\\\""),
            b'\\' => out.extend_from_slice(b"\\\\"),
            b'\n' => out.extend_from_slice(b"\\n"),
            b'\r' => out.extend_from_slice(b"\\r"),
            b'\t' => out.extend_from_slice(b"\\t"),
            _ => {
                out.extend_from_slice(b"\\u00");
                out.extend_from_slice(&[HEX[usize::from(byte >> 4)], HEX[usize::from(byte & 15)]]);
            }
        }
        rest = after;
    }
}

/// Appends the character that the escape at the beginning of `rest` (after its backslash) stands for; returns the
/// number of bytes used, or the error. A lone surrogate becomes U+FFFD.
pub(crate) fn unescape(rest: &[u8], out: &mut Vec<u8>) -> Result<usize, &'static str> {
    let byte = match rest.first() {
        Some(byte @ (b'"' | b'\\' | b'/')) => *byte,
        Some(b'b') => 8,
        Some(b'f') => 12,
        Some(b'n') => b'\n',
        Some(b'r') => b'\r',
        Some(b't') => b'\t',
        Some(b'u') => return unescape_utf16(rest, out),
        _ => return Err("an unknown escape"),
    };
    out.push(byte);
    Ok(1)
}

fn unescape_utf16(rest: &[u8], out: &mut Vec<u8>) -> Result<usize, &'static str> {
    let high = hex4(rest.get(1..5)).ok_or("an escape without four hex digits")?;
    let mut used = 5;
    let mut code = u32::from(high);
    if (0xd800..0xdc00).contains(&high) && rest.get(5..7) == Some(b"\\u") {
        let low = hex4(rest.get(7..11)).ok_or("an escape without four hex digits")?;
        if (0xdc00..0xe000).contains(&low) {
            code = 0x1_0000 + ((u32::from(high) - 0xd800) << 10) + (u32::from(low) - 0xdc00);
            used = 11;
        }
    }
    let character = char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER);
    out.extend_from_slice(character.encode_utf8(&mut [0; 4]).as_bytes());
    Ok(used)
}

fn hex4(digits: Option<&[u8]>) -> Option<u16> {
    digits?.iter().try_fold(0, |value: u16, digit| Some(value << 4 | char::from(*digit).to_digit(16)? as u16))
}

/// Returns the length of the JSON value at the beginning of `input`, including white space before it, without building
/// it: string contents are skipped at memory speed. Brackets must balance and may nest 128 deep; everything else
/// between them is left to the parser of the value.
pub fn json_value_len(input: &[u8]) -> Result<usize, CodecError> {
    let fail = |at, reason| CodecError::from_input(CodecErrorKind::Json { at, reason });
    let mut at = input.iter().position(|byte| !is_space(*byte)).unwrap_or(input.len());
    let mut depth = 0;
    loop {
        match input.get(at) {
            None => return Err(fail(at, "the input ends inside a value")),
            Some(b'"') => at = string_end(input, at).ok_or_else(|| fail(at, "a string without an end"))?,
            Some(b'{' | b'[') => {
                depth += 1;
                at += 1;
                if depth > MAX_NESTING {
                    return Err(CodecError::from_input(CodecErrorKind::TooDeep(MAX_NESTING)));
                }
            }
            Some(b'}' | b']') if depth > 0 => {
                depth -= 1;
                at += 1;
            }
            Some(b'}' | b']' | b',' | b':') if depth == 0 => {
                return Err(fail(at, "expected a value"));
            }
            Some(_) if depth > 0 => at += unstructured_prefix(&input[at..]),
            Some(_) => {
                let ends =
                    |byte: &u8| matches!(byte, b'"' | b'{' | b'}' | b'[' | b']' | b',' | b':') || is_space(*byte);
                let rest = &input[at..];
                at += rest.iter().position(ends).unwrap_or(rest.len());
            }
        }
        if depth == 0 {
            return Ok(at);
        }
    }
}

/// Returns the length of the prefix without quotes, brackets and braces.
#[inline]
fn unstructured_prefix(bytes: &[u8]) -> usize {
    let mut at = 0;
    while let Some(chunk) = bytes[at..].first_chunk::<8>() {
        let word = u64::from_le_bytes(*chunk);
        // A bracket and the corresponding brace differ in one bit.
        let folded = word | (ONES * 0x20);
        let open = (folded ^ (ONES * u64::from(b'{'))).wrapping_sub(ONES);
        let close = (folded ^ (ONES * u64::from(b'}'))).wrapping_sub(ONES);
        let quote = (word ^ (ONES * u64::from(b'"'))).wrapping_sub(ONES);
        let found = (open | close | quote) & !word & HIGHS;
        if found != 0 {
            return at + (found.trailing_zeros() / 8) as usize;
        }
        at += 8;
    }
    let structural = |byte: &u8| matches!(byte, b'"' | b'{' | b'}' | b'[' | b']');
    at + bytes[at..].iter().position(structural).unwrap_or(bytes.len() - at)
}

/// Returns the end of the string that begins at `start` (a quote): the offset after its closing quote.
#[inline]
fn string_end(input: &[u8], start: usize) -> Option<usize> {
    let mut at = start + 1;
    // Most strings are keys: too short to be worth the wide search.
    let near = input[at..].iter().take(16).position(|byte| matches!(byte, b'"' | b'\\'));
    match near {
        Some(near) if input[at + near] == b'"' => return Some(at + near + 1),
        Some(near) => at += near,
        None => {}
    }
    loop {
        at += memchr::memchr2(b'"', b'\\', input.get(at..)?)?;
        match input[at] {
            b'"' => return Some(at + 1),
            _ => at += 2,
        }
    }
}

/// Returns true for JSON white space.
#[inline]
pub(crate) fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\n' | b'\r' | b'\t')
}
