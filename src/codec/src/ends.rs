//! The two ends of one topic on a link: encoder and choice here, decoder there, and what is sent back.
//!
//! ```text
//!   Sender::encode ──frame──▶ Receiver::decode ──▶ message
//!   Sender::answered ◀──Answer (after loss or damage)────┘
//! ```
//! After a reconnect both are told so: what the other side remembers is then no matter.

use crate::auto::{Auto, Choice};
use crate::codec::Codec;
use crate::error::Error;
use crate::jpeg::JpegOptions;
use crate::layout::Schema;
use crate::topic::{Decoded, Decoder, Encoded, Encoder};
use crate::video::VideoOptions;
use std::time::Duration;

/// What may be done to a topic's messages.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Policy {
    /// Nothing: they go as they are.
    AsIs,
    /// One codec always; it falls back where a message does not fit.
    Always(Codec),
    /// The lossless codec that pays.
    #[default]
    Lossless,
    /// The fastest codec; pictures may lose detail if no lossless codec keeps up.
    Lossy(Lossy),
}

/// The lossy codecs of pictures.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Lossy {
    /// JPEG: each picture alone.
    Jpeg(JpegOptions),
    /// H.264: predicted from the picture before; only where it is built.
    Video(VideoOptions),
}

/// What a [`Receiver`] wants its [`Sender`] to know.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Answer {
    /// Something was lost: the next frame must refer to none before it.
    Keyframe,
    /// The frame does not make the message that was encoded: this one, and those after it, must come another way.
    Damaged,
}

/// The end that encodes one topic's messages.
#[derive(Debug)]
pub struct Sender {
    encoder: Encoder,
    choosing: Choosing,
}

#[derive(Debug)]
enum Choosing {
    Fixed(Codec),
    Auto(Auto),
}

impl Sender {
    /// For messages of `schema`. Video that is not built is not chosen.
    pub fn new(schema: Schema, policy: Policy) -> Self {
        let mut encoder = Encoder::new(schema);
        let mut lossy = None;
        match policy {
            Policy::Lossy(Lossy::Jpeg(options)) => {
                encoder = encoder.allow_jpeg(options);
                lossy = Some(Codec::Jpeg);
            }
            Policy::Lossy(Lossy::Video(options)) => {
                encoder = encoder.allow_video(options);
                lossy = Some(Codec::Video).filter(|codec| codec.is_built());
            }
            _ => {}
        }
        let choosing = match policy {
            Policy::AsIs => Choosing::Fixed(Codec::Raw),
            Policy::Always(codec) => Choosing::Fixed(codec),
            Policy::Lossless | Policy::Lossy(_) => Choosing::Auto(Auto::new(schema, lossy)),
        };
        Self { encoder, choosing }
    }

    /// A lossless codec that takes longer than this to bring a message to the other side does not keep up.
    #[must_use]
    pub fn within(mut self, deadline: Option<Duration>) -> Self {
        if let Choosing::Auto(auto) = &mut self.choosing {
            auto.within(deadline);
        }
        self
    }

    /// Appends the frame of `message` to `out`. `clock` is any steady clock; processor time serves best.
    pub fn encode(
        &mut self,
        message: &[u8],
        clock: impl Fn() -> Duration,
        out: &mut Vec<u8>,
    ) -> Encoded {
        match &mut self.choosing {
            Choosing::Fixed(codec) => self.encoder.encode(*codec, message, out),
            Choosing::Auto(auto) => auto.encode(&mut self.encoder, message, clock, out),
        }
    }

    /// The link took `time` for `bytes`, while it had nothing else to do.
    pub fn sent(&mut self, bytes: usize, time: Duration) {
        if let Choosing::Auto(auto) = &mut self.choosing {
            auto.link(bytes, time);
        }
    }

    /// The receiver has answered.
    pub fn answered(&mut self, answer: Answer) {
        match answer {
            Answer::Keyframe => self.encoder.request_keyframe(),
            Answer::Damaged => {
                let next = match self.choosing {
                    Choosing::Fixed(Codec::Raw | Codec::Zstd(_)) => Codec::Raw,
                    _ => Codec::Zstd(3),
                };
                self.choosing = Choosing::Fixed(next);
            }
        }
    }

    /// The link is another one now: the next frame refers to none before it, and how fast the link is must be
    /// measured again. What the codecs cost is still known.
    pub fn reconnected(&mut self) {
        self.encoder.request_keyframe();
        if let Choosing::Auto(auto) = &mut self.choosing {
            auto.forget_link();
        }
    }

    /// What is chosen and why; `None` where there is nothing to choose.
    pub fn choice(&self) -> Option<Choice> {
        match &self.choosing {
            Choosing::Fixed(_) => None,
            Choosing::Auto(auto) => Some(auto.choice()),
        }
    }
}

