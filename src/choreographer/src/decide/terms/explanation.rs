//! Explains, row by row, why a statement leads to its terms.

use std::collections::BTreeMap;

use api::Stated;
use api::dictionary::{Considered, Explained, ExplainedGoal, Row};
use api::sla::Goal;

use super::{Cap, Offer, TermsContext, compute_terms, row_in_words};
use crate::decide::dictionary::{Aux, DictionaryView, row_applies};

/// Returns what a robot with this statement would get, and why.
pub fn explain(stated: &Stated, offer: &Offer<'_>) -> Explained {
    let all = BTreeMap::from([(String::new(), stated.clone())]);
    let outcome = compute_terms(&all, offer);
    let mut explained = Explained { service: offer.service.to_owned(), stated: stated.clone(), ..Explained::default() };
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
    let Ok(reading) = TermsContext::from_stated(&all, offer) else {
        return explained;
    };
    let shelf = reading.dictionary_view(offer);
    let against = |row: &Row| reading.bounds.exceeded_by(row, &shelf);
    for goal in reading.sla.goals() {
        let row = taken.iter().find(|row| row.measure == goal.measure);
        let considered = shelf.rows_by_cost(goal.measure).into_iter();
        let considered = considered.map(|other| Considered {
            row: other.clone(),
            taken: row.is_some_and(|row| row.id == other.id),
            why: row_verdict(other, row, &goal, &shelf, against(other)),
        });
        explained.goals.push(ExplainedGoal {
            measure: goal.measure,
            desire: goal.desire,
            bound: goal.bound,
            rows: considered.collect(),
        });
        if let Some(row) = row {
            explained.next.extend(neighbour_rows(row, &shelf, against));
        }
    }
    explained
}

/// Returns why a row is taken, or not.
fn row_verdict(
    row: &Row,
    taken: Option<&Row>,
    goal: &Goal,
    shelf: &DictionaryView<'_>,
    against: Option<Cap>,
) -> String {
    let measure = goal.measure;
    let reaches = |than| measure.reaches(row.value, than);
    // Unknown parameters are evaluated case by case.
    let known = |key: &str| shelf.aux.get(key).or_else(|| row.aux.get(key));
    if taken.is_some_and(|taken| taken.id == row.id) {
        "taken".to_owned()
    } else if !row_applies(row, known) {
        "is for other auxiliary parameters".to_owned()
    } else if let Some(cap) = against {
        format!("needs more {} than: {cap}", cap.resource)
    } else if !reaches(goal.bound) {
        format!("does not reach {}", measure.format_value(goal.bound))
    } else if !reaches(goal.desire) {
        format!("is acceptable, but does not reach {}", measure.format_value(goal.desire))
    } else {
        let unsaid = row.aux.iter();
        let unsaid: Aux = unsaid
            .filter(|(key, _)| !shelf.aux.contains_key(*key))
            .map(|(key, value)| (key.clone(), value.clone()))
            .collect();
        if unsaid.is_empty() {
            "would suffice, too".to_owned()
        } else {
            format!("would suffice with {}, which is not given", super::aux_pairs(&unsaid))
        }
    }
}

/// Returns the neighbouring rows in either direction, in words.
fn neighbour_rows(row: &Row, shelf: &DictionaryView<'_>, against: impl Fn(&Row) -> Option<Cap>) -> Vec<String> {
    let (better, weaker) = shelf.neighbours(row);
    let better = better.map(|row| {
        let capped = against(row).map(|cap| format!(", more {} than: {cap}", cap.resource));
        format!("better: {}{}", row_in_words(row), capped.unwrap_or_default())
    });
    let weaker = weaker.map(|row| format!("cheaper: {}", row_in_words(row)));
    let mut next: Vec<String> = better.into_iter().chain(weaker).collect();
    if next.is_empty() {
        next.push(format!("{} is the only entry of this kind", row_in_words(row)));
    }
    next
}
