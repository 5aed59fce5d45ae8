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

fn verify(known: Option<&str>, password: &str) -> Result<PasswordVerdict, password_hash::Error> {
    super::verify(known, password, &mut memory())
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
    assert!(written.starts_with("$argon2id$v=19$m=19456,t=2,p=1$"), "{written}");
    assert_ne!(written, hash(GOOD).expect("hashed"), "salted");
    assert_eq!(verify(Some(&written), GOOD), Ok(PasswordVerdict::Right));
    assert_eq!(verify(Some(&written), "four quiet purple engine"), Ok(PasswordVerdict::Wrong));
    assert_eq!(verify(None, GOOD), Ok(PasswordVerdict::Wrong));
    verify(Some("no hash"), GOOD).expect_err("damaged");
}

#[test]
fn a_hash_of_other_parameters_is_made_anew() {
    let params = Params::new(8, 1, 1, None).expect("parameters");
    let salt = SaltString::generate(&mut OsRng);
    let weak = Argon2::new(Algorithm::Argon2id, Version::V0x13, params);
    let weak = weak.hash_password(GOOD.as_bytes(), &salt).expect("hashed").to_string();
    let Ok(PasswordVerdict::Rehashed(better)) = verify(Some(&weak), GOOD) else {
        panic!("kept");
    };
    assert_eq!(verify(Some(&better), GOOD), Ok(PasswordVerdict::Right));
    assert_eq!(verify(Some(&weak), "another one, wrong"), Ok(PasswordVerdict::Wrong));
}

#[test]
fn passwords_that_are_guessed_first_are_refused() {
    check_strength("alice", GOOD).expect("a good one");
    check_strength("al", "ägyptisches öl").expect("characters are counted, not bytes");
    for (name, password, words) in [
        ("alice", "short", "at least 12"),
        ("alice", "", "at least 12"),
        ("alice", &*"x".repeat(LONGEST + 1), "at most"),
        ("alice", "aaaaaaaaaaaaaaa", "too easy to guess"),
        ("alice", "PasswordPassword", "too easy to guess"),
        ("administrator1", "Administrator1", "too easy to guess"),
        ("alice", "alicealice123", "too easy to guess"),
    ] {
        let refused = check_strength(name, password).expect_err(password).to_string();
        assert!(refused.contains(words), "{password}: {refused}");
    }
}

#[test]
fn what_is_written_is_what_the_library_reads() {
    let written = hash(GOOD).expect("hashed");
    let parsed = PasswordHash::new(&written).expect("a hash");
    let verified = argon2().expect("parameters").verify_password(GOOD.as_bytes(), &parsed);
    verified.expect("the same");
    // Memory that was used before does not change the hash.
    let mut used = memory();
    super::hash("another one, before", &mut used).expect("hashed");
    assert_eq!(super::verify(Some(&written), GOOD, &mut used), Ok(PasswordVerdict::Right));
}

#[tokio::test]
async fn names_that_are_made_up_hold_up_nobody_who_has_an_account() {
    let passwords = Passwords::default();
    let known = hash(GOOD).expect("hashed");
    // None of them finishes, as if further ones kept coming.
    let mut waiting = Vec::new();
    for number in 0..500 {
        let name = format!("nobody{number}");
        let passwords = &passwords;
        let mut tried = Box::pin(async move {
            let attempt = attempt(number, &name, None);
            passwords.verify(attempt, || Ok(())).await
        });
        if let std::task::Poll::Ready(tried) = futures_util::poll!(&mut tried) {
            assert_eq!(tried.expect_err("busy").problem().status, 503);
        }
        waiting.push(tried);
    }
    for number in 0..20 {
        let own = attempt(1000 + number, "alice", Some(&known));
        let looked = passwords.verify(own, || Ok(())).await;
        assert_eq!(looked.expect("her turn"), PasswordVerdict::Right);
    }
}

#[tokio::test]
async fn one_address_and_one_account_take_few_of_the_places() {
    let holders = HashSlots::default();
    let hold = |from: &str, account: &str| holders.acquire(from.parse().expect("an address"), account);
    let of_address: Vec<HashSlot> =
        (0..OF_EACH).map(|number| hold("192.0.2.1", &format!("name{number}")).expect("room")).collect();
    let refused = hold("192.0.2.1", "alice").expect_err("too many").problem();
    assert_eq!((refused.status, refused.retry_after.is_some()), (503, true));
    let of_account: Vec<HashSlot> =
        (0..OF_EACH).map(|number| hold(&format!("192.0.2.{}", number + 2), "alice").expect("room")).collect();
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
        turns.push(passwords.accounts.acquire().await.expect("a turn"));
    }
    let mut waiting = Vec::new();
    for _ in 0..WAITING {
        let mut turn = Box::pin(passwords.accounts.acquire());
        assert!(futures_util::poll!(&mut turn).is_pending());
        waiting.push(turn);
    }
    let refused = passwords.hash(GOOD.into()).await.expect_err("no room").problem();
    assert_eq!((refused.status, refused.retry_after.is_some()), (503, true));
    drop((turns, waiting));
    passwords.hash(GOOD.into()).await.expect("room again");
    assert!(passwords.accounts.is_empty(all));
}

#[tokio::test]
async fn what_is_refused_before_is_not_looked_at() {
    let passwords = Passwords::default();
    let refused = passwords.verify(attempt(1, "alice", None), || Err(Error::Internal("test"))).await;
    refused.expect_err("refused");
    assert!(passwords.made_up.is_empty(AT_ONCE_IN_VAIN + WAITING));
    assert!(passwords.holders.is_empty());
}
