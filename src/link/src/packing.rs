//! Messages made smaller on their way: an encoder for each topic that goes out, a decoder for each that comes in.
//!
//! Encoded is what is about to be sent, not what waits: a picture that a newer one replaces costs nothing, and the
//! codecs that refer to earlier frames never miss one but by a lost connection. And only while the link is what
//! holds messages up: over a fast one they are sooner there as they are.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use codec::{Answer, Codec, JpegOptions, Lossy, Policy, Receiver, Schema, Sender, VideoOptions};

use crate::MAX_RECORD;

/// A link this fast, in bytes per second, is never the bottleneck: encoding takes longer than it saves.
const FAST: f64 = 60e6;
/// Topics that may be decoded at once.
const MAX_TOPICS: usize = 1024;
/// Part of T_max that encoding and sending may take; if it takes longer, and a lossy codec is allowed, that is used.
const SHARE_OF_T_MAX: u32 = 4;
/// What lossless encoding makes use of.
const LOSSLESS: [Codec; 6] = [
    Codec::Raw,
    Codec::Zstd(3),
    Codec::Image,
    Codec::Grid,
    Codec::Scan,
    Codec::Cloud,
];

/// Those that lose detail of pictures.
const LOSSY: [Codec; 2] = [Codec::Jpeg, Codec::Video];

/// The names of the codecs that this side decodes, for the opening frames; of lossy ones those that are welcome.
pub fn decoded_here(welcome: impl Fn(Codec) -> bool) -> Vec<String> {
    // Decoding is built with encoding.
    let lossy = LOSSY
        .into_iter()
        .filter(|codec| codec.is_built() && welcome(*codec));
    let all = LOSSLESS.into_iter().chain(lossy);
    all.map(|codec| codec.name().to_owned()).collect()
}

/// A topic's encoder.
#[derive(Debug)]
struct Lane {
    schema: Schema,
    /// None while it is at work.
    sender: Option<Sender>,
    /// What came while it was at work.
    answers: Vec<Answer>,
    begin_anew: bool,
}

/// One message to be encoded, with all that is needed for it: it is done on another thread.
pub(crate) struct Job {
    channel: u32,
    sender: Sender,
    message: Bytes,
}

/// What came of it.
pub(crate) struct Packed {
    channel: u32,
    sender: Sender,
    pub(crate) frame: Bytes,
    pub(crate) took: Duration,
}

impl Job {
    /// Encodes.
    pub(crate) fn run(mut self) -> Packed {
        let begun = Instant::now();
        let mut frame = Vec::new();
        self.sender
            .encode(&self.message, || begun.elapsed(), &mut frame);
        Packed {
            channel: self.channel,
            sender: self.sender,
            frame: frame.into(),
            took: begun.elapsed(),
        }
    }
}

/// The codecs of a session.
#[derive(Debug, Default)]
pub(crate) struct Packing {
    lossless: bool,
    lossy: Option<Codec>,
    jpeg: JpegOptions,
    deadline: Option<Duration>,
    lanes: HashMap<u32, Lane>,
    receivers: HashMap<u32, Receiver>,
}

impl Packing {
    /// For a link on which messages are answered within `t_max`.
    pub(crate) fn new(t_max: Option<Duration>) -> Self {
        Self {
            deadline: t_max.map(|t_max| t_max / SHARE_OF_T_MAX),
            ..Self::default()
        }
    }

    /// Sets the quality of JPEG pictures, 1 to 100; none: 80.
    pub(crate) fn set_quality(&mut self, quality: Option<u8>) {
        self.jpeg = quality.map_or_else(JpegOptions::default, |quality| JpegOptions { quality });
    }

    /// The peer decodes these.
    pub(crate) fn peer_decodes(&mut self, names: &[String]) {
        let has = |codec: &Codec| names.iter().any(|name| name == codec.name());
        self.lossless = LOSSLESS.iter().all(has);
        self.lossy = LOSSY.into_iter().find(has);
    }

    /// A topic's messages are of this schema.
    pub(crate) fn add(&mut self, channel: u32, schema: Schema) {
        let lane = Lane {
            schema,
            sender: None,
            answers: Vec::new(),
            begin_anew: false,
        };
        self.lanes.insert(channel, lane);
    }

    pub(crate) fn remove(&mut self, channel: u32) {
        self.lanes.remove(&channel);
    }

    pub(crate) fn peer_closed(&mut self, channel: u32) {
        self.receivers.remove(&channel);
    }

    /// Whether encoding pays on a link that carries so many bytes per second; none: it never had to hurry.
    pub(crate) fn pays(&self, throughput: Option<f64>) -> bool {
        self.lossless && throughput.is_some_and(|rate| rate < FAST)
    }

    /// What is needed to encode a message, alone if it must be understood without those before.
    pub(crate) fn job(
        &mut self,
        channel: u32,
        message: Bytes,
        alone: bool,
        throughput: Option<f64>,
    ) -> Option<Job> {
        let lane = self.lanes.get_mut(&channel)?;
        let policy = match self.lossy {
            Some(Codec::Jpeg) => Policy::Lossy(Lossy::Jpeg(self.jpeg)),
            Some(Codec::Video) => Policy::Lossy(Lossy::Video(VideoOptions::default())),
            _ => Policy::Lossless,
        };
        let (schema, deadline) = (lane.schema, self.deadline);
        let mut sender = lane
            .sender
            .take()
            .unwrap_or_else(|| Sender::new(schema, policy).within(deadline));
        if std::mem::take(&mut lane.begin_anew) {
            sender.reconnected();
        }
        for answer in lane.answers.drain(..) {
            sender.answered(answer);
        }
        if alone {
            sender.answered(Answer::Keyframe);
        }
        if let Some(rate) = throughput {
            sender.sent(
                1 << 20,
                Duration::from_secs_f64(f64::from(1 << 20) / rate.max(1.0)),
            );
        }
        Some(Job {
            channel,
            sender,
            message,
        })
    }

    /// It was encoded.
    pub(crate) fn done(&mut self, packed: Packed) -> Bytes {
        if let Some(lane) = self.lanes.get_mut(&packed.channel) {
            lane.sender = Some(packed.sender);
        }
        packed.frame
    }

    /// The peer has answered a frame.
    pub(crate) fn answered(&mut self, channel: u32, answer: Answer) {
        if let Some(lane) = self.lanes.get_mut(&channel) {
            // Twice the same tells no more.
            lane.answers.retain(|earlier| *earlier != answer);
            lane.answers.push(answer);
        }
    }

    /// What was under way on the last connection may be lost: the next frames refer to none before.
    pub(crate) fn reconnect(&mut self) {
        for lane in self.lanes.values_mut() {
            lane.begin_anew = true;
        }
    }

    /// Decodes what came; what to answer.
    pub(crate) fn unpack(
        &mut self,
        channel: u32,
        frame: &[u8],
    ) -> (Result<Bytes, codec::Error>, Option<Answer>) {
        if self.receivers.len() >= MAX_TOPICS && !self.receivers.contains_key(&channel) {
            self.receivers.clear();
        }
        let receiver = self
            .receivers
            .entry(channel)
            .or_insert_with(|| Receiver::new(MAX_RECORD));
        let mut message = Vec::new();
        let (decoded, answer) = receiver.decode(frame, &mut message);
        (decoded.map(|_| message.into()), answer)
    }
}

#[cfg(test)]
mod tests;
