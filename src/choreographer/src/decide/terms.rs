//! On which terms a robot has a servant: from what its clients state, its class and its service to the limits that are promised
//! to it.
//!
//! What several clients of one robot state (its stubs, each for a node; rosbridge clients) is for one servant: the
//! strictest counts ([`Stated::with`]). The limits follow from, the first that says something:
//!
//! 1. `cpus` and `memory` that are stated outright,
//! 2. the rows of the service's dictionary that are taken for the goals of the SLA ([`super::dictionary`]); of several goals what is
//!    enough for all,
//! 3. the push of the service,
//! 4. the limits of the class.
//!
//! An SLA by default is that of the class, where no SLA and no resources are stated. What is stated is bounded by the caps of
//! the class and of the service; the deployer's own limits are not. A goal that the robot states and that cannot be met is
//! refused, with what can be; one of its class, or beside resources that it states outright, is not: it gets the best there is.

mod caps;
mod explanation;

use std::collections::BTreeMap;

use api::dictionary::Row;
use api::sla::Goal;
use api::{Caps, Limits, Sla, Stated, Terms};

use super::Amount;
use super::demand::with_bounded_weight;
use super::dictionary::{Aux, Choice, Shelf};
use crate::options::{Class, DEFAULT_CLASS};
use caps::Bounds;
pub use caps::{Cap, Capper};
pub use explanation::explain;

/// What terms are made from, beside what is stated.
#[derive(Debug, Clone, Copy)]
pub struct Offer<'a> {
    /// The service.
    pub service: &'a str,
    /// Limits that its push asked for.
    pub limits: Limits,
    /// A deployer owns it: the weight that its push and its rows ask for is at most what is promised.
    pub is_deployers: bool,
    /// What its robots may ask for.
    pub caps: Caps,
    /// All classes, by name.
    pub classes: &'a BTreeMap<String, Class>,
    /// The service's dictionary.
    pub rows: &'a [Row],
    /// Auxiliary parameters that sessions of the robot have measured; what it states comes before.
    pub measured: &'a Aux,
    /// What is set aside for a servant for which nobody asks anything: cores and bytes.
    pub reserve: (f64, u64),
    /// What the machine has for servants.
    pub capacity: Amount,
}

/// Why a robot cannot have a servant on its terms.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Untenable {
    /// The configuration has no such class.
    #[error("class = {name:?} is not one of the configuration's classes")]
    UnknownClass {
        /// Stated.
        name: String,
        /// Names that exist.
        exists: Vec<String>,
    },
    /// More than its class or its service allows.
    #[error("{} = {asked} is more than this robot may ask for: {cap}", cap.resource)]
    Capped {
        /// What was stated.
        asked: String,
        /// What bounds it.
        cap: Box<Cap>,
    },
    /// The row that would do is more than it may have.
    #[error("{goal}{} needs {needs}, which is more {} than this robot may have: {cap}", assumed_in_words(assumed), cap.resource)]
    Beyond {
        /// What was stated, such as `rrt 100ms`.
        goal: String,
        /// Auxiliary parameters that nobody stated, with the values that need most.
        assumed: Aux,
        /// Limits, and the row that says so.
        needs: String,
        /// What bounds them.
        cap: Box<Cap>,
        /// What would fit, as it would be stated.
        fits: Option<String>,
    },
    /// No row does.
    #[error("{service} does not reach {goal}{}: {}", for_what(assumed), best.as_deref().map_or("its dictionary has no row for it".to_owned(), |best| format!("the best that it may have is {best}")))]
    Unmet {
        /// The service.
        service: String,
        /// What was stated.
        goal: String,
        /// Auxiliary parameters for which there is none.
        assumed: Aux,
        /// The best that can be had, with the row that says so.
        best: Option<String>,
        /// What would fit, as it would be stated.
        fits: Option<String>,
    },
}

