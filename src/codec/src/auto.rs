//! Chooses the codec of a topic whose configuration says `auto`.
//!
//! ```text
//!                          ┌───────────── probe: one message in PROBE_EVERY ────────────┐
//!                          ▼                                                            │
//!   message ──▶ choose() ──▶ encode ──▶ record_encoding(size, CPU time) ──▶ estimates ──┤
//!                                       record_transfer(bytes, time) ─────▶ throughput ─┘
//!                                                                               │
//!                          a challenger clearly better PATIENCE times ───────▶ switch
//! ```
//! The criterion is the latency of a message: encoding, then sending the frame over the link at the measured
//! throughput. A codec that needs more than its share of the time between messages is ruled out, and so is one that
//! exceeds the deadline, if there is one. A lossy codec is chosen only if no lossless one keeps up.

use crate::codec::Codec;
use crate::layout::Schema;
use crate::topic::{EncodedFrame, Encoder};
use std::time::Duration;

/// Number of messages between two probes, each of which tries one other codec, in turn.
const PROBE_EVERY: u64 = 48;
/// Number of comparisons in a row that a challenger must win.
const PATIENCE: u32 = 6;
/// Fraction of the current codec's latency that a challenger must stay below.
const CLEARLY: f64 = 0.85;
/// Fraction of the time between messages that encoding may take, and sending.
const SHARE: f64 = 0.8;
/// Assumed throughput of the link until it is measured, in bytes per second.
const UNKNOWN_LINK: f64 = 12.5e6;
/// Weight of the newest measurement in an average.
const NEWEST: f64 = 0.25;

/// Measurements of one codec on this topic.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct CodecEstimate {
    /// The codec.
    pub codec: Codec,
    /// Frame bytes per message byte.
    pub ratio: f64,
    /// Encoding time per message byte, in nanoseconds.
    pub nanoseconds_per_byte: f64,
    /// Number of measurements; zero until it was tried.
    pub samples: u64,
}

/// Reason for the current codec.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Reason {
    /// Nothing has been measured yet.
    First,
    /// It has the lowest latency.
    Fastest,
    /// No lossless codec keeps up with the topic, or with the deadline, over this link.
    OnlyOneThatKeepsUp,
    /// No codec keeps up; this one comes closest.
    LeastLate,
}

/// The choice of `auto` and its reason.
#[derive(Clone, PartialEq, Debug)]
pub struct CodecChoice {
    /// The codec in use.
    pub codec: Codec,
    /// Reason for this codec.
    pub reason: Reason,
    /// Number of codec changes.
    pub switches: u64,
    /// Throughput of the link in bytes per second, measured or assumed.
    pub link: f64,
    /// Time between messages, known from the second one on.
    pub period: Option<Duration>,
    /// Expected latency of each candidate for a message of the usual size.
    pub expected: Vec<(CodecEstimate, Duration)>,
}

/// Chooses the codec of one topic from measurements.
#[derive(Clone, Debug)]
pub struct CodecSelector {
    candidates: Vec<CodecEstimate>,
    current: usize,
    reason: Reason,
    switches: u64,
    messages: u64,
    probes: usize,
    challenger: Option<(usize, u32)>,
    link: Option<f64>,
    period: Option<f64>,
    /// Maximum latency, in seconds.
    deadline: Option<f64>,
    last: Option<Duration>,
    usual_size: f64,
}

impl CodecSelector {
    /// Creates a selector for messages of `schema`, including the lossy codec for pictures, if given.
    pub fn new(schema: Schema, lossy: Option<Codec>) -> Self {
        let made = Codec::for_schema(schema);
        let mut codecs = vec![made, Codec::Zstd(1), Codec::Raw];
        match schema {
            Schema::Other => codecs.push(Codec::Zstd(9)),
            Schema::Image => codecs.extend(lossy),
            _ => {}
        }
        Self::with_candidates(&codecs)
    }

