use api::Level;
use api::dictionary::{NewRows, Row};
use package::inventory::Inventory;
use ros::flavour::Flavour;

use super::*;

fn revision(service: &str, image: &str) -> RevisionRecord {
    RevisionRecord {
        service: service.into(),
        number: 0,
        image: image.into(),
        published: now(),
        package: "opencv_apps".into(),
        owner: None,
        source: "--apt opencv_apps".into(),
        flavour: Default::default(),
        plan: Plan {
            nodes: vec![servant::spec::NodeSpec {
                name: "/people_detect".into(),
                argv: vec!["/usr/lib/opencv_apps/people_detect".into()],
                environment: Default::default(),
                directory: String::new(),
                respawn: false,
                respawn_delay: 0.0,
                required: false,
            }],
            ..Plan::default()
        },
        interface: Default::default(),
    }
}

fn state() -> (tempfile::TempDir, State) {
    let directory = tempfile::tempdir().expect("a directory");
    let state = State::open(&directory.path().join("cloudroid.db")).expect("a database");
    (directory, state)
}

#[test]
fn a_published_revision_is_read_back_after_a_restart() {
    let (directory, state) = state();
    assert_eq!(state.publish(&revision("opencv_apps", "sha256:1"), &Inventory::default()).expect("published"), 1);
    let mut second = revision("opencv_apps", "sha256:2");
    second.flavour.distribution = "melodic".into();
    let inventory = Inventory { prefixes: vec!["/usr".into()], ..Inventory::default() };
    assert_eq!(state.publish(&second, &inventory).expect("published"), 2);
    drop(state);
    let state = State::open(&directory.path().join("cloudroid.db")).expect("the same database");
    assert_eq!(state.service_names().expect("readable"), ["opencv_apps"]);
    assert_eq!(state.inventory("opencv_apps", 2).expect("readable"), Some(inventory));
    let current = state.current_revision("opencv_apps").expect("readable").expect("there");
    assert_eq!(*current, RevisionRecord { number: 2, ..second });
    let numbers: Vec<u64> = state.revisions("opencv_apps").expect("readable").iter().map(|r| r.number).collect();
    assert_eq!(numbers, [2, 1]);
}

#[test]
fn rolling_back_needs_a_revision_that_exists() {
    let (_directory, state) = state();
    state.publish(&revision("a", "sha256:1"), &Inventory::default()).expect("published");
    state.publish(&revision("a", "sha256:2"), &Inventory::default()).expect("published");
    assert!(state.set_current_revision("a", 1).expect("readable"));
    assert_eq!(state.current_revision("a").expect("readable").expect("there").image, "sha256:1");
    assert!(!state.set_current_revision("a", 7).expect("readable"));
    assert!(!state.set_current_revision("b", 1).expect("readable"));
    assert_eq!(
        state.publish(&revision("a", "sha256:3"), &Inventory::default()).expect("published"),
        3,
        "numbers go on"
    );
}

#[test]
fn a_removed_service_is_gone_and_its_numbers_are_not_given_again() {
    let (_directory, state) = state();
    state.publish(&revision("a", "sha256:1"), &Inventory::default()).expect("published");
    assert!(state.remove_service("a").expect("readable"));
    assert!(!state.remove_service("a").expect("readable"));
    assert!(state.current_revision("a").expect("readable").is_none());
    assert!(state.all_revisions().expect("readable").is_empty());
    assert_eq!(state.publish(&revision("a", "sha256:1"), &Inventory::default()).expect("published"), 2);
}

#[test]
fn a_robot_stays_with_whom_it_came_first() {
    let (_directory, state) = state();
    let (mine, theirs) = ("m".repeat(64), "t".repeat(64));
    let owner = |robot: &str, token: Option<&String>, claim| state.claim_robot(robot, token, claim).expect("readable");
    assert_eq!(owner("r1", Some(&mine), false), Some(mine.clone()));
    assert_eq!(owner("r1", Some(&theirs), true), Some(mine.clone()));
    assert_eq!(owner("r1", None, false), Some(mine));
    assert_eq!(owner("r2", None, false), None);
    assert_eq!(owner("r2", Some(&theirs), false), None, "who uses it without a token is not locked out");
    assert_eq!(owner("r2", Some(&theirs), true), Some(theirs.clone()));
    assert_eq!(state.release_robots(std::slice::from_ref(&theirs)).expect("readable"), 1);
    assert_eq!(owner("r1", Some(&theirs), false), Some(theirs));
}

