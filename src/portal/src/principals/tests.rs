use access::{ConnectionAccess, Grant, Operation, Principal, Role};
use api::access::{NewRule, NewToken};

use super::changing::SECRET;
use super::*;
use crate::tokens;

struct World {
    _home: tempfile::TempDir,
    principals: Principals,
}

fn world(configured: &[&str]) -> World {
    let home = tempfile::tempdir().expect("a directory");
    let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
    let configured: Vec<String> = configured.iter().map(|text| (*text).to_owned()).collect();
    let configured = Tokens::new(&configured).expect("tokens");
    let principals = Principals::new(configured, Arc::new(state)).expect("readable");
    World { _home: home, principals }
}

fn recognise(principals: &Principals, token: &str) -> Result<CallerIdentity, AuthenticationError> {
    let here = IpAddr::from([127, 0, 0, 1]);
    principals.with_recogniser(|known| known.recognise(token, here, store::now()))
}

fn robot(name: &str) -> NewToken {
    NewToken {
        name: name.into(),
        role: Role::Robot,
        services: vec!["det*".parse().expect("a pattern")],
        robot: Some("r1".into()),
        classes: Vec::new(),
        lifetime: None,
    }
}

fn permits(standing: &ConnectionAccess, operation: Operation, name: &str) -> bool {
    match standing {
        ConnectionAccess::Granted(grants) => grants.permits(operation, name),
        ConnectionAccess::Ended(_) => false,
    }
}

#[test]
fn a_token_is_good_until_it_is_revoked_or_rotated() {
    let World { principals, _home } = world(&[]);
    assert!(principals.has_no_credentials());
    let made = principals.create_token(&robot("rover")).expect("made");
    assert!(!principals.has_no_credentials());
    assert_eq!(made.secret.len(), SECRET);
    let listed = serde_json::to_string(&principals.tokens()).expect("JSON");
    assert!(!listed.contains(&made.secret) && !listed.contains(&tokens::hash(&made.secret)));
    let who = recognise(&principals, &made.secret).expect("known");
    assert_eq!((&*who.principal.name, who.owner.as_deref()), ("rover", Some("robot:r1")));
    principals.record_use(&who, store::now());
    assert!(principals.tokens()[0].last_used.is_some());
    let earlier = who.clone();
    let rotated = principals.rotate_token("rover").expect("there");
    assert_eq!(recognise(&principals, &made.secret), Err(AuthenticationError::Unknown));
    let ended = principals.connection_access(&who, "detector");
    assert_eq!(ended, ConnectionAccess::Ended("this token was replaced by a new one".into()));
    let who = recognise(&principals, &rotated.secret).expect("known");
    assert!(permits(&principals.connection_access(&who, "detector"), Operation::Publish, "/x"));
    // Its resume tokens remain its own.
    assert_eq!(who.resume_binding(), earlier.resume_binding());
    principals.revoke_token("rover").expect("there");
    assert_eq!(recognise(&principals, &rotated.secret), Err(AuthenticationError::Revoked));
    let ended = principals.connection_access(&who, "detector");
    assert_eq!(ended, ConnectionAccess::Ended("this token was revoked".into()));
    assert!(!principals.has_no_credentials(), "the door does not open again");
    let next = principals.create_token(&robot("rover")).expect("made").secret;
    let next = recognise(&principals, &next).expect("known");
    assert_ne!(next.resume_binding(), earlier.resume_binding(), "another's, of the same name");
    principals.revoke_token("rover").expect("there");
    let unknown = principals.revoke_token("rover").expect_err("once").problem();
    assert_eq!(unknown.status, 404);
}

#[test]
fn a_token_ends_at_its_time() {
    let World { principals, _home } = world(&[]);
    let secret = principals.create_token(&NewToken { lifetime: Some(60), ..robot("rover") }).expect("made").secret;
    let hash = tokens::hash(&secret);
    let end = principals.tokens()[0].expires.expect("an end");
    let stored = principals.stored.read();
    assert!(stored.recognise(&hash, end - 1).expect("good").is_some());
    assert_eq!(stored.recognise(&hash, end), Err(AuthenticationError::Expired));
}

#[test]
fn tokens_of_the_configuration_are_admins() {
    let World { principals, _home } = world(&["open sesame"]);
    let who = recognise(&principals, "open sesame").expect("known");
    assert!(who.principal.has_role(Role::Admin));
    assert_eq!(who.owner, Some(tokens::hash("open sesame")));
    assert!(permits(&principals.connection_access(&who, "any"), Operation::Call, "/x"));
}

