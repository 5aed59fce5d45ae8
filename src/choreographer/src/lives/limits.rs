//! Changes the limits of a running servant: on the operator's request, or because its robot states something new.

use std::time::Duration;

use api::limits::DEFAULT_CPU_WEIGHT;
use api::{Limits, Size, Stated, Terms};
use servant::engine::ServantHandle;

use super::ChoreographerInner;
use crate::decide::demand::{LimitSources, with_default_weight};
use crate::decide::measured::{MeasuredInput, aux_from_inputs, merge_max};
use crate::decide::refusal_reports::suppressed_note;
use crate::decide::terms::{TermsError, aux_pairs, compute_terms, limits_in_words};
use crate::error::{ResizeError, STATING};
use crate::lives::handle::Handle;
use crate::{Choreographer, Error, ServantRequest};
use store::NewEvent;
use tokio::time::{Instant, timeout};
use tracing::Instrument;

/// Timeout for one servant to apply limits.
const PATIENCE: Duration = Duration::from_secs(5);

impl Choreographer {
    /// Changes the given limits of a running servant, and its promise with them.
    pub async fn set_limits(&self, id: &str, change: Limits) -> Result<(), Error> {
        let (whole, handle) = (self.clone(), self.servant(id)?);
        let span = handle.span(None);
        let set = async move { whole.apply_limits(&handle, change).await };
        // The caller may go away meanwhile; a change in progress is completed.
        tokio::spawn(set.instrument(span)).await.map_err(|_| Error::Internal("changing a servant's limits"))?
    }

    async fn apply_limits(&self, handle: &Handle, change: Limits) -> Result<(), Error> {
        let id = &handle.id;
        handle.check_container()?;
        // One change at a time: the promise, the limits in force and the stored limits must agree.
        let _turn = handle.lock_limits().await;
        let before = handle.limit_sources();
        let after = LimitSources { set: change.or(before.set), ..before.clone() };
        let inner = &self.inner;
        let set = after.set;
        let [has, wanted] = [&before, &after].map(|sources| inner.promised_amount(&sources.promised_limits()));
        if !wanted.fits(has) {
            // More than the whole machine is no matter of waiting.
            inner.admission.ledger().check(wanted)?;
        }
        let in_force = inner.resize(handle, with_default_weight(change), after).await?;
        inner.state.set_servant_limits(id, &set)?;
        let message = format!("servant {id}: limits changed to {in_force}");
        inner.journal.info("limits-changed", &message, &handle.event_context());
        Ok(())
    }
}

impl ChoreographerInner {
    /// Reports a robot that is refused for its statement.
    pub(crate) fn report_refused(&self, request: &ServantRequest, error: &Error) {
        let (service, robot) = (&request.service, &request.robot);
        let about = NewEvent { service: Some(service), servant: None, robot: Some(robot) };
        self.report_terms_refused(service, robot, &about, || {
            let stated = &request.stated;
            format!("robot {robot} requests {stated} of {service} and is refused: {error}")
        });
    }

    /// Reports a servant that keeps its limits although its robot states or sends something else.
    pub(crate) fn report_not_resized(&self, handle: &Handle, error: &Error) {
        let (service, robot) = (handle.service(), &handle.robot);
        self.report_terms_refused(service, robot, &handle.event_context(), || error.to_string());
    }

    fn report_terms_refused(&self, service: &str, robot: &str, about: &NewEvent<'_>, message: impl FnOnce() -> String) {
        let now = Instant::now().into_std();
        let told = self.refusals.lock().record_refusal(service, robot, now);
        if let Some(before) = told {
            let message = message() + &suppressed_note(before);
            self.journal.warning("terms-refused", &message, about);
        }
    }

    /// Applies the new statement of one of the robot's clients to a running servant. If that is impossible, it keeps
    /// its limits.
    pub(crate) async fn agree_terms(&self, handle: &Handle, who: &str, stated: &Stated) -> Result<(), Error> {
        let agreed = self.apply_statement(handle, who, stated).await;
        if let Err(error @ Error::NotResized { .. }) = &agreed {
            self.report_not_resized(handle, error);
        }
        agreed
    }

