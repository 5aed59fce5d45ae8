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

mod agreement;

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::size::Size;
use agreement::rate;
pub use agreement::{Goal, Measure, Sla};
pub use qos::{NotASpan, Span};

/// What begins the key of an auxiliary parameter.
pub const AUX: &str = "aux.";

/// Auxiliary parameters that a robot may state.
const MOST_AUX: usize = 16;
/// Bytes of a name, and of an auxiliary parameter's value.
const LONGEST: usize = 64;
/// Cores, and bytes of memory, outside of which no servant works.
const CPUS: (f64, f64) = (0.01, 4096.0);
const LEAST_MEMORY: Size = Size(4 << 20);

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
    /// The reason, and what to do.
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
