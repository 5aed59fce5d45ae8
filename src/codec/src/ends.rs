//! The two ends of one topic on a link: the encoder with its codec selection, the decoder, and the feedback between
//! them.
//!
//! ```text
//!   Sender::encode ──frame──▶ Receiver::decode ──▶ message
//!   Sender::on_feedback ◀──ReceiverFeedback (after loss or damage)──┘
//! ```
//! After a reconnect both are told so; the state of the other side does not matter then.

use crate::auto::{CodecChoice, CodecSelector};
use crate::codec::Codec;
use crate::error::Error;
use crate::jpeg::JpegOptions;
use crate::layout::Schema;
use crate::topic::{DecodedFrame, Decoder, EncodedFrame, Encoder};
use crate::video::VideoOptions;
use std::time::Duration;

/// Policy for encoding a topic's messages.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum CodecPolicy {
    /// Messages are sent unchanged.
    AsIs,
    /// Always the same codec, with its fallback for messages that do not fit.
    Always(Codec),
    /// The fastest lossless codec.
    #[default]
    Lossless,
    /// The fastest codec; pictures may lose detail if no lossless codec keeps up.
    Lossy(LossyCodec),
}

/// Lossy codecs for pictures.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum LossyCodec {
    /// JPEG: each picture is independent.
    Jpeg(JpegOptions),
    /// H.264: predicted from the picture before; only in builds that include it.
    Video(VideoOptions),
}

/// Feedback from a [`Receiver`] to its [`Sender`].
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ReceiverFeedback {
    /// A frame was lost: the next one must not refer to earlier ones.
    Keyframe,
    /// The frame does not decode to the message that was encoded: this message and later ones must be sent with another
    /// codec.
    Damaged,
}

/// The sending end, which encodes one topic's messages.
#[derive(Debug)]
pub struct Sender {
    encoder: Encoder,
    choosing: CodecSelection,
}

#[derive(Debug)]
enum CodecSelection {
    Fixed(Codec),
    Auto(CodecSelector),
}

impl Sender {
    /// Creates a sender for messages of `schema`. Video is not chosen if the build lacks it.
    pub fn new(schema: Schema, policy: CodecPolicy) -> Self {
        let mut encoder = Encoder::new(schema);
        let mut lossy = None;
        match policy {
            CodecPolicy::Lossy(LossyCodec::Jpeg(options)) => {
                encoder = encoder.allow_jpeg(options);
                lossy = Some(Codec::Jpeg);
            }
            CodecPolicy::Lossy(LossyCodec::Video(options)) => {
                encoder = encoder.allow_video(options);
                lossy = Some(Codec::Video).filter(|codec| codec.is_available());
            }
            _ => {}
        }
        let choosing = match policy {
            CodecPolicy::AsIs => CodecSelection::Fixed(Codec::Raw),
            CodecPolicy::Always(codec) => CodecSelection::Fixed(codec),
            CodecPolicy::Lossless | CodecPolicy::Lossy(_) => CodecSelection::Auto(CodecSelector::new(schema, lossy)),
        };
        Self { encoder, choosing }
    }

    /// Sets the maximum latency: a lossless codec that takes longer to deliver a message does not keep up.
    #[must_use]
    pub fn with_deadline(mut self, deadline: Option<Duration>) -> Self {
        if let CodecSelection::Auto(auto) = &mut self.choosing {
            auto.set_deadline(deadline);
        }
        self
    }

    /// Appends the frame of `message` to `out`. `clock` is any steady clock; CPU time serves best.
    pub fn encode(&mut self, message: &[u8], clock: impl Fn() -> Duration, out: &mut Vec<u8>) -> EncodedFrame {
        match &mut self.choosing {
            CodecSelection::Fixed(codec) => self.encoder.encode(*codec, message, out),
            CodecSelection::Auto(auto) => auto.encode(&mut self.encoder, message, clock, out),
        }
    }

    /// Records that the otherwise idle link took `time` for `bytes`.
    pub fn record_transfer(&mut self, bytes: usize, time: Duration) {
        if let CodecSelection::Auto(auto) = &mut self.choosing {
            auto.record_transfer(bytes, time);
        }
    }

