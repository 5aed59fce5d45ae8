//! Who shows which token, and what it may do: the tokens of the configuration and of the database, and the policy. Changes
//! hold at once, for open connections as for requests.

mod pairings;

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use access::{Glob, Guesses, Policy, Principal, Role, Rule, Scope, Standing};
use api::Millis;
use catalogue::names;
use parking_lot::{Mutex, RwLock};
use serde::{Deserialize, Serialize};
use store::{NewToken, Owner, RuleRecord, State, TokenHash, TokenRecord};
use tokio::sync::watch;

use crate::errors::Error;
use crate::tokens::{self, AuthMessage, Tokens};

use pairings::Paired;
pub use pairings::{Uncertified, Uncoded};

/// Characters of a token: of 36 letters and digits each, that is 268 bits.
const SECRET: usize = 52;
/// A token's last use is written no more often.
const USED: Millis = 60_000;
/// How often it is looked whether a token has expired: no more, and no less, often.
const SOONEST: Duration = Duration::from_millis(10);
const LATEST: Duration = Duration::from_secs(60);
/// Names of principals that are known without a token.
const RESERVED: [&str; 3] = ["local", "root", "configured"];

/// By what somebody is known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shown {
    /// By nothing: on loopback, on a machine whose operator has named nobody; or not at all.
    Nothing,
    /// By a token of the configuration.
    Configured,
    /// By a token of the database.
    Stored {
        /// Its number.
        id: i64,
        /// The secret's hash: after a rotation it is another.
        hash: TokenHash,
    },
    /// By a certificate in TLS.
    Certificate {
        /// The number of the robot's pairing.
        pairing: i64,
        /// SHA-256 of the key that was paired; none where another authority than the daemon's signs the robot's certificates.
        key: Option<String>,
        /// The certificate's end.
        until: Millis,
    },
    /// By the kernel, at the daemon's socket.
    User,
}

/// Somebody who has been recognised.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The principal.
    pub principal: Arc<Principal>,
    /// By what.
    pub shown: Shown,
    /// The hash of the token that was shown.
    pub token: Option<TokenHash>,
    /// To whom names of robots are bound that it uses first.
    pub owner: Option<Owner>,
}

impl Identity {
    /// To what its resume tokens are bound: to whoever has a token of the database, whichever its secret is now; else to the token.
    pub fn bound_by(&self) -> Option<String> {
        match &self.shown {
            Shown::Stored { id, .. } => Some(format!("token {id}")),
            Shown::Certificate { pairing, .. } => Some(format!("pairing {pairing}")),
            _ => self.token.clone(),
        }
    }
}

/// Why a token lets nobody in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Unrecognised {
    /// It was good once.
    #[error("this token was revoked")]
    Revoked,
    /// It was good until its end.
    #[error("this token has expired")]
    Expired,
    /// Nobody has it.
    #[error("this token is not known")]
    Unknown,
    /// It was not looked at.
    #[error("too many tokens that are not known came from this address; none is looked at for {} s", .0.div_ceil(1000))]
    Slowed(Millis),
}

/// What the store keeps of a token beside its role.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct StoredScope {
    services: Vec<Glob>,
    #[serde(default)]
    robot: Option<String>,
    #[serde(default)]
    classes: Vec<Glob>,
}

/// A token of the database, in memory.
struct Known {
    id: i64,
    hash: TokenHash,
    principal: Arc<Principal>,
    created: Millis,
    expires: Option<Millis>,
    last_used: AtomicU64,
    revoked: Option<Millis>,
}

impl Known {
    /// Whose robots' names are that it uses: a robot's token has its robot's name, and other tokens of that robot, too.
    fn owner(&self) -> Owner {
        match &self.principal.scope.robot {
            Some(robot) => format!("robot:{robot}"),
            None => format!("token:{}", self.principal.name),
        }
    }

    /// Why it is not good any more.
    fn over(&self, now: Millis) -> Option<Unrecognised> {
        if self.revoked.is_some() {
            return Some(Unrecognised::Revoked);
        }
        let end = self.expires.filter(|end| *end <= now);
        end.map(|_| Unrecognised::Expired)
    }

