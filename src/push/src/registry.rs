//! All pushes: those that run, and those that ended lately.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::{PushEvent, PushState, PushStatus};
use parking_lot::Mutex;
use store::{PushRecord, State};

use super::running::{CompletedStep, RunningPush};
use crate::Error;

/// Number of pushes that are kept, the running ones included.
const MAX_PUSHES: u32 = 100;
/// Maximum length of the description of what is pushed, which its client chooses.
const LONGEST_SOURCE: usize = 300;
/// Time for which an ended push is kept.
const RECORD_EXPIRY: Duration = Duration::from_secs(14 * 24 * 3600);

/// All pushes, by number.
pub(super) struct PushRegistry {
    state: Arc<State>,
    running: Mutex<BTreeMap<u64, Arc<RunningPush>>>,
}

impl PushRegistry {
    pub(super) fn new(state: Arc<State>) -> PushRegistry {
        PushRegistry { state, running: Mutex::default() }
    }

    /// Registers a push that begins. `service` is its name, if known; `source` describes what is pushed.
    pub(super) fn begin(
        &self,
        id: &str,
        (service, source, by): (Option<&str>, &str, &str),
    ) -> Result<Arc<RunningPush>, Error> {
        let mut record = PushRecord {
            id: 0,
            service: service.map(str::to_owned),
            source: source.chars().take(LONGEST_SOURCE).collect(),
            who: by.to_owned(),
            began: store::now(),
            ended: None,
            state: PushState::Running,
            step: String::new(),
            message: None,
        };
        record.id = self.state.add_push(&record)?;
        let push = Arc::new(RunningPush::new(record, id.to_owned()));
        self.running.lock().insert(push.number, Arc::clone(&push));
        Ok(push)
    }

    /// Adds an event to a push. A step is told what it took last.
    pub(super) fn add_event(&self, push: &RunningPush, mut event: PushEvent) {
        let subject = push.subject();
        if let PushEvent::Step { title, last_took } = &mut event {
            *last_took = self.state.last_push_step(&subject, title).unwrap_or_default();
        }
        self.record_step(&subject, push.add(event));
    }

    fn record_step(&self, subject: &str, completed: Option<CompletedStep>) {
        let Some(CompletedStep { title, took }) = completed else {
            return;
        };
        if let Err(error) = self.state.record_push_step(subject, &title, took) {
            tracing::debug!("the duration of a step is not recorded: {error}");
        }
    }

    /// Ends a push with its last event.
    pub(super) fn end(&self, push: &RunningPush, event: PushEvent) {
        let (record, output) = push.to_record(&event);
        let since = store::now().saturating_sub(RECORD_EXPIRY.as_millis() as u64);
        if let Err(error) = self.state.end_push(&record, &output, MAX_PUSHES, since) {
            tracing::warn!("the end of push {} is not recorded: {error}", push.number);
        }
        self.running.lock().remove(&push.number);
        self.record_step(&push.subject(), push.end(event));
    }

    /// Returns a running push.
    pub(super) fn find(&self, number: u64) -> Option<Arc<RunningPush>> {
        self.running.lock().get(&number).cloned()
    }

    /// Returns the running push with this build.
    pub(super) fn find_build(&self, id: &str) -> Option<Arc<RunningPush>> {
        self.running.lock().values().find(|push| push.id == id).cloned()
    }

    /// Returns all pushes, newest first.
    pub(super) fn list(&self) -> Result<Vec<PushStatus>, Error> {
        // Before the records: a push that ends meanwhile is then found there.
        let running = self.running.lock().clone();
        let records = self.state.pushes()?;
        Ok(records
            .into_iter()
            .map(|record| match running.get(&record.id) {
                Some(push) if record.ended.is_none() => push.status(),
                _ => to_status(record),
            })
            .collect())
    }

    /// Returns what a push that has ended printed, as JSON lines; `None` if it is not known.
    pub(super) fn stored_output(&self, number: u64) -> Result<Option<String>, Error> {
        Ok(self.state.push_output(number)?)
    }
}

/// Converts the record of a push that does not run.
fn to_status(record: PushRecord) -> PushStatus {
    let (state, message) = match record.state {
        PushState::Running => (PushState::Failed, Some("the daemon restarted before the push had ended".to_owned())),
        state => (state, record.message),
    };
    PushStatus {
        number: record.id,
        service: record.service,
        source: record.source,
        by: record.who,
        state,
        began: record.began,
        ended: record.ended,
        step: record.step,
        step_began: None,
        last_took: None,
        progress: None,
        message,
        can_read: false,
        can_cancel: false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn registry(directory: &tempfile::TempDir) -> PushRegistry {
        let state = State::open(&directory.path().join("cloudroid.db")).expect("a database");
        PushRegistry::new(Arc::new(state))
    }

    fn begin(registry: &PushRegistry, id: &str) -> Arc<RunningPush> {
        let of = (Some("maps"), "./maps", "ada");
        registry.begin(id, of).expect("registered")
    }

    #[test]
    fn a_push_is_listed_while_it_runs_and_afterwards() {
        let directory = tempfile::tempdir().expect("a directory");
        let all = registry(&directory);
        let push = begin(&all, "push-a");
        all.add_event(&push, PushEvent::step("compiling"));
        let listed = all.list().expect("read");
        assert_eq!((listed[0].state, &*listed[0].step, &*listed[0].by), (PushState::Running, "compiling", "ada"));
        assert!(all.find_build("push-a").is_some() && all.find_build("push-b").is_none());
        push.publishing.cancel();
        let problem = api::Problem { detail: "it broke".into(), ..api::Problem::default() };
        all.end(&push, PushEvent::Error { problem });
        let listed = all.list().expect("read");
        assert_eq!((listed[0].state, listed[0].message.as_deref()), (PushState::Failed, Some("it broke")));
        assert!(all.find(push.number).is_none());
        let output = all.stored_output(push.number).expect("read").expect("kept");
        assert!(output.contains("compiling") && output.ends_with('\n'), "{output}");
        assert_eq!(output.lines().count(), 2, "the last event once: {output}");
    }

    #[test]
    fn a_push_that_its_daemon_did_not_survive_has_failed() {
        let directory = tempfile::tempdir().expect("a directory");
        begin(&registry(&directory), "push-a");
        let listed = registry(&directory).list().expect("read");
        assert_eq!(listed[0].state, PushState::Failed);
        assert!(listed[0].message.as_deref().is_some_and(|why| why.contains("restarted")), "{listed:?}");
    }

    #[test]
    fn a_step_tells_what_it_took_last() {
        let directory = tempfile::tempdir().expect("a directory");
        let all = registry(&directory);
        let first = begin(&all, "push-a");
        all.add_event(&first, PushEvent::step("compiling"));
        assert_eq!(first.status().last_took, None);
        all.add_event(&first, PushEvent::step("packing"));
        let second = begin(&all, "push-b");
        all.add_event(&second, PushEvent::step("compiling"));
        assert!(second.status().last_took.is_some());
        let told = second.output();
        assert!(matches!(told[0], PushEvent::Step { last_took: Some(_), .. }), "{told:?}");
        // The first has not completed this one yet.
        all.add_event(&second, PushEvent::step("packing"));
        assert_eq!(second.status().last_took, None);
    }
}
