//! Servants that an earlier daemon left: taken over, or forgotten.

use std::collections::HashMap;
use std::sync::Arc;

use super::driver::{self, Beginning};
use super::warm_pool::NOBODY;
use servant::engine::ContainerState;

use crate::Error;
use crate::decide::adoption::{Fate, Found, Started, fate, is_linked};
use crate::decide::demand::Asked;
use crate::{Choreographer, Handle};
use store::{NewEvent, RevisionRecord, ServantRecord};

/// It was kept ready for a robot that had not come.
fn is_nobodys(record: &ServantRecord) -> bool {
    record.robot == NOBODY
}

impl Choreographer {
    /// Takes over the servants that an earlier daemon left, and forgets those that are gone.
    pub async fn adopt(&self) -> Result<usize, Error> {
        let inner = &self.inner;
        let found = inner.engine.adopt().await?;
        for error in &found.failures {
            let message = format!("what an earlier daemon left could not be removed: {error}");
            let about = NewEvent::default();
            inner.journal.warning("servant-leftover", &message, &about);
        }
        let mut records: HashMap<String, ServantRecord> = inner
            .state
            .servants()?
            .into_iter()
            .map(|record| (record.id.clone(), record))
            .collect();
        let mut adopted = 0;
        for servant in found.running {
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
            match (fate, record.zip(revision)) {
                (Fate::Kept, Some((record, revision))) => {
                    self.adopt_one(record, revision, servant);
                    adopted += 1;
                }
                (Fate::Unused, _) => {
                    self.end_unknown(&servant).await;
                    inner.state.remove_servant(servant.id());
                }
                (Fate::Unknown | Fate::Kept, _) => {
                    inner.journal.warning(
                        "servant-unknown",
                        &format!(
                            "ended servant {}, which belongs to no service any more",
                            servant.id()
                        ),
                        &NewEvent {
                            servant: Some(servant.id()),
                            ..NewEvent::default()
                        },
                    );
                    self.end_unknown(&servant).await;
                    inner.state.remove_servant(servant.id());
                }
            }
        }
        let mut ends: HashMap<String, Option<ContainerState>> = found
            .ended
            .into_iter()
            .map(|ended| (ended.id, ended.state))
            .collect();
        for gone in records.into_values() {
            inner.state.remove_servant(&gone.id);
            if is_nobodys(&gone) {
                continue;
            }
            let why = match ends.remove(&gone.id).flatten() {
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
        Ok(adopted)
    }

    /// Ends a servant that nobody needs. What cannot be removed of it is told, and is in nobody's way.
    async fn end_unknown(&self, servant: &Arc<dyn servant::engine::Servant>) {
        if let Err(error) = servant.stop().await {
            let message = format!("servant {} could not be cleaned up: {error}", servant.id());
            let about = NewEvent {
                servant: Some(servant.id()),
                ..NewEvent::default()
            };
            let journal = &self.inner.journal;
            journal.error("servant-leftover", &message, &about);
        }
    }

    fn adopt_one(
        &self,
        record: ServantRecord,
        revision: Arc<RevisionRecord>,
        servant: Arc<dyn servant::engine::Servant>,
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
