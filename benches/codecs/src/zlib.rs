//! Bindings to zlib itself rather than a port, because it is the codec that most links use.

use libz_sys::{Z_OK, compress2, compressBound, uLong, uncompress as uncompress_c};

/// Compresses `message` into one zlib stream.
pub fn compress(message: &[u8], level: i32) -> Vec<u8> {
    // SAFETY: a pure function of a number.
    let bound = unsafe { compressBound(message.len() as uLong) };
    let mut out = vec![0u8; bound as usize];
    let mut length = bound;
    // SAFETY: both buffers are valid for the lengths given, and `length` is the output's capacity.
    let status = unsafe { compress2(out.as_mut_ptr(), &mut length, message.as_ptr(), message.len() as uLong, level) };
    assert_eq!(status, Z_OK, "zlib compresses into its own bound");
    out.truncate(length as usize);
    out
}

/// Decompresses into `out`, which must be large enough; returns the length of the message.
pub fn uncompress(stream: &[u8], out: &mut [u8]) -> usize {
    let mut length = out.len() as uLong;
    // SAFETY: both buffers are valid for the lengths given, and `length` is the output's capacity.
    let status = unsafe { uncompress_c(out.as_mut_ptr(), &mut length, stream.as_ptr(), stream.len() as uLong) };
    assert_eq!(status, Z_OK, "zlib reads its own stream");
    length as usize
}
