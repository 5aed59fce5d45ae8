use std::sync::Arc;

use access::Role;
use oidc::RoleGroup;
use store::State;

use super::*;
use crate::principals::SessionLifetimes;
use crate::tokens::Tokens;

const ISSUER: &str = "https://id.lab.example";

fn roles(viewers: &str, services: &str) -> Roles {
    Roles(vec![RoleGroup {
        name: viewers.into(),
        role: Role::Viewer,
        services: vec![services.parse().expect("a pattern")],
    }])
}

fn person(subject: &str, name: &str) -> Person {
    Person { subject: subject.into(), name: name.into(), groups: vec!["students".into(), "others".into()] }
}

struct World {
    _home: tempfile::TempDir,
    state: Arc<State>,
}

impl World {
    fn new() -> World {
        let home = tempfile::tempdir().expect("a directory");
        let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
        World { _home: home, state: Arc::new(state) }
    }

    /// Loads the principals as a daemon with this configuration does.
    fn start(&self, provider: Option<(&str, &Roles)>) -> Principals {
        Principals::new(Tokens::default(), Arc::clone(&self.state))
            .expect("readable")
            .with_session_lifetimes(SessionLifetimes::default())
            .with_provider(provider)
            .expect("readable")
    }
}

fn begin(principals: &Principals, roles: &Roles, person: &Person) -> StartedSession {
    let granted = roles.grant_for_groups(&person.groups).expect("a role");
    principals.begin_provider_session(ISSUER, person, &granted, "127.0.0.1:5000").expect("begun")
}

#[test]
fn people_of_a_provider_are_told_apart_by_its_word_for_them() {
    let (world, roles) = (World::new(), roles("students", "lab_*"));
    let principals = world.start(Some((ISSUER, &roles)));
    assert!(!principals.has_no_credentials(), "a provider names people");
    let alice = begin(&principals, &roles, &person("1", "alice"));
    let principal = &alice.identity.principal;
    assert_eq!((&*principal.name, principal.has_role(Role::Viewer)), ("oidc:alice", true));
    assert!(principal.scope.includes("lab_1") && !principal.scope.includes("other"));
    let other = begin(&principals, &roles, &person("2", "alice"));
    assert_eq!(other.identity.principal.name, "oidc:alice~2");
    // The first person keeps what is theirs.
    let renamed = begin(&principals, &roles, &person("2", "oidc:alice"));
    assert_eq!(renamed.identity.principal.name, "oidc:alice~2");
    let account = principals.check_account(&api::people::NewAccount {
        name: "oidc:alice".into(),
        password: String::new(),
        role: Role::Admin,
        services: Vec::new(),
    });
    account.expect_err("no account's name");
}

#[test]
fn at_a_start_sessions_end_that_would_be_others_today() {
    let world = World::new();
    let first = roles("students", "lab_*");
    let principals = world.start(Some((ISSUER, &first)));
    let begun = begin(&principals, &first, &person("1", "alice"));
    let good = |principals: &Principals| {
        principals.with_recogniser(|known| known.recognise_session(&begun.secret, store::now())).is_ok()
    };
    assert!(good(&world.start(Some((ISSUER, &first)))), "as before");
    for (what, other) in [("another group", roles("staff", "lab_*")), ("another scope", roles("students", "*"))] {
        let world = World::new();
        let principals = world.start(Some((ISSUER, &first)));
        begin(&principals, &first, &person("1", "alice"));
        assert!(world.start(Some((ISSUER, &other))).sessions().is_empty(), "{what}");
    }
    let world_of_another = World::new();
    let principals = world_of_another.start(Some((ISSUER, &first)));
    begin(&principals, &first, &person("1", "alice"));
    let elsewhere = world_of_another.start(Some(("https://other.example", &first)));
    assert!(elsewhere.sessions().is_empty(), "another provider");
    let without = world.start(None);
    assert!(!good(&without));
    assert!(!without.has_no_credentials(), "the door does not open again");
}

#[test]
fn sessions_of_accounts_are_not_a_providers() {
    let world = World::new();
    let principals = world.start(None);
    let new = api::people::NewAccount {
        name: "bob".into(),
        password: String::new(),
        role: Role::Operator,
        services: Vec::new(),
    };
    principals.create_account(&new, "hash").expect("made");
    let candidate = principals.candidate("bob").expect("an account");
    let begun = principals.begin_session(&candidate, "127.0.0.1:1").expect("written");
    assert!(begun.is_some());
    assert_eq!(world.start(None).sessions().len(), 1);
}
