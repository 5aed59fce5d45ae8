//! Codec for colour pictures as H.264: the pixels are lossy, so it is only used if the robot's configuration allows it.
//! All other bytes of the message are exact, alpha included.
//!
//! Every frame but a keyframe refers to the one before. The decoder detects a gap and asks for a keyframe; so does a
//! decoder that starts late.
//!
//! Body: `head · padding · number · key? · [alpha] · H.264 (Annex B)`.

#[cfg(feature = "video")]
mod colour;
#[cfg(feature = "video")]
mod guard;
#[cfg(feature = "video")]
mod h264;

use crate::Error;
use crate::layout::ImageLayout;
use crate::wire::FrameCursor;

/// Settings of the video encoder.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct VideoOptions {
    /// Quantiser of H.264, 0 (best) to 51 (smallest). Six more halve the detail kept; 22 is hard to tell from the
    /// original.
    pub quantiser: u8,
}

impl Default for VideoOptions {
    fn default() -> Self {
        Self { quantiser: 22 }
    }
}

/// State of the encoder.
#[derive(Debug)]
pub(crate) struct VideoEncoder {
    #[cfg(feature = "video")]
    inner: h264::VideoEncoder,
}

impl VideoEncoder {
    #[cfg_attr(not(feature = "video"), allow(unused_variables))]
    pub(crate) fn new(options: VideoOptions) -> Self {
        Self {
            #[cfg(feature = "video")]
            inner: h264::VideoEncoder::new(options),
        }
    }

    /// Appends the body of `message`; `None` if it is no colour picture or the library refuses it.
    #[cfg_attr(not(feature = "video"), allow(unused_variables, clippy::ptr_arg))]
    pub(crate) fn encode(&mut self, message: &[u8], layout: &ImageLayout, out: &mut Vec<u8>) -> Option<()> {
        #[cfg(feature = "video")]
        return self.inner.encode(message, layout, out);
        #[cfg(not(feature = "video"))]
        None
    }

    /// Makes the next frame a keyframe.
    pub(crate) fn request_keyframe(&mut self) {
        #[cfg(feature = "video")]
        self.inner.request_keyframe();
    }
}

/// State of the decoder.
#[derive(Debug, Default)]
pub(crate) struct VideoDecoder {
    #[cfg(feature = "video")]
    inner: h264::VideoDecoder,
}

impl VideoDecoder {
    /// Decodes a message of `total` bytes and appends it to `out`.
    #[cfg_attr(not(feature = "video"), allow(unused_variables, clippy::ptr_arg))]
    pub(crate) fn decode(&mut self, input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
        #[cfg(feature = "video")]
        return self.inner.decode(input, total, out);
        #[cfg(not(feature = "video"))]
        Err(Error::VideoNotBuilt)
    }
}
