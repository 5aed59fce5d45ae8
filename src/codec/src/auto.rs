//! Which codec a topic gets when its configuration says `auto`.
//!
//! ```text
//!                        ┌───────── probe: one message in PROBE_EVERY ─────────┐
//!                        ▼                                                      │
//!   message ──▶ next() ──▶ encode ──▶ measured(size, CPU time) ──▶ estimates ──┤
//!                                      link(bytes, time) ─────────▶ throughput ─┘
//!                                                                       │
//!                        a challenger clearly better PATIENCE times ──▶ switch
//! ```
//! The measure is how long a message takes from here to the other side: encoding, then the frame over the link as
//! measured. A codec that needs more than its share of the time between messages is out, and so is one that takes
//! longer than the deadline, where there is one. A lossy codec is taken only when no lossless one keeps up like that.

use crate::codec::Codec;
use crate::layout::Schema;
use crate::topic::{Encoded, Encoder};
use std::time::Duration;

/// Every so many messages one other codec is tried on a message, in turns.
const PROBE_EVERY: u64 = 48;
/// A challenger must win so many comparisons in a row.
const PATIENCE: u32 = 6;
/// In each it must take less than this part of the present codec's time.
const CLEARLY: f64 = 0.85;
/// How much of the time between messages encoding may take, and the link.
const SHARE: f64 = 0.8;
/// Taken for the link until it was measured, in bytes per second.
const UNKNOWN_LINK: f64 = 12.5e6;
/// The weight of the newest measurement.
const NEWEST: f64 = 0.25;

/// What is known of one codec on this topic.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Estimate {
    /// The codec.
    pub codec: Codec,
    /// Frame bytes per message byte.
    pub ratio: f64,
    /// Encoding time per message byte, in nanoseconds.
    pub nanoseconds_per_byte: f64,
    /// How often it was measured; zero until it was tried.
    pub samples: u64,
}

/// Why the current codec is the current one.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Reason {
    /// Nothing is measured yet.
    First,
    /// It brings a message to the other side soonest.
    Fastest,
    /// No lossless codec keeps up with the topic, or with the deadline, over this link.
    OnlyOneThatKeepsUp,
    /// None keeps up; this one comes closest.
    LeastLate,
}

/// What `auto` does and why.
#[derive(Clone, PartialEq, Debug)]
pub struct Choice {
    /// The codec in use.
    pub codec: Codec,
    /// Why this codec is in use.
    pub reason: Reason,
    /// How often it was changed.
    pub switches: u64,
    /// The link's throughput in bytes per second, as measured or assumed.
    pub link: f64,
    /// Time between messages, once there were two.
    pub period: Option<Duration>,
    /// Time from here to the other side that each candidate is expected to take for a message of the usual size.
    pub expected: Vec<(Estimate, Duration)>,
}

/// Chooses the codec of one topic.
#[derive(Clone, Debug)]
pub struct Auto {
    candidates: Vec<Estimate>,
    current: usize,
    reason: Reason,
    switches: u64,
    messages: u64,
    probes: usize,
    challenger: Option<(usize, u32)>,
    link: Option<f64>,
    period: Option<f64>,
    /// Seconds from here to the other side.
    deadline: Option<f64>,
    last: Option<Duration>,
    usual_size: f64,
}

impl Auto {
    /// For messages of `schema`; with the lossy codec that pictures may have.
    pub fn new(schema: Schema, lossy: Option<Codec>) -> Self {
        let made = Codec::made_for(schema);
        let mut codecs = vec![made, Codec::Zstd(1), Codec::Raw];
        match schema {
            Schema::Other => codecs.push(Codec::Zstd(9)),
            Schema::Image => codecs.extend(lossy),
            _ => {}
        }
        Self::among(&codecs)
    }

