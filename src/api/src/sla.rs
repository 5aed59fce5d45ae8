//! What a robot states when it asks for a service: a service level agreement (SLA), a class, or resources outright, and what
//! the deployer's dictionary may look at beside. It comes before the robot is admitted, in the query of its WebSocket
//! handshake:
//!
//! ```text
//! ws://host:9090/detect?robot=rover1&rrt=100ms&max_rrt=300ms&aux.width=640
//! ```
//!
//! | key | is |
//! |---|---|
//! | `rrt`, `max_rrt` | T_desire and T_max of the request response time |
//! | `fps`, `min_fps` | rate of an output that is wished for, and the least that is acceptable: frames per second |
//! | `age`, `max_age` | age of an output that is wished for, and the greatest that is acceptable |
//! | `class` | a class of the daemon's configuration |
//! | `cpus`, `memory` | resources outright: cores, and bytes (`512M`) |
//! | `aux.KEY` | an auxiliary parameter of the service's dictionary |
//!
//! Times are seconds, or text such as `100ms`. Keys of others (`robot`, `token`, `resume`) are not looked at.

mod span;

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::size::Size;
pub use span::{NotASpan, Span};

/// What begins the key of an auxiliary parameter.
pub const AUX: &str = "aux.";

/// Auxiliary parameters that a robot may state.
const MOST_AUX: usize = 16;
/// Bytes of a name, and of an auxiliary parameter's value.
const LONGEST: usize = 64;
/// Cores, and bytes of memory, outside of which no servant works.
const CPUS: (f64, f64) = (0.01, 4096.0);
const LEAST_MEMORY: Size = Size(4 << 20);
/// Frames per second beyond which it is a mistake of units.
const MOST_FPS: f64 = 1e6;

/// What is to be kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Measure {
    /// The request response time, in seconds: less is better.
    Rrt,
    /// The rate of an output, in frames per second: more is better.
    Fps,
    /// The age of an output, in seconds: less is better.
    Age,
}

impl Measure {
    /// All of them.
    pub const ALL: [Measure; 3] = [Measure::Rrt, Measure::Fps, Measure::Age];

    /// Its key.
    pub fn name(self) -> &'static str {
        match self {
            Measure::Rrt => "rrt",
            Measure::Fps => "fps",
            Measure::Age => "age",
        }
    }

    /// Whether `value` is at least as good as `than`.
    pub fn reaches(self, value: f64, than: f64) -> bool {
        match self {
            Measure::Rrt | Measure::Age => value <= than,
            Measure::Fps => value >= than,
        }
    }

    /// A value with its unit, as it is written behind the measure's key.
    pub fn print(self, value: f64) -> String {
        match (self, Span::seconds(value)) {
            (Measure::Rrt | Measure::Age, Some(span)) => span.to_string(),
            _ => value.to_string(),
        }
    }

    /// Reads a value: seconds for times.
    pub fn read(self, text: &str) -> Result<f64, String> {
        match self {
            Measure::Rrt | Measure::Age => text
                .parse::<Span>()
                .map(Span::as_seconds)
                .map_err(|error| error.to_string()),
            Measure::Fps => rate(text),
        }
    }
}

/// A service level agreement; nothing of it need be given.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Sla {
    /// T_desire: the request response time that is wished for.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub rrt: Option<Span>,
    /// T_max: the longest that is acceptable.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub max_rrt: Option<Span>,
    /// The rate of an output that is wished for, frames per second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fps: Option<f64>,
    /// The least that is acceptable.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_fps: Option<f64>,
    /// The age of an output that is wished for.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub age: Option<Span>,
    /// The greatest that is acceptable.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(value_type = Option<String>))]
    pub max_age: Option<Span>,
}

/// One measure of an SLA.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Goal {
    /// What is measured.
    pub measure: Measure,
    /// What is wished for: seconds, or frames per second.
    pub desire: f64,
    /// What is acceptable; never better than `desire`.
    pub bound: f64,
}

impl Sla {
    /// Whether nothing is given.
    pub fn is_empty(&self) -> bool {
        *self == Sla::default()
    }

    /// What is to be kept. Where one of desire and bound is given, it is both.
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

    /// Refuses an SLA that contradicts itself.
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
                rate(&value.to_string()).map_err(|reason| Unstatable::new(key, reason))?;
            }
        }
        Ok(())
    }

    /// The stricter of both, measure by measure.
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

/// A desire and a bound of one measure.
type Pair<T> = (Option<T>, Option<T>);

