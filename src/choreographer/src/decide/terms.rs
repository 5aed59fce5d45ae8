//! Derives the terms of a robot's servant, its promised limits, from what the robot's clients state, its class and its
//! service.
//!
//! The statements of several clients of one robot (its stubs, each for a node; rosbridge clients) apply to one servant:
//! the strictest counts ([`Stated::merge`]). The limits come from the first of these sources that provides them:
//!
//! 1. `cpus` and `memory` stated explicitly,
//! 2. the dictionary rows chosen for the goals of the SLA ([`super::dictionary`]); with several goals, enough for all
//!    of them,
//! 3. the push of the service,
//! 4. the limits of the class.
//!
//! The class provides the default SLA, if neither an SLA nor resources are stated. Statements are bounded by the caps
//! of the class and of the service; the deployer's own limits are not. A stated goal that cannot be met is refused,
//! with a possible alternative; a goal of the class, or one beside explicitly stated resources, is not: it gets the
//! best available row.

mod caps;
mod explanation;

use std::collections::BTreeMap;

use api::dictionary::Row;
use api::sla::Goal;
use api::{Caps, Limits, Sla, Stated, Terms};

use super::Amount;
use super::demand::with_bounded_weight;
use super::dictionary::{Aux, DictionaryView, RowChoice};
use crate::options::{ClassOptions, DEFAULT_CLASS};
use caps::RobotCaps;
pub use caps::{Cap, CapSource};
pub use explanation::explain;

/// The context from which terms are derived, apart from the statements.
#[derive(Debug, Clone, Copy)]
pub struct Offer<'a> {
    /// The service.
    pub service: &'a str,
    /// Limits requested by its push.
    pub limits: Limits,
    /// The service belongs to a deployer: the weight requested by its push and rows is bounded by its promise.
    pub is_deployers: bool,
    /// Caps on what its robots may request.
    pub caps: Caps,
    /// All classes, by name.
    pub classes: &'a BTreeMap<String, ClassOptions>,
    /// The service's dictionary.
    pub rows: &'a [Row],
    /// Auxiliary parameters measured by the robot's sessions; stated ones take precedence.
    pub measured: &'a Aux,
    /// Reserve for a servant without any limits: cores and bytes.
    pub reserve: (f64, u64),
    /// Capacity of the machine for servants.
    pub capacity: Amount,
}

/// The error of terms that cannot be granted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TermsError {
    /// The configuration has no such class.
    #[error("class = {name:?} is not one of the configuration's classes")]
    UnknownClass {
        /// The stated name.
        name: String,
        /// Existing names.
        exists: Vec<String>,
    },
    /// The statement exceeds a cap of the class or the service.
    #[error("{} = {asked} is more than this robot may request: {cap}", cap.resource)]
    Capped {
        /// The stated value.
        asked: String,
        /// The cap that it exceeds.
        cap: Box<Cap>,
    },
    /// The sufficient row exceeds a cap.
    #[error(
        "{goal}{} needs {needs}, which is more {} than this robot may have: {cap}",
        assumed_in_words(assumed), cap.resource
    )]
    Beyond {
        /// The stated goal, such as `rrt 100ms`.
        goal: String,
        /// Auxiliary parameters that were not stated, with the most demanding values.
        assumed: Aux,
        /// Required limits, with the row.
        needs: String,
        /// The cap that they exceed.
        cap: Box<Cap>,
        /// A goal that would fit, in the form of a statement.
        fits: Option<String>,
    },
    /// No row suffices.
    #[error(
        "{service} does not reach {goal}{}: {}", for_what(assumed),
        best.as_deref().map_or(
            "its SLA table has no entry for it".to_owned(),
            |best| format!("the best permitted is {best}")
        )
    )]
    Unmet {
        /// The service.
        service: String,
        /// The stated goal.
        goal: String,
        /// Auxiliary parameters for which no row suffices.
        assumed: Aux,
        /// The best available value, with its row.
        best: Option<String>,
        /// A goal that would fit, in the form of a statement.
        fits: Option<String>,
    },
}

