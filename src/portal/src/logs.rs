//! Output of servants' nodes: of running servants, and of ended ones whose logs are kept.

use std::sync::Arc;
use std::time::Duration;

use access::AccessAction;
use api::KeptLog;
use axum::extract::{Path, State};
use axum::response::Response;
use axum::{Extension, Json};
use budget::{Budget, Exceeded, Permit};
use futures_util::StreamExt;
use serde::Deserialize;
use servant::engine::{LogLine, LogStart};
use servant::logs::{LONGEST_LINE, ROTATE_AT};
use tokio_stream::wrappers::ReceiverStream;
use utoipa::IntoParams;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::{JsonResult, json_lines};
use crate::query::Query;
use crate::views;

/// Default number of log lines.
const LOG_LINES: usize = 10_000;
/// Estimated overhead of a log line in bytes, besides its text.
const LOG_LINE: usize = 150;

/// Maximum memory that a log takes: its two files, and the overhead of its lines.
const LARGEST_LOG: usize = 3 * ROTATE_AT as usize;
/// Time for which a reader waits until its other requests have released memory.
const PATIENCE: Duration = Duration::from_secs(10);

/// Query of a log.
#[derive(Debug, Deserialize, IntoParams)]
pub struct LogQuery {
    /// Keep the response open and send new lines as they come, until the servant ends.
    #[serde(default)]
    follow: bool,
    /// Number of lines from the end of the log (default: 10000).
    tail: Option<usize>,
    /// Earliest time: only lines printed at this time or later, in milliseconds since 1970-01-01 UTC.
    since: Option<u64>,
}

/// Output of a servant's nodes, as JSON lines.
pub async fn read(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Query(part): Query<LogQuery>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let count = part.tail.unwrap_or(LOG_LINES);
    let since = part.since.unwrap_or_default();
    let is_wanted = move |line: &LogLine| store::millis(line.time) >= since;
    let budget = app.choreographer.memory().client(&caller.peer.budget_name(None));
    let (mut past, mut held, place) = if app.choreographer.kept_log(&id).is_some() {
        // A slow reader keeps files open and lines in memory for that long.
        let place = app.live.acquire_slot(&caller)?;
        let held = wait_for_room(&budget, count).await?;
        (app.choreographer.read_kept_log(&id, count).await, held, place)
    } else {
        let handle = app.choreographer.servant(&id)?;
        handle.check_container()?;
        let Some(container) = handle.container() else {
            return Ok(json_lines(futures_util::stream::empty::<api::LogLine>()));
        };
        let place = app.live.acquire_slot(&caller)?;
        if part.follow {
            let printed = ReceiverStream::new(container.follow(LogStart::Last(count)));
            let printed = printed.filter(move |line| std::future::ready(is_wanted(line))).map(move |line| {
                let _held = &place;
                views::log_line(line)
            });
            // A follower must not keep the daemon from stopping.
            let ending = caller.wait_for_end(&app, handle.service());
            return Ok(json_lines(printed.take_until(ending)));
        }
        let held = wait_for_room(&budget, count).await?;
        (container.logs(count, None).await, held, place)
    };
    past.retain(is_wanted);
    held.resize(past.iter().map(|line| line.line.len() + LOG_LINE).sum())?;
    let past = futures_util::stream::iter(past).map(move |line| {
        let _held = (&place, &held);
        views::log_line(line)
    });
    Ok(json_lines(past))
}

/// Takes memory of a client's budget for the last `count` lines of a log, whose length is not known before they are
/// read. A client whose whole budget is smaller reads one log at a time.
async fn wait_for_room(budget: &Budget, count: usize) -> Result<Permit, Exceeded> {
    let most = count.saturating_mul(LONGEST_LINE + LOG_LINE).min(LARGEST_LOG);
    budget.wait(most.min(budget.max_permit()), PATIENCE).await
}

/// Query: which logs.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct KeptLogQuery {
    /// Only the log of this servant.
    servant: Option<String>,
    /// Only logs of this service.
    service: Option<String>,
    /// Only logs of this robot.
    robot: Option<String>,
}

/// Lists the ended servants whose logs are kept and the caller may read, newest first.
pub async fn list(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Query(which): Query<KeptLogQuery>,
) -> JsonResult<Vec<KeptLog>> {
    let of = |wanted: &Option<String>, is: &str| wanted.as_deref().is_none_or(|wanted| wanted == is);
    let mut all = app.choreographer.kept_logs();
    all.retain(|one| {
        of(&which.servant, &one.servant)
            && of(&which.service, &one.service)
            && of(&which.robot, &one.robot)
            && caller.is_allowed_for_robot(&app, AccessAction::Logs, &one.service, &one.robot)
    });
    Ok(Json(all))
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    #[tokio::test]
    async fn a_log_is_read_once_its_reader_has_room_for_it() {
        let budget = Budget::new("client x", 2 * LARGEST_LOG + LARGEST_LOG / 2);
        let first = wait_for_room(&budget, usize::MAX).await.expect("there is room");
        let second = wait_for_room(&budget, LOG_LINES).await.expect("there is room");
        assert_eq!((first.bytes(), second.bytes()), (LARGEST_LOG, LARGEST_LOG));
        let mut third = Box::pin(wait_for_room(&budget, usize::MAX));
        assert!((&mut third).now_or_never().is_none(), "it waits");
        let few = wait_for_room(&budget, 10).await.expect("a few lines take little");
        assert!(few.bytes() < 1 << 20, "{}", few.bytes());
        drop((first, few));
        third.await.expect("there is room again");
        let small = Budget::new("client y", 1 << 20);
        assert_eq!(wait_for_room(&small, LOG_LINES).await.expect("all that it has").bytes(), 1 << 20);
    }
}
