//! Timing of replayed requests: a request never precedes the response to the previous one.

use std::time::Duration;

use tokio::time::Instant;

/// Timing and number of requests.
#[derive(Debug, Clone)]
pub struct ReplayPace {
    /// Input whose messages are the requests; by default the first one that is fed.
    pub input: Option<String>,
    /// Maximum number of requests whose times are reported.
    pub requests: usize,
    /// Repeat the messages.
    pub again: bool,
    /// Minimum time from one request to the next.
    pub gap: RequestGap,
    /// Timeout of a response.
    pub answer: Duration,
    /// Maximum total duration.
    pub whole: Duration,
    /// Number of consecutive unanswered requests that end the replay.
    pub in_vain: Option<usize>,
}

/// Time from one request to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RequestGap {
    /// None: each request follows the response before it.
    None,
    /// The pace of the recording.
    Recorded,
    /// A rate in requests per second.
    Rate(f64),
}

impl ReplayPace {
    /// Creates a timing in which each message is sent once, as fast as it is answered.
    pub fn once(answer: Duration) -> ReplayPace {
        ReplayPace {
            input: None,
            requests: usize::MAX,
            again: false,
            gap: RequestGap::None,
            answer,
            whole: Duration::from_secs(24 * 3600),
            in_vain: None,
        }
    }
}

/// Schedule of the messages. Lost time is made up for by at most one request interval.
pub(super) struct ReplayClock {
    began: Instant,
    /// Recorded length of a round.
    length: Duration,
    /// Factor on recorded times.
    scale: f64,
    /// Requests per second.
    pace: Option<f64>,
}

impl ReplayClock {
    /// Creates a schedule for rounds of this length with this many requests.
    pub(super) fn new(length: Duration, requests: usize, gap: RequestGap) -> ReplayClock {
        let recorded = requests as f64 / length.as_secs_f64();
        let scale = match gap {
            RequestGap::None => 0.0,
            RequestGap::Recorded => 1.0,
            RequestGap::Rate(rate) => recorded / rate,
        };
        // A recording of one message has no rate.
        let scale = if recorded.is_finite() { scale } else { 0.0 };
        ReplayClock { began: Instant::now(), length, scale, pace: (scale > 0.0).then(|| recorded / scale) }
    }

    /// Returns the intended requests per second.
    pub(super) fn pace(&self) -> Option<f64> {
        self.pace
    }

    /// Returns when a message of this round, recorded `at` after the first, is to be published: now or later.
    pub(super) fn due(&mut self, round: usize, at: Duration) -> Instant {
        let recorded = self.length.as_secs_f64() * round as f64 + at.as_secs_f64();
        let due = self.began + Duration::from_secs_f64(recorded * self.scale);
        let now = Instant::now();
        if let Some(pace) = self.pace {
            let late = now.saturating_duration_since(due);
            self.began += late.saturating_sub(Duration::from_secs_f64(1.0 / pace));
        }
        due.max(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[tokio::test(start_paused = true)]
    async fn messages_are_due_as_recorded_and_no_crowd_of_them_follows_a_long_answer() {
        let began = Instant::now();
        let mut clock = ReplayClock::new(400 * MS, 4, RequestGap::Recorded);
        assert_eq!(clock.pace(), Some(10.0));
        let since = |due: Instant| due.duration_since(began).as_millis();
        assert_eq!(since(clock.due(0, 100 * MS)), 100);
        // Slightly late: the next one keeps its time.
        tokio::time::advance(150 * MS).await;
        assert_eq!(since(clock.due(0, 100 * MS)), 150);
        assert_eq!(since(clock.due(0, 200 * MS)), 200);
        // The response took as long as three requests, of which one is made up for.
        tokio::time::advance(350 * MS).await;
        assert_eq!(since(clock.due(0, 200 * MS)), 500);
        assert_eq!(since(clock.due(0, 300 * MS)), 500);
        assert_eq!(since(clock.due(1, Duration::ZERO)), 600);
    }

    #[tokio::test(start_paused = true)]
    async fn a_rate_takes_the_place_of_the_recorded_pace() {
        let began = Instant::now();
        let mut clock = ReplayClock::new(400 * MS, 4, RequestGap::Rate(20.0));
        assert_eq!(clock.pace(), Some(20.0));
        assert_eq!(clock.due(1, 100 * MS).duration_since(began), 250 * MS);
        let mut clock = ReplayClock::new(400 * MS, 4, RequestGap::None);
        assert_eq!((clock.pace(), clock.due(3, 100 * MS)), (None, began));
        // One message has no rate.
        let clock = ReplayClock::new(Duration::ZERO, 1, RequestGap::Recorded);
        assert_eq!(clock.pace(), None);
        assert_eq!(ReplayClock::new(Duration::ZERO, 1, RequestGap::Rate(5.0)).pace(), None);
    }
}