    fn view(&self) -> api::access::Token {
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

/// The tokens of the database, and the policy.
#[derive(Default)]
pub struct Stored {
    tokens: Vec<Known>,
    pairings: Vec<Paired>,
    /// Places in `tokens`.
    by_hash: HashMap<TokenHash, usize>,
    rules: Vec<(i64, Rule)>,
    policy: Policy,
}

fn damaged(what: String) -> impl FnOnce(serde_json::Error) -> store::Error {
    move |source| store::Error::Record { what, source }
}

fn read_text<T: serde::de::DeserializeOwned>(text: &str, what: &str) -> Result<T, store::Error> {
    let value = serde_json::Value::String(text.to_owned());
    serde_json::from_value(value).map_err(damaged(what.to_owned()))
}

fn read_token(record: TokenRecord) -> Result<Known, store::Error> {
    let what = format!("token {}", record.name);
    let role: Role = read_text(&record.role, &what)?;
    let scope: StoredScope = serde_json::from_str(&record.scope).map_err(damaged(what))?;
    let scope = match role.is_scoped() {
        true => Scope {
            services: scope.services,
            robot: scope.robot,
            classes: scope.classes,
        },
        false => Scope::everything(),
    };
    Ok(Known {
        id: record.id,
        hash: record.hash,
        principal: Arc::new(Principal {
            name: record.name,
            roles: vec![role],
            scope,
        }),
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
            tokens,
            pairings,
            rules,
        })
    }

    /// Whether there never was a token, nor a robot that is paired.
    pub fn is_empty(&self) -> bool {
        self.tokens.is_empty() && self.pairings.is_empty()
    }

    /// Whose token it is, by its hash.
    fn recognise(&self, hash: &str, now: Millis) -> Result<Option<Identity>, Unrecognised> {
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

    fn of_id(&self, id: i64) -> Option<&Known> {
        self.tokens.iter().find(|known| known.id == id)
    }
}

/// By what tokens are recognised.
#[derive(Clone, Copy)]
pub struct Recognising<'a> {
    /// Tokens of the configuration.
    pub tokens: &'a Tokens,
    /// Tokens of the database.
    pub stored: &'a Stored,
    /// What was guessed, by address.
    pub guesses: &'a Mutex<Guesses>,
}

impl Recognising<'_> {
    /// Whose token it is, that came from an address.
    pub fn recognise(
        &self,
        token: &str,
        from: IpAddr,
        now: Millis,
    ) -> Result<Identity, Unrecognised> {
        self.by(token, from, now, || self.tokens.recognise(token))
    }

    /// Looks for a token in the database and then, with `configured`, among those of the configuration. The former cannot be
    /// guessed, and are looked for always: who has one is not held up by whoever guesses at the same address. The latter
    /// people choose.
    fn by(
        &self,
        token: &str,
        from: IpAddr,
        now: Millis,
        configured: impl FnOnce() -> Option<TokenHash>,
    ) -> Result<Identity, Unrecognised> {
        if let Some(identity) = self.stored.recognise(&tokens::hash(token), now)? {
            return Ok(identity);
        }
        let mut guesses = self.guesses.lock();
        guesses.ask(from, now).map_err(Unrecognised::Slowed)?;
        if let Some(hash) = configured() {
            return Ok(of_configuration(hash));
        }
        if let Some(wait) = guesses.failed(from, now) {
            let seconds = wait.div_ceil(1000);
            tracing::warn!(
                "tokens that are not known come from {from}: for {seconds} s none is looked at"
            );
        }
        Err(Unrecognised::Unknown)
    }
}

fn of_configuration(hash: TokenHash) -> Identity {
    Identity {
        principal: Arc::new(Principal::admin("configured")),
        shown: Shown::Configured,
        owner: Some(hash.clone()),
        token: Some(hash),
    }
}

/// All who are known, and what they may do.
pub struct Principals {
    configured: Tokens,
    state: Arc<State>,
    stored: RwLock<Stored>,
    guesses: Mutex<Guesses>,
    /// Grows by one with every change.
    changed: watch::Sender<u64>,
}

