use super::*;

fn state() -> (tempfile::TempDir, State) {
    let home = tempfile::tempdir().expect("a directory");
    let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
    (home, state)
}

fn session(hash: &str, account: Option<i64>, expires: u64) -> NewSession<'_> {
    NewSession { hash, account, name: "alice", role: "viewer", scope: "{}", peer: "127.0.0.1:1", expires, person: None }
}

#[test]
fn a_name_is_one_live_accounts() {
    let (_home, state) = state();
    assert!(state.add_account("alice", "hash", "viewer", "{}").expect("written"));
    assert!(!state.add_account("alice", "other", "admin", "{}").expect("refused"));
    assert!(state.remove_account("alice").expect("removed"));
    assert!(!state.remove_account("alice").expect("none is left"));
    let edit = AccountEdit { password: Some("hash"), ..AccountEdit::default() };
    assert!(!state.edit_account("alice", &edit).expect("none is left"));
    assert!(state.add_account("alice", "other", "admin", "{}").expect("written"));
    let kept = state.accounts().expect("readable");
    assert_eq!(kept.len(), 2);
    assert!(kept[0].removed.is_some() && kept[0].password.is_empty());
    assert_eq!((&*kept[1].password, kept[1].removed), ("other", None));
}

#[test]
fn a_session_begins_by_an_account_as_it_is_and_those_that_are_over_go() {
    let (_home, state) = state();
    state.add_account("alice", "hash", "viewer", "{}").expect("written");
    let id = state.accounts().expect("readable")[0].id;
    let later = now() + 60_000;
    let wrong = state.add_session(&session("a", Some(id), later), Some("other"));
    assert_eq!(wrong.expect("readable"), None);
    state.add_session(&session("old", None, 1), None).expect("written").expect("made");
    let made = state.add_session(&session("a", Some(id), later), Some("hash"));
    let made = made.expect("written").expect("made");
    assert_eq!(state.sessions().expect("readable").as_slice(), std::slice::from_ref(&made));
    assert!(state.accounts().expect("readable")[0].last_login.is_some());
    let edit = AccountEdit { role_and_scope: Some(("admin", "{}")), ..AccountEdit::default() };
    assert!(state.edit_account("alice", &edit).expect("written"));
    let account = &state.accounts().expect("readable")[0];
    assert_eq!((&*account.role, &*account.password), ("admin", "hash"));
    assert_eq!(state.sessions().expect("readable"), []);
    assert!(!state.end_session(made.id).expect("over"));
}