/// The better desire and the better bound of two.
fn stricter<T: Copy>(one: Pair<T>, other: Pair<T>, better: fn(T, T) -> T) -> Pair<T> {
    // Where one of desire and bound is given, it is both.
    let whole = |(desire, bound): Pair<T>| Some((desire.or(bound)?, bound.or(desire)?));
    match (whole(one), whole(other)) {
        (Some(a), Some(b)) => (Some(better(a.0, b.0)), Some(better(a.1, b.1))),
        (Some(_), None) => one,
        (None, _) => other,
    }
}

/// What a robot states.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Stated {
    /// What it wishes to be kept.
    #[serde(skip_serializing_if = "Sla::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub sla: Sla,
    /// Its class.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Cores outright, whatever the SLA would need.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// The same of memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Auxiliary parameters.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub aux: BTreeMap<String, String>,
}

/// Something that cannot be stated, or not so.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unstatable {
    /// Its key.
    pub key: String,
    /// Why not, and what to do.
    pub reason: String,
}

impl Unstatable {
    fn new(key: &str, reason: String) -> Unstatable {
        Unstatable {
            key: key.to_owned(),
            reason,
        }
    }
}

impl fmt::Display for Unstatable {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} {}", self.key, self.reason)
    }
}

impl std::error::Error for Unstatable {}

impl Stated {
    /// All keys but those of auxiliary parameters.
    pub const KEYS: [&str; 9] = [
        "rrt", "max_rrt", "fps", "min_fps", "age", "max_age", "class", "cpus", "memory",
    ];

    /// Whether nothing is stated.
    pub fn is_empty(&self) -> bool {
        *self == Stated::default()
    }

    /// Reads what is stated among `pairs` of keys and values; keys of others are left out.
    ///
    /// # Errors
    /// The key that cannot be as it is, why not, and what to write.
    pub fn read<K: AsRef<str>, V: AsRef<str>>(
        pairs: impl IntoIterator<Item = (K, V)>,
    ) -> Result<Stated, Unstatable> {
        let mut stated = Stated::default();
        let mut seen = Vec::new();
        for (key, text) in pairs {
            let (key, text) = (key.as_ref(), text.as_ref().trim());
            let is_aux = key.starts_with(AUX);
            if !is_aux && !Stated::KEYS.contains(&key) {
                meant(key)?;
                continue;
            }
            if seen.iter().any(|earlier| earlier == key) {
                return Err(Unstatable::new(key, "is given twice; give it once".into()));
            }
            seen.push(key.to_owned());
            stated.set(key, text)?;
        }
        if stated.aux.len() > MOST_AUX {
            let reason = format!(
                "makes {} auxiliary parameters; give at most {MOST_AUX}",
                stated.aux.len()
            );
            return Err(Unstatable::new(
                seen.last().map_or(AUX, String::as_str),
                reason,
            ));
        }
        stated.sla.check()?;
        Ok(stated)
    }

    fn set(&mut self, key: &str, text: &str) -> Result<(), Unstatable> {
        let refused = |reason: String| Unstatable::new(key, reason);
        let span = || {
            let span = Span::from_str(text).map_err(|error| refused(format!("= {error}")))?;
            Ok(Some(span))
        };
        let rate = || rate(text).map(Some).map_err(refused);
        match key {
            "rrt" => self.sla.rrt = span()?,
            "max_rrt" => self.sla.max_rrt = span()?,
            "fps" => self.sla.fps = rate()?,
            "min_fps" => self.sla.min_fps = rate()?,
            "age" => self.sla.age = span()?,
            "max_age" => self.sla.max_age = span()?,
            "class" => {
                name(text).map_err(refused)?;
                self.class = Some(text.to_owned());
            }
            "cpus" => {
                let (least, most) = CPUS;
                let cpus = text
                    .parse()
                    .ok()
                    .filter(|cpus| (least..=most).contains(cpus));
                let reason = || {
                    refused(format!(
                        "= {text:?} is not a number of cores between {least} and {most}; write one such as 1.5"
                    ))
                };
                self.cpus = Some(cpus.ok_or_else(reason)?);
            }
            "memory" => {
                let memory = text.parse::<Size>();
                let memory = memory.map_err(|error| refused(format!("= {error}")))?;
                if memory < LEAST_MEMORY {
                    return Err(refused(format!(
                        "= {memory} is too little for any node; write at least {LEAST_MEMORY}"
                    )));
                }
                self.memory = Some(memory);
            }
            _ => {
                let aux = key.strip_prefix(AUX).unwrap_or(key);
                check_aux(aux, text).map_err(refused)?;
                self.aux.insert(aux.to_owned(), text.to_owned());
            }
        }
        Ok(())
    }

