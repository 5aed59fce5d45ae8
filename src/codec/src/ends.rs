//! The two ends of one topic on a link: encoder and choice here, decoder there, and what is sent back.
//!
//! ```text
//!   Sender::encode ──frame──▶ Receiver::decode ──▶ message
//!   Sender::answered ◀──Answer (grids, and after loss)──┘
//! ```
//! After a reconnect both are told so: what the other side remembers is then no matter.

use crate::auto::{Auto, Choice};
use crate::codec::Codec;
use crate::error::Error;
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
    /// The codec that pays; colour pictures may lose detail when no lossless one keeps up.
    Lossy(VideoOptions),
}

/// What a [`Receiver`] wants its [`Sender`] to know.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Answer {
    /// The frame with this number was decoded and is kept: later ones may refer to it.
    Acknowledge(u64),
    /// Something was lost: the next frame must refer to none before it.
    Keyframe,
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
        if let Policy::Lossy(options) = policy {
            encoder = encoder.allow_video(options);
        }
        let choosing = match policy {
            Policy::AsIs => Choosing::Fixed(Codec::Raw),
            Policy::Always(codec) => Choosing::Fixed(codec),
            Policy::Lossless | Policy::Lossy(_) => {
                Choosing::Auto(Auto::new(schema, encoder.has_video()))
            }
        };
        Self { encoder, choosing }
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
            Answer::Acknowledge(sequence) => self.encoder.acknowledge(sequence),
            Answer::Keyframe => self.encoder.request_keyframe(),
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
            Ok(decoded) => {
                self.waiting = None;
                // Nothing else is ever referred to by its number.
                (decoded.codec == Codec::Grid).then_some(Answer::Acknowledge(decoded.sequence))
            }
            Err(error) if error.wants_keyframe() => {
                let waiting = self.waiting.map_or(0, |waiting| (waiting + 1) % ASK_AGAIN);
                self.waiting = Some(waiting);
                (waiting == 0).then_some(Answer::Keyframe)
            }
            Err(_) => None,
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
    fn grids_are_acknowledged_and_a_reconnect_begins_anew() {
        let mut sender = Sender::new(Schema::OccupancyGrid, Policy::Always(Codec::Grid));
        let mut receiver = Receiver::new(10_000);
        let send = |sender: &mut Sender, receiver: &mut Receiver, wall: usize| {
            let mut frame = Vec::new();
            sender.encode(&grid(wall), no_clock, &mut frame);
            let mut back = Vec::new();
            let (result, answer) = receiver.decode(&frame, &mut back);
            assert_eq!(back, grid(wall));
            assert!(
                matches!(answer, Some(Answer::Acknowledge(sequence)) if sequence == result.unwrap().sequence)
            );
            sender.answered(answer.unwrap());
            frame.len()
        };
        let whole = send(&mut sender, &mut receiver, 800);
        let successor = send(&mut sender, &mut receiver, 810);
        assert!(successor < whole / 2, "{successor} of {whole}");
        sender.reconnected();
        receiver.reconnected();
        let whole = send(&mut sender, &mut receiver, 820);
        assert!(whole > 2 * successor, "{whole} after {successor}");
    }

    #[test]
    fn a_receiver_that_lost_its_memory_asks_once_for_a_keyframe() {
        let mut sender = Sender::new(Schema::OccupancyGrid, Policy::Always(Codec::Grid));
        let mut frame = Vec::new();
        let encoded = sender.encode(&grid(100), no_clock, &mut frame);
        sender.answered(Answer::Acknowledge(encoded.sequence));
        let mut receiver = Receiver::new(10_000);
        let mut answers = Vec::new();
        for wall in 0..40 {
            let mut frame = Vec::new();
            sender.encode(&grid(wall), no_clock, &mut frame);
            let (result, answer) = receiver.decode(&frame, &mut Vec::new());
            assert!(matches!(result, Err(Error::MissingReference(_))));
            answers.extend(answer);
        }
        assert_eq!(answers, [Answer::Keyframe; 2]);
        sender.answered(Answer::Keyframe);
        let mut frame = Vec::new();
        sender.encode(&grid(7), no_clock, &mut frame);
        let mut back = Vec::new();
        receiver.decode(&frame, &mut back).0.unwrap();
        assert_eq!(back, grid(7));
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
        assert!(!candidates(&lossless).contains(&Codec::Video));
        let lossy = Sender::new(Schema::Image, Policy::Lossy(VideoOptions::default()));
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