    /// Handles feedback from the receiver.
    pub fn on_feedback(&mut self, answer: ReceiverFeedback) {
        match answer {
            ReceiverFeedback::Keyframe => self.encoder.request_keyframe(),
            ReceiverFeedback::Damaged => {
                let next = match self.choosing {
                    CodecSelection::Fixed(Codec::Raw | Codec::Zstd(_)) => Codec::Raw,
                    _ => Codec::Zstd(3),
                };
                self.choosing = CodecSelection::Fixed(next);
            }
        }
    }

    /// Handles a reconnect: the next frame refers to no earlier ones, and the throughput of the link must be measured
    /// again. The measured costs of the codecs are kept.
    pub fn on_reconnect(&mut self) {
        self.encoder.request_keyframe();
        if let CodecSelection::Auto(auto) = &mut self.choosing {
            auto.forget_link();
        }
    }

    /// Returns the current choice and its reason; `None` if the codec is fixed.
    pub fn choice(&self) -> Option<CodecChoice> {
        match &self.choosing {
            CodecSelection::Fixed(_) => None,
            CodecSelection::Auto(auto) => Some(auto.choice()),
        }
    }
}

/// Number of undecodable frames after which a keyframe is requested again.
const ASK_AGAIN: u32 = 30;

/// The receiving end, which decodes one topic's frames.
#[derive(Debug)]
pub struct Receiver {
    limit: usize,
    decoder: Decoder,
    /// Number of undecodable frames since a keyframe was requested.
    waiting: Option<u32>,
}