/// Intermediate result of deriving terms, apart from the limits.
struct TermsContext<'a> {
    together: Stated,
    class: Option<(&'a str, &'a ClassOptions)>,
    bounds: RobotCaps,
    /// Limits if neither resources nor rows apply.
    own: Limits,
    aux: Aux,
    /// The auxiliary parameters that were measured and not stated.
    measured: Aux,
    sla: Sla,
    /// A goal that cannot be met is an error.
    strict: bool,
}

impl<'a> TermsContext<'a> {
    fn from_stated(stated: &BTreeMap<String, Stated>, offer: &Offer<'a>) -> Result<TermsContext<'a>, TermsError> {
        let priority = |name: &str| offer.classes.get(name).map(|class| class.priority);
        let prefer = |one: &str, other: &str| priority(one) > priority(other);
        let together = stated.values().cloned().reduce(|one, other| one.merge(other, prefer)).unwrap_or_default();
        let class = find_class(together.class.as_deref(), offer.classes)?;
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
        Ok(TermsContext {
            bounds: RobotCaps::for_class(class, offer),
            own: offer.limits.or(by_class),
            strict: stated_sla && !direct,
            together,
            class,
            aux,
            measured,
            sla,
        })
    }

    fn dictionary_view(&'a self, offer: &Offer<'a>) -> DictionaryView<'a> {
        DictionaryView {
            rows: offer.rows,
            aux: &self.aux,
            own: self.own,
            reserve: offer.reserve,
            capacity: offer.capacity,
        }
    }

    /// Returns the explicitly stated resources.
    fn stated_resources(&self) -> Limits {
        Limits { cpus: self.together.cpus, memory: self.together.memory, ..Limits::default() }
    }
}

