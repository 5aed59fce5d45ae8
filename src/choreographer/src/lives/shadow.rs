//! Sends a robot's requests to a candidate as well, and compares the results. The candidate is a servant of another
//! revision without a robot: its answers are only used here.
//!
//! ```text
//!  robot ⇄ bridge, links ─ tap ─▶ servant            observed by an extra node: topics in, topics out
//!                           │ calls, goals              │
//!                           └──────────┐   ┌────────────┘
//!                                      ▼   ▼
//!                                     mirror ⇄ candidate ─▶ differences
//! ```

mod exchanges;
mod linked;
mod mirror;
mod topics;

use std::sync::Arc;
use std::time::Duration;

use api::Phase;
use api::shadow::{Shadow, ShadowEvent, ShadowOptions};
use budget::Budget;
use catalogue::names;
use store::RevisionRecord;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::driver::{self, ServantSource};
use crate::decide::demand::LimitSources;
use crate::lives::handle::Handle;
use crate::{Choreographer, Error, Lease, MeasuredServant};

use mirror::Mirror;

/// Prefix of a candidate's name, in place of a robot's name: no robot can have it.
const NAME_PREFIX: &str = "~shadow-";
/// Interval between checks whether a robot uses the service.
const LOOK: Duration = Duration::from_millis(200);

impl Handle {
    /// Returns true if it is a candidate beside a robot's servant.
    pub(crate) fn is_candidate(&self) -> bool {
        self.robot.starts_with(NAME_PREFIX)
    }
}

impl Choreographer {
    /// Compares a revision of a service with the one that a robot uses. Progress is reported to `events`, but not the
    /// end; data held meanwhile counts in `budget`. The candidate is ended even if this future is dropped.
    pub async fn shadow(
        &self,
        service: &str,
        options: &ShadowOptions,
        budget: &Budget,
        events: &mpsc::Sender<ShadowEvent>,
    ) -> Result<Shadow, Error> {
        let step = async |title: String| {
            // If the caller is gone, this future is dropped soon.
            let _ = events.send(ShadowEvent::Step { title }).await;
        };
        let revision = self.candidate_of(service, options)?;
        let present = match self.robot_for(service, options)? {
            Some(present) => present,
            None => {
                step(format!("waiting for a robot that uses {service}")).await;
                self.await_robot(service, options).await?
            }
        };
        step(format!(
            "starting a candidate of revision {} beside servant {} of robot {}",
            revision.number, present.id, present.robot
        ))
        .await;
        let candidate = self.start_candidate(&present, revision)?;
        candidate.lease.wait_admitted().await?;
        let reach = candidate.lease.wait_ready().await?;
        if present.is_linked() {
            linked::start(&present, &*reach).await?;
        }
        let mirror = Mirror::open(self, &present, (&candidate, &*reach), options, budget).await?;
        step(format!("comparing, for {} s at most", options.seconds)).await;
        Ok(mirror.run().await)
    }

    /// Returns the revision to compare, if that is allowed.
    fn candidate_of(&self, service: &str, options: &ShadowOptions) -> Result<Arc<RevisionRecord>, Error> {
        self.inner.catalogue.current_revision(service)?;
        let number = options.revision;
        let Some(revision) = self.inner.state.revision(service, number)? else {
            return Err(Error::Shadow(format!(
                "{service} has no revision {number}; see those it has with: cloudroidctl services {service}"
            )));
        };
        let grants = &revision.plan.grants;
        let acts = !grants.egress.is_empty() || !grants.devices.is_empty();
        if acts && !options.acting {
            let what = [&grants.egress[..], &grants.devices[..]].concat();
            return Err(Error::Shadow(format!(
                "revision {number} of {service} is granted {}: a candidate would use it beside the robot's servant; \
                    pass --acting if this is safe",
                what.join(", ")
            )));
        }
        Ok(revision)
    }

    /// Returns the servant of the named robot, or of any, if it can be compared with.
    fn robot_for(&self, service: &str, options: &ShadowOptions) -> Result<Option<Arc<Handle>>, Error> {
        let named = options.robot.as_deref();
        let of_it = |handle: &&Arc<Handle>| {
            handle.service() == service
                && handle.life().phase == Phase::Ready
                && !handle.robot.starts_with('~')
                && named.is_none_or(|robot| robot == handle.robot)
        };
        let servants = self.servants();
        let mut why = None;
        for handle in servants.iter().filter(of_it) {
            if handle.revision.number == options.revision {
                why.get_or_insert(format!(
                    "robot {} already uses revision {} of {service}",
                    handle.robot, options.revision
                ));
            } else if handle.is_linked() && handle.is_place() {
                why.get_or_insert(format!(
                    "robot {} uses the shared service {service} through stubs, which use other names; for shared \
                        services only rosbridge robots can be compared with",
                    handle.robot
                ));
            } else {
                return Ok(Some(Arc::clone(handle)));
            }
        }
        match why {
            Some(why) => Err(Error::Shadow(why)),
            None => Ok(None),
        }
    }

    async fn await_robot(&self, service: &str, options: &ShadowOptions) -> Result<Arc<Handle>, Error> {
        let ends = Instant::now() + Duration::from_secs_f64(options.seconds);
        loop {
            tokio::time::sleep(LOOK).await;
            if let Some(found) = self.robot_for(service, options)? {
                return Ok(found);
            }
            if Instant::now() >= ends {
                let who = options
                    .robot
                    .as_deref()
                    .map_or_else(|| "no robot".to_owned(), |robot| format!("robot {robot} did not"));
                let used = if options.robot.is_some() { "use" } else { "used" };
                return Err(Error::Shadow(format!(
                    "{who} {used} {service} within {} s; see which robots do with: cloudroidctl servants",
                    options.seconds
                )));
            }
        }
    }

    /// Starts a servant of this revision with the limits of the present one. It is promised the reserved cores of
    /// servants without limits, like the probe of a push; memory is promised in full.
    fn start_candidate(&self, present: &Handle, revision: Arc<RevisionRecord>) -> Result<MeasuredServant, Error> {
        let inner = &self.inner;
        let limits = present.limits();
        let asked = LimitSources {
            set: api::Limits::default(),
            terms: api::Terms {
                limits: api::Limits { memory: limits.memory, ..api::Limits::default() },
                ..api::Terms::default()
            },
            default: limits,
        };
        let handle = Arc::new(Handle::new(
            names::servant_id(&revision.service),
            format!("{NAME_PREFIX}{}", names::random(6)),
            true,
            asked,
            revision,
            store::now(),
        ));
        if present.is_linked() {
            handle.set_linked();
        }
        let lease = {
            let mut servants = inner.servants.lock();
            if inner.is_ending() {
                return Err(Error::Ending);
            }
            servants.all.insert(handle.id.clone(), Arc::clone(&handle));
            Lease::new(Arc::clone(&handle), "")
        };
        driver::start(inner, handle, ServantSource::Asked(None));
        Ok(MeasuredServant { lease })
    }
}