impl Receiver {
    /// Creates a receiver for messages of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { limit, decoder: Decoder::new(limit), waiting: None }
    }

    /// Appends the message of `frame` to `out`; on an error `out` is unchanged. The feedback, if any, is to be sent to
    /// the sender.
    pub fn decode(
        &mut self,
        frame: &[u8],
        out: &mut Vec<u8>,
    ) -> (Result<DecodedFrame, Error>, Option<ReceiverFeedback>) {
        let result = self.decoder.decode(frame, out);
        let answer = match &result {
            Ok(_) => {
                self.waiting = None;
                None
            }
            Err(error) if error.wants_keyframe() => {
                let waiting = self.waiting.map_or(0, |waiting| (waiting + 1) % ASK_AGAIN);
                self.waiting = Some(waiting);
                (waiting == 0).then_some(ReceiverFeedback::Keyframe)
            }
            Err(error) => error.wants_another_codec().then_some(ReceiverFeedback::Damaged),
        };
        (result, answer)
    }

    /// Handles a reconnect: later frames refer to nothing received before.
    pub fn on_reconnect(&mut self) {
        *self = Self::new(self.limit);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a grid of 40×40 cells with a wall up to `wall`.
    fn grid(wall: usize) -> Vec<u8> {
        let mut message = vec![0; 16];
        message.extend_from_slice(&[0; 8]);
        message.extend_from_slice(&0.5f32.to_le_bytes());
        message.extend_from_slice(&[40, 0, 0, 0, 40, 0, 0, 0]);
        message.extend_from_slice(&[0; 56]);
        message.extend_from_slice(&1600u32.to_le_bytes());
        let noise = |at: usize| [0, 100][((at * at * 2_654_435_761) >> 40) & 1];
        message.extend((0..1600).map(|at| if at < wall { noise(at) } else { 255 }));
        message
    }

    fn no_clock() -> Duration {
        Duration::ZERO
    }

    #[test]
    fn what_is_damaged_on_its_way_is_never_given_out_and_comes_another_way() {
        let mut sender = Sender::new(Schema::OccupancyGrid, CodecPolicy::Always(Codec::Grid));
        let mut receiver = Receiver::new(10_000);
        let mut frame = Vec::new();
        sender.encode(&grid(800), no_clock, &mut frame);
        for at in 0..frame.len() {
            let mut damaged = frame.clone();
            damaged[at] ^= 0x10;
            let mut back = Vec::new();
            match receiver.decode(&damaged, &mut back) {
                // The frame's own number does not matter.
                (Ok(_), None) => assert_eq!(back, grid(800), "byte {at}"),
                (Err(error), answer) => {
                    let asks = matches!(error, Error::TooLarge { .. }) || answer == Some(ReceiverFeedback::Damaged);
                    assert!(asks && back.is_empty(), "byte {at}: {error}");
                }
                (Ok(_), answer) => panic!("{answer:?}"),
            }
        }
        for codec in [Codec::Zstd(3), Codec::Raw, Codec::Raw] {
            sender.on_feedback(ReceiverFeedback::Damaged);
            let (mut frame, mut back) = (Vec::new(), Vec::new());
            let encoded = sender.encode(&grid(800), no_clock, &mut frame);
            assert_eq!(encoded.codec, codec);
            receiver.decode(&frame, &mut back).0.unwrap();
            assert_eq!(back, grid(800));
        }
    }

    #[cfg(feature = "video")]
    #[test]
    fn a_receiver_that_lost_its_memory_asks_once_for_a_keyframe() {
        let mut picture = vec![0; 12];
        picture.extend([0; 4]);
        picture.extend([32, 0, 0, 0, 32, 0, 0, 0, 4, 0, 0, 0]);
        picture.extend(b"rgb8\x00");
        picture.extend(96u32.to_le_bytes());
        picture.extend(3072u32.to_le_bytes());
        picture.extend([90; 3072]);
        let lossy = LossyCodec::Video(VideoOptions::default());
        let mut sender = Sender::new(Schema::Image, CodecPolicy::Lossy(lossy));
        sender.choosing = CodecSelection::Fixed(Codec::Video);
        sender.encode(&picture, no_clock, &mut Vec::new());
        let mut receiver = Receiver::new(10_000);
        let mut answers = Vec::new();
        for _ in 0..40 {
            let mut frame = Vec::new();
            sender.encode(&picture, no_clock, &mut frame);
            let (result, answer) = receiver.decode(&frame, &mut Vec::new());
            assert!(matches!(result, Err(Error::KeyframeNeeded(_))));
            answers.extend(answer);
        }
        assert_eq!(answers, [ReceiverFeedback::Keyframe; 2]);
        sender.on_feedback(ReceiverFeedback::Keyframe);
        let mut frame = Vec::new();
        sender.encode(&picture, no_clock, &mut frame);
        receiver.decode(&frame, &mut Vec::new()).0.unwrap();
    }

    #[test]
    fn a_policy_is_kept() {
        let mut as_it_is = Sender::new(Schema::Other, CodecPolicy::AsIs);
        let encoded = as_it_is.encode(&[0; 1000], no_clock, &mut Vec::new());
        assert_eq!((encoded.codec, as_it_is.choice()), (Codec::Raw, None));
        let lossless = Sender::new(Schema::Image, CodecPolicy::Lossless);
        let candidates = |sender: &Sender| -> Vec<Codec> {
            let expected = sender.choice().unwrap().expected;
            expected.iter().map(|(estimate, _)| estimate.codec).collect()
        };
        assert!(candidates(&lossless).iter().all(|codec| codec.is_lossless()));
        let jpeg = CodecPolicy::Lossy(LossyCodec::Jpeg(JpegOptions::default()));
        let lossy = Sender::new(Schema::Image, jpeg);
        assert!(candidates(&lossy).contains(&Codec::Jpeg));
        let video = CodecPolicy::Lossy(LossyCodec::Video(VideoOptions::default()));
        let lossy = Sender::new(Schema::Image, video);
        assert_eq!(candidates(&lossy).contains(&Codec::Video), cfg!(feature = "video"));
    }

    #[test]
    fn a_new_link_is_measured_anew() {
        let mut sender = Sender::new(Schema::Other, CodecPolicy::Lossless);
        let unknown = sender.choice().unwrap().link;
        sender.record_transfer(1_000_000, Duration::from_millis(10));
        assert!(sender.choice().unwrap().link > 2.0 * unknown);
        sender.on_reconnect();
        assert_eq!(sender.choice().unwrap().link, unknown);
    }
}
