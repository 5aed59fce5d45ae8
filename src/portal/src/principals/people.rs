//! People: their accounts and sessions.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use access::{Glob, Principal, Role};
use api::Millis;
use api::people::{Account, AccountChange, NewAccount, SessionLine};
use catalogue::names;
use store::{AccountEdit, AccountRecord, NewSession, Owner, SessionRecord};

use super::changing::{NameHolder, RESERVED, SECRET};
use super::stored::{StoredScope, read_principal, record_error};
use super::{AuthenticationError, CallerIdentity, Credential, Principals};
use crate::errors::Error;
use crate::tokens;

/// Lifetimes of sessions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SessionLifetimes {
    /// Maximum lifetime.
    pub most: Duration,
    /// Maximum time without a request.
    pub idle: Duration,
}

impl Default for SessionLifetimes {
    fn default() -> Self {
        SessionLifetimes {
            most: Duration::from_secs(12 * 3600),
            idle: Duration::from_secs(3600),
        }
    }
}

pub(super) fn milliseconds(time: Duration) -> Millis {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

/// Returns the owner of robot names used by a person.
fn person_owner(name: &str) -> Owner {
    format!("person:{name}")
}

/// An account, in memory.
pub struct KnownAccount {
    pub(super) record: AccountRecord,
    pub(super) principal: Arc<Principal>,
}

impl KnownAccount {
    pub(super) fn read(record: AccountRecord) -> Result<KnownAccount, store::Error> {
        let principal = read_principal(&record.name, &record.role, &record.scope, "account")?;
        Ok(KnownAccount {
            principal: Arc::new(principal),
            record,
        })
    }

    pub(super) fn is_live(&self) -> bool {
        self.record.removed.is_none()
    }

    pub(super) fn owner(&self) -> Owner {
        person_owner(&self.record.name)
    }
}

/// A session, in memory.
pub struct KnownSession {
    pub(super) record: SessionRecord,
    pub(super) principal: Arc<Principal>,
    pub(super) last_used: AtomicU64,
    /// Value of `last_used` when it was last written.
    pub(super) written: AtomicU64,
}

impl KnownSession {
    pub(super) fn read(record: SessionRecord) -> Result<KnownSession, store::Error> {
        let principal = read_principal(&record.name, &record.role, &record.scope, "session")?;
        Ok(KnownSession {
            principal: Arc::new(principal),
            last_used: AtomicU64::new(record.last_used),
            written: AtomicU64::new(record.last_used),
            record,
        })
    }

    pub(super) fn owner(&self) -> Owner {
        person_owner(&self.record.name)
    }

    pub(super) fn recognise(
        &self,
        now: Millis,
        lasting: SessionLifetimes,
    ) -> Result<CallerIdentity, AuthenticationError> {
        let last = self.last_used.load(Ordering::Relaxed);
        let idle = last.saturating_add(milliseconds(lasting.idle));
        if self.record.expires.min(idle) <= now {
            return Err(AuthenticationError::SessionOver);
        }
        Ok(CallerIdentity {
            principal: Arc::clone(&self.principal),
            shown: Credential::Session { id: self.record.id },
            token: None,
            owner: Some(self.owner()),
        })
    }
}

/// A session that was just started.
pub struct StartedSession {
    /// Secret for the browser's cookie; it is not stored.
    pub secret: String,
    /// Identity of the person.
    pub identity: CallerIdentity,
    /// Time when the session ends at the latest.
    pub expires: Millis,
}

/// An account whose password is to be verified.
#[derive(Clone)]
pub struct Candidate {
    id: i64,
    name: String,
    /// Hash of the password.
    pub password: String,
    role: String,
    scope: String,
}

fn check_role(role: Role, services: &[Glob]) -> Result<(), String> {
    if role == Role::Robot {
        return Err("an account cannot have the role robot; create a token for a robot: cloudroidctl token create NAME \
            --role robot".into());
    }
    match (role.is_scoped(), services.is_empty()) {
        (true, true) => Err(format!(
            "a {role} needs its services; give them with --service, or all with --service '*'"
        )),
        (false, false) => Err(format!(
            "an {role} is for all services; omit --service, or choose another role"
        )),
        _ => Ok(()),
    }
}

pub(super) fn encode_scope(services: &[Glob], name: &str) -> Result<String, store::Error> {
    let scope = StoredScope {
        services: services.to_vec(),
        robot: None,
        classes: Vec::new(),
    };
    serde_json::to_string(&scope).map_err(record_error(format!("account {name}")))
}

impl Principals {
    /// Returns true if any account exists.
    pub fn has_accounts(&self) -> bool {
        let stored = self.stored.read();
        stored.accounts.iter().any(KnownAccount::is_live)
    }

    /// Returns true if an account of this name exists.
    pub(super) fn has_account(&self, name: &str) -> bool {
        let stored = self.stored.read();
        let mut live = stored.accounts.iter().filter(|known| known.is_live());
        live.any(|known| known.record.name == name)
    }

    /// Returns all existing accounts.
    pub fn accounts(&self) -> Vec<Account> {
        let stored = self.stored.read();
        let live = stored.accounts.iter().filter(|known| known.is_live());
        live.map(|known| {
            let record = &known.record;
            let sessions = stored.sessions.values();
            Account {
                name: record.name.clone(),
                role: known
                    .principal
                    .roles
                    .first()
                    .copied()
                    .unwrap_or(Role::Viewer),
                services: known.principal.scope.services.clone(),
                created: record.created,
                last_login: record.last_login,
                disabled: record.disabled,
                sessions: sessions
                    .filter(|session| session.record.account == Some(record.id))
                    .count(),
            }
        })
        .collect()
    }

    /// Returns the account with which a person may sign in.
    pub fn candidate(&self, name: &str) -> Option<Candidate> {
        let stored = self.stored.read();
        let mut live = stored.accounts.iter().filter(|known| known.is_live());
        let record = &live.find(|known| known.record.name == name)?.record;
        record.disabled.is_none().then(|| Candidate {
            id: record.id,
            name: record.name.clone(),
            password: record.password.clone(),
            role: record.role.clone(),
            scope: record.scope.clone(),
        })
    }

    /// Stores a new hash of the same password.
    pub fn rehash(&self, candidate: &mut Candidate, password: String) -> Result<(), Error> {
        self.state
            .rehash_password(candidate.id, &candidate.password, &password)?;
        candidate.password = password;
        Ok(self.reload()?)
    }

    /// Starts a session after the password was verified; `None` if the account has changed meanwhile.
    pub fn begin_session(
        &self,
        candidate: &Candidate,
        peer: &str,
    ) -> Result<Option<StartedSession>, Error> {
        let secret = names::random(SECRET);
        let hash = tokens::hash(&secret);
        let made = self.state.add_session(
            &NewSession {
                hash: &hash,
                account: Some(candidate.id),
                name: &candidate.name,
                role: &candidate.role,
                scope: &candidate.scope,
                peer,
                expires: store::now().saturating_add(milliseconds(self.lasting.most)),
                person: None,
            },
            Some(&candidate.password),
        )?;
        let Some(made) = made else {
            return Ok(None);
        };
        self.reload()?;
        let expires = made.expires;
        let identity = KnownSession::read(made)?.recognise(store::now(), self.lasting)?;
        Ok(Some(StartedSession {
            secret,
            identity,
            expires,
        }))
    }

    /// Returns when a session ends at the latest.
    pub fn session_end(&self, id: i64) -> Option<Millis> {
        let stored = self.stored.read();
        stored.find_session(id).map(|known| known.record.expires)
    }

    /// Returns all active sessions.
    pub fn sessions(&self) -> Vec<SessionLine> {
        let now = store::now();
        let stored = self.stored.read();
        let good = stored
            .sessions
            .values()
            .filter(|known| known.recognise(now, self.lasting).is_ok());
        let mut lines: Vec<SessionLine> = good
            .map(|known| SessionLine {
                id: known.record.id,
                name: known.record.name.clone(),
                role: known
                    .principal
                    .roles
                    .first()
                    .copied()
                    .unwrap_or(Role::Viewer),
                from: known.record.peer.clone(),
                created: known.record.created,
                last_used: known.last_used.load(Ordering::Relaxed),
                expires: known.record.expires,
            })
            .collect();
        lines.sort_by_key(|line| line.id);
        lines
    }

    /// Ends a session and the connections started with it.
    pub fn end_session(&self, id: i64) -> Result<(), Error> {
        self.state.end_session(id)?;
        Ok(self.reload()?)
    }

    /// Ends the session with this secret, if there is one.
    pub fn end_session_by_secret(&self, secret: &str) -> Result<(), Error> {
        let hash = tokens::hash(secret);
        let id = self
            .stored
            .read()
            .sessions
            .get(&hash)
            .map(|known| known.record.id);
        id.map_or(Ok(()), |id| self.end_session(id))
    }

    /// Ends all sessions of a person.
    pub fn end_sessions_of(&self, name: &str) -> Result<(), Error> {
        self.state.end_sessions(name)?;
        Ok(self.reload()?)
    }

    /// Checks a new account.
    pub fn check_account(&self, new: &NewAccount) -> Result<(), Error> {
        access::principal::check_name(&new.name)
            .map_err(|error| Error::BadRequest(error.to_string()))?;
        if RESERVED.contains(&&*new.name) {
            return Err(Error::BadRequest(format!(
                "{} is a reserved name; choose another",
                new.name
            )));
        }
        check_role(new.role, &new.services).map_err(Error::BadRequest)?;
        self.check_name_is_free(&new.name, NameHolder::Account)
    }

    /// Creates an account with the hash of its password.
    pub fn create_account(&self, new: &NewAccount, password: &str) -> Result<(), Error> {
        self.check_account(new)?;
        let scope = encode_scope(&new.services, &new.name)?;
        let made = self
            .state
            .add_account(&new.name, password, new.role.name(), &scope)?;
        self.reload()?;
        if made {
            Ok(())
        } else {
            Err(Error::AccountExists(new.name.clone()))
        }
    }

    fn unknown_account(&self, name: &str) -> Error {
        Error::UnknownAccount {
            name: name.to_owned(),
            exists: self
                .accounts()
                .into_iter()
                .map(|known| known.name)
                .collect(),
        }
    }

    /// Refuses the name of an account that does not exist.
    pub fn check_account_exists(&self, name: &str) -> Result<(), Error> {
        if self.accounts().iter().any(|known| known.name == name) {
            Ok(())
        } else {
            Err(self.unknown_account(name))
        }
    }

    /// Changes an account, including the hash of its password if given. All its sessions end.
    pub fn change_account(
        &self,
        name: &str,
        change: &AccountChange,
        password: Option<&str>,
    ) -> Result<(), Error> {
        self.check_account_exists(name)?;
        if change.role.is_none() && !change.services.is_empty() {
            return Err(Error::BadRequest(
                "services need a role; give the role, too".into(),
            ));
        }
        if let Some(role) = change.role {
            check_role(role, &change.services).map_err(Error::BadRequest)?;
        }
        let scope = change
            .role
            .map(|_| encode_scope(&change.services, name))
            .transpose()?;
        let is_known = self.state.edit_account(
            name,
            &AccountEdit {
                password,
                role_and_scope: change.role.map(Role::name).zip(scope.as_deref()),
                is_disabled: change.disabled,
            },
        )?;
        self.reload()?;
        if is_known {
            Ok(())
        } else {
            Err(self.unknown_account(name))
        }
    }

    /// Removes an account.
    pub fn remove_account(&self, name: &str) -> Result<(), Error> {
        let removed = self.state.remove_account(name)?;
        self.reload()?;
        if !removed {
            return Err(self.unknown_account(name));
        }
        Ok(self.release_robots()?)
    }
}

#[cfg(test)]
mod tests;
