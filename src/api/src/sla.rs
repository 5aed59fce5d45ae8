//! Statements that robots make when they request a service: a service level agreement (SLA), a class, or explicit
//! resources, plus auxiliary parameters for the deployer's dictionary. The statement precedes admission; it is in the
//! query of the robot's WebSocket handshake:
//!
//! ```text
//! ws://host:9090/detect?robot=rover1&rrt=100ms&max_rrt=300ms&aux.width=640
//! ```
//!
//! | Key | Meaning |
//! |---|---|
//! | `rrt`, `max_rrt` | T_desire and T_max of the request response time |
//! | `fps`, `min_fps` | desired and lowest acceptable rate of an output, in frames per second |
//! | `age`, `max_age` | desired and highest acceptable age of an output |
//! | `class` | a class of the daemon's configuration |
//! | `cpus`, `memory` | explicit resources: cores, and bytes (`512M`) |
//! | `aux.KEY` | an auxiliary parameter of the service's dictionary |
//!
//! Times are in seconds, or text such as `100ms`. Other keys (`robot`, `token`, `resume`) are ignored.

mod agreement;

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::limits::{LEAST_CPUS, LEAST_MEMORY, MOST_CPUS};
use crate::size::{NotASize, Size};
pub use agreement::{Goal, Measure, ParseRateError, ParseValueError, Sla};
use agreement::{describe_contradiction, parse_rate};
pub use qos::{ParseSpanError, Span};

/// Prefix of the keys of auxiliary parameters.
pub const AUX: &str = "aux.";

/// Maximum number of auxiliary parameters in a statement.
const MOST_AUX: usize = 16;
/// Maximum length of a name or of an auxiliary parameter's value, in bytes.
const LONGEST: usize = 64;

/// A key of a statement.
#[derive(Debug, Clone, Copy)]
pub struct StatedKey {
    /// The key as written.
    pub name: &'static str,
    /// Description of the value.
    pub description: &'static str,
    /// True if only a number is accepted.
    pub is_number: bool,
}

const fn key(name: &'static str, description: &'static str, is_number: bool) -> StatedKey {
    StatedKey { name, description, is_number }
}

/// All keys except those of auxiliary parameters, in the order in which they are written.
pub static KEYS: [StatedKey; 9] = [
    key("rrt", "Desired response time (T_desire), such as `100ms`.", false),
    key("max_rrt", "Maximum acceptable response time (T_max), such as `300ms`.", false),
    key("fps", "Desired frames per second of an output.", true),
    key("min_fps", "Minimum acceptable frames per second of an output.", true),
    key("age", "Desired age of an output, such as `100ms`.", false),
    key("max_age", "Maximum acceptable age of an output, such as `300ms`.", false),
    key("class", "Class of the configuration.", false),
    key("cpus", "CPU limit in cores, stated directly.", true),
    key("memory", "Memory limit, such as `512M`, stated directly.", false),
];

/// Statement of a robot.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Stated {
    /// Service level agreement.
    #[serde(skip_serializing_if = "Sla::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub sla: Sla,
    /// Class.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<String>,
    /// Explicit CPU in cores, regardless of the SLA.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpus: Option<f64>,
    /// Explicit memory, regardless of the SLA.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Auxiliary parameters.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "schema", schema(required = false))]
    pub aux: BTreeMap<String, String>,
}

/// An invalid key or value in a statement.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key} {reason}")]
pub struct Unstatable {
    /// Key that is invalid.
    pub key: String,
    /// Reason, and what to write instead.
    pub reason: UnstatableReason,
}

impl Unstatable {
    fn new(key: &str, reason: impl Into<UnstatableReason>) -> Unstatable {
        Unstatable { key: key.to_owned(), reason: reason.into() }
    }
}