    async fn apply_statement(&self, handle: &Handle, who: &str, stated: &Stated) -> Result<(), Error> {
        let _turn = handle.lock_limits().await;
        let before = handle.limit_sources();
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
                reason: Box::new(ResizeError::Many),
            });
        }
        let measured = before.terms.measured.clone();
        let terms = self.with_offer(&handle.revision, |_| measured, |offer| compute_terms(&all, offer))?;
        let why = stated.to_string();
        let changed = self.apply_terms(handle, before, terms, &why).await?;
        if !handle.is_place() {
            let states = handle.terms().describe_stated();
            self.report_changed(handle, changed, &format!("its robot requests {states}"));
        }
        Ok(())
    }

    /// Removes the statements of clients that have been away for the grace time from a running servant. If it cannot be
    /// made smaller, it keeps its limits.
    pub(crate) async fn forget_stated(&self, handle: &Handle, grace: Duration) -> Result<(), Error> {
        // A client that is back by now waits for this lock, and states it again.
        let _turn = handle.lock_limits().await;
        let away = handle.clients_away_for(grace);
        let before = handle.limit_sources();
        let mut left = before.terms.stated.clone();
        left.retain(|who, _| !away.contains(who));
        if left.len() == before.terms.stated.len() {
            return Ok(());
        }
        let measured = before.terms.measured.clone();
        let terms = self.with_offer(&handle.revision, |_| measured, |offer| compute_terms(&left, offer))?;
        let away: Vec<&str> = away.iter().map(|who| client_in_words(who)).collect();
        let why = format!("its robot's clients without {}", away.join(", "));
        let changed = self.apply_terms(handle, before, terms, &why).await?;
        if !handle.is_place() {
            let why = format!("the requests of {} expired {} s after it left", away.join(", "), grace.as_secs_f64());
            self.report_changed(handle, changed, &why);
        }
        Ok(())
    }

    /// Applies the dictionary's rows for the measured message sizes to a running servant. If that is impossible, it
    /// keeps its limits.
    pub(crate) async fn apply_measured(&self, handle: &Handle, inputs: &[MeasuredInput]) -> Result<(), Error> {
        let _turn = handle.lock_limits().await;
        let before = handle.limit_sources();
        let known = &before.terms.measured;
        let anew = self.with_offer(
            &handle.revision,
            |rows| merge_max(known, aux_from_inputs(inputs, rows)),
            |offer| {
                let terms = || compute_terms(&before.terms.stated, offer);
                (offer.measured != known).then(|| (aux_pairs(offer.measured), terms()))
            },
        )?;
        let Some((sends, terms)) = anew else {
            return Ok(());
        };
        let why = format!("messages of {sends}");
        let changed = self.apply_terms(handle, before.clone(), terms, &why).await?;
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
                limits_in_words(&earlier),
                limits_in_words(&handle.limits()),
            ),
            None => format!("servant {id}: {why}; its limits are unchanged"),
        };
        self.journal.info("terms-changed", &message, &handle.event_context());
    }

    /// Applies these terms to a servant, for the reason `why`; returns the previous limits if they change. Requires
    /// [`Handle::lock_limits`].
    async fn apply_terms(
        &self,
        handle: &Handle,
        before: LimitSources,
        terms: Result<Terms, TermsError>,
        why: &str,
    ) -> Result<Option<Limits>, Error> {
        let refused = |reason| Error::NotResized {
            servant: handle.id.clone(),
            service: handle.service().to_owned(),
            stated: why.to_owned(),
            reason: Box::new(reason),
        };
        let terms = terms.map_err(|untenable| refused(ResizeError::Untenable(untenable)))?;
        let after = LimitSources { terms, ..before.clone() };
        if handle.is_place() {
            // It has no container; the group takes the goals of its SLA into account.
            handle.set_limit_sources(after);
            return Ok(None);
        }
        let (earlier, told) = (before.limits(), after.terms.clone());
        let change = earlier.changes_to(after.limits(), self.options.cores);
        if let (Some(wanted), Some(container)) = (change.memory, handle.container())
            && earlier.memory.is_none_or(|earlier| wanted < earlier)
            && let Ok(usage) = container.usage().await
            && wanted.0 < usage.memory
        {
            let used = Size(usage.memory);
            return Err(refused(ResizeError::Used { used, wanted }));
        }
        let resized = change != Limits::default();
        if resized {
            let resized = self.resize(handle, change, after).await;
            resized.map_err(|error| match error {
                Error::Full(full) => refused(ResizeError::Full(full)),
                error => error,
            })?;
        } else {
            handle.set_limit_sources(after);
        }
        self.state.set_servant_terms(&handle.id, &told)?;
        Ok(resized.then_some(earlier))
    }

    /// Applies the limits of `change` to a servant and promises `after` to it; all or nothing. Requires
    /// [`Handle::lock_limits`]. Returns the limits in force afterwards.
    async fn resize(&self, handle: &Handle, change: Limits, after: LimitSources) -> Result<String, Error> {
        let unreached = || Error::Servant {
            service: handle.service().to_owned(),
            robot: handle.robot.clone(),
            reason: "is not running, so its limits cannot be changed".to_owned(),
            log: Vec::new(),
        };
        let container = handle.container().ok_or_else(unreached)?;
        let promise = handle.promise().ok_or_else(unreached)?;
        let before = handle.limit_sources();
        let (has, wanted) =
            (self.promised_amount(&before.promised_limits()), self.promised_amount(&after.promised_limits()));
        // An increase is promised before the kernel grants it, and a decrease is released only after the kernel has
        // applied it: otherwise more would be promised than there is if the kernel refuses.
        promise.change(has.max(wanted))?;
        if let Err(error) = container.set_limits(change).await {
            // What the kernel applied before it refused the rest is reverted.
            let back = change.changes_to(before.limits(), self.options.cores);
            let _ = container.set_limits(back).await;
            promise.change(has)?;
            return Err(error.into());
        }
        handle.set_limit_sources(after);
        promise.change(wanted)?;
        Ok(limits_in_words(&container.enforced_limits().limits))
    }
}

