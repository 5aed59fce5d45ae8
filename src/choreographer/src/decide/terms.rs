//! On which terms a robot has a servant: from what its clients state, its class and its service to the limits that are promised
//! to it.
//!
//! What several clients of one robot state (its stubs, each for a node; rosbridge clients) is for one servant: the
//! strictest counts ([`Stated::with`]). The limits follow from, the first that says something:
//!
//! 1. `cpus` and `memory` that are stated outright,
//! 2. the push of the service,
//! 3. the limits of the class.
//!
//! An SLA by default is that of the class, where no SLA and no resources are stated. What is stated is bounded by the caps of
//! the class and of the service; the deployer's own limits are not.

use std::collections::BTreeMap;
use std::fmt;

use api::{Caps, Limits, Size, Sla, Stated, Terms};

use crate::options::{Class, DEFAULT_CLASS};

/// What terms are made from, beside what is stated.
#[derive(Debug, Clone, Copy)]
pub struct Offer<'a> {
    /// The service.
    pub service: &'a str,
    /// Limits that its push asked for.
    pub limits: Limits,
    /// What its robots may ask for.
    pub caps: Caps,
    /// All classes, by name.
    pub classes: &'a BTreeMap<String, Class>,
}

/// Who bounds what a robot may ask for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Capper {
    /// A class, by its `max_cpus` or `max_memory`.
    Class(String),
    /// A service, by its push.
    Service(String),
}

/// A bound of one resource, and whose it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cap {
    /// `cpus` or `memory`.
    pub resource: &'static str,
    /// The most, as it is written.
    pub most: String,
    /// Whose it is.
    pub by: Capper,
}

impl fmt::Display for Cap {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Cap { resource, most, by } = self;
        match by {
            Capper::Class(name) => write!(
                out,
                "{most}, the max_{resource} of class {name} ([class.{name}] of the configuration)"
            ),
            Capper::Service(name) => {
                write!(
                    out,
                    "{most}, the --max-{resource} with which {name} was pushed"
                )
            }
        }
    }
}

/// Why a robot cannot have a servant on its terms.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Untenable {
    /// The configuration has no such class.
    #[error("class = {name:?} is not one of the configuration's classes")]
    UnknownClass {
        /// Stated.
        name: String,
        /// Those that there are.
        exists: Vec<String>,
    },
    /// More than its class or its service allows.
    #[error("{} = {asked} is more than this robot may ask for: {cap}", cap.resource)]
    Capped {
        /// What was stated.
        asked: String,
        /// What bounds it.
        cap: Cap,
    },
}

/// The terms for what the clients of one robot state, by node. Same input, same output.
pub fn terms(stated: &BTreeMap<String, Stated>, offer: &Offer<'_>) -> Result<Terms, Untenable> {
    let priority = |name: &str| offer.classes.get(name).map(|class| class.priority);
    let prefer = |one: &str, other: &str| priority(one) > priority(other);
    let together = stated
        .values()
        .cloned()
        .reduce(|one, other| one.with(other, prefer))
        .unwrap_or_default();
    let (name, class) = class(together.class.as_deref(), offer.classes)?;
    let mut why = Vec::new();
    check_caps(&together, name, class, offer)?;
    let direct = Limits {
        cpus: together.cpus,
        memory: together.memory,
        ..Limits::default()
    };
    if direct != Limits::default() {
        why.push(format!("{} as stated", in_words(&direct)));
    }
    let sla = sla(&together, class);
    if !sla.is_empty() {
        why.push(format!(
            "{} has no dictionary: its own limits apply",
            offer.service
        ));
    }
    let by_class = class.map_or(Limits::default(), |class| class.limits);
    Ok(Terms {
        stated: stated.clone(),
        class: name.map(str::to_owned),
        priority: class.map_or(0, |class| class.priority),
        rows: Vec::new(),
        limits: direct.or(offer.limits).or(by_class),
        why,
    })
}

