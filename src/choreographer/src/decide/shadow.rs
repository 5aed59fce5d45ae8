//! Compares the answers of a servant and of a candidate: fields of a message ([`differences`]), messages of two
//! sequences ([`Pairing`]), and the overall result ([`Tally`], [`overall_verdict`]).

mod fields;
mod pairing;

use std::collections::BTreeMap;

use api::calibration::TimeSpread;
use api::shadow::{Compared, FieldDifference, Kind, Verdict};

use fields::FIELDS;
pub(crate) use fields::{DifferingField, Tolerance, differences};
pub(crate) use pairing::{Pairing, PairingResult, ShadowSide, WINDOW};

/// Maximum number of response times kept of each side.
const TIMES: usize = 50_000;
/// Minimum number of times for a meaningful median.
const FEWEST: usize = 10;
/// Tolerance of the median, in milliseconds: the path to the candidate is longer by a hop.
const SLACK: f64 = 1.0;

/// Comparison of one topic, service or action.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    row: Compared,
    present: Vec<f64>,
    candidate: Vec<f64>,
    fields: BTreeMap<String, FieldDifference>,
}

impl Tally {
    pub(crate) fn new(kind: Kind, name: &str) -> Tally {
        Tally { row: Compared { kind, name: name.to_owned(), ..Compared::default() }, ..Tally::default() }
    }

    /// Records a pair of answers and their differences.
    pub(crate) fn record_pair(&mut self, differing: Vec<DifferingField>) {
        if differing.is_empty() {
            self.row.equal += 1;
            return;
        }
        self.row.different += 1;
        let mut counted = Vec::new();
        for DifferingField { field, present, candidate } in differing {
            // Elements of an array share one name.
            if counted.contains(&field) {
                continue;
            }
            counted.push(field.clone());
            if self.fields.len() >= FIELDS && !self.fields.contains_key(&field) {
                continue;
            }
            let known = self.fields.entry(field.clone());
            let known = known.or_insert(FieldDifference { field, answers: 0, present, candidate });
            known.answers += 1;
        }
    }

    pub(crate) fn record_missing(&mut self) {
        self.row.missing += 1;
    }

    pub(crate) fn record_surplus(&mut self) {
        self.row.surplus += 1;
    }

    /// Records the response time of a request, in milliseconds.
    pub(crate) fn record_time(&mut self, side: ShadowSide, time: f64) {
        let times = match side {
            ShadowSide::Present => &mut self.present,
            ShadowSide::Candidate => &mut self.candidate,
        };
        if times.len() < TIMES {
            times.push(time);
        }
    }

    pub(crate) fn into_compared(self) -> Compared {
        let mut fields: Vec<FieldDifference> = self.fields.into_values().collect();
        fields.sort_by(|one, other| (other.answers, &one.field).cmp(&(one.answers, &other.field)));
        Compared {
            present: TimeSpread::from_samples(self.present),
            candidate: TimeSpread::from_samples(self.candidate),
            fields,
            ..self.row
        }
    }

    /// Returns true if the candidate's median is longer than `bound` allows.
    fn is_slower(row: &Compared, bound: f64) -> bool {
        let enough = row.answers() >= FEWEST as u64;
        match (&row.present, &row.candidate) {
            (Some(present), Some(candidate)) if enough => candidate.p50 > present.p50 * (1.0 + bound) + SLACK,
            _ => false,
        }
    }
}

/// Returns the overall verdict; `failed` is the reason why the candidate ended unexpectedly.
pub(crate) fn overall_verdict(rows: &[Compared], failed: Option<&str>, bound: f64) -> (Verdict, String) {
    if let Some(reason) = failed {
        return (Verdict::Failed, format!("the candidate {reason}"));
    }
    let answers: u64 = rows.iter().map(Compared::answers).sum();
    let unequal: u64 = rows.iter().map(Compared::unequal).sum();
    if answers == 0 {
        return (Verdict::Nothing, "there were no answers to compare".to_owned());
    }
    if unequal > 0 {
        let of: Vec<&str> = rows.iter().filter(|row| row.unequal() > 0).map(|row| row.name.as_str()).collect();
        return (Verdict::Different, format!("{unequal} of {answers} answers differ: {}", of.join(", ")));
    }
    let slower: Vec<String> = rows
        .iter()
        .filter(|row| Tally::is_slower(row, bound))
        .filter_map(|row| {
            let (present, candidate) = (row.present?, row.candidate?);
            Some(format!("{} takes {:.1} ms instead of {:.1} ms (p50)", row.name, candidate.p50, present.p50))
        })
        .collect();
    if !slower.is_empty() {
        return (Verdict::Slower, slower.join(", "));
    }
    (Verdict::Equal, format!("{answers} answers are equal and not slower"))
}

#[cfg(test)]
mod tests;
