use argon2::PasswordHasher;

use super::super::lanes::OF_EACH;
use super::*;

const GOOD: &str = "four quiet purple engines";

fn memory() -> Vec<Block> {
    let blocks = argon2().expect("parameters").params().block_count();
    vec![Block::new(); blocks]
}

fn hash(password: &str) -> Result<String, password_hash::Error> {
    super::hash(password, &mut memory())
}

fn look(known: Option<&str>, password: &str) -> Result<Looked, password_hash::Error> {
    super::look(known, password, &mut memory())
}

fn attempt(from: u32, name: &str, known: Option<&str>) -> Attempt {
    Attempt {
        from: IpAddr::V4(from.into()),
        name: name.to_owned(),
        known: known.map(str::to_owned),
        password: GOOD.to_owned(),
    }
}

#[test]
fn a_password_is_looked_at_by_its_hash_alone() {
    let written = hash(GOOD).expect("hashed");
    assert!(
        written.starts_with("$argon2id$v=19$m=19456,t=2,p=1$"),
        "{written}"
    );
    assert_ne!(written, hash(GOOD).expect("hashed"), "salted");
    assert_eq!(look(Some(&written), GOOD), Ok(Looked::Right));
    assert_eq!(
        look(Some(&written), "four quiet purple engine"),
        Ok(Looked::Wrong)
    );
    assert_eq!(look(None, GOOD), Ok(Looked::Wrong));
    look(Some("no hash"), GOOD).expect_err("damaged");
}

#[test]
fn a_hash_of_other_parameters_is_made_anew() {
    let params = Params::new(8, 1, 1, None).expect("parameters");
    let salt = SaltString::generate(&mut OsRng);
    let weak = Argon2::new(Algorithm::Argon2id, Version::V0x13, params);
    let weak = weak
        .hash_password(GOOD.as_bytes(), &salt)
        .expect("hashed")
        .to_string();
    let Ok(Looked::Rehashed(better)) = look(Some(&weak), GOOD) else {
        panic!("kept");
    };
    assert_eq!(look(Some(&better), GOOD), Ok(Looked::Right));
    assert_eq!(look(Some(&weak), "another one, wrong"), Ok(Looked::Wrong));
}

#[test]
fn passwords_that_are_guessed_first_are_refused() {
    check("alice", GOOD).expect("a good one");
    check("al", "ägyptisches öl").expect("characters are counted, not bytes");
    for (name, password, words) in [
        ("alice", "short", "at least 12"),
        ("alice", "", "at least 12"),
        ("alice", &*"x".repeat(LONGEST + 1), "at most"),
        ("alice", "aaaaaaaaaaaaaaa", "first that are guessed"),
        ("alice", "PasswordPassword", "first that are guessed"),
        ("administrator1", "Administrator1", "first that are guessed"),
        ("alice", "alicealice123", "first that are guessed"),
    ] {
        let refused = check(name, password).expect_err(password);
        assert!(refused.contains(words), "{password}: {refused}");
    }
}

#[test]
fn what_is_written_is_what_the_library_reads() {
    let written = hash(GOOD).expect("hashed");
    let parsed = PasswordHash::new(&written).expect("a hash");
    let verified = argon2()
        .expect("parameters")
        .verify_password(GOOD.as_bytes(), &parsed);
    verified.expect("the same");
    // Memory that another has used makes no other hash.
    let mut used = memory();
    super::hash("another one, before", &mut used).expect("hashed");
    assert_eq!(
        super::look(Some(&written), GOOD, &mut used),
        Ok(Looked::Right)
    );
}

#[tokio::test]
async fn names_that_are_made_up_hold_up_nobody_who_has_an_account() {
    let passwords = Passwords::default();
    let known = hash(GOOD).expect("hashed");
    // None of them ends, as if there were always another.
    let mut waiting = Vec::new();
    for number in 0..500 {
        let name = format!("nobody{number}");
        let passwords = &passwords;
        let mut tried = Box::pin(async move {
            let attempt = attempt(number, &name, None);
            passwords.look(attempt, || Ok(())).await
        });
        if let std::task::Poll::Ready(tried) = futures_util::poll!(&mut tried) {
            assert_eq!(tried.expect_err("busy").problem().status, 503);
        }
        waiting.push(tried);
    }
    for number in 0..20 {
        let own = attempt(1000 + number, "alice", Some(&known));
        let looked = passwords.look(own, || Ok(())).await;
        assert_eq!(looked.expect("her turn"), Looked::Right);
    }
}

#[tokio::test]
async fn one_address_and_one_account_take_few_of_the_places() {
    let holders = Holders::default();
    let hold = |from: &str, account: &str| holders.hold(from.parse().expect("an address"), account);
    let of_address: Vec<Held> = (0..OF_EACH)
        .map(|number| hold("192.0.2.1", &format!("name{number}")).expect("room"))
        .collect();
    let refused = hold("192.0.2.1", "alice").expect_err("too many").problem();
    assert_eq!((refused.status, refused.retry_after.is_some()), (503, true));
    let of_account: Vec<Held> = (0..OF_EACH)
        .map(|number| hold(&format!("192.0.2.{}", number + 2), "alice").expect("room"))
        .collect();
    hold("192.0.2.99", "alice").expect_err("too many of one account");
    hold("192.0.2.99", "bob").expect("another's");
    drop((of_address, of_account));
    assert!(holders.is_empty());
}

#[tokio::test]
async fn more_than_may_wait_are_refused() {
    let passwords = Passwords::default();
    let all = AT_ONCE + WAITING;
    let mut turns = Vec::new();
    for _ in 0..AT_ONCE {
        turns.push(passwords.accounts.turn().await.expect("a turn"));
    }
    let mut waiting = Vec::new();
    for _ in 0..WAITING {
        let mut turn = Box::pin(passwords.accounts.turn());
        assert!(futures_util::poll!(&mut turn).is_pending());
        waiting.push(turn);
    }
    let refused = passwords
        .hash(GOOD.into())
        .await
        .expect_err("no room")
        .problem();
    assert_eq!((refused.status, refused.retry_after.is_some()), (503, true));
    drop((turns, waiting));
    passwords.hash(GOOD.into()).await.expect("room again");
    assert!(passwords.accounts.is_empty(all));
}

#[tokio::test]
async fn what_is_refused_before_is_not_looked_at() {
    let passwords = Passwords::default();
    let refused = passwords
        .look(attempt(1, "alice", None), || Err(Error::Internal("test")))
        .await;
    refused.expect_err("refused");
    assert!(passwords.made_up.is_empty(AT_ONCE_IN_VAIN + WAITING));
    assert!(passwords.holders.is_empty());
}
