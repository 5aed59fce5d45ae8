//! Durability under write errors: an operation that reported success is present after a restart, whichever writes of
//! SQLite fail. The disk is full for every n-th write.

use std::ffi::{c_int, c_void};
use std::sync::atomic::{AtomicU64, Ordering};

use nix::errno::Errno;
use nix::libc;
use package::inventory::Inventory;
use rusqlite::ffi;
use store::{AccountEdit, Error, NewAuditRecord, NewSample, NewSession, NewToken, State};
use store::{RecordingRecord, RevisionRecord, SeriesFilter};

/// Every n-th write fails; 0 means that none does.
static FAILING: AtomicU64 = AtomicU64::new(0);
static WRITES: AtomicU64 = AtomicU64::new(0);

fn should_fail() -> bool {
    let number = WRITES.fetch_add(1, Ordering::Relaxed);
    match FAILING.load(Ordering::Relaxed) {
        0 => false,
        one_of => number % one_of == one_of - 1,
    }
}

extern "C" fn write(file: c_int, bytes: *const c_void, count: usize) -> isize {
    if should_fail() {
        Errno::ENOSPC.set();
        return -1;
    }
    // SAFETY: SQLite passes the arguments of write(2).
    unsafe { libc::write(file, bytes, count) }
}

extern "C" fn write_at(file: c_int, bytes: *const c_void, count: usize, offset: i64) -> isize {
    if should_fail() {
        Errno::ENOSPC.set();
        return -1;
    }
    // SAFETY: SQLite passes the arguments of pwrite(2).
    unsafe { libc::pwrite(file, bytes, count, offset) }
}

/// Replaces the write system calls of SQLite's Unix VFS by the functions above.
fn inject_faults() {
    type Call = unsafe extern "C" fn();
    type Write = extern "C" fn(c_int, *const c_void, usize) -> isize;
    type WriteAt = extern "C" fn(c_int, *const c_void, usize, i64) -> isize;
    // SAFETY: SQLite calls each function with the arguments of the system call that it replaces.
    unsafe {
        let write = std::mem::transmute::<Write, Call>(write);
        let write_at = std::mem::transmute::<WriteAt, Call>(write_at);
        let vfs = ffi::sqlite3_vfs_find(std::ptr::null());
        let replace = (*vfs).xSetSystemCall.expect("the VFS of Unix");
        // Only the first, or the others, depending on how SQLite was built.
        replace(vfs, c"write".as_ptr(), Some(write));
        replace(vfs, c"pwrite".as_ptr(), Some(write_at));
        replace(vfs, c"pwrite64".as_ptr(), Some(write_at));
    }
}

fn revision(service: &str, owner: &str) -> RevisionRecord {
    RevisionRecord {
        service: service.to_owned(),
        number: 0,
        image: "sha256:1".to_owned(),
        published: 0,
        package: service.to_owned(),
        owner: Some(owner.to_owned()),
        source: String::new(),
        flavour: Default::default(),
        plan: Default::default(),
        interface: Default::default(),
    }
}

fn recording(robot: &str) -> RecordingRecord {
    RecordingRecord {
        id: 0,
        service: "s".to_owned(),
        robot: robot.to_owned(),
        servant: "s-1".to_owned(),
        time: 1,
        why: String::new(),
        span: 1,
        messages: 1,
        bytes: 1,
        topics: None,
    }
}

fn token(name: &str) -> NewToken<'_> {
    NewToken { name, hash: name, role: "viewer", scope: "{}", expires: None }
}

fn session(name: &str) -> NewSession<'_> {
    NewSession {
        hash: name,
        account: None,
        name,
        role: "viewer",
        scope: "{}",
        peer: "",
        expires: u64::MAX >> 1,
        person: None,
    }
}

fn live_token(state: &State, name: &str) -> Option<String> {
    let tokens = state.tokens().expect("readable").into_iter();
    let mut live = tokens.filter(|token| token.name == name && token.revoked.is_none());
    live.next().map(|token| token.hash)
}

fn find_rule(state: &State, who: &str) -> Option<i64> {
    let mut rules = state.rules().expect("readable").into_iter();
    rules.find(|rule| rule.who == who).map(|rule| rule.id)
}

fn is_paired(state: &State, robot: &str) -> bool {
    let pairings = state.pairings().expect("readable");
    pairings.iter().any(|pairing| pairing.robot == robot && pairing.revoked.is_none())
}

