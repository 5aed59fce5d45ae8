//! Servants that an earlier daemon left: taken over, or forgotten.

use std::collections::HashMap;
use std::sync::Arc;

use api::Limits;
use servant::engine::{Adopted, ContainerState, Ended, Servant};
use store::{NewEvent, RevisionRecord, ServantRecord};
use tokio::task::JoinHandle;

use super::driver::{self, Beginning};
use super::waiting::Permit;
use super::warm_pool::NOBODY;
use crate::Error;
use crate::decide::adoption::{Fate, Found, Started, fate, is_linked};
use crate::decide::demand::Asked;
use crate::{Choreographer, Handle};

/// It was kept ready for a robot that had not come.
fn is_nobodys(record: &ServantRecord) -> bool {
    record.robot == NOBODY
}

/// What an earlier daemon left.
pub struct Inheritance {
    /// How many servants were taken over.
    pub adopted: usize,
    /// Ends and removes what is of no use, beside everything else; robots need not wait for it.
    pub removal: JoinHandle<()>,
}

/// A container that runs and is nobody's any more.
struct Useless {
    servant: Arc<dyn Servant>,
    fate: Fate,
    /// What it has is promised to nobody else before it has ended.
    _permit: Permit,
}

impl Choreographer {
    /// Takes over the servants that an earlier daemon left, and forgets those that are gone.
    pub async fn adopt(&self) -> Result<Inheritance, Error> {
        let inner = &self.inner;
        let Adopted {
            running,
            ended,
            failures,
        } = inner.engine.adopt().await?;
        for error in &failures {
            self.report_leftover(error);
        }
        let mut records: HashMap<String, ServantRecord> = inner
            .state
            .servants()?
            .into_iter()
            .map(|record| (record.id.clone(), record))
            .collect();
        let mut adopted = 0;
        let mut useless = Vec::new();
        for servant in running {
            let record = records.remove(servant.id());
            let revision = match &record {
                Some(record) => inner.state.revision(&record.service, record.revision)?,
                None => None,
            };
            let fate = fate(Found {
                recorded: record.is_some(),
                nobodys: record.as_ref().is_some_and(is_nobodys),
                published: revision.is_some(),
                empty: servant.nodes().is_empty(),
            });
            match (fate, record, revision) {
                (Fate::Kept, Some(record), Some(revision)) => {
                    self.adopt_one(record, revision, servant);
                    adopted += 1;
                }
                (fate, _, revision) => {
                    let had = revision.map_or(Limits::default(), |revision| {
                        inner.of_push(&revision).promised()
                    });
                    useless.push(Useless {
                        servant,
                        fate,
                        _permit: inner.admission.adopt(inner.promised(&had)),
                    });
                }
            }
        }
        self.forget(records, &ended);
        let whole = self.clone();
        let removal = tokio::spawn(async move {
            let ends = useless.into_iter().map(|useless| whole.end(useless));
            let ends = futures_util::future::join_all(ends);
            // One that takes its time to end keeps nothing of the others from being removed.
            let (_, failures) = tokio::join!(ends, whole.inner.engine.sweep(&ended));
            for error in failures {
                whole.report_leftover(&error);
            }
        });
        Ok(Inheritance { adopted, removal })
    }

    fn report_leftover(&self, error: &servant::Error) {
        let message = format!("what an earlier daemon left could not be removed: {error}");
        let about = NewEvent::default();
        let journal = &self.inner.journal;
        journal.warning("servant-leftover", &message, &about);
    }

    /// Forgets servants that are gone, and tells how they ended.
    fn forget(&self, records: HashMap<String, ServantRecord>, ended: &[Ended]) {
        let inner = &self.inner;
        let ends: HashMap<&str, Option<&ContainerState>> = ended
            .iter()
            .map(|ended| (ended.id.as_str(), ended.state.as_ref()))
            .collect();
        for gone in records.into_values() {
            inner.state.remove_servant(&gone.id);
            if is_nobodys(&gone) {
                continue;
            }
            let why = match ends.get(gone.id.as_str()).copied().flatten() {
                Some(ContainerState::Stopped { reason } | ContainerState::Failed { reason }) => {
                    format!(": {reason}")
                }
                _ => String::new(),
            };
            inner.journal.warning(
                "servant-lost",
                &format!(
                    "servant {} of {} for {} ended while no daemon ran{why}",
                    gone.id, gone.service, gone.robot
                ),
                &NewEvent {
                    service: Some(&gone.service),
                    servant: Some(&gone.id),
                    robot: Some(&gone.robot),
                },
            );
        }
    }

    /// Ends a container that nobody needs. What cannot be removed of it is told, and is in nobody's way.
    async fn end(&self, useless: Useless) {
        let (inner, servant) = (&self.inner, &useless.servant);
        let about = NewEvent {
            servant: Some(servant.id()),
            ..NewEvent::default()
        };
        if useless.fate != Fate::Unused {
            let id = servant.id();
            let message = format!("ended servant {id}, which belongs to no service any more");
            inner.journal.warning("servant-unknown", &message, &about);
        }
        if let Err(error) = servant.stop().await {
            let message = format!("servant {} could not be cleaned up: {error}", servant.id());
            inner.journal.error("servant-leftover", &message, &about);
        }
        inner.state.remove_servant(servant.id());
    }

    fn adopt_one(
        &self,
        record: ServantRecord,
        revision: Arc<RevisionRecord>,
        servant: Arc<dyn Servant>,
    ) {
        let inner = &self.inner;
        let of_push = || inner.of_push(&revision);
        let asked = Asked {
            set: record.limits,
            ..record
                .terms
                .map_or_else(of_push, |terms| inner.asked(terms))
        };
        let key = (record.service, record.robot.clone());
        let handle = Arc::new(Handle::new(
            record.id.clone(),
            record.robot,
            record.anonymous,
            asked,
            revision,
            record.created,
        ));
        let planned = &handle.revision.plan.nodes;
        let started = servant.nodes().into_iter().map(|name| Started {
            planned: planned.iter().any(|node| node.name == name),
            run: servant.run(&name).is_some(),
        });
        if is_linked(&started.collect::<Vec<_>>()) {
            handle.set_linked();
        }
        {
            let mut servants = inner.servants.lock();
            servants.all.insert(record.id, Arc::clone(&handle));
            servants.given.insert(key, Arc::clone(&handle));
        }
        let permit = inner.admission.adopt(inner.promised(&handle.asked()));
        tokio::spawn(driver::drive(
            Arc::clone(inner),
            handle,
            Beginning::Adopted(servant, Some(permit)),
        ));
    }
}
