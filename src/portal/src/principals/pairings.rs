//! Paired robots and pairing codes: which certificates are accepted, and whether their pairings are still valid
//! (docs/adr/086).

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use access::{Principal, Role, Scope};
use api::Millis;
use api::machines::{NewPairing, Pairing, PairingState};
use authority::{Authority, CertificateRequest, IssuedRobotCertificate, VerifiedCertificate as Certificate};
use catalogue::names;
use store::{CodeRecord, Owner, PairingRecord};

use super::changing::{NameHolder, RESERVED_PRINCIPALS};
use super::identity::{CallerIdentity, Credential};
use super::recognising::Recogniser;
use super::refusals::{AuthenticationError, CertificateRefusal, PairingCodeRefusal};
use super::stored::{StoredPrincipals, StoredScope, record_error};
use super::{Principals, USE_INTERVAL};
use crate::errors::Error;
use crate::tokens;

/// Lifetime of a pairing code in seconds: default and maximum.
const CODE: u64 = 15 * 60;
const LONGEST_CODE: u64 = 7 * 86_400;

/// Number of times per certificate lifetime that the end of a robot's newest certificate is written.
const WRITES_PER_LIFETIME: Millis = 10;

/// A pairing of the database, in memory.
pub(super) struct StoredPairing {
    id: i64,
    robot: String,
    /// `None` if another authority signs the robot's certificates.
    key: Option<String>,
    principal: Arc<Principal>,
    created: Millis,
    expires: Option<Millis>,
    last_used: AtomicU64,
    revoked: bool,
}

fn read_scope(robot: &str, text: &str) -> Result<StoredScope, store::Error> {
    serde_json::from_str(text).map_err(record_error(format!("the pairing of {robot}")))
}

pub(super) fn read_pairing(record: PairingRecord) -> Result<StoredPairing, store::Error> {
    let scope = read_scope(&record.robot, &record.scope)?;
    Ok(StoredPairing {
        id: record.id,
        key: record.key,
        principal: Arc::new(Principal {
            name: record.robot.clone(),
            roles: vec![Role::Robot],
            scope: Scope { services: scope.services, robot: Some(record.robot.clone()), classes: scope.classes },
        }),
        robot: record.robot,
        created: record.created,
        expires: record.expires,
        last_used: AtomicU64::new(record.last_used.unwrap_or_default()),
        revoked: record.revoked.is_some(),
    })
}

/// Returns the owner of a paired robot's name, the same as for a token of that robot.
fn robot_owner(robot: &str) -> Owner {
    format!("robot:{robot}")
}

impl StoredPairing {
    fn to_pairing(&self) -> Pairing {
        let Scope { services, classes, .. } = &self.principal.scope;
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

    /// Returns when a connection's permission ends: with the newest certificate of the key or, if another authority
    /// signs them, with the certificate presented.
    fn valid_until(&self, shown: Millis) -> Millis {
        match self.key {
            Some(_) => self.expires.unwrap_or(shown).max(shown),
            None => shown,
        }
    }
}

impl StoredPrincipals {
    fn find_pairing(&self, id: i64) -> Option<&StoredPairing> {
        self.pairings.iter().find(|paired| paired.id == id)
    }

    /// Returns the robot's current pairing.
    fn live_pairing(&self, robot: &str) -> Option<&StoredPairing> {
        let mut live = self.pairings.iter().filter(|paired| !paired.revoked);
        live.find(|paired| paired.robot == robot)
    }

    /// Returns true if the robot was ever paired.
    fn was_paired(&self, robot: &str) -> bool {
        self.pairings.iter().any(|paired| paired.robot == robot)
    }

    /// Returns why the pairing no longer admits a connection whose certificate is valid until `until`.
    pub(super) fn pairing_refusal(&self, id: i64, until: Millis, now: Millis) -> Option<CertificateRefusal> {
        let paired = self.find_pairing(id)?;
        let robot = paired.robot.clone();
        match () {
            () if paired.revoked && self.live_pairing(&robot).is_some() => Some(CertificateRefusal::Replaced(robot)),
            () if paired.revoked => Some(CertificateRefusal::Unpaired(robot)),
            () if paired.valid_until(until) <= now => Some(CertificateRefusal::Expired(robot)),
            () => None,
        }
    }

    /// Returns when the pairing's permission ends unless it is renewed.
    pub(super) fn pairing_end(&self, id: i64, until: Millis) -> Option<Millis> {
        self.find_pairing(id).map(|paired| paired.valid_until(until))
    }

