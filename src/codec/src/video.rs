//! Colour pictures as H.264: lossy, so only where the robot's configuration allows it.

use crate::Error;
use crate::layout::Image;
use crate::wire::Cursor;

/// How much may be lost, and for what.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct VideoOptions {
    /// The quantiser, 0 (best) to 51.
    pub quantiser: u8,
}

#[derive(Debug)]
pub(crate) struct VideoEncoder;
impl VideoEncoder {
    pub(crate) fn new(_: VideoOptions) -> Self { Self }
    pub(crate) fn encode(&mut self, _m: &[u8], _l: &Image, _s: u64, _o: &mut Vec<u8>) -> Option<()> { None }
    pub(crate) fn request_keyframe(&mut self) {}
}
#[derive(Debug, Default)]
pub(crate) struct VideoDecoder;
impl VideoDecoder {
    pub(crate) fn decode(&mut self, _i: &mut Cursor<'_>, _s: u64, _t: usize, _o: &mut Vec<u8>) -> Result<(), Error> { Err(Error::VideoNotBuilt) }
}
