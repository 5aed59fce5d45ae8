use api::Size;
use proptest::prelude::*;

use super::*;

const CAPACITY: Amount = Amount { millicpus: 4000, memory: 8 << 30 };

fn row(id: i64, measure: Measure, value: f64, cpus: f64, aux: &[(&str, &str)]) -> Row {
    Row {
        id,
        measure,
        value,
        aux: aux_of(aux),
        limits: Limits { cpus: Some(cpus), ..Limits::default() },
        spread: None,
        revision: None,
        written: 0,
    }
}

fn aux_of(aux: &[(&str, &str)]) -> Aux {
    aux.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
}

fn goal(desire: f64, bound: f64) -> Goal {
    Goal { measure: Measure::Rrt, desire, bound }
}

fn view<'a>(rows: &'a [Row], aux: &'a Aux) -> DictionaryView<'a> {
    DictionaryView { rows, aux, own: Limits::default(), reserve: (0.01, 64 << 20), capacity: CAPACITY }
}

/// The number of the chosen row, and whether it reaches the desired value; otherwise the best one and the one that is
/// too expensive.
type ChoiceOutcome = Result<Option<(i64, bool)>, (Option<i64>, Option<i64>)>;

fn choice_outcome(choice: &RowChoice<'_>) -> ChoiceOutcome {
    match choice {
        RowChoice::Silent => Ok(None),
        RowChoice::Taken { row, desired, .. } => Ok(Some((row.id, *desired))),
        RowChoice::Unmet { best, beyond, .. } => Err((best.map(|row| row.id), beyond.map(|row| row.id))),
    }
}

#[test]
fn the_cheapest_that_meets_the_goal_is_taken() {
    let rows = [
        row(1, Measure::Rrt, 0.050, 3.0, &[]),
        row(2, Measure::Rrt, 0.100, 1.5, &[]),
        row(3, Measure::Rrt, 0.200, 0.75, &[]),
        row(4, Measure::Rrt, 0.200, 1.0, &[]),
        row(5, Measure::Fps, 5.0, 0.5, &[]),
        row(6, Measure::Fps, 20.0, 2.0, &[]),
    ];
    let none = Aux::new();
    let shelf = view(&rows, &none);
    for (desire, bound, most, expected) in [
        (0.100, 0.300, 4.0, Ok(Some((2, true)))),
        (0.150, 0.300, 4.0, Ok(Some((2, true)))),
        (0.200, 0.300, 4.0, Ok(Some((3, true)))),
        (0.060, 0.300, 4.0, Ok(Some((1, true)))),
        // The desired value is not reached: the best within the bound.
        (0.020, 0.300, 4.0, Ok(Some((1, false)))),
        (0.060, 0.300, 2.0, Ok(Some((2, false)))),
        (0.060, 0.300, 1.0, Ok(Some((3, false)))),
        // Not even the bound.
        (0.020, 0.030, 4.0, Err((Some(1), None))),
        (0.050, 0.060, 2.0, Err((Some(2), Some(1)))),
        (0.050, 0.300, 0.1, Err((None, Some(3)))),
    ] {
        let choice = shelf.choose(&goal(desire, bound), |row| row.limits.cpus <= Some(most));
        assert_eq!(choice_outcome(&choice), expected, "{desire} {bound} {most}");
    }
    let fps = |desire, bound| Goal { measure: Measure::Fps, desire, bound };
    for (desire, bound, expected) in [
        (4.0, 2.0, Ok(Some((5, true)))),
        (10.0, 2.0, Ok(Some((6, true)))),
        (30.0, 10.0, Ok(Some((6, false)))),
        (30.0, 25.0, Err((Some(6), None))),
    ] {
        let choice = shelf.choose(&fps(desire, bound), |_| true);
        assert_eq!(choice_outcome(&choice), expected, "{desire} {bound}");
    }
    let age = Goal { measure: Measure::Age, desire: 1.0, bound: 1.0 };
    assert_eq!(shelf.choose(&age, |_| true), RowChoice::Silent);
    let next = |id: usize| {
        let (better, weaker) = shelf.neighbours(&rows[id - 1]);
        (better.map(|row| row.id), weaker.map(|row| row.id))
    };
    assert_eq!(next(2), (Some(1), Some(3)));
    assert_eq!((next(1), next(3)), ((None, Some(2)), (Some(2), None)));
    assert_eq!((next(5), next(6)), ((Some(6), None), (None, Some(5))));
}

