//! How requests follow one another: never before the last was answered.

use std::time::Duration;

use tokio::time::Instant;

/// How requests follow one another, and how many.
#[derive(Debug, Clone)]
pub struct Pace {
    /// The input whose messages are the requests; none: the first that is fed.
    pub input: Option<String>,
    /// Requests whose times are told, at most.
    pub requests: usize,
    /// The messages come again and again.
    pub again: bool,
    /// From one request to the next, at least.
    pub gap: Gap,
    /// How long an answer is waited for.
    pub answer: Duration,
    /// How long all of it may take.
    pub whole: Duration,
    /// So many requests in vain, one after the other, end it.
    pub in_vain: Option<usize>,
}

/// From one request to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Gap {
    /// Nothing: each follows the answer before it.
    None,
    /// As it was recorded.
    Recorded,
    /// So many requests a second.
    Rate(f64),
}

impl Pace {
    /// Each message once, as fast as it is answered.
    pub fn once(answer: Duration) -> Pace {
        Pace {
            input: None,
            requests: usize::MAX,
            again: false,
            gap: Gap::None,
            answer,
            whole: Duration::from_secs(24 * 3600),
            in_vain: None,
        }
    }
}

/// When messages are due. Of time that was lost, no more is made up for than lies between two requests.
pub(super) struct Clock {
    began: Instant,
    /// Of a round, as recorded.
    length: Duration,
    /// What a recorded time is multiplied by.
    scale: f64,
    /// Requests a second.
    pace: Option<f64>,
}

impl Clock {
    /// For rounds of this length and so many requests.
    pub(super) fn new(length: Duration, requests: usize, gap: Gap) -> Clock {
        let recorded = requests as f64 / length.as_secs_f64();
        let scale = match gap {
            Gap::None => 0.0,
            Gap::Recorded => 1.0,
            Gap::Rate(rate) => recorded / rate,
        };
        // A recording of one message has no pace of its own.
        let scale = if recorded.is_finite() { scale } else { 0.0 };
        Clock {
            began: Instant::now(),
            length,
            scale,
            pace: (scale > 0.0).then(|| recorded / scale),
        }
    }

    /// Requests a second that are to be made.
    pub(super) fn pace(&self) -> Option<f64> {
        self.pace
    }

    /// When a message of this round, recorded `at` since the first, is to be published: now or later.
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
        let mut clock = Clock::new(400 * MS, 4, Gap::Recorded);
        assert_eq!(clock.pace(), Some(10.0));
        let since = |due: Instant| due.duration_since(began).as_millis();
        assert_eq!(since(clock.due(0, 100 * MS)), 100);
        // A little late: the next comes when it would have come.
        tokio::time::advance(150 * MS).await;
        assert_eq!(since(clock.due(0, 100 * MS)), 150);
        assert_eq!(since(clock.due(0, 200 * MS)), 200);
        // The answer took as long as three requests: but one of them is made up for.
        tokio::time::advance(350 * MS).await;
        assert_eq!(since(clock.due(0, 200 * MS)), 500);
        assert_eq!(since(clock.due(0, 300 * MS)), 500);
        assert_eq!(since(clock.due(1, Duration::ZERO)), 600);
    }

    #[tokio::test(start_paused = true)]
    async fn a_rate_takes_the_place_of_the_recorded_pace() {
        let began = Instant::now();
        let mut clock = Clock::new(400 * MS, 4, Gap::Rate(20.0));
        assert_eq!(clock.pace(), Some(20.0));
        assert_eq!(clock.due(1, 100 * MS).duration_since(began), 250 * MS);
        let mut clock = Clock::new(400 * MS, 4, Gap::None);
        assert_eq!((clock.pace(), clock.due(3, 100 * MS)), (None, began));
        // One message has no pace.
        let clock = Clock::new(Duration::ZERO, 1, Gap::Recorded);
        assert_eq!(clock.pace(), None);
        assert_eq!(Clock::new(Duration::ZERO, 1, Gap::Rate(5.0)).pace(), None);
    }
}
