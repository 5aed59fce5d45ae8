//! Tokens and rules, read from the database: in memory, for each request asks for them.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use access::{Glob, Policy, Principal, Role, Rule, Scope};
use api::Millis;
use serde::{Deserialize, Serialize};
use store::{Owner, RuleRecord, State, TokenHash, TokenRecord};

use super::pairings::{self, Paired};
use super::people::{KnownAccount, KnownSession, Lasting};
use super::{Identity, Shown, Unrecognised};

/// What the store keeps of a token beside its role.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct StoredScope {
    pub(super) services: Vec<Glob>,
    #[serde(default)]
    pub(super) robot: Option<String>,
    #[serde(default)]
    pub(super) classes: Vec<Glob>,
}

/// A token of the database, in memory.
pub(super) struct Known {
    pub(super) id: i64,
    pub(super) hash: TokenHash,
    pub(super) principal: Arc<Principal>,
    pub(super) created: Millis,
    pub(super) expires: Option<Millis>,
    pub(super) last_used: AtomicU64,
    pub(super) revoked: Option<Millis>,
}

impl Known {
    /// Whose robots' names are that it uses: a robot's token has its robot's name, and other tokens of that robot, too.
    pub(super) fn owner(&self) -> Owner {
        match &self.principal.scope.robot {
            Some(robot) => format!("robot:{robot}"),
            None => format!("token:{}", self.principal.name),
        }
    }

    /// Why it is not good any more.
    pub(super) fn over(&self, now: Millis) -> Option<Unrecognised> {
        if self.revoked.is_some() {
            return Some(Unrecognised::Revoked);
        }
        let end = self.expires.filter(|end| *end <= now);
        end.map(|_| Unrecognised::Expired)
    }

    pub(super) fn view(&self) -> api::access::Token {
        let Principal { name, roles, scope } = &*self.principal;
        let last = self.last_used.load(Ordering::Relaxed);
        api::access::Token {
            name: name.clone(),
            role: roles.first().copied().unwrap_or(Role::Viewer),
            services: scope.services.clone(),
            robot: scope.robot.clone(),
            classes: scope.classes.clone(),
            created: self.created,
            expires: self.expires,
            last_used: (last > 0).then_some(last),
            revoked: self.revoked,
        }
    }
}

/// The tokens, accounts and sessions of the database, and the policy.
#[derive(Default)]
pub struct Stored {
    pub(super) tokens: Vec<Known>,
    pub(super) pairings: Vec<Paired>,
    /// Places in `tokens`.
    by_hash: HashMap<TokenHash, usize>,
    pub(super) accounts: Vec<KnownAccount>,
    /// By the hash of what their browsers show.
    pub(super) sessions: HashMap<TokenHash, KnownSession>,
    /// Whether an identity provider names people, or did.
    pub(super) names_provider: bool,
    pub(super) rules: Vec<(i64, Rule)>,
    pub(super) policy: Policy,
}

pub(super) fn damaged(what: String) -> impl FnOnce(serde_json::Error) -> store::Error {
    move |source| store::Error::Record { what, source }
}

fn read_text<T: serde::de::DeserializeOwned>(text: &str, what: &str) -> Result<T, store::Error> {
    let value = serde_json::Value::String(text.to_owned());
    serde_json::from_value(value).map_err(damaged(what.to_owned()))
}

/// Whose record it is.
pub(super) fn read_principal(
    name: &str,
    role: &str,
    scope: &str,
    kind: &str,
) -> Result<Principal, store::Error> {
    let what = format!("{kind} {name}");
    let role: Role = read_text(role, &what)?;
    let scope: StoredScope = serde_json::from_str(scope).map_err(damaged(what))?;
    let scope = match role.is_scoped() {
        true => Scope {
            services: scope.services,
            robot: scope.robot,
            classes: scope.classes,
        },
        false => Scope::everything(),
    };
    Ok(Principal {
        name: name.to_owned(),
        roles: vec![role],
        scope,
    })
}

pub(super) fn read_token(record: TokenRecord) -> Result<Known, store::Error> {
    let principal = read_principal(&record.name, &record.role, &record.scope, "token")?;
    Ok(Known {
        id: record.id,
        hash: record.hash,
        principal: Arc::new(principal),
        created: record.created,
        expires: record.expires,
        last_used: AtomicU64::new(record.last_used.unwrap_or_default()),
        revoked: record.revoked,
    })
}

fn read_rule(record: RuleRecord) -> Result<(i64, Rule), store::Error> {
    let what = format!("rule {}", record.id);
    let rule = Rule {
        who: read_text(&record.who, &what)?,
        services: read_text(&record.services, &what)?,
        allow: serde_json::from_str(&record.allow).map_err(damaged(what))?,
    };
    Ok((record.id, rule))
}

impl Stored {
    /// What a database holds.
    pub fn read(state: &State) -> Result<Stored, store::Error> {
        let tokens = state
            .tokens()?
            .into_iter()
            .map(read_token)
            .collect::<Result<Vec<_>, _>>()?;
        let pairings = state
            .pairings()?
            .into_iter()
            .map(pairings::read)
            .collect::<Result<Vec<_>, _>>()?;
        let accounts = state.accounts()?.into_iter().map(KnownAccount::read);
        let sessions = state.sessions()?.into_iter().map(|record| {
            let hash = record.hash.clone();
            Ok((hash, KnownSession::read(record)?))
        });
        let rules = state
            .rules()?
            .into_iter()
            .map(read_rule)
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Stored {
            by_hash: tokens
                .iter()
                .enumerate()
                .map(|(at, known)| (known.hash.clone(), at))
                .collect(),
            policy: Policy {
                rules: rules.iter().map(|(_, rule)| rule.clone()).collect(),
            },
            accounts: accounts.collect::<Result<_, store::Error>>()?,
            sessions: sessions.collect::<Result<_, store::Error>>()?,
            names_provider: !state.provided_people()?.is_empty(),
            tokens,
            pairings,
            rules,
        })
    }

    /// Whether there never was a token, nor an account, nor a robot that is paired, nor an identity provider.
    pub fn is_empty(&self) -> bool {
        self.tokens.is_empty()
            && self.accounts.is_empty()
            && self.pairings.is_empty()
            && !self.names_provider
    }

    /// Whose session it is, by the hash of what is shown.
    pub(super) fn recognise_session(
        &self,
        hash: &str,
        now: Millis,
        lasting: Lasting,
    ) -> Result<Identity, Unrecognised> {
        let known = self.sessions.get(hash);
        known.map_or(Err(Unrecognised::SessionOver), |known| {
            known.recognise(now, lasting)
        })
    }

    pub(super) fn session_of_id(&self, id: i64) -> Option<&KnownSession> {
        self.sessions.values().find(|known| known.record.id == id)
    }

    /// Whose token it is, by its hash.
    pub(super) fn recognise(
        &self,
        hash: &str,
        now: Millis,
    ) -> Result<Option<Identity>, Unrecognised> {
        let Some(known) = self.by_hash.get(hash).map(|at| &self.tokens[*at]) else {
            return Ok(None);
        };
        if let Some(reason) = known.over(now) {
            return Err(reason);
        }
        Ok(Some(Identity {
            principal: Arc::clone(&known.principal),
            shown: Shown::Stored {
                id: known.id,
                hash: known.hash.clone(),
            },
            token: Some(known.hash.clone()),
            owner: Some(known.owner()),
        }))
    }

    pub(super) fn of_id(&self, id: i64) -> Option<&Known> {
        self.tokens.iter().find(|known| known.id == id)
    }
}
