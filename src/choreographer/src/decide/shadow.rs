//! What is the same in the answers of a servant and of a candidate: fields of a message ([`differences`]), messages of two
//! sequences ([`Pairing`]), and all of it together ([`Tally`], [`verdict`]).

mod fields;
mod pairing;

use std::collections::BTreeMap;

use api::calibration::TimeSpread;
use api::shadow::{Compared, FieldDifference, Kind, Verdict};

use fields::FIELDS;
pub(crate) use fields::{Differing, Tolerance, differences};
pub(crate) use pairing::{Paired, Pairing, Side, WINDOW};

/// Response times that are kept of each side.
const TIMES: usize = 50_000;
/// Fewer times say nothing of a median.
const FEWEST: usize = 10;
/// A median that is longer by less is no slower, in milliseconds: the way to the candidate is longer by a hop.
const SLACK: f64 = 1.0;

/// What is known of one topic, service or action.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    row: Compared,
    present: Vec<f64>,
    candidate: Vec<f64>,
    fields: BTreeMap<String, FieldDifference>,
}

impl Tally {
    pub(crate) fn of(kind: Kind, name: &str) -> Tally {
        Tally {
            row: Compared {
                kind,
                name: name.to_owned(),
                ..Compared::default()
            },
            ..Tally::default()
        }
    }

    /// Both have answered.
    pub(crate) fn pair(&mut self, differing: Vec<Differing>) {
        if differing.is_empty() {
            self.row.equal += 1;
            return;
        }
        self.row.different += 1;
        let mut counted = Vec::new();
        for Differing {
            field,
            present,
            candidate,
        } in differing
        {
            // Elements of an array have one name.
            if counted.contains(&field) {
                continue;
            }
            counted.push(field.clone());
            if self.fields.len() >= FIELDS && !self.fields.contains_key(&field) {
                continue;
            }
            let known = self.fields.entry(field.clone());
            let known = known.or_insert(FieldDifference {
                field,
                answers: 0,
                present,
                candidate,
            });
            known.answers += 1;
        }
    }

    pub(crate) fn missing(&mut self) {
        self.row.missing += 1;
    }

    pub(crate) fn surplus(&mut self) {
        self.row.surplus += 1;
    }

    /// How long a request took, in milliseconds.
    pub(crate) fn time(&mut self, side: Side, time: f64) {
        let times = match side {
            Side::Present => &mut self.present,
            Side::Candidate => &mut self.candidate,
        };
        if times.len() < TIMES {
            times.push(time);
        }
    }

    pub(crate) fn shown(self) -> Compared {
        let mut fields: Vec<FieldDifference> = self.fields.into_values().collect();
        fields.sort_by(|one, other| (other.answers, &one.field).cmp(&(one.answers, &other.field)));
        Compared {
            present: TimeSpread::of(self.present),
            candidate: TimeSpread::of(self.candidate),
            fields,
            ..self.row
        }
    }

    /// Whether its median is longer than `bound` allows.
    fn is_slower(row: &Compared, bound: f64) -> bool {
        let enough = row.answers() >= FEWEST as u64;
        match (&row.present, &row.candidate) {
            (Some(present), Some(candidate)) if enough => {
                candidate.p50 > present.p50 * (1.0 + bound) + SLACK
            }
            _ => false,
        }
    }
}

/// What it all comes to; `failed` is why the candidate ended by itself.
pub(crate) fn verdict(rows: &[Compared], failed: Option<&str>, bound: f64) -> (Verdict, String) {
    if let Some(reason) = failed {
        return (Verdict::Failed, format!("the candidate {reason}"));
    }
    let answers: u64 = rows.iter().map(Compared::answers).sum();
    let unequal: u64 = rows.iter().map(Compared::unequal).sum();
    if answers == 0 {
        return (
            Verdict::Nothing,
            "nothing was answered that could be compared".to_owned(),
        );
    }
    if unequal > 0 {
        let of: Vec<&str> = rows
            .iter()
            .filter(|row| row.unequal() > 0)
            .map(|row| row.name.as_str())
            .collect();
        return (
            Verdict::Different,
            format!(
                "{unequal} of {answers} answers are not the same: {}",
                of.join(", ")
            ),
        );
    }
    let slower: Vec<String> = rows
        .iter()
        .filter(|row| Tally::is_slower(row, bound))
        .filter_map(|row| {
            let (present, candidate) = (row.present?, row.candidate?);
            Some(format!(
                "{} takes {:.1} ms instead of {:.1} ms (median)",
                row.name, candidate.p50, present.p50
            ))
        })
        .collect();
    if !slower.is_empty() {
        return (Verdict::Slower, slower.join(", "));
    }
    (
        Verdict::Equal,
        format!("{answers} answers are the same, and took no longer"),
    )
}

#[cfg(test)]
mod tests;
