//! Link codecs: turn ROS messages into smaller frames and back, losing only what may be lost.
//!
//! ```text
//!   message (serialized) ──▶ Encoder ──▶ frame ──▶ Decoder ──▶ the same message, verified by its checksum
//!                              ▲  request_keyframe()  │        (for video and JPEG everything but the pixels)
//!                              └──────────────────────┘
//! ```
//! Pure code without I/O, threads or clocks; state lives in one [`Encoder`] and one [`Decoder`] per topic. Frames carry
//! their codec and its version, so codecs can change from message to message: [`CodecSelector`] chooses them.
//! [`Sender`] and [`Receiver`] combine the three, with the feedback between them.
//!
//! Every lossless codec restores the message bit by bit, and leaves a message that does not fit to zstd. Every decoder
//! is safe with any input: it fails or returns a message of the declared size, within its limit.

#![forbid(unsafe_code)]
// Several arrays of lanes and columns are walked in parallel: an index shows that, zipped iterators hide it.
#![allow(clippy::needless_range_loop)]

mod auto;
mod cloud;
mod codec;
mod column;
mod ends;
mod entropy;
mod error;
mod generic;
mod grid;
mod image;
mod jpeg;
mod layout;
mod padded;
mod plane8;
mod predict;
mod preview;
mod rows;
mod scale;
mod scan;
mod topic;
mod video;
mod wide;
mod wire;

pub use auto::{CodecChoice, CodecEstimate, CodecSelector, Reason};
pub use codec::{Codec, UnknownCodec};
pub use ends::{CodecPolicy, LossyCodec, Receiver, ReceiverFeedback, Sender};
pub use error::Error;
pub use jpeg::JpegOptions;
pub use layout::Schema;
pub use preview::encode_preview;
pub use topic::{DecodedFrame, Decoder, EncodedFrame, Encoder, peek};
pub use video::VideoOptions;
