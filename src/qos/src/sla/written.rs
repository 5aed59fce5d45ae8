//! An SLA as it is written, and what must hold of it.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Deserialize;

use super::{Local, Measure, Mode, SafeStop, Sla, Times, Warm};
use crate::pair::Pair;
use crate::satisfaction::{DEFAULT_CAP, below};
use crate::sla_error::SlaError;
use crate::span::{LONGEST, Span};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Written {
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
    local: Local,
    warm: Option<Warm>,
    #[serde(default)]
    measure: WrittenMeasure,
    answers: Option<Vec<Pair>>,
    safe_stop: Option<SafeStop>,
    #[serde(default)]
    requests: BTreeMap<String, WrittenTimes>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "snake_case")]
enum WrittenMeasure {
    #[default]
    Rrt,
    FramesPerSecond(WrittenRate),
    Age(WrittenAge),
    Link(WrittenLink),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenRate {
    #[serde(default)]
    output: String,
    desire: f64,
    min: f64,
    #[serde(default = "default_over")]
    over: usize,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenAge {
    #[serde(default)]
    output: String,
    desire: Span,
    max: Span,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenLink {
    after: Span,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenTimes {
    t_desire: Span,
    t_max: Span,
}

/// Servants that start take about as long.
const UNREACHED: Duration = Duration::from_secs(3);

fn default_threshold() -> f64 {
    4.0
}

fn default_over() -> usize {
    5
}

impl Written {
    pub(super) fn check(self) -> Result<Sla, SlaError> {
        positive("threshold", self.threshold)?;
        let initial = self.initial.unwrap_or(2.0 * self.threshold);
        positive("initial", initial)?;
        let cap = self.cap.unwrap_or(DEFAULT_CAP * self.threshold);
        // Q must be able to rise above the threshold, or the local original would never be stopped.
        if cap.is_nan() || below(cap) <= self.threshold {
            return Err(SlaError::new(
                "cap",
                format!(
                    "{cap} is not above threshold ({}); raise it, or remove it for {DEFAULT_CAP} times the threshold",
                    self.threshold
                ),
            ));
        }
        if self.warm.is_some() && self.local != Local::Warm {
            return Err(SlaError::new(
                "warm",
                "says when a warm local original starts, but local is not \"warm\"; set local = \"warm\" or remove it",
            ));
        }
        let (measure, times) = match self.measure {
            WrittenMeasure::Rrt => {
                let times = Times::check("", self.t_desire, self.t_max)?;
                (Measure::Rrt, times)
            }
            measure => {
                // The measure brings its own limits; a second pair would contradict it.
                for (field, given) in [("t_desire", self.t_desire), ("t_max", self.t_max)] {
                    if given.is_some() {
                        return Err(SlaError::new(
                            field,
                            "belongs to the response time, but measure names another one; remove it, or remove measure",
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
            absolute("safe_stop.topic", &stop.topic)?;
            if stop
                .type_name
                .split('/')
                .filter(|part| !part.is_empty())
                .count()
                != 2
            {
                return Err(SlaError::new(
                    "safe_stop.type",
                    format!("{:?} is not written as package/Type", stop.type_name),
                ));
            }
        }
        Ok(Sla {
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

impl WrittenMeasure {
    fn check(self) -> Result<(Measure, Times), SlaError> {
        match self {
            Self::Rrt => unreachable!("the caller took it"),
            Self::FramesPerSecond(rate) => {
                absolute_or_none("measure.frames_per_second.output", &rate.output)?;
                positive("measure.frames_per_second.desire", rate.desire)?;
                positive("measure.frames_per_second.min", rate.min)?;
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
                    t_desire: interval("measure.frames_per_second.desire", rate.desire)?,
                    t_max: interval("measure.frames_per_second.min", rate.min)?,
                };
                let measure = Measure::FramesPerSecond {
                    output: rate.output,
                    over: rate.over,
                };
                Ok((measure, times))
            }
            Self::Age(age) => {
                absolute_or_none("measure.age.output", &age.output)?;
                let desire = age.desire.duration();
                let max = age.max.duration();
                if max < desire {
                    return Err(SlaError::new(
                        "measure.age.max",
                        format!("{max:?} is below desire ({desire:?}); raise it"),
                    ));
                }
                let times = Times {
                    t_desire: desire,
                    t_max: max,
                };
                Ok((Measure::Age { output: age.output }, times))
            }
            Self::Link(link) => {
                let after = link.after.duration();
                // Requests wait as long as whoever asks does.
                let times = Times {
                    t_desire: LONGEST,
                    t_max: LONGEST,
                };
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

fn absolute(field: &str, topic: &str) -> Result<(), SlaError> {
    if topic.len() > 1 && topic.starts_with('/') {
        return Ok(());
    }
    Err(SlaError::new(
        field,
        format!("{topic:?} is not an absolute topic name; begin it with a slash"),
    ))
}

/// Not given, it is the output that answers the first request that is found.
fn absolute_or_none(field: &str, topic: &str) -> Result<(), SlaError> {
    if topic.is_empty() {
        return Ok(());
    }
    absolute(field, topic)
}

/// The time between two frames of a rate.
fn interval(field: &str, rate: f64) -> Result<Duration, SlaError> {
    let interval = Span::seconds(1.0 / rate).map(Span::duration);
    interval.ok_or_else(|| {
        let reason = format!("{rate} frames a second are not between one a day and a billion");
        SlaError::new(field, reason)
    })
}

fn positive(field: &str, value: f64) -> Result<(), SlaError> {
    if value.is_finite() && value > 0.0 && (4.0 * value).is_normal() {
        return Ok(());
    }
    Err(SlaError::new(
        field,
        format!("{value} is not a positive number"),
    ))
}