/// Reason why a key or its value is invalid. Its text continues a sentence that begins with the key.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UnstatableReason {
    /// The key was given before.
    #[error("is given twice; give it once")]
    Repeated,
    /// The key is a misspelling of this one.
    #[error("is not a key; write {0}")]
    Misspelled(&'static str),
    /// The statement has this many auxiliary parameters.
    #[error("makes {0} auxiliary parameters; give at most {MOST_AUX}")]
    TooManyAux(usize),
    /// The value is no time.
    #[error("= {0}")]
    Span(#[from] ParseSpanError),
    /// The value is no rate.
    #[error(transparent)]
    Rate(#[from] ParseRateError),
    /// The value is not the name of a class.
    #[error(transparent)]
    ClassName(#[from] ClassNameError),
    /// The key or the value is not that of an auxiliary parameter.
    #[error(transparent)]
    Aux(#[from] AuxError),
    /// The value is not a number of cores in the allowed range.
    #[error("= {0:?} is not a number of cores between {LEAST_CPUS} and {MOST_CPUS}; write one such as 1.5")]
    Cores(String),
    /// The value is no size.
    #[error("= {0}")]
    Size(#[from] NotASize),
    /// The value is less memory than any node needs.
    #[error("= {0} is too little for any node; write at least {LEAST_MEMORY}")]
    TooLittleMemory(Size),
    /// The desired value is worse than the acceptable one.
    #[error("{}", describe_contradiction(.measure, .desire, .bound))]
    WorseThanBound {
        /// The measure.
        measure: Measure,
        /// Desired value: seconds, or frames per second.
        desire: f64,
        /// Acceptable value.
        bound: f64,
    },
}

/// Error of a text that is not the name of a class. Its text continues a sentence that begins with `class`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("= {0:?} is not a name; write letters, digits, - and _, at most {LONGEST}")]
pub struct ClassNameError(String);

/// Error of an auxiliary parameter. Its text continues a sentence that begins with the parameter's key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AuxError {
    /// Invalid key.
    #[error(
        "is not an auxiliary parameter; write {AUX}KEY=VALUE, KEY of letters, digits, -, _ and ., at most {LONGEST}"
    )]
    Key,
    /// Missing or invalid value of this key.
    #[error("has no value, or one of more than {LONGEST} bytes; write {AUX}{0}=VALUE, such as {AUX}width=640")]
    Value(String),
}

impl Stated {
    /// Returns whether nothing is stated.
    pub fn is_empty(&self) -> bool {
        *self == Stated::default()
    }

    /// Parses a statement from key-value pairs; unrelated keys are ignored.
    ///
    /// # Errors
    /// Returns the first invalid key, with the reason and what to write instead.
    pub fn read<K: AsRef<str>, V: AsRef<str>>(pairs: impl IntoIterator<Item = (K, V)>) -> Result<Stated, Unstatable> {
        let mut stated = Stated::default();
        let mut seen = Vec::new();
        for (key, text) in pairs {
            let (key, text) = (key.as_ref(), text.as_ref().trim());
            let is_aux = key.starts_with(AUX);
            if !is_aux && !KEYS.iter().any(|known| known.name == key) {
                reject_misspelled_key(key)?;
                continue;
            }
            if seen.iter().any(|earlier| earlier == key) {
                return Err(Unstatable::new(key, UnstatableReason::Repeated));
            }
            seen.push(key.to_owned());
            stated.set(key, text)?;
        }
        if stated.aux.len() > MOST_AUX {
            return Err(Unstatable::new(
                seen.last().map_or(AUX, String::as_str),
                UnstatableReason::TooManyAux(stated.aux.len()),
            ));
        }
        stated.sla.check()?;
        Ok(stated)
    }

    fn set(&mut self, key: &str, text: &str) -> Result<(), Unstatable> {
        let span = || {
            let span = Span::from_str(text).map(Some);
            span.map_err(|error| Unstatable::new(key, error))
        };
        let rate = || {
            let rate = parse_rate(text).map(Some);
            rate.map_err(|error| Unstatable::new(key, error))
        };
        match key {
            "rrt" => self.sla.rrt = span()?,
            "max_rrt" => self.sla.max_rrt = span()?,
            "fps" => self.sla.fps = rate()?,
            "min_fps" => self.sla.min_fps = rate()?,
            "age" => self.sla.age = span()?,
            "max_age" => self.sla.max_age = span()?,
            "class" => {
                check_name(text).map_err(|error| Unstatable::new(key, error))?;
                self.class = Some(text.to_owned());
            }
            "cpus" => {
                let cpus = text.parse().ok().filter(|cpus| (LEAST_CPUS..=MOST_CPUS).contains(cpus));
                let refused = || Unstatable::new(key, UnstatableReason::Cores(text.to_owned()));
                self.cpus = Some(cpus.ok_or_else(refused)?);
            }
            "memory" => {
                let memory = text.parse::<Size>();
                let memory = memory.map_err(|error| Unstatable::new(key, error))?;
                if memory < LEAST_MEMORY {
                    let reason = UnstatableReason::TooLittleMemory(memory);
                    return Err(Unstatable::new(key, reason));
                }
                self.memory = Some(memory);
            }
            _ => {
                let aux = key.strip_prefix(AUX).unwrap_or(key);
                check_aux(aux, text).map_err(|error| Unstatable::new(key, error))?;
                self.aux.insert(aux.to_owned(), text.to_owned());
            }
        }
        Ok(())
    }

    /// Returns the keys and values in the form that [`read`](Self::read) accepts.
    pub fn to_pairs(&self) -> Vec<(String, String)> {
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
            self.memory.map(format_exact),
        ];
        let own = KEYS.iter().zip(own).filter_map(|(key, value)| Some((key.name.to_owned(), value?)));
        let aux = self.aux.iter();
        own.chain(aux.map(|(key, value)| (format!("{AUX}{key}"), value.clone()))).collect()
    }

    /// Merges two statements of one robot for the same servant: the stricter SLA and the larger resources; of two
    /// classes the one that `prefer` selects; of two values of an auxiliary parameter the larger number, otherwise the
    /// first.
    pub fn merge(mut self, other: Stated, prefer: impl Fn(&str, &str) -> bool) -> Stated {
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
            let stays = self
                .aux
                .get(&key)
                .is_some_and(|has| !matches!((number(has), number(&value)), (Some(has), Some(value)) if value > has));
            if !stays {
                self.aux.insert(key, value);
            }
        }
        self
    }
}

