//! The audit log: who did what to what from where. Secrets are in none of it: of a request only method and path, which has
//! names alone, never its query, headers or body.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use access::{Action, Sparing};
use axum::Extension;
use axum::extract::State as AxumState;
use axum::http::Method;
use axum::response::Response;
use futures_util::StreamExt;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use store::{NewAudited, State};
use tokio::sync::watch;
use utoipa::IntoParams;

use super::api_v1::lines;
use super::guard::Caller;
use crate::app::App;
use crate::errors::Error;
use crate::query::Query;

/// Longest text of an object: some hold names that a client chose.
const LONGEST: usize = 300;
/// Records when nobody says how many.
const RECORDS: u32 = 100;
/// Records that are read at once for somebody who follows.
const AT_ONCE: u32 = 1_000;

/// What a handler tells of its object where the address does not name it.
#[derive(Debug, Clone, Default)]
pub struct About(Arc<OnceLock<String>>);

impl About {
    /// Says what it is about.
    pub fn is(&self, object: String) {
        let _ = self.0.set(object);
    }

    /// Names an object and the value that it is given, as JSON.
    pub fn is_set(&self, object: &str, value: &impl Serialize) {
        let value = serde_json::to_string(value).unwrap_or_default();
        self.is(format!("{object}: {value}"));
    }

    /// What was said, or else `object`.
    pub fn or(&self, object: &str) -> String {
        self.0.get().cloned().unwrap_or_else(|| object.to_owned())
    }
}

/// What a principal did lately. What succeeded has a room of its own: however much fails, it hides nothing that was done.
#[derive(Debug, Default)]
struct Recent {
    succeeded: Sparing,
    failed: Sparing,
}

impl Recent {
    fn room(&mut self, status: u16) -> &mut Sparing {
        if status < 400 {
            &mut self.succeeded
        } else {
            &mut self.failed
        }
    }
}

/// Records what callers do.
pub struct Audit {
    state: Arc<State>,
    /// Of each principal, so that nobody takes another's room.
    recent: Mutex<HashMap<String, Recent>>,
    last: watch::Sender<i64>,
}

/// Whether a request is recorded however it ends: others only when they were refused.
pub fn is_recorded(action: Action, method: &Method) -> bool {
    let reads = [Action::Enter, Action::Look, Action::See];
    !reads.contains(&action) && method != Method::GET && method != Method::HEAD
}

fn cut(text: &str) -> String {
    text.chars().take(LONGEST).collect()
}

impl Audit {
    /// Into `state`.
    pub fn new(state: Arc<State>) -> Audit {
        Audit {
            state,
            recent: Mutex::default(),
            last: watch::Sender::new(0),
        }
    }

    /// Records what was done, on disk when this returns.
    pub fn record(&self, caller: &Caller, action: Action, did: &str, object: &str, status: u16) {
        let what = What {
            action,
            did,
            object,
            status,
            more: 0,
        };
        self.write(caller, &what, State::add_audited);
    }

    /// Records what may be done, or tried, again and again: once a minute, with how often it was, and without waiting for the
    /// disk.
    pub fn record_sparingly(
        &self,
        caller: &Caller,
        action: Action,
        did: &str,
        object: &str,
        status: u16,
    ) {
        let (who, address) = (&caller.who.principal.name, caller.peer.ip());
        let (did, object) = (&cut(did), &cut(object));
        let alike = format!("{address} {did} {object} {status}");
        let more = {
            let mut recent = self.recent.lock();
            let own = recent.entry(who.clone()).or_default();
            own.room(status).ask(&alike, store::now())
        };
        if let Some(more) = more {
            let what = What {
                action,
                did,
                object,
                status,
                more,
            };
            self.write(caller, &what, State::add_audited_soon);
        }
    }

    /// What cannot be recorded has been done: the log says so.
    fn write(
        &self,
        caller: &Caller,
        what: &What<'_>,
        add: fn(&State, &NewAudited<'_>) -> Result<i64, store::Error>,
    ) {
        let recorded = add(
            &self.state,
            &NewAudited {
                who: &caller.who.principal.to_string(),
                peer: &caller.peer.to_string(),
                action: what.action.name(),
                did: &cut(what.did),
                object: &cut(what.object),
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

/// What is recorded of a request.
struct What<'a> {
    action: Action,
    did: &'a str,
    object: &'a str,
    status: u16,
    more: u64,
}

/// Which records.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Which {
    /// Go on as they come.
    #[serde(default)]
    follow: bool,
    /// Only those with a greater number.
    #[serde(default)]
    since: i64,
    /// So many of the newest; 100 by default.
    limit: Option<u32>,
}

/// The audit log, as JSON lines.
pub async fn audit(
    AxumState(app): AxumState<Arc<App>>,
    Query(which): Query<Which>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let told = app.audit.last.subscribe();
    let past = app
        .state
        .audited(which.since, which.limit.unwrap_or(RECORDS))?;
    if !which.follow {
        return Ok(lines(futures_util::stream::iter(past)));
    }
    let since = past.last().map_or(which.since, |record| record.id);
    let reader = Arc::clone(&app);
    let coming = futures_util::stream::try_unfold((since, told), move |(since, mut told)| {
        let app = Arc::clone(&reader);
        async move {
            loop {
                told.borrow_and_update();
                // The newest are read: who reads too slowly for a thousand at a time misses the older ones, and sees it by their numbers.
                let new = app.state.audited(since, AT_ONCE)?;
                if let Some(last) = new.last() {
                    let since = last.id;
                    return Ok::<_, store::Error>(Some((new, (since, told))));
                }
                if told.changed().await.is_err() {
                    return Ok(None);
                }
            }
        }
    });
    let coming = coming
        .take_while(|new| std::future::ready(new.is_ok()))
        .flat_map(|new| futures_util::stream::iter(new.unwrap_or_default()));
    let ending = caller.over(&app, "");
    Ok(lines(
        futures_util::stream::iter(past)
            .chain(coming)
            .take_until(ending),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_changes_something_is_recorded() {
        for (action, method, recorded) in [
            (Action::Deploy, Method::POST, true),
            (Action::Operate, Method::DELETE, true),
            (Action::Operate, Method::PATCH, true),
            (Action::Administer, Method::POST, true),
            (Action::Administer, Method::GET, false),
            (Action::Try, Method::POST, true),
            (Action::Logs, Method::GET, false),
            (Action::See, Method::GET, false),
            (Action::Enter, Method::POST, false),
        ] {
            assert_eq!(
                is_recorded(action, &method),
                recorded,
                "{action:?} {method}"
            );
        }
    }
}
