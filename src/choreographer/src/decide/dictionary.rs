//! Which row of a service's dictionary a goal of an SLA takes: the cheapest that meets it.
//!
//! A row says: up to these auxiliary parameters, with these limits, this value of a measure is reached. Of one goal, with
//! T_desire and T_max or their like ([`Goal`]):
//!
//! 1. Rows of other measures do not count. Where there is none of the goal's, the dictionary says nothing of it.
//! 2. A row *applies* where each of its auxiliary parameters covers the robot's: of two numbers the row's is at least the
//!    robot's, other texts are the same. A parameter that the row does not name does not matter to it.
//! 3. A row is *affordable* where its limits are within every cap, the machine's included.
//! 4. Of the affordable rows that apply, the cheapest one that reaches the desire is taken. Where none does, the one with the
//!    best value is taken, if that reaches the bound. Otherwise the goal cannot be met.
//! 5. *Cheaper* is what takes the smaller dominant share of the machine, the greater of its shares of cores and of memory
//!    (Ghodsi et al., Dominant Resource Fairness, NSDI 2011); then the smaller other share; then the smaller number of the
//!    row. What counts is what is promised: where a row names no limit, that of the service.
//! 6. Where an auxiliary parameter is known of neither the robot nor its session, each value that rows name is looked at by
//!    itself, and the dearest choice is taken. The goal cannot be met if it cannot be met for one of them.

use std::collections::{BTreeMap, BTreeSet};

use api::dictionary::Row;
use api::sla::{Goal, check_aux};
use api::{Limits, Measure};

use super::Amount;
use super::demand;

/// Rows that a service may have.
pub const MOST_ROWS: usize = 1000;

/// Auxiliary parameters, by name.
pub type Aux = BTreeMap<String, String>;

/// What a choice is made from, beside the goal.
#[derive(Debug, Clone, Copy)]
pub struct Shelf<'a> {
    /// All rows of the service.
    pub rows: &'a [Row],
    /// What is known of the robot.
    pub aux: &'a Aux,
    /// Limits where a row names none.
    pub own: Limits,
    /// What is set aside where those name none either: cores and bytes.
    pub reserve: (f64, u64),
    /// What the machine has.
    pub capacity: Amount,
}

/// What is taken for a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Choice<'a> {
    /// There is no row of its measure.
    Silent,
    /// This row.
    Taken {
        /// The row.
        row: &'a Row,
        /// Its value reaches what is wished for, not only what is acceptable.
        desired: bool,
        /// Auxiliary parameters that are not known, with the values for which the row was taken.
        assumed: Aux,
    },
    /// None can be taken.
    Unmet {
        /// The best that can be had.
        best: Option<&'a Row>,
        /// The cheapest that would do and is not affordable.
        beyond: Option<&'a Row>,
        /// Auxiliary parameters that are not known, with the values for which there is none.
        assumed: Aux,
    },
}

/// What a row takes of the machine: the less, the cheaper. Dominant share, other share, number.
type Cost = (f64, f64, i64);

fn less(one: Cost, other: Cost) -> std::cmp::Ordering {
    one.0
        .total_cmp(&other.0)
        .then(one.1.total_cmp(&other.1))
        .then(one.2.cmp(&other.2))
}

impl<'a> Shelf<'a> {
    /// What a row takes.
    pub fn amount(&self, row: &Row) -> Amount {
        demand::promised(&row.limits.or(self.own), self.reserve)
    }

    fn cost(&self, row: &Row) -> Cost {
        let share = |of: u64, all: u64| of as f64 / all.max(1) as f64;
        let amount = self.amount(row);
        let cores = share(amount.millicpus, self.capacity.millicpus);
        let memory = share(amount.memory, self.capacity.memory);
        (cores.max(memory), cores.min(memory), row.id)
    }

