//! Changes the limits of a servant while it works: because the operator says so, or because its robot states something else
//! than before.

use std::time::Duration;

use api::{Limits, Size, Stated, Terms};
use servant::engine::Servant;
use servant::spec::UNLIMITED;

use super::Inner;
use crate::decide::demand::{Asked, with_weight};
use crate::decide::measured::{Input, grown, measured};
use crate::decide::terms::{Untenable, in_words, pairs_of, terms};
use crate::decide::told::left_out;
use crate::error::{STATING, Unchanged};
use crate::limits::limits_of;
use crate::lives::handle::Handle;
use crate::{Choreographer, Error, ServantRequest, engine_limits};
use store::NewEvent;
use tokio::time::{Instant, timeout};

/// For one servant to take other limits.
const PATIENCE: Duration = Duration::from_secs(5);
/// `cpu.weight` where nobody has asked for one.
pub(super) const PLAIN_WEIGHT: u64 = 100;

impl Choreographer {
    /// Changes the limits that are given, of a servant that runs; what is promised to it changes with them.
    pub async fn set_limits(&self, id: &str, change: Limits) -> Result<(), Error> {
        let (whole, id) = (self.clone(), id.to_owned());
        // Whoever asks may go away meanwhile; what is begun is done.
        let set = tokio::spawn(async move { whole.set(&id, change).await });
        set.await
            .map_err(|_| Error::Internal("changing a servant's limits"))?
    }

    async fn set(&self, id: &str, change: Limits) -> Result<(), Error> {
        let handle = self.servant(id)?;
        handle.check_container()?;
        // One change after the other: what is promised, in force and remembered must be of the same.
        let _turn = handle.limits_turn().await;
        let before = handle.all_asked();
        let after = Asked {
            set: change.or(before.set),
            ..before
        };
        let inner = &self.inner;
        let set = after.set;
        let in_force = inner.resize(&handle, with_weight(change), after).await?;
        inner.state.set_servant_limits(id, &set)?;
        let message = format!("servant {id}: limits changed to {in_force}");
        inner
            .journal
            .info("limits-changed", &message, &handle.about());
        Ok(())
    }
}

impl Inner {
    /// Tells of a robot that is refused for what it states.
    pub(crate) fn report_refused(&self, request: &ServantRequest, error: &Error) {
        let (service, robot) = (&request.service, &request.robot);
        let about = NewEvent {
            service: Some(service),
            servant: None,
            robot: Some(robot),
        };
        self.report_terms_refused(service, robot, &about, || {
            let stated = &request.stated;
            format!("robot {robot} states {stated} to {service} and is refused: {error}")
        });
    }

    /// Tells of a servant that keeps what it has, although its robot states or sends something else.
    pub(crate) fn report_not_resized(&self, handle: &Handle, error: &Error) {
        let (service, robot) = (handle.service(), &handle.robot);
        self.report_terms_refused(service, robot, &handle.about(), || error.to_string());
    }

    fn report_terms_refused(
        &self,
        service: &str,
        robot: &str,
        about: &NewEvent<'_>,
        message: impl FnOnce() -> String,
    ) {
        let now = Instant::now().into_std();
        let told = self.refusals.lock().tell(service, robot, now);
        if let Some(before) = told {
            let message = message() + &left_out(before);
            self.journal.warning("terms-refused", &message, about);
        }
    }

    /// Gives a servant that runs what its robot states now, by one of its clients. Where that cannot be, it keeps what it
    /// has.
    pub(crate) async fn agree(
        &self,
        handle: &Handle,
        who: &str,
        stated: &Stated,
    ) -> Result<(), Error> {
        let agreed = self.agreed(handle, who, stated).await;
        if let Err(error @ Error::NotResized { .. }) = &agreed {
            self.report_not_resized(handle, error);
        }
        agreed
    }

    async fn agreed(&self, handle: &Handle, who: &str, stated: &Stated) -> Result<(), Error> {
        let _turn = handle.limits_turn().await;
        let before = handle.all_asked();
        let mut all = before.terms.stated.clone();
        if all.insert(who.to_owned(), stated.clone()).as_ref() == Some(stated) {
            // Another connection of the same client was faster.
            return Ok(());
        }
        if all.len() > STATING {
            return Err(Error::NotResized {
                servant: handle.id.clone(),
                service: handle.service().to_owned(),
                stated: stated.to_string(),
                reason: Box::new(Unchanged::Many),
            });
        }
        let measured = before.terms.measured.clone();
        let terms = self.offering(&handle.revision, |_| measured, |offer| terms(&all, offer))?;
        let why = stated.to_string();
        let changed = self.renew(handle, before, terms, &why).await?;
        if !handle.is_place() {
            let states = handle.terms().stated_in_words();
            self.report_changed(handle, changed, &format!("its robot states {states}"));
        }
        Ok(())
    }

