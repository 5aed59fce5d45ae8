//! Chooses the row of a service's dictionary for a goal of an SLA: the cheapest that meets it.
//!
//! A row states: up to these auxiliary parameters, with these limits, this value of a measure is reached. For a goal
//! with T_desire and T_max or their equivalents ([`Goal`]):
//!
//! 1. Rows of other measures do not count. If there is none of the goal's measure, the dictionary has no answer.
//! 2. A row *applies* if each of its auxiliary parameters covers the robot's: a number of the row is at least the
//!    robot's, other texts are equal. Parameters that the row does not name do not matter.
//! 3. A row is *affordable* if its limits are within every cap, the machine's included.
//! 4. Of the affordable rows that apply, the cheapest one that reaches the desired value is taken. If none does, the
//!    one with the best value is taken, provided it reaches the bound. Otherwise the goal cannot be met.
//! 5. A row is *cheaper* if it takes a smaller dominant share of the machine, the greater of its shares of cores and of
//!    memory (Ghodsi et al., Dominant Resource Fairness, NSDI 2011); then the smaller other share; then the smaller row
//!    number. The promised amount counts: if a row names no limit, the service's own.
//! 6. If an auxiliary parameter is known neither from the robot nor from its session, each value named in rows is
//!    evaluated separately, and the most expensive choice is taken. The goal cannot be met if it cannot be met for one
//!    of them.

use std::collections::{BTreeMap, BTreeSet};

use api::dictionary::Row;
use api::limits::UnusableLimits;
use api::sla::{AuxError, Goal, ParseValueError, check_aux};
use api::{Limits, Measure};

use super::Amount;
use super::demand;

/// Maximum number of rows of a service.
pub const MOST_ROWS: usize = 1000;

/// Auxiliary parameters, by name.
pub type Aux = BTreeMap<String, String>;

/// A service's dictionary and the context for a choice.
#[derive(Debug, Clone, Copy)]
pub struct DictionaryView<'a> {
    /// All rows of the service.
    pub rows: &'a [Row],
    /// Known auxiliary parameters of the robot.
    pub aux: &'a Aux,
    /// Limits for rows that name none.
    pub own: Limits,
    /// Reserve for resources without any limit: cores and bytes.
    pub reserve: (f64, u64),
    /// Capacity of the machine.
    pub capacity: Amount,
}

/// Result of the choice for a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum RowChoice<'a> {
    /// No row has the goal's measure.
    Silent,
    /// This row is taken.
    Taken {
        /// The row.
        row: &'a Row,
        /// The row reaches the desired value, not only the bound.
        desired: bool,
        /// Unknown auxiliary parameters, with the values for which the row was chosen.
        assumed: Aux,
    },
    /// No row can be taken.
    Unmet {
        /// The best affordable row.
        best: Option<&'a Row>,
        /// The cheapest sufficient row that is not affordable.
        beyond: Option<&'a Row>,
        /// Unknown auxiliary parameters, with the values for which no row suffices.
        assumed: Aux,
    },
}

/// Cost of a row: dominant share of the machine, other share, row number.
type Cost = (f64, f64, i64);

fn compare_costs(one: Cost, other: Cost) -> std::cmp::Ordering {
    one.0.total_cmp(&other.0).then(one.1.total_cmp(&other.1)).then(one.2.cmp(&other.2))
}

impl<'a> DictionaryView<'a> {
    /// Returns the amount that a row is promised.
    pub fn amount(&self, row: &Row) -> Amount {
        demand::promised_amount(&row.limits.or(self.own), self.reserve)
    }

    fn cost(&self, row: &Row) -> Cost {
        let share = |of: u64, all: u64| of as f64 / all.max(1) as f64;
        let amount = self.amount(row);
        let cores = share(amount.millicpus, self.capacity.millicpus);
        let memory = share(amount.memory, self.capacity.memory);
        (cores.max(memory), cores.min(memory), row.id)
    }

