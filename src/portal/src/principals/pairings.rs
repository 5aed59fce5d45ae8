//! Robots that are paired, and the codes by which they are: who shows which certificate, and whether its pairing stands
//! (docs/adr/086).

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use access::{Principal, Role, Scope};
use api::Millis;
use api::machines::{NewPairing, Pairing, PairingState};
use authority::{Authority, Issued, Request, Shown as Certificate};
use catalogue::names;
use store::{CodeRecord, Owner, PairingRecord};

use super::changing::{Named, RESERVED};
use super::stored::{StoredScope, damaged};
use super::{Identity, Principals, Recognising, Shown, Stored, USED, Unrecognised};
use crate::errors::Error;
use crate::tokens;

/// How long a code is good where nobody says it, and at most: seconds.
const CODE: u64 = 15 * 60;
const LONGEST_CODE: u64 = 7 * 86_400;

/// The end of a robot's newest certificate is written so often in the life of one.
const OFTEN: Millis = 10;

/// Why a certificate lets nobody in, though an authority that is trusted has signed it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Uncertified {
    /// It names no robot.
    #[error("{0}")]
    Nameless(String),
    /// Nobody has paired the robot.
    #[error("robot {0} is not paired")]
    NotPaired(String),
    /// Its pairing has ended.
    #[error("robot {0} was unpaired")]
    Unpaired(String),
    /// Another key is paired by now, or another authority's certificate.
    #[error("robot {0} was paired anew, with another key than this certificate has")]
    Replaced(String),
    /// It has ended, on a connection that goes on.
    #[error("the certificate of robot {0} has expired")]
    Expired(String),
}

/// Why a pairing code pairs nobody.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Uncoded {
    /// Nobody has made it.
    #[error("this pairing code is not known")]
    Unknown,
    /// It is of another robot.
    #[error("this pairing code is for another robot")]
    Another,
    /// It is good once.
    #[error("this pairing code was used already")]
    Used,
    /// It was taken back, or there is a newer one.
    #[error("this pairing code was cancelled, or a newer one took its place")]
    Cancelled,
    /// It was good for some minutes.
    #[error("this pairing code has expired")]
    Expired,
}

/// A pairing of the database, in memory.
pub(super) struct Paired {
    id: i64,
    robot: String,
    /// None: another authority signs its certificates.
    key: Option<String>,
    principal: Arc<Principal>,
    created: Millis,
    expires: Option<Millis>,
    last_used: AtomicU64,
    revoked: bool,
}

fn read_scope(robot: &str, text: &str) -> Result<StoredScope, store::Error> {
    serde_json::from_str(text).map_err(damaged(format!("the pairing of {robot}")))
}

pub(super) fn read(record: PairingRecord) -> Result<Paired, store::Error> {
    let scope = read_scope(&record.robot, &record.scope)?;
    Ok(Paired {
        id: record.id,
        key: record.key,
        principal: Arc::new(Principal {
            name: record.robot.clone(),
            roles: vec![Role::Robot],
            scope: Scope {
                services: scope.services,
                robot: Some(record.robot.clone()),
                classes: scope.classes,
            },
        }),
        robot: record.robot,
        created: record.created,
        expires: record.expires,
        last_used: AtomicU64::new(record.last_used.unwrap_or_default()),
        revoked: record.revoked.is_some(),
    })
}

/// Whose a robot's name is that is paired: the same as of a token of that robot.
fn owner(robot: &str) -> Owner {
    format!("robot:{robot}")
}

impl Paired {
    fn view(&self) -> Pairing {
        let Scope {
            services, classes, ..
        } = &self.principal.scope;
        let last = self.last_used.load(Ordering::Relaxed);
        Pairing {
            robot: self.robot.clone(),
            services: services.clone(),
            classes: classes.clone(),
            state: PairingState::Paired,
            own_certificate: self.key.is_none(),
            created: self.created,
            expires: self.expires,
            last_used: (last > 0).then_some(last),
        }
    }

    /// The end of a connection's right: of the newest certificate of the key, or of the one that was shown where another authority
    /// signs them.
    fn end(&self, shown: Millis) -> Millis {
        match self.key {
            Some(_) => self.expires.unwrap_or(shown).max(shown),
            None => shown,
        }
    }
}

impl Stored {
    fn of_pairing(&self, id: i64) -> Option<&Paired> {
        self.pairings.iter().find(|paired| paired.id == id)
    }

    /// The one that stands.
    fn paired(&self, robot: &str) -> Option<&Paired> {
        let mut live = self.pairings.iter().filter(|paired| !paired.revoked);
        live.find(|paired| paired.robot == robot)
    }

    /// Whether it is known that a robot was paired at any time.
    fn was_paired(&self, robot: &str) -> bool {
        self.pairings.iter().any(|paired| paired.robot == robot)
    }

