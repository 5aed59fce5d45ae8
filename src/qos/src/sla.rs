//! What the robot is promised, as written in its parameters, its launch file or its configuration.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize};

use crate::pair::Pair;
use crate::sla_error::SlaError;

/// The promise, and what is done to keep it. Times are written as seconds (`0.3`) or with a unit (`"300ms"`).
///
/// ```toml
/// t_desire = 0.1             # desirable response time of the cloud
/// t_max = 0.3                # maximal acceptable response time
/// threshold = 4.0            # Q_t: below it the local original is wanted
/// initial = 8.0              # Q at the beginning; 2·Q_t where it is not given
/// mode = "stateless"         # or "stateful": the local original only while the link is down
/// local = "cold"             # or "warm", or "none"
/// answers = ["/image -> /people_detect/found"]
/// safe_stop = { topic = "/cmd_vel", type = "geometry_msgs/Twist", message = {} }
/// ```
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sla {
    /// T_desire.
    #[serde(serialize_with = "seconds")]
    pub t_desire: Duration,
    /// T_max.
    #[serde(serialize_with = "seconds")]
    pub t_max: Duration,
    /// Q_t.
    pub threshold: f64,
    /// Q at the beginning.
    pub initial: f64,
    /// Whether requests depend on one another.
    pub mode: Mode,
    /// How the local original is kept.
    pub local: Local,
    /// With [`Local::Warm`], from when on its process runs.
    pub warm: Warm,
    /// What T is.
    pub measure: Measure,
    /// Overrides what is found automatically; empty means that nothing but calls and goals is a request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub answers: Option<Vec<Pair>>,
    /// What is published when nobody answers in time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub safe_stop: Option<SafeStop>,
    /// Other times for single services, actions and inputs, by name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub requests: BTreeMap<String, Times>,
}

/// T_desire and T_max of one kind of request.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Times {
    /// T_desire.
    #[serde(serialize_with = "seconds")]
    pub t_desire: Duration,
    /// T_max.
    #[serde(serialize_with = "seconds")]
    pub t_max: Duration,
}

/// Whether requests depend on one another.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Each stands alone: both sides may be asked, either may answer.
    #[default]
    Stateless,
    /// Answers depend on earlier requests: one side at a time, the local original only while the link is down.
    Stateful,
}

/// How the local original is kept.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Local {
    /// Its process is started and ended as the algorithm says.
    #[default]
    Cold,
    /// Its process runs before it is needed and is only fed as the algorithm says.
    Warm,
    /// There is none, or it is not to be used.
    None,
}

/// From when on a warm local original runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Warm {
    /// As long as the node runs.
    #[default]
    AtOnce,
    /// From the first late request until Q is full again.
    FirstSign,
}

/// What T is.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Measure {
    /// The response time of requests.
    #[default]
    Rrt,
    /// The mean interval of the last frames of an output; T_desire and T_max are the inverse rates.
    FramesPerSecond {
        /// The output topic; empty: the one that answers the first request that is found.
        output: String,
        /// Frames over which the mean is taken.
        over: usize,
    },
    /// How old an output has become when the next one comes, counted from its `header.stamp` where it has one.
    Age {
        /// The output topic; empty: the one that answers the first request that is found.
        output: String,
    },
}

/// The message that brings the robot to rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SafeStop {
    /// Absolute topic name.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its fields; those not given are zero.
    #[serde(default)]
    pub message: serde_json::Map<String, serde_json::Value>,
}

impl Sla {
    /// Reads and checks an SLA. `from` is any serde source: a table of a TOML file, ROS parameters as JSON.
    ///
    /// # Errors
    /// The first field that is missing, unknown, of another type or out of range.
    pub fn parse<'de, D: Deserializer<'de>>(from: D) -> Result<Self, SlaError> {
        let written: Written = serde_path_to_error::deserialize(from).map_err(|error| {
            let path = error.path().to_string();
            SlaError {
                field: if path == "." { "the SLA".into() } else { path },
                // Some formats add the place in the file as lines of its own.
                reason: error.into_inner().to_string().trim().replace('\n', " "),
            }
        })?;
        written.check()
    }

