//! Service level agreements: desired and acceptable values of each measure.

use serde::{Deserialize, Serialize};

use super::{ParseSpanError, Span, Unstatable, UnstatableReason};

/// Maximum rate in frames per second; larger values are assumed to be in the wrong unit.
const MOST_FPS: f64 = 1e6;

/// Measure of an SLA.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Measure {
    /// Request response time in seconds; less is better.
    Rrt,
    /// Rate of an output in frames per second; more is better.
    Fps,
    /// Age of an output in seconds; less is better.
    Age,
}

/// Row of the table of measures, from which statements are parsed and printed, and values compared.
struct MeasureRow {
    /// Keys of the desired and of the acceptable value.
    keys: [&'static str; 2],
    unit: Unit,
}

/// Unit of a measure's values. Less time is better, and more frames.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Unit {
    Seconds,
    FramesPerSecond,
}

impl Measure {
    /// All measures.
    pub const ALL: [Measure; 3] = [Measure::Rrt, Measure::Fps, Measure::Age];

    fn row(self) -> MeasureRow {
        let (keys, unit) = match self {
            Measure::Rrt => (["rrt", "max_rrt"], Unit::Seconds),
            Measure::Fps => (["fps", "min_fps"], Unit::FramesPerSecond),
            Measure::Age => (["age", "max_age"], Unit::Seconds),
        };
        MeasureRow { keys, unit }
    }

    /// Returns the key of the measure.
    pub fn name(self) -> &'static str {
        self.row().keys[0]
    }

    /// Returns whether the smaller of two values is the better one.
    pub fn is_less_better(self) -> bool {
        self.row().unit == Unit::Seconds
    }

    /// Returns whether `value` is at least as good as `than`.
    pub fn reaches(self, value: f64, than: f64) -> bool {
        if self.is_less_better() { value <= than } else { value >= than }
    }

    /// Formats a value with its unit, as it is written after the measure's key.
    pub fn format_value(self, value: f64) -> String {
        match (self.row().unit, Span::from_seconds(value)) {
            (Unit::Seconds, Some(span)) => span.to_string(),
            _ => value.to_string(),
        }
    }

    /// Parses a value; times are in seconds.
    pub fn parse_value(self, text: &str) -> Result<f64, ParseValueError> {
        Ok(match self.row().unit {
            Unit::Seconds => text.parse::<Span>()?.as_seconds(),
            Unit::FramesPerSecond => parse_rate(text)?,
        })
    }
}

/// Error of parsing a value of a measure.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ParseValueError {
    /// The text is no time.
    #[error(transparent)]
    Span(#[from] ParseSpanError),
    /// The text is no rate.
    #[error(transparent)]
    Rate(#[from] ParseRateError),
}

/// Error of parsing a rate. Its text continues a sentence that begins with the key of the rate.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("= {0:?} is not a rate; write frames per second greater than 0, such as 10")]
pub struct ParseRateError(String);

/// A service level agreement. All fields are optional.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Sla {
    /// T_desire: desired request response time.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub rrt: Option<Span>,
    /// T_max: longest acceptable request response time.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub max_rrt: Option<Span>,
    /// Desired rate of an output, in frames per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fps: Option<f64>,
    /// Lowest acceptable rate of an output, in frames per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_fps: Option<f64>,
    /// Desired age of an output.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub age: Option<Span>,
    /// Highest acceptable age of an output.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub max_age: Option<Span>,
}

/// Goal for one measure of an SLA.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Goal {
    /// The measure.
    pub measure: Measure,
    /// Desired value: seconds, or frames per second.
    pub desire: f64,
    /// Acceptable value; never better than `desire`.
    pub bound: f64,
}

impl Sla {
    /// Returns whether nothing is given.
    pub fn is_empty(&self) -> bool {
        *self == Sla::default()
    }

    /// Returns the desired and the acceptable value of each measure, as given.
    fn values(&self) -> [(Measure, Pair<f64>); 3] {
        let seconds = |span: Option<Span>| span.map(Span::as_seconds);
        [
            (Measure::Rrt, (seconds(self.rrt), seconds(self.max_rrt))),
            (Measure::Fps, (self.fps, self.min_fps)),
            (Measure::Age, (seconds(self.age), seconds(self.max_age))),
        ]
    }

    /// Returns the goals. If only one of desire and bound is given, it is used for both.
    pub fn goals(&self) -> Vec<Goal> {
        let goals = self.values().into_iter().filter_map(|(measure, pair)| {
            let (desire, bound) = complete(pair)?;
            Some(Goal { measure, desire, bound })
        });
        goals.collect()
    }

    /// Rejects a contradictory SLA.
    pub fn check(&self) -> Result<(), Unstatable> {
        for (measure, (desire, bound)) in self.values() {
            let [key, bound_key] = measure.row().keys;
            if let (Some(desire), Some(bound)) = (desire, bound)
                && !measure.reaches(desire, bound)
            {
                let reason = UnstatableReason::WorseThanBound { measure, desire, bound };
                return Err(Unstatable::new(key, reason));
            }
            // Spans are checked where they are made.
            for (key, value) in [(key, desire), (bound_key, bound)] {
                if measure.row().unit == Unit::FramesPerSecond
                    && let Some(value) = value
                {
                    parse_rate(&value.to_string()).map_err(|error| Unstatable::new(key, error))?;
                }
            }
        }
        Ok(())
    }

    /// Returns the stricter of both, measure by measure.
    pub fn stricter(self, other: Sla) -> Sla {
        let (rrt, max_rrt) = stricter((self.rrt, self.max_rrt), (other.rrt, other.max_rrt), Span::min);
        let (fps, min_fps) = stricter((self.fps, self.min_fps), (other.fps, other.min_fps), f64::max);
        let (age, max_age) = stricter((self.age, self.max_age), (other.age, other.max_age), Span::min);
        Sla { rrt, max_rrt, fps, min_fps, age, max_age }
    }
}

/// Desired and acceptable value of one measure.
type Pair<T> = (Option<T>, Option<T>);

/// Returns a pair's values, if any is given: one stands for both.
fn complete<T: Copy>((desire, bound): Pair<T>) -> Option<(T, T)> {
    Some((desire.or(bound)?, bound.or(desire)?))
}

/// Returns the better desired value and the better bound of two pairs.
fn stricter<T: Copy>(one: Pair<T>, other: Pair<T>, better: fn(T, T) -> T) -> Pair<T> {
    match (complete(one), complete(other)) {
        (Some(a), Some(b)) => (Some(better(a.0, b.0)), Some(better(a.1, b.1))),
        (Some(_), None) => one,
        (None, _) => other,
    }
}

/// Describes a desired value that is worse than the acceptable one; continues a sentence that begins with the key.
pub(super) fn describe_contradiction(measure: &Measure, desire: &f64, bound: &f64) -> String {
    let [_, bound_key] = measure.row().keys;
    let [desire, bound] = [desire, bound].map(|value| measure.format_value(*value));
    let (relation, correct, otherwise) =
        if measure.is_less_better() { ("greater", "lower", "raise") } else { ("less", "raise", "lower") };
    format!("({desire}) is {relation} than {bound_key} ({bound}); {correct} it, or {otherwise} {bound_key}")
}

/// Parses a rate in frames per second.
pub(super) fn parse_rate(text: &str) -> Result<f64, ParseRateError> {
    let rate = text.parse().ok();
    rate.filter(|rate| *rate > 0.0 && *rate <= MOST_FPS).ok_or_else(|| ParseRateError(text.to_owned()))
}