    /// Creates a selector among `codecs`; the first one is used until more is known.
    pub fn with_candidates(codecs: &[Codec]) -> Self {
        let estimate = |&codec| CodecEstimate { codec, ratio: 1.0, nanoseconds_per_byte: 0.0, samples: 0 };
        let mut candidates: Vec<_> = codecs.iter().map(estimate).collect();
        if candidates.is_empty() {
            candidates.push(estimate(&Codec::Zstd(3)));
        }
        Self {
            candidates,
            current: 0,
            reason: Reason::First,
            switches: 0,
            messages: 0,
            probes: 0,
            challenger: None,
            link: None,
            period: None,
            deadline: None,
            last: None,
            usual_size: 0.0,
        }
    }

    /// Sets the maximum latency of a message. It has no effect without a lossy codec to fall back to.
    pub fn set_deadline(&mut self, deadline: Option<Duration>) {
        let lossy = |candidate: &CodecEstimate| !candidate.codec.is_lossless();
        let has_lossy = self.candidates.iter().any(lossy);
        self.deadline = deadline.filter(|_| has_lossy).map(|deadline| deadline.as_secs_f64());
    }

    /// Returns the codec for the next message: the current one, or one to be tried.
    pub fn choose(&mut self) -> Codec {
        self.messages += 1;
        let untried = self.candidates.iter().position(|candidate| candidate.samples == 0);
        if let Some(untried) = untried {
            return self.candidates[untried].codec;
        }
        if self.messages % PROBE_EVERY == 0 && self.candidates.len() > 1 {
            self.probes += 1;
            let others = self.candidates.len() - 1;
            return self.candidates[(self.current + 1 + self.probes % others) % self.candidates.len()].codec;
        }
        self.candidates[self.current].codec
    }

    /// Records that a message of `message` bytes arrived at `now` (by any steady clock), and that encoding took `cpu`
    /// and produced `frame` bytes.
    pub fn record_encoding(&mut self, codec: Codec, message: usize, frame: usize, cpu: Duration, now: Duration) {
        if let Some(last) = self.last.replace(now) {
            update_average(&mut self.period, now.saturating_sub(last).as_secs_f64());
        }
        let size = message.max(1) as f64;
        let Some(candidate) = self.candidates.iter_mut().find(|candidate| candidate.codec == codec) else {
            return;
        };
        let (ratio, cost) = (frame as f64 / size, cpu.as_nanos() as f64 / size);
        let weight = if candidate.samples == 0 { 1.0 } else { NEWEST };
        candidate.ratio += weight * (ratio - candidate.ratio);
        candidate.nanoseconds_per_byte += weight * (cost - candidate.nanoseconds_per_byte);
        candidate.samples += 1;
        self.usual_size =
            if self.usual_size == 0.0 { size } else { self.usual_size + NEWEST * (size - self.usual_size) };
        self.decide();
    }

    /// Records that the otherwise idle link took `time` for `bytes`.
    pub fn record_transfer(&mut self, bytes: usize, time: Duration) {
        let seconds = time.as_secs_f64();
        if bytes > 0 && seconds > 0.0 {
            update_average(&mut self.link, bytes as f64 / seconds);
        }
    }

    /// Forgets the measured throughput: the link was replaced.
    pub fn forget_link(&mut self) {
        self.link = None;
        self.challenger = None;
    }

    /// Encodes with the chosen codec and measures the time by `clock`, any steady clock.
    pub fn encode(
        &mut self,
        encoder: &mut Encoder,
        message: &[u8],
        clock: impl Fn() -> Duration,
        out: &mut Vec<u8>,
    ) -> EncodedFrame {
        let codec = self.choose();
        let start = clock();
        let encoded = encoder.encode(codec, message, out);
        let cpu = clock().saturating_sub(start);
        self.record_encoding(codec, message.len(), encoded.bytes, cpu, start);
        encoded
    }

    /// Returns the current choice and its reason.
    pub fn choice(&self) -> CodecChoice {
        let expected = self
            .candidates
            .iter()
            .map(|candidate| (*candidate, Duration::from_secs_f64(self.expected_latency(candidate).clamp(0.0, 1e6))))
            .collect();
        CodecChoice {
            codec: self.candidates[self.current].codec,
            reason: self.reason,
            switches: self.switches,
            link: self.throughput(),
            period: self.period.map(|period| Duration::from_secs_f64(period.clamp(0.0, 1e6))),
            expected,
        }
    }

    fn throughput(&self) -> f64 {
        self.link.unwrap_or(UNKNOWN_LINK).max(1.0)
    }

