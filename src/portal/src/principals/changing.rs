//! Changing who may do what: tokens and rules, in the database first.

use std::sync::atomic::Ordering;

use access::Role;
use catalogue::names;
use store::NewToken;

use super::Principals;
use super::stored::{Known, Stored, StoredScope, damaged, read_token};
use crate::errors::Error;
use crate::tokens;

/// Characters of a token: of 36 letters and digits each, that is 268 bits.
pub(super) const SECRET: usize = 52;
/// Names of principals that are known without a token.
pub(super) const RESERVED: [&str; 3] = ["local", "root", "configured"];

/// What somebody is that is given a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Named<'a> {
    Account,
    Token {
        /// The robot whose it is, if it is a robot's.
        robot: Option<&'a str>,
    },
    Pairing,
}

impl Principals {
    /// Reads the database again, and tells whoever follows.
    pub(super) fn reload(&self) -> Result<(), store::Error> {
        // Read under the lock: of two changes, the one that is read last holds both.
        let mut stored = self.stored.write();
        let mut fresh = Stored::read(&self.state)?;
        fresh.names_provider |= stored.names_provider;
        // Not yet written ones, too.
        for known in &fresh.tokens {
            if let Some(before) = stored.of_id(known.id) {
                known
                    .last_used
                    .fetch_max(before.last_used.load(Ordering::Relaxed), Ordering::Relaxed);
            }
        }
        fresh.keep_uses(&stored);
        for known in fresh.sessions.values() {
            if let Some(before) = stored.session_of_id(known.record.id) {
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

    /// All tokens there ever were.
    pub fn tokens(&self) -> Vec<api::access::Token> {
        self.stored.read().tokens.iter().map(Known::view).collect()
    }

    fn live(&self, name: &str) -> Result<api::access::Token, Error> {
        let tokens = self.tokens();
        let of_name = tokens
            .into_iter()
            .find(|token| token.name == name && token.revoked.is_none());
        of_name.ok_or(Error::Internal("reading a token back"))
    }

    fn unknown(&self, name: &str) -> Error {
        let live = self
            .tokens()
            .into_iter()
            .filter(|token| token.revoked.is_none());
        Error::UnknownToken {
            name: name.to_owned(),
            exists: live.map(|token| token.name).collect(),
        }
    }

    /// Refuses a name that somebody of another kind has: rules and records know all of them by their names. A robot's token may have
    /// the robot's name.
    pub(super) fn check_name_is_free(&self, name: &str, of: Named<'_>) -> Result<(), Error> {
        if of != Named::Account && self.has_account(name) {
            return Err(Error::AccountExists(name.to_owned()));
        }
        let is_robots = |robot: Option<&str>| robot == Some(name);
        let is_others = match of {
            Named::Account => true,
            Named::Token { robot } => !is_robots(robot),
            Named::Pairing => false,
        };
        if is_others && self.pairings()?.iter().any(|pairing| pairing.robot == name) {
            return Err(Error::PairingExists(name.to_owned()));
        }
        let stored = self.stored.read();
        let mut live = stored.tokens.iter().filter(|known| known.revoked.is_none());
        let token = live.find(|known| known.principal.name == name);
        let is_others = token.is_some_and(|token| match of {
            Named::Account => true,
            // Whether there is one already is seen when it is made.
            Named::Token { .. } => false,
            Named::Pairing => !is_robots(token.principal.scope.robot.as_deref()),
        });
        if is_others {
            return Err(Error::TokenExists(name.to_owned()));
        }
        Ok(())
    }

    /// Makes a token; its secret is told once.
    pub fn create(&self, new: &api::access::NewToken) -> Result<api::access::Secret, Error> {
        check(new).map_err(Error::BadRequest)?;
        let robot = new.robot.as_deref();
        self.check_name_is_free(&new.name, Named::Token { robot })?;
        let end = |seconds: u64| {
            let end = seconds
                .checked_mul(1000)
                .and_then(|length| length.checked_add(store::now()));
            end.filter(|end| i64::try_from(*end).is_ok())
                .ok_or_else(|| {
                    Error::BadRequest(
                        "the lifetime is too long; leave it out for a token that does not end"
                            .into(),
                    )
                })
        };
        let expires = new.lifetime.map(end).transpose()?;
        let secret = names::random(SECRET);
        let scope = StoredScope {
            services: new.services.clone(),
            robot: new.robot.clone(),
            classes: new.classes.clone(),
        };
        let scope =
            serde_json::to_string(&scope).map_err(damaged(format!("token {}", new.name)))?;
        let record = self.state.add_token(&NewToken {
            name: &new.name,
            hash: &tokens::hash(&secret),
            role: new.role.name(),
            scope: &scope,
            expires,
        })?;
        let known = record
            .map(read_token)
            .transpose()?
            .ok_or_else(|| Error::TokenExists(new.name.clone()))?;
        if let Some(robot) = &new.robot {
            self.state.bind_robot(robot, &known.owner())?;
        }
        self.reload()?;
        Ok(api::access::Secret {
            token: known.view(),
            secret,
        })
    }

    /// Gives a token another secret; what shows the old one ends.
    pub fn rotate(&self, name: &str) -> Result<api::access::Secret, Error> {
        let secret = names::random(SECRET);
        let rotated = self.state.rotate_token(name, &tokens::hash(&secret))?;
        rotated.ok_or_else(|| self.unknown(name))?;
        self.reload()?;
        Ok(api::access::Secret {
            token: self.live(name)?,
            secret,
        })
    }

    /// Ends a token, and what shows it.
    pub fn revoke(&self, name: &str) -> Result<(), Error> {
        self.state
            .revoke_token(name)?
            .ok_or_else(|| self.unknown(name))?;
        self.reload()?;
        Ok(self.release_robots()?)
    }

    /// All rules.
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

    /// Writes a rule.
    pub fn add_rule(&self, new: &api::access::NewRule) -> Result<(), Error> {
        if self.stored.read().rules.len() >= MOST_RULES {
            return Err(Error::BadRequest(format!(
                "there are {MOST_RULES} rules, and no more can be; remove some with: cloudroidctl policy rm NUMBER"
            )));
        }
        let allow = serde_json::to_string(&new.allow).map_err(damaged("a rule".to_owned()))?;
        self.state
            .add_rule(&new.who.to_string(), new.services.as_str(), &allow)?;
        Ok(self.reload()?)
    }

    /// Removes a rule; false where there is none of that number.
    pub fn remove_rule(&self, id: i64) -> Result<bool, Error> {
        let removed = self.state.remove_rule(id)?;
        self.reload()?;
        Ok(removed.is_some())
    }
}

/// Rules that a policy may have: each connection looks at all of them.
const MOST_RULES: usize = 1000;

/// Refuses what cannot be a token, in words.
fn check(new: &api::access::NewToken) -> Result<(), String> {
    access::principal::check_name(&new.name).map_err(|error| error.to_string())?;
    if RESERVED.contains(&new.name.as_str()) {
        return Err(format!(
            "{} is a name that the daemon uses itself; choose another",
            new.name
        ));
    }
    let (role, scoped) = (new.role, new.role.is_scoped());
    if scoped && new.services.is_empty() {
        return Err(format!(
            "a {role} is for services that are named; name them with --service, or all with --service '*'"
        ));
    }
    let names_some = !new.services.is_empty() || !new.classes.is_empty();
    if !scoped && names_some {
        return Err(format!(
            "an {role} is for all services and classes; leave out --service and --class, or choose another role"
        ));
    }
    match (&new.robot, role) {
        (Some(robot), Role::Robot) => names::robot(robot).map_err(|error| error.to_string())?,
        (None, Role::Robot) => {
            return Err("a robot's token is for one robot; name it with --robot".into());
        }
        (Some(_), role) => {
            return Err(format!(
                "--robot is for tokens of robots, and this one is for a {role}"
            ));
        }
        (None, _) => {}
    }
    match new.lifetime {
        Some(0) => Err("a token that ends at once is of no use; give it a longer lifetime".into()),
        _ => Ok(()),
    }
}