    /// Why a pairing lets nobody in any more, whose certificate is good until `until`.
    pub(super) fn pairing_over(&self, id: i64, until: Millis, now: Millis) -> Option<Uncertified> {
        let paired = self.of_pairing(id)?;
        let robot = paired.robot.clone();
        match () {
            () if paired.revoked && self.paired(&robot).is_some() => {
                Some(Uncertified::Replaced(robot))
            }
            () if paired.revoked => Some(Uncertified::Unpaired(robot)),
            () if paired.end(until) <= now => Some(Uncertified::Expired(robot)),
            () => None,
        }
    }

    /// When somebody's pairing ends if nothing is done.
    pub(super) fn pairing_end(&self, id: i64, until: Millis) -> Option<Millis> {
        self.of_pairing(id).map(|paired| paired.end(until))
    }

    /// Owners of robots' names that are paired.
    pub(super) fn paired_owners(&self) -> impl Iterator<Item = Owner> {
        let live = self.pairings.iter().filter(|paired| !paired.revoked);
        live.map(|paired| owner(&paired.robot))
    }

    /// Uses that are not written yet.
    pub(super) fn keep_uses(&self, before: &Stored) {
        for paired in &self.pairings {
            if let Some(before) = before.of_pairing(paired.id) {
                let last = before.last_used.load(Ordering::Relaxed);
                paired.last_used.fetch_max(last, Ordering::Relaxed);
            }
        }
    }
}

impl Recognising<'_> {
    /// Whose a certificate is, that was verified: signed by somebody who is trusted, and shown by who has its key.
    pub fn certified(
        &self,
        authority: &Authority,
        shown: &Certificate,
        now: Millis,
    ) -> Result<Identity, Uncertified> {
        let robot = || shown.robot.clone();
        let Some(paired) = self.stored.paired(&shown.robot) else {
            return Err(match self.stored.was_paired(&shown.robot) {
                true => Uncertified::Unpaired(robot()),
                false => Uncertified::NotPaired(robot()),
            });
        };
        let is_its_own = match &paired.key {
            Some(key) => authority.has_signed(shown) && *key == shown.key,
            // What the daemon's authority signed was for a pairing before this one.
            None => !authority.has_signed(shown),
        };
        if !is_its_own {
            return Err(Uncertified::Replaced(robot()));
        }
        if paired.end(shown.until) <= now {
            return Err(Uncertified::Expired(robot()));
        }
        Ok(Identity {
            principal: Arc::clone(&paired.principal),
            shown: Shown::Certificate {
                pairing: paired.id,
                key: paired.key.clone(),
                until: shown.until,
            },
            token: None,
            owner: Some(owner(&paired.robot)),
        })
    }
}

