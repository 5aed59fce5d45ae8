//! Hashing passwords: Argon2id (RFC 9106), version 19, 19 MiB, two passes, one lane, as OWASP's Password Storage Cheat Sheet
//! asks for at least. Kept in the PHC string format, which has the parameters: a hash with others is made anew when its owner
//! signs in.

use std::net::IpAddr;
use std::sync::OnceLock;

use argon2::password_hash::rand_core::OsRng;
use argon2::password_hash::{self, Output, ParamsString, PasswordHash, Salt, SaltString};
use argon2::{Algorithm, Argon2, Block, Params, PasswordVerifier, Version};

use super::lanes::{Held, Holders, Lane, Turn};
use crate::errors::Error;

/// KiB, passes and lanes.
const MEMORY: u32 = 19 * 1024;
const PASSES: u32 = 2;
const LANES: u32 = 1;
/// Hashes that are made at once, of accounts and of names that nobody has, and requests that may wait for theirs, in each of the two lanes:
/// who signs in takes no more than this of the machine.
const AT_ONCE: usize = 2;
const AT_ONCE_IN_VAIN: usize = 1;
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
    /// Of people who have an account, and of accounts that are made.
    accounts: Lane,
    /// Of names that nobody has.
    made_up: Lane,
    holders: Holders,
}

impl Default for Passwords {
    fn default() -> Self {
        Passwords {
            accounts: Lane::new(AT_ONCE, WAITING),
            made_up: Lane::new(AT_ONCE_IN_VAIN, WAITING),
            holders: Holders::default(),
        }
    }
}

/// A password that is tried.
pub struct Attempt {
    /// From where.
    pub from: IpAddr,
    /// For which account, which need not exist.
    pub name: String,
    /// The account's hash; none where there is no such account.
    pub known: Option<String>,
    /// The password.
    pub password: String,
}

fn argon2() -> Result<Argon2<'static>, password_hash::Error> {
    let params = Params::new(MEMORY, PASSES, LANES, None)?;
    Ok(Argon2::new(Algorithm::Argon2id, Version::V0x13, params))
}

/// What today's parameters make of a password and a salt.
fn compute(
    password: &str,
    salt: Salt<'_>,
    memory: &mut [Block],
) -> Result<Output, password_hash::Error> {
    let mut decoded = [0; Salt::MAX_LENGTH];
    let salt = salt.decode_b64(&mut decoded)?;
    Output::init_with(Params::DEFAULT_OUTPUT_LEN, |out| {
        let argon2 = argon2()?;
        Ok(argon2.hash_password_into_with_memory(password.as_bytes(), salt, out, memory)?)
    })
}

fn hash(password: &str, memory: &mut [Block]) -> Result<String, password_hash::Error> {
    let salt = SaltString::generate(&mut OsRng);
    let output = compute(password, salt.as_salt(), memory)?;
    let hash = PasswordHash {
        algorithm: Algorithm::Argon2id.ident(),
        version: Some(Version::V0x13.into()),
        params: ParamsString::try_from(argon2()?.params())?,
        salt: Some(salt.as_salt()),
        hash: Some(output),
    };
    Ok(hash.to_string())
}

/// Whose password nobody knows: looking at it takes as long as at another's.
fn nobodys(memory: &mut [Block]) -> Result<&'static str, password_hash::Error> {
    static HASH: OnceLock<Result<String, password_hash::Error>> = OnceLock::new();
    let made = HASH.get_or_init(|| hash(&catalogue::names::random(32), memory));
    made.as_deref().map_err(|error| *error)
}

fn is_todays(hash: &PasswordHash<'_>) -> bool {
    let params = Params::try_from(hash).ok();
    let same = params.is_some_and(|params| {
        (params.m_cost(), params.t_cost(), params.p_cost()) == (MEMORY, PASSES, LANES)
    });
    same && hash.algorithm == Algorithm::Argon2id.ident()
        && hash.version == Some(Version::V0x13.into())
        && hash
            .hash
            .is_some_and(|output| output.len() == Params::DEFAULT_OUTPUT_LEN)
}

fn look(
    known: Option<&str>,
    password: &str,
    memory: &mut [Block],
) -> Result<Looked, password_hash::Error> {
    let written = match known {
        Some(written) => written,
        None => nobodys(memory)?,
    };
    let parsed = PasswordHash::new(written)?;
    if let Some(salt) = parsed.salt.filter(|_| is_todays(&parsed)) {
        let computed = compute(password, salt, memory)?;
        // Compared in constant time.
        let is_right = known.is_some() && parsed.hash == Some(computed);
        return Ok(if is_right {
            Looked::Right
        } else {
            Looked::Wrong
        });
    }
    match argon2()?.verify_password(password.as_bytes(), &parsed) {
        Ok(()) => hash(password, memory).map(Looked::Rehashed),
        Err(password_hash::Error::Password) => Ok(Looked::Wrong),
        Err(error) => Err(error),
    }
}

/// Works where nothing waits for it.
async fn work<T: Send + 'static>(
    turn: Turn,
    held: Option<Held>,
    work: impl FnOnce(&mut [Block]) -> Result<T, password_hash::Error> + Send + 'static,
) -> Result<T, Error> {
    let worked = tokio::task::spawn_blocking(move || {
        let blocks = argon2()?.params().block_count();
        let worked = turn.work(blocks, work);
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

impl Passwords {
    /// The hash of a new password.
    pub async fn hash(&self, password: String) -> Result<String, Error> {
        let turn = self.accounts.turn().await?;
        work(turn, None, move |memory| hash(&password, memory)).await
    }

    /// Looks whether a password is that of a hash. Without one it takes as long and is wrong. `before` is asked when it is about to
    /// be looked at.
    pub async fn look(
        &self,
        attempt: Attempt,
        before: impl FnOnce() -> Result<(), Error> + Send,
    ) -> Result<Looked, Error> {
        let held = self.holders.hold(attempt.from, &attempt.name)?;
        let lane = match attempt.known {
            Some(_) => &self.accounts,
            None => &self.made_up,
        };
        let turn = lane.turn().await?;
        before()?;
        let Attempt {
            known, password, ..
        } = attempt;
        let looking = move |memory: &mut [Block]| look(known.as_deref(), &password, memory);
        work(turn, Some(held), looking).await
    }
}

#[cfg(test)]
mod tests;
