//! Meters for the rate and the age of an output.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::sla::{Measure, QosSla};

/// Smallest time after T_max: an output that arrives exactly at T_max is still in time.
const PAST: Duration = Duration::from_nanos(1);

/// Turns the outputs of one side on one topic into times for the satisfaction algorithm.
///
/// - Frames per second: T is the mean interval of the last `over` frames.
/// - Age: T is the age that an output has reached when the next one arrives.
///
/// A missing output counts as well: at the moment when T exceeds T_max, and again after each further T_max. Outputs are
/// expected from [`start`](Self::start) on.
#[derive(Debug, Clone)]
pub struct Meter {
    kind: Kind,
    t_max: Duration,
    /// Time at which the next missing output counts, right after T exceeds T_max. `None` before the start.
    deadline: Option<Instant>,
    /// The expected output was counted as missing already and must not count again when it comes.
    counted: bool,
}

#[derive(Debug, Clone)]
enum Kind {
    /// Arrival times, newest last; at most `over + 1`.
    Rate { over: usize, arrivals: VecDeque<Instant> },
    /// Time of the newest output's stamp.
    Age { born: Option<Instant> },
}

impl Meter {
    /// Creates the meter for an SLA's measure, with the topic it observes; `None` if the measure is the response time
    /// or the link.
    pub fn new(sla: &QosSla) -> Option<(&str, Self)> {
        let (output, kind) = match &sla.measure {
            Measure::Rrt | Measure::Link { .. } => return None,
            Measure::FramesPerSecond { output, over } => {
                let arrivals = VecDeque::new();
                (output, Kind::Rate { over: *over, arrivals })
            }
            Measure::Age { output } => (output, Kind::Age { born: None }),
        };
        let meter = Self { kind, t_max: sla.t_max, deadline: None, counted: false };
        Some((output, meter))
    }

    /// Starts expecting outputs. Later calls have no effect.
    pub fn start(&mut self, now: Instant) {
        self.deadline.get_or_insert(now + self.t_max + PAST);
    }

    /// Stops expecting outputs (without a subscriber, say) and forgets earlier ones.
    pub fn stop(&mut self) {
        self.deadline = None;
        self.counted = false;
        match &mut self.kind {
            Kind::Rate { arrivals, .. } => arrivals.clear(),
            Kind::Age { born } => *born = None,
        }
    }

    /// Records an output that arrived `age` after its stamp (zero without a stamp), and returns T, or `None` if there
    /// is no earlier output to compare with. [`take_missed`](Self::take_missed) must have been called for `now` before.
    /// While outputs are not expected nothing is recorded, because an output in flight when the last subscriber left is
    /// followed by none.
    pub fn output(&mut self, now: Instant, age: Duration) -> Option<Duration> {
        self.deadline?;
        let counted = std::mem::take(&mut self.counted);
        match &mut self.kind {
            Kind::Rate { over, arrivals } => {
                if counted {
                    arrivals.clear();
                }
                arrivals.push_back(now);
                if arrivals.len() > *over + 1 {
                    arrivals.pop_front();
                }
                // With the next frame the mean covers one more interval, up to `over`; it exceeds T_max once those
                // intervals have used up their time.
                let next = arrivals.len().min(*over);
                let used = next as u32 * self.t_max;
                let due = arrivals[arrivals.len() - next] + used;
                self.deadline = Some(due.max(now + self.t_max) + PAST);
                let intervals = arrivals.len() as u32 - 1;
                (intervals > 0).then(|| (now - arrivals[0]) / intervals)
            }
            Kind::Age { born } => {
                let this = now.checked_sub(age).unwrap_or(now);
                let before = born.replace(this).filter(|_| !counted);
                self.deadline = Some((this + self.t_max + PAST).max(now));
                before.map(|before| now - before)
            }
        }
    }

    /// Returns the time at which [`take_missed`](Self::take_missed) is to be called next.
    pub fn deadline(&self) -> Option<Instant> {
        self.deadline
    }

    /// Returns how many outputs have gone missing since the last call.
    pub fn take_missed(&mut self, now: Instant) -> u32 {
        let mut missed = 0;
        while let Some(deadline) = self.deadline.filter(|deadline| *deadline <= now) {
            missed += 1;
            self.counted = true;
            self.deadline = Some(deadline + self.t_max);
            // Q has reached its minimum long before.
            if missed == 1000 {
                self.deadline = Some(now + self.t_max);
            }
        }
        missed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meter(text: &str) -> Meter {
        let sla = QosSla::parse(toml::Deserializer::parse(text).unwrap()).unwrap();
        Meter::new(&sla).unwrap().1
    }

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn frames_are_averaged_and_a_stall_counts_while_it_lasts() {
        let mut meter = meter("measure.frames_per_second = { output = '/m', desire = 10, min = 4, over = 2 }");
        let start = Instant::now();
        meter.start(start);
        assert_eq!(meter.take_missed(start + 250 * MS), 0, "it is still in time");
        assert_eq!(meter.output(start + 250 * MS, Duration::ZERO), None);
        assert_eq!(meter.output(start + 329 * MS, Duration::ZERO), Some(79 * MS));
        assert_eq!(meter.output(start + 449 * MS, Duration::ZERO), Some(99_500 * MS / 1000));
        // 329 and 449 are two arrivals; with one more their mean is 250 ms at 329 + 500.
        assert_eq!(meter.take_missed(start + 829 * MS), 0, "it is still in time");
        assert_eq!(meter.deadline(), Some(start + 829 * MS + PAST));
        assert_eq!(meter.take_missed(start + 1100 * MS), 2);
        // The gap was counted twice already; the frame that ends it starts a new mean.
        assert_eq!(meter.output(start + 1100 * MS, Duration::ZERO), None);
        assert_eq!(meter.output(start + 1200 * MS, Duration::ZERO), Some(100 * MS));
    }

    #[test]
    fn an_output_is_as_old_as_it_was_when_the_next_came() {
        let mut meter = meter("measure.age = { output = '/m', desire = 0.5, max = 1 }");
        let start = Instant::now() + Duration::from_secs(100);
        meter.start(start);
        assert_eq!(meter.output(start + 500 * MS, 200 * MS), None);
        assert_eq!(meter.output(start + 1200 * MS, 100 * MS), Some(900 * MS));
        assert_eq!(meter.take_missed(start + 2100 * MS), 0);
        assert_eq!(meter.take_missed(start + 2100 * MS + PAST), 1);
        assert_eq!(meter.output(start + 2200 * MS, Duration::ZERO), None);
        assert_eq!(meter.output(start + 2300 * MS, Duration::ZERO), Some(100 * MS));
    }

    #[test]
    fn an_output_that_is_too_old_when_it_comes_counts_once() {
        let mut meter = meter("measure.age = { output = '/m', desire = 0.5, max = 1 }");
        let start = Instant::now() + Duration::from_secs(100);
        meter.start(start);
        assert_eq!(meter.output(start, 3000 * MS), None);
        assert_eq!(meter.take_missed(start), 1);
        assert_eq!(meter.output(start + 100 * MS, Duration::ZERO), None);
    }

    #[test]
    fn nothing_is_missed_while_nobody_waits() {
        let mut meter = meter("measure.age = { output = '/m', desire = 0.5, max = 1 }");
        let start = Instant::now();
        assert_eq!(meter.take_missed(start + Duration::from_secs(60)), 0);
        meter.start(start);
        meter.stop();
        assert_eq!(meter.take_missed(start + Duration::from_secs(60)), 0);
    }
}
