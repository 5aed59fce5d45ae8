//! Link codecs: ROS messages in, smaller frames out, and back; nothing lost that must not be.
//!
//! ```text
//!   message (serialized, as it is) ──▶ Encoder ──▶ frame ──▶ Decoder ──▶ the same message, by its checksum
//!                                        ▲  request_keyframe()  │ (of videos all but the pixels, of JPEG too)
//!                                        └──────────────────────┘
//! ```
//! Pure: no I/O, no threads, no clock; state lives in one [`Encoder`] and one [`Decoder`] per topic. Frames carry their
//! codec and its version, so codecs can change from message to message: [`Auto`] chooses
//! them. [`Sender`] and [`Receiver`] put the three together, with what they tell each other.
//!
//! Every lossless codec restores the message bit by bit, and one that does not fit a message leaves it to zstd. Every
//! decoder is safe with any input: it fails or returns a message of the declared size, within the limit it was given.

#![forbid(unsafe_code)]
// Lanes and columns are walked side by side in several arrays: an index says that, zipped iterators hide it.
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
mod rows;
mod scale;
mod scan;
mod topic;
mod video;
mod wide;
mod wire;

pub use auto::{Auto, Choice, Estimate, Reason};
pub use codec::{Codec, UnknownCodec};
pub use ends::{Answer, Lossy, Policy, Receiver, Sender};
pub use error::Error;
pub use jpeg::JpegOptions;
pub use layout::Schema;
pub use topic::{Decoded, Decoder, Encoded, Encoder, peek};
pub use video::VideoOptions;
