//! Changes of tokens and rules, made in the database first.

use std::sync::atomic::Ordering;

use access::Role;
use catalogue::names;
use store::NewToken;

use super::Principals;
use super::stored::{KnownToken, StoredPrincipals, StoredScope, read_token, record_error};
use crate::errors::Error;
use crate::tokens;

/// Length of a token in characters out of 36 letters and digits: 268 bits.
pub(super) const SECRET: usize = 52;
/// Names of principals that are known without a token.
pub(super) const RESERVED_PRINCIPALS: [&str; 3] = ["local", "root", "configured"];

/// Holder of a principal's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NameHolder<'a> {
    Account,
    Token {
        /// The robot of the token, if it is a robot's.
        robot: Option<&'a str>,
    },
    Pairing,
}

impl Principals {
    /// Reloads the database and notifies followers.
    pub(super) fn reload(&self) -> Result<(), store::Error> {
        // Loads under the lock: of two concurrent changes, the one loaded last includes both.
        let mut stored = self.stored.write();
        let mut fresh = StoredPrincipals::load(&self.state)?;
        fresh.names_provider |= stored.names_provider;
        // Keeps uses that are not written yet.
        for known in &fresh.tokens {
            if let Some(before) = stored.find_token(known.id) {
                known.last_used.fetch_max(before.last_used.load(Ordering::Relaxed), Ordering::Relaxed);
            }
        }
        fresh.keep_uses(&stored);
        for known in fresh.sessions.values() {
            if let Some(before) = stored.find_session(known.record.id) {
                let last = before.last_used.load(Ordering::Relaxed);
                known.last_used.fetch_max(last, Ordering::Relaxed);
                let written = before.written.load(Ordering::Relaxed);
                known.written.fetch_max(written, Ordering::Relaxed);
            }
        }
        *stored = fresh;
        drop(stored);
        self.changed.send_modify(|number| *number += 1);
        Ok(())
    }

    /// Returns all tokens, including revoked ones.
    pub fn tokens(&self) -> Vec<api::access::Token> {
        self.stored.read().tokens.iter().map(KnownToken::to_api_token).collect()
    }

    fn live_token(&self, name: &str) -> Result<api::access::Token, Error> {
        let tokens = self.tokens();
        let of_name = tokens.into_iter().find(|token| token.name == name && token.revoked.is_none());
        of_name.ok_or(Error::Internal("reading a token back"))
    }

    fn unknown_token(&self, name: &str) -> Error {
        let live = self.tokens().into_iter().filter(|token| token.revoked.is_none());
        Error::UnknownToken { name: name.to_owned(), exists: live.map(|token| token.name).collect() }
    }

    /// Refuses a name held by another kind of principal, because rules and records identify all of them by name. A
    /// robot's token may have the robot's name.
    pub(super) fn check_name_is_free(&self, name: &str, of: NameHolder<'_>) -> Result<(), Error> {
        if of != NameHolder::Account && self.has_account(name) {
            return Err(Error::AccountExists(name.to_owned()));
        }
        let is_robots = |robot: Option<&str>| robot == Some(name);
        let is_others = match of {
            NameHolder::Account => true,
            NameHolder::Token { robot } => !is_robots(robot),
            NameHolder::Pairing => false,
        };
        if is_others && self.pairings()?.iter().any(|pairing| pairing.robot == name) {
            return Err(Error::PairingExists(name.to_owned()));
        }
        let stored = self.stored.read();
        let mut live = stored.tokens.iter().filter(|known| known.revoked.is_none());
        let token = live.find(|known| known.principal.name == name);
        let is_others = token.is_some_and(|token| match of {
            NameHolder::Account => true,
            // Duplicate tokens are detected when the token is created.
            NameHolder::Token { .. } => false,
            NameHolder::Pairing => !is_robots(token.principal.scope.robot.as_deref()),
        });
        if is_others {
            return Err(Error::TokenExists(name.to_owned()));
        }
        Ok(())
    }

