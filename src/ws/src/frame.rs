//! WebSocket frames (RFC 6455, section 5): headers and masks.

use super::WsError;

/// Opcode of a frame that continues the message of the previous one.
pub const CONTINUATION: u8 = 0;
/// Opcode of a text message (UTF-8).
pub const TEXT: u8 = 1;
/// Opcode of a binary message.
pub const BINARY: u8 = 2;
/// Opcode of a close frame, which carries a code and a reason.
pub const CLOSE: u8 = 8;
/// Opcode of a ping.
pub const PING: u8 = 9;
/// Opcode of a pong, the answer to a ping.
pub const PONG: u8 = 10;

/// Largest payload of a control frame, in bytes.
pub const MAX_CONTROL: usize = 125;

/// Header of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// Set on the last frame of a message.
    pub last: bool,
    /// The opcode (RFC 6455, 5.2).
    pub opcode: u8,
    /// Mask of the payload. Clients mask their frames, servers do not.
    pub mask: Option<[u8; 4]>,
    /// Length of the payload in bytes.
    pub length: u64,
}

impl Header {
    /// Parses a header at the beginning of `bytes` and returns it with its own length; `None` while it is incomplete.
    pub fn parse(bytes: &[u8]) -> Result<Option<(Header, usize)>, WsError> {
        let [first, second, rest @ ..] = bytes else {
            return Ok(None);
        };
        if first & 0x70 != 0 {
            return Err(WsError::protocol("reserved bits are set, no extension was agreed upon"));
        }
        let opcode = first & 0x0f;
        let last = first & 0x80 != 0;
        let short = second & 0x7f;
        let width = match short {
            126 => 2,
            127 => 8,
            _ => 0,
        };
        let masked = second & 0x80 != 0;
        let size = 2 + width + if masked { 4 } else { 0 };
        if bytes.len() < size {
            return Ok(None);
        }
        let length = match width {
            0 => u64::from(short),
            _ => rest[..width].iter().fold(0, |sum, &byte| (sum << 8) | u64::from(byte)),
        };
        match opcode {
            CONTINUATION | TEXT | BINARY => {}
            CLOSE | PING | PONG if last && length <= MAX_CONTROL as u64 => {}
            CLOSE | PING | PONG => {
                return Err(WsError::protocol("a control frame is long or in parts"));
            }
            _ => return Err(WsError::protocol("a reserved opcode is used")),
        }
        let mask = masked.then(|| [rest[width], rest[width + 1], rest[width + 2], rest[width + 3]]);
        Ok(Some((Header { last, opcode, mask, length }, size)))
    }

    /// Appends the header of an unfragmented frame, with its mask if there is one.
    pub fn write(out: &mut bytes::BytesMut, opcode: u8, length: usize, mask: Option<[u8; 4]>) {
        let masked = if mask.is_some() { 0x80 } else { 0 };
        out.extend_from_slice(&[0x80 | opcode]);
        match length {
            0..=125 => out.extend_from_slice(&[masked | length as u8]),
            126..=0xffff => {
                out.extend_from_slice(&[masked | 126]);
                out.extend_from_slice(&(length as u16).to_be_bytes());
            }
            _ => {
                out.extend_from_slice(&[masked | 127]);
                out.extend_from_slice(&(length as u64).to_be_bytes());
            }
        }
        out.extend_from_slice(mask.as_ref().map_or(&[], |mask| mask.as_slice()));
    }
}

/// Removes a client's mask from a payload, or applies it.
pub fn unmask(payload: &mut [u8], mask: [u8; 4]) {
    // As long as the widest vector registers: the compiler emits one instruction for each block.
    let wide: [u8; 64] = std::array::from_fn(|at| mask[at % 4]);
    let mut blocks = payload.chunks_exact_mut(64);
    for block in &mut blocks {
        for (byte, key) in block.iter_mut().zip(&wide) {
            *byte ^= key;
        }
    }
    for (byte, key) in blocks.into_remainder().iter_mut().zip(&wide) {
        *byte ^= key;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_are_read_in_every_width() {
        let header = |bytes: &[u8]| Header::parse(bytes).unwrap();
        assert_eq!(header(&[0x81]), None);
        assert_eq!(
            header(&[0x81, 0x85, 1, 2, 3, 4]),
            Some((Header { last: true, opcode: TEXT, mask: Some([1, 2, 3, 4]), length: 5 }, 6))
        );
        assert_eq!(header(&[0x81, 0xfe, 1]), None);
        assert_eq!(
            header(&[0x02, 0x7e, 1, 0]).map(|(header, size)| (header.length, header.last, size)),
            Some((256, false, 4))
        );
        assert_eq!(header(&[0x82, 0x7f, 0, 0, 0, 0, 0, 1, 0, 0]).map(|(header, _)| header.length), Some(65536));
        for length in [0, 125, 126, 65535, 65536] {
            let mut out = bytes::BytesMut::new();
            Header::write(&mut out, BINARY, length, None);
            let (header, size) = header(&out).unwrap();
            assert_eq!((header.length, size), (length as u64, out.len()));
        }
    }

    #[test]
    fn what_the_protocol_forbids_is_refused() {
        for first in [0xc1, 0x83, 0x09, 0x8b] {
            assert!(Header::parse(&[first, 0x80, 0, 0, 0, 0]).is_err(), "{first:x}");
        }
        assert!(Header::parse(&[0x89, 0x7e, 0, 126]).is_err());
    }

    #[test]
    fn masks_come_off_at_every_length() {
        for length in (0..70).chain([127, 128, 200]) {
            let clear: Vec<u8> = (0..length).collect();
            let mut bytes: Vec<u8> = clear.iter().enumerate().map(|(at, byte)| byte ^ [9, 8, 7, 6][at % 4]).collect();
            unmask(&mut bytes, [9, 8, 7, 6]);
            assert_eq!(bytes, clear);
        }
    }
}
