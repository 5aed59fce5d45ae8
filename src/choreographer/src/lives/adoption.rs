//! Takes over, or removes, servants that an earlier daemon left.

use std::collections::HashMap;
use std::sync::Arc;

use api::{KeptLog, Limits};
use servant::engine::{AdoptedServants, ContainerState, EndedServant, ServantHandle};
use store::{NewEvent, RevisionRecord, ServantRecord};
use tokio::task::JoinHandle;

use super::driver::{self, ServantSource};
use super::waiting::Permit;
use super::warm_pool::NOBODY;
use crate::Error;
use crate::decide::adoption::{LeftoverContainer, LeftoverFate, decide_fate};
use crate::decide::demand::LimitSources;
use crate::{Choreographer, Handle};

/// Returns true if it was kept ready for a robot that had not come.
fn is_unassigned(record: &ServantRecord) -> bool {
    record.robot == NOBODY
}

/// Describes a servant that ended while no daemon was running, for its log.
fn to_kept_log(gone: &ServantRecord, why: &str) -> KeptLog {
    KeptLog {
        servant: gone.id.clone(),
        service: gone.service.clone(),
        revision: gone.revision,
        robot: gone.robot.clone(),
        created: gone.created,
        ended: store::now(),
        failed: true,
        reason: format!("ended while the daemon was not running{why}"),
        bytes: api::Size(0),
    }
}

/// Returns whether the servant's shim has told the servant's state.
fn has_told(servant: &dyn ServantHandle) -> bool {
    *servant.state().borrow() != ContainerState::Creating
}

/// Result of adopting what an earlier daemon left.
pub struct AdoptionResult {
    /// Number of adopted servants.
    pub adopted: usize,
    /// Background task that ends and removes the rest; robots need not wait for it.
    pub removal: JoinHandle<()>,
}

/// A running container that belongs to no robot any more.
struct UnneededContainer {
    servant: Arc<dyn ServantHandle>,
    fate: LeftoverFate,
    /// Keeps its capacity reserved until it has ended.
    _permit: Permit,
}

impl Choreographer {
    /// Adopts the servants that an earlier daemon left, and forgets those that are gone.
    pub async fn adopt(&self) -> Result<AdoptionResult, Error> {
        let inner = &self.inner;
        let AdoptedServants { running, mut ended, failures } = inner.engine.adopt().await?;
        inner.load_kept_logs().await;
        for error in &failures {
            self.report_leftover(error);
        }
        let mut records: HashMap<String, ServantRecord> =
            inner.state.servants()?.into_iter().map(|record| (record.id.clone(), record)).collect();
        let mut adopted = 0;
        let mut useless = Vec::new();
        for servant in running {
            let record = records.remove(servant.id());
            let revision = match &record {
                Some(record) => inner.state.revision(&record.service, record.revision)?,
                None => None,
            };
            let fate = decide_fate(LeftoverContainer {
                recorded: record.is_some(),
                nobodys: record.as_ref().is_some_and(is_unassigned),
                published: revision.is_some(),
                empty: has_told(&*servant) && servant.nodes().is_empty(),
            });
            match (fate, record, revision) {
                (LeftoverFate::Kept, Some(record), Some(revision)) => {
                    self.adopt_one(record, revision, servant);
                    adopted += 1;
                }
                (fate, _, revision) => {
                    let had =
                        revision.map_or(Limits::default(), |revision| inner.push_limits(&revision).promised_limits());
                    useless.push(UnneededContainer {
                        servant,
                        fate,
                        _permit: inner.admission.adopt(inner.promised_amount(&had)),
                    });
                }
            }
        }
        self.forget(records, &mut ended);
        let whole = self.clone();
        let removal = tokio::spawn(async move {
            let ends = useless.into_iter().map(|useless| whole.end(useless));
            let ends = futures_util::future::join_all(ends);
            // A slow end does not delay the removal of the others.
            let (_, failures) = tokio::join!(ends, whole.inner.engine.sweep(&ended));
            for error in failures {
                whole.report_leftover(&error);
            }
            whole.inner.load_kept_logs().await;
        });
        Ok(AdoptionResult { adopted, removal })
    }

    fn report_leftover(&self, error: &servant::Error) {
        let message = format!("cannot remove leftovers of a previous daemon: {error}");
        let about = NewEvent::default();
        let journal = &self.inner.journal;
        journal.warning("servant-leftover", &message, &about);
    }

    /// Forgets servants that are gone, reports how they ended, and has their logs kept.
    fn forget(&self, records: HashMap<String, ServantRecord>, ended: &mut [EndedServant]) {
        let inner = &self.inner;
        let mut ends: HashMap<String, &mut EndedServant> =
            ended.iter_mut().map(|ended| (ended.id.clone(), ended)).collect();
        for gone in records.into_values() {
            inner.state.remove_servant(&gone.id);
            if is_unassigned(&gone) {
                continue;
            }
            let end = ends.remove(&gone.id);
            let why = match end.as_ref().and_then(|end| end.state.as_ref()) {
                Some(ContainerState::Stopped { reason } | ContainerState::Failed { reason }) => {
                    format!(": {reason}")
                }
                _ => String::new(),
            };
            if let Some(end) = end
                && !inner.options.kept_logs.age.is_zero()
            {
                end.keep = Some(to_kept_log(&gone, &why));
            }
            inner.journal.warning(
                "servant-lost",
                &format!(
                    "servant {} of {} for {} ended while the daemon was not running{why}",
                    gone.id, gone.service, gone.robot
                ),
                &NewEvent { service: Some(&gone.service), servant: Some(&gone.id), robot: Some(&gone.robot) },
            );
        }
    }

    /// Ends an unneeded container. What cannot be removed of it is reported and does no harm.
    async fn end(&self, useless: UnneededContainer) {
        let (inner, servant) = (&self.inner, &useless.servant);
        let about = NewEvent { servant: Some(servant.id()), ..NewEvent::default() };
        if useless.fate != LeftoverFate::Unused {
            let id = servant.id();
            let message = format!("ended servant {id} because its service no longer exists");
            inner.journal.warning("servant-unknown", &message, &about);
        }
        if let Err(error) = servant.stop().await {
            let message = format!("cannot clean up servant {}: {error}", servant.id());
            inner.journal.error("servant-leftover", &message, &about);
        }
        inner.state.remove_servant(servant.id());
    }

    fn adopt_one(&self, record: ServantRecord, revision: Arc<RevisionRecord>, servant: Arc<dyn ServantHandle>) {
        let inner = &self.inner;
        let of_push = || inner.push_limits(&revision);
        let asked = LimitSources {
            set: record.limits,
            ..record.terms.map_or_else(of_push, |terms| inner.limit_sources(terms))
        };
        let key = (record.service, record.robot.clone());
        let handle =
            Arc::new(Handle::new(record.id.clone(), record.robot, record.anonymous, asked, revision, record.created));
        {
            let mut servants = inner.servants.lock();
            servants.all.insert(record.id, Arc::clone(&handle));
            servants.given.insert(key, Arc::clone(&handle));
        }
        let permit = inner.admission.adopt(inner.promised_amount(&handle.requested_limits()));
        let beginning = ServantSource::Adopted(servant, Some(permit));
        driver::start(inner, handle, beginning);
    }
}