    /// Creates a token. Its secret is returned only here.
    pub fn create_token(&self, new: &api::access::NewToken) -> Result<api::access::Secret, Error> {
        check_token(new)?;
        let robot = new.robot.as_deref();
        self.check_name_is_free(&new.name, NameHolder::Token { robot })?;
        let end = |seconds: u64| {
            let end = seconds.checked_mul(1000).and_then(|length| length.checked_add(store::now()));
            end.filter(|end| i64::try_from(*end).is_ok()).ok_or_else(|| {
                Error::BadRequest("the lifetime is too long; omit it for a token that never expires".into())
            })
        };
        let expires = new.lifetime.map(end).transpose()?;
        let secret = names::random(SECRET);
        let scope =
            StoredScope { services: new.services.clone(), robot: new.robot.clone(), classes: new.classes.clone() };
        let scope = serde_json::to_string(&scope).map_err(record_error(format!("token {}", new.name)))?;
        let record = self.state.add_token(&NewToken {
            name: &new.name,
            hash: &tokens::hash(&secret),
            role: new.role.name(),
            scope: &scope,
            expires,
        })?;
        let known = record.map(read_token).transpose()?.ok_or_else(|| Error::TokenExists(new.name.clone()))?;
        if let Some(robot) = &new.robot {
            self.state.bind_robot(robot, &known.owner())?;
        }
        self.reload()?;
        Ok(api::access::Secret { token: known.to_api_token(), secret })
    }

    /// Replaces the secret of a token; connections using the old one end.
    pub fn rotate_token(&self, name: &str) -> Result<api::access::Secret, Error> {
        let secret = names::random(SECRET);
        let rotated = self.state.rotate_token(name, &tokens::hash(&secret))?;
        rotated.ok_or_else(|| self.unknown_token(name))?;
        self.reload()?;
        Ok(api::access::Secret { token: self.live_token(name)?, secret })
    }

    /// Revokes a token; connections using it end.
    pub fn revoke_token(&self, name: &str) -> Result<(), Error> {
        self.state.revoke_token(name)?.ok_or_else(|| self.unknown_token(name))?;
        self.reload()?;
        Ok(self.release_robots()?)
    }

    /// Returns all rules.
    pub fn rules(&self) -> Vec<api::access::Rule> {
        let stored = self.stored.read();
        let rules = stored.rules.iter();
        rules
            .map(|(id, rule)| api::access::Rule {
                id: *id,
                who: rule.who.clone(),
                services: rule.services.clone(),
                allow: rule.allow.clone(),
            })
            .collect()
    }

    /// Adds a rule.
    pub fn add_rule(&self, new: &api::access::NewRule) -> Result<(), Error> {
        if self.stored.read().rules.len() >= MOST_RULES {
            return Err(Error::BadRequest(format!(
                "there are already {MOST_RULES} rules, which is the limit; remove some with: cloudroidctl policy rm \
                    NUMBER"
            )));
        }
        let allow = serde_json::to_string(&new.allow).map_err(record_error("a rule".to_owned()))?;
        self.state.add_rule(&new.who.to_string(), new.services.as_str(), &allow)?;
        Ok(self.reload()?)
    }

    /// Removes a rule; returns false if there is none with this id.
    pub fn remove_rule(&self, id: i64) -> Result<bool, Error> {
        let removed = self.state.remove_rule(id)?;
        self.reload()?;
        Ok(removed.is_some())
    }
}

/// Limit on the rules of the policy, because each connection checks all of them.
const MOST_RULES: usize = 1000;

/// Checks a new token.
fn check_token(new: &api::access::NewToken) -> Result<(), Error> {
    let refused = |words: String| Err(Error::BadRequest(words));
    access::principal::check_name(&new.name).map_err(|error| Error::BadRequest(error.to_string()))?;
    if RESERVED_PRINCIPALS.contains(&new.name.as_str()) {
        return refused(format!("{} is a reserved name; choose another", new.name));
    }
    let (role, scoped) = (new.role, new.role.is_scoped());
    if scoped && new.services.is_empty() {
        return refused(format!("a {role} needs its services; give them with --service, or all with --service '*'"));
    }
    let names_some = !new.services.is_empty() || !new.classes.is_empty();
    if !scoped && names_some {
        return refused(format!(
            "an {role} is for all services and classes; omit --service and --class, or choose another role"
        ));
    }
    match (&new.robot, role) {
        (Some(robot), Role::Robot) => {
            names::validate_robot(robot).map_err(|error| Error::BadRequest(error.to_string()))?
        }
        (None, Role::Robot) => {
            return refused("a robot's token is for one robot; give it with --robot".to_owned());
        }
        (Some(_), role) => {
            return refused(format!("--robot is only for tokens of robots, but this one is for a {role}"));
        }
        (None, _) => {}
    }
    match new.lifetime {
        Some(0) => refused("a token that expires at once is useless; give it a longer lifetime".to_owned()),
        _ => Ok(()),
    }
}