    /// The times of one service, action or input.
    pub fn times(&self, name: &str) -> Times {
        self.requests.get(name).copied().unwrap_or(Times {
            t_desire: self.t_desire,
            t_max: self.t_max,
        })
    }
}

impl<'de> Deserialize<'de> for Sla {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        Written::deserialize(from)?
            .check()
            .map_err(serde::de::Error::custom)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    t_desire: Option<Span>,
    t_max: Option<Span>,
    #[serde(default = "default_threshold")]
    threshold: f64,
    initial: Option<f64>,
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
struct WrittenTimes {
    t_desire: Span,
    t_max: Span,
}

fn default_threshold() -> f64 {
    4.0
}

fn default_over() -> usize {
    5
}

impl Written {
    fn check(self) -> Result<Sla, SlaError> {
        positive("threshold", self.threshold)?;
        let initial = self.initial.unwrap_or(2.0 * self.threshold);
        positive("initial", initial)?;
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
                let desire = age.desire.check("measure.age.desire")?;
                let max = age.max.check("measure.age.max")?;
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
        }
    }
}

impl Times {
    fn check(prefix: &str, desire: Option<Span>, max: Option<Span>) -> Result<Self, SlaError> {
        let given = |name: &str, value: Option<Span>| {
            let field = format!("{prefix}{name}");
            match value {
                Some(span) => span.check(&field),
                None => Err(SlaError::new(
                    &field,
                    "is missing; give it in seconds, such as 0.3",
                )),
            }
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

/// A time as written: seconds, or text with a unit.
#[derive(Deserialize, Clone)]
#[serde(
    untagged,
    expecting = "a time: seconds as a number, or text such as \"300ms\""
)]
enum Span {
    Seconds(f64),
    Text(String),
}

impl Span {
    fn check(&self, field: &str) -> Result<Duration, SlaError> {
        let seconds =
            match self {
                Self::Seconds(seconds) => *seconds,
                Self::Text(text) => {
                    let text = text.trim();
                    let (number, scale) = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
                        (Some(number), _) => (number, 1e-3),
                        (None, Some(number)) => (number, 1.0),
                        (None, None) => (text, 1.0),
                    };
                    number.trim().parse::<f64>().map(|number| number * scale).map_err(|_| {
                    SlaError::new(
                        field,
                        format!("{text:?} is not a time; write seconds, such as 0.3, or \"300ms\""),
                    )
                })?
                }
            };
        positive(field, seconds)?;
        // Beyond a day it is a mistake of units, and far below it sums of deadlines cannot overflow.
        if seconds > 86_400.0 {
            return Err(SlaError::new(
                field,
                format!("{seconds} s is more than a day; times are in seconds"),
            ));
        }
        let time = Duration::from_secs_f64(seconds);
        if time.is_zero() {
            return Err(SlaError::new(
                field,
                format!("{seconds} s is less than a nanosecond"),
            ));
        }
        Ok(time)
    }
}

