use std::sync::Arc;

use access::ConnectionAccess;
use api::access::NewToken;
use store::State;
use tokio::sync::watch;

use super::*;
use crate::principals::SessionLifetimes;
use crate::principals::refusals::AuthenticationError;
use crate::tokens::Tokens;

struct World {
    _home: tempfile::TempDir,
    state: Arc<State>,
    principals: Principals,
}

fn world() -> World {
    let home = tempfile::tempdir().expect("a directory");
    let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
    let state = Arc::new(state);
    let principals = Principals::new(Tokens::default(), Arc::clone(&state)).expect("readable");
    World { _home: home, state, principals }
}

fn alice() -> NewAccount {
    NewAccount {
        name: "alice".into(),
        password: String::new(),
        role: Role::Deployer,
        services: vec!["lab_*".parse().expect("a pattern")],
    }
}

impl World {
    /// Creates the account `alice`, whose password hash is `hash`.
    fn with_alice(self) -> World {
        self.principals.create_account(&alice(), "hash").expect("made");
        self
    }

    fn begin(&self) -> StartedSession {
        let candidate = self.principals.candidate("alice").expect("an account");
        let begun = self.principals.begin_session(&candidate, "127.0.0.1:5000");
        expect_begun(begun)
    }

    fn recognise(&self, secret: &str, now: Millis) -> Result<CallerIdentity, AuthenticationError> {
        self.principals.with_recogniser(|known| known.recognise_session(secret, now))
    }
}

fn expect_begun(begun: Result<Option<StartedSession>, Error>) -> StartedSession {
    begun.expect("written").expect("an account as it was")
}

#[test]
fn a_session_ends_at_its_end_and_when_it_is_not_used() {
    let world = world().with_alice();
    assert!(!world.principals.has_no_credentials());
    let begun = world.begin();
    let who = world.recognise(&begun.secret, store::now()).expect("good");
    assert_eq!((&*who.principal.name, &*who.principal.roles), ("alice", &[Role::Deployer][..]));
    assert_eq!(who.owner.as_deref(), Some("person:alice"));
    assert!(who.principal.scope.includes("lab_1") && !who.principal.scope.includes("other"));
    let idle = milliseconds(SessionLifetimes::default().idle);
    let used = world.principals.sessions()[0].last_used;
    let over = Err(AuthenticationError::SessionOver);
    world.recognise(&begun.secret, used + idle - 1).expect("just");
    assert_eq!(world.recognise(&begun.secret, used + idle), over);
    // Use extends the session, up to its end.
    world.principals.record_use(&who, used + idle - 1);
    world.recognise(&begun.secret, used + idle).expect("used meanwhile");
    world.principals.record_use(&who, begun.expires - 1);
    world.recognise(&begun.secret, begun.expires - 1).expect("the last moment");
    assert_eq!(world.recognise(&begun.secret, begun.expires), over);
    assert_eq!(world.recognise("another", store::now()), over);
    assert_eq!(world.recognise(&tokens::hash(&begun.secret), store::now()), over);
}

#[test]
fn uses_are_kept_when_something_else_changes() {
    let world = world().with_alice();
    let begun = world.begin();
    let later = store::now() + 30_000;
    world.principals.record_use(&begun.identity, later);
    world.begin();
    let sessions = world.principals.sessions();
    assert_eq!(sessions[0].last_used, later, "not written yet, but known");
    assert_eq!(world.state.sessions().expect("readable")[0].last_used, sessions[0].created);
    world.principals.record_use(&begun.identity, later + USED_LATER);
    assert_eq!(world.state.sessions().expect("readable")[0].last_used, later + USED_LATER);
}

/// Interval after which uses are written to disk.
const USED_LATER: Millis = 60_000;

#[test]
fn changes_of_an_account_end_its_sessions_and_no_others() {
    let world = world().with_alice();
    let other = NewAccount { name: "bob".into(), role: Role::Admin, services: Vec::new(), ..alice() };
    world.principals.create_account(&other, "hash").expect("made");
    let candidate = world.principals.candidate("bob").expect("an account");
    let bob = expect_begun(world.principals.begin_session(&candidate, "x"));
    let role = AccountChange { role: Some(Role::Operator), ..AccountChange::default() };
    let disabled = |disabled| AccountChange { disabled: Some(disabled), ..AccountChange::default() };
    let changes: [(AccountChange, Option<&str>); 4] = [
        (role, None),
        (AccountChange::default(), Some("another hash")),
        (disabled(true), None),
        (disabled(false), None),
    ];
    for (change, password) in &changes {
        let begun = world.principals.candidate("alice").map(|_| world.begin());
        let changed = world.principals.change_account("alice", change, *password);
        changed.expect("there");
        if let Some(begun) = begun {
            let standing = world.principals.connection_access(&begun.identity, "lab_1");
            assert_eq!(standing, ConnectionAccess::Ended("this session was ended".into()));
        }
    }
    assert_eq!(world.principals.accounts()[0].role, Role::Operator);
    let begun = world.begin();
    world.principals.remove_account("alice").expect("there");
    assert!(world.recognise(&begun.secret, store::now()).is_err());
    assert!(world.principals.candidate("alice").is_none());
    world.recognise(&bob.secret, store::now()).expect("another's");
    let unknown = world.principals.remove_account("alice").expect_err("once");
    assert_eq!(unknown.problem().status, 404);
    world.principals.remove_account("bob").expect("there");
    assert!(!world.principals.has_no_credentials(), "the door does not open again");
}

