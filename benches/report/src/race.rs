//! Compares runners in turns, so that disturbances affect all of them, and by processor time, so that few do.

use rustix::time::{ClockId, clock_gettime};
use std::time::Duration;

use crate::quantile_seconds;

/// Run times of one runner.
#[derive(Clone, Debug)]
pub struct Times {
    /// Name of the runner.
    pub name: String,
    /// Times, shortest first.
    pub sorted: Vec<Duration>,
}

impl Times {
    /// Shortest time: the cost of the code without disturbances.
    pub fn best(&self) -> Duration {
        self.sorted.first().copied().unwrap_or_default()
    }

    /// Longest time.
    pub fn longest(&self) -> Duration {
        self.sorted.last().copied().unwrap_or_default()
    }

    /// Median time in milliseconds.
    pub fn median_milliseconds(&self) -> f64 {
        quantile_seconds(&self.sorted, 0.5) * 1e3
    }

    /// [`Times::best`] in microseconds.
    pub fn best_micros(&self) -> f64 {
        self.best().as_secs_f64() * 1e6
    }

    /// Throughput in megabytes (10⁶) per second at the best time, for `bytes` per run.
    pub fn megabytes_per_second(&self, bytes: usize) -> f64 {
        bytes as f64 / 1e6 / self.best().as_secs_f64().max(1e-12)
    }
}

/// Returns the processor time of this thread so far, which does not include time taken by other work.
pub fn thread_processor_time() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// Runs several functions in turns on this thread and measures the thread's processor time.
pub struct Race<'a> {
    rounds: usize,
    runners: Vec<(String, Box<dyn FnMut() + 'a>)>,
}

impl<'a> Race<'a> {
    /// Creates a race of `rounds` counted rounds, preceded by one warm-up round.
    pub fn new(rounds: usize) -> Self {
        Self { rounds, runners: Vec::new() }
    }

    /// Adds a runner. Results of the computation should go through [`std::hint::black_box`].
    pub fn add(&mut self, name: impl Into<String>, runner: impl FnMut() + 'a) -> &mut Self {
        self.runners.push((name.into(), Box::new(runner)));
        self
    }

    /// Runs all runners; returns their times in the order in which they were added.
    pub fn run(mut self) -> Vec<Times> {
        let mut times: Vec<Times> =
            self.runners.iter().map(|(name, _)| Times { name: name.clone(), sorted: Vec::new() }).collect();
        for round in 0..=self.rounds {
            for ((_, runner), times) in self.runners.iter_mut().zip(&mut times) {
                let start = thread_processor_time();
                runner();
                let took = thread_processor_time() - start;
                if round > 0 {
                    times.sorted.push(took);
                }
            }
        }
        times.iter_mut().for_each(|times| times.sorted.sort_unstable());
        times
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runners_take_turns() {
        let order = std::cell::RefCell::new(String::new());
        let mut race = Race::new(2);
        race.add("a", || order.borrow_mut().push('a')).add("b", || order.borrow_mut().push('b'));
        let times = race.run();
        assert_eq!(order.into_inner(), "ababab");
        assert_eq!(times.iter().map(|times| times.sorted.len()).collect::<Vec<_>>(), [2, 2]);
        assert!(times[0].best() <= times[0].longest());
    }
}