/// Returns a human-readable name of a client: a stub by its node.
fn client_in_words(who: &str) -> &str {
    match who {
        "" => "a rosbridge client",
        node => node,
    }
}

/// Changes the limits of a container from `made` to those of its servant.
pub(super) async fn fit_container(
    container: &dyn ServantHandle,
    made: &Limits,
    limits: &Limits,
    cores: f64,
) -> Result<(), servant::Error> {
    let change = made.changes_to(*limits, cores);
    if change != Limits::default() {
        container.set_limits(change).await?;
    }
    Ok(())
}

/// Restores the promised cores of an adopted servant, if an earlier daemon's controller has moved them and this daemon
/// has no controller.
pub(super) async fn restore_cores(inner: &ChoreographerInner, handle: &Handle, container: &dyn ServantHandle) {
    let (has, wanted) = (container.enforced_limits().limits, handle.limits());
    // Cores that this host cannot limit were not moved.
    if inner.options.controller || has.cpus.is_none() {
        return;
    }
    let _turn = handle.lock_limits().await;
    let before = Limits {
        // A servant that may have all cores has nothing to restore.
        cpus: has.cpus.filter(|_| wanted.cpus.is_some()),
        cpu_weight: has.cpu_weight,
        ..Limits::default()
    };
    let after = Limits {
        cpus: wanted.cpus,
        cpu_weight: wanted.cpu_weight.or(has.cpu_weight.and(Some(DEFAULT_CPU_WEIGHT))),
        ..Limits::default()
    };
    let change = before.changes_to(after, inner.options.cores);
    if change == Limits::default() {
        return;
    }
    let (id, about) = (&handle.id, handle.event_context());
    match timeout(PATIENCE, container.set_limits(change)).await {
        Ok(Ok(_)) => {
            let message = format!(
                "servant {id} of {} for {}: back from {} to {}: the controller is off",
                handle.service(),
                handle.robot,
                limits_in_words(&before),
                limits_in_words(&change),
            );
            inner.journal.info("cores-moved", &message, &about);
        }
        Ok(Err(error)) => {
            let message = format!("servant {id} keeps cores set by the controller: {error}");
            inner.journal.warning("limits-unmet", &message, &about);
        }
        Err(_) => {
            let message = format!("servant {id} keeps cores set by the controller: it does not answer");
            inner.journal.warning("limits-unmet", &message, &about);
        }
    }
}
