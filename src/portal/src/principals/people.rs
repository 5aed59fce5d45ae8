//! People: their accounts and sessions.

use std::sync::atomic::Ordering;

use access::{Glob, Role};
use api::Millis;
use api::people::{Account, AccountChange, NewAccount, SessionLine};
use catalogue::names;
use store::{AccountEdit, NewSession};

use super::Principals;
use super::changing::{NameHolder, RESERVED_PRINCIPALS, SECRET};
use super::identity::CallerIdentity;
use super::stored::{KnownAccount, KnownSession, StoredScope, milliseconds, record_error};
use crate::errors::Error;
use crate::tokens;

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

fn check_role(role: Role, services: &[Glob]) -> Result<(), Error> {
    let refused = |words: String| Err(Error::BadRequest(words));
    if role == Role::Robot {
        return refused(
            "an account cannot have the role robot; create a token for a robot: cloudroidctl token create NAME --role \
                robot"
                .to_owned(),
        );
    }
    match (role.is_scoped(), services.is_empty()) {
        (true, true) => {
            refused(format!("a {role} needs its services; give them with --service, or all with --service '*'"))
        }
        (false, false) => refused(format!("an {role} is for all services; omit --service, or choose another role")),
        _ => Ok(()),
    }
}

pub(super) fn encode_scope(services: &[Glob], name: &str) -> Result<String, store::Error> {
    let scope = StoredScope { services: services.to_vec(), robot: None, classes: Vec::new() };
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
                role: known.principal.first_role(),
                services: known.principal.scope.services.clone(),
                created: record.created,
                last_login: record.last_login,
                disabled: record.disabled,
                sessions: sessions.filter(|session| session.record.account == Some(record.id)).count(),
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
        self.state.rehash_password(candidate.id, &candidate.password, &password)?;
        candidate.password = password;
        Ok(self.reload()?)
    }

    /// Starts a session after the password was verified; `None` if the account has changed meanwhile.
    pub fn begin_session(&self, candidate: &Candidate, peer: &str) -> Result<Option<StartedSession>, Error> {
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
        Ok(Some(StartedSession { secret, identity, expires }))
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
        let good = stored.sessions.values().filter(|known| known.recognise(now, self.lasting).is_ok());
        let mut lines: Vec<SessionLine> = good
            .map(|known| SessionLine {
                id: known.record.id,
                name: known.record.name.clone(),
                role: known.principal.first_role(),
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
        let id = self.stored.read().sessions.get(&hash).map(|known| known.record.id);
        id.map_or(Ok(()), |id| self.end_session(id))
    }

    /// Ends all sessions of a person.
    pub fn end_sessions_of(&self, name: &str) -> Result<(), Error> {
        self.state.end_sessions(name)?;
        Ok(self.reload()?)
    }

    /// Checks a new account.
    pub fn check_account(&self, new: &NewAccount) -> Result<(), Error> {
        access::principal::check_name(&new.name).map_err(|error| Error::BadRequest(error.to_string()))?;
        if RESERVED_PRINCIPALS.contains(&&*new.name) {
            return Err(Error::BadRequest(format!("{} is a reserved name; choose another", new.name)));
        }
        check_role(new.role, &new.services)?;
        self.check_name_is_free(&new.name, NameHolder::Account)
    }

    /// Creates an account with the hash of its password.
    pub fn create_account(&self, new: &NewAccount, password: &str) -> Result<(), Error> {
        self.check_account(new)?;
        let scope = encode_scope(&new.services, &new.name)?;
        let made = self.state.add_account(&new.name, password, new.role.name(), &scope)?;
        self.reload()?;
        if made { Ok(()) } else { Err(Error::AccountExists(new.name.clone())) }
    }

    fn unknown_account(&self, name: &str) -> Error {
        Error::UnknownAccount {
            name: name.to_owned(),
            exists: self.accounts().into_iter().map(|known| known.name).collect(),
        }
    }

    /// Refuses the name of an account that does not exist.
    pub fn check_account_exists(&self, name: &str) -> Result<(), Error> {
        if self.accounts().iter().any(|known| known.name == name) { Ok(()) } else { Err(self.unknown_account(name)) }
    }

    /// Changes an account, including the hash of its password if given. All its sessions end.
    pub fn change_account(&self, name: &str, change: &AccountChange, password: Option<&str>) -> Result<(), Error> {
        self.check_account_exists(name)?;
        if change.role.is_none() && !change.services.is_empty() {
            return Err(Error::BadRequest("services need a role; give the role, too".into()));
        }
        if let Some(role) = change.role {
            check_role(role, &change.services)?;
        }
        let scope = change.role.map(|_| encode_scope(&change.services, name)).transpose()?;
        let is_known = self.state.edit_account(
            name,
            &AccountEdit {
                password,
                role_and_scope: change.role.map(Role::name).zip(scope.as_deref()),
                is_disabled: change.disabled,
            },
        )?;
        self.reload()?;
        if is_known { Ok(()) } else { Err(self.unknown_account(name)) }
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
