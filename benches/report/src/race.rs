//! Compares runners in turns, so that disturbances affect all of them, and by processor time, so that few do.

use rustix::time::{ClockId, clock_gettime};
use std::time::Duration;

/// Run times of one runner.
#[derive(Clone, Debug)]
pub struct Times {
    /// Name of the runner.
    pub name: String,
    /// Times, shortest first.
    pub sorted: Vec<Duration>,
}

/// Returns the quantile of `values` at a fraction `0.0..=1.0`; `None` for an empty slice.
pub fn quantile<T: Copy + PartialOrd>(values: &[T], fraction: f64) -> Option<T> {
    let mut sorted = values.to_vec();
    sorted.sort_by(|one, other| one.partial_cmp(other).unwrap_or(std::cmp::Ordering::Equal));
    quantile_of_sorted(&sorted, fraction)
}

fn quantile_of_sorted<T: Copy>(sorted: &[T], fraction: f64) -> Option<T> {
    let last = sorted.len().checked_sub(1)?;
    sorted
        .get((fraction * last as f64).round() as usize)
        .copied()
}

impl Times {
    /// Shortest time: the cost of the code without disturbances.
    pub fn best(&self) -> Duration {
        self.quantile(0.0)
    }

    /// Median time.
    pub fn median(&self) -> Duration {
        self.quantile(0.5)
    }

    /// Quantile of the times at a fraction `0.0..=1.0`.
    pub fn quantile(&self, fraction: f64) -> Duration {
        quantile_of_sorted(&self.sorted, fraction).unwrap_or_default()
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

/// Returns the processor time of the child processes that have ended and been waited for.
pub fn children_processor_time() -> Duration {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The fields after the name in parentheses start with state, field 3; cutime and cstime are 16 and 17, in
    // hundredths of a second.
    let fields = text
        .rsplit(')')
        .next()
        .unwrap_or_default()
        .split_whitespace();
    let ticks: u64 = fields
        .skip(13)
        .take(2)
        .filter_map(|field| field.parse::<u64>().ok())
        .sum();
    Duration::from_millis(ticks * 10)
}

/// Runs several functions in turns on this thread and measures the thread's processor time.
pub struct Race<'a> {
    rounds: usize,
    runners: Vec<(String, Box<dyn FnMut() + 'a>)>,
}

impl<'a> Race<'a> {
    /// Creates a race of `rounds` counted rounds, preceded by one warm-up round.
    pub fn new(rounds: usize) -> Self {
        Self {
            rounds,
            runners: Vec::new(),
        }
    }

    /// Adds a runner. Results of the computation should go through [`std::hint::black_box`].
    pub fn add(&mut self, name: impl Into<String>, runner: impl FnMut() + 'a) -> &mut Self {
        self.runners.push((name.into(), Box::new(runner)));
        self
    }

    /// Runs all runners; returns their times in the order in which they were added.
    pub fn run(mut self) -> Vec<Times> {
        let mut times: Vec<Times> = self
            .runners
            .iter()
            .map(|(name, _)| Times {
                name: name.clone(),
                sorted: Vec::new(),
            })
            .collect();
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
        times
            .iter_mut()
            .for_each(|times| times.sorted.sort_unstable());
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
        race.add("a", || order.borrow_mut().push('a'))
            .add("b", || order.borrow_mut().push('b'));
        let times = race.run();
        assert_eq!(order.into_inner(), "ababab");
        assert_eq!(
            times
                .iter()
                .map(|times| times.sorted.len())
                .collect::<Vec<_>>(),
            [2, 2]
        );
        assert!(times[0].best() <= times[0].median());
    }
}
