//! A push that runs: what it printed so far, for any number of clients that come and go.
//!
//! ```text
//!   events of the push ─▶ kept, up to a size: the oldest log lines go first ─▶ follower: what it has not seen yet
//!                                                                          └─▶ follower …
//! ```
//!
//! A slow follower delays neither the push nor other followers: it misses lines that are no longer kept.

use std::collections::VecDeque;
use std::sync::Arc;

use api::{Millis, PushCount, PushEvent, PushState, PushStatus};
use parking_lot::Mutex;
use store::PushRecord;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// Maximum size of the events kept of a running push, in bytes.
const MAX_EVENT_BYTES: usize = 2 << 20;
/// Size counted for each event besides its text, in bytes.
const EVENT_OVERHEAD: usize = 64;
/// Maximum size of the output that is stored when a push has ended, in bytes.
const MAX_STORED_OUTPUT: usize = 256 << 10;
/// Maximum length of the reason of a failure in the list of pushes. The output has all of it.
const LONGEST_MESSAGE: usize = 1000;

/// A push that runs.
pub struct RunningPush {
    /// Number of the push.
    pub number: u64,
    /// Id of its build.
    pub(super) id: String,
    /// Description of what is pushed.
    source: String,
    /// Name of the principal that pushes.
    by: String,
    began: Millis,
    /// Cancelled when somebody cancels the push.
    pub(super) cancel: CancellationToken,
    /// Cancelled when the push begins to publish, after which it can no longer be cancelled.
    pub(super) publishing: CancellationToken,
    /// Cancelled when the archive is complete, from when on the push needs no client.
    pub(super) received: CancellationToken,
    output: Mutex<PushOutput>,
    /// Number of events so far.
    grown: watch::Sender<u64>,
}

/// An event and its number, which counts from 0.
struct NumberedEvent {
    number: u64,
    event: PushEvent,
}

#[derive(Default)]
struct PushOutput {
    service: Option<String>,
    kept: VecDeque<NumberedEvent>,
    /// Size of what is kept.
    bytes: usize,
    /// Number of the next event.
    next: u64,
    /// Number after that of the last event that was removed; 0 if there was none.
    removed_to: u64,
    /// Latest progress of the current step. Earlier ones are of no interest.
    progress: Option<NumberedEvent>,
    step: String,
    step_began: Millis,
    last_took: Option<u64>,
    has_ended: bool,
}

/// A step that was completed.
pub(super) struct CompletedStep {
    pub(super) title: String,
    /// Duration in milliseconds.
    pub(super) took: u64,
}

impl RunningPush {
    /// Creates a push from its record.
    pub(super) fn new(record: PushRecord, id: String) -> RunningPush {
        RunningPush {
            number: record.id,
            id,
            source: record.source,
            by: record.who,
            began: record.began,
            cancel: CancellationToken::new(),
            publishing: CancellationToken::new(),
            received: CancellationToken::new(),
            output: Mutex::new(PushOutput { service: record.service, ..PushOutput::default() }),
            grown: watch::Sender::new(0),
        }
    }

    /// Returns what the durations of its steps are recorded for: the service, otherwise what is pushed.
    pub(super) fn subject(&self) -> String {
        self.output.lock().service.clone().unwrap_or_else(|| self.source.clone())
    }

    /// Sets the name of the service.
    pub(super) fn set_service(&self, name: &str) {
        self.output.lock().service = Some(name.to_owned());
    }

    /// Adds an event. Returns the step that a new one completes, unless it was spent waiting.
    pub(super) fn add(&self, event: PushEvent) -> Option<CompletedStep> {
        let mut output = self.output.lock();
        let completed = output.add(event, store::now());
        self.grown.send_replace(output.next);
        completed
    }

    /// Adds the last event. Returns the step that a success completes.
    pub(super) fn end(&self, event: PushEvent) -> Option<CompletedStep> {
        let mut output = self.output.lock();
        let completed = output.add(event, store::now());
        output.has_ended = true;
        self.grown.send_replace(output.next);
        completed
    }

