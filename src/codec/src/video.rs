//! Colour pictures as H.264: the pixels are lossy, so it is only used where the robot's configuration allows it. All
//! other bytes of the message are exact, alpha included.
//!
//! Every frame but a keyframe refers to the one before. The decoder notices a gap and asks for a keyframe; so does one
//! that starts late.
//!
//! Body: `head · padding · number · key? · [alpha] · H.264 (Annex B)`.

#[cfg(feature = "video")]
mod colour;
#[cfg(feature = "video")]
mod guard;
#[cfg(feature = "video")]
mod h264;

use crate::Error;
use crate::layout::Image;
use crate::wire::Cursor;

/// How much may be lost.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct VideoOptions {
    /// H.264's quantiser, 0 (best) to 51 (smallest). Six more halve the detail kept; 22 is hard to tell from the
    /// original.
    pub quantiser: u8,
}

impl Default for VideoOptions {
    fn default() -> Self {
        Self { quantiser: 22 }
    }
}

/// The encoder's memory.
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

    /// Appends the body of `message`; `None` when it is no colour picture or the library refuses it.
    #[cfg_attr(not(feature = "video"), allow(unused_variables, clippy::ptr_arg))]
    pub(crate) fn encode(
        &mut self,
        message: &[u8],
        layout: &Image,
        out: &mut Vec<u8>,
    ) -> Option<()> {
        #[cfg(feature = "video")]
        return self.inner.encode(message, layout, out);
        #[cfg(not(feature = "video"))]
        None
    }

    /// The next frame refers to none.
    pub(crate) fn request_keyframe(&mut self) {
        #[cfg(feature = "video")]
        self.inner.request_keyframe();
    }
}

/// The decoder's memory.
#[derive(Debug, Default)]
pub(crate) struct VideoDecoder {
    #[cfg(feature = "video")]
    inner: h264::VideoDecoder,
}

impl VideoDecoder {
    /// Appends a message of `total` bytes to `out`.
    #[cfg_attr(not(feature = "video"), allow(unused_variables, clippy::ptr_arg))]
    pub(crate) fn decode(
        &mut self,
        input: &mut Cursor<'_>,
        total: usize,
        out: &mut Vec<u8>,
    ) -> Result<(), Error> {
        #[cfg(feature = "video")]
        return self.inner.decode(input, total, out);
        #[cfg(not(feature = "video"))]
        Err(Error::VideoNotBuilt)
    }
}