#[test]
fn cheap_is_what_takes_a_small_share_of_the_machine() {
    let with = |id, cpus, gib: u64| {
        let mut row = row(id, Measure::Rrt, 0.1, cpus, &[]);
        row.limits.memory = Some(Size(gib << 30));
        row
    };
    let none = Aux::new();
    for (rows, expected) in [
        // A quarter of the cores against half of the memory.
        ([with(1, 1.0, 1), with(2, 0.1, 4)], 1),
        // Equal dominant shares: the smaller other share, then the smaller number.
        ([with(1, 1.0, 2), with(2, 1.0, 1)], 2),
        ([with(2, 1.0, 1), with(1, 1.0, 1)], 1),
    ] {
        let choice = view(&rows, &none).choose(&goal(0.1, 0.1), |_| true);
        assert_eq!(choice_outcome(&choice), Ok(Some((expected, true))));
    }
    // If a row names no memory, the service's own counts.
    let rows = [row(1, Measure::Rrt, 0.1, 1.0, &[]), with(2, 1.1, 1)];
    let own = Limits { memory: Some(Size(4 << 30)), ..Limits::default() };
    let shelf = DictionaryView { own, ..view(&rows, &none) };
    let choice = shelf.choose(&goal(0.1, 0.1), |_| true);
    assert_eq!(choice_outcome(&choice), Ok(Some((2, true))));
}

#[test]
fn auxiliary_parameters_say_which_rows_hold() {
    let rows = [
        row(1, Measure::Rrt, 0.1, 0.5, &[("width", "640")]),
        row(2, Measure::Rrt, 0.1, 2.0, &[("width", "1920")]),
        row(3, Measure::Rrt, 0.1, 3.0, &[("width", "640"), ("model", "big")]),
        row(4, Measure::Rrt, 0.05, 3.5, &[("model", "big")]),
    ];
    for (aux, desire, expected) in [
        (&[("width", "640"), ("model", "small")][..], 0.1, Ok(Some((1, true)))),
        (&[("width", "320.5"), ("model", "small")], 0.1, Ok(Some((1, true)))),
        (&[("width", "641"), ("model", "small")], 0.1, Ok(Some((2, true)))),
        // Nothing was measured for it.
        (&[("width", "1921"), ("model", "small")], 0.1, Err((None, None))),
        (&[("width", "wide"), ("model", "small")], 0.1, Err((None, None))),
        (&[("width", "wide"), ("model", "big")], 0.1, Ok(Some((4, true)))),
        (&[("width", "640"), ("model", "big")], 0.05, Ok(Some((4, true)))),
        // An unknown parameter may have any value that rows name.
        (&[("model", "small")], 0.1, Ok(Some((2, true)))),
        (&[("width", "640")], 0.1, Ok(Some((1, true)))),
    ] {
        let aux = aux_of(aux);
        let choice = view(&rows, &aux).choose(&goal(desire, 0.1), |_| true);
        assert_eq!(choice_outcome(&choice), expected, "{aux:?} {desire}");
    }
    let nothing = Aux::new();
    let choice = view(&rows[..2], &nothing).choose(&goal(0.1, 0.1), |_| true);
    let RowChoice::Taken { assumed, .. } = choice else {
        panic!("{choice:?}");
    };
    assert_eq!(assumed, aux_of(&[("width", "1920")]), "it is said");
}

#[test]
fn rows_that_cannot_be_are_refused_with_what_to_write() {
    let good = row(0, Measure::Rrt, 0.1, 1.0, &[("width", "640")]);
    assert_eq!(check(&good), Ok(()));
    let with = |change: fn(&mut Row)| {
        let mut row = good.clone();
        change(&mut row);
        check(&row).expect_err("refused").to_string()
    };
    for (refused, words) in [
        (with(|row| row.value = 0.0), "rrt \"0\" is not a time"),
        (with(|row| row.value = f64::NAN), "rrt \"NaN\""),
        (with(|row| row.value = 1e9), "rrt \"1000000000\""),
        (with(|row| (row.measure, row.value) = (Measure::Fps, -1.0)), "fps = \"-1\" is not a rate"),
        (with(|row| row.aux = aux_of(&[("a b", "1")])), "aux.a b is not an auxiliary parameter"),
        (with(|row| row.aux = aux_of(&[("a", "")])), "aux.a has no value"),
        (with(|row| row.limits.cpus = Some(0.0)), "cpus = 0 is not"),
        (with(|row| row.limits.memory = Some(Size(1))), "memory = 1 is too little"),
        (
            with(|row| {
                row.spread = Some(api::dictionary::Spread { p50: f64::NAN, p95: 1.0, requests: 1 });
            }),
            "spread: p50 NaN",
        ),
        (
            with(|row| {
                row.spread = Some(api::dictionary::Spread { p50: 0.2, p95: 0.1, requests: 1 });
            }),
            "spread: p95, 0.1, is less than p50, 0.2",
        ),
    ] {
        assert!(refused.starts_with(words), "{refused}");
    }
}

