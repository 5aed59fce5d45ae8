//! Service level agreements: desired and acceptable values of each measure.

use serde::{Deserialize, Serialize};

use super::Span;
use super::Unstatable;

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

impl Measure {
    /// All measures.
    pub const ALL: [Measure; 3] = [Measure::Rrt, Measure::Fps, Measure::Age];

    /// Returns the key of the measure.
    pub fn name(self) -> &'static str {
        match self {
            Measure::Rrt => "rrt",
            Measure::Fps => "fps",
            Measure::Age => "age",
        }
    }

    /// Returns whether `value` is at least as good as `than`.
    pub fn reaches(self, value: f64, than: f64) -> bool {
        match self {
            Measure::Rrt | Measure::Age => value <= than,
            Measure::Fps => value >= than,
        }
    }

    /// Formats a value with its unit, as it is written after the measure's key.
    pub fn format_value(self, value: f64) -> String {
        match (self, Span::from_seconds(value)) {
            (Measure::Rrt | Measure::Age, Some(span)) => span.to_string(),
            _ => value.to_string(),
        }
    }

    /// Parses a value; times are in seconds.
    pub fn parse_value(self, text: &str) -> Result<f64, String> {
        match self {
            Measure::Rrt | Measure::Age => text
                .parse::<Span>()
                .map(Span::as_seconds)
                .map_err(|error| error.to_string()),
            Measure::Fps => parse_rate(text),
        }
    }
}

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

    /// Returns the goals. If only one of desire and bound is given, it is used for both.
    pub fn goals(&self) -> Vec<Goal> {
        let seconds = |span: Option<Span>| span.map(Span::as_seconds);
        let goal = |measure, desire: Option<f64>, bound: Option<f64>| {
            let (desire, bound) = (desire.or(bound)?, bound.or(desire)?);
            Some(Goal {
                measure,
                desire,
                bound,
            })
        };
        let all = [
            goal(Measure::Rrt, seconds(self.rrt), seconds(self.max_rrt)),
            goal(Measure::Fps, self.fps, self.min_fps),
            goal(Measure::Age, seconds(self.age), seconds(self.max_age)),
        ];
        all.into_iter().flatten().collect()
    }

    /// Rejects a contradictory SLA.
    pub fn check(&self) -> Result<(), Unstatable> {
        let refused = |key: &str, reason: String| Err(Unstatable::new(key, reason));
        if let (Some(rrt), Some(max)) = (self.rrt, self.max_rrt)
            && rrt > max
        {
            let reason =
                format!("({rrt}) is greater than max_rrt ({max}); lower it, or raise max_rrt");
            return refused("rrt", reason);
        }
        if let (Some(fps), Some(min)) = (self.fps, self.min_fps)
            && fps < min
        {
            let reason =
                format!("({fps}) is less than min_fps ({min}); raise it, or lower min_fps");
            return refused("fps", reason);
        }
        if let (Some(age), Some(max)) = (self.age, self.max_age)
            && age > max
        {
            let reason =
                format!("({age}) is greater than max_age ({max}); lower it, or raise max_age");
            return refused("age", reason);
        }
        for (key, value) in [("fps", self.fps), ("min_fps", self.min_fps)] {
            if let Some(value) = value {
                parse_rate(&value.to_string()).map_err(|reason| Unstatable::new(key, reason))?;
            }
        }
        Ok(())
    }

    /// Returns the stricter of both, measure by measure.
    pub fn stricter(self, other: Sla) -> Sla {
        let (rrt, max_rrt) = stricter(
            (self.rrt, self.max_rrt),
            (other.rrt, other.max_rrt),
            Span::min,
        );
        let (fps, min_fps) = stricter(
            (self.fps, self.min_fps),
            (other.fps, other.min_fps),
            f64::max,
        );
        let (age, max_age) = stricter(
            (self.age, self.max_age),
            (other.age, other.max_age),
            Span::min,
        );
        Sla {
            rrt,
            max_rrt,
            fps,
            min_fps,
            age,
            max_age,
        }
    }
}

/// Desired and acceptable value of one measure.
type Pair<T> = (Option<T>, Option<T>);

/// Returns the better desired value and the better bound of two pairs.
fn stricter<T: Copy>(one: Pair<T>, other: Pair<T>, better: fn(T, T) -> T) -> Pair<T> {
    // If only one of desire and bound is given, it is used for both.
    let whole = |(desire, bound): Pair<T>| Some((desire.or(bound)?, bound.or(desire)?));
    match (whole(one), whole(other)) {
        (Some(a), Some(b)) => (Some(better(a.0, b.0)), Some(better(a.1, b.1))),
        (Some(_), None) => one,
        (None, _) => other,
    }
}

/// Parses a rate in frames per second.
pub(super) fn parse_rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok();
    rate.filter(|rate| *rate > 0.0 && *rate <= MOST_FPS)
        .ok_or_else(|| {
            format!("= {text:?} is not a rate; write frames per second greater than 0, such as 10")
        })
}