    /// Has a servant that runs forget what those of its robot's clients stated that have been away for the grace time. Where it
    /// cannot be made smaller, it keeps what it has.
    pub(crate) async fn forget_stated(
        &self,
        handle: &Handle,
        grace: Duration,
    ) -> Result<(), Error> {
        // Whoever is back by now waits for this turn, and states it again.
        let _turn = handle.limits_turn().await;
        let away = handle.away_for(grace);
        let before = handle.all_asked();
        let mut left = before.terms.stated.clone();
        left.retain(|who, _| !away.contains(who));
        if left.len() == before.terms.stated.len() {
            return Ok(());
        }
        let measured = before.terms.measured.clone();
        let terms = self.offering(&handle.revision, |_| measured, |offer| terms(&left, offer))?;
        let away: Vec<&str> = away.iter().map(|who| client(who)).collect();
        let why = format!("its robot's clients without {}", away.join(", "));
        let changed = self.renew(handle, before, terms, &why).await?;
        if !handle.is_place() {
            let why = format!(
                "what {} stated ended {} s after that had left",
                away.join(", "),
                grace.as_secs_f64()
            );
            self.report_changed(handle, changed, &why);
        }
        Ok(())
    }

    /// Gives a servant that runs what the dictionary says of messages as large as those that its robot sends. Where that
    /// cannot be, it keeps what it has.
    pub(crate) async fn measured(&self, handle: &Handle, inputs: &[Input]) -> Result<(), Error> {
        let _turn = handle.limits_turn().await;
        let before = handle.all_asked();
        let known = &before.terms.measured;
        let anew = self.offering(
            &handle.revision,
            |rows| grown(known, measured(inputs, rows)),
            |offer| {
                let terms = || terms(&before.terms.stated, offer);
                (offer.measured != known).then(|| (pairs_of(offer.measured), terms()))
            },
        )?;
        let Some((sends, terms)) = anew else {
            return Ok(());
        };
        let why = format!("messages of {sends}");
        let changed = self.renew(handle, before.clone(), terms, &why).await?;
        if changed.is_some() {
            self.report_changed(handle, changed, &format!("its robot sends {why}"));
        }
        Ok(())
    }

    fn report_changed(&self, handle: &Handle, from: Option<Limits>, why: &str) {
        let id = &handle.id;
        let message = match from {
            Some(earlier) => format!(
                "servant {id}: {why}; limits changed from {} to {}",
                in_words(&earlier),
                in_words(&handle.limits()),
            ),
            None => format!("servant {id}: {why}; its limits stay"),
        };
        self.journal
            .info("terms-changed", &message, &handle.about());
    }

    /// Gives a servant these terms, for what `why` says; the limits that it had, where they change. Only in its
    /// [`Handle::limits_turn`].
    async fn renew(
        &self,
        handle: &Handle,
        before: Asked,
        terms: Result<Terms, Untenable>,
        why: &str,
    ) -> Result<Option<Limits>, Error> {
        let refused = |reason| Error::NotResized {
            servant: handle.id.clone(),
            service: handle.service().to_owned(),
            stated: why.to_owned(),
            reason: Box::new(reason),
        };
        let terms = terms.map_err(|untenable| refused(Unchanged::Untenable(untenable)))?;
        let after = Asked {
            terms,
            ..before.clone()
        };
        if handle.is_place() {
            // It has no container; what it wishes of its SLA, the group heeds.
            handle.set_asked(after);
            return Ok(None);
        }
        let (earlier, told) = (before.limits(), after.terms.clone());
        let change = changed(&earlier, &after.limits(), self.options.cores);
        if let (Some(wanted), Some(container)) = (change.memory, handle.container())
            && earlier.memory.is_none_or(|earlier| wanted < earlier)
            && let Ok(usage) = container.usage().await
            && wanted.0 < usage.memory
        {
            let used = Size(usage.memory);
            return Err(refused(Unchanged::Used { used, wanted }));
        }
        let resized = change != Limits::default();
        if resized {
            let resized = self.resize(handle, change, after).await;
            resized.map_err(|error| match error {
                Error::Full(full) => refused(Unchanged::Full(full)),
                error => error,
            })?;
        } else {
            handle.set_asked(after);
        }
        self.state.set_servant_terms(&handle.id, &told)?;
        Ok(resized.then_some(earlier))
    }

    /// Gives a servant the limits of `change`, and promises `after` to it; all or nothing. Only in its
    /// [`Handle::limits_turn`]. Gives what is in force then.
    async fn resize(&self, handle: &Handle, change: Limits, after: Asked) -> Result<String, Error> {
        let unreached = || Error::Servant {
            service: handle.service().to_owned(),
            robot: handle.robot.clone(),
            reason: "does not run, so that its limits cannot be changed".to_owned(),
            log: Vec::new(),
        };
        let container = handle.container().ok_or_else(unreached)?;
        let promise = handle.promise().ok_or_else(unreached)?;
        let before = handle.all_asked();
        let (has, wanted) = (
            self.promised(&before.promised()),
            self.promised(&after.promised()),
        );
        // What is more is promised before the kernel gives it, and what is less given to others only once the kernel has
        // taken it: else more would be promised than there is where it refuses.
        promise.change(has.max(wanted))?;
        if let Err(error) = container.set_limits(engine_limits(&change)).await {
            // What the kernel took of it before it refused the rest is taken back.
            let back = changed(&change, &before.limits(), self.options.cores);
            let _ = container.set_limits(engine_limits(&back)).await;
            promise.change(has)?;
            return Err(error.into());
        }
        handle.set_asked(after);
        promise.change(wanted)?;
        Ok(in_words(&limits_of(&container.enforced().limits)))
    }
}