    /// Among `codecs`; the first is used until more is known.
    pub fn among(codecs: &[Codec]) -> Self {
        let estimate = |&codec| Estimate {
            codec,
            ratio: 1.0,
            nanoseconds_per_byte: 0.0,
            samples: 0,
        };
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

    /// Messages should be on the other side so soon. Without a lossy codec there is nothing that could be done for it.
    pub fn within(&mut self, deadline: Option<Duration>) {
        let lossy = |candidate: &Estimate| !candidate.codec.is_lossless();
        let has_lossy = self.candidates.iter().any(lossy);
        self.deadline = deadline
            .filter(|_| has_lossy)
            .map(|deadline| deadline.as_secs_f64());
    }

    /// The codec for the next message: the current one, or one to be tried.
    pub fn choose(&mut self) -> Codec {
        self.messages += 1;
        let untried = self
            .candidates
            .iter()
            .position(|candidate| candidate.samples == 0);
        if let Some(untried) = untried {
            return self.candidates[untried].codec;
        }
        if self.messages % PROBE_EVERY == 0 && self.candidates.len() > 1 {
            self.probes += 1;
            let others = self.candidates.len() - 1;
            return self.candidates
                [(self.current + 1 + self.probes % others) % self.candidates.len()]
            .codec;
        }
        self.candidates[self.current].codec
    }

    /// A message of `message` bytes arrived at `now` (by any steady clock); encoding took `cpu` and made `frame` bytes.
    pub fn measured(
        &mut self,
        codec: Codec,
        message: usize,
        frame: usize,
        cpu: Duration,
        now: Duration,
    ) {
        if let Some(last) = self.last.replace(now) {
            blend(&mut self.period, now.saturating_sub(last).as_secs_f64());
        }
        let size = message.max(1) as f64;
        let Some(candidate) = self
            .candidates
            .iter_mut()
            .find(|candidate| candidate.codec == codec)
        else {
            return;
        };
        let (ratio, cost) = (frame as f64 / size, cpu.as_nanos() as f64 / size);
        let weight = if candidate.samples == 0 { 1.0 } else { NEWEST };
        candidate.ratio += weight * (ratio - candidate.ratio);
        candidate.nanoseconds_per_byte += weight * (cost - candidate.nanoseconds_per_byte);
        candidate.samples += 1;
        self.usual_size = if self.usual_size == 0.0 {
            size
        } else {
            self.usual_size + NEWEST * (size - self.usual_size)
        };
        self.decide();
    }

    /// The link took `time` for `bytes`, while it had nothing else to do.
    pub fn link(&mut self, bytes: usize, time: Duration) {
        let seconds = time.as_secs_f64();
        if bytes > 0 && seconds > 0.0 {
            blend(&mut self.link, bytes as f64 / seconds);
        }
    }

    /// The link is another one: how fast it is must be measured again.
    pub fn forget_link(&mut self) {
        self.link = None;
        self.challenger = None;
    }

    /// Encodes with the codec chosen and measures it by `clock`, any steady clock.
    pub fn encode(
        &mut self,
        encoder: &mut Encoder,
        message: &[u8],
        clock: impl Fn() -> Duration,
        out: &mut Vec<u8>,
    ) -> Encoded {
        let codec = self.choose();
        let start = clock();
        let encoded = encoder.encode(codec, message, out);
        let cpu = clock().saturating_sub(start);
        self.measured(codec, message.len(), encoded.bytes, cpu, start);
        encoded
    }

    /// What is chosen and why.
    pub fn choice(&self) -> Choice {
        let expected = self
            .candidates
            .iter()
            .map(|candidate| {
                (
                    *candidate,
                    Duration::from_secs_f64(self.expected(candidate).clamp(0.0, 1e6)),
                )
            })
            .collect();
        Choice {
            codec: self.candidates[self.current].codec,
            reason: self.reason,
            switches: self.switches,
            link: self.throughput(),
            period: self
                .period
                .map(|period| Duration::from_secs_f64(period.clamp(0.0, 1e6))),
            expected,
        }
    }

    fn throughput(&self) -> f64 {
        self.link.unwrap_or(UNKNOWN_LINK).max(1.0)
    }

    fn encoding(&self, candidate: &Estimate) -> f64 {
        self.usual_size * candidate.nanoseconds_per_byte * 1e-9
    }

    fn sending(&self, candidate: &Estimate) -> f64 {
        self.usual_size * candidate.ratio / self.throughput()
    }

    /// Seconds from here to the other side.
    fn expected(&self, candidate: &Estimate) -> f64 {
        self.encoding(candidate) + self.sending(candidate)
    }

    /// Whether encoding and sending are each done before the next message, and both before the deadline.
    fn keeps_up(&self, candidate: &Estimate) -> bool {
        if self
            .deadline
            .is_some_and(|deadline| self.expected(candidate) > deadline)
        {
            return false;
        }
        let Some(period) = self.period else {
            return true;
        };
        self.encoding(candidate).max(self.sending(candidate)) <= SHARE * period
    }

    /// The best candidate by what is known now.
    fn best(&self) -> (usize, Reason) {
        let tried = || {
            self.candidates
                .iter()
                .enumerate()
                .filter(|(_, candidate)| candidate.samples > 0)
        };
        let soonest = |index: &usize, other: &usize| {
            self.expected(&self.candidates[*index])
                .total_cmp(&self.expected(&self.candidates[*other]))
        };
        let lossless = tried()
            .filter(|(_, candidate)| candidate.codec.is_lossless() && self.keeps_up(candidate));
        if let Some(best) = lossless.map(|(index, _)| index).min_by(soonest) {
            return (best, Reason::Fastest);
        }
        let keeping = tried().filter(|(_, candidate)| self.keeps_up(candidate));
        if let Some(best) = keeping.map(|(index, _)| index).min_by(soonest) {
            return (best, Reason::OnlyOneThatKeepsUp);
        }
        let least = tried().map(|(index, _)| index).min_by(|&index, &other| {
            let late = |candidate: &Estimate| self.encoding(candidate).max(self.sending(candidate));
            late(&self.candidates[index]).total_cmp(&late(&self.candidates[other]))
        });
        (least.unwrap_or(self.current), Reason::LeastLate)
    }

    fn decide(&mut self) {
        let (best, reason) = self.best();
        let (current, other) = (&self.candidates[self.current], &self.candidates[best]);
        // Between codecs of one kind only a clear gain is worth a change; another kind has its reason.
        let same_kind = reason == self.reason || self.reason == Reason::First;
        let clearly = self.expected(other) < CLEARLY * self.expected(current);
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

fn blend(average: &mut Option<f64>, newest: f64) {
    *average = Some(average.map_or(newest, |average| average + NEWEST * (newest - average)));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A topic of 1 MB messages, 30 per second, over a link of `link` bytes per second.
    fn run(auto: &mut Auto, messages: usize, link: f64, from: &mut u32) {
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
            auto.link(frame, Duration::from_secs_f64(frame as f64 / link));
            auto.measured(
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
        let mut auto = Auto::new(Schema::Image, Some(Codec::Video));
        let mut clock = 0;
        run(&mut auto, 60, 1e9, &mut clock);
        assert_eq!(
            (auto.choice().codec, auto.choice().reason),
            (Codec::Raw, Reason::Fastest)
        );
        run(&mut auto, 60, 20e6, &mut clock);
        assert_eq!(
            (auto.choice().codec, auto.choice().reason),
            (Codec::Image, Reason::Fastest)
        );
        assert_eq!(auto.choice().expected.len(), 4);
    }

    #[test]
    fn what_is_lossy_is_the_last_resort() {
        let mut clock = 0;
        let mut auto = Auto::new(Schema::Image, Some(Codec::Video));
        run(&mut auto, 60, 2e6, &mut clock);
        assert_eq!(
            (auto.choice().codec, auto.choice().reason),
            (Codec::Video, Reason::OnlyOneThatKeepsUp)
        );
        run(&mut auto, 120, 40e6, &mut clock);
        assert_eq!(auto.choice().codec, Codec::Image);
        let mut lossless = Auto::new(Schema::Image, None);
        run(&mut lossless, 60, 2e6, &mut clock);
        assert_eq!(
            (lossless.choice().codec, lossless.choice().reason),
            (Codec::Image, Reason::LeastLate)
        );
    }

    #[test]
    fn a_deadline_that_no_lossless_codec_keeps_is_a_reason_for_a_lossy_one() {
        let mut clock = 0;
        // 250 kB in 25 ms: with the rate it keeps up.
        let mut auto = Auto::new(Schema::Image, Some(Codec::Jpeg));
        run(&mut auto, 60, 10.5e6, &mut clock);
        assert_eq!(auto.choice().codec, Codec::Image);
        auto.within(Some(Duration::from_millis(15)));
        run(&mut auto, 60, 10.5e6, &mut clock);
        assert_eq!(
            (auto.choice().codec, auto.choice().reason),
            (Codec::Jpeg, Reason::OnlyOneThatKeepsUp)
        );
        // Over a quicker link nothing need be lost.
        run(&mut auto, 120, 60e6, &mut clock);
        assert_eq!(auto.choice().codec, Codec::Image);
        // Where nothing may be, the deadline changes nothing.
        let mut lossless = Auto::new(Schema::Image, None);
        lossless.within(Some(Duration::from_millis(15)));
        run(&mut lossless, 60, 10.5e6, &mut clock);
        assert_eq!(lossless.choice().reason, Reason::Fastest);
    }

    #[test]
    fn a_wavering_link_does_not_make_it_waver() {
        let mut auto = Auto::new(Schema::Image, None);
        let mut clock = 0;
        // Around the point where raw and image take the same time: 1 MB / 150 MB/s = 6.7 ms.
        for round in 0..200 {
            run(
                &mut auto,
                3,
                if round % 2 == 0 { 140e6 } else { 165e6 },
                &mut clock,
            );
        }
        assert!(auto.choice().switches <= 1, "{}", auto.choice().switches);
    }

    #[test]
    fn every_candidate_is_tried_at_first_and_again_later() {
        let mut auto = Auto::new(Schema::Other, None);
        let mut clock = 0;
        run(&mut auto, 4, 10e6, &mut clock);
        assert!(
            auto.choice()
                .expected
                .iter()
                .all(|(estimate, _)| estimate.samples == 1)
        );
        run(&mut auto, 400, 10e6, &mut clock);
        assert!(
            auto.choice()
                .expected
                .iter()
                .all(|(estimate, _)| estimate.samples > 1)
        );
    }

    #[test]
    fn a_message_goes_through() {
        let mut auto = Auto::new(Schema::Other, None);
        let mut encoder = Encoder::new(Schema::Other);
        let mut decoder = crate::Decoder::new(1000);
        for round in 0..10 {
            let mut frame = Vec::new();
            auto.encode(
                &mut encoder,
                &[7; 1000],
                || Duration::from_millis(round),
                &mut frame,
            );
            let mut back = Vec::new();
            decoder.decode(&frame, &mut back).unwrap();
            assert_eq!(back, [7; 1000]);
        }
    }
}