/// What follows from what is stated, beside the limits.
struct Reading<'a> {
    together: Stated,
    class: Option<(&'a str, &'a Class)>,
    bounds: Bounds,
    /// Limits where neither resources nor rows say anything.
    own: Limits,
    aux: Aux,
    /// Those of them that it did not state.
    measured: Aux,
    sla: Sla,
    /// A goal that cannot be met is refused.
    strict: bool,
}

impl<'a> Reading<'a> {
    fn of(stated: &BTreeMap<String, Stated>, offer: &Offer<'a>) -> Result<Reading<'a>, Untenable> {
        let priority = |name: &str| offer.classes.get(name).map(|class| class.priority);
        let prefer = |one: &str, other: &str| priority(one) > priority(other);
        let together = stated
            .values()
            .cloned()
            .reduce(|one, other| one.with(other, prefer))
            .unwrap_or_default();
        let class = class(together.class.as_deref(), offer.classes)?;
        let by_class = class.map_or(Limits::default(), |(_, class)| class.limits);
        let mut measured = offer.measured.clone();
        measured.retain(|key, _| !together.aux.contains_key(key));
        let mut aux = measured.clone();
        aux.extend(together.aux.clone());
        let direct = together.cpus.is_some() || together.memory.is_some();
        let (sla, stated_sla) = match class {
            Some((_, class)) if together.sla.is_empty() && !direct => (class.sla, false),
            _ => (together.sla, true),
        };
        Ok(Reading {
            bounds: Bounds::of(class, offer),
            own: offer.limits.or(by_class),
            strict: stated_sla && !direct,
            together,
            class,
            aux,
            measured,
            sla,
        })
    }

    fn shelf(&'a self, offer: &Offer<'a>) -> Shelf<'a> {
        Shelf {
            rows: offer.rows,
            aux: &self.aux,
            own: self.own,
            reserve: offer.reserve,
            capacity: offer.capacity,
        }
    }

    /// Resources that are stated outright.
    fn direct(&self) -> Limits {
        Limits {
            cpus: self.together.cpus,
            memory: self.together.memory,
            ..Limits::default()
        }
    }
}

/// The terms for what the clients of one robot state, by node. Same input, same output.
pub fn terms(stated: &BTreeMap<String, Stated>, offer: &Offer<'_>) -> Result<Terms, Untenable> {
    let reading = Reading::of(stated, offer)?;
    reading.bounds.check(&reading.together)?;
    let (direct, own) = (reading.direct(), reading.own);
    let mut why = Vec::new();
    if direct != Limits::default() {
        why.push(format!("{} as stated", in_words(&direct)));
    }
    let (mut rows, mut by_rows): (Vec<Row>, Option<Limits>) = (Vec::new(), None);
    for goal in reading.sla.goals() {
        let shelf = reading.shelf(offer);
        let choice = shelf.choose(&goal, |row| reading.bounds.against(row, &shelf).is_none());
        let (row, reason) = match choice {
            Choice::Silent => {
                let name = goal.measure.name();
                let service = offer.service;
                why.push(format!(
                    "the dictionary of {service} says nothing of {name}"
                ));
                continue;
            }
            Choice::Taken {
                row,
                desired,
                assumed,
            } => (row, taken(&goal, row, desired, &assumed)),
            Choice::Unmet {
                best: Some(row), ..
            } if !reading.strict => (row, format!("{} is the best there is", named(row))),
            Choice::Unmet { .. } if !reading.strict => {
                why.push(format!("no row for {} applies", words_of(&goal)));
                continue;
            }
            Choice::Unmet {
                best,
                beyond,
                assumed,
            } => return Err(unmet(&goal, best, beyond, assumed, offer, &reading)),
        };
        let enough = row.limits.or(own);
        by_rows = Some(by_rows.map_or(enough, |sum| sum.most(enough)));
        why.push(reason);
        rows.push(row.clone());
    }
    if !rows.is_empty() && !reading.measured.is_empty() {
        let measured = pairs_of(&reading.measured);
        why.push(format!("its messages were measured: {measured}"));
    }
    let limits = direct.or(by_rows.unwrap_or(own));
    // The weight of a class is an operator's.
    let asks = |limits: &Limits| limits.cpu_weight.is_some();
    let by_deployer = asks(&offer.limits) || rows.iter().any(|row| asks(&row.limits));
    let limits = if offer.is_deployers && by_deployer {
        with_bounded_weight(limits)
    } else {
        limits
    };
    Ok(Terms {
        stated: stated.clone(),
        measured: offer.measured.clone(),
        class: reading.class.map(|(name, _)| name.to_owned()),
        priority: reading.class.map_or(0, |(_, class)| class.priority),
        rows,
        limits,
        why,
    })
}