    fn encoding_time(&self, candidate: &CodecEstimate) -> f64 {
        self.usual_size * candidate.nanoseconds_per_byte * 1e-9
    }

    fn transfer_time(&self, candidate: &CodecEstimate) -> f64 {
        self.usual_size * candidate.ratio / self.throughput()
    }

    /// Returns the expected latency in seconds: encoding and sending.
    fn expected_latency(&self, candidate: &CodecEstimate) -> f64 {
        self.encoding_time(candidate) + self.transfer_time(candidate)
    }

    /// Returns true if encoding and sending each finish before the next message, and together before the deadline.
    fn keeps_up(&self, candidate: &CodecEstimate) -> bool {
        if self.deadline.is_some_and(|deadline| self.expected_latency(candidate) > deadline) {
            return false;
        }
        let Some(period) = self.period else {
            return true;
        };
        self.encoding_time(candidate).max(self.transfer_time(candidate)) <= SHARE * period
    }

    /// Returns the best candidate by the current measurements.
    fn best(&self) -> (usize, Reason) {
        let tried = || self.candidates.iter().enumerate().filter(|(_, candidate)| candidate.samples > 0);
        let soonest = |index: &usize, other: &usize| {
            self.expected_latency(&self.candidates[*index]).total_cmp(&self.expected_latency(&self.candidates[*other]))
        };
        let lossless = tried().filter(|(_, candidate)| candidate.codec.is_lossless() && self.keeps_up(candidate));
        if let Some(best) = lossless.map(|(index, _)| index).min_by(soonest) {
            return (best, Reason::Fastest);
        }
        let keeping = tried().filter(|(_, candidate)| self.keeps_up(candidate));
        if let Some(best) = keeping.map(|(index, _)| index).min_by(soonest) {
            return (best, Reason::OnlyOneThatKeepsUp);
        }
        let least = tried().map(|(index, _)| index).min_by(|&index, &other| {
            let late = |candidate: &CodecEstimate| self.encoding_time(candidate).max(self.transfer_time(candidate));
            late(&self.candidates[index]).total_cmp(&late(&self.candidates[other]))
        });
        (least.unwrap_or(self.current), Reason::LeastLate)
    }

    fn decide(&mut self) {
        let (best, reason) = self.best();
        let (current, other) = (&self.candidates[self.current], &self.candidates[best]);
        // Between codecs of the same kind only a clear gain justifies a change; a change of kind has its own reason.
        let same_kind = reason == self.reason || self.reason == Reason::First;
        let clearly = self.expected_latency(other) < CLEARLY * self.expected_latency(current);
        if best == self.current || (same_kind && current.samples > 0 && !clearly) {
            self.challenger = None;
            if best == self.current {
                self.reason = reason;
            }
            return;
        }
        let wins = match self.challenger {
            Some((challenger, wins)) if challenger == best => wins + 1,
            _ => 1,
        };
        self.challenger = Some((best, wins));
        if wins >= PATIENCE {
            self.current = best;
            self.reason = reason;
            self.switches += 1;
            self.challenger = None;
        }
    }
}