    /// Returns the owners of paired robots' names.
    pub(super) fn paired_owners(&self) -> impl Iterator<Item = Owner> {
        let live = self.pairings.iter().filter(|paired| !paired.revoked);
        live.map(|paired| robot_owner(&paired.robot))
    }

    /// Takes over uses that are not written yet.
    pub(super) fn keep_uses(&self, before: &StoredPrincipals) {
        for paired in &self.pairings {
            if let Some(before) = before.find_pairing(paired.id) {
                let last = before.last_used.load(Ordering::Relaxed);
                paired.last_used.fetch_max(last, Ordering::Relaxed);
            }
        }
    }
}

impl Recogniser<'_> {
    /// Identifies the robot of a verified certificate, that is, one signed by a trusted authority and presented by
    /// the holder of its key.
    pub fn recognise_certificate(
        &self,
        authority: &Authority,
        shown: &Certificate,
        now: Millis,
    ) -> Result<CallerIdentity, CertificateRefusal> {
        let robot = || shown.robot.clone();
        let Some(paired) = self.stored.live_pairing(&shown.robot) else {
            return Err(if self.stored.was_paired(&shown.robot) {
                CertificateRefusal::Unpaired(robot())
            } else {
                CertificateRefusal::NotPaired(robot())
            });
        };
        let is_its_own = match &paired.key {
            Some(key) => authority.has_issued(shown) && *key == shown.key,
            // Certificates of the daemon's authority belong to an earlier pairing.
            None => !authority.has_issued(shown),
        };
        if !is_its_own {
            return Err(CertificateRefusal::Replaced(robot()));
        }
        if paired.valid_until(shown.until) <= now {
            return Err(CertificateRefusal::Expired(robot()));
        }
        Ok(CallerIdentity {
            principal: Arc::clone(&paired.principal),
            shown: Credential::Certificate { pairing: paired.id, key: paired.key.clone(), until: shown.until },
            token: None,
            owner: Some(robot_owner(&paired.robot)),
        })
    }
}