/// Why a row is taken.
fn taken(goal: &Goal, row: &Row, desired: bool, assumed: &Aux) -> String {
    let reason = match desired {
        true => "is the cheapest that reaches",
        false => "is the best that is acceptable for",
    };
    let measure = goal.measure;
    let wished = measure.print(goal.desire);
    format!(
        "{} {reason} {} {wished}{}",
        named(row),
        measure.name(),
        for_what(assumed)
    )
}

fn unmet(
    goal: &Goal,
    best: Option<&Row>,
    beyond: Option<&Row>,
    assumed: Aux,
    offer: &Offer<'_>,
    reading: &Reading<'_>,
) -> Untenable {
    let measure = goal.measure;
    let fits = best.map(|row| format!("{}={}", measure.name(), measure.print(row.value)));
    let goal = words_of(goal);
    let shelf = reading.shelf(offer);
    let beyond = beyond.and_then(|row| Some((row, reading.bounds.against(row, &shelf)?)));
    match beyond {
        Some((row, cap)) => Untenable::Beyond {
            goal,
            assumed,
            needs: named(row),
            cap: Box::new(cap),
            fits,
        },
        None => Untenable::Unmet {
            service: offer.service.to_owned(),
            goal,
            assumed: match assumed.is_empty() {
                true => reading.aux.clone(),
                false => assumed,
            },
            best: best.map(named),
            fits,
        },
    }
}

/// What of a goal must be kept.
fn words_of(goal: &Goal) -> String {
    let measure = goal.measure;
    format!("{} {}", measure.name(), measure.print(goal.bound))
}

/// A row for people.
pub(crate) fn named(row: &Row) -> String {
    match in_words(&row.limits).as_str() {
        "" => format!("row {} ({row}: the service's own limits)", row.id),
        limits => format!("row {} ({row}: {limits})", row.id),
    }
}

/// What was assumed since nobody stated it.
fn assumed_in_words(assumed: &Aux) -> String {
    match assumed.is_empty() {
        true => String::new(),
        false => format!(
            " with {}, which is assumed since it is not stated,",
            pairs_of(assumed)
        ),
    }
}

/// What was assumed of auxiliary parameters, behind what it is about.
fn for_what(assumed: &Aux) -> String {
    match assumed.is_empty() {
        true => String::new(),
        false => format!(" with {}", pairs_of(assumed)),
    }
}

/// Auxiliary parameters as they would be stated.
pub(crate) fn pairs_of(aux: &Aux) -> String {
    let pairs = aux.iter().map(|(key, value)| format!("aux.{key}={value}"));
    pairs.collect::<Vec<_>>().join(" ")
}

/// The class that a robot is in: the one that it names, else the default one where there is one.
fn class<'a>(
    named: Option<&str>,
    classes: &'a BTreeMap<String, Class>,
) -> Result<Option<(&'a str, &'a Class)>, Untenable> {
    let found = classes.get_key_value(named.unwrap_or(DEFAULT_CLASS));
    match (named, found) {
        (Some(name), None) => Err(Untenable::UnknownClass {
            name: name.to_owned(),
            exists: classes.keys().cloned().collect(),
        }),
        (_, found) => Ok(found.map(|(name, class)| (name.as_str(), class))),
    }
}

/// Limits for people, by the names of the flags that set them.
pub(crate) fn in_words(limits: &Limits) -> String {
    let set = limits
        .named()
        .map(|(name, value)| format!("{name} {value}"));
    set.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests;
