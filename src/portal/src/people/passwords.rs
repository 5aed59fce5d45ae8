//! Hashing passwords: Argon2id (RFC 9106), version 19, 19 MiB, two passes, one lane, as OWASP's Password Storage Cheat Sheet
//! asks for at least. Kept in the PHC string format, which has the parameters: a hash with others is made anew when its owner
//! signs in.

use std::sync::{Arc, LazyLock};

use argon2::password_hash::rand_core::OsRng;
use argon2::password_hash::{self, PasswordHash, SaltString};
use argon2::{Algorithm, Argon2, Params, PasswordHasher, PasswordVerifier, Version};
use tokio::sync::Semaphore;

use crate::errors::Error;

/// KiB, passes and lanes.
const MEMORY: u32 = 19 * 1024;
const PASSES: u32 = 2;
const LANES: u32 = 1;
/// Hashes that are made at once, and requests that may wait for theirs: who signs in takes no more than this of the machine.
const AT_ONCE: usize = 2;
const WAITING: usize = 32;
/// Characters that a password has at least, and bytes that it may have.
const SHORTEST: usize = 12;
pub const LONGEST: usize = 1024;
/// What is tried first by who guesses, of those that are long enough; in lower case.
const OBVIOUS: [&str; 12] = [
    "123456789012",
    "1234567890123",
    "12345678901234567890",
    "administrator",
    "changemechangeme",
    "correcthorsebatterystaple",
    "letmeinletmein",
    "password1234",
    "passwordpassword",
    "qwertyuiop12",
    "qwertyuiopasdfghjkl",
    "robotrobotrobot",
];

/// Refuses a password that can be guessed, in words.
pub fn check(name: &str, password: &str) -> Result<(), String> {
    if password.len() > LONGEST {
        return Err(format!("a password has at most {LONGEST} bytes"));
    }
    if password.chars().count() < SHORTEST {
        return Err(format!(
            "a password has at least {SHORTEST} characters; four words that have nothing to do with each other are good ones"
        ));
    }
    let plain = password.to_lowercase();
    let mut characters = plain.chars();
    let first = characters.next();
    let is_of_one = characters.all(|other| Some(other) == first);
    let without_name = plain.replace(&name.to_lowercase(), "");
    if is_of_one || without_name.chars().count() < SHORTEST / 2 || OBVIOUS.contains(&&*plain) {
        return Err("this password is among the first that are guessed; choose another".into());
    }
    Ok(())
}

/// What came of looking at a password.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Looked {
    /// It is another.
    Wrong,
    /// It is the one.
    Right,
    /// It is the one, and is hashed anew by today's parameters.
    Rehashed(String),
}

/// Makes hashes, a few at once, on threads where they hold up nothing.
pub struct Passwords {
    /// Those that are made.
    working: Arc<Semaphore>,
    /// Those that are made or waited for.
    room: Arc<Semaphore>,
}

impl Default for Passwords {
    fn default() -> Self {
        Passwords {
            working: Arc::new(Semaphore::new(AT_ONCE)),
            room: Arc::new(Semaphore::new(AT_ONCE + WAITING)),
        }
    }
}

fn argon2() -> Result<Argon2<'static>, password_hash::Error> {
    let params = Params::new(MEMORY, PASSES, LANES, None)?;
    Ok(Argon2::new(Algorithm::Argon2id, Version::V0x13, params))
}

fn hash(password: &str) -> Result<String, password_hash::Error> {
    let salt = SaltString::generate(&mut OsRng);
    let hash = argon2()?.hash_password(password.as_bytes(), &salt)?;
    Ok(hash.to_string())
}

/// Whose password nobody knows: looking at it takes as long as at another's.
fn nobodys() -> Result<&'static str, password_hash::Error> {
    static HASH: LazyLock<Result<String, password_hash::Error>> =
        LazyLock::new(|| hash(&catalogue::names::random(32)));
    HASH.as_deref().map_err(|error| *error)
}

fn is_todays(hash: &PasswordHash<'_>) -> bool {
    let params = Params::try_from(hash).ok();
    let same = params.is_some_and(|params| {
        (params.m_cost(), params.t_cost(), params.p_cost()) == (MEMORY, PASSES, LANES)
    });
    same && hash.algorithm == Algorithm::Argon2id.ident()
        && hash.version == Some(Version::V0x13.into())
}

fn look(known: Option<&str>, password: &str) -> Result<Looked, password_hash::Error> {
    let written = match known {
        Some(written) => written,
        None => nobodys()?,
    };
    let parsed = PasswordHash::new(written)?;
    match argon2()?.verify_password(password.as_bytes(), &parsed) {
        Ok(()) if known.is_none() => Ok(Looked::Wrong),
        Ok(()) if is_todays(&parsed) => Ok(Looked::Right),
        Ok(()) => hash(password).map(Looked::Rehashed),
        Err(password_hash::Error::Password) => Ok(Looked::Wrong),
        Err(error) => Err(error),
    }
}

impl Passwords {
    async fn work<T: Send + 'static>(
        &self,
        before: impl FnOnce() -> Result<(), Error> + Send,
        work: impl FnOnce() -> Result<T, password_hash::Error> + Send + 'static,
    ) -> Result<T, Error> {
        let room = Arc::clone(&self.room);
        let Ok(place) = room.try_acquire_owned() else {
            return Err(Error::SignInBusy);
        };
        let turn = Arc::clone(&self.working).acquire_owned().await;
        before()?;
        // Whoever does not wait for it any more does not make room for another before it has ended.
        let worked = tokio::task::spawn_blocking(move || {
            let held = (place, turn);
            let worked = work();
            drop(held);
            worked
        });
        match worked.await {
            Ok(Ok(worked)) => Ok(worked),
            Ok(Err(error)) => {
                tracing::error!("a password could not be hashed, or its hash not be read: {error}");
                Err(Error::Internal("hashing a password"))
            }
            Err(_) => Err(Error::Internal("hashing a password")),
        }
    }

    /// The hash of a new password.
    pub async fn hash(&self, password: String) -> Result<String, Error> {
        self.work(|| Ok(()), move || hash(&password)).await
    }

    /// Looks whether a password is that of a hash. Without one it takes as long and is wrong. `before` is asked when it is about to
    /// be looked at.
    pub async fn look(
        &self,
        known: Option<String>,
        password: String,
        before: impl FnOnce() -> Result<(), Error> + Send,
    ) -> Result<Looked, Error> {
        self.work(before, move || look(known.as_deref(), &password))
            .await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "four quiet purple engines";

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

    #[tokio::test]
    async fn more_than_may_wait_are_refused() {
        let passwords = Passwords::default();
        let all = (AT_ONCE + WAITING) as u32;
        let taken = Arc::clone(&passwords.room)
            .acquire_many_owned(all)
            .await
            .expect("open");
        let refused = passwords
            .hash(GOOD.into())
            .await
            .expect_err("no room")
            .problem();
        assert_eq!((refused.status, refused.retry_after.is_some()), (503, true));
        drop(taken);
        passwords.hash(GOOD.into()).await.expect("room again");
    }

    #[tokio::test]
    async fn what_is_refused_before_is_not_looked_at() {
        let passwords = Passwords::default();
        let refused = passwords
            .look(None, GOOD.into(), || Err(Error::Internal("test")))
            .await;
        refused.expect_err("refused");
        assert_eq!(passwords.room.available_permits(), AT_ONCE + WAITING);
    }
}