#[test]
fn who_guesses_is_slowed_and_who_has_a_token_of_the_database_is_not() {
    let World { principals, _home } = world(&["open sesame"]);
    let made = principals.create_token(&robot("rover")).expect("made").secret;
    let revoked = principals.create_token(&robot("over")).expect("made").secret;
    principals.revoke_token("over").expect("there");
    let (here, there) = (IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2]));
    let shows = |token: &str, from| principals.with_recogniser(|known| known.recognise(token, from, 5_000));
    // A revoked token does not count as a guess.
    for _ in 0..2 * access::guesses::FREE {
        assert_eq!(shows(&revoked, here), Err(AuthenticationError::Revoked));
    }
    for number in 0..access::guesses::FREE {
        assert_eq!(shows(&format!("guess {number}"), here), Err(AuthenticationError::Unknown));
    }
    for token in ["guess", "open sesame"] {
        assert_eq!(shows(token, here), Err(AuthenticationError::Slowed(1_000)), "{token}");
    }
    assert!(shows(&made, here).is_ok() && shows("open sesame", there).is_ok());
    assert_eq!(principals.token_counts(), (u64::from(access::guesses::FREE), 2));
    // rosbridge's auth messages count in the same way.
    let message =
        |mac: &str| -> AuthMessage { serde_json::from_value(serde_json::json!({"mac": mac})).expect("a message") };
    let far = IpAddr::from([10, 0, 0, 3]);
    for _ in 0..access::guesses::FREE {
        let refused = principals.recognise_auth(&message("guess"), far, 0.0).expect_err("a guess").to_string();
        assert!(refused.contains("neither contains a known token"), "{refused}");
    }
    let refused = principals.recognise_auth(&message("open sesame"), far, 0.0).expect_err("slowed").to_string();
    assert!(refused.contains("are not checked"), "{refused}");
    principals.recognise_auth(&message(&made), far, 0.0).expect("known");
}

#[test]
fn what_cannot_be_a_token_is_refused_with_words() {
    let World { principals, _home } = world(&[]);
    let table = [
        (NewToken { name: "a b".into(), ..robot("x") }, "is not a valid name"),
        (NewToken { name: "root".into(), ..robot("x") }, "is a reserved name"),
        (NewToken { services: Vec::new(), ..robot("x") }, "--service"),
        (NewToken { robot: None, ..robot("x") }, "--robot"),
        (NewToken { robot: Some("a/b".into()), ..robot("x") }, "robot"),
        (NewToken { role: Role::Viewer, ..robot("x") }, "--robot is only for"),
        (NewToken { role: Role::Admin, robot: None, ..robot("x") }, "all services"),
        (NewToken { lifetime: Some(0), ..robot("x") }, "expires at once"),
        (NewToken { lifetime: Some(u64::MAX), ..robot("x") }, "too long"),
    ];
    for (new, words) in table {
        let refused = principals.create_token(&new).expect_err(words).problem();
        assert!(refused.status == 400 && refused.detail.contains(words), "{words}: {refused:?}");
    }
    assert!(principals.has_no_credentials(), "none of them was made");
    principals.create_token(&robot("x")).expect("made");
    assert_eq!(principals.create_token(&robot("x")).expect_err("taken").problem().status, 409);
}

#[tokio::test]
async fn whoever_follows_hears_of_changes_of_the_policy_and_of_the_end() {
    let World { principals, _home } = world(&[]);
    let secret = principals.create_token(&robot("rover")).expect("made").secret;
    let who = recognise(&principals, &secret).expect("known");
    let (sender, mut standing) = watch::channel(principals.connection_access(&who, "detector"));
    let change = async {
        let grant: Grant = "subscribe:/camera/**".parse().expect("a grant");
        let rule = NewRule {
            who: "rover".parse().expect("a name"),
            services: "*".parse().expect("a pattern"),
            allow: vec![grant],
        };
        principals.add_rule(&rule).expect("written");
        standing.changed().await.expect("followed");
        let now = standing.borrow_and_update().clone();
        assert!(permits(&now, Operation::Subscribe, "/camera/x") && !permits(&now, Operation::Publish, "/x"));
        let whole = principals.wait_for_end(&who, "detector", true).await;
        assert!(whole.contains("needs all of detector"), "{whole}");
        principals.revoke_token("rover").expect("there");
        standing.changed().await.expect("followed");
        let ended = standing.borrow_and_update().clone();
        assert_eq!(ended, ConnectionAccess::Ended("this token was revoked".into()));
    };
    tokio::select! {
        () = principals.follow_access(&who, "detector", &sender) => {}
        () = change => {}
    }
}

#[test]
fn this_machines_users_need_a_token_once_there_is_one() {
    let World { principals, _home } = world(&[]);
    let local = CallerIdentity {
        principal: Arc::new(Principal::local()),
        shown: Credential::Nothing,
        token: None,
        owner: None,
    };
    assert!(permits(&principals.connection_access(&local, "any"), Operation::Publish, "/x"));
    principals.create_token(&robot("rover")).expect("made");
    assert!(matches!(principals.connection_access(&local, "any"), ConnectionAccess::Ended(_)));
}