fn interval(field: &str, rate: f64) -> Result<Duration, SlaError> {
    Span::Seconds(1.0 / rate).check(field)
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

fn seconds<S: serde::Serializer>(time: &Duration, out: S) -> Result<S::Ok, S::Error> {
    out.serialize_f64(time.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Sla, SlaError> {
        Sla::parse(toml::Deserializer::parse(text).unwrap())
    }

    #[test]
    fn two_times_are_enough() {
        let sla = parse("t_desire = 0.1\nt_max = '300ms'").unwrap();
        assert_eq!(sla.t_desire, Duration::from_millis(100));
        assert_eq!(sla.t_max, Duration::from_millis(300));
        assert_eq!((sla.threshold, sla.initial), (4.0, 8.0));
        assert_eq!((sla.mode, sla.local), (Mode::Stateless, Local::Cold));
        assert_eq!(sla.answers, None);
    }

    #[test]
    fn everything_can_be_said() {
        let sla = parse(
            "t_desire = 1\nt_max = 2\nthreshold = 3\ninitial = 5.5\nmode = 'stateful'\nlocal = 'warm'\n\
             warm = 'first-sign'\nanswers = ['/image -> /found']\n\
             safe_stop = { topic = '/cmd_vel', type = 'geometry_msgs/Twist', message = { linear = { x = 0 } } }\n\
             [requests.'/plan']\nt_desire = 5\nt_max = '20 s'",
        )
        .unwrap();
        assert_eq!(sla.times("/plan").t_max, Duration::from_secs(20));
        assert_eq!(sla.times("/other").t_max, Duration::from_secs(2));
        assert_eq!(sla.warm, Warm::FirstSign);
        assert_eq!(sla.answers.unwrap()[0].outputs, ["/found"]);
        assert_eq!(sla.safe_stop.unwrap().type_name, "geometry_msgs/Twist");
    }

    #[test]
    fn other_measures_bring_their_limits() {
        let sla =
            parse("measure.frames_per_second = { output = '/map', desire = 10, min = 4 }").unwrap();
        assert_eq!(sla.t_desire, Duration::from_millis(100));
        assert_eq!(sla.t_max, Duration::from_millis(250));
        let sla = parse("measure.age = { output = '/map', desire = 0.5, max = 2 }").unwrap();
        assert_eq!(sla.t_max, Duration::from_secs(2));
        assert_eq!(
            sla.measure,
            Measure::Age {
                output: "/map".into()
            }
        );
    }

    #[test]
    fn what_is_wrong_is_named_with_its_field() {
        for (text, field, reason) in [
            ("t_max = 1", "t_desire", "missing"),
            ("t_desire = 1", "t_max", "missing"),
            ("t_desire = 2\nt_max = 1", "t_max", "below t_desire"),
            ("t_desire = 0\nt_max = 1", "t_desire", "positive"),
            ("t_desire = nan\nt_max = 1", "t_desire", "positive"),
            ("t_desire = 'soon'\nt_max = 1", "t_desire", "\"soon\""),
            ("t_desire = 100\nt_max = 300000", "t_max", "day"),
            ("t_desire = true\nt_max = 1", "t_desire", "a time"),
            (
                "t_desire = 1\nt_max = 1\nthreshold = -1",
                "threshold",
                "positive",
            ),
            (
                "t_desire = 1\nt_max = 1\nthreshold = 'x'",
                "threshold",
                "string",
            ),
            (
                "t_desire = 1\nt_max = 1\ninitial = inf",
                "initial",
                "positive",
            ),
            ("t_desire = 1\nt_max = 1\nmode = 'x'", "mode", "stateless"),
            ("t_desire = 1\nt_max = 1\nlocal = 'hot'", "local", "warm"),
            ("t_desire = 1\nt_max = 1\nwarm = 'at-once'", "warm", "local"),
            (
                "t_desire = 1\nt_max = 1\nt_maximal = 1",
                "t_maximal",
                "unknown field",
            ),
            (
                "t_desire = 1\nt_max = 1\nanswers = ['/a']",
                "answers[0]",
                "arrow",
            ),
            (
                "t_desire = 1\nt_max = 1\nsafe_stop = { topic = 'v', type = 'a/B' }",
                "safe_stop.topic",
                "slash",
            ),
            (
                "t_desire = 1\nt_max = 1\nsafe_stop = { topic = '/v', type = 'B' }",
                "safe_stop.type",
                "package/Type",
            ),
            (
                "t_max = 1\nmeasure.age = { output = '/m', desire = 1, max = 2 }",
                "t_max",
                "measure",
            ),
            (
                "measure.age = { output = '/m', desire = 3, max = 2 }",
                "measure.age.max",
                "below desire",
            ),
            (
                "measure.frames_per_second = { output = '/m', desire = 3, min = 4 }",
                "measure.frames_per_second.min",
                "above desire",
            ),
            (
                "t_desire = 1\nt_max = 1\nrequests.'/p' = { t_desire = 2, t_max = 1 }",
                "requests./p.t_max",
                "below",
            ),
        ] {
            let error = parse(text).unwrap_err();
            assert_eq!(error.field, field, "{text}: {error}");
            assert!(error.reason.contains(reason), "{text}: {error}");
        }
    }

    #[test]
    fn ros_parameters_do_as_well() {
        let sla = Sla::parse(serde_json::json!({"t_desire": 1, "t_max": 2.5})).unwrap();
        assert_eq!(sla.t_max, Duration::from_millis(2500));
        let error = Sla::parse(serde_json::json!({"t_desire": [1], "t_max": 2.5})).unwrap_err();
        assert_eq!(error.field, "t_desire");
    }
}
