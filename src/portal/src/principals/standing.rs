//! How connections stand: whether what they were begun with still holds, and what they may do. Whoever follows hears of changes
//! at once.

use std::sync::Arc;
use std::time::Duration;

use access::{Grants, Policy, Standing};
use api::Millis;
use tokio::sync::watch;

use super::{Identity, Principals, Shown};
use crate::inside::Part;

/// How often it is looked whether a token has expired: no more, and no less, often.
const SOONEST: Duration = Duration::from_millis(10);
const LATEST: Duration = Duration::from_secs(60);

impl Principals {
    /// How a connection of somebody to a service stands.
    pub fn standing(&self, who: &Identity, service: &str) -> Standing {
        self.stands(who, |policy| policy.grants(&who.principal, service))
    }

    /// How a connection of somebody who looks into a servant of a service stands.
    pub fn standing_inside(&self, who: &Identity, service: &str, part: Part) -> Standing {
        self.stands(who, |policy| match part {
            Part::Acts => policy.grants(&who.principal, service),
            Part::Looks => policy.hearing(&who.principal, service),
        })
    }

    fn stands(&self, who: &Identity, grants: impl FnOnce(&Policy) -> Grants) -> Standing {
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
            // A connection is no request: it stays for as long as the session may last at most.
            Shown::Session { id } => match stored.session_of_id(*id) {
                Some(known) if known.record.expires > store::now() => None,
                Some(_) => Some("this session is over".to_owned()),
                None => Some("this session was ended".to_owned()),
            },
            Shown::Nothing | Shown::Configured | Shown::User => None,
        };
        match over {
            Some(reason) => Standing::Ended(reason),
            None => Standing::Granted(Arc::new(grants(&stored.policy))),
        }
    }

    /// Until when somebody's token or session is good.
    pub(super) fn expiry(&self, who: &Identity) -> Option<Millis> {
        let stored = self.stored.read();
        match who.shown {
            Shown::Stored { id, .. } => stored.of_id(id)?.expires,
            Shown::Session { id } => Some(stored.session_of_id(id)?.record.expires),
            Shown::Certificate { pairing, until, .. } => stored.pairing_end(pairing, until),
            _ => None,
        }
    }

    /// Tells `standing` whenever that of a connection changes; never comes back.
    pub async fn follow(&self, who: &Identity, service: &str, standing: &watch::Sender<Standing>) {
        self.follows(who, || self.standing(who, service), standing)
            .await;
    }

    /// The same of a connection of somebody who looks into a servant.
    pub async fn follow_inside(
        &self,
        who: &Identity,
        service: &str,
        part: Part,
        standing: &watch::Sender<Standing>,
    ) {
        self.follows(who, || self.standing_inside(who, service, part), standing)
            .await;
    }

    async fn follows(
        &self,
        who: &Identity,
        stands: impl Fn() -> Standing + Send,
        standing: &watch::Sender<Standing>,
    ) {
        let mut changed = self.changed.subscribe();
        loop {
            changed.borrow_and_update();
            let now = stands();
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
}
