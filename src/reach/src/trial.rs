//! What a servant makes of recorded requests: it is given a recording or pictures, and what it answers, and when, is told. So
//! T_desire and T_max can be chosen before a robot is touched ([`api::trial`]), and limits be compared
//! ([`api::calibration`]).

mod ears;
mod pace;
mod picture;
mod plan;

use std::sync::Arc;
use std::time::{Duration, Instant};

use api::trial::{Fed, Heard, Times, Trial};
use package::interface::Interface;
use ros::bag::Recorded;
use ros::bus::{Bus, Publisher, RosVersion, reaches};
use ros::schema::Registry;
use tokio::time::timeout;

pub use pace::{Gap, Pace};
pub use picture::Picture;

use crate::Error;
use ears::Ears;
use pace::Clock;
use plan::{Input, Plan};

/// For the servant's nodes to listen, and for the first answer, at least.
const PATIENCE: Duration = Duration::from_secs(10);
/// So much of a recording is used.
pub const RECORDED: usize = 300;
const QUEUE: usize = 16;

/// What a servant is given.
#[derive(Debug, Clone)]
pub enum Material {
    /// Pictures, one after the other, again and again.
    Pictures(Vec<Picture>),
    /// A recording.
    Bag(Vec<Recorded>),
}

/// What a servant has made of it.
#[derive(Debug, Clone, Default)]
pub struct Replay {
    /// What was published to it.
    pub inputs: Vec<Fed>,
    /// Topics of the recording that it has no input for.
    pub unused: Vec<String>,
    /// What it published.
    pub outputs: Vec<Heard>,
    /// Size of the largest request, in bytes.
    pub largest: usize,
    /// Requests a second that were to be made; none where each followed the answer before it.
    pub pace: Option<f64>,
    /// Requests a second that were made.
    pub rate: f64,
    /// Response times of the requests, in their order; none of those that were not answered. The first request is not
    /// among them: much is made at it.
    pub times: Vec<Option<Duration>>,
}

/// Refuses material that a service of this interface has no input for, and an `input` that it does not feed.
pub fn fits(
    (service, ros): (&str, RosVersion),
    interface: &Interface,
    material: &Material,
    input: Option<&str>,
) -> Result<(), Error> {
    let registry = registry((service, ros), interface)?;
    Plan::new(interface, &registry, material, input).map(|_| ())
}

fn registry((service, ros): (&str, RosVersion), interface: &Interface) -> Result<Registry, Error> {
    Registry::of_definitions(ros, &interface.definitions)
        .map_err(|error| Error::Trial(format!("a definition of {service}: {error}")))
}

/// Gives `material` to a servant of the service `service`, which has this interface.
pub(crate) async fn replay(
    bus: &Arc<dyn Bus>,
    service: &str,
    interface: &Interface,
    material: &Material,
    pace: &Pace,
) -> Result<Replay, Error> {
    let registry = registry((service, bus.version()), interface)?;
    let plan = Plan::new(interface, &registry, material, pace.input.as_deref())?;
    let mut ears = Ears::open(bus, interface).await?;
    let first_answer = pace.answer.max(PATIENCE);
    let mut mouths = Vec::new();
    for Input {
        topic,
        wire_type,
        qos,
    } in &plan.inputs
    {
        let publisher = bus
            .advertise(topic, wire_type.clone(), *qos)
            .await
            .map_err(failed)?;
        let listening = reaches(publisher.matched(), 1);
        if timeout(first_answer, listening).await.is_err() {
            return Err(Error::Trial(format!(
                "no node of {service} listens to {topic}"
            )));
        }
        mouths.push(Mouth { publisher, sent: 0 });
    }
    let ends = tokio::time::Instant::now() + pace.whole;
    let mut clock = Clock::new(plan.length, plan.requests(), pace.gap);
    let mut done = Done::default();
    let mut warmed_up = false;
    for (turn, item) in plan.items(pace.again).enumerate() {
        if done.times.len() >= pace.requests || done.is_given_up(pace) {
            break;
        }
        let due = clock.due(turn / plan.items.len(), item.at);
        if due >= ends || tokio::time::Instant::now() >= ends {
            break;
        }
        tokio::time::sleep_until(due).await;
        let message = item.content.message(turn, bus.version());
        ears.forget();
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
        let answered = ears.answer(patience, stamp, &registry).await;
        if std::mem::replace(&mut warmed_up, true) {
            let took = answered.map(|at| at.saturating_duration_since(asked));
            done.note(asked, took);
        }
    }
    let fed = plan.inputs.iter().zip(&mouths).enumerate();
    Ok(Replay {
        inputs: fed
            .map(|(number, (input, mouth))| Fed {
                topic: input.topic.clone(),
                type_name: input.wire_type.name.clone(),
                sent: mouth.sent,
                from: plan.recorded_for(number),
            })
            .collect(),
        outputs: ears.heard(&registry),
        unused: plan.unused,
        largest: done.largest,
        pace: clock.pace(),
        rate: done.rate(),
        times: done.times,
    })
}