    /// Cancels the push; false if it publishes already or has ended.
    pub fn cancel(&self) -> bool {
        let can = !self.publishing.is_cancelled() && !self.output.lock().has_ended;
        if can {
            self.cancel.cancel();
        }
        can
    }

    /// Follows the output from its beginning.
    pub fn follow(self: &Arc<Self>) -> PushFollower {
        PushFollower { grown: self.grown.subscribe(), push: Arc::clone(self), seen: 0 }
    }

    /// Returns what is kept of the output so far.
    pub fn output(&self) -> Vec<PushEvent> {
        self.output.lock().read(&mut 0)
    }

    /// Returns the state of the push, for its list.
    pub fn status(&self) -> PushStatus {
        let output = self.output.lock();
        let progress = output.progress.as_ref().and_then(|latest| match &latest.event {
            PushEvent::Progress { unit, done, total } => {
                Some(PushCount { unit: unit.clone(), done: *done, total: *total })
            }
            _ => None,
        });
        PushStatus {
            number: self.number,
            service: output.service.clone(),
            source: self.source.clone(),
            by: self.by.clone(),
            state: PushState::Running,
            began: self.began,
            ended: None,
            step: output.step.clone(),
            step_began: (!output.step.is_empty()).then_some(output.step_began),
            last_took: output.last_took,
            progress,
            message: None,
            can_read: false,
            can_cancel: false,
        }
    }

    /// Returns the record of the push that ends with this event, and its output as JSON lines.
    pub(super) fn to_record(&self, last: &PushEvent) -> (PushRecord, String) {
        let (state, message) = match last {
            PushEvent::Done { .. } | PushEvent::Underlay { .. } => (PushState::Published, None),
            PushEvent::Error { .. } if self.cancel.is_cancelled() => (PushState::Cancelled, None),
            PushEvent::Error { problem } => {
                (PushState::Failed, Some(problem.detail.chars().take(LONGEST_MESSAGE).collect()))
            }
            _ => (PushState::Failed, None),
        };
        let output = self.output.lock();
        let record = PushRecord {
            id: self.number,
            service: output.service.clone(),
            source: self.source.clone(),
            who: self.by.clone(),
            began: self.began,
            ended: Some(store::now()),
            state,
            step: output.step.clone(),
            message,
        };
        (record, output.to_lines(last))
    }
}

impl PushOutput {
    fn add(&mut self, event: PushEvent, now: Millis) -> Option<CompletedStep> {
        let number = self.next;
        self.next += 1;
        if matches!(event, PushEvent::Progress { .. }) {
            self.progress = Some(NumberedEvent { number, event });
            return None;
        }
        let is_over = matches!(
            event,
            PushEvent::Step { .. } | PushEvent::Done { .. } | PushEvent::Underlay { .. } | PushEvent::Error { .. }
        );
        let mut completed = None;
        if is_over {
            self.progress = None;
            let (title, took) = (self.step.clone(), now.saturating_sub(self.step_began));
            let counts = !matches!(event, PushEvent::Error { .. }) && !title.is_empty() && !is_waiting(&title);
            completed = counts.then_some(CompletedStep { title, took });
        }
        if let PushEvent::Step { title, last_took } = &event {
            self.step.clone_from(title);
            self.step_began = now;
            self.last_took = *last_took;
        }
        self.bytes += event_size(&event);
        self.kept.push_back(NumberedEvent { number, event });
        while self.bytes > MAX_EVENT_BYTES && self.kept.len() > 1 {
            // Steps and warnings are few, and tell more than lines.
            let oldest = self.kept.iter().position(|one| matches!(one.event, PushEvent::Log { .. })).unwrap_or(0);
            if let Some(removed) = self.kept.remove(oldest) {
                self.bytes -= event_size(&removed.event);
                self.removed_to = self.removed_to.max(removed.number + 1);
            }
        }
        completed
    }

