//! Checks streams before the video library reads them: only those of the kind our encoder makes, of the declared size.
//!
//! A sequence parameter set (H.264, 7.3.2.1.1) declares the picture's size, and the library allocates memory for it. So
//! it is read here first.

use crate::Error;
use crate::entropy::bits::BitReader;

const BAD: Error = Error::Corrupt("an H.264 stream of another kind than ours");

/// Checks every unit of an Annex B stream against a picture of `width`×`height` pixels.
pub(super) fn check(stream: &[u8], width: usize, height: usize) -> Result<(), Error> {
    let mut rest = stream.strip_prefix(&[0, 0, 0, 1]).ok_or(BAD)?;
    loop {
        let end = rest.windows(3).position(|bytes| bytes == [0, 0, 1]).unwrap_or(rest.len());
        let unit = &rest[..end];
        match unit.first().ok_or(BAD)? & 0x1f {
            // Slices; picture parameter sets.
            1 | 5 | 8 => {}
            7 if picture_size(&unit[1..]).ok_or(BAD)? == (width.div_ceil(16), height.div_ceil(16)) => {}
            _ => return Err(BAD),
        }
        match rest.get(end + 3..) {
            Some(next) if !next.is_empty() => rest = next,
            Some(_) => return Err(BAD),
            None => return Ok(()),
        }
    }
}

/// Reads bits, most significant first, as in H.264.
struct MsbBitReader<'a>(BitReader<'a>, u32, u32);

impl MsbBitReader<'_> {
    fn bit(&mut self) -> u32 {
        if self.2 == 0 {
            self.1 = self.0.take(8);
            self.2 = 8;
        }
        self.2 -= 1;
        (self.1 >> self.2) & 1
    }

    fn bits(&mut self, count: u32) -> u32 {
        (0..count).fold(0, |value, _| value << 1 | self.bit())
    }

    /// Reads an Exp-Golomb number of at most 16 bits: our sets need no more.
    fn exp_golomb(&mut self) -> Option<u32> {
        let mut length = 0;
        while self.bit() == 0 {
            length += 1;
            if length > 16 {
                return None;
            }
        }
        Some((1 << length) - 1 + self.bits(length))
    }
}

/// Returns the width and height in macroblocks of a baseline sequence parameter set with few reference pictures.
fn picture_size(set: &[u8]) -> Option<(usize, usize)> {
    let mut plain = Vec::with_capacity(set.len());
    for &byte in set {
        // A three after two zeros only prevents false start codes.
        if byte != 3 || !plain.ends_with(&[0, 0]) {
            plain.push(byte);
        }
    }
    let mut bits = MsbBitReader(BitReader::new(&plain), 0, 0);
    if bits.bits(8) != 66 {
        return None;
    }
    bits.bits(16);
    // The set's id; the size of the frame number.
    (bits.exp_golomb()? < 32).then_some(())?;
    (bits.exp_golomb()? <= 12).then_some(())?;
    // The picture order count type; ours is 0 or 2.
    match bits.exp_golomb()? {
        0 => {
            (bits.exp_golomb()? <= 12).then_some(())?;
        }
        2 => {}
        _ => return None,
    }
    let references = bits.exp_golomb()?;
    bits.bit();
    let (width, height) = (bits.exp_golomb()? + 1, bits.exp_golomb()? + 1);
    // Frames only, no fields.
    (bits.bit() == 1 && references <= 4 && !bits.0.has_overrun()).then_some((width as usize, height as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a baseline set of 48×36 macroblocks with one reference picture.
    fn set() -> Vec<u8> {
        let mut text = String::from("01000010" /* 66 */);
        text.push_str("0000000000011110");
        text.push('1'); // set 0
        text.push_str("011"); // 2: frame number
        text.push_str("011"); // 2: order
        text.push_str("010"); // 1 reference
        text.push('0');
        text.push_str("00000110000"); // 47
        text.push_str("00000100100"); // 35
        text.push_str("11");
        while text.len() % 8 != 0 {
            text.push('0');
        }
        text.as_bytes().chunks(8).map(|bits| bits.iter().fold(0, |byte, &bit| byte << 1 | (bit & 1))).collect()
    }

    fn stream(units: &[&[u8]]) -> Vec<u8> {
        units.iter().flat_map(|unit| [&[0, 0, 0, 1], *unit].concat()).collect()
    }

    #[test]
    fn only_the_declared_size_passes() {
        let set = [&[0x67], &set()[..]].concat();
        let whole = stream(&[&set, &[0x68, 1], &[0x65, 1, 2, 3]]);
        check(&whole, 768, 576).unwrap();
        check(&whole, 767, 561).unwrap();
        assert_eq!(check(&whole, 769, 576), Err(BAD));
        assert_eq!(check(&whole, 768, 592), Err(BAD));
    }

    #[test]
    fn other_units_do_not_pass() {
        assert_eq!(check(&stream(&[&[0x6f, 0]]), 16, 16), Err(BAD));
        assert_eq!(check(&stream(&[&[]]), 16, 16), Err(BAD));
        assert_eq!(check(&[1, 2, 3], 16, 16), Err(BAD));
        assert_eq!(check(&stream(&[&[0x67, 66]]), 16, 16), Err(BAD));
        assert_eq!(check(&stream(&[&[0x67, 100, 0, 0, 0xff, 0xff]]), 16, 16), Err(BAD));
        check(&stream(&[&[0x41, 9, 9]]), 16, 16).unwrap();
    }
}
