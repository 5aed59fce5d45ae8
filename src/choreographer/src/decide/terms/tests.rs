use api::{Measure, Size};

use super::*;

fn statement(query: &[(&str, &str)]) -> BTreeMap<String, Stated> {
    let stated = Stated::read(query.iter().copied()).expect("valid");
    BTreeMap::from([(String::new(), stated)])
}

fn classes() -> BTreeMap<String, ClassOptions> {
    let caps = |cpus, memory: &str| Caps { cpus: Some(cpus), memory: memory.parse().ok() };
    let default = ClassOptions { caps: caps(1.0, "512M"), ..ClassOptions::default() };
    let urgent = ClassOptions {
        priority: 10,
        caps: caps(4.0, "2G"),
        limits: Limits { cpu_weight: Some(500), cpus: Some(0.5), ..Limits::default() },
        ..ClassOptions::default()
    };
    BTreeMap::from([("default".to_owned(), default), ("urgent".to_owned(), urgent)])
}

fn offer(classes: &BTreeMap<String, ClassOptions>) -> Offer<'_> {
    Offer {
        service: "detect",
        limits: Limits { cpus: Some(2.0), ..Limits::default() },
        is_deployers: false,
        caps: Caps { cpus: Some(3.0), memory: None },
        classes,
        rows: &[],
        measured: &NOTHING,
        reserve: (0.01, 64 << 20),
        capacity: Amount { millicpus: 8000, memory: 16 << 30 },
    }
}

static NOTHING: Aux = Aux::new();

fn row(id: i64, measure: Measure, value: f64, cpus: f64, mib: Option<u64>) -> Row {
    Row {
        id,
        measure,
        value,
        aux: Aux::new(),
        limits: Limits { cpus: Some(cpus), memory: mib.map(|mib| Size(mib << 20)), ..Limits::default() },
        spread: None,
        revision: None,
        written: 0,
    }
}

fn rows() -> [Row; 4] {
    [
        row(1, Measure::Rrt, 0.05, 2.5, Some(1024)),
        row(2, Measure::Rrt, 0.1, 1.0, Some(512)),
        row(3, Measure::Rrt, 0.2, 0.5, None),
        row(4, Measure::Fps, 10.0, 0.75, Some(768)),
    ]
}

#[test]
fn what_is_stated_comes_before_the_push_and_the_push_before_the_class() {
    let (some, none) = (classes(), BTreeMap::new());
    for (query, classes, cpus, weight, class, priority) in [
        (&[][..], &none, 2.0, None, None, 0),
        (&[], &some, 2.0, None, Some("default"), 0),
        (&[("cpus", "0.5")], &some, 0.5, None, Some("default"), 0),
        (&[("cpus", "3")], &none, 3.0, None, None, 0),
        (&[("class", "urgent")], &some, 2.0, Some(500), Some("urgent"), 10),
        (&[("class", "urgent"), ("cpus", "2.5")], &some, 2.5, Some(500), Some("urgent"), 10),
    ] {
        let terms = compute_terms(&statement(query), &offer(classes)).expect("tenable");
        let limits = terms.limits;
        assert_eq!((limits.cpus, limits.cpu_weight), (Some(cpus), weight), "{query:?}");
        assert_eq!((terms.class.as_deref(), terms.priority), (class, priority));
    }
}

#[test]
fn more_than_a_cap_is_refused_with_its_name() {
    let classes = classes();
    for (query, words) in [
        (
            &[("cpus", "1.5")][..],
            "cpus = 1.5 is more than this robot may request: 1, the max_cpus of class default ([class.default] of the \
                configuration)",
        ),
        (
            &[("memory", "1G")],
            "memory = 1G is more than this robot may request: 512M, the max_memory of class default ([class.default] \
                of the configuration)",
        ),
        (
            &[("class", "urgent"), ("cpus", "3.5")],
            "cpus = 3.5 is more than this robot may request: 3, the --max-cpus with which detect was pushed",
        ),
        (
            &[("class", "urgent"), ("memory", "3G")],
            "memory = 3G is more than this robot may request: 2G, the max_memory of class urgent ([class.urgent] of \
                the configuration)",
        ),
        (&[("class", "nope")], "class = \"nope\" is not one of the configuration's classes"),
    ] {
        let refused = compute_terms(&statement(query), &offer(&classes)).expect_err(words);
        assert_eq!(refused.to_string(), words);
    }
    // The deployer's own limits exceed the default class's cap, and stay.
    let own = compute_terms(&statement(&[]), &offer(&classes)).expect("tenable");
    assert_eq!(own.limits.cpus, Some(2.0));
}