    /// Chooses the row for a goal; `affordable` evaluates the caps.
    pub fn choose(&self, goal: &Goal, affordable: impl Fn(&Row) -> bool) -> RowChoice<'a> {
        let of_measure = || self.rows.iter().filter(|row| row.measure == goal.measure);
        if of_measure().next().is_none() {
            return RowChoice::Silent;
        }
        let holding = of_measure().filter(|row| row_applies(row, |key| self.aux.get(key).or(row.aux.get(key))));
        let mut holding: Vec<CandidateRow<'a>> = holding
            .map(|row| CandidateRow {
                row,
                cost: self.cost(row),
                open: affordable(row),
                unknown: (row.aux.iter())
                    .filter(|(key, _)| !self.aux.contains_key(*key))
                    .map(|(key, value)| (&**key, &**value, parse_number(value)))
                    .collect(),
            })
            .collect();
        holding.sort_unstable_by(|one, other| compare_costs(one.cost, other.cost));
        let cases: BTreeSet<AuxCase<'a>> = holding.iter().map(CandidateRow::aux_case).collect();
        let mut dearest: Option<(&CandidateRow<'a>, bool, AuxCase<'a>)> = None;
        for case in cases {
            let numbers: Vec<Option<f64>> = case.iter().map(|(_, value)| parse_number(value)).collect();
            let applying = || holding.iter().filter(|row| row.applies_in(&case, &numbers));
            match best_row(goal, applying) {
                Ok((row, desired)) => {
                    let dear = dearest.as_ref().map(|(dear, ..)| dear.cost);
                    if dear.is_none_or(|dear| compare_costs(row.cost, dear).is_gt()) {
                        dearest = Some((row, desired, case));
                    }
                }
                Err((best, beyond)) => {
                    return RowChoice::Unmet { best, beyond, assumed: to_aux(&case) };
                }
            }
        }
        match dearest {
            Some((CandidateRow { row, .. }, desired, case)) => {
                RowChoice::Taken { row, desired, assumed: to_aux(&case) }
            }
            // Without any case no row matches the known parameters.
            None => RowChoice::Unmet { best: None, beyond: None, assumed: Aux::new() },
        }
    }

    /// Returns the cheapest row with a better value than this one's, and the best of the cheaper ones, among those for
    /// the same robot: the neighbours in either direction. Unknown parameters of the robot are taken from this row.
    pub fn neighbours(&self, taken: &Row) -> (Option<&'a Row>, Option<&'a Row>) {
        let beside = || {
            let rows = self.rows.iter();
            let known = |key: &str| self.aux.get(key).or(taken.aux.get(key));
            rows.filter(move |row| row.measure == taken.measure && row_applies(row, known))
        };
        let cheaper = |one: &&'a Row, other: &&'a Row| compare_costs(self.cost(one), self.cost(other));
        let dearer = beside().filter(|row| compare_values(row.measure, row.value, taken.value).is_lt());
        let weaker = beside().filter(|row| {
            row.id != taken.id
                && compare_costs(self.cost(row), self.cost(taken)).is_lt()
                && !compare_values(row.measure, row.value, taken.value).is_lt()
        });
        let weaker = weaker
            .min_by(|one, other| compare_values(one.measure, one.value, other.value).then_with(|| cheaper(one, other)));
        (dearer.min_by(cheaper), weaker)
    }

    /// Returns all rows of a measure, cheapest first.
    pub fn rows_by_cost(&self, measure: Measure) -> Vec<&'a Row> {
        let rows = self.rows.iter().filter(|row| row.measure == measure);
        let mut rows: Vec<&Row> = rows.collect();
        rows.sort_by(|one, other| compare_costs(self.cost(one), self.cost(other)));
        rows
    }
}

/// Compares two values of a measure; the better one is less.
fn compare_values(measure: Measure, one: f64, other: f64) -> std::cmp::Ordering {
    if measure.is_less_better() { one.total_cmp(&other) } else { other.total_cmp(&one) }
}

/// Values of the unknown parameters, as named in rows that match the known ones; sorted by name.
type AuxCase<'a> = Vec<(&'a str, &'a str)>;

fn to_aux(case: &AuxCase<'_>) -> Aux {
    let pairs = case.iter();
    pairs.map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
}

/// A row that matches the known parameters of the robot, with precomputed data for the choice among many.
struct CandidateRow<'a> {
    row: &'a Row,
    cost: Cost,
    /// The row is affordable.
    open: bool,
    /// Unknown parameters of the row, sorted by name: value, and value as a number.
    unknown: Vec<(&'a str, &'a str, Option<f64>)>,
}