/// Who states something, for people: a stub by its node.
fn client(who: &str) -> &str {
    match who {
        "" => "a rosbridge client",
        node => node,
    }
}

/// Gives a container that was made with the limits `made` those of the servant that it becomes.
pub(super) async fn fit(
    container: &dyn Servant,
    made: &Limits,
    limits: &Limits,
    cores: f64,
) -> Result<(), servant::Error> {
    let change = changed(made, limits, cores);
    if change != Limits::default() {
        container.set_limits(engine_limits(&change)).await?;
    }
    Ok(())
}

/// Gives a servant that was adopted what it was promised, where an earlier daemon's controller has moved its cores and this one
/// moves none.
pub(super) async fn take_back(inner: &Inner, handle: &Handle, container: &dyn Servant) {
    let (has, wanted) = (container.enforced().limits, handle.limits());
    // What this host cannot limit was not moved.
    if inner.options.controller || has.cpus.is_none() {
        return;
    }
    let _turn = handle.limits_turn().await;
    let before = Limits {
        // Of one that may have all cores nothing is taken back.
        cpus: has.cpus.filter(|_| wanted.cpus.is_some()),
        cpu_weight: has.cpu_weight,
        ..Limits::default()
    };
    let change = changed(
        &before,
        &Limits {
            cpus: wanted.cpus,
            cpu_weight: wanted.cpu_weight.or(has.cpu_weight.and(Some(PLAIN_WEIGHT))),
            ..Limits::default()
        },
        inner.options.cores,
    );
    if change == Limits::default() {
        return;
    }
    let (id, about) = (&handle.id, handle.about());
    match timeout(PATIENCE, container.set_limits(engine_limits(&change))).await {
        Ok(Ok(_)) => {
            let message = format!(
                "servant {id} of {} for {}: back from {} to {}: no controller moves cores any more",
                handle.service(),
                handle.robot,
                in_words(&before),
                in_words(&change),
            );
            inner.journal.info("cores-moved", &message, &about);
        }
        Ok(Err(error)) => {
            let message = format!("servant {id} keeps cores that a controller has moved: {error}");
            inner.journal.warning("limits-unmet", &message, &about);
        }
        Err(_) => {
            let message =
                format!("servant {id} keeps cores that a controller has moved: it does not answer");
            inner.journal.warning("limits-unmet", &message, &about);
        }
    }
}

/// What has to be set for a servant of the limits `before` to have those of `after`: what is the same is left out, since some
/// limits, such as a cpuset on cgroup v1, cannot be set again. What `after` says nothing of is none again, all of this
/// machine's `cores`, and the kernel's weight; a cpuset stays.
fn changed(before: &Limits, after: &Limits, cores: f64) -> Limits {
    let unlimited = Limits {
        cpus: Some(cores),
        cpu_weight: Some(PLAIN_WEIGHT),
        memory: Some(Size(UNLIMITED)),
        memory_high: Some(Size(UNLIMITED)),
        pids: Some(UNLIMITED),
        io_read: Some(Size(UNLIMITED)),
        io_write: Some(Size(UNLIMITED)),
        cpuset: None,
    };
    after.or(before.and(unlimited)).without(*before)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_later_terms_say_nothing_of_is_none_again() {
        let size = |bytes| Some(Size(bytes));
        let before = Limits {
            cpus: Some(1.0),
            cpu_weight: Some(1000),
            memory: size(64),
            memory_high: size(32),
            pids: Some(9),
            io_read: size(8),
            io_write: size(9),
            cpuset: "0-1".parse().ok(),
        };
        let after = Limits {
            memory: size(64),
            io_write: size(7),
            ..Limits::default()
        };
        let none = size(UNLIMITED);
        let change = Limits {
            cpus: Some(4.0),
            cpu_weight: Some(100),
            memory: None,
            memory_high: none,
            pids: Some(UNLIMITED),
            io_read: none,
            io_write: size(7),
            cpuset: None,
        };
        assert_eq!(changed(&before, &after, 4.0), change);
        let nothing = Limits::default();
        assert_eq!(changed(&before, &before, 4.0), nothing);
        assert_eq!(changed(&nothing, &nothing, 4.0), nothing);
        assert_eq!(changed(&nothing, &after, 4.0), after);
    }
}