impl Principals {
    /// Remembers that a paired robot came, to the minute.
    pub(super) fn note_pairing(&self, id: i64, now: Millis) {
        let stored = self.stored.read();
        let due = stored.of_pairing(id).is_some_and(|paired| {
            let last = paired.last_used.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USED
                && paired
                    .last_used
                    .compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed)
                    .is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.pairing_used(id, now) {
            tracing::warn!("when a robot came last cannot be written: {error}");
        }
    }

    /// Robots that are paired, and those for which a code waits.
    pub fn pairings(&self) -> Result<Vec<Pairing>, Error> {
        let waiting = self.state.pairing_codes(store::now())?;
        let mut all: Vec<Pairing> = {
            let stored = self.stored.read();
            let live = stored.pairings.iter().filter(|paired| !paired.revoked);
            live.map(Paired::view).collect()
        };
        for code in waiting {
            let scope = read_scope(&code.robot, &code.scope)?;
            all.push(Pairing {
                robot: code.robot,
                services: scope.services,
                classes: scope.classes,
                state: PairingState::Waiting,
                own_certificate: false,
                created: code.created,
                expires: Some(code.expires),
                last_used: None,
            });
        }
        all.sort_by(|one, other| one.robot.cmp(&other.robot));
        Ok(all)
    }

    /// Makes a code for a robot, in place of one that it has: the code, and its end.
    pub fn begin_pairing(&self, new: &NewPairing) -> Result<(String, Millis), Error> {
        check(new).map_err(Error::BadRequest)?;
        self.check_name_is_free(&new.robot, Named::Pairing)?;
        let seconds = new.lifetime.unwrap_or(CODE);
        let expires = store::now() + seconds * 1000;
        let code = names::random(::tls::CODE);
        let scope = self.scope_of(new)?;
        self.state
            .add_pairing_code(&new.robot, &tokens::hash(&code), &scope, expires)?;
        Ok((code, expires))
    }

    /// Pairs a robot that has certificates of the lab's own authority.
    pub fn pair_own(&self, new: &NewPairing) -> Result<(), Error> {
        check(new).map_err(Error::BadRequest)?;
        self.check_name_is_free(&new.robot, Named::Pairing)?;
        self.state.add_pairing(&new.robot, &self.scope_of(new)?)?;
        self.state.bind_robot(&new.robot, &owner(&new.robot))?;
        Ok(self.reload()?)
    }

    fn scope_of(&self, new: &NewPairing) -> Result<String, Error> {
        let scope = StoredScope {
            services: new.services.clone(),
            robot: Some(new.robot.clone()),
            classes: new.classes.clone(),
        };
        let what = format!("the pairing of {}", new.robot);
        Ok(serde_json::to_string(&scope).map_err(damaged(what))?)
    }

    /// A code that came from an address for a robot, if it could be used now. One that nobody has made is a guess, as an unknown
    /// token is.
    pub fn code(
        &self,
        robot: &str,
        code: &str,
        from: IpAddr,
        now: Millis,
    ) -> Result<CodeRecord, Error> {
        let known = self.state.pairing_code(&tokens::hash(code))?;
        let Some(known) = known.filter(|_| ::tls::is_code(code)) else {
            let mut guesses = self.guesses.lock();
            guesses.ask(from, now).map_err(Unrecognised::Slowed)?;
            guesses.failed(from, now);
            return Err(Uncoded::Unknown.into());
        };
        let refused = match &known {
            known if known.robot != robot => Some(Uncoded::Another),
            known if known.used.is_some() => Some(Uncoded::Used),
            known if known.cancelled.is_some() => Some(Uncoded::Cancelled),
            known if known.expires <= now => Some(Uncoded::Expired),
            _ => None,
        };
        match refused {
            Some(refused) => Err(refused.into()),
            None => Ok(known),
        }
    }

    /// Uses a code: gives its robot a certificate. A pairing that it had ends.
    pub fn pair(
        &self,
        code: &CodeRecord,
        request: &Request,
        authority: &Authority,
        lifetime: Duration,
    ) -> Result<Issued, Error> {
        let issued = authority
            .issue(request, &code.robot, store::now(), lifetime)
            .map_err(Error::Uncertifiable)?;
        self.state
            .use_pairing_code(code.id, request.key_hash(), issued.expires)?
            .ok_or(Uncoded::Used)?;
        self.state.bind_robot(&code.robot, &owner(&code.robot))?;
        self.reload()?;
        Ok(issued)
    }

    /// Gives a paired robot another certificate of its key. `pairing` is that by which it asks.
    pub fn renew(
        &self,
        (pairing, robot): (i64, &str),
        request: &Request,
        authority: &Authority,
        lifetime: Duration,
    ) -> Result<Issued, Error> {
        let issued = authority
            .issue(request, robot, store::now(), lifetime)
            .map_err(Error::Uncertifiable)?;
        // Who asks again and again makes nobody write each time.
        let lately = issued
            .expires
            .saturating_sub(lifetime.as_millis() as Millis / OFTEN);
        let known = {
            let stored = self.stored.read();
            let live = stored.of_pairing(pairing).filter(|paired| !paired.revoked);
            live.and_then(|paired| paired.expires)
        };
        if known.is_none_or(|known| known < lately) {
            if !self.state.pairing_renewed(pairing, issued.expires)? {
                return Err(Uncertified::Unpaired(robot.to_owned()).into());
            }
            self.reload()?;
        }
        Ok(issued)
    }

    /// Ends a robot's pairing, its connections, and a code that waits for it.
    pub fn unpair(&self, robot: &str) -> Result<(), Error> {
        let there = self.state.revoke_pairing(robot)?;
        self.reload()?;
        self.release_robots()?;
        match there {
            true => Ok(()),
            false => Err(self.unknown_pairing(robot)?),
        }
    }

    /// Takes a robot's code back.
    pub fn cancel_pairing(&self, robot: &str) -> Result<(), Error> {
        match self.state.cancel_pairing_code(robot)? {
            true => Ok(()),
            false => Err(self.unknown_pairing(robot)?),
        }
    }

    fn unknown_pairing(&self, robot: &str) -> Result<Error, Error> {
        let exists = self.pairings()?.into_iter();
        Ok(Error::UnknownPairing {
            name: robot.to_owned(),
            exists: exists.map(|pairing| pairing.robot).collect(),
        })
    }
}

/// Refuses what cannot be a pairing, in words.
fn check(new: &NewPairing) -> Result<(), String> {
    names::robot(&new.robot).map_err(|error| error.to_string())?;
    if RESERVED.contains(&new.robot.as_str()) {
        return Err(format!(
            "{} is a name that the daemon uses itself; choose another",
            new.robot
        ));
    }
    if new.services.is_empty() {
        return Err(
            "a robot is paired for services that are named; name them with --services, or all with --services '*'".into(),
        );
    }
    match new.lifetime {
        Some(0) => Err("a code that ends at once is of no use; give it a longer --ttl".into()),
        Some(seconds) if seconds > LONGEST_CODE => Err(
            "a pairing code is good for 7d at most: who finds the line is the robot; give it a shorter --ttl".into(),
        ),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