impl<'a> CandidateRow<'a> {
    fn aux_case(&self) -> AuxCase<'a> {
        let unknown = self.unknown.iter();
        unknown.map(|(key, value, _)| (*key, *value)).collect()
    }

    /// Returns true if the row applies in this case, whose values are these numbers.
    fn applies_in(&self, case: &AuxCase<'a>, numbers: &[Option<f64>]) -> bool {
        let mut has = case.iter().zip(numbers);
        self.unknown.iter().all(|(key, most, upto)| {
            has.find(|((name, _), _)| name == key).is_some_and(|((_, value), number)| match (number, upto) {
                (Some(number), Some(upto)) => number <= upto,
                _ => value == most,
            })
        })
    }
}

/// Chooses among rows that apply, cheapest first: the row to take and whether it reaches the desired value; otherwise
/// the best row, and the cheapest that only the caps exclude.
#[allow(clippy::type_complexity)]
fn best_row<'a, 'h, I: Iterator<Item = &'h CandidateRow<'a>>>(
    goal: &Goal,
    rows: impl Fn() -> I,
) -> Result<(&'h CandidateRow<'a>, bool), (Option<&'a Row>, Option<&'a Row>)>
where
    'a: 'h,
{
    let reaches = |one: &CandidateRow<'_>, than| goal.measure.reaches(one.row.value, than);
    let open = || rows().filter(|one| one.open);
    if let Some(one) = open().find(|one| reaches(one, goal.desire)) {
        return Ok((one, true));
    }
    // Among equally good rows the first is the cheapest.
    let best = open().min_by(|one, other| compare_values(goal.measure, one.row.value, other.row.value));
    match best {
        Some(one) if reaches(one, goal.bound) => Ok((one, false)),
        best => {
            let beyond = rows().find(|one| !one.open && reaches(one, goal.bound));
            Err((best.map(|one| one.row), beyond.map(|one| one.row)))
        }
    }
}

/// Returns true if a row applies to a robot with the `known` parameters.
pub fn row_applies<'a>(row: &Row, known: impl Fn(&str) -> Option<&'a String>) -> bool {
    row.aux.iter().all(|(key, most)| {
        known(key).is_some_and(|has| match (parse_number(has), parse_number(most)) {
            (Some(has), Some(most)) => has <= most,
            _ => has == most,
        })
    })
}

fn parse_number(text: &str) -> Option<f64> {
    text.parse().ok().filter(|number: &f64| number.is_finite())
}

/// Reason why a row is invalid, and what to write instead.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RowError {
    /// Invalid value of the measure.
    #[error("{} {error}", .measure.name())]
    Value {
        /// The measure.
        measure: Measure,
        /// Reason.
        error: ParseValueError,
    },
    /// Invalid auxiliary parameter.
    #[error("aux.{key} {error}")]
    Aux {
        /// Name of the parameter.
        key: String,
        /// Reason.
        error: AuxError,
    },
    /// Invalid limits.
    #[error(transparent)]
    Limits(#[from] UnusableLimits),
    /// Percentiles that are no times or rates.
    #[error("spread: p50 {p50} and p95 {p95} are not valid times or rates")]
    InvalidSpread {
        /// Median.
        p50: f64,
        /// 95th percentile.
        p95: f64,
    },
    /// Percentiles in the wrong order.
    #[error("spread: p95, {p95}, is less than p50, {p50}; write p50 first")]
    DisorderedSpread {
        /// Median.
        p50: f64,
        /// 95th percentile.
        p95: f64,
    },
}

/// Checks a row; the error says what to write.
pub fn check(row: &Row) -> Result<(), RowError> {
    let measure = row.measure;
    measure.parse_value(&row.value.to_string()).map_err(|error| RowError::Value { measure, error })?;
    for (key, value) in &row.aux {
        check_aux(key, value).map_err(|error| RowError::Aux { key: key.clone(), error })?;
    }
    row.limits.check()?;
    if let Some(spread) = &row.spread {
        let (p50, p95) = (spread.p50, spread.p95);
        if !(p50.is_finite() && p95.is_finite() && p50 >= 0.0 && p95 >= 0.0) {
            return Err(RowError::InvalidSpread { p50, p95 });
        }
        if measure.is_less_better() && p95 < p50 {
            return Err(RowError::DisorderedSpread { p50, p95 });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
