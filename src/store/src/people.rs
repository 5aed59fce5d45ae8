//! User accounts with passwords, and sessions of the web page. Only hashes of passwords and session tokens are stored.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, TokenHash, now};

/// A user account.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccountRecord {
    /// Row number; never reused.
    pub id: i64,
    /// Name of the user.
    pub name: String,
    /// Hash of the password, in the PHC string format.
    pub password: String,
    /// Role of the user, as encoded by the portal.
    pub role: String,
    /// Scope of the user, as encoded by the portal.
    pub scope: String,
    /// Creation time in milliseconds since 1970, as all times here.
    pub created: u64,
    /// Last sign-in.
    pub last_login: Option<u64>,
    /// Time when sign-in was disabled.
    pub disabled: Option<u64>,
    /// Time when the account was removed.
    pub removed: Option<u64>,
}

/// A session of the web page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionRecord {
    /// Row number; never reused.
    pub id: i64,
    /// SHA-256 of the session token.
    pub hash: TokenHash,
    /// Account of the session; absent if the user was authenticated by an identity provider.
    pub account: Option<i64>,
    /// Name of the user.
    pub name: String,
    /// Role of the user.
    pub role: String,
    /// Scope of the user.
    pub scope: String,
    /// Origin of the session.
    pub peer: String,
    /// Time when the session began.
    pub created: u64,
    /// Last use, to the minute.
    pub last_used: u64,
    /// Latest time at which the session ends.
    pub expires: u64,
    /// Federated person, if authenticated by an identity provider.
    pub person: Option<i64>,
    /// Groups of the person that the configuration named when the session began, as JSON.
    pub groups: Option<String>,
}

/// Changes to an account. Absent fields stay unchanged.
#[derive(Debug, Clone, Copy, Default)]
pub struct AccountEdit<'a> {
    /// Hash of the new password, in the PHC string format.
    pub password: Option<&'a str>,
    /// New role and scope.
    pub role_and_scope: Option<(&'a str, &'a str)>,
    /// True to disable sign-in, false to enable it.
    pub is_disabled: Option<bool>,
}

/// A session to create.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewSession<'a> {
    /// SHA-256 of the session token.
    pub hash: &'a str,
    /// Account of the session.
    pub account: Option<i64>,
    /// Name of the user.
    pub name: &'a str,
    /// Role of the user.
    pub role: &'a str,
    /// Scope of the user.
    pub scope: &'a str,
    /// Origin of the session.
    pub peer: &'a str,
    /// Latest time at which the session ends.
    pub expires: u64,
    /// Federated person, with those of its groups that the configuration names, as JSON.
    pub person: Option<(i64, &'a str)>,
}

/// Maximum number of sessions per user; the oldest are ended first.
const MOST_SESSIONS: u32 = 32;

const ACCOUNT: &str = "id, name, password, role, scope, created, last_login, disabled, removed";
const SESSION: &str = "id, hash, account, name, role, scope, peer, created, last_used, expires, person, groups";

fn read_account(row: &Row<'_>) -> rusqlite::Result<AccountRecord> {
    Ok(AccountRecord {
        id: row.get(0)?,
        name: row.get(1)?,
        password: row.get(2)?,
        role: row.get(3)?,
        scope: row.get(4)?,
        created: row.get(5)?,
        last_login: row.get(6)?,
        disabled: row.get(7)?,
        removed: row.get(8)?,
    })
}

fn read_session(row: &Row<'_>) -> rusqlite::Result<SessionRecord> {
    Ok(SessionRecord {
        id: row.get(0)?,
        hash: row.get(1)?,
        account: row.get(2)?,
        name: row.get(3)?,
        role: row.get(4)?,
        scope: row.get(5)?,
        peer: row.get(6)?,
        created: row.get(7)?,
        last_used: row.get(8)?,
        expires: row.get(9)?,
        person: row.get(10)?,
        groups: row.get(11)?,
    })
}