impl Principals {
    /// Records that a paired robot connected, with a resolution of a minute.
    pub(super) fn record_pairing_use(&self, id: i64, now: Millis) {
        let stored = self.stored.read();
        let due = stored.find_pairing(id).is_some_and(|paired| {
            let last = paired.last_used.load(Ordering::Relaxed);
            now.saturating_sub(last) >= USE_INTERVAL
                && paired.last_used.compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed).is_ok()
        });
        drop(stored);
        if due && let Err(error) = self.state.record_pairing_use(id, now) {
            tracing::warn!("cannot store when a robot last connected: {error}");
        }
    }

    /// Returns paired robots and pending pairing codes.
    pub fn pairings(&self) -> Result<Vec<Pairing>, Error> {
        let waiting = self.state.pairing_codes(store::now())?;
        let mut all: Vec<Pairing> = {
            let stored = self.stored.read();
            let live = stored.pairings.iter().filter(|paired| !paired.revoked);
            live.map(StoredPairing::to_pairing).collect()
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

    /// Creates a pairing code for a robot, replacing a pending one; returns the code and its expiry.
    pub fn begin_pairing(&self, new: &NewPairing) -> Result<(String, Millis), Error> {
        check_pairing(new)?;
        self.check_name_is_free(&new.robot, NameHolder::Pairing)?;
        let seconds = new.lifetime.unwrap_or(CODE);
        let expires = store::now() + seconds * 1000;
        let code = names::random(::tls::CODE);
        let scope = self.encode_scope(new)?;
        self.state.add_pairing_code(&new.robot, &tokens::hash(&code), &scope, expires)?;
        Ok((code, expires))
    }

    /// Pairs a robot that has certificates of the operator's own authority.
    pub fn pair_own(&self, new: &NewPairing) -> Result<(), Error> {
        check_pairing(new)?;
        self.check_name_is_free(&new.robot, NameHolder::Pairing)?;
        self.state.add_pairing(&new.robot, &self.encode_scope(new)?)?;
        self.state.bind_robot(&new.robot, &robot_owner(&new.robot))?;
        Ok(self.reload()?)
    }

    fn encode_scope(&self, new: &NewPairing) -> Result<String, Error> {
        let scope = StoredScope {
            services: new.services.clone(),
            robot: Some(new.robot.clone()),
            classes: new.classes.clone(),
        };
        let what = format!("the pairing of {}", new.robot);
        Ok(serde_json::to_string(&scope).map_err(record_error(what))?)
    }

    /// Checks a pairing code that came from an address for a robot. An unknown code counts as a guess, like an
    /// unknown token.
    pub fn check_code(&self, robot: &str, code: &str, from: IpAddr, now: Millis) -> Result<CodeRecord, Error> {
        let known = self.state.pairing_code(&tokens::hash(code))?;
        let Some(known) = known.filter(|_| ::tls::is_code(code)) else {
            let mut guesses = self.guesses.lock();
            guesses.check(from, now).map_err(AuthenticationError::Slowed)?;
            guesses.record_failure(from, now);
            return Err(PairingCodeRefusal::Unknown.into());
        };
        let refused = match &known {
            known if known.robot != robot => Some(PairingCodeRefusal::Another),
            known if known.used.is_some() => Some(PairingCodeRefusal::Used),
            known if known.cancelled.is_some() => Some(PairingCodeRefusal::Cancelled),
            known if known.expires <= now => Some(PairingCodeRefusal::Expired),
            _ => None,
        };
        match refused {
            Some(refused) => Err(refused.into()),
            None => Ok(known),
        }
    }

    /// Uses a pairing code: issues a certificate to its robot, ending an earlier pairing.
    pub fn pair(
        &self,
        code: &CodeRecord,
        request: &CertificateRequest,
        authority: &Authority,
        lifetime: Duration,
    ) -> Result<IssuedRobotCertificate, Error> {
        let issued = authority.issue(request, &code.robot, store::now(), lifetime).map_err(Error::Uncertifiable)?;
        self.state.use_pairing_code(code.id, request.key_hash(), issued.expires)?.ok_or(PairingCodeRefusal::Used)?;
        self.state.bind_robot(&code.robot, &robot_owner(&code.robot))?;
        self.reload()?;
        Ok(issued)
    }

    /// Renews the certificate of a paired robot. `pairing` is the one under which it asks.
    pub fn renew(
        &self,
        (pairing, robot): (i64, &str),
        request: &CertificateRequest,
        authority: &Authority,
        lifetime: Duration,
    ) -> Result<IssuedRobotCertificate, Error> {
        let issued = authority.issue(request, robot, store::now(), lifetime).map_err(Error::Uncertifiable)?;
        // Frequent renewals do not each cause a write.
        let lately = issued.expires.saturating_sub(lifetime.as_millis() as Millis / WRITES_PER_LIFETIME);
        let known = {
            let stored = self.stored.read();
            let live = stored.find_pairing(pairing).filter(|paired| !paired.revoked);
            live.and_then(|paired| paired.expires)
        };
        if known.is_none_or(|known| known < lately) {
            if !self.state.extend_pairing(pairing, issued.expires)? {
                return Err(CertificateRefusal::Unpaired(robot.to_owned()).into());
            }
            self.reload()?;
        }
        Ok(issued)
    }

    /// Ends a robot's pairing and its connections, and cancels its pairing code.
    pub fn unpair(&self, robot: &str) -> Result<(), Error> {
        let there = self.state.revoke_pairing(robot)?;
        self.reload()?;
        self.release_robots()?;
        if there { Ok(()) } else { Err(self.unknown_pairing(robot)?) }
    }

    /// Cancels a robot's pairing code.
    pub fn cancel_pairing(&self, robot: &str) -> Result<(), Error> {
        if self.state.cancel_pairing_code(robot)? { Ok(()) } else { Err(self.unknown_pairing(robot)?) }
    }

    fn unknown_pairing(&self, robot: &str) -> Result<Error, Error> {
        let exists = self.pairings()?.into_iter();
        Ok(Error::UnknownPairing { name: robot.to_owned(), exists: exists.map(|pairing| pairing.robot).collect() })
    }
}

/// Checks a new pairing.
fn check_pairing(new: &NewPairing) -> Result<(), Error> {
    let refused = |words: String| Err(Error::BadRequest(words));
    names::validate_robot(&new.robot).map_err(|error| Error::BadRequest(error.to_string()))?;
    if RESERVED_PRINCIPALS.contains(&new.robot.as_str()) {
        return refused(format!("{} is a reserved name; choose another", new.robot));
    }
    if new.services.is_empty() {
        return refused(
            "a robot is paired for given services; give them with --services, or all with --services '*'".to_owned(),
        );
    }
    match new.lifetime {
        Some(0) => refused("a code that expires at once is useless; give a longer --ttl".to_owned()),
        Some(seconds) if seconds > LONGEST_CODE => refused(
            "a pairing code is valid for at most 7d, since whoever finds it can act as the \
                robot; give a shorter --ttl"
                .to_owned(),
        ),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