    /// The row for a goal; `affordable` is what the caps say.
    pub fn choose(&self, goal: &Goal, affordable: impl Fn(&Row) -> bool) -> Choice<'a> {
        let of_measure = || self.rows.iter().filter(|row| row.measure == goal.measure);
        if of_measure().next().is_none() {
            return Choice::Silent;
        }
        let holding =
            of_measure().filter(|row| applies(row, |key| self.aux.get(key).or(row.aux.get(key))));
        let mut holding: Vec<Holding<'a>> = holding
            .map(|row| Holding {
                row,
                cost: self.cost(row),
                open: affordable(row),
                unknown: (row.aux.iter())
                    .filter(|(key, _)| !self.aux.contains_key(*key))
                    .map(|(key, value)| (&**key, &**value, number(value)))
                    .collect(),
            })
            .collect();
        holding.sort_unstable_by(|one, other| less(one.cost, other.cost));
        let cases: BTreeSet<Case<'a>> = holding.iter().map(Holding::case).collect();
        let mut dearest: Option<(&Holding<'a>, bool, Case<'a>)> = None;
        for case in cases {
            let numbers: Vec<Option<f64>> = case.iter().map(|(_, value)| number(value)).collect();
            let applying = || holding.iter().filter(|row| row.covers(&case, &numbers));
            match best_of(goal, applying) {
                Ok((row, desired)) => {
                    let dear = dearest.as_ref().map(|(dear, ..)| dear.cost);
                    if dear.is_none_or(|dear| less(row.cost, dear).is_gt()) {
                        dearest = Some((row, desired, case));
                    }
                }
                Err((best, beyond)) => {
                    return Choice::Unmet {
                        best,
                        beyond,
                        assumed: owned(&case),
                    };
                }
            }
        }
        match dearest {
            Some((Holding { row, .. }, desired, case)) => Choice::Taken {
                row,
                desired,
                assumed: owned(&case),
            },
            // Without any case no row is for what is known.
            None => Choice::Unmet {
                best: None,
                beyond: None,
                assumed: Aux::new(),
            },
        }
    }

    /// The cheapest row with a better value than this one's, and the best of the cheaper ones, of those that hold for the same
    /// robot: what comes next in either direction. What is not known of the robot is as this row has it.
    pub fn next_to(&self, taken: &Row) -> (Option<&'a Row>, Option<&'a Row>) {
        let beside = || {
            let rows = self.rows.iter();
            let known = |key: &str| self.aux.get(key).or(taken.aux.get(key));
            rows.filter(move |row| row.measure == taken.measure && applies(row, known))
        };
        let cheaper = |one: &&'a Row, other: &&'a Row| less(self.cost(one), self.cost(other));
        let dearer = beside().filter(|row| better(row.measure, row.value, taken.value).is_lt());
        let weaker = beside().filter(|row| {
            row.id != taken.id
                && less(self.cost(row), self.cost(taken)).is_lt()
                && !better(row.measure, row.value, taken.value).is_lt()
        });
        let weaker = weaker.min_by(|one, other| {
            better(one.measure, one.value, other.value).then_with(|| cheaper(one, other))
        });
        (dearer.min_by(cheaper), weaker)
    }

    /// All rows of a measure, the cheapest first.
    pub fn by_cost(&self, measure: Measure) -> Vec<&'a Row> {
        let rows = self.rows.iter().filter(|row| row.measure == measure);
        let mut rows: Vec<&Row> = rows.collect();
        rows.sort_by(|one, other| less(self.cost(one), self.cost(other)));
        rows
    }
}

/// The better value first.
fn better(measure: Measure, one: f64, other: f64) -> std::cmp::Ordering {
    match measure {
        Measure::Rrt | Measure::Age => one.total_cmp(&other),
        Measure::Fps => other.total_cmp(&one),
    }
}

/// What the parameters that are not known may be, as rows name them that hold for what is known; in the order of their names.
type Case<'a> = Vec<(&'a str, &'a str)>;