impl State {
    /// Returns all accounts, including removed ones, oldest first.
    pub fn accounts(&self) -> Result<Vec<AccountRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {ACCOUNT} FROM accounts ORDER BY id"))?
                .query_map([], read_account)?
                .collect()
        })
    }

    /// Creates an account durably; returns false if the name is taken.
    pub fn add_account(&self, name: &str, password: &str, role: &str, scope: &str) -> Result<bool, Error> {
        self.write_durably(|connection| {
            connection.execute(
                "INSERT INTO accounts (name, password, role, scope, created) VALUES (?1, ?2, ?3, ?4, ?5)
                 ON CONFLICT (name) WHERE removed IS NULL DO NOTHING",
                params![name, password, role, scope, now() as i64],
            )
        })
        .map(|changed| changed > 0)
    }

    /// Changes an account and ends all its sessions, both or neither; returns false if there is no such account.
    fn change_account(
        &self,
        name: &str,
        change: impl FnOnce(&rusqlite::Transaction<'_>, i64) -> rusqlite::Result<usize>,
    ) -> Result<bool, Error> {
        self.write_durably(|transaction| {
            let id: Option<i64> = transaction
                .prepare_cached("SELECT id FROM accounts WHERE name = ?1 AND removed IS NULL")?
                .query_row([name], |row| row.get(0))
                .optional()?;
            let Some(id) = id else {
                return Ok(false);
            };
            change(transaction, id)?;
            transaction.execute("DELETE FROM sessions WHERE account = ?1", [id])?;
            Ok(true)
        })
    }

    /// Applies `edit` to an account and ends all its sessions; returns false if there is no such account.
    pub fn edit_account(&self, name: &str, edit: &AccountEdit<'_>) -> Result<bool, Error> {
        let (role, scope) = edit.role_and_scope.unzip();
        let disabled = edit.is_disabled.map(|is_disabled| is_disabled.then(now));
        self.change_account(name, |transaction, id| {
            transaction.execute(
                "UPDATE accounts SET password = COALESCE(?2, password), role = COALESCE(?3, role),
                 scope = COALESCE(?4, scope), disabled = CASE WHEN ?5 THEN ?6 ELSE disabled END WHERE id = ?1",
                params![id, edit.password, role, scope, disabled.is_some(), disabled.flatten()],
            )
        })
    }

    /// Replaces the hash of an unchanged password; sessions are kept.
    pub fn rehash_password(&self, id: i64, before: &str, password: &str) -> Result<(), Error> {
        self.write(|connection| {
            connection.execute(
                "UPDATE accounts SET password = ?3 WHERE id = ?1 AND password = ?2",
                params![id, before, password],
            )
        })
        .map(|_| ())
    }

    /// Removes an account. A record of it is kept, without its password.
    pub fn remove_account(&self, name: &str) -> Result<bool, Error> {
        self.change_account(name, |transaction, id| {
            transaction
                .execute("UPDATE accounts SET removed = ?2, password = '' WHERE id = ?1", params![id, now() as i64])
        })
    }

    /// Returns all sessions.
    pub fn sessions(&self) -> Result<Vec<SessionRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {SESSION} FROM sessions ORDER BY id"))?
                .query_map([], read_session)?
                .collect()
        })
    }

    /// Creates a session and deletes expired ones. Returns `None` if the account has changed since its password was
    /// checked; `password` is the hash that was checked.
    pub fn add_session(&self, new: &NewSession<'_>, password: Option<&str>) -> Result<Option<SessionRecord>, Error> {
        let at = now() as i64;
        self.write_durably(|transaction| {
            let good = match new.account {
                None => true,
                // The password may have been changed, or the account disabled, while it was hashed.
                Some(id) => transaction
                    .prepare_cached(
                        "SELECT 1 FROM accounts WHERE id = ?1 AND password = ?2 AND role = ?3 AND scope = ?4
                         AND disabled IS NULL AND removed IS NULL",
                    )?
                    .exists(params![id, password, new.role, new.scope])?,
            };
            if !good {
                return Ok(None);
            }
            transaction.execute("DELETE FROM sessions WHERE expires <= ?1", [at])?;
            let made = transaction
                .prepare_cached(&format!(
                    "INSERT INTO sessions (hash, account, name, role, scope, peer, created, last_used, expires, \
                     person, groups)
                     VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?7, ?8, ?9, ?10) RETURNING {SESSION}"
                ))?
                .query_row(
                    params![
                        new.hash,
                        new.account,
                        new.name,
                        new.role,
                        new.scope,
                        new.peer,
                        at,
                        new.expires,
                        new.person.map(|(id, _)| id),
                        new.person.map(|(_, groups)| groups),
                    ],
                    read_session,
                )?;
            transaction.execute(
                "DELETE FROM sessions WHERE name = ?1 AND id NOT IN
                 (SELECT id FROM sessions WHERE name = ?1 ORDER BY id DESC LIMIT ?2)",
                params![new.name, MOST_SESSIONS],
            )?;
            if let Some(id) = new.account {
                transaction.execute("UPDATE accounts SET last_login = ?2 WHERE id = ?1", params![id, at])?;
            }
            Ok(Some(made))
        })
    }

    /// Records the use of a session.
    pub fn record_session_use(&self, id: i64, at: u64) -> Result<(), Error> {
        self.write(|connection| connection.execute("UPDATE sessions SET last_used = ?2 WHERE id = ?1", params![id, at]))
            .map(|_| ())
    }

    /// Ends a session; returns false if it does not exist.
    pub fn end_session(&self, id: i64) -> Result<bool, Error> {
        self.write_durably(|connection| connection.execute("DELETE FROM sessions WHERE id = ?1", [id]))
            .map(|ended| ended > 0)
    }

    /// Ends all sessions of a user; returns their number.
    pub fn end_sessions(&self, name: &str) -> Result<usize, Error> {
        self.write_durably(|connection| connection.execute("DELETE FROM sessions WHERE name = ?1", [name]))
    }
}

#[cfg(test)]
mod tests;