    /// Returns the events from number `seen` on, which becomes that of the next one.
    fn read(&self, seen: &mut u64) -> Vec<PushEvent> {
        let first = self.kept.partition_point(|one| one.number < *seen);
        let mut events = Vec::with_capacity(self.kept.len() - first + 2);
        if self.removed_to > *seen {
            events.push(removal_mark());
        }
        events.extend(self.kept.iter().skip(first).map(|one| one.event.clone()));
        events.extend(self.progress.iter().filter(|latest| latest.number >= *seen).map(|latest| latest.event.clone()));
        *seen = self.next;
        events
    }

    /// Returns the newest events and `last` as JSON lines, as far as they may be stored.
    fn to_lines(&self, last: &PushEvent) -> String {
        let to_line = |event: &PushEvent| serde_json::to_string(event).unwrap_or_default();
        let mut lines = vec![to_line(last)];
        let mut bytes = 0;
        for one in self.kept.iter().rev() {
            let line = to_line(&one.event);
            bytes += line.len();
            if bytes > MAX_STORED_OUTPUT {
                lines.push(to_line(&removal_mark()));
                break;
            }
            lines.push(line);
        }
        let mut text = String::with_capacity(bytes);
        for line in lines.iter().rev() {
            text.push_str(line);
            text.push('\n');
        }
        text
    }
}

/// Returns the line in place of those that were removed.
fn removal_mark() -> PushEvent {
    PushEvent::Log { line: "(earlier lines are no longer kept)".to_owned() }
}

/// Returns true if the step waits for others, so that its duration says nothing about the next push.
fn is_waiting(title: &str) -> bool {
    title.starts_with("waiting")
}

fn event_size(event: &PushEvent) -> usize {
    let text = match event {
        PushEvent::Log { line } => line.len(),
        PushEvent::Step { title, .. } => title.len(),
        PushEvent::Warning { message } => message.len(),
        PushEvent::Accepted { .. }
        | PushEvent::Progress { .. }
        | PushEvent::Done { .. }
        | PushEvent::Underlay { .. }
        | PushEvent::Error { .. } => 0,
    };
    text + EVENT_OVERHEAD
}

/// Reads the output of a push while it grows.
pub struct PushFollower {
    push: Arc<RunningPush>,
    grown: watch::Receiver<u64>,
    seen: u64,
}

impl PushFollower {
    /// Waits for further events; `None` if the push has ended and all were returned.
    pub async fn next(&mut self) -> Option<Vec<PushEvent>> {
        loop {
            // Before reading, so that no event is missed in between.
            self.grown.borrow_and_update();
            let (events, has_ended) = {
                let output = self.push.output.lock();
                (output.read(&mut self.seen), output.has_ended)
            };
            if !events.is_empty() {
                return Some(events);
            }
            if has_ended {
                return None;
            }
            self.grown.changed().await.ok()?;
        }
    }
}

/// Cancels a push whose client leaves before the archive is complete.
pub struct ReceptionGuard(Arc<RunningPush>);

impl ReceptionGuard {
    /// Creates the guard of a push that was just started.
    pub fn new(push: Arc<RunningPush>) -> ReceptionGuard {
        ReceptionGuard(push)
    }
}

