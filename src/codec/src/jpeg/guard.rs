//! Checks a stream before the JPEG library reads it: only features that our encoder uses, and only a picture of exactly
//! the declared size, because the library allocates memory for the size in the stream.

use crate::Error;
use crate::wire::FrameCursor;

const START: u8 = 0xd8;
const END: u8 = 0xd9;
const FRAME: u8 = 0xc0;
const HUFFMAN: u8 = 0xc4;
const QUANTISERS: u8 = 0xdb;
const SCAN: u8 = 0xda;
const JFIF: u8 = 0xe0;

const BAD: Error = Error::Corrupt("a JPEG that our encoder does not write");

/// Fails unless `stream` is one baseline picture of `width` by `height` pixels with `colours` components in one scan.
pub(super) fn check(stream: &[u8], width: usize, height: usize, colours: usize) -> Result<(), Error> {
    let mut input = FrameCursor::new(stream);
    if input.take(2)? != [0xff, START] {
        return Err(BAD);
    }
    let mut framed = false;
    loop {
        let &[0xff, marker] = input.take(2)? else {
            return Err(BAD);
        };
        let length = read_u16_be(input.take(2)?);
        let segment = input.take(length.checked_sub(2).ok_or(BAD)?)?;
        match marker {
            JFIF | HUFFMAN | QUANTISERS => {}
            FRAME if !framed => {
                framed = true;
                let [8, size @ ..] = segment else {
                    return Err(BAD);
                };
                let told = size.len() == 5 + 3 * colours
                    && read_u16_be(&size[..2]) == height
                    && read_u16_be(&size[2..4]) == width
                    && usize::from(size[4]) == colours;
                if !told {
                    return Err(Error::Corrupt("a JPEG of another size than declared"));
                }
            }
            SCAN if framed => {
                if segment.first().copied().map(usize::from) != Some(colours) {
                    return Err(BAD);
                }
                return check_scan(input.take_rest());
            }
            _ => return Err(BAD),
        }
    }
}

/// Checks the rest of a picture: its samples and its end marker.
fn check_scan(samples: &[u8]) -> Result<(), Error> {
    let (samples, end) = samples.split_last_chunk::<2>().ok_or(BAD)?;
    let mut bytes = samples.iter();
    // Stuffed bytes look like markers and are none.
    while let Some(&byte) = bytes.next() {
        if byte == 0xff && bytes.next() != Some(&0) {
            return Err(BAD);
        }
    }
    if *end == [0xff, END] { Ok(()) } else { Err(BAD) }
}

/// Reads two bytes, big endian.
fn read_u16_be(bytes: &[u8]) -> usize {
    usize::from(bytes[0]) << 8 | usize::from(bytes[1])
}