    /// Keys and values, as [`read`](Self::read) reads them.
    pub fn pairs(&self) -> Vec<(String, String)> {
        let sla = &self.sla;
        let span = |span: Option<Span>| span.map(|span| span.to_string());
        let number = |number: Option<f64>| number.map(|number| number.to_string());
        let own = [
            span(sla.rrt),
            span(sla.max_rrt),
            number(sla.fps),
            number(sla.min_fps),
            span(sla.age),
            span(sla.max_age),
            self.class.clone(),
            number(self.cpus),
            self.memory.map(exact),
        ];
        let own = Stated::KEYS
            .into_iter()
            .zip(own)
            .filter_map(|(key, value)| Some((key.to_owned(), value?)));
        let aux = self.aux.iter();
        own.chain(aux.map(|(key, value)| (format!("{AUX}{key}"), value.clone())))
            .collect()
    }

    /// What two of one robot state together, for one servant: the stricter SLA, the more of resources. Of two classes the
    /// one that `prefer` picks; of an auxiliary parameter with two values the greater number, else the first.
    pub fn with(mut self, other: Stated, prefer: impl Fn(&str, &str) -> bool) -> Stated {
        self.sla = self.sla.stricter(other.sla);
        self.class = match (self.class.take(), other.class) {
            (Some(one), Some(other)) if prefer(&other, &one) => Some(other),
            (one, other) => one.or(other),
        };
        self.cpus = match (self.cpus, other.cpus) {
            (Some(one), Some(other)) => Some(one.max(other)),
            (one, other) => one.or(other),
        };
        self.memory = self.memory.max(other.memory);
        for (key, value) in other.aux {
            let number = |text: &str| text.parse::<f64>().ok();
            let stays = self.aux.get(&key).is_some_and(|has| {
                !matches!((number(has), number(&value)), (Some(has), Some(value)) if value > has)
            });
            if !stays {
                self.aux.insert(key, value);
            }
        }
        self
    }
}

/// As it would be typed; `nothing` where nothing is stated.
impl fmt::Display for Stated {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pairs = self.pairs();
        if pairs.is_empty() {
            return out.write_str("nothing");
        }
        for (index, (key, value)) in pairs.iter().enumerate() {
            let space = if index == 0 { "" } else { " " };
            write!(out, "{space}{key}={value}")?;
        }
        Ok(())
    }
}

/// A size in full: what is printed shortly may be rounded.
fn exact(size: Size) -> String {
    let short = size.to_string();
    match short.parse() == Ok(size) {
        true => short,
        false => size.0.to_string(),
    }
}

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok();
    rate.filter(|rate| *rate > 0.0 && *rate <= MOST_FPS)
        .ok_or_else(|| {
            format!("= {text:?} is not a rate; write frames per second greater than 0, such as 10")
        })
}

/// Refuses a name that no class can have.
pub fn name(text: &str) -> Result<(), String> {
    let fits = !text.is_empty()
        && text.len() <= LONGEST
        && text
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte));
    match fits {
        true => Ok(()),
        false => Err(format!(
            "= {text:?} is not a name; write letters, digits, - and _, at most {LONGEST}"
        )),
    }
}

/// Refuses an auxiliary parameter that cannot be.
pub fn check_aux(key: &str, value: &str) -> Result<(), String> {
    let key_fits = !key.is_empty()
        && key.len() <= LONGEST
        && key
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte));
    if !key_fits {
        return Err(format!(
            "names no auxiliary parameter; write {AUX}KEY=VALUE, KEY of letters, digits, -, _ and ., at most {LONGEST}"
        ));
    }
    let value_fits =
        !value.is_empty() && value.len() <= LONGEST && !value.chars().any(char::is_control);
    if !value_fits {
        return Err(format!(
            "has no value, or one of more than {LONGEST} bytes; write {AUX}{key}=VALUE, such as {AUX}width=640"
        ));
    }
    Ok(())
}

/// Refuses a key that was meant to be one of these: one that is silently left out would be missed late.
fn meant(key: &str) -> Result<(), Unstatable> {
    let bare = |key: &str| {
        let letters = key.chars().filter(|c| !"-_.".contains(*c));
        letters.collect::<String>().to_ascii_lowercase()
    };
    let told = bare(key);
    let other = [
        ("desire", "rrt"),
        ("tdesire", "rrt"),
        ("max", "max_rrt"),
        ("tmax", "max_rrt"),
        ("rtt", "rrt"),
        ("maxrtt", "max_rrt"),
        ("framespersecond", "fps"),
        ("minframespersecond", "min_fps"),
        ("cpu", "cpus"),
        ("mem", "memory"),
    ];
    let known = Stated::KEYS.into_iter().find(|known| bare(known) == told);
    let known = known.or_else(|| {
        let other = other.into_iter().find(|(word, _)| *word == told);
        other.map(|(_, key)| key)
    });
    match known {
        Some(known) => Err(Unstatable::new(key, format!("is not a key; write {known}"))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests;
