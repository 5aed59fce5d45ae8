//! Replay of recorded requests: gives a recording or images to a servant and reports its responses and their times.
//! This allows choosing T_desire and T_max before a robot is involved ([`api::trial`]), and comparing limits
//! ([`api::calibration`]).

mod ears;
mod pace;
mod picture;
mod plan;

use std::sync::Arc;
use std::time::{Duration, Instant};

use api::trial::{Fed, Heard, Times, Trial};
use package::interface::Interface;
use ros::bag::BagMessage;
use ros::bus::{Bus, Publisher, RosVersion, wait_for_connected};
use ros::schema::Registry;
use tokio::time::timeout;

pub use pace::{ReplayPace, RequestGap};
pub use picture::Picture;

use crate::Error;
use ears::OutputListeners;
use pace::ReplayClock;
use plan::{PlannedInput, ReplayPlan};

/// Minimum timeout for the servant's nodes to subscribe, and for the first response.
const PATIENCE: Duration = Duration::from_secs(10);
/// Maximum number of messages used from a recording.
pub const MAX_RECORDED: usize = 300;
const QUEUE: usize = 16;

/// Input of a replay.
#[derive(Debug, Clone)]
pub enum Material {
    /// Images, repeated cyclically.
    Pictures(Vec<Picture>),
    /// A recording.
    Bag(Vec<BagMessage>),
}

/// Result of a replay.
#[derive(Debug, Clone, Default)]
pub struct Replay {
    /// Messages published to the servant.
    pub inputs: Vec<Fed>,
    /// Topics of the recording for which it has no input.
    pub unused: Vec<String>,
    /// Messages published by the servant.
    pub outputs: Vec<Heard>,
    /// Size of the largest request in bytes.
    pub largest: usize,
    /// Intended requests per second; `None` if each followed the response before it.
    pub pace: Option<f64>,
    /// Actual requests per second.
    pub rate: f64,
    /// Response times of the requests in order; `None` for unanswered ones. The first request is not included, because
    /// it involves initialization.
    pub times: Vec<Option<Duration>>,
}

/// Returns an error if a service with this interface has no input for the material, or if the material does not feed
/// `input`.
pub fn check_material(
    (service, ros): (&str, RosVersion),
    interface: &Interface,
    material: &Material,
    input: Option<&str>,
) -> Result<(), Error> {
    let registry = build_registry((service, ros), interface)?;
    ReplayPlan::new(interface, &registry, material, input).map(|_| ())
}

fn build_registry((service, ros): (&str, RosVersion), interface: &Interface) -> Result<Registry, Error> {
    Registry::with_definitions(ros, &interface.definitions)
        .map_err(|error| Error::Trial(format!("a definition of {service}: {error}")))
}

/// Replays `material` to a servant of `service`, which has this interface.
pub(crate) async fn replay(
    bus: &Arc<dyn Bus>,
    service: &str,
    interface: &Interface,
    material: &Material,
    pace: &ReplayPace,
) -> Result<Replay, Error> {
    let registry = build_registry((service, bus.version()), interface)?;
    let plan = ReplayPlan::new(interface, &registry, material, pace.input.as_deref())?;
    let mut ears = OutputListeners::open(bus, interface).await?;
    let first_answer = pace.answer.max(PATIENCE);
    let mut mouths = Vec::new();
    for PlannedInput { topic, wire_type, qos } in &plan.inputs {
        let publisher = bus.advertise(topic, wire_type.clone(), *qos).await.map_err(trial_error)?;
        let listening = wait_for_connected(publisher.matched_subscribers(), 1);
        if timeout(first_answer, listening).await.is_err() {
            return Err(Error::Trial(format!("no node of {service} listens to {topic}")));
        }
        mouths.push(InputPublisher { publisher, sent: 0 });
    }
    let ends = tokio::time::Instant::now() + pace.whole;
    let mut clock = ReplayClock::new(plan.length, plan.requests(), pace.gap);
    let mut done = ReplayProgress::default();
    let mut warmed_up = false;
    for (turn, item) in plan.items(pace.again).enumerate() {
        if done.times.len() >= pace.requests || done.should_give_up(pace) {
            break;
        }
        let due = clock.due(turn / plan.items.len(), item.at);
        if due >= ends || tokio::time::Instant::now() >= ends {
            break;
        }
        tokio::time::sleep_until(due).await;
        let message = item.content.message(turn, bus.version());
        ears.drain();
        let asked = Instant::now();
        let mouth = &mut mouths[item.input];
        mouth.publisher.publish(message.clone());
        mouth.sent += 1;
        if item.input != plan.request {
            continue;
        }
        done.largest = done.largest.max(message.len());
        let patience = if warmed_up { pace.answer } else { first_answer };
        let stamp = plan.stamp(item.input, &message, &registry);
        let answered = ears.wait_answer(patience, stamp, &registry).await;
        if std::mem::replace(&mut warmed_up, true) {
            let took = answered.map(|at| at.saturating_duration_since(asked));
            done.record(asked, took);
        }
    }
    let fed = plan.inputs.iter().zip(&mouths).enumerate();
    Ok(Replay {
        inputs: fed
            .map(|(number, (input, mouth))| Fed {
                topic: input.topic.clone(),
                type_name: input.wire_type.name.clone(),
                sent: mouth.sent,
                from: plan.source_topics(number),
            })
            .collect(),
        outputs: ears.summarize(&registry),
        unused: plan.unused,
        largest: done.largest,
        pace: clock.pace(),
        rate: done.rate(),
        times: done.times,
    })
}