#[test]
fn servants_are_remembered_until_they_end() {
    let (_directory, state) = state();
    let record = ServantRecord {
        id: "a-1".into(),
        service: "a".into(),
        revision: 1,
        robot: "r1".into(),
        anonymous: false,
        created: 5,
        limits: api::Limits::default(),
        terms: None,
    };
    state.add_servant(&record).expect("written");
    assert_eq!(state.servants().expect("readable"), std::slice::from_ref(&record));
    let terms = api::Terms {
        stated: [(String::new(), api::Stated::read([("rrt", "100ms"), ("class", "urgent")]).expect("valid"))].into(),
        class: Some("urgent".into()),
        priority: 3,
        ..api::Terms::default()
    };
    state.set_servant_terms("a-1", &terms).expect("written");
    let record = ServantRecord { terms: Some(terms), ..record };
    assert_eq!(state.servants().expect("readable"), std::slice::from_ref(&record));
    let other = ServantRecord { id: "a-2".into(), created: 6, ..record.clone() };
    state.add_servant(&other).expect("written");
    assert_eq!(state.servants().expect("readable"), [record, other]);
    state.remove_servant("a-2");
    state.remove_servant("a-1");
    assert!(state.servants().expect("readable").is_empty());
}

#[test]
fn rows_of_a_dictionary_are_kept_replaced_and_go_with_their_service() {
    let (_directory, state) = state();
    state.publish(&revision("a", "sha256:1"), &Default::default()).expect("published");
    let row = |text: &str| serde_json::from_str::<Row>(text).expect("a row");
    let new = |rows: Vec<Row>, replace| {
        let written = state.write_dictionary("a", 3, &NewRows { rows, replace });
        written.expect("written");
        let rows = state.dictionary("a").expect("readable").into_iter();
        rows.map(|row| (row.id, row.to_string(), row.limits.cpus, row.revision)).collect::<Vec<_>>()
    };
    let wide = row(
        r#"{"measure":"rrt","value":0.1,"aux":{"width":"640"},"limits":{"cpus":2},"spread":{"p50":0.05,"p95":0.1,"requests":9}}"#,
    );
    let fps = row(r#"{"measure":"fps","value":5,"limits":{"cpus":0.5,"memory":"1G"}}"#);
    assert_eq!(
        new(vec![wide.clone(), fps], false),
        [(1, "rrt 100ms with aux.width=640".into(), Some(2.0), Some(3)), (2, "fps 5".into(), Some(0.5), Some(3)),]
    );
    let kept = &state.dictionary("a").expect("readable")[0];
    assert_eq!(kept.spread, wide.spread);
    // An equal row replaces it.
    let cheaper = row(r#"{"measure":"rrt","value":0.1,"aux":{"width":"640"},"limits":{"cpus":1}}"#);
    let rows = new(vec![cheaper.clone()], false);
    assert_eq!((rows.len(), rows[0].0, rows[0].2), (2, 1, Some(1.0)));
    assert!(state.remove_from_dictionary("a", 2).expect("written"));
    assert!(!state.remove_from_dictionary("a", 2).expect("it is gone"));
    assert!(!state.remove_from_dictionary("b", 1).expect("another's"));
    let rows = new(vec![row(r#"{"measure":"age","value":1,"limits":{}}"#)], true);
    assert_eq!(rows[0].1, "age 1s");
    assert!(rows.len() == 1 && rows[0].0 > 2, "numbers are not given twice: {rows:?}");
    state.remove_service("a").expect("written");
    assert_eq!(state.dictionary("a").expect("readable"), []);
}

#[test]
fn the_newest_events_come_oldest_first() {
    let (_directory, state) = state();
    for number in 1..=5 {
        let about = NewEvent { service: Some("a"), ..NewEvent::default() };
        state.add_event(Level::Info, "test", &format!("number {number}"), &about);
    }
    let texts = |since, limit| -> Vec<String> {
        state.events(since, limit).expect("readable").into_iter().map(|event| event.message).collect()
    };
    assert_eq!(texts(0, 2), ["number 4", "number 5"]);
    assert_eq!(texts(4, 10), ["number 5"]);
}

#[test]
fn events_are_told_apart_by_kind_and_by_whom_they_are_about() {
    let (_directory, state) = state();
    for (number, (kind, service, servant, robot)) in [
        ("node-hung", Some("a"), Some("a-1"), Some("r1")),
        ("node-hung", Some("b"), Some("b-1"), Some("r1")),
        ("terms", Some("a"), Some("a-1"), Some("r1")),
        ("terms", Some("a"), Some("a-2"), Some("r2")),
        ("machine-stalled", None, None, None),
    ]
    .into_iter()
    .enumerate()
    {
        let about = NewEvent { service, servant, robot };
        state.add_event(Level::Info, kind, &number.to_string(), &about);
    }
    let numbers = |filter, limit| -> Vec<String> {
        let events = state.filtered_events(filter, 0, limit).expect("readable");
        events.into_iter().map(|event| event.message).collect()
    };
    let all = EventFilter::default();
    let of = |kind, service, servant, robot| EventFilter { kind, service, servant, robot, told: None };
    for (filter, expected) in [
        (all, &["0", "1", "2", "3", "4"][..]),
        (of(Some("node-hung"), None, None, None), &["0", "1"]),
        (of(None, Some("a"), None, None), &["0", "2", "3"]),
        (of(None, None, Some("a-1"), None), &["0", "2"]),
        (of(None, None, None, Some("r2")), &["3"]),
        (of(Some("terms"), Some("a"), None, Some("r1")), &["2"]),
        (of(Some("no-such-kind"), None, None, None), &[]),
    ] {
        assert_eq!(numbers(filter, 10), expected, "{filter:?}");
    }
    assert_eq!(numbers(of(None, Some("a"), None, None), 2), ["2", "3"]);
}

#[test]
fn revisions_of_an_earlier_version_are_kept_and_completed() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("cloudroid.db");
    let earlier = Connection::open(&path).expect("a database");
    earlier.execute_batch(MIGRATIONS[0]).expect("made");
    earlier.execute_batch(MIGRATIONS[1]).expect("migrated");
    earlier
        .execute_batch(
            "PRAGMA user_version = 2; PRAGMA foreign_keys = OFF;
             INSERT INTO services VALUES ('a', 'p', 2);
             INSERT INTO revisions VALUES ('a', 1, 'sha256:1', 5, 'x', '{\"nodes\":[]}', '{}');
             INSERT INTO revisions VALUES ('a', 2, 'sha256:2', 6, 'y', '{\"nodes\":[]}', '{}');",
        )
        .expect("written");
    drop(earlier);
    let state = State::open(&path).expect("migrated");
    let current = state.current_revision("a").expect("readable").expect("there");
    assert_eq!((current.number, &*current.source), (2, "y"));
    assert_eq!(current.flavour, Flavour::default());
    assert_eq!(state.inventory("a", 2).expect("readable"), None);
    let incomplete = state.revisions_without_inventory().expect("readable");
    assert_eq!(incomplete.iter().map(|line| line.number).collect::<Vec<_>>(), [2], "the current one");
    let inventory = Inventory { prefixes: vec!["/usr".into()], ..Inventory::default() };
    let flavour = Flavour { base: "lab".into(), ..Flavour::default() };
    state.record_inventory("a", 2, &flavour, &inventory).expect("written");
    assert!(state.revisions_without_inventory().expect("readable").is_empty());
    assert_eq!(state.inventory("a", 2).expect("readable"), Some(inventory));
    let current = state.current_revision("a").expect("readable").expect("there");
    assert_eq!(current.flavour, flavour);
    assert_eq!(state.inventory("a", 1).expect("readable"), None, "another's");
}

#[test]
fn a_later_versions_database_is_left_alone() {
    let (directory, state) = state();
    drop(state);
    let path = directory.path().join("cloudroid.db");
    Connection::open(&path).expect("a database").pragma_update(None, "user_version", 99).expect("written");
    let refused = State::open(&path).err().expect("too new").to_string();
    assert!(refused.contains("version 99"), "{refused}");
}

#[tokio::test]
async fn what_is_told_while_another_has_the_database_is_kept_and_written_later() {
    let (directory, state) = state();
    let state = std::sync::Arc::new(state);
    let tell = |message: &str| {
        state.add_event(Level::Info, "test", message, &NewEvent::default());
    };
    tell("before");
    let path = directory.path().join("cloudroid.db");
    let other = Connection::open(&path).expect("a database");
    other.execute_batch("BEGIN EXCLUSIVE").expect("locked");
    tell("during");
    let messages = |state: &State| -> Vec<String> {
        let events = state.events(0, 100).expect("readable");
        events.into_iter().map(|event| event.message).collect()
    };
    assert_eq!(messages(&state), ["before", "during"], "told all the same");
    let watching = tokio::spawn(flush_pending_writes(std::sync::Arc::clone(&state)));
    while state.outage_message().is_none() {
        tokio::task::yield_now().await;
    }
    state.remove_servant("a-1");
    tell("later");
    other.execute_batch("COMMIT").expect("unlocked");
    while state.outage_message().is_some() {
        tokio::task::yield_now().await;
    }
    let told = messages(&state);
    watching.abort();
    let _ = watching.await;
    drop(state);
    let again = State::open(&path).expect("the same database");
    assert_eq!(messages(&again), told, "in the database now");
    let kinds: Vec<String> = again.events(0, 100).expect("readable").into_iter().map(|event| event.kind).collect();
    assert_eq!(kinds, ["test", "test", "state-unwritable", "test", "state-writable"]);
    assert!(told[2].contains("another program has locked it"), "{told:?}");
}

#[test]
fn a_known_robot_comes_in_while_nothing_can_be_written() {
    let (directory, state) = state();
    assert_eq!(state.find_robot_owner("r1").expect("readable"), None);
    state.claim_robot("r1", None, false).expect("written");
    let other = Connection::open(directory.path().join("cloudroid.db")).expect("a database");
    other.execute_batch("BEGIN EXCLUSIVE").expect("locked");
    assert_eq!(state.claim_robot("r1", None, false).expect("known"), None);
    let refused = state.claim_robot("r2", None, false).expect_err("new");
    assert!(refused.to_string().contains("locked"), "{refused}");
    assert!(state.outage_message().is_some());
}

#[test]
fn tokens_are_kept_by_their_hashes_and_a_name_is_one_live_tokens() {
    let (directory, state) = state();
    let new = |name, hash| NewToken { name, hash, role: "robot", scope: "{}", expires: Some(7) };
    let first = state.add_token(&new("r1", "h1")).expect("written").expect("new");
    assert_eq!((first.expires, first.revoked, first.last_used), (Some(7), None, None));
    assert_eq!(state.add_token(&new("r1", "h2")).expect("written"), None, "the name is taken");
    let rotated = state.rotate_token("r1", "h3").expect("written").expect("there");
    assert_eq!((rotated.id, &*rotated.hash), (first.id, "h3"));
    state.record_token_use(first.id, 9).expect("written");
    assert!(state.revoke_token("r1").expect("written").is_some());
    assert_eq!(state.revoke_token("r1").expect("written"), None, "once");
    assert_eq!(state.rotate_token("r1", "h4").expect("written"), None, "revoked for good");
    let second = state.add_token(&new("r1", "h5")).expect("written").expect("the name is free");
    assert_ne!(second.id, first.id);
    drop(state);
    let state = State::open(&directory.path().join("cloudroid.db")).expect("the same database");
    let kept = state.tokens().expect("readable");
    let hashes: Vec<_> = kept.iter().map(|token| (&*token.hash, token.last_used)).collect();
    assert_eq!(hashes, [("h3", Some(9)), ("h5", None)]);
    assert!(kept[0].revoked.is_some() && kept[1].revoked.is_none());
}

#[test]
fn a_new_database_grants_robots_and_deployers_what_they_had() {
    let (_directory, state) = state();
    let rules = state.rules().expect("readable");
    let texts: Vec<_> = rules.iter().map(|rule| (&*rule.who, &*rule.services, &*rule.allow)).collect();
    let all = r#"["*:**"]"#;
    assert_eq!(texts, [("role:robot", "*", all), ("role:deployer", "*", all)]);
    assert!(state.remove_rule(rules[0].id).expect("written").is_some());
    assert_eq!(state.remove_rule(rules[0].id).expect("written"), None);
    let added = state.add_rule("r1", "det*", "[]").expect("written");
    assert!(added.id > rules[1].id, "numbers are not given twice");
    assert_eq!(state.rules().expect("readable").len(), 2);
}

#[test]
fn a_service_is_owned_by_whoever_published_it_first() {
    let (_directory, state) = state();
    assert_eq!(state.service_owner("a").expect("readable"), None);
    let published = |service: &str, owner: Option<&str>| {
        let mut record = revision(service, "sha256:1");
        record.owner = owner.map(str::to_owned);
        let number = state.publish(&record, &Inventory::default());
        let revision = state.revision(service, number.expect("published"));
        let owner = revision.expect("readable").expect("there").owner.clone();
        assert_eq!(state.service_owner(service).expect("readable"), Some(owner.clone()));
        owner
    };
    let alice = Some("alice".to_owned());
    assert_eq!(published("a", Some("alice")), alice);
    assert_eq!(published("a", Some("bob")), alice);
    assert_eq!(published("b", None), None);
    assert_eq!(published("b", Some("bob")), None, "it is the operator's");
}

#[test]
fn a_robots_name_can_be_bound_again() {
    let (_directory, state) = state();
    let owner = |name: &str| name.to_owned();
    state.claim_robot("r1", Some(&owner("a")), true).expect("written");
    state.bind_robot("r1", &owner("robot:r1")).expect("written");
    let found = state.claim_robot("r1", Some(&owner("a")), true).expect("read");
    assert_eq!(found, Some(owner("robot:r1")));
}

#[test]
fn the_audit_log_is_only_added_to() {
    let (home, state) = state();
    let did = |object| NewAuditRecord {
        who: "alice (deployer)",
        peer: "10.0.0.3:5000",
        action: "deploy",
        did: "POST /api/v1/push",
        object,
        status: 200,
        more: 0,
    };
    for object in ["one", "two", "three"] {
        state.add_audit_record(&did(object)).expect("recorded");
    }
    let objects = |since, limit| -> Vec<String> {
        let records = state.audit_records(since, limit).expect("readable");
        records.into_iter().map(|record| record.object).collect()
    };
    assert_eq!(objects(0, 2), ["two", "three"]);
    assert_eq!(objects(2, 100), ["three"]);
    // Not even by a process that has the database open.
    let connection = Connection::open(home.path().join("cloudroid.db")).expect("opened");
    for statement in ["DELETE FROM audit", "UPDATE audit SET who = 'bob'", "DELETE FROM audit WHERE id = 1"] {
        let refused = connection.execute(statement, []).expect_err(statement).to_string();
        assert!(refused.contains("only added to"), "{refused}");
    }
    assert_eq!(objects(0, 100).len(), 3);
    // Beyond a million records the oldest may be deleted.
    connection.execute("UPDATE sqlite_sequence SET seq = 1000001 WHERE name = 'audit'", []).expect("set");
    assert_eq!(connection.execute("DELETE FROM audit WHERE id = 1", []).expect("old"), 1);
    connection.execute("DELETE FROM audit WHERE id = 2", []).expect_err("not old enough");
}
