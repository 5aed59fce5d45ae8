//! Errors of decoding.

/// The error of a frame that cannot be decoded, with what to do about it. Encoding never fails.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// The frame ends before its content does.
    #[error("frame ends early; it was cut on its way")]
    Truncated,
    /// The frame contradicts itself.
    #[error("frame is corrupt: {0}")]
    Corrupt(&'static str),
    /// The tag names no codec.
    #[error("unknown codec tag {0:#04x}; the peer speaks a newer protocol, update this side")]
    UnknownTag(u8),
    /// The codec is known, but not its version.
    #[error("codec `{codec}` in version {version}; this side knows version {known}, update the older side")]
    Version {
        /// The codec's name.
        codec: &'static str,
        /// The version in the frame.
        version: u8,
        /// The version this build knows.
        known: u8,
    },
    /// The message would be larger than allowed. Nothing was allocated for it.
    #[error("frame declares a message of {declared} bytes, the limit is {limit}; raise the limit or drop the sender")]
    TooLarge {
        /// The size declared in the frame.
        declared: u64,
        /// The limit given to the decoder.
        limit: usize,
    },
    /// The checksum of the decoded message is wrong. The message is not returned.
    #[error("message decoded by `{codec}` has another checksum than the one sent; send it another way and report this")]
    Checksum {
        /// The codec's name.
        codec: &'static str,
    },
    /// A video frame depends on one that was lost.
    #[error("video frame {0} follows a frame that was lost; ask the sender for a keyframe")]
    KeyframeNeeded(u64),
    /// H.264 frames need the cargo feature `video`.
    #[error("frame is H.264 video and this build has no video; build with the feature `video`")]
    VideoNotBuilt,
    /// The JPEG library refused the frame.
    #[error("JPEG library refused the frame: {0}; send it another way")]
    Jpeg(String),
    /// The video library refused the frame.
    #[error("video library refused the frame: {0}; ask the sender for a keyframe")]
    Video(String),
}

impl Error {
    /// Returns true if the message may be sent with another codec: the frame is wrong, not the message.
    pub fn wants_another_codec(&self) -> bool {
        !self.wants_keyframe() && !matches!(self, Self::TooLarge { .. })
    }

    /// Returns true if the sender's next keyframe resolves the error.
    pub fn wants_keyframe(&self) -> bool {
        matches!(self, Self::KeyframeNeeded(_) | Self::Video(_))
    }
}