fn measures() -> impl Strategy<Value = Measure> {
    prop_oneof![Just(Measure::Rrt), Just(Measure::Fps)]
}

/// A few different values, so that some coincide.
fn value() -> impl Strategy<Value = f64> {
    (1u32..12).prop_map(|n| f64::from(n) / 8.0)
}

fn rows() -> impl Strategy<Value = Vec<Row>> {
    let width = proptest::option::of(1u32..5);
    let one = (measures(), value(), 1u32..12, 1u64..6, width);
    proptest::collection::vec(one, 0..12).prop_map(|rows| {
        let rows = rows.into_iter().enumerate();
        rows.map(|(index, (measure, value, cpus, gib, width))| {
            let mut row = row(index as i64 + 1, measure, value, f64::from(cpus) / 4.0, &[]);
            row.limits.memory = Some(Size(gib << 30));
            if let Some(width) = width {
                row.aux.insert("width".into(), width.to_string());
            }
            row
        })
        .collect()
    })
}

fn goals() -> impl Strategy<Value = Goal> {
    (measures(), value(), value()).prop_map(|(measure, one, other)| {
        let in_order = measure.reaches(one, other);
        let (desire, bound) = if in_order { (one, other) } else { (other, one) };
        Goal { measure, desire, bound }
    })
}

fn affordable_within(most: f64) -> impl Fn(&Row) -> bool {
    move |row| row.limits.cpus <= Some(most)
}

proptest! {
    #[test]
    fn what_is_taken_meets_the_goal_and_nothing_cheaper_does(
        rows in rows(), goal in goals(), width in 1u32..6, most in value().prop_map(|n| n * 3.0),
    ) {
        let aux = aux_of(&[("width", &width.to_string())]);
        let shelf = view(&rows, &aux);
        let open = |row: &&Row| {
            let fits = row.aux.get("width").is_none_or(|has| has.parse::<u32>().unwrap() >= width);
            row.measure == goal.measure && fits && affordable_within(most)(row)
        };
        let reaching = |than: f64| rows.iter().filter(open).filter(move |row| goal.measure.reaches(row.value, than));
        match shelf.choose(&goal, affordable_within(most)) {
            RowChoice::Silent => prop_assert!(rows.iter().all(|row| row.measure != goal.measure)),
            RowChoice::Taken { row, desired, assumed } => {
                prop_assert!(assumed.is_empty());
                prop_assert!(open(&row) && goal.measure.reaches(row.value, goal.bound));
                prop_assert_eq!(desired, reaching(goal.desire).next().is_some());
                if desired {
                    for other in reaching(goal.desire) {
                        prop_assert!(compare_costs(shelf.cost(row), shelf.cost(other)).is_le());
                    }
                } else {
                    for other in reaching(goal.bound) {
                        prop_assert!(goal.measure.reaches(row.value, other.value));
                    }
                }
            }
            RowChoice::Unmet { .. } => prop_assert!(reaching(goal.bound).next().is_none()),
        }
    }

    #[test]
    fn the_order_of_rows_does_not_matter(rows in rows(), goal in goals(), most in value()) {
        let none = Aux::new();
        let turned: Vec<Row> = rows.iter().rev().cloned().collect();
        let one = view(&rows, &none).choose(&goal, affordable_within(most * 3.0)).clone();
        let other = view(&turned, &none);
        prop_assert_eq!(choice_outcome(&one), choice_outcome(&other.choose(&goal, affordable_within(most * 3.0))));
    }

    #[test]
    fn who_wishes_for_less_never_pays_more(rows in rows(), goal in goals(), less in value(), width in 1u32..6) {
        let aux = aux_of(&[("width", &width.to_string())]);
        let shelf = view(&rows, &aux);
        let relaxed = if goal.measure.reaches(less, goal.desire) {
return Ok(())
} else {
Goal {
                desire: less,
                bound: if goal.measure.reaches(goal.bound, less) { less } else { goal.bound },
                ..goal
            }
};
        if let RowChoice::Taken { row, .. } = shelf.choose(&goal, |_| true) {
            let RowChoice::Taken { row: other, .. } = shelf.choose(&relaxed, |_| true) else {
                panic!("it could be met before");
            };
            prop_assert!(super::compare_costs(shelf.cost(other), shelf.cost(row)).is_le());
        }
    }

    #[test]
    fn who_does_not_say_pays_for_the_dearest_that_rows_know(rows in rows(), goal in goals()) {
        let nothing = Aux::new();
        let RowChoice::Taken { row, .. } = view(&rows, &nothing).choose(&goal, |_| true) else {
            return Ok(());
        };
        for width in rows.iter().filter(|row| row.measure == goal.measure).filter_map(|row| row.aux.get("width")) {
            let aux = aux_of(&[("width", width)]);
            let shelf = view(&rows, &aux);
            let RowChoice::Taken { row: told, .. } = shelf.choose(&goal, |_| true) else {
                panic!("it could be met for all");
            };
            prop_assert!(compare_costs(shelf.cost(told), shelf.cost(row)).is_le());
        }
    }

    #[test]
    fn what_is_not_stated_is_looked_at_value_by_value(
        mut rows in rows(), models in proptest::collection::vec(proptest::option::of(0..3usize), 12),
        goal in goals(), most in value(),
    ) {
        for (row, model) in rows.iter_mut().zip(models) {
            row.aux.extend(model.map(|model| ("model".to_owned(), ["big", "7", "30"][model].to_owned())));
        }
        let nothing = Aux::new();
        let all = view(&rows, &nothing);
        let chosen = all.choose(&goal, affordable_within(most * 3.0));
        // Each combination named by a row, stated by a robot of its own; parameters that the row does not name have no
        // value.
        let of_measure = rows.iter().filter(|row| row.measure == goal.measure);
        let cases: BTreeSet<&Aux> = of_measure.map(|row| &row.aux).collect();
        let mut dearest: Option<Cost> = None;
        let mut unmet = false;
        for case in cases {
            let of_case: Vec<Row> = rows.iter().filter(|row| row_applies(row, |key| case.get(key))).cloned().collect();
            match view(&of_case, case).choose(&goal, affordable_within(most * 3.0)) {
                RowChoice::Taken { row, .. } => {
                    let cost = all.cost(row);
                    dearest = Some(dearest.map_or(cost, |dear| if compare_costs(cost,
                        dear).is_gt() { cost } else { dear }));
                }
                _ => unmet = true,
            }
        }
        match chosen {
            RowChoice::Silent => prop_assert!(dearest.is_none() && !unmet),
            RowChoice::Taken { row, .. } => prop_assert_eq!((Some(all.cost(row)), unmet), (dearest, false)),
            RowChoice::Unmet { .. } => prop_assert!(unmet),
        }
    }
}