impl Principals {
    /// Those of the configuration and of the database.
    pub fn new(configured: Tokens, state: Arc<State>) -> Result<Principals, store::Error> {
        let principals = Principals {
            stored: RwLock::new(Stored::read(&state)?),
            configured,
            state,
            guesses: Mutex::default(),
            changed: watch::Sender::new(0),
        };
        principals.release_robots()?;
        Ok(principals)
    }

    /// Names of robots that are bound to nobody who is left would be nobody's for ever.
    fn release_robots(&self) -> Result<(), store::Error> {
        let mut owners: Vec<Owner> = self.configured.hashes().to_vec();
        let stored = self.stored.read();
        let live = stored.tokens.iter().filter(|known| known.revoked.is_none());
        owners.extend(live.map(Known::owner));
        owners.extend(stored.paired_owners());
        drop(stored);
        self.state.release_robots(&owners).map(|_| ())
    }

    /// Calls `look` with what is known now.
    pub fn with<T>(&self, look: impl FnOnce(Recognising<'_>) -> T) -> T {
        look(Recognising {
            tokens: &self.configured,
            stored: &self.stored.read(),
            guesses: &self.guesses,
        })
    }

    /// Tokens since the daemon started that were not known, and those that were not looked at.
    pub fn guessed(&self) -> (u64, u64) {
        self.guesses.lock().counts()
    }

    /// Whether nobody was ever named: then this machine's own users need no token.
    pub fn names_nobody(&self) -> bool {
        self.configured.is_empty() && self.stored.read().is_empty()
    }

    /// Who is meant by rosbridge's `auth` message that came from an address, at `seconds` since 1970.
    pub fn recognise_auth(
        &self,
        message: &AuthMessage,
        from: IpAddr,
        seconds: f64,
    ) -> Result<Identity, String> {
        let now = (seconds * 1000.0) as Millis;
        let mut refusal = None;
        let identity = self.with(|known| {
            known.by(&message.mac, from, now, || {
                let recognised = known.tokens.recognise_auth(message, seconds);
                recognised.map_err(|why| refusal = Some(why)).ok()
            })
        });
        match identity {
            Ok(identity) => {
                self.note_use(&identity, now);
                Ok(identity)
            }
            // What is expected of such a message says more.
            Err(why) => Err(refusal.map_or_else(|| why.to_string(), |refusal| refusal.to_string())),
        }
    }

    /// Remembers that a token was shown, to the minute.
    pub fn note_use(&self, identity: &Identity, now: Millis) {
        let id = match identity.shown {
            Shown::Stored { id, .. } => id,
            Shown::Certificate { pairing, .. } => return self.note_pairing(pairing, now),
            _ => return,
        };
        let stored = self.stored.read();
        let due = stored.of_id(id).is_some_and(|known| {
            let last = known.last_used.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USED
                && known
                    .last_used
                    .compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed)
                    .is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.token_used(id, now) {
            tracing::warn!("when a token was used last cannot be written: {error}");
        }
    }

    /// How a connection of somebody to a service stands.
    pub fn standing(&self, who: &Identity, service: &str) -> Standing {
        let stored = self.stored.read();
        let over = match &who.shown {
            Shown::Nothing if !(self.configured.is_empty() && stored.is_empty()) => {
                Some("a token is needed since the first was made".to_owned())
            }
            Shown::Stored { id, hash } => match stored.of_id(*id) {
                Some(known) if known.hash == *hash => {
                    known.over(store::now()).map(|over| over.to_string())
                }
                _ => Some("this token was replaced by another".to_owned()),
            },
            Shown::Certificate { pairing, until, .. } => {
                let over = stored.pairing_over(*pairing, *until, store::now());
                over.map(|over| over.to_string())
            }
            Shown::Nothing | Shown::Configured | Shown::User => None,
        };
        match over {
            Some(reason) => Standing::Ended(reason),
            None => Standing::Granted(Arc::new(stored.policy.grants(&who.principal, service))),
        }
    }

    /// Until when somebody's token is good.
    fn expiry(&self, who: &Identity) -> Option<Millis> {
        match who.shown {
            Shown::Stored { id, .. } => self.stored.read().of_id(id)?.expires,
            Shown::Certificate { pairing, until, .. } => {
                self.stored.read().pairing_end(pairing, until)
            }
            _ => None,
        }
    }

    /// Tells `standing` whenever that of a connection changes; never comes back.
    pub async fn follow(&self, who: &Identity, service: &str, standing: &watch::Sender<Standing>) {
        let mut changed = self.changed.subscribe();
        loop {
            changed.borrow_and_update();
            let now = self.standing(who, service);
            standing.send_if_modified(|known| {
                let new = *known != now;
                known.clone_from(&now);
                new
            });
            let expires = async {
                let ends = self
                    .expiry(who)
                    .filter(|_| matches!(now, Standing::Granted(_)));
                let Some(end) = ends else {
                    return std::future::pending().await;
                };
                // The clock may be set meanwhile, or the machine have slept: it is looked at again.
                let left = Duration::from_millis(end.saturating_sub(store::now()));
                tokio::time::sleep(left.clamp(SOONEST, LATEST)).await;
            };
            tokio::select! {
                _ = changed.changed() => {}
                () = expires => {}
            }
        }
    }

    /// Comes back with the reason when a connection of somebody to a service is to end. `whole`: what serves it needs
    /// everything granted.
    pub async fn ended(&self, who: &Identity, service: &str, whole: bool) -> String {
        let (standing, mut told) = watch::channel(self.standing(who, service));
        let reason = async {
            loop {
                match &*told.borrow_and_update() {
                    Standing::Ended(reason) => return reason.clone(),
                    Standing::Granted(grants) if whole && !grants.is_everything() => {
                        return format!("a stub needs all of {service}, and is granted {grants}");
                    }
                    Standing::Granted(_) => {}
                }
                if told.changed().await.is_err() {
                    std::future::pending().await
                }
            }
        };
        tokio::select! {
            reason = reason => reason,
            () = self.follow(who, service, &standing) => std::future::pending().await,
        }
    }

    /// Reads the database again, and tells whoever follows.
    fn reload(&self) -> Result<(), store::Error> {
        // Read under the lock: of two changes, the one that is read last holds both.
        let mut stored = self.stored.write();
        let fresh = Stored::read(&self.state)?;
        // Not yet written ones, too.
        for known in &fresh.tokens {
            if let Some(before) = stored.of_id(known.id) {
                known
                    .last_used
                    .fetch_max(before.last_used.load(Ordering::Relaxed), Ordering::Relaxed);
            }
        }
        fresh.keep_uses(&stored);
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

    /// Makes a token; its secret is told once.
    pub fn create(&self, new: &api::access::NewToken) -> Result<api::access::Secret, Error> {
        check(new).map_err(Error::BadRequest)?;
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

#[cfg(test)]
mod tests {
    use access::{Grant, Operation};
    use api::access::{NewRule, NewToken};

    use super::*;

    struct World {
        _home: tempfile::TempDir,
        principals: Principals,
    }

    fn world(configured: &[&str]) -> World {
        let home = tempfile::tempdir().expect("a directory");
        let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
        let configured: Vec<String> = configured.iter().map(|text| (*text).to_owned()).collect();
        let configured = Tokens::new(&configured).expect("tokens");
        let principals = Principals::new(configured, Arc::new(state)).expect("readable");
        World {
            _home: home,
            principals,
        }
    }

    fn recognised(principals: &Principals, token: &str) -> Result<Identity, Unrecognised> {
        let here = IpAddr::from([127, 0, 0, 1]);
        principals.with(|known| known.recognise(token, here, store::now()))
    }

    fn robot(name: &str) -> NewToken {
        NewToken {
            name: name.into(),
            role: Role::Robot,
            services: vec!["det*".parse().expect("a pattern")],
            robot: Some("r1".into()),
            classes: Vec::new(),
            lifetime: None,
        }
    }

    fn permits(standing: &Standing, operation: Operation, name: &str) -> bool {
        match standing {
            Standing::Granted(grants) => grants.permits(operation, name),
            Standing::Ended(_) => false,
        }
    }

    #[test]
    fn a_token_is_good_until_it_is_revoked_or_rotated() {
        let World { principals, _home } = world(&[]);
        assert!(principals.names_nobody());
        let made = principals.create(&robot("rover")).expect("made");
        assert!(!principals.names_nobody());
        assert_eq!(made.secret.len(), SECRET);
        let listed = serde_json::to_string(&principals.tokens()).expect("JSON");
        assert!(!listed.contains(&made.secret) && !listed.contains(&tokens::hash(&made.secret)));
        let who = recognised(&principals, &made.secret).expect("known");
        assert_eq!(
            (&*who.principal.name, who.owner.as_deref()),
            ("rover", Some("robot:r1"))
        );
        principals.note_use(&who, store::now());
        assert!(principals.tokens()[0].last_used.is_some());
        let earlier = who.clone();
        let rotated = principals.rotate("rover").expect("there");
        assert_eq!(
            recognised(&principals, &made.secret),
            Err(Unrecognised::Unknown)
        );
        let ended = principals.standing(&who, "detector");
        assert_eq!(
            ended,
            Standing::Ended("this token was replaced by another".into())
        );
        let who = recognised(&principals, &rotated.secret).expect("known");
        assert!(permits(
            &principals.standing(&who, "detector"),
            Operation::Publish,
            "/x"
        ));
        // What it left behind is still its own.
        assert_eq!(who.bound_by(), earlier.bound_by());
        principals.revoke("rover").expect("there");
        assert_eq!(
            recognised(&principals, &rotated.secret),
            Err(Unrecognised::Revoked)
        );
        let ended = principals.standing(&who, "detector");
        assert_eq!(ended, Standing::Ended("this token was revoked".into()));
        assert!(!principals.names_nobody(), "the door does not open again");
        let next = principals.create(&robot("rover")).expect("made").secret;
        let next = recognised(&principals, &next).expect("known");
        assert_ne!(
            next.bound_by(),
            earlier.bound_by(),
            "another's, of the same name"
        );
        principals.revoke("rover").expect("there");
        let unknown = principals.revoke("rover").expect_err("once").problem();
        assert_eq!(unknown.status, 404);
    }

    #[test]
    fn a_token_ends_at_its_time() {
        let World { principals, _home } = world(&[]);
        let secret = principals
            .create(&NewToken {
                lifetime: Some(60),
                ..robot("rover")
            })
            .expect("made")
            .secret;
        let hash = tokens::hash(&secret);
        let end = principals.tokens()[0].expires.expect("an end");
        let stored = principals.stored.read();
        assert!(stored.recognise(&hash, end - 1).expect("good").is_some());
        assert_eq!(stored.recognise(&hash, end), Err(Unrecognised::Expired));
    }

    #[test]
    fn tokens_of_the_configuration_are_admins() {
        let World { principals, _home } = world(&["open sesame"]);
        let who = recognised(&principals, "open sesame").expect("known");
        assert!(who.principal.is(Role::Admin));
        assert_eq!(who.owner, Some(tokens::hash("open sesame")));
        assert!(permits(
            &principals.standing(&who, "any"),
            Operation::Call,
            "/x"
        ));
    }

    #[test]
    fn who_guesses_is_slowed_and_who_has_a_token_of_the_database_is_not() {
        let World { principals, _home } = world(&["open sesame"]);
        let made = principals.create(&robot("rover")).expect("made").secret;
        let revoked = principals.create(&robot("over")).expect("made").secret;
        principals.revoke("over").expect("there");
        let (here, there) = (IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2]));
        let shows =
            |token: &str, from| principals.with(|known| known.recognise(token, from, 5_000));
        // What was good once is no guess.
        for _ in 0..2 * access::guesses::FREE {
            assert_eq!(shows(&revoked, here), Err(Unrecognised::Revoked));
        }
        for number in 0..access::guesses::FREE {
            assert_eq!(
                shows(&format!("guess {number}"), here),
                Err(Unrecognised::Unknown)
            );
        }
        for token in ["guess", "open sesame"] {
            assert_eq!(
                shows(token, here),
                Err(Unrecognised::Slowed(1_000)),
                "{token}"
            );
        }
        assert!(shows(&made, here).is_ok() && shows("open sesame", there).is_ok());
        assert_eq!(principals.guessed(), (u64::from(access::guesses::FREE), 2));
        // By rosbridge's message they count alike.
        let message = |mac: &str| -> AuthMessage {
            serde_json::from_value(serde_json::json!({"mac": mac})).expect("a message")
        };
        let far = IpAddr::from([10, 0, 0, 3]);
        for _ in 0..access::guesses::FREE {
            let refused = principals
                .recognise_auth(&message("guess"), far, 0.0)
                .expect_err("a guess");
            assert!(
                refused.contains("neither contains a known token"),
                "{refused}"
            );
        }
        let refused = principals.recognise_auth(&message("open sesame"), far, 0.0);
        assert!(refused.expect_err("slowed").contains("none is looked at"));
        principals
            .recognise_auth(&message(&made), far, 0.0)
            .expect("known");
    }

    #[test]
    fn what_cannot_be_a_token_is_refused_with_words() {
        let World { principals, _home } = world(&[]);
        let table = [
            (
                NewToken {
                    name: "a b".into(),
                    ..robot("x")
                },
                "is no name",
            ),
            (
                NewToken {
                    name: "root".into(),
                    ..robot("x")
                },
                "uses itself",
            ),
            (
                NewToken {
                    services: Vec::new(),
                    ..robot("x")
                },
                "--service",
            ),
            (
                NewToken {
                    robot: None,
                    ..robot("x")
                },
                "--robot",
            ),
            (
                NewToken {
                    robot: Some("a/b".into()),
                    ..robot("x")
                },
                "robot",
            ),
            (
                NewToken {
                    role: Role::Viewer,
                    ..robot("x")
                },
                "--robot is for",
            ),
            (
                NewToken {
                    role: Role::Admin,
                    robot: None,
                    ..robot("x")
                },
                "all services",
            ),
            (
                NewToken {
                    lifetime: Some(0),
                    ..robot("x")
                },
                "ends at once",
            ),
            (
                NewToken {
                    lifetime: Some(u64::MAX),
                    ..robot("x")
                },
                "too long",
            ),
        ];
        for (new, words) in table {
            let refused = principals.create(&new).expect_err(words).problem();
            assert!(
                refused.status == 400 && refused.detail.contains(words),
                "{words}: {refused:?}"
            );
        }
        assert!(principals.names_nobody(), "none of them was made");
        principals.create(&robot("x")).expect("made");
        assert_eq!(
            principals
                .create(&robot("x"))
                .expect_err("taken")
                .problem()
                .status,
            409
        );
    }

    #[tokio::test]
    async fn whoever_follows_hears_of_changes_of_the_policy_and_of_the_end() {
        let World { principals, _home } = world(&[]);
        let secret = principals.create(&robot("rover")).expect("made").secret;
        let who = recognised(&principals, &secret).expect("known");
        let (sender, mut standing) = watch::channel(principals.standing(&who, "detector"));
        let change = async {
            let grant: Grant = "subscribe:/camera/**".parse().expect("a grant");
            let rule = NewRule {
                who: "rover".parse().expect("a name"),
                services: "*".parse().expect("a pattern"),
                allow: vec![grant],
            };
            principals.add_rule(&rule).expect("written");
            standing.changed().await.expect("followed");
            let now = standing.borrow_and_update().clone();
            assert!(
                permits(&now, Operation::Subscribe, "/camera/x")
                    && !permits(&now, Operation::Publish, "/x")
            );
            let whole = principals.ended(&who, "detector", true).await;
            assert!(whole.contains("a stub needs all of detector"), "{whole}");
            principals.revoke("rover").expect("there");
            standing.changed().await.expect("followed");
            let ended = standing.borrow_and_update().clone();
            assert_eq!(ended, Standing::Ended("this token was revoked".into()));
        };
        tokio::select! {
            () = principals.follow(&who, "detector", &sender) => {}
            () = change => {}
        }
    }

    #[test]
    fn this_machines_users_need_a_token_once_there_is_one() {
        let World { principals, _home } = world(&[]);
        let local = Identity {
            principal: Arc::new(Principal::local()),
            shown: Shown::Nothing,
            token: None,
            owner: None,
        };
        assert!(permits(
            &principals.standing(&local, "any"),
            Operation::Publish,
            "/x"
        ));
        principals.create(&robot("rover")).expect("made");
        assert!(matches!(
            principals.standing(&local, "any"),
            Standing::Ended(_)
        ));
    }
}
