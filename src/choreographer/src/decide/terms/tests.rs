use super::*;

fn stated(query: &[(&str, &str)]) -> BTreeMap<String, Stated> {
    let stated = Stated::read(query.iter().copied()).expect("valid");
    BTreeMap::from([(String::new(), stated)])
}

fn classes() -> BTreeMap<String, Class> {
    let caps = |cpus, memory: &str| Caps {
        cpus: Some(cpus),
        memory: memory.parse().ok(),
    };
    let default = Class {
        caps: caps(1.0, "512M"),
        ..Class::default()
    };
    let urgent = Class {
        priority: 10,
        caps: caps(4.0, "2G"),
        limits: Limits {
            cpu_weight: Some(500),
            cpus: Some(0.5),
            ..Limits::default()
        },
        ..Class::default()
    };
    BTreeMap::from([
        ("default".to_owned(), default),
        ("urgent".to_owned(), urgent),
    ])
}

fn offer(classes: &BTreeMap<String, Class>) -> Offer<'_> {
    Offer {
        service: "detect",
        limits: Limits {
            cpus: Some(2.0),
            ..Limits::default()
        },
        caps: Caps {
            cpus: Some(3.0),
            memory: None,
        },
        classes,
    }
}

#[test]
fn what_is_stated_comes_before_the_push_and_the_push_before_the_class() {
    let (some, none) = (classes(), BTreeMap::new());
    for (query, classes, cpus, weight, class, priority) in [
        (&[][..], &none, 2.0, None, None, 0),
        (&[], &some, 2.0, None, Some("default"), 0),
        (&[("cpus", "0.5")], &some, 0.5, None, Some("default"), 0),
        (&[("cpus", "3")], &none, 3.0, None, None, 0),
        (
            &[("class", "urgent")],
            &some,
            2.0,
            Some(500),
            Some("urgent"),
            10,
        ),
        (
            &[("class", "urgent"), ("cpus", "2.5")],
            &some,
            2.5,
            Some(500),
            Some("urgent"),
            10,
        ),
    ] {
        let terms = terms(&stated(query), &offer(classes)).expect("tenable");
        let limits = terms.limits;
        assert_eq!(
            (limits.cpus, limits.cpu_weight),
            (Some(cpus), weight),
            "{query:?}"
        );
        assert_eq!((terms.class.as_deref(), terms.priority), (class, priority));
    }
}

#[test]
fn more_than_a_cap_is_refused_with_its_name() {
    let classes = classes();
    for (query, words) in [
        (
            &[("cpus", "1.5")][..],
            "cpus = 1.5 is more than this robot may ask for: 1, the max_cpus of class default ([class.default] of the configuration)",
        ),
        (
            &[("memory", "1G")],
            "memory = 1G is more than this robot may ask for: 512M, the max_memory of class default ([class.default] of the configuration)",
        ),
        (
            &[("class", "urgent"), ("cpus", "3.5")],
            "cpus = 3.5 is more than this robot may ask for: 3, the --max-cpus with which detect was pushed",
        ),
        (
            &[("class", "urgent"), ("memory", "3G")],
            "memory = 3G is more than this robot may ask for: 2G, the max_memory of class urgent ([class.urgent] of the configuration)",
        ),
        (
            &[("class", "nope")],
            "class = \"nope\" is not one of the configuration's classes",
        ),
    ] {
        let refused = terms(&stated(query), &offer(&classes)).expect_err(words);
        assert_eq!(refused.to_string(), words);
    }
    // The deployer's own limits are above the default class's cap, and stay.
    let own = terms(&stated(&[]), &offer(&classes)).expect("tenable");
    assert_eq!(own.limits.cpus, Some(2.0));
}

#[test]
fn the_clients_of_one_robot_get_what_the_strictest_needs() {
    let classes = classes();
    let one = |query: &[(&str, &str)]| Stated::read(query.iter().copied()).expect("valid");
    let stated = BTreeMap::from([
        (
            "/detector".to_owned(),
            one(&[("cpus", "1"), ("class", "default")]),
        ),
        (
            "/tracker".to_owned(),
            one(&[("cpus", "2"), ("memory", "1G"), ("class", "urgent")]),
        ),
    ]);
    let terms = terms(&stated, &offer(&classes)).expect("tenable");
    let limits = terms.limits;
    assert_eq!(
        (limits.cpus, limits.memory),
        (Some(2.0), Some(Size(1 << 30)))
    );
    assert_eq!(
        (terms.class.as_deref(), terms.priority),
        (Some("urgent"), 10)
    );
    assert_eq!(
        terms.stated_in_words(),
        "/detector: class=default cpus=1; /tracker: class=urgent cpus=2 memory=1G"
    );
}