#[test]
fn the_clients_of_one_robot_get_what_the_strictest_needs() {
    let classes = classes();
    let one = |query: &[(&str, &str)]| Stated::read(query.iter().copied()).expect("valid");
    let stated = BTreeMap::from([
        ("/detector".to_owned(), one(&[("cpus", "1"), ("class", "default")])),
        ("/tracker".to_owned(), one(&[("cpus", "2"), ("memory", "1G"), ("class", "urgent")])),
    ]);
    let terms = compute_terms(&stated, &offer(&classes)).expect("tenable");
    let limits = terms.limits;
    assert_eq!((limits.cpus, limits.memory), (Some(2.0), Some(Size(1 << 30))));
    assert_eq!((terms.class.as_deref(), terms.priority), (Some("urgent"), 10));
    assert_eq!(terms.describe_stated(), "/detector: class=default cpus=1; /tracker: class=urgent cpus=2 memory=1G");
}

#[test]
fn an_sla_is_given_what_its_row_says() {
    let (rows, mut classes) = (rows(), classes());
    let memory = |mib: u64| Some(Size(mib << 20));
    let rows = &rows;
    fn offer_with_rows<'a>(rows: &'a [Row], classes: &'a BTreeMap<String, ClassOptions>) -> Offer<'a> {
        Offer { rows, ..offer(classes) }
    }
    for (query, cpus, mib, taken) in [
        (&[("rrt", "100ms")][..], 1.0, memory(512), &[2][..]),
        (&[("rrt", "50ms"), ("max_rrt", "150ms")], 1.0, memory(512), &[2]),
        (&[("rrt", "50ms"), ("max_rrt", "150ms"), ("class", "urgent")], 2.5, memory(1024), &[1]),
        // Neither the row nor the push names memory.
        (&[("rrt", "250ms")], 0.5, None, &[3]),
        // Enough for both.
        (&[("rrt", "100ms"), ("fps", "5"), ("class", "urgent")], 1.0, memory(768), &[2, 4]),
        // No row for it: the push's own limits.
        (&[("age", "1s")], 2.0, None, &[]),
        // Explicit resources take precedence.
        (&[("rrt", "100ms"), ("cpus", "0.25")], 0.25, memory(512), &[2]),
        (&[("rrt", "1ms"), ("cpus", "0.25")], 0.25, memory(512), &[2]),
    ] {
        let terms = compute_terms(&statement(query), &offer_with_rows(rows, &classes)).expect("tenable");
        let ids: Vec<i64> = terms.rows.iter().map(|row| row.id).collect();
        assert_eq!(
            (terms.limits.cpus, terms.limits.memory, &*ids),
            (Some(cpus), mib, taken),
            "{query:?} {:?}",
            terms.why
        );
    }
    // The class's SLA applies to robots that state nothing, and is no reason to refuse them.
    let default = classes.get_mut("default").expect("it is there");
    default.sla.rrt = api::Span::from_millis(60);
    let told = compute_terms(&statement(&[]), &offer_with_rows(rows, &classes)).expect("tenable");
    assert_eq!(told.rows[0].id, 2, "the best within the class's caps: {told:?}");
    let told = compute_terms(&statement(&[("cpus", "1")]), &offer_with_rows(rows, &classes)).expect("tenable");
    assert!(told.rows.is_empty(), "it states resources: {told:?}");
}