/// Writes the statement as key-value pairs; `nothing` if it is empty.
impl fmt::Display for Stated {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pairs = self.to_pairs();
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

/// Formats a size exactly, since its display form may be rounded.
fn format_exact(size: Size) -> String {
    let short = size.to_string();
    if short.parse() == Ok(size) { short } else { size.0.to_string() }
}

/// Validates the name of a class.
pub fn check_name(text: &str) -> Result<(), ClassNameError> {
    let fits = !text.is_empty()
        && text.len() <= LONGEST
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte));
    if fits { Ok(()) } else { Err(ClassNameError(text.to_owned())) }
}

/// Validates the key and value of an auxiliary parameter.
pub fn check_aux(key: &str, value: &str) -> Result<(), AuxError> {
    let key_fits = !key.is_empty()
        && key.len() <= LONGEST
        && key.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte));
    if !key_fits {
        return Err(AuxError::Key);
    }
    let value_fits = !value.is_empty() && value.len() <= LONGEST && !value.chars().any(char::is_control);
    if !value_fits {
        return Err(AuxError::Value(key.to_owned()));
    }
    Ok(())
}

/// Rejects a misspelled key, which would otherwise be ignored silently.
fn reject_misspelled_key(key: &str) -> Result<(), Unstatable> {
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
    let mut names = KEYS.iter().map(|known| known.name);
    let known = names.find(|known| bare(known) == told);
    let known = known.or_else(|| {
        let other = other.into_iter().find(|(word, _)| *word == told);
        other.map(|(_, key)| key)
    });
    match known {
        Some(known) => Err(Unstatable::new(key, UnstatableReason::Misspelled(known))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests;
