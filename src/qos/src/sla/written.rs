//! The serialized form of an SLA, and its validation.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Deserialize;

use super::{LocalPolicy, Measure, Mode, QosSla, SafeStop, Times, WarmStart};
use crate::pair::TopicPair;
use crate::satisfaction::{DEFAULT_CAP, next_below};
use crate::sla_error::SlaError;
use crate::span::{LONGEST, Span};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawSla {
    t_desire: Option<Span>,
    t_max: Option<Span>,
    #[serde(default = "default_threshold")]
    threshold: f64,
    initial: Option<f64>,
    cap: Option<f64>,
    unreached: Option<Span>,
    #[serde(default)]
    mode: Mode,
    #[serde(default)]
    local: LocalPolicy,
    warm: Option<WarmStart>,
    #[serde(default)]
    measure: RawMeasure,
    answers: Option<Vec<TopicPair>>,
    safe_stop: Option<SafeStop>,
    #[serde(default)]
    requests: BTreeMap<String, RawTimes>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "snake_case")]
enum RawMeasure {
    #[default]
    Rrt,
    FramesPerSecond(RawRate),
    Age(RawAge),
    Link(RawLink),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRate {
    #[serde(default)]
    output: String,
    desire: f64,
    min: f64,
    #[serde(default = "default_over")]
    over: usize,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawAge {
    #[serde(default)]
    output: String,
    desire: Span,
    max: Span,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawLink {
    after: Span,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawTimes {
    t_desire: Span,
    t_max: Span,
}

/// Default for `unreached`: about the time a servant takes to start.
const UNREACHED: Duration = Duration::from_secs(3);

fn default_threshold() -> f64 {
    4.0
}

fn default_over() -> usize {
    5
}

impl RawSla {
    pub(super) fn check(self) -> Result<QosSla, SlaError> {
        check_positive("threshold", self.threshold)?;
        let initial = self.initial.unwrap_or(2.0 * self.threshold);
        check_positive("initial", initial)?;
        let cap = self.cap.unwrap_or(DEFAULT_CAP * self.threshold);
        // Q must be able to exceed the threshold, or the local original would never be stopped.
        if cap.is_nan() || next_below(cap) <= self.threshold {
            return Err(SlaError::new(
                "cap",
                format!(
                    "{cap} is not above threshold ({}); raise it, or remove it for {DEFAULT_CAP} times the threshold",
                    self.threshold
                ),
            ));
        }
        if self.warm.is_some() && self.local != LocalPolicy::Warm {
            return Err(SlaError::new(
                "warm",
                "says when a warm local original starts, but local is not \"warm\"; set local = \"warm\" or remove it",
            ));
        }
        let (measure, times) = match self.measure {
            RawMeasure::Rrt => {
                let times = Times::check("", self.t_desire, self.t_max)?;
                (Measure::Rrt, times)
            }
            measure => {
                // The measure has limits of its own; a second pair would contradict it.
                for (field, given) in [("t_desire", self.t_desire), ("t_max", self.t_max)] {
                    if given.is_some() {
                        return Err(SlaError::new(
                            field,
                            "belongs to the response time, but measure selects another one; remove it, or remove \
                                measure",
                        ));
                    }
                }
                measure.check()?
            }
        };
        let mut requests = BTreeMap::new();
        for (name, times) in self.requests {
            let field = format!("requests.{name}.");
            let times = Times::check(&field, Some(times.t_desire), Some(times.t_max))?;
            requests.insert(name, times);
        }
        if let Some(stop) = &self.safe_stop {
            check_absolute("safe_stop.topic", &stop.topic)?;
            if stop.type_name.split('/').filter(|part| !part.is_empty()).count() != 2 {
                return Err(SlaError::new(
                    "safe_stop.type",
                    format!("{:?} is not written as package/Type", stop.type_name),
                ));
            }
        }
        Ok(QosSla {
            t_desire: times.t_desire,
            t_max: times.t_max,
            threshold: self.threshold,
            initial,
            cap,
            unreached: match self.unreached {
                Some(span) => span.duration(),
                None => UNREACHED.max(times.t_max),
            },
            mode: self.mode,
            local: self.local,
            warm: self.warm.unwrap_or_default(),
            measure,
            answers: self.answers,
            safe_stop: self.safe_stop,
            requests,
        })
    }
}

impl RawMeasure {
    fn check(self) -> Result<(Measure, Times), SlaError> {
        match self {
            Self::Rrt => unreachable!("the caller has checked this"),
            Self::FramesPerSecond(rate) => {
                check_absolute_or_empty("measure.frames_per_second.output", &rate.output)?;
                check_positive("measure.frames_per_second.desire", rate.desire)?;
                check_positive("measure.frames_per_second.min", rate.min)?;
                if rate.min > rate.desire {
                    return Err(SlaError::new(
                        "measure.frames_per_second.min",
                        format!("{} is above desire ({}); lower it", rate.min, rate.desire),
                    ));
                }
                if !(1..=1000).contains(&rate.over) {
                    return Err(SlaError::new(
                        "measure.frames_per_second.over",
                        format!("{} frames; write 1 to 1000", rate.over),
                    ));
                }
                let times = Times {
                    t_desire: frame_interval("measure.frames_per_second.desire", rate.desire)?,
                    t_max: frame_interval("measure.frames_per_second.min", rate.min)?,
                };
                let measure = Measure::FramesPerSecond { output: rate.output, over: rate.over };
                Ok((measure, times))
            }
            Self::Age(age) => {
                check_absolute_or_empty("measure.age.output", &age.output)?;
                let desire = age.desire.duration();
                let max = age.max.duration();
                if max < desire {
                    return Err(SlaError::new(
                        "measure.age.max",
                        format!("{max:?} is below desire ({desire:?}); raise it"),
                    ));
                }
                let times = Times { t_desire: desire, t_max: max };
                Ok((Measure::Age { output: age.output }, times))
            }
            Self::Link(link) => {
                let after = link.after.duration();
                // Requests wait as long as their callers do.
                let times = Times { t_desire: LONGEST, t_max: LONGEST };
                Ok((Measure::Link { after }, times))
            }
        }
    }
}

impl Times {
    fn check(prefix: &str, desire: Option<Span>, max: Option<Span>) -> Result<Self, SlaError> {
        let given = |name: &str, value: Option<Span>| {
            let missing = "is missing; give it in seconds, such as 0.3";
            let missing = || SlaError::new(&format!("{prefix}{name}"), missing);
            value.map(Span::duration).ok_or_else(missing)
        };
        let t_desire = given("t_desire", desire)?;
        let t_max = given("t_max", max)?;
        if t_max < t_desire {
            return Err(SlaError::new(
                &format!("{prefix}t_max"),
                format!("{t_max:?} is below t_desire ({t_desire:?}); raise it"),
            ));
        }
        Ok(Self { t_desire, t_max })
    }
}

fn check_absolute(field: &str, topic: &str) -> Result<(), SlaError> {
    if topic.len() > 1 && topic.starts_with('/') {
        return Ok(());
    }
    Err(SlaError::new(field, format!("{topic:?} is not an absolute topic name; begin it with a slash")))
}

/// Checks a topic name that may be empty, which stands for the output that answers the first detected request.
fn check_absolute_or_empty(field: &str, topic: &str) -> Result<(), SlaError> {
    if topic.is_empty() {
        return Ok(());
    }
    check_absolute(field, topic)
}

/// Returns the interval between two frames at `rate`.
fn frame_interval(field: &str, rate: f64) -> Result<Duration, SlaError> {
    let interval = Span::from_seconds(1.0 / rate).map(Span::duration);
    interval.ok_or_else(|| {
        let reason = format!("{rate} frames per second are not between one per day and a billion");
        SlaError::new(field, reason)
    })
}

fn check_positive(field: &str, value: f64) -> Result<(), SlaError> {
    if value.is_finite() && value > 0.0 && (4.0 * value).is_normal() {
        return Ok(());
    }
    Err(SlaError::new(field, format!("{value} is not a positive number")))
}