#[test]
fn what_comes_next_holds_for_the_same_robot() {
    let of = |id, value, cpus, aux: &[(&str, &str)]| row(id, Measure::Rrt, value, cpus, aux);
    let rows = [
        of(1, 0.2, 0.5, &[("width", "640")]),
        of(2, 0.1, 1.0, &[("width", "1280")]),
        of(3, 0.05, 2.0, &[("width", "320")]),
        of(4, 0.04, 3.0, &[]),
        of(5, 0.02, 3.5, &[("model", "big")]),
    ];
    let next = |aux: &[(&str, &str)], taken: usize| {
        let aux = aux_of(aux);
        let (better, weaker) = view(&rows, &aux).neighbours(&rows[taken - 1]);
        (better.map(|row| row.id), weaker.map(|row| row.id))
    };
    assert_eq!(next(&[("width", "640")], 1), (Some(2), None), "wider will do");
    assert_eq!(next(&[("width", "640")], 2), (Some(4), Some(1)));
    assert_eq!(next(&[("width", "320")], 2), (Some(3), Some(1)));
    // The row's width was assumed.
    assert_eq!(next(&[], 2), (Some(4), None));
    assert_eq!(next(&[("model", "big")], 4), (Some(5), None));
}

/// The maximum number of rows and cases, each with a value of its own.
#[test]
fn as_many_rows_as_there_may_be_are_chosen_from() {
    let rows: Vec<Row> = (1..=MOST_ROWS as i64)
        .map(|id| {
            let (width, model) = (id.to_string(), (id % 7).to_string());
            let aux = [("width", &*width), ("model", &*model)];
            row(id, Measure::Rrt, 0.1, id as f64 / 1e4, &aux)
        })
        .collect();
    let nothing = Aux::new();
    let RowChoice::Taken { row, desired, .. } = view(&rows, &nothing).choose(&goal(0.01, 0.1), |_| true) else {
        panic!("it is acceptable");
    };
    assert_eq!((row.id, desired), (MOST_ROWS as i64, false));
}