impl Drop for ReceptionGuard {
    fn drop(&mut self) {
        if !self.0.received.is_cancelled() {
            self.0.cancel.cancel();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn push() -> Arc<RunningPush> {
        let record = PushRecord {
            id: 7,
            service: None,
            source: "./maps".into(),
            who: "ada".into(),
            began: 0,
            ended: None,
            state: PushState::Running,
            step: String::new(),
            message: None,
        };
        Arc::new(RunningPush::new(record, "push-x".into()))
    }

    fn log(line: impl Into<String>) -> PushEvent {
        PushEvent::Log { line: line.into() }
    }

    fn progress(done: u64) -> PushEvent {
        PushEvent::Progress { unit: "packages".into(), done, total: None }
    }

    fn error() -> PushEvent {
        PushEvent::Error { problem: api::Problem { detail: "it broke".into(), ..api::Problem::default() } }
    }

    #[tokio::test]
    async fn whoever_comes_later_reads_the_same() {
        let push = push();
        let mut early = push.follow();
        push.add(PushEvent::step("compiling"));
        assert_eq!(early.next().await, Some(vec![PushEvent::step("compiling")]));
        push.add(progress(1));
        push.add(progress(2));
        push.add(log("a line"));
        assert_eq!(early.next().await, Some(vec![log("a line"), progress(2)]), "the latest progress alone");
        assert_eq!(push.output(), [PushEvent::step("compiling"), log("a line"), progress(2)]);
        let status = push.status();
        assert_eq!((&*status.step, status.progress.map(|count| count.done)), ("compiling", Some(2)));
        push.end(error());
        assert_eq!(early.next().await, Some(vec![error()]));
        assert_eq!(early.next().await, None);
        let mut late = push.follow();
        assert_eq!(late.next().await, Some(vec![PushEvent::step("compiling"), log("a line"), error()]));
        assert_eq!(late.next().await, None);
        assert!(!push.cancel(), "it has ended");
    }

    #[test]
    fn lines_beyond_the_limit_go_and_steps_stay() {
        let push = push();
        push.add(PushEvent::step("compiling"));
        let line = "x".repeat(1 << 10);
        for _ in 0..4 * MAX_EVENT_BYTES / line.len() {
            push.add(log(&*line));
        }
        push.add(log("the last"));
        let kept = push.output();
        assert!(kept.iter().map(event_size).sum::<usize>() <= MAX_EVENT_BYTES + 2 * EVENT_OVERHEAD, "{}", kept.len());
        assert!(matches!(&kept[0], PushEvent::Log { line } if line.contains("no longer kept")), "{:?}", kept[0]);
        assert_eq!(kept[1], PushEvent::step("compiling"));
        assert_eq!(kept.last(), Some(&log("the last")));
        let (record, output) = push.to_record(&error());
        assert!(output.len() < MAX_STORED_OUTPUT + 10_000, "{}", output.len());
        assert!(output.lines().all(|line| serde_json::from_str::<PushEvent>(line).is_ok()));
        assert_eq!((record.state, record.message.as_deref()), (PushState::Failed, Some("it broke")));
        let detail = "é".repeat(1 << 20);
        let long = PushEvent::Error { problem: api::Problem { detail, ..api::Problem::default() } };
        let (record, _) = push.to_record(&long);
        assert_eq!(record.message.map(|message| message.chars().count()), Some(LONGEST_MESSAGE));
    }

    #[test]
    fn a_step_is_completed_by_the_next_unless_it_waited() {
        let mut output = PushOutput::default();
        assert!(output.add(PushEvent::step("receiving"), 1000).is_none());
        let completed = output.add(PushEvent::step("waiting: others build"), 1500).expect("it was received");
        assert_eq!((&*completed.title, completed.took), ("receiving", 500));
        assert!(output.add(PushEvent::step("compiling"), 9000).is_none(), "waiting takes what others take");
        assert!(output.add(log("a line"), 9500).is_none());
    }

    #[test]
    fn a_client_that_leaves_ends_only_what_it_was_sending() {
        let sending = push();
        drop(ReceptionGuard::new(Arc::clone(&sending)));
        assert!(sending.cancel.is_cancelled());
        let sent = push();
        sent.received.cancel();
        drop(ReceptionGuard::new(Arc::clone(&sent)));
        assert!(!sent.cancel.is_cancelled());
        assert!(sent.cancel() && sent.cancel.is_cancelled());
        assert_eq!(sent.to_record(&error()).0.state, PushState::Cancelled);
        let published = push();
        published.publishing.cancel();
        assert!(!published.cancel() && !published.cancel.is_cancelled());
    }
}