/// After so many more frames that cannot be decoded a keyframe is asked for again.
const ASK_AGAIN: u32 = 30;

/// The end that decodes one topic's frames.
#[derive(Debug)]
pub struct Receiver {
    limit: usize,
    decoder: Decoder,
    /// Frames that could not be decoded since a keyframe was asked for.
    waiting: Option<u32>,
}

impl Receiver {
    /// For messages of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self {
            limit,
            decoder: Decoder::new(limit),
            waiting: None,
        }
    }

    /// Appends the message of `frame` to `out`; on an error `out` is as before. The answer, if there is one, goes to
    /// the sender.
    pub fn decode(
        &mut self,
        frame: &[u8],
        out: &mut Vec<u8>,
    ) -> (Result<Decoded, Error>, Option<Answer>) {
        let result = self.decoder.decode(frame, out);
        let answer = match &result {
            Ok(_) => {
                self.waiting = None;
                None
            }
            Err(error) if error.wants_keyframe() => {
                let waiting = self.waiting.map_or(0, |waiting| (waiting + 1) % ASK_AGAIN);
                self.waiting = Some(waiting);
                (waiting == 0).then_some(Answer::Keyframe)
            }
            Err(error) => error.wants_another_codec().then_some(Answer::Damaged),
        };
        (result, answer)
    }

    /// The link is another one now: nothing that was received before is referred to.
    pub fn reconnected(&mut self) {
        *self = Self::new(self.limit);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid of 40×40 cells with a wall up to `wall`.
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
        let mut sender = Sender::new(Schema::OccupancyGrid, Policy::Always(Codec::Grid));
        let mut receiver = Receiver::new(10_000);
        let mut frame = Vec::new();
        sender.encode(&grid(800), no_clock, &mut frame);
        for at in 0..frame.len() {
            let mut damaged = frame.clone();
            damaged[at] ^= 0x10;
            let mut back = Vec::new();
            match receiver.decode(&damaged, &mut back) {
                // The frame's own number is of no consequence.
                (Ok(_), None) => assert_eq!(back, grid(800), "byte {at}"),
                (Err(error), answer) => {
                    let asks =
                        matches!(error, Error::TooLarge { .. }) || answer == Some(Answer::Damaged);
                    assert!(asks && back.is_empty(), "byte {at}: {error}");
                }
                (Ok(_), answer) => panic!("{answer:?}"),
            }
        }
        for codec in [Codec::Zstd(3), Codec::Raw, Codec::Raw] {
            sender.answered(Answer::Damaged);
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
        let lossy = Lossy::Video(VideoOptions::default());
        let mut sender = Sender::new(Schema::Image, Policy::Lossy(lossy));
        sender.choosing = Choosing::Fixed(Codec::Video);
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
        assert_eq!(answers, [Answer::Keyframe; 2]);
        sender.answered(Answer::Keyframe);
        let mut frame = Vec::new();
        sender.encode(&picture, no_clock, &mut frame);
        receiver.decode(&frame, &mut Vec::new()).0.unwrap();
    }

    #[test]
    fn a_policy_is_kept() {
        let mut as_it_is = Sender::new(Schema::Other, Policy::AsIs);
        let encoded = as_it_is.encode(&[0; 1000], no_clock, &mut Vec::new());
        assert_eq!((encoded.codec, as_it_is.choice()), (Codec::Raw, None));
        let lossless = Sender::new(Schema::Image, Policy::Lossless);
        let candidates = |sender: &Sender| -> Vec<Codec> {
            let expected = sender.choice().unwrap().expected;
            expected
                .iter()
                .map(|(estimate, _)| estimate.codec)
                .collect()
        };
        assert!(
            candidates(&lossless)
                .iter()
                .all(|codec| codec.is_lossless())
        );
        let jpeg = Policy::Lossy(Lossy::Jpeg(JpegOptions::default()));
        let lossy = Sender::new(Schema::Image, jpeg);
        assert!(candidates(&lossy).contains(&Codec::Jpeg));
        let video = Policy::Lossy(Lossy::Video(VideoOptions::default()));
        let lossy = Sender::new(Schema::Image, video);
        assert_eq!(
            candidates(&lossy).contains(&Codec::Video),
            cfg!(feature = "video")
        );
    }

    #[test]
    fn a_new_link_is_measured_anew() {
        let mut sender = Sender::new(Schema::Other, Policy::Lossless);
        let unknown = sender.choice().unwrap().link;
        sender.sent(1_000_000, Duration::from_millis(10));
        assert!(sender.choice().unwrap().link > 2.0 * unknown);
        sender.reconnected();
        assert_eq!(sender.choice().unwrap().link, unknown);
    }
}
