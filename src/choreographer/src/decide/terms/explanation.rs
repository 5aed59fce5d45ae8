//! Why a statement leads to its terms, row by row.

use std::collections::BTreeMap;

use api::Stated;
use api::dictionary::{Considered, Explained, ExplainedGoal, Row};
use api::sla::Goal;

use super::{Cap, Offer, Reading, named, terms};
use crate::decide::dictionary::{Aux, Shelf, applies};

/// What a robot would get that states this, and why.
pub fn explain(stated: &Stated, offer: &Offer<'_>) -> Explained {
    let all = BTreeMap::from([(String::new(), stated.clone())]);
    let outcome = terms(&all, offer);
    let mut explained = Explained {
        service: offer.service.to_owned(),
        stated: stated.clone(),
        ..Explained::default()
    };
    let mut taken = Vec::new();
    match outcome {
        Ok(terms) => {
            explained.class = terms.class;
            explained.priority = terms.priority;
            explained.limits = Some(terms.limits);
            explained.why = terms.why;
            taken = terms.rows;
        }
        Err(untenable) => explained.refused = Some(untenable.to_string()),
    }
    let Ok(reading) = Reading::of(&all, offer) else {
        return explained;
    };
    let shelf = reading.shelf(offer);
    let against = |row: &Row| reading.bounds.against(row, &shelf);
    for goal in reading.sla.goals() {
        let row = taken.iter().find(|row| row.measure == goal.measure);
        let considered = shelf.by_cost(goal.measure).into_iter();
        let considered = considered.map(|other| Considered {
            row: other.clone(),
            taken: row.is_some_and(|row| row.id == other.id),
            why: verdict(other, row, &goal, &shelf, against(other)),
        });
        explained.goals.push(ExplainedGoal {
            measure: goal.measure,
            desire: goal.desire,
            bound: goal.bound,
            rows: considered.collect(),
        });
        if let Some(row) = row {
            explained.next.extend(next(row, &shelf, against));
        }
    }
    explained
}

/// Why a row is taken, or not.
fn verdict(
    row: &Row,
    taken: Option<&Row>,
    goal: &Goal,
    shelf: &Shelf<'_>,
    against: Option<Cap>,
) -> String {
    let measure = goal.measure;
    let reaches = |than| measure.reaches(row.value, than);
    // What nobody knows is looked at in each case.
    let known = |key: &str| shelf.aux.get(key).or_else(|| row.aux.get(key));
    if taken.is_some_and(|taken| taken.id == row.id) {
        "taken".to_owned()
    } else if !applies(row, known) {
        "is for other auxiliary parameters".to_owned()
    } else if let Some(cap) = against {
        format!("needs more {} than: {cap}", cap.resource)
    } else if !reaches(goal.bound) {
        format!("does not reach {}", measure.print(goal.bound))
    } else if !reaches(goal.desire) {
        format!(
            "is acceptable, but does not reach {}",
            measure.print(goal.desire)
        )
    } else {
        let unsaid = row.aux.iter();
        let unsaid: Aux = unsaid
            .filter(|(key, _)| !shelf.aux.contains_key(*key))
            .map(|(key, value)| (key.clone(), value.clone()))
            .collect();
        match unsaid.is_empty() {
            true => "would do, too".to_owned(),
            false => format!(
                "would do with {}, which is not stated",
                super::pairs_of(&unsaid)
            ),
        }
    }
}

/// What comes next in either direction.
fn next(row: &Row, shelf: &Shelf<'_>, against: impl Fn(&Row) -> Option<Cap>) -> Vec<String> {
    let (better, weaker) = shelf.next_to(row);
    let better = better.map(|row| {
        let capped = against(row).map(|cap| format!(", more {} than: {cap}", cap.resource));
        format!("better: {}{}", named(row), capped.unwrap_or_default())
    });
    let weaker = weaker.map(|row| format!("cheaper: {}", named(row)));
    let mut next: Vec<String> = better.into_iter().chain(weaker).collect();
    if next.is_empty() {
        next.push(format!(
            "there is no other row of this kind than {}",
            named(row)
        ));
    }
    next
}