fn update_average(average: &mut Option<f64>, newest: f64) {
    *average = Some(average.map_or(newest, |average| average + NEWEST * (newest - average)));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates a topic of 1 MB messages, 30 per second, over a link of `link` bytes per second.
    fn run_messages(auto: &mut CodecSelector, messages: usize, link: f64, from: &mut u32) {
        for _ in 0..messages {
            *from += 1;
            let codec = auto.choose();
            let (ratio, milliseconds) = match codec {
                Codec::Raw => (1.0, 0.1),
                Codec::Zstd(_) => (0.6, 3.0),
                Codec::Image => (0.25, 5.0),
                _ => (0.01, 3.0),
            };
            let frame = (1e6 * ratio) as usize;
            auto.record_transfer(frame, Duration::from_secs_f64(frame as f64 / link));
            auto.record_encoding(
                codec,
                1_000_000,
                frame,
                Duration::from_secs_f64(milliseconds / 1e3),
                *from * Duration::from_millis(33),
            );
        }
    }

    #[test]
    fn a_fast_link_gets_the_message_as_it_is_and_a_slow_one_the_smallest_lossless() {
        let mut auto = CodecSelector::new(Schema::Image, Some(Codec::Video));
        let mut clock = 0;
        run_messages(&mut auto, 60, 1e9, &mut clock);
        assert_eq!((auto.choice().codec, auto.choice().reason), (Codec::Raw, Reason::Fastest));
        run_messages(&mut auto, 60, 20e6, &mut clock);
        assert_eq!((auto.choice().codec, auto.choice().reason), (Codec::Image, Reason::Fastest));
        assert_eq!(auto.choice().expected.len(), 4);
    }

    #[test]
    fn what_is_lossy_is_the_last_resort() {
        let mut clock = 0;
        let mut auto = CodecSelector::new(Schema::Image, Some(Codec::Video));
        run_messages(&mut auto, 60, 2e6, &mut clock);
        assert_eq!((auto.choice().codec, auto.choice().reason), (Codec::Video, Reason::OnlyOneThatKeepsUp));
        run_messages(&mut auto, 120, 40e6, &mut clock);
        assert_eq!(auto.choice().codec, Codec::Image);
        let mut lossless = CodecSelector::new(Schema::Image, None);
        run_messages(&mut lossless, 60, 2e6, &mut clock);
        assert_eq!((lossless.choice().codec, lossless.choice().reason), (Codec::Image, Reason::LeastLate));
    }

    #[test]
    fn a_deadline_that_no_lossless_codec_keeps_is_a_reason_for_a_lossy_one() {
        let mut clock = 0;
        // 250 kB in 25 ms: with the rate it keeps up.
        let mut auto = CodecSelector::new(Schema::Image, Some(Codec::Jpeg));
        run_messages(&mut auto, 60, 10.5e6, &mut clock);
        assert_eq!(auto.choice().codec, Codec::Image);
        auto.set_deadline(Some(Duration::from_millis(15)));
        run_messages(&mut auto, 60, 10.5e6, &mut clock);
        assert_eq!((auto.choice().codec, auto.choice().reason), (Codec::Jpeg, Reason::OnlyOneThatKeepsUp));
        // Over a faster link nothing need be lost.
        run_messages(&mut auto, 120, 60e6, &mut clock);
        assert_eq!(auto.choice().codec, Codec::Image);
        // Where losses are not allowed, the deadline changes nothing.
        let mut lossless = CodecSelector::new(Schema::Image, None);
        lossless.set_deadline(Some(Duration::from_millis(15)));
        run_messages(&mut lossless, 60, 10.5e6, &mut clock);
        assert_eq!(lossless.choice().reason, Reason::Fastest);
    }

    #[test]
    fn a_wavering_link_does_not_make_it_waver() {
        let mut auto = CodecSelector::new(Schema::Image, None);
        let mut clock = 0;
        // Around the point where raw and image take the same time: 1 MB / 150 MB/s = 6.7 ms.
        for round in 0..200 {
            run_messages(&mut auto, 3, if round % 2 == 0 { 140e6 } else { 165e6 }, &mut clock);
        }
        assert!(auto.choice().switches <= 1, "{}", auto.choice().switches);
    }

    #[test]
    fn every_candidate_is_tried_at_first_and_again_later() {
        let mut auto = CodecSelector::new(Schema::Other, None);
        let mut clock = 0;
        run_messages(&mut auto, 4, 10e6, &mut clock);
        assert!(auto.choice().expected.iter().all(|(estimate, _)| estimate.samples == 1));
        run_messages(&mut auto, 400, 10e6, &mut clock);
        assert!(auto.choice().expected.iter().all(|(estimate, _)| estimate.samples > 1));
    }

    #[test]
    fn a_message_goes_through() {
        let mut auto = CodecSelector::new(Schema::Other, None);
        let mut encoder = Encoder::new(Schema::Other);
        let mut decoder = crate::Decoder::new(1000);
        for round in 0..10 {
            let mut frame = Vec::new();
            auto.encode(&mut encoder, &[7; 1000], || Duration::from_millis(round), &mut frame);
            let mut back = Vec::new();
            decoder.decode(&frame, &mut back).unwrap();
            assert_eq!(back, [7; 1000]);
        }
    }
}
