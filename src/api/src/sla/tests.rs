use proptest::prelude::*;

use super::*;

fn read(query: &[(&str, &str)]) -> Result<Stated, Unstatable> {
    Stated::read(query.iter().copied())
}

#[test]
fn all_that_can_be_stated_is_read() {
    let stated = read(&[
        ("robot", "rover1"),
        ("rrt", "100ms"),
        ("max_rrt", "0.3"),
        ("fps", "10"),
        ("min_fps", "5"),
        ("age", "500ms"),
        ("max_age", "2s"),
        ("class", "interactive"),
        ("cpus", "1.5"),
        ("memory", "1G"),
        ("aux.width", "640"),
        ("token", "secret"),
    ])
    .expect("valid");
    assert_eq!(stated.sla.rrt, Span::from_millis(100));
    assert_eq!(stated.sla.max_rrt, Span::from_millis(300));
    assert_eq!((stated.sla.fps, stated.sla.min_fps), (Some(10.0), Some(5.0)));
    assert_eq!(stated.class.as_deref(), Some("interactive"));
    assert_eq!((stated.cpus, stated.memory), (Some(1.5), Some(Size(1 << 30))));
    assert_eq!(stated.aux["width"], "640");
    assert_eq!(
        stated.to_string(),
        "rrt=100ms max_rrt=300ms fps=10 min_fps=5 age=500ms max_age=2s class=interactive cpus=1.5 \
         memory=1G aux.width=640"
    );
    let none = read(&[("robot", "rover1"), ("v", "1")]).expect("nothing is stated");
    assert!(none.is_empty());
    assert_eq!(none.to_string(), "nothing");
}

#[test]
fn what_cannot_be_stated_is_named_with_the_reason_and_what_to_write() {
    for (key, value, words) in [
        ("rrt", "soon", &["rrt = \"soon\" is not a time", "300ms"][..]),
        ("rrt", "", &["rrt = \"\" is not a time"]),
        ("max_rrt", "-1", &["max_rrt = \"-1\""]),
        ("max_rrt", "5 min", &["max_rrt", "seconds"]),
        ("fps", "0", &["fps = \"0\" is not a rate", "greater than 0"]),
        ("min_fps", "nan", &["min_fps = \"nan\""]),
        ("age", "1e9", &["age", "a day"]),
        ("class", "", &["class = \"\" is not a name"]),
        ("class", "a b", &["class = \"a b\"", "letters"]),
        ("cpus", "many", &["cpus = \"many\"", "such as 1.5"]),
        ("cpus", "0", &["cpus = \"0\"", "between 0.01 and 4096"]),
        ("cpus", "inf", &["cpus = \"inf\""]),
        ("memory", "lots", &["memory = \"lots\" is not a size", "512M"]),
        ("memory", "1K", &["memory = 1K is too little", "4M"]),
        ("aux.", "1", &["aux.", "write aux.KEY=VALUE"]),
        ("aux.a b", "1", &["aux.a b is not an auxiliary parameter"]),
        ("aux.width", "", &["aux.width has no value", "aux.width=640"]),
        ("aux.width", "\u{7}", &["aux.width has no value"]),
        // Misspelled keys.
        ("max-rrt", "1", &["max-rrt is not a key; write max_rrt"]),
        ("RRT", "1", &["RRT is not a key; write rrt"]),
        ("desire", "1", &["desire is not a key; write rrt"]),
        ("max", "1", &["max is not a key; write max_rrt"]),
        ("rtt", "1", &["rtt is not a key; write rrt"]),
        ("frames_per_second", "1", &["write fps"]),
        ("cpu", "1", &["write cpus"]),
    ] {
        let refused = read(&[(key, value)]).expect_err(key).to_string();
        for words in words {
            assert!(refused.contains(words), "{key}={value}: {refused}");
        }
    }
    for (query, words) in [
        ([("rrt", "300ms"), ("max_rrt", "100ms")], "rrt (300ms) is greater than max_rrt (100ms); lower it"),
        ([("fps", "5"), ("min_fps", "10")], "fps (5) is less than min_fps (10); raise it"),
        ([("max_age", "1"), ("age", "2")], "age (2s) is greater than max_age (1s); lower it"),
        ([("rrt", "1"), ("rrt", "1")], "rrt is given twice"),
        ([("aux.a", "1"), ("aux.a", "2")], "aux.a is given twice"),
    ] {
        let refused = read(&query).expect_err(words).to_string();
        assert!(refused.contains(words), "{refused}");
    }
    let many: Vec<(String, &str)> = (0..17).map(|n| (format!("aux.k{n}"), "1")).collect();
    let refused = Stated::read(many).expect_err("too many").to_string();
    assert!(refused.contains("at most 16"), "{refused}");
}