fn failed(error: ros::bus::BusError) -> Error {
    Error::Trial(format!("the trial's servant cannot be used: {error}"))
}

struct Mouth {
    publisher: Box<dyn Publisher>,
    sent: usize,
}

/// Requests that were made.
#[derive(Default)]
struct Done {
    times: Vec<Option<Duration>>,
    largest: usize,
    /// When the first and the last of `times` were made.
    made: Option<(Instant, Instant)>,
}

impl Done {
    fn note(&mut self, asked: Instant, took: Option<Duration>) {
        self.times.push(took);
        let (first, _) = self.made.unwrap_or((asked, asked));
        self.made = Some((first, asked));
    }

    /// The last were all in vain.
    fn is_given_up(&self, pace: &Pace) -> bool {
        let in_vain = self.times.iter().rev().take_while(|took| took.is_none());
        pace.in_vain.is_some_and(|most| in_vain.count() >= most)
    }

    fn rate(&self) -> f64 {
        let between = self
            .made
            .map_or(Duration::ZERO, |(first, last)| last - first);
        if between.is_zero() {
            return 0.0;
        }
        (self.times.len() - 1) as f64 / between.as_secs_f64()
    }
}

impl Replay {
    /// As a trial of `service`.
    pub fn into_trial(self, service: &str) -> Trial {
        let times: Vec<Duration> = self.times.iter().flatten().copied().collect();
        Trial {
            service: service.to_owned(),
            inputs: self.inputs,
            unused: self.unused,
            outputs: self.outputs,
            requests: self.times.len(),
            answered: times.len(),
            rrt: summed_up(times),
        }
    }
}

/// Quantiles (nearest rank), and what to begin with.
fn summed_up(mut times: Vec<Duration>) -> Option<Times> {
    times.sort();
    let rank = |percent| Some(qos::nearest_rank(&times, percent)?.as_secs_f64() * 1000.0);
    let (p50, p90, max) = (rank(50)?, rank(90)?, rank(100)?);
    let desire = p50 * 1.5;
    Some(Times {
        p50,
        p90,
        max,
        desire,
        acceptable: (p90 * 2.0).max(desire * 2.0),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suggestions_leave_room() {
        let times = (1..=10).map(|n| Duration::from_millis(n * 10)).collect();
        let times = summed_up(times).expect("times");
        assert_eq!((times.p50, times.p90, times.max), (50.0, 90.0, 100.0));
        assert_eq!((times.desire, times.acceptable), (75.0, 180.0));
        assert_eq!(summed_up(Vec::new()), None);
    }

    #[test]
    fn requests_in_vain_end_a_replay_when_they_come_one_after_the_other() {
        let pace = Pace {
            in_vain: Some(2),
            ..Pace::once(Duration::ZERO)
        };
        let mut done = Done::default();
        let now = Instant::now();
        let some = Some(Duration::from_millis(1));
        for (number, (took, given_up)) in
            [(None, false), (some, false), (None, false), (None, true)]
                .into_iter()
                .enumerate()
        {
            done.note(now + Duration::from_millis(100 * number as u64), took);
            assert_eq!(done.is_given_up(&pace), given_up, "{:?}", done.times);
        }
        assert!((done.rate() - 10.0).abs() < 1e-9, "{}", done.rate());
        assert_eq!(Done::default().rate(), 0.0);
    }
}