fn owned(case: &Case<'_>) -> Aux {
    let pairs = case.iter();
    pairs
        .map(|(key, value)| ((*key).to_owned(), (*value).to_owned()))
        .collect()
}

/// A row that holds for what is known of the robot, with what choosing among many asks of it again and again.
struct Holding<'a> {
    row: &'a Row,
    cost: Cost,
    /// It is affordable.
    open: bool,
    /// Its parameters that are not known, in the order of their names: value, and as a number.
    unknown: Vec<(&'a str, &'a str, Option<f64>)>,
}

impl<'a> Holding<'a> {
    fn case(&self) -> Case<'a> {
        let unknown = self.unknown.iter();
        unknown.map(|(key, value, _)| (*key, *value)).collect()
    }

    /// Whether it applies in this case, whose values are these numbers.
    fn covers(&self, case: &Case<'a>, numbers: &[Option<f64>]) -> bool {
        let mut has = case.iter().zip(numbers);
        self.unknown.iter().all(|(key, most, upto)| {
            has.find(|((name, _), _)| name == key)
                .is_some_and(|((_, value), number)| match (number, upto) {
                    (Some(number), Some(upto)) => number <= upto,
                    _ => value == most,
                })
        })
    }
}

/// Of rows that apply, the cheapest first: the one to take and whether it reaches the desire; else the best, and the cheapest
/// that would do but for the caps.
#[allow(clippy::type_complexity)]
fn best_of<'a, 'h, I: Iterator<Item = &'h Holding<'a>>>(
    goal: &Goal,
    rows: impl Fn() -> I,
) -> Result<(&'h Holding<'a>, bool), (Option<&'a Row>, Option<&'a Row>)>
where
    'a: 'h,
{
    let reaches = |one: &Holding<'_>, than| goal.measure.reaches(one.row.value, than);
    let open = || rows().filter(|one| one.open);
    if let Some(one) = open().find(|one| reaches(one, goal.desire)) {
        return Ok((one, true));
    }
    // The first of those that are equally good is the cheapest.
    let best = open().min_by(|one, other| better(goal.measure, one.row.value, other.row.value));
    match best {
        Some(one) if reaches(one, goal.bound) => Ok((one, false)),
        best => {
            let beyond = rows().find(|one| !one.open && reaches(one, goal.bound));
            Err((best.map(|one| one.row), beyond.map(|one| one.row)))
        }
    }
}

/// Whether a row holds for a robot of which `known` says what is known.
pub fn applies<'a>(row: &Row, known: impl Fn(&str) -> Option<&'a String>) -> bool {
    row.aux.iter().all(|(key, most)| {
        known(key).is_some_and(|has| match (number(has), number(most)) {
            (Some(has), Some(most)) => has <= most,
            _ => has == most,
        })
    })
}

fn number(text: &str) -> Option<f64> {
    text.parse().ok().filter(|number: &f64| number.is_finite())
}

/// Refuses a row that cannot be; says what to write.
pub fn check(row: &Row) -> Result<(), String> {
    let name = row.measure.name();
    row.measure
        .read(&row.value.to_string())
        .map_err(|reason| format!("{name} {reason}"))?;
    for (key, value) in &row.aux {
        check_aux(key, value).map_err(|reason| format!("aux.{key} {reason}"))?;
    }
    crate::limits::check(&row.limits).map_err(|error| error.to_string())?;
    if let Some(spread) = &row.spread {
        let (p50, p95) = (spread.p50, spread.p95);
        if !(p50.is_finite() && p95.is_finite() && p50 >= 0.0 && p95 >= 0.0) {
            return Err(format!(
                "spread: p50 {p50} and p95 {p95} are no times or rates"
            ));
        }
        if row.measure != Measure::Fps && p95 < p50 {
            return Err(format!(
                "spread: the 95th percentile, {p95}, is less than the median, {p50}; write the median first"
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
