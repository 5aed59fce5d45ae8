//! Generic codecs: zlib (RFC 1950), deflate (RFC 1951), zstd (RFC 8878).
//!
//! All of them restore exactly the declared number of bytes or fail; none allocates more.

use crate::Error;
use flate2::{Compress, Compression, Decompress, FlushCompress, FlushDecompress, Status};

/// Compresses `message` to a zlib stream (`header`) or to bare deflate data.
pub(crate) fn deflate(message: &[u8], level: u32, header: bool, out: &mut Vec<u8>) {
    let mut stream = Compress::new(Compression::new(level.min(9)), header);
    loop {
        let done = stream.total_in() as usize;
        out.reserve((message.len() - done) / 2 + 64);
        match stream.compress_vec(&message[done..], out, FlushCompress::Finish) {
            Ok(Status::StreamEnd) => return,
            Ok(_) => {}
            Err(error) => unreachable!("deflate refuses no input: {error}"),
        }
    }
}

/// Decompresses exactly `length` bytes and appends them to `out`.
pub(crate) fn inflate(data: &[u8], length: usize, header: bool, out: &mut Vec<u8>) -> Result<(), Error> {
    const BAD: Error = Error::Corrupt("a deflate stream that does not hold what it declares");
    let mut stream = Decompress::new(header);
    let first = out.len();
    // Maximum output of a stream of this size; the declared length may be wrong.
    let possible = data.len().saturating_mul(1032).saturating_add(64);
    if length > possible {
        return Err(BAD);
    }
    out.reserve_exact(length + 1);
    loop {
        let before = (stream.total_in(), stream.total_out());
        let status =
            stream.decompress_vec(&data[before.0 as usize..], out, FlushDecompress::Finish).map_err(|_| BAD)?;
        if status == Status::StreamEnd {
            break;
        }
        if out.len() - first > length || before == (stream.total_in(), stream.total_out()) {
            return Err(BAD);
        }
    }
    if out.len() - first == length && stream.total_in() as usize == data.len() { Ok(()) } else { Err(BAD) }
}

/// A zstd context that is reused: setting one up costs more than a small message.
#[derive(Default)]
pub(crate) struct ZstdCompressor {
    context: Option<(i32, zstd::bulk::Compressor<'static>)>,
}

impl ZstdCompressor {
    /// Appends `message` compressed at `level` to `out`.
    pub(crate) fn compress(&mut self, message: &[u8], level: i32, out: &mut Vec<u8>) {
        if self.context.as_ref().is_none_or(|(current, _)| *current != level) {
            match zstd::bulk::Compressor::new(level) {
                Ok(compressor) => self.context = Some((level, compressor)),
                Err(error) => {
                    unreachable!("zstd clamps levels, and memory is checked elsewhere: {error}")
                }
            }
        }
        let Some((_, compressor)) = &mut self.context else { unreachable!("set above") };
        let first = out.len();
        out.resize(first + zstd::zstd_safe::compress_bound(message.len()), 0);
        match compressor.compress_to_buffer(message, &mut out[first..]) {
            Ok(written) => out.truncate(first + written),
            Err(error) => unreachable!("the buffer has zstd's own bound: {error}"),
        }
    }
}

impl std::fmt::Debug for ZstdCompressor {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Zstd").finish_non_exhaustive()
    }
}

/// Decompresses exactly `length` bytes and appends them to `out`.
pub(crate) fn unzstd(data: &[u8], length: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    const BAD: Error = Error::Corrupt("a zstd frame that does not hold what it declares");
    // Our frames declare their size; check it before allocating for a false one.
    match zstd::zstd_safe::get_frame_content_size(data) {
        Ok(Some(told)) if told == length as u64 => {}
        _ => return Err(BAD),
    }
    let first = out.len();
    out.resize(first + length, 0);
    let written = zstd::bulk::decompress_to_buffer(data, &mut out[first..]).map_err(|_| BAD)?;
    if written == length { Ok(()) } else { Err(BAD) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_come_back() {
        for message in [&b""[..], b"a", &[7; 100_000], &(0..=255).collect::<Vec<u8>>()] {
            for header in [false, true] {
                let mut frame = Vec::new();
                deflate(message, 6, header, &mut frame);
                let mut back = b"before".to_vec();
                inflate(&frame, message.len(), header, &mut back).unwrap();
                assert_eq!(back, [b"before", message].concat());
                assert!(inflate(&frame, message.len() + 1, header, &mut Vec::new()).is_err());
                if !message.is_empty() {
                    assert!(inflate(&frame, message.len() - 1, header, &mut Vec::new()).is_err());
                }
            }
            let mut frame = Vec::new();
            ZstdCompressor::default().compress(message, 3, &mut frame);
            let mut back = b"before".to_vec();
            unzstd(&frame, message.len(), &mut back).unwrap();
            assert_eq!(back, [b"before", message].concat());
            assert!(unzstd(&frame, message.len() + 1, &mut Vec::new()).is_err());
        }
    }

    #[test]
    fn a_bomb_is_refused_before_it_unfolds() {
        let mut frame = Vec::new();
        deflate(&vec![0; 1 << 20], 9, true, &mut frame);
        let mut back = Vec::new();
        assert!(inflate(&frame, 1000, true, &mut back).is_err());
        assert!(back.capacity() < 4096);
        assert!(inflate(&[1, 2, 3], usize::MAX, true, &mut back).is_err());
    }
}