fn find_session(state: &State, name: &str) -> Option<i64> {
    let sessions = state.sessions().expect("readable").into_iter();
    sessions.filter(|session| session.name == name).map(|session| session.id).next()
}

fn find_recording(state: &State, robot: &str) -> Option<u64> {
    let mut recordings = state.recordings().expect("readable").into_iter();
    recordings.find(|recording| recording.robot == robot).map(|recording| recording.id)
}

fn account(state: &State, name: &str) -> Option<String> {
    let accounts = state.accounts().expect("readable").into_iter();
    let mut live = accounts.filter(|account| account.name == name && account.removed.is_none());
    live.next().map(|account| account.role)
}

fn is_audited(state: &State, object: &str) -> bool {
    let audited = state.audit_records(0, u32::MAX).expect("readable");
    audited.iter().any(|record| record.object == object)
}

/// An operation on the state: how to prepare it while the database can be written, how to run it, and how to check that
/// it was done. All objects of one operation share a unique name.
struct Operation {
    name: &'static str,
    prepare: fn(&State, &str) -> Result<(), Error>,
    run: fn(&State, &str) -> Result<(), Error>,
    is_done: fn(&State, &str) -> bool,
}

const OPERATIONS: &[Operation] = &[
    Operation {
        name: "add a token",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_token(&token(name)).map(drop),
        is_done: |state, name| live_token(state, name).is_some(),
    },
    Operation {
        name: "rotate a token",
        prepare: |state, name| state.add_token(&token(name)).map(drop),
        run: |state, name| state.rotate_token(name, &format!("{name} anew")).map(drop),
        is_done: |state, name| live_token(state, name) == Some(format!("{name} anew")),
    },
    Operation {
        name: "revoke a token",
        prepare: |state, name| state.add_token(&token(name)).map(drop),
        run: |state, name| state.revoke_token(name).map(drop),
        is_done: |state, name| live_token(state, name).is_none(),
    },
    Operation {
        name: "add a rule",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_rule(name, "*", "[]").map(drop),
        is_done: |state, name| find_rule(state, name).is_some(),
    },
    Operation {
        name: "remove a rule",
        prepare: |state, name| state.add_rule(name, "*", "[]").map(drop),
        run: |state, name| match find_rule(state, name) {
            Some(id) => state.remove_rule(id).map(drop),
            None => Ok(()),
        },
        is_done: |state, name| find_rule(state, name).is_none(),
    },
    Operation {
        name: "pair a robot by a code",
        prepare: |state, name| state.add_pairing_code(name, name, "{}", u64::MAX >> 1),
        run: |state, name| match state.pairing_code(name)? {
            Some(code) => state.use_pairing_code(code.id, "key", 1).map(drop),
            None => Ok(()),
        },
        is_done: is_paired,
    },
    Operation {
        name: "pair a robot",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_pairing(name, "{}").map(drop),
        is_done: is_paired,
    },
    Operation {
        name: "revoke a pairing",
        prepare: |state, name| state.add_pairing(name, "{}").map(drop),
        run: |state, name| state.revoke_pairing(name).map(drop),
        is_done: |state, name| !is_paired(state, name),
    },
    Operation {
        name: "add an account",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_account(name, "", "viewer", "{}").map(drop),
        is_done: |state, name| account(state, name).is_some(),
    },
    Operation {
        name: "change an account",
        prepare: |state, name| state.add_account(name, "", "viewer", "{}").map(drop),
        run: |state, name| {
            let edit = AccountEdit { role_and_scope: Some(("admin", "{}")), ..AccountEdit::default() };
            state.edit_account(name, &edit).map(drop)
        },
        is_done: |state, name| account(state, name).as_deref() == Some("admin"),
    },
    Operation {
        name: "remove an account",
        prepare: |state, name| state.add_account(name, "", "viewer", "{}").map(drop),
        run: |state, name| state.remove_account(name).map(drop),
        is_done: |state, name| account(state, name).is_none(),
    },
    Operation {
        name: "begin a session",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_session(&session(name), None).map(drop),
        is_done: |state, name| find_session(state, name).is_some(),
    },
    Operation {
        name: "end a session",
        prepare: |state, name| state.add_session(&session(name), None).map(drop),
        run: |state, name| state.end_sessions(name).map(drop),
        is_done: |state, name| find_session(state, name).is_none(),
    },
    Operation {
        name: "sign somebody in whom a provider knows",
        prepare: |_, _| Ok(()),
        run: |state, name| state.sign_in_federated_person("issuer", name, name).map(drop),
        is_done: |state, name| {
            let people = state.federated_people().expect("readable");
            people.iter().any(|person| person.subject == name)
        },
    },
    Operation {
        name: "bind a robot that comes",
        prepare: |_, _| Ok(()),
        run: |state, name| state.claim_robot(name, Some(&"alice".to_owned()), true).map(drop),
        is_done: |state, name| {
            let owner = state.claim_robot(name, Some(&"bob".to_owned()), false);
            owner.expect("readable").as_deref() == Some("alice")
        },
    },
    Operation {
        name: "publish a service",
        prepare: |_, _| Ok(()),
        run: |state, name| state.publish(&revision(name, "alice"), &Inventory::default()).map(drop),
        is_done: |state, name| {
            state.service_owner(name).expect("readable") == Some(Some("alice".to_owned()))
                && state.current_revision(name).expect("readable").is_some()
        },
    },
    Operation {
        name: "remove a service",
        prepare: |state, name| state.publish(&revision(name, "alice"), &Inventory::default()).map(drop),
        run: |state, name| state.remove_service(name).map(drop),
        is_done: |state, name| state.current_revision(name).expect("readable").is_none(),
    },
    Operation {
        name: "keep samples",
        prepare: |_, _| Ok(()),
        run: |state, name| {
            let sample = NewSample { servant: name, service: "s", robot: "r", began: 1, figures: &[1.0] };
            state.add_samples(10, 1, &[sample])
        },
        is_done: |state, name| {
            let filter = SeriesFilter { servant: Some(name), ..SeriesFilter::default() };
            let recorded = state.recorded_series(filter, 0, 1).expect("readable");
            recorded.iter().any(|one| state.samples(one.id, 10, (0, 9), 9).expect("readable").len() == 1)
        },
    },
    Operation {
        name: "remember a recording",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_recording(&recording(name)).map(drop),
        is_done: |state, name| find_recording(state, name).is_some(),
    },
    Operation {
        name: "forget a recording",
        prepare: |state, name| state.add_recording(&recording(name)).map(drop),
        run: |state, name| match find_recording(state, name) {
            Some(id) => state.forget_recording(id).map(drop),
            None => Ok(()),
        },
        is_done: |state, name| find_recording(state, name).is_none(),
    },
    Operation {
        name: "add to the audit log",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_audit_record(&new_audit_record(name)).map(drop),
        is_done: is_audited,
    },
    Operation {
        name: "add to the audit log without waiting for the disk",
        prepare: |_, _| Ok(()),
        run: |state, name| state.add_audit_record_without_sync(&new_audit_record(name)).map(drop),
        is_done: is_audited,
    },
];

