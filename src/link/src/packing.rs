//! Compression of topic messages: one encoder for each outgoing topic and one decoder for each incoming topic.
//!
//! Messages are encoded when they are about to be sent, not when they are queued. An image that is replaced by a newer
//! one therefore costs nothing, and codecs that refer to earlier frames miss one only when a connection is lost.
//! Messages are encoded only while the link is the bottleneck: over a fast link they arrive sooner unencoded.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use codec::{Codec, CodecPolicy, JpegOptions, LossyCodec, Receiver, ReceiverFeedback, Schema, Sender, VideoOptions};

use crate::MAX_RECORD;

/// Throughput in bytes per second above which the link is not the bottleneck: encoding takes longer than it saves.
const FAST: f64 = 60e6;
/// Maximum number of topics decoded at a time.
const MAX_TOPICS: usize = 1024;
/// Divisor of T_max: the time that encoding and sending may take. If it takes longer, a lossy codec is used where
/// allowed.
const SHARE_OF_T_MAX: u32 = 4;
/// Codecs used for lossless encoding.
const LOSSLESS: [Codec; 6] = [Codec::Raw, Codec::Zstd(3), Codec::Image, Codec::Grid, Codec::Scan, Codec::Cloud];

/// Codecs that lose detail of images.
const LOSSY: [Codec; 2] = [Codec::Jpeg, Codec::Video];

/// Returns the names of the codecs that this end can decode, for the opening frames; of the lossy ones, those for which
/// `welcome` returns true.
pub fn supported_codecs(welcome: impl Fn(Codec) -> bool) -> Vec<String> {
    // A decoder is built together with its encoder.
    let lossy = LOSSY.into_iter().filter(|codec| codec.is_available() && welcome(*codec));
    let all = LOSSLESS.into_iter().chain(lossy);
    all.map(|codec| codec.name().to_owned()).collect()
}

/// The encoder of a topic.
#[derive(Debug)]
struct TopicEncoder {
    schema: Schema,
    /// `None` while it is in use.
    sender: Option<Sender>,
    /// Replies of the receiver that arrived while it was in use.
    answers: Vec<ReceiverFeedback>,
    begin_anew: bool,
}

/// The result of encoding a message.
pub(crate) struct EncodedMessage {
    channel: u32,
    sender: Sender,
    frame: Bytes,
    took: Duration,
}

/// The encoders and decoders of a session.
#[derive(Debug, Default)]
pub(crate) struct SessionCodecs {
    lossless: bool,
    lossy: Option<Codec>,
    jpeg: JpegOptions,
    deadline: Option<Duration>,
    lanes: HashMap<u32, TopicEncoder>,
    receivers: HashMap<u32, Receiver>,
}

impl SessionCodecs {
    /// Creates the codecs for a link with this maximum response time.
    pub(crate) fn new(t_max: Option<Duration>) -> Self {
        Self { deadline: t_max.map(|t_max| t_max / SHARE_OF_T_MAX), ..Self::default() }
    }

    /// Sets the codecs that the peer can decode, and the quality of JPEG images, 1 to 100 (default: 80).
    pub(crate) fn set_peer_codecs(&mut self, names: &[String], quality: Option<u8>) {
        self.jpeg = quality.map_or_else(JpegOptions::default, |quality| JpegOptions { quality });
        let has = |codec: &Codec| names.iter().any(|name| name == codec.name());
        self.lossless = LOSSLESS.iter().all(has);
        self.lossy = LOSSY.into_iter().find(has);
    }

    /// Adds an outgoing topic with messages of this schema.
    pub(crate) fn add(&mut self, channel: u32, schema: Schema) {
        let lane = TopicEncoder { schema, sender: None, answers: Vec::new(), begin_anew: false };
        self.lanes.insert(channel, lane);
    }

    pub(crate) fn remove(&mut self, channel: u32) {
        self.lanes.remove(&channel);
    }

    pub(crate) fn on_peer_closed(&mut self, channel: u32) {
        self.receivers.remove(&channel);
    }

    /// Returns whether encoding is worthwhile at this throughput in bytes per second; `None`: the link was never busy.
    pub(crate) fn is_worthwhile(&self, throughput: Option<f64>) -> bool {
        self.lossless && throughput.is_some_and(|rate| rate < FAST)
    }

    /// Creates the job that encodes a message on another thread. If `alone` is set, the result is decodable without
    /// earlier frames.
    pub(crate) fn encode_job(
        &mut self,
        channel: u32,
        message: Bytes,
        alone: bool,
        throughput: Option<f64>,
    ) -> Option<impl FnOnce() -> EncodedMessage + Send + use<>> {
        let lane = self.lanes.get_mut(&channel)?;
        let policy = match self.lossy {
            Some(Codec::Jpeg) => CodecPolicy::Lossy(LossyCodec::Jpeg(self.jpeg)),
            Some(Codec::Video) => CodecPolicy::Lossy(LossyCodec::Video(VideoOptions::default())),
            _ => CodecPolicy::Lossless,
        };
        let (schema, deadline) = (lane.schema, self.deadline);
        let mut sender = lane.sender.take().unwrap_or_else(|| Sender::new(schema, policy).with_deadline(deadline));
        if std::mem::take(&mut lane.begin_anew) {
            sender.on_reconnect();
        }
        for answer in lane.answers.drain(..) {
            sender.on_feedback(answer);
        }
        if alone {
            sender.on_feedback(ReceiverFeedback::Keyframe);
        }
        if let Some(rate) = throughput {
            sender.record_transfer(1 << 20, Duration::from_secs_f64(f64::from(1 << 20) / rate.max(1.0)));
        }
        Some(move || {
            let begun = Instant::now();
            let mut frame = Vec::new();
            sender.encode(&message, || begun.elapsed(), &mut frame);
            EncodedMessage { channel, sender, frame: frame.into(), took: begun.elapsed() }
        })
    }

    /// Returns the encoder to its topic, and the frame and the time that it took to the caller.
    pub(crate) fn finish(&mut self, packed: EncodedMessage) -> (Bytes, Duration) {
        if let Some(lane) = self.lanes.get_mut(&packed.channel) {
            lane.sender = Some(packed.sender);
        }
        (packed.frame, packed.took)
    }

    /// Passes the receiver's reply about a frame to the encoder.
    pub(crate) fn on_answer(&mut self, channel: u32, answer: ReceiverFeedback) {
        if let Some(lane) = self.lanes.get_mut(&channel) {
            // Duplicates carry no information.
            lane.answers.retain(|earlier| *earlier != answer);
            lane.answers.push(answer);
        }
    }

    /// Starts anew on another connection: frames in flight may be lost, so the next ones refer to no earlier ones.
    pub(crate) fn reconnect(&mut self) {
        for lane in self.lanes.values_mut() {
            lane.begin_anew = true;
        }
    }

    /// Decodes a frame; returns the message and the reply to send.
    pub(crate) fn decode(
        &mut self,
        channel: u32,
        frame: &[u8],
    ) -> (Result<Bytes, codec::Error>, Option<ReceiverFeedback>) {
        if self.receivers.len() >= MAX_TOPICS && !self.receivers.contains_key(&channel) {
            self.receivers.clear();
        }
        let receiver = self.receivers.entry(channel).or_insert_with(|| Receiver::new(MAX_RECORD));
        let mut message = Vec::new();
        let (decoded, answer) = receiver.decode(frame, &mut message);
        (decoded.map(|_| message.into()), answer)
    }
}

#[cfg(test)]
mod tests;