#[test]
fn nobody_begins_by_what_an_account_was_before() {
    let world = world().with_alice();
    let before = world.principals.candidate("alice").expect("an account");
    let role = AccountChange { role: Some(Role::Viewer), services: alice().services, ..AccountChange::default() };
    for (change, password) in [(&role, None), (&AccountChange::default(), Some("another"))] {
        let changed = world.principals.change_account("alice", change, password);
        changed.expect("there");
        let begun = world.principals.begin_session(&before, "x").expect("readable");
        assert!(begun.is_none(), "its password was looked at before the change");
    }
    let disabled = AccountChange { disabled: Some(true), ..AccountChange::default() };
    let before = world.principals.candidate("alice").expect("an account");
    let changed = world.principals.change_account("alice", &disabled, None);
    changed.expect("there");
    assert!(world.principals.begin_session(&before, "x").expect("readable").is_none());
    assert!(world.principals.candidate("alice").is_none());
}

#[test]
fn a_hash_made_anew_ends_no_session() {
    let world = world().with_alice();
    let begun = world.begin();
    let mut candidate = world.principals.candidate("alice").expect("an account");
    world.principals.rehash(&mut candidate, "better".into()).expect("written");
    world.recognise(&begun.secret, store::now()).expect("good still");
    expect_begun(world.principals.begin_session(&candidate, "x"));
    assert_eq!(world.principals.candidate("alice").expect("there").password, "better");
}

#[test]
fn accounts_and_tokens_share_their_names() {
    let world = world().with_alice();
    let token = NewToken {
        name: "alice".into(),
        role: Role::Operator,
        services: Vec::new(),
        robot: None,
        classes: Vec::new(),
        lifetime: None,
    };
    let taken = world.principals.create_token(&token).expect_err("an account's").problem();
    assert_eq!(taken.status, 409, "{taken:?}");
    let bob = NewToken { name: "bob".into(), ..token };
    world.principals.create_token(&bob).expect("made");
    let new = NewAccount { name: "bob".into(), ..alice() };
    let taken = world.principals.create_account(&new, "hash").expect_err("a token's");
    assert_eq!(taken.problem().status, 409);
    let taken = world.principals.create_account(&alice(), "hash").expect_err("an account's");
    assert_eq!(taken.problem().status, 409);
}

#[test]
fn guesses_at_an_account_are_slowed_wherever_they_come_from() {
    let world = world().with_alice();
    let from = |number: u8| std::net::IpAddr::from([10, 0, 0, number]);
    for number in 0..access::guesses::FREE as u8 {
        world.principals.check_sign_in("alice", from(number), 5_000).expect("free");
        world.principals.record_wrong_password("alice", from(number), 5_000);
    }
    let slowed = world.principals.check_sign_in("alice", from(99), 5_000);
    assert_eq!(slowed, Err(AuthenticationError::SlowedSignIn(1_000)));
    world.principals.check_sign_in("bob", from(99), 5_000).expect("another account");
    assert_eq!(world.principals.password_counts(), (u64::from(access::guesses::FREE), 1));
    // Also from one address, whatever the account.
    for number in 0..access::guesses::FREE {
        world.principals.record_wrong_password(&format!("name{number}"), from(50), 5_000);
    }
    let slowed = world.principals.check_sign_in("bob", from(50), 5_000);
    assert_eq!(slowed, Err(AuthenticationError::SlowedSignIn(1_000)));
}

#[test]
fn names_that_nobody_has_make_nothing_of_an_accounts_forgotten_and_slow_no_other() {
    let world = world().with_alice();
    let from = |number: u32| std::net::IpAddr::from((0x0a00_0000 + number).to_be_bytes());
    for number in 0..access::guesses::FREE {
        let principals = &world.principals;
        principals.record_wrong_password("alice", from(number), 5_000);
    }
    for number in 0..access::guesses::MAX_ENTRIES as u32 + 100 {
        let name = format!("nobody{number}");
        let principals = &world.principals;
        principals.record_wrong_password(&name, from(1_000 + number), 5_001);
    }
    let slowed = world.principals.check_sign_in("alice", from(99_999), 5_001);
    assert_eq!(slowed, Err(AuthenticationError::SlowedSignIn(999)));
    for other in ["bob", "nobody-new"] {
        let tried = world.principals.check_sign_in(other, from(99_999), 5_001);
        tried.expect("it was not tried before");
    }
}

#[test]
fn a_person_has_so_many_sessions_and_no_more() {
    let world = world().with_alice();
    let first = world.begin();
    for _ in 0..32 {
        world.begin();
    }
    assert_eq!(world.principals.sessions().len(), 32);
    assert!(world.recognise(&first.secret, store::now()).is_err(), "the oldest");
}

#[tokio::test]
async fn whoever_follows_hears_that_a_session_was_ended() {
    let world = world().with_alice();
    let begun = world.begin();
    let now = world.principals.connection_access(&begun.identity, "lab_1");
    assert!(matches!(now, ConnectionAccess::Granted(_)));
    let (sender, mut standing) = watch::channel(now);
    let change = async {
        world.principals.end_sessions_of("alice").expect("ended");
        standing.changed().await.expect("followed");
        assert!(matches!(&*standing.borrow(), ConnectionAccess::Ended(_)));
    };
    tokio::select! {
        () = world.principals.follow_access(&begun.identity, "lab_1", &sender) => {}
        () = change => {}
    }
}