#[test]
fn every_key_is_read_and_documented() {
    let document = include_str!("../../../../docs/robots.md");
    for key in &KEYS {
        assert!(document.contains(&format!("`{}`", key.name)), "{}", key.name);
        let refused = read(&[(key.name, "")]).expect_err(key.name);
        assert_eq!(refused.key, key.name);
    }
    for measure in Measure::ALL {
        let pair = KEYS.iter().filter(|key| key.name.ends_with(measure.name()));
        assert_eq!(pair.count(), 2, "{measure:?}");
    }
}

#[test]
fn a_goal_has_a_desire_and_a_bound() {
    let goals = |query: &[(&str, &str)]| read(query).expect("valid").sla.goals();
    let goal = |measure, desire, bound| Goal { measure, desire, bound };
    assert_eq!(goals(&[]), []);
    assert_eq!(goals(&[("rrt", "0.1"), ("max_rrt", "0.3")]), [goal(Measure::Rrt, 0.1, 0.3)]);
    assert_eq!(
        goals(&[("max_rrt", "0.3"), ("fps", "4")]),
        [goal(Measure::Rrt, 0.3, 0.3), goal(Measure::Fps, 4.0, 4.0)]
    );
    assert_eq!(goals(&[("age", "2")]), [goal(Measure::Age, 2.0, 2.0)]);
}

#[test]
fn several_of_one_robot_get_what_the_strictest_needs() {
    let read = |query: &[(&str, &str)]| read(query).expect("valid");
    let one = read(&[
        ("rrt", "200ms"),
        ("max_rrt", "400ms"),
        ("cpus", "1"),
        ("class", "slow"),
        ("aux.width", "640"),
        ("aux.model", "a"),
    ]);
    let other = read(&[
        ("max_rrt", "100ms"),
        ("fps", "5"),
        ("memory", "1G"),
        ("class", "fast"),
        ("aux.width", "1920"),
        ("aux.model", "b"),
    ]);
    let both = one.merge(other, |one, _| one == "fast");
    assert_eq!(
        both.to_string(),
        "rrt=100ms max_rrt=100ms fps=5 class=fast cpus=1 memory=1G aux.model=a aux.width=1920"
    );
    both.sla.check().expect("in order");
}

fn any_stated() -> impl Strategy<Value = Stated> {
    let span = || proptest::option::of((1u64..86_400_000_000_000).prop_map(|nanos| nanos as f64 / 1e9));
    // Exactly representable in binary: serde_json may parse other values with an error in the last digit.
    let eighths = |most: u32| (1..most).prop_map(|n| f64::from(n) / 8.0);
    let rate = || proptest::option::of(eighths(8_000_000));
    let aux = proptest::collection::btree_map("[a-zA-Z0-9_.-]{1,8}", "[!-~]{1,8}", 0..4);
    (
        (span(), span(), rate(), rate(), span(), span()),
        proptest::option::of("[a-zA-Z0-9_-]{1,8}"),
        proptest::option::of(eighths(32_000)),
        proptest::option::of((4u64 << 20)..(1 << 50)),
        aux,
    )
        .prop_map(|((rrt, max_rrt, fps, min_fps, age, max_age), class, cpus, memory, aux)| {
            let span = |seconds: Option<f64>| seconds.and_then(Span::from_seconds);
            // A desired value is at least as strict as its bound.
            let within = |desire: Option<f64>, bound: Option<f64>| {
                desire.map(|desire| bound.map_or(desire, |bound| bound.min(desire)))
            };
            let sla = Sla {
                rrt: span(within(rrt, max_rrt)),
                max_rrt: span(max_rrt),
                fps: fps.map(|fps| min_fps.map_or(fps, |min| fps.max(min))),
                min_fps,
                age: span(within(age, max_age)),
                max_age: span(max_age),
            };
            Stated { sla, class, cpus, memory: memory.map(Size), aux }
        })
}

proptest! {
    #[test]
    fn what_is_printed_is_read_again(stated in any_stated()) {
        prop_assert_eq!(Stated::read(stated.to_pairs()), Ok(stated.clone()));
        let json = serde_json::to_string(&stated).unwrap();
        prop_assert_eq!(serde_json::from_str::<Stated>(&json).unwrap(), stated);
    }

    #[test]
    fn together_none_is_promised_less_than_alone(one in any_stated(), other in any_stated()) {
        let both = one.clone().merge(other.clone(), |_, _| false);
        prop_assert_eq!(both.sla.check(), Ok(()));
        for goal in one.sla.goals().into_iter().chain(other.sla.goals()) {
            let goals = both.sla.goals();
            let kept = goals.iter().find(|kept| kept.measure == goal.measure).unwrap();
            prop_assert!(goal.measure.reaches(kept.desire, goal.desire));
            prop_assert!(goal.measure.reaches(kept.bound, goal.bound));
        }
        prop_assert!(both.cpus >= one.cpus && both.cpus >= other.cpus);
        prop_assert!(both.memory >= one.memory.max(other.memory));
    }
}
