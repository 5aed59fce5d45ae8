//! Credentials and rules of the database, cached in memory because every request needs them.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use access::{AccessPolicy, AccessRule, Glob, Principal, Role, Scope};
use api::Millis;
use serde::{Deserialize, Serialize};
use store::{AccountRecord, Owner, RuleRecord, SessionRecord, State, TokenHash, TokenRecord};

use super::identity::{CallerIdentity, Credential};
use super::pairings::{self, StoredPairing};
use super::refusals::AuthenticationError;

/// Scope of a token as stored in the database, besides its role.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct StoredScope {
    pub(super) services: Vec<Glob>,
    #[serde(default)]
    pub(super) robot: Option<String>,
    #[serde(default)]
    pub(super) classes: Vec<Glob>,
}

/// A token of the database, in memory.
pub(super) struct KnownToken {
    pub(super) id: i64,
    pub(super) hash: TokenHash,
    pub(super) principal: Arc<Principal>,
    pub(super) created: Millis,
    pub(super) expires: Option<Millis>,
    pub(super) last_used: AtomicU64,
    pub(super) revoked: Option<Millis>,
}

impl KnownToken {
    /// Returns the owner of robot names used with the token: a robot's token owns its robot's name, as do other
    /// tokens of that robot.
    pub(super) fn owner(&self) -> Owner {
        match &self.principal.scope.robot {
            Some(robot) => format!("robot:{robot}"),
            None => format!("token:{}", self.principal.name),
        }
    }

    /// Returns why the token is not valid any more, if so.
    pub(super) fn refusal(&self, now: Millis) -> Option<AuthenticationError> {
        if self.revoked.is_some() {
            return Some(AuthenticationError::Revoked);
        }
        let end = self.expires.filter(|end| *end <= now);
        end.map(|_| AuthenticationError::Expired)
    }

    pub(super) fn to_api_token(&self) -> api::access::Token {
        let Principal { name, scope, .. } = &*self.principal;
        let last = self.last_used.load(Ordering::Relaxed);
        api::access::Token {
            name: name.clone(),
            role: self.principal.first_role(),
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
        SessionLifetimes { most: Duration::from_secs(12 * 3600), idle: Duration::from_secs(3600) }
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
        Ok(KnownAccount { principal: Arc::new(principal), record })
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

/// Tokens, accounts and sessions of the database, and the policy.
#[derive(Default)]
pub struct StoredPrincipals {
    pub(super) tokens: Vec<KnownToken>,
    pub(super) pairings: Vec<StoredPairing>,
    /// Indices into `tokens`.
    by_hash: HashMap<TokenHash, usize>,
    pub(super) accounts: Vec<KnownAccount>,
    /// Sessions by the hash of the browser's secret.
    pub(super) sessions: HashMap<TokenHash, KnownSession>,
    /// True if an identity provider is or was configured.
    pub(super) names_provider: bool,
    pub(super) rules: Vec<(i64, AccessRule)>,
    pub(super) policy: AccessPolicy,
}

pub(super) fn record_error(what: String) -> impl FnOnce(serde_json::Error) -> store::Error {
    move |source| store::Error::Record { what, source }
}

fn read_text<T: serde::de::DeserializeOwned>(text: &str, what: &str) -> Result<T, store::Error> {
    let value = serde_json::Value::String(text.to_owned());
    serde_json::from_value(value).map_err(record_error(what.to_owned()))
}

/// Builds the principal of a record.
pub(super) fn read_principal(name: &str, role: &str, scope: &str, kind: &str) -> Result<Principal, store::Error> {
    let what = format!("{kind} {name}");
    let role: Role = read_text(role, &what)?;
    let scope: StoredScope = serde_json::from_str(scope).map_err(record_error(what))?;
    let scope = if role.is_scoped() {
        Scope { services: scope.services, robot: scope.robot, classes: scope.classes }
    } else {
        Scope::everything()
    };
    Ok(Principal { name: name.to_owned(), roles: vec![role], scope })
}

pub(super) fn read_token(record: TokenRecord) -> Result<KnownToken, store::Error> {
    let principal = read_principal(&record.name, &record.role, &record.scope, "token")?;
    Ok(KnownToken {
        id: record.id,
        hash: record.hash,
        principal: Arc::new(principal),
        created: record.created,
        expires: record.expires,
        last_used: AtomicU64::new(record.last_used.unwrap_or_default()),
        revoked: record.revoked,
    })
}

fn read_rule(record: RuleRecord) -> Result<(i64, AccessRule), store::Error> {
    let what = format!("rule {}", record.id);
    let rule = AccessRule {
        who: read_text(&record.who, &what)?,
        services: read_text(&record.services, &what)?,
        allow: serde_json::from_str(&record.allow).map_err(record_error(what))?,
    };
    Ok((record.id, rule))
}

impl StoredPrincipals {
    /// Loads everything from a database.
    pub fn load(state: &State) -> Result<StoredPrincipals, store::Error> {
        let tokens = state.tokens()?.into_iter().map(read_token).collect::<Result<Vec<_>, _>>()?;
        let pairings = state.pairings()?.into_iter().map(pairings::read_pairing).collect::<Result<Vec<_>, _>>()?;
        let accounts = state.accounts()?.into_iter().map(KnownAccount::read);
        let sessions = state.sessions()?.into_iter().map(|record| {
            let hash = record.hash.clone();
            Ok((hash, KnownSession::read(record)?))
        });
        let rules = state.rules()?.into_iter().map(read_rule).collect::<Result<Vec<_>, _>>()?;
        Ok(StoredPrincipals {
            by_hash: tokens.iter().enumerate().map(|(at, known)| (known.hash.clone(), at)).collect(),
            policy: AccessPolicy { rules: rules.iter().map(|(_, rule)| rule.clone()).collect() },
            accounts: accounts.collect::<Result<_, store::Error>>()?,
            sessions: sessions.collect::<Result<_, store::Error>>()?,
            names_provider: !state.federated_people()?.is_empty(),
            tokens,
            pairings,
            rules,
        })
    }

    /// Returns true if there never was a token, an account, a paired robot or an identity provider.
    pub fn is_empty(&self) -> bool {
        self.tokens.is_empty() && self.accounts.is_empty() && self.pairings.is_empty() && !self.names_provider
    }

    /// Identifies the caller by the hash of a session's secret.
    pub(super) fn recognise_session(
        &self,
        hash: &str,
        now: Millis,
        lasting: SessionLifetimes,
    ) -> Result<CallerIdentity, AuthenticationError> {
        let known = self.sessions.get(hash);
        known.map_or(Err(AuthenticationError::SessionOver), |known| known.recognise(now, lasting))
    }

    pub(super) fn find_session(&self, id: i64) -> Option<&KnownSession> {
        self.sessions.values().find(|known| known.record.id == id)
    }

    /// Identifies the caller by the hash of a token.
    pub(super) fn recognise(&self, hash: &str, now: Millis) -> Result<Option<CallerIdentity>, AuthenticationError> {
        let Some(known) = self.by_hash.get(hash).map(|at| &self.tokens[*at]) else {
            return Ok(None);
        };
        if let Some(reason) = known.refusal(now) {
            return Err(reason);
        }
        Ok(Some(CallerIdentity {
            principal: Arc::clone(&known.principal),
            shown: Credential::Stored { id: known.id, hash: known.hash.clone() },
            token: Some(known.hash.clone()),
            owner: Some(known.owner()),
        }))
    }

    pub(super) fn find_token(&self, id: i64) -> Option<&KnownToken> {
        self.tokens.iter().find(|known| known.id == id)
    }
}
