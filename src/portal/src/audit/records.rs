//! `/api/v1/audit`: the records of the audit log.

use std::sync::Arc;

use axum::Extension;
use axum::extract::State;
use axum::response::Response;
use futures_util::StreamExt;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::json_lines;
use crate::query::Query;

/// Default number of records.
const RECORDS: u32 = 100;
/// Number of records read at once for a follower.
const AT_ONCE: u32 = 1_000;

/// Query of the audit log.
#[derive(Debug, Deserialize, IntoParams)]
pub struct AuditQuery {
    /// Keep the response open and send new records as they come.
    #[serde(default)]
    follow: bool,
    /// Only records with a greater number.
    #[serde(default)]
    since: i64,
    /// Number of records, the newest ones (default: 100).
    limit: Option<u32>,
}

/// The audit log, as JSON lines.
pub async fn audit(
    State(app): State<Arc<App>>,
    Query(which): Query<AuditQuery>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let told = app.audit.last.subscribe();
    let past = app.state.audit_records(which.since, which.limit.unwrap_or(RECORDS))?;
    if !which.follow {
        return Ok(json_lines(futures_util::stream::iter(past)));
    }
    let since = past.last().map_or(which.since, |record| record.id);
    let reader = Arc::clone(&app);
    let coming = futures_util::stream::try_unfold((since, told), move |(since, mut told)| {
        let app = Arc::clone(&reader);
        async move {
            loop {
                told.borrow_and_update();
                // A follower too slow for a thousand records at a time misses the older ones and notices by their
                // numbers.
                let new = app.state.audit_records(since, AT_ONCE)?;
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
    let ending = caller.wait_for_end(&app, "");
    Ok(json_lines(futures_util::stream::iter(past).chain(coming).take_until(ending)))
}