/// Derives the terms for the statements of one robot's clients, by node. Deterministic.
pub fn compute_terms(stated: &BTreeMap<String, Stated>, offer: &Offer<'_>) -> Result<Terms, TermsError> {
    let reading = TermsContext::from_stated(stated, offer)?;
    reading.bounds.check(&reading.together)?;
    let (direct, own) = (reading.stated_resources(), reading.own);
    let mut why = Vec::new();
    if direct != Limits::default() {
        why.push(format!("{} as requested", limits_in_words(&direct)));
    }
    let (mut rows, mut by_rows): (Vec<Row>, Option<Limits>) = (Vec::new(), None);
    for goal in reading.sla.goals() {
        let shelf = reading.dictionary_view(offer);
        let choice = shelf.choose(&goal, |row| reading.bounds.exceeded_by(row, &shelf).is_none());
        let (row, reason) = match choice {
            RowChoice::Silent => {
                let name = goal.measure.name();
                let service = offer.service;
                why.push(format!("the SLA table of {service} has no entry for {name}"));
                continue;
            }
            RowChoice::Taken { row, desired, assumed } => (row, taken_reason(&goal, row, desired, &assumed)),
            RowChoice::Unmet { best: Some(row), .. } if !reading.strict => {
                (row, format!("{} is the best available", row_in_words(row)))
            }
            RowChoice::Unmet { .. } if !reading.strict => {
                why.push(format!("no entry for {} applies", goal_in_words(&goal)));
                continue;
            }
            RowChoice::Unmet { best, beyond, assumed } => {
                return Err(unmet_error(&goal, best, beyond, assumed, offer, &reading));
            }
        };
        let enough = row.limits.or(own);
        by_rows = Some(by_rows.map_or(enough, |sum| sum.combine_max(enough)));
        why.push(reason);
        rows.push(row.clone());
    }
    if !rows.is_empty() && !reading.measured.is_empty() {
        let measured = aux_pairs(&reading.measured);
        why.push(format!("measured from its messages: {measured}"));
    }
    let limits = direct.or(by_rows.unwrap_or(own));
    // The weight of a class was set by an operator.
    let asks = |limits: &Limits| limits.cpu_weight.is_some();
    let by_deployer = asks(&offer.limits) || rows.iter().any(|row| asks(&row.limits));
    let limits = if offer.is_deployers && by_deployer { with_bounded_weight(limits) } else { limits };
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

/// Returns the reason why a row is taken.
fn taken_reason(goal: &Goal, row: &Row, desired: bool, assumed: &Aux) -> String {
    let reason = if desired { "is the cheapest that reaches" } else { "is the best acceptable entry for" };
    let measure = goal.measure;
    let wished = measure.format_value(goal.desire);
    format!("{} {reason} {} {wished}{}", row_in_words(row), measure.name(), for_what(assumed))
}

fn unmet_error(
    goal: &Goal,
    best: Option<&Row>,
    beyond: Option<&Row>,
    assumed: Aux,
    offer: &Offer<'_>,
    reading: &TermsContext<'_>,
) -> TermsError {
    let measure = goal.measure;
    let fits = best.map(|row| format!("{}={}", measure.name(), measure.format_value(row.value)));
    let goal = goal_in_words(goal);
    let shelf = reading.dictionary_view(offer);
    let beyond = beyond.and_then(|row| Some((row, reading.bounds.exceeded_by(row, &shelf)?)));
    match beyond {
        Some((row, cap)) => TermsError::Beyond { goal, assumed, needs: row_in_words(row), cap: Box::new(cap), fits },
        None => TermsError::Unmet {
            service: offer.service.to_owned(),
            goal,
            assumed: if assumed.is_empty() { reading.aux.clone() } else { assumed },
            best: best.map(row_in_words),
            fits,
        },
    }
}

/// Returns the bound of a goal in words.
fn goal_in_words(goal: &Goal) -> String {
    let measure = goal.measure;
    format!("{} {}", measure.name(), measure.format_value(goal.bound))
}

/// Returns a human-readable form of a row.
pub(crate) fn row_in_words(row: &Row) -> String {
    match limits_in_words(&row.limits).as_str() {
        "" => format!("entry {} ({row}: the service's own limits)", row.id),
        limits => format!("entry {} ({row}: {limits})", row.id),
    }
}

/// Returns the assumed parameters that were not stated, in words.
fn assumed_in_words(assumed: &Aux) -> String {
    if assumed.is_empty() { String::new() } else { format!(" with {} (assumed because not given)", aux_pairs(assumed)) }
}

/// Returns the assumed auxiliary parameters as a suffix.
fn for_what(assumed: &Aux) -> String {
    if assumed.is_empty() { String::new() } else { format!(" with {}", aux_pairs(assumed)) }
}

/// Returns auxiliary parameters in the form of a statement.
pub(crate) fn aux_pairs(aux: &Aux) -> String {
    let pairs = aux.iter().map(|(key, value)| format!("aux.{key}={value}"));
    pairs.collect::<Vec<_>>().join(" ")
}

/// Returns the class of a robot: the one that it names, or the default one if it exists.
fn find_class<'a>(
    named: Option<&str>,
    classes: &'a BTreeMap<String, ClassOptions>,
) -> Result<Option<(&'a str, &'a ClassOptions)>, TermsError> {
    let found = classes.get_key_value(named.unwrap_or(DEFAULT_CLASS));
    match (named, found) {
        (Some(name), None) => {
            Err(TermsError::UnknownClass { name: name.to_owned(), exists: classes.keys().cloned().collect() })
        }
        (_, found) => Ok(found.map(|(name, class)| (name.as_str(), class))),
    }
}

/// Returns a human-readable form of limits, by the names of their flags.
pub(crate) fn limits_in_words(limits: &Limits) -> String {
    let set = limits.flag_values().map(|(name, value)| format!("{name} {value}"));
    set.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests;