fn new_audit_record(object: &str) -> NewAuditRecord<'_> {
    NewAuditRecord { object, ..NewAuditRecord::default() }
}

/// Runs all operations several times while every n-th write fails, and checks them after a restart.
fn check(one_of: u64) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("cloudroid.db");
    let state = State::open(&path).expect("a database");
    let turns: Vec<_> = (0..3)
        .flat_map(|turn| {
            OPERATIONS.iter().enumerate().map(move |(number, operation)| (format!("n{turn}-{number}"), operation))
        })
        .collect();
    for (name, operation) in &turns {
        (operation.prepare)(&state, name).expect("writable so far");
    }
    FAILING.store(one_of, Ordering::Relaxed);
    let outcomes: Vec<_> = turns.iter().map(|(name, operation)| (operation.run)(&state, name)).collect();
    drop(state);
    FAILING.store(0, Ordering::Relaxed);
    let failed = outcomes.iter().filter(|outcome| outcome.is_err()).count();
    assert!(failed > 0, "no operation noticed that one write of {one_of} failed");
    let state = State::open(&path).expect("the database, undamaged");
    for ((name, operation), outcome) in turns.iter().zip(outcomes) {
        let is_done = (operation.is_done)(&state, name);
        assert!(
            is_done || outcome.is_err(),
            "{} ({name}) was answered with success and is lost, where one write of {one_of} fails",
            operation.name
        );
    }
}

#[test]
fn what_was_answered_with_success_is_there_after_a_restart() {
    inject_faults();
    for one_of in [1, 2, 3, 4, 5, 7, 11, 16, 23, 37] {
        check(one_of);
    }
}
