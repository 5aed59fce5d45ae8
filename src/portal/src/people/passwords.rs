//! Password hashing with Argon2id (RFC 9106), version 19, 19 MiB, two passes, one lane, the minimum of OWASP's
//! Password Storage Cheat Sheet. Hashes are stored in the PHC string format, which includes the parameters; a hash
//! with other parameters is recomputed when its owner signs in.

use std::net::IpAddr;
use std::sync::OnceLock;

use argon2::password_hash::rand_core::OsRng;
use argon2::password_hash::{self, Output, ParamsString, PasswordHash, Salt, SaltString};
use argon2::{Algorithm, Argon2, Block, Params, PasswordVerifier, Version};

use super::lanes::{HashLane, HashSlot, HashSlots, HashTurn};
use crate::errors::Error;

/// Memory in KiB, passes and lanes.
const MEMORY: u32 = 19 * 1024;
const PASSES: u32 = 2;
const LANES: u32 = 1;
/// Limits on parallel hashes, for accounts and for unknown names, and on requests waiting in each of the two lanes;
/// they bound what sign-ins take of the machine.
const AT_ONCE: usize = 2;
const AT_ONCE_IN_VAIN: usize = 1;
const WAITING: usize = 32;
/// Minimum length of a password in characters and maximum length in bytes.
const SHORTEST: usize = 12;
pub const LONGEST: usize = 1024;
/// Common passwords of sufficient length, in lower case.
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

/// Reason why a password may not be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PasswordError {
    /// The password is too long.
    #[error("a password has at most {LONGEST} bytes")]
    TooLong,
    /// The password is too short.
    #[error("a password has at least {SHORTEST} characters; four unrelated words make a good one")]
    TooShort,
    /// The password is common, or made of its owner's name or of one character.
    #[error("this password is too easy to guess; choose another")]
    Obvious,
}

impl From<PasswordError> for Error {
    fn from(error: PasswordError) -> Error {
        Error::BadRequest(error.to_string())
    }
}

/// Refuses a password that is easy to guess.
pub fn check_strength(name: &str, password: &str) -> Result<(), PasswordError> {
    if password.len() > LONGEST {
        return Err(PasswordError::TooLong);
    }
    if password.chars().count() < SHORTEST {
        return Err(PasswordError::TooShort);
    }
    let plain = password.to_lowercase();
    let mut characters = plain.chars();
    let first = characters.next();
    let is_of_one = characters.all(|other| Some(other) == first);
    let without_name = plain.replace(&name.to_lowercase(), "");
    if is_of_one || without_name.chars().count() < SHORTEST / 2 || OBVIOUS.contains(&&*plain) {
        return Err(PasswordError::Obvious);
    }
    Ok(())
}

/// Result of verifying a password.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PasswordVerdict {
    /// The password is wrong.
    Wrong,
    /// The password is right.
    Right,
    /// The password is right; here is its hash with the current parameters.
    Rehashed(String),
}

/// Hashes passwords, a few at once, on threads where they block nothing else.
pub struct Passwords {
    /// Lane of existing accounts, and of accounts being created.
    accounts: HashLane,
    /// Lane of unknown names.
    made_up: HashLane,
    holders: HashSlots,
}

impl Default for Passwords {
    fn default() -> Self {
        Passwords {
            accounts: HashLane::new(AT_ONCE, WAITING),
            made_up: HashLane::new(AT_ONCE_IN_VAIN, WAITING),
            holders: HashSlots::default(),
        }
    }
}

/// A password to verify.
pub struct Attempt {
    /// Address of the client.
    pub from: IpAddr,
    /// Name of the account, which need not exist.
    pub name: String,
    /// Hash of the account's password; `None` if there is no such account.
    pub known: Option<String>,
    /// The password.
    pub password: String,
}

fn argon2() -> Result<Argon2<'static>, password_hash::Error> {
    let params = Params::new(MEMORY, PASSES, LANES, None)?;
    Ok(Argon2::new(Algorithm::Argon2id, Version::V0x13, params))
}

/// Computes the hash of a password and a salt with the current parameters.
fn compute(password: &str, salt: Salt<'_>, memory: &mut [Block]) -> Result<Output, password_hash::Error> {
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

/// Returns the hash of an unknown password, so that verifying takes as long as for an account.
fn dummy_hash(memory: &mut [Block]) -> Result<&'static str, password_hash::Error> {
    static HASH: OnceLock<Result<String, password_hash::Error>> = OnceLock::new();
    let made = HASH.get_or_init(|| hash(&catalogue::names::random(32), memory));
    made.as_deref().map_err(|error| *error)
}

fn has_current_parameters(hash: &PasswordHash<'_>) -> bool {
    let params = Params::try_from(hash).ok();
    let same =
        params.is_some_and(|params| (params.m_cost(), params.t_cost(), params.p_cost()) == (MEMORY, PASSES, LANES));
    same && hash.algorithm == Algorithm::Argon2id.ident()
        && hash.version == Some(Version::V0x13.into())
        && hash.hash.is_some_and(|output| output.len() == Params::DEFAULT_OUTPUT_LEN)
}

fn verify(known: Option<&str>, password: &str, memory: &mut [Block]) -> Result<PasswordVerdict, password_hash::Error> {
    let written = match known {
        Some(written) => written,
        None => dummy_hash(memory)?,
    };
    let parsed = PasswordHash::new(written)?;
    if let Some(salt) = parsed.salt.filter(|_| has_current_parameters(&parsed)) {
        let computed = compute(password, salt, memory)?;
        // Compared in constant time.
        let is_right = known.is_some() && parsed.hash == Some(computed);
        return Ok(if is_right { PasswordVerdict::Right } else { PasswordVerdict::Wrong });
    }
    match argon2()?.verify_password(password.as_bytes(), &parsed) {
        Ok(()) => hash(password, memory).map(PasswordVerdict::Rehashed),
        Err(password_hash::Error::Password) => Ok(PasswordVerdict::Wrong),
        Err(error) => Err(error),
    }
}

/// Runs the hash on a blocking thread.
async fn run_hashing<T: Send + 'static>(
    turn: HashTurn,
    held: Option<HashSlot>,
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
    /// Hashes a new password.
    pub async fn hash(&self, password: String) -> Result<String, Error> {
        let turn = self.accounts.acquire().await?;
        run_hashing(turn, None, move |memory| hash(&password, memory)).await
    }

    /// Verifies a password against the hash of its account. Without an account it takes as long and fails. `before`
    /// is checked immediately before the computation.
    pub async fn verify(
        &self,
        attempt: Attempt,
        before: impl FnOnce() -> Result<(), Error> + Send,
    ) -> Result<PasswordVerdict, Error> {
        let held = self.holders.acquire(attempt.from, &attempt.name)?;
        let lane = match attempt.known {
            Some(_) => &self.accounts,
            None => &self.made_up,
        };
        let turn = lane.acquire().await?;
        before()?;
        let Attempt { known, password, .. } = attempt;
        let looking = move |memory: &mut [Block]| verify(known.as_deref(), &password, memory);
        run_hashing(turn, Some(held), looking).await
    }
}

#[cfg(test)]
mod tests;
