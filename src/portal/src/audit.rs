//! The audit log: who did what to what from where. It never contains secrets: of a request, only words for what it does
//! (`crate::routes::words`) and names from its path are recorded, never its query, headers or body.

pub mod records;

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use access::AccessAction;
use axum::http::Method;
use parking_lot::Mutex;
use serde::Serialize;
use store::{NewAuditRecord, NoticeThrottle, State};
use tokio::sync::watch;

use crate::caller::Caller;

/// Maximum length of an object's text, since some contain names chosen by a client.
pub const LONGEST: usize = 300;

/// Object of an action, set by the handler if the path does not name it.
#[derive(Debug, Clone, Default)]
pub struct AuditObject(Arc<OnceLock<String>>);

impl AuditObject {
    /// Sets the object.
    pub fn set(&self, object: String) {
        let _ = self.0.set(object);
    }

    /// Sets the object and the value that it is given, as JSON.
    pub fn set_value(&self, object: &str, value: &impl Serialize) {
        let value = serde_json::to_string(value).unwrap_or_default();
        self.set(format!("{object}: {value}"));
    }

    /// Returns the object that was set, or else `object`.
    pub fn get_or(&self, object: &str) -> String {
        self.0.get().cloned().unwrap_or_else(|| object.to_owned())
    }
}

/// Recent actions of a principal. Successes are throttled separately, so that failures, however many, cannot hide
/// them.
#[derive(Debug, Default)]
struct RecentActions {
    succeeded: NoticeThrottle,
    failed: NoticeThrottle,
}

impl RecentActions {
    fn throttle_for(&mut self, status: u16) -> &mut NoticeThrottle {
        if status < 400 { &mut self.succeeded } else { &mut self.failed }
    }
}

/// Writes the audit log.
pub struct Audit {
    state: Arc<State>,
    /// Recent actions by principal, so that nobody uses up another's share.
    recent: Mutex<HashMap<String, RecentActions>>,
    last: watch::Sender<i64>,
}

/// Returns true if requests of this kind are recorded whatever their outcome; others are recorded only when
/// forbidden.
pub fn is_recorded(action: AccessAction, method: &Method) -> bool {
    let reads = [AccessAction::Enter, AccessAction::Look, AccessAction::See];
    !reads.contains(&action) && method != Method::GET && method != Method::HEAD
}

fn truncate(text: &str) -> String {
    text.chars().take(LONGEST).collect()
}

impl Audit {
    /// Creates the log in the database `state`.
    pub fn new(state: Arc<State>) -> Audit {
        Audit { state, recent: Mutex::default(), last: watch::Sender::new(0) }
    }

    /// Records an action; it is on disk when this returns.
    pub fn record(&self, caller: &Caller, action: AccessAction, did: &str, object: &str, status: u16) {
        let what = AuditEntry { action, did, object, status, more: 0 };
        self.write(caller, &what, State::add_audit_record);
    }

    /// Records an action that may be repeated or tried often: once a minute, with the number of repetitions, and
    /// without waiting for the disk.
    pub fn record_throttled(&self, caller: &Caller, action: AccessAction, did: &str, object: &str, status: u16) {
        let (who, address) = (&caller.who.principal.name, caller.peer.ip());
        let (did, object) = (&truncate(did), &truncate(object));
        let alike = format!("{address} {did} {object} {status}");
        let more = {
            let mut recent = self.recent.lock();
            let own = recent.entry(who.clone()).or_default();
            own.throttle_for(status).admit(&alike, store::now())
        };
        if let Some(more) = more {
            let what = AuditEntry { action, did, object, status, more };
            self.write(caller, &what, State::add_audit_record_without_sync);
        }
    }

    /// Writes a record. If that fails, the action has still been done, so the daemon's log reports it.
    fn write(
        &self,
        caller: &Caller,
        what: &AuditEntry<'_>,
        add: fn(&State, &NewAuditRecord<'_>) -> Result<i64, store::Error>,
    ) {
        let recorded = add(
            &self.state,
            &NewAuditRecord {
                who: &caller.who.principal.to_string(),
                peer: &caller.peer.to_string(),
                action: what.action.name(),
                did: &truncate(what.did),
                object: &truncate(what.object),
                status: what.status,
                more: what.more,
            },
        );
        match recorded {
            Ok(id) => {
                self.last.send_if_modified(|last| {
                    let newer = id > *last;
                    *last = id.max(*last);
                    newer
                });
            }
            Err(error) => tracing::error!(
                "what {} did from {} is not in the audit log ({} {}): {error}",
                caller.who.principal,
                caller.peer,
                what.did,
                what.object
            ),
        }
    }
}

/// A record of the audit log.
struct AuditEntry<'a> {
    action: AccessAction,
    did: &'a str,
    object: &'a str,
    status: u16,
    more: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_changes_something_is_recorded() {
        for (action, method, recorded) in [
            (AccessAction::Deploy, Method::POST, true),
            (AccessAction::Operate, Method::DELETE, true),
            (AccessAction::Operate, Method::PATCH, true),
            (AccessAction::Administer, Method::POST, true),
            (AccessAction::Administer, Method::GET, false),
            (AccessAction::Try, Method::POST, true),
            (AccessAction::Logs, Method::GET, false),
            (AccessAction::See, Method::GET, false),
            (AccessAction::Enter, Method::POST, false),
        ] {
            assert_eq!(is_recorded(action, &method), recorded, "{action:?} {method}");
        }
    }
}