fn trial_error(error: ros::bus::BusError) -> Error {
    Error::Trial(format!("the trial's servant cannot be used: {error}"))
}

struct InputPublisher {
    publisher: Box<dyn Publisher>,
    sent: usize,
}

/// Requests made so far.
#[derive(Default)]
struct ReplayProgress {
    times: Vec<Option<Duration>>,
    largest: usize,
    /// Times of the first and the last request in `times`.
    made: Option<(Instant, Instant)>,
}

impl ReplayProgress {
    fn record(&mut self, asked: Instant, took: Option<Duration>) {
        self.times.push(took);
        let (first, _) = self.made.unwrap_or((asked, asked));
        self.made = Some((first, asked));
    }

    /// Returns whether the last requests were all in vain.
    fn should_give_up(&self, pace: &ReplayPace) -> bool {
        let in_vain = self.times.iter().rev().take_while(|took| took.is_none());
        pace.in_vain.is_some_and(|most| in_vain.count() >= most)
    }

    fn rate(&self) -> f64 {
        let between = self.made.map_or(Duration::ZERO, |(first, last)| last - first);
        if between.is_zero() {
            return 0.0;
        }
        (self.times.len() - 1) as f64 / between.as_secs_f64()
    }
}

impl Replay {
    /// Converts the result to a trial of `service`.
    pub fn into_trial(self, service: &str) -> Trial {
        let times: Vec<Duration> = self.times.iter().flatten().copied().collect();
        Trial {
            service: service.to_owned(),
            inputs: self.inputs,
            unused: self.unused,
            outputs: self.outputs,
            requests: self.times.len(),
            answered: times.len(),
            rrt: summarize_times(times),
        }
    }
}

/// Computes quantiles (nearest rank) and suggested initial values.
fn summarize_times(mut times: Vec<Duration>) -> Option<Times> {
    times.sort();
    let rank = |percent| Some(qos::nearest_rank(&times, percent)?.as_secs_f64() * 1000.0);
    let (p50, p90, max) = (rank(50)?, rank(90)?, rank(100)?);
    let desire = p50 * 1.5;
    Some(Times { p50, p90, max, desire, acceptable: (p90 * 2.0).max(desire * 2.0) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suggestions_leave_room() {
        let times = (1..=10).map(|n| Duration::from_millis(n * 10)).collect();
        let times = summarize_times(times).expect("times");
        assert_eq!((times.p50, times.p90, times.max), (50.0, 90.0, 100.0));
        assert_eq!((times.desire, times.acceptable), (75.0, 180.0));
        assert_eq!(summarize_times(Vec::new()), None);
    }

    #[test]
    fn requests_in_vain_end_a_replay_when_they_come_one_after_the_other() {
        let pace = ReplayPace { in_vain: Some(2), ..ReplayPace::once(Duration::ZERO) };
        let mut done = ReplayProgress::default();
        let now = Instant::now();
        let some = Some(Duration::from_millis(1));
        for (number, (took, given_up)) in
            [(None, false), (some, false), (None, false), (None, true)].into_iter().enumerate()
        {
            done.record(now + Duration::from_millis(100 * number as u64), took);
            assert_eq!(done.should_give_up(&pace), given_up, "{:?}", done.times);
        }
        assert!((done.rate() - 10.0).abs() < 1e-9, "{}", done.rate());
        assert_eq!(ReplayProgress::default().rate(), 0.0);
    }
}