#[test]
fn an_sla_that_cannot_be_kept_is_refused_with_what_can() {
    let (rows, classes) = (rows(), classes());
    let offer = Offer { rows: &rows, ..offer(&classes) };
    for (query, words) in [
        (
            &[("rrt", "50ms")][..],
            "rrt 50ms needs entry 1 (rrt 50ms: cpus 2.5, memory 1G), which is more cpus than this robot may have: 1, \
                the max_cpus of class default ([class.default] of the configuration)",
        ),
        (
            &[("rrt", "10ms"), ("max_rrt", "20ms"), ("class", "urgent")],
            "detect does not reach rrt 20ms: the best permitted is entry 1 (rrt 50ms: cpus 2.5, memory 1G)",
        ),
    ] {
        let refused = compute_terms(&statement(query), &offer).expect_err(words);
        assert_eq!(refused.to_string(), words);
    }
    let fits = |query: &[(&str, &str)]| match compute_terms(&statement(query), &offer) {
        Err(TermsError::Beyond { fits, .. } | TermsError::Unmet { fits, .. }) => fits,
        other => panic!("{other:?}"),
    };
    assert_eq!(fits(&[("rrt", "50ms")]).as_deref(), Some("rrt=100ms"));
    assert_eq!(fits(&[("rrt", "1ms"), ("class", "urgent")]).as_deref(), Some("rrt=50ms"));
    // The suggested goal is accepted.
    compute_terms(&statement(&[("rrt", "100ms")]), &offer).expect("it was said so");
    // Nothing was measured for such pictures.
    let mut narrow = rows.clone();
    for row in &mut narrow {
        row.aux.insert("width".into(), "640".into());
    }
    let offer = Offer { rows: &narrow, ..offer };
    let refused = compute_terms(&statement(&[("rrt", "100ms"), ("aux.width", "1920")]), &offer);
    assert_eq!(
        refused.expect_err("too wide").to_string(),
        "detect does not reach rrt 100ms with aux.width=1920: its SLA table has no entry for it"
    );
    // Measured parameters count if the robot states none.
    let measured = Aux::from([("width".to_owned(), "320".to_owned())]);
    let offer = Offer { measured: &measured, ..offer };
    let told = compute_terms(&statement(&[("rrt", "100ms")]), &offer).expect("narrow enough");
    assert_eq!(told.rows[0].id, 2);
    // A machine that is too small for the row is a cap, too.
    let offer = Offer { capacity: Amount::new(0.75, 1 << 30), ..offer };
    let refused = compute_terms(&statement(&[("rrt", "100ms")]), &offer).expect_err("too big");
    assert!(
        refused.to_string().ends_with("more cpus than this robot may have: 0.75, this machine's capacity for servants"),
        "{refused}"
    );
}

#[test]
fn an_explanation_says_of_each_row_why() {
    let (rows, classes) = (rows(), classes());
    let offer = Offer { rows: &rows, ..offer(&classes) };
    let one = |query: &[(&str, &str)]| {
        let stated = Stated::read(query.iter().copied()).expect("valid");
        explain(&stated, &offer)
    };
    let explained = one(&[("rrt", "90ms"), ("max_rrt", "150ms")]);
    assert_eq!(explained.limits.and_then(|limits| limits.cpus), Some(1.0));
    let said: Vec<(i64, bool, &str)> =
        explained.goals[0].rows.iter().map(|one| (one.row.id, one.taken, one.why.as_str())).collect();
    assert_eq!(
        said,
        [
            (3, false, "does not reach 150ms"),
            (2, true, "taken"),
            (1, false, "needs more cpus than: 1, the max_cpus of class default ([class.default] of the configuration)"),
        ]
    );
    assert_eq!(
        explained.next,
        [
            "better: entry 1 (rrt 50ms: cpus 2.5, memory 1G), more cpus than: 1, the max_cpus of class default \
                ([class.default] of the configuration)",
            "cheaper: entry 3 (rrt 200ms: cpus 0.5)",
        ]
    );
    let refused = one(&[("rrt", "10ms")]);
    assert_eq!(refused.limits, None);
    assert!(refused.refused.is_some_and(|why| why.contains("rrt 10ms")));
    let unknown = one(&[("class", "nope")]);
    assert!(unknown.refused.is_some_and(|why| why.contains("nope")));
}

#[test]
fn what_a_deployer_asks_for_outweighs_no_promise_and_what_an_operator_says_may() {
    let (some, none) = (classes(), BTreeMap::new());
    let heavy = Limits { cpu_weight: Some(10_000), ..Limits::default() };
    let promised = Limits { cpus: Some(2.0), ..heavy };
    let mut by_row = row(1, Measure::Rrt, 0.05, 1.0, None);
    by_row.limits.cpu_weight = Some(10_000);
    let rows = [by_row];
    let rrt = &[("rrt", "50ms")][..];
    let (of_nobody, unweighed) = (&[][..], Limits::default());
    // (push, rows, classes, stated, a deployer's, an operator's)
    for (limits, rows, classes, query, deployers, operators) in [
        (heavy, of_nobody, &none, &[][..], 100, 10_000),
        (promised, of_nobody, &none, &[], 2000, 10_000),
        // By the cores that it gets in the end, not by those of the push.
        (promised, of_nobody, &none, &[("cpus", "0.5")], 500, 10_000),
        (unweighed, &rows, &none, rrt, 1000, 10_000),
        (heavy, of_nobody, &some, &[("class", "urgent")], 500, 10_000),
        // The class's own, which the operator set.
        (unweighed, of_nobody, &some, &[("class", "urgent")], 500, 500),
    ] {
        let weight = |is_deployers| {
            let offer = Offer { limits, rows, is_deployers, ..offer(classes) };
            let terms = compute_terms(&statement(query), &offer).expect("tenable");
            terms.limits.cpu_weight
        };
        let got = (weight(true), weight(false));
        assert_eq!(got, (Some(deployers), Some(operators)), "{query:?}");
    }
}
