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

use crate::size::Size;
use agreement::parse_rate;
pub use agreement::{Goal, Measure, Sla};
pub use qos::{ParseSpanError, Span};

/// Prefix of the keys of auxiliary parameters.
pub const AUX: &str = "aux.";

/// Maximum number of auxiliary parameters in a statement.
const MOST_AUX: usize = 16;
/// Maximum length of a name or of an auxiliary parameter's value, in bytes.
const LONGEST: usize = 64;
/// Allowed range of cores, and minimum memory; servants do not work outside these bounds.
const CPUS: (f64, f64) = (0.01, 4096.0);
const LEAST_MEMORY: Size = Size(4 << 20);

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
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unstatable {
    /// Key that is invalid.
    pub key: String,
    /// Reason, and what to write instead.
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
    /// All keys except those of auxiliary parameters.
    pub const KEYS: [&str; 9] = [
        "rrt", "max_rrt", "fps", "min_fps", "age", "max_age", "class", "cpus", "memory",
    ];

    /// Returns whether nothing is stated.
    pub fn is_empty(&self) -> bool {
        *self == Stated::default()
    }

    /// Parses a statement from key-value pairs; unrelated keys are ignored.
    ///
    /// # Errors
    /// Returns the first invalid key, with the reason and what to write instead.
    pub fn read<K: AsRef<str>, V: AsRef<str>>(
        pairs: impl IntoIterator<Item = (K, V)>,
    ) -> Result<Stated, Unstatable> {
        let mut stated = Stated::default();
        let mut seen = Vec::new();
        for (key, text) in pairs {
            let (key, text) = (key.as_ref(), text.as_ref().trim());
            let is_aux = key.starts_with(AUX);
            if !is_aux && !Stated::KEYS.contains(&key) {
                reject_misspelled_key(key)?;
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
        let rate = || parse_rate(text).map(Some).map_err(refused);
        match key {
            "rrt" => self.sla.rrt = span()?,
            "max_rrt" => self.sla.max_rrt = span()?,
            "fps" => self.sla.fps = rate()?,
            "min_fps" => self.sla.min_fps = rate()?,
            "age" => self.sla.age = span()?,
            "max_age" => self.sla.max_age = span()?,
            "class" => {
                check_name(text).map_err(refused)?;
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
        let own = Stated::KEYS
            .into_iter()
            .zip(own)
            .filter_map(|(key, value)| Some((key.to_owned(), value?)));
        let aux = self.aux.iter();
        own.chain(aux.map(|(key, value)| (format!("{AUX}{key}"), value.clone())))
            .collect()
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
    if short.parse() == Ok(size) {
        short
    } else {
        size.0.to_string()
    }
}

/// Validates the name of a class.
pub fn check_name(text: &str) -> Result<(), String> {
    let fits = !text.is_empty()
        && text.len() <= LONGEST
        && text
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte));
    if fits {
        Ok(())
    } else {
        Err(format!(
            "= {text:?} is not a name; write letters, digits, - and _, at most {LONGEST}"
        ))
    }
}

/// Validates the key and value of an auxiliary parameter.
pub fn check_aux(key: &str, value: &str) -> Result<(), String> {
    let key_fits = !key.is_empty()
        && key.len() <= LONGEST
        && key
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte));
    if !key_fits {
        return Err(format!(
            "is not an auxiliary parameter; write {AUX}KEY=VALUE, KEY of letters, digits, -, _ and ., at most {LONGEST}"
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