/// The SLA that counts: where neither one nor resources are stated, the class's.
fn sla(stated: &Stated, class: Option<&Class>) -> Sla {
    let says = !stated.sla.is_empty() || stated.cpus.is_some() || stated.memory.is_some();
    match class {
        Some(class) if !says => class.sla,
        _ => stated.sla,
    }
}

/// The class that a robot is in: the one that it names, else the default one where there is one.
fn class<'a>(
    named: Option<&'a str>,
    classes: &'a BTreeMap<String, Class>,
) -> Result<(Option<&'a str>, Option<&'a Class>), Untenable> {
    match named {
        Some(name) => match classes.get(name) {
            Some(class) => Ok((Some(name), Some(class))),
            None => Err(Untenable::UnknownClass {
                name: name.to_owned(),
                exists: classes.keys().cloned().collect(),
            }),
        },
        None => {
            let class = classes.get(DEFAULT_CLASS);
            Ok((class.map(|_| DEFAULT_CLASS), class))
        }
    }
}

/// The tighter bounds of a class and a service, each with whose it is.
#[derive(Debug, Clone, Default, PartialEq)]
struct Bounds {
    cpus: Option<(f64, Cap)>,
    memory: Option<(Size, Cap)>,
}

fn bounds(name: Option<&str>, class: Option<&Class>, offer: &Offer<'_>) -> Bounds {
    let of_class = class.map_or(Caps::default(), |class| class.caps);
    let by_class = || Capper::Class(name.unwrap_or(DEFAULT_CLASS).to_owned());
    let by_service = || Capper::Service(offer.service.to_owned());
    let cap = |resource, most: String, by| Cap { resource, most, by };
    let cpus = match (of_class.cpus, offer.caps.cpus) {
        (Some(class), service) if service.is_none_or(|service| class <= service) => {
            Some((class, cap("cpus", class.to_string(), by_class())))
        }
        (_, service) => service.map(|most| (most, cap("cpus", most.to_string(), by_service()))),
    };
    let memory = match (of_class.memory, offer.caps.memory) {
        (Some(class), service) if service.is_none_or(|service| class <= service) => {
            Some((class, cap("memory", class.to_string(), by_class())))
        }
        (_, service) => service.map(|most| (most, cap("memory", most.to_string(), by_service()))),
    };
    Bounds { cpus, memory }
}

fn check_caps(
    stated: &Stated,
    name: Option<&str>,
    class: Option<&Class>,
    offer: &Offer<'_>,
) -> Result<(), Untenable> {
    let bounds = bounds(name, class, offer);
    if let (Some(asked), Some((most, cap))) = (stated.cpus, bounds.cpus)
        && asked > most
    {
        let asked = asked.to_string();
        return Err(Untenable::Capped { asked, cap });
    }
    if let (Some(asked), Some((most, cap))) = (stated.memory, bounds.memory)
        && asked > most
    {
        let asked = asked.to_string();
        return Err(Untenable::Capped { asked, cap });
    }
    Ok(())
}

/// Limits for people, by the names of the flags that set them.
pub(crate) fn in_words(limits: &Limits) -> String {
    let named = [
        ("cpus", limits.cpus.map(|cpus| cpus.to_string())),
        ("cpu-weight", limits.cpu_weight.map(|n| n.to_string())),
        ("cpuset", limits.cpuset.map(|cores| cores.to_string())),
        ("memory", limits.memory.map(|bytes| bytes.to_string())),
        ("memory-high", limits.memory_high.map(|n| n.to_string())),
        ("pids", limits.pids.map(|pids| pids.to_string())),
        ("io-read", limits.io_read.map(|bytes| bytes.to_string())),
        ("io-write", limits.io_write.map(|bytes| bytes.to_string())),
    ];
    let set = named
        .into_iter()
        .filter_map(|(name, value)| Some(format!("{name} {}", value?)));
    set.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests;
