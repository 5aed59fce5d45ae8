//! Access of open connections: whether their credential is still valid, and what they may do. Followers are notified
//! of changes at once.

use std::sync::Arc;
use std::time::Duration;

use access::{AccessPolicy, ConnectionAccess, Grants};
use api::Millis;
use tokio::sync::watch;

use super::Principals;
use super::identity::{CallerIdentity, Credential};
use crate::inside::connections::InsideRole;

/// Bounds on the interval at which expiry is checked.
const SOONEST: Duration = Duration::from_millis(10);
const LATEST: Duration = Duration::from_secs(60);

impl Principals {
    /// Returns the access of a connection to a service.
    pub fn connection_access(&self, who: &CallerIdentity, service: &str) -> ConnectionAccess {
        self.compute_access(who, |policy| policy.grants(&who.principal, service))
    }

    /// Returns the access of a connection that looks into a servant of a service.
    pub fn inside_access(&self, who: &CallerIdentity, service: &str, part: InsideRole) -> ConnectionAccess {
        self.compute_access(who, |policy| match part {
            InsideRole::Acts => policy.grants(&who.principal, service),
            InsideRole::Looks => policy.observer_grants(&who.principal, service),
        })
    }

    fn compute_access(&self, who: &CallerIdentity, grants: impl FnOnce(&AccessPolicy) -> Grants) -> ConnectionAccess {
        let stored = self.stored.read();
        let over = match &who.shown {
            Credential::Nothing if !(self.configured.is_empty() && stored.is_empty()) => {
                Some("a token is required since the first one was created".to_owned())
            }
            Credential::Stored { id, hash } => match stored.find_token(*id) {
                Some(known) if known.hash == *hash => known.refusal(store::now()).map(|over| over.to_string()),
                _ => Some("this token was replaced by a new one".to_owned()),
            },
            Credential::Certificate { pairing, until, .. } => {
                let over = stored.pairing_refusal(*pairing, *until, store::now());
                over.map(|over| over.to_string())
            }
            // A connection is not a request: it may stay open for the session's maximum lifetime.
            Credential::Session { id } => match stored.find_session(*id) {
                Some(known) if known.record.expires > store::now() => None,
                Some(_) => Some("this session has ended".to_owned()),
                None => Some("this session was ended".to_owned()),
            },
            Credential::Nothing | Credential::Loopback | Credential::Configured | Credential::User => None,
        };
        match over {
            Some(reason) => ConnectionAccess::Ended(reason),
            None => ConnectionAccess::Granted(Arc::new(grants(&stored.policy))),
        }
    }

    /// Returns when the caller's credential expires.
    pub(super) fn expiry(&self, who: &CallerIdentity) -> Option<Millis> {
        let stored = self.stored.read();
        match who.shown {
            Credential::Stored { id, .. } => stored.find_token(id)?.expires,
            Credential::Session { id } => Some(stored.find_session(id)?.record.expires),
            Credential::Certificate { pairing, until, .. } => stored.pairing_end(pairing, until),
            _ => None,
        }
    }

    /// Updates `standing` whenever the access of a connection changes; never returns.
    pub async fn follow_access(&self, who: &CallerIdentity, service: &str, standing: &watch::Sender<ConnectionAccess>) {
        self.watch_access(who, || self.connection_access(who, service), standing).await;
    }

    /// Updates `standing` whenever the access of a connection that looks into a servant changes; never returns.
    pub async fn follow_inside_access(
        &self,
        who: &CallerIdentity,
        service: &str,
        part: InsideRole,
        standing: &watch::Sender<ConnectionAccess>,
    ) {
        self.watch_access(who, || self.inside_access(who, service, part), standing).await;
    }

    async fn watch_access(
        &self,
        who: &CallerIdentity,
        stands: impl Fn() -> ConnectionAccess + Send,
        standing: &watch::Sender<ConnectionAccess>,
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
                let ends = self.expiry(who).filter(|_| matches!(now, ConnectionAccess::Granted(_)));
                let Some(end) = ends else {
                    return std::future::pending().await;
                };
                // Checked again, because the clock may be set meanwhile or the machine may have slept.
                let left = Duration::from_millis(end.saturating_sub(store::now()));
                tokio::time::sleep(left.clamp(SOONEST, LATEST)).await;
            };
            tokio::select! {
                _ = changed.changed() => {}
                () = expires => {}
            }
        }
    }

    /// Waits until a connection to a service must be closed and returns the reason. With `whole`, the connection
    /// needs all operations granted.
    pub async fn wait_for_end(&self, who: &CallerIdentity, service: &str, whole: bool) -> String {
        let (standing, mut told) = watch::channel(self.connection_access(who, service));
        let reason = async {
            loop {
                match &*told.borrow_and_update() {
                    ConnectionAccess::Ended(reason) => return reason.clone(),
                    ConnectionAccess::Granted(grants) if whole && !grants.is_everything() => {
                        return format!("this needs all of {service}, but only {grants} is granted");
                    }
                    ConnectionAccess::Granted(_) => {}
                }
                if told.changed().await.is_err() {
                    std::future::pending().await
                }
            }
        };
        tokio::select! {
            reason = reason => reason,
            () = self.follow_access(who, service, &standing) => std::future::pending().await,
        }
    }
}
