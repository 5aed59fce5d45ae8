//! Logs of ended servants. They are kept for a while, up to a quota that services share fairly, and survive the daemon;
//! the list of them is in memory, and read at the start.

mod list;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::KeptLog;
use servant::engine::{LogLine, ServantHandle};
use store::NewEvent;
use tokio::time::{MissedTickBehavior, interval};

use super::ChoreographerInner;
use crate::Choreographer;
use crate::decide::quota::{QuotaFile, find_files_to_evict};
use crate::lives::handle::Handle;

pub(crate) use list::KeptLogs;

/// Interval between two searches for logs that are too old.
const LOOK: Duration = Duration::from_secs(3600);
/// Event kind: a log could not be kept, or not be removed.
const LOG_NOT_KEPT: &str = "log-not-kept";

impl ChoreographerInner {
    /// Ends the processes of a servant and keeps its log, unless its service was removed or no logs are kept. The
    /// container is to be stopped afterwards.
    pub(crate) async fn keep_log(&self, handle: &Handle, container: &dyn ServantHandle) {
        let is_removed = matches!(self.state.service_package(handle.service()), Ok(None));
        if is_removed || self.options.kept_logs.age.is_zero() {
            return;
        }
        let life = handle.life();
        let about = KeptLog {
            servant: handle.id.clone(),
            service: handle.service().to_owned(),
            revision: handle.revision.number,
            robot: handle.robot.clone(),
            created: handle.created,
            ended: store::now(),
            failed: life.failure.is_some(),
            reason: life.reason().unwrap_or_default(),
            bytes: api::Size(0),
        };
        match container.keep_log(about).await {
            Ok(kept) => {
                let _turn = self.kept_logs.turn.lock().await;
                self.settle_logs(vec![kept]).await;
            }
            Err(error) => {
                let message = format!("the log of servant {} is lost: {error}", handle.id);
                self.journal.warning(LOG_NOT_KEPT, &message, &handle.event_context());
            }
        }
    }

    /// Reads the list of the logs that an earlier daemon kept, and those that a sweep has added.
    pub(crate) async fn load_kept_logs(&self) {
        let _turn = self.kept_logs.turn.lock().await;
        match self.engine.kept_logs().await {
            Ok(found) => self.settle_logs(found).await,
            Err(error) => {
                let message = format!("cannot list the logs of ended servants: {error}");
                self.journal.warning(LOG_NOT_KEPT, &message, &NewEvent::default());
            }
        }
    }

    /// Adds logs to the list, and removes all those that are too old, exceed the quota, or whose service is gone. The
    /// caller has the turn.
    async fn settle_logs(&self, more: Vec<KeptLog>) {
        let mut known = self.kept_logs.known.lock().clone();
        known.retain(|one| more.iter().all(|new| new.servant != one.servant));
        let mut all = more;
        all.extend(known);
        all.sort_by_key(|one| std::cmp::Reverse(one.ended));
        let mut owners: HashMap<String, Option<String>> = HashMap::new();
        for one in &all {
            owners.entry(one.service.clone()).or_insert_with(|| {
                // If the database cannot tell, it counts as an operator's.
                let owner = self.state.service_owner(&one.service).unwrap_or(Some(None));
                owner.map(Option::unwrap_or_default)
            });
        }
        let options = self.options.kept_logs;
        let oldest = store::now().saturating_sub(options.age.as_millis() as u64);
        let (mut kept, mut gone): (Vec<KeptLog>, Vec<KeptLog>) =
            all.into_iter().partition(|one| one.ended >= oldest && owners[&one.service].is_some());
        let evicted = loop {
            let Some((newest, others)) = kept.split_first() else {
                break Vec::new();
            };
            let files: Vec<QuotaFile<'_>> = others.iter().map(|one| to_quota_file(one, &owners)).collect();
            match find_files_to_evict(&files, to_quota_file(newest, &owners), options.quota) {
                Some(evicted) => break evicted,
                None => {
                    self.report_no_room(newest);
                    gone.push(kept.remove(0));
                }
            }
        };
        // Their places are after the newest.
        let mut places: Vec<usize> = evicted.into_iter().map(|place| place + 1).collect();
        places.sort_unstable();
        gone.extend(places.into_iter().rev().map(|place| kept.remove(place)));
        *self.kept_logs.known.lock() = kept;
        self.remove_logs(gone).await;
    }

    fn report_no_room(&self, log: &KeptLog) {
        let message = format!(
            "the log of servant {} is not kept: it has {}, and the logs of those that use less leave no room for it in \
             the {} of all (disk and servants in [logs])",
            log.servant,
            log.bytes,
            api::Size(self.options.kept_logs.quota.bytes)
        );
        let about = NewEvent { service: Some(&log.service), servant: Some(&log.servant), robot: Some(&log.robot) };
        self.journal.warning(LOG_NOT_KEPT, &message, &about);
    }

    async fn remove_logs(&self, gone: Vec<KeptLog>) {
        if gone.is_empty() {
            return;
        }
        let ids = gone.into_iter().map(|one| one.servant).collect();
        for error in self.engine.remove_kept_logs(ids).await {
            let message = format!("cannot remove the log of an ended servant: {error}");
            self.journal.warning(LOG_NOT_KEPT, &message, &NewEvent::default());
        }
    }
}

/// Returns a log as input for the decision on the quota.
fn to_quota_file<'a>(one: &'a KeptLog, owners: &'a HashMap<String, Option<String>>) -> QuotaFile<'a> {
    let owner = owners.get(&one.service).and_then(Option::as_deref);
    QuotaFile { owner: owner.unwrap_or_default(), service: &one.service, bytes: one.bytes.0 }
}

/// Removes logs that have become too old, until the daemon ends.
pub(crate) async fn watch(inner: Arc<ChoreographerInner>) {
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        let _turn = inner.kept_logs.turn.lock().await;
        inner.settle_logs(Vec::new()).await;
    }
}

impl Choreographer {
    /// Returns the ended servants whose logs are kept, newest first.
    pub fn kept_logs(&self) -> Vec<KeptLog> {
        self.inner.kept_logs.known.lock().clone()
    }

    /// Returns the ended servant with this id, if its log is kept.
    pub fn kept_log(&self, id: &str) -> Option<KeptLog> {
        self.inner.kept_logs.known.lock().iter().find(|one| one.servant == id).cloned()
    }

    /// Returns the last lines of an ended servant's log, at most `last`, oldest first; none if it is not kept.
    pub async fn read_kept_log(&self, id: &str, last: usize) -> Vec<LogLine> {
        match self.kept_log(id) {
            Some(_) => self.inner.engine.read_kept_log(id, last).await,
            None => Vec::new(),
        }
    }

    /// Removes the logs of a service's ended servants.
    pub async fn forget_logs(&self, service: &str) {
        let kept_logs = &self.inner.kept_logs;
        let _turn = kept_logs.turn.lock().await;
        let (gone, kept) = self.kept_logs().into_iter().partition(|one| one.service == service);
        *kept_logs.known.lock() = kept;
        self.inner.remove_logs(gone).await;
    }
}
