//! A comparison, from its first request to its report.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::shadow::{NotCompared, Shadow, ShadowOptions};
use budget::Budget;
use bytes::Bytes;
use package::difference::Difference;
use reach::Reach;
use reach::tap::{TapAnswer, TapEvent, TapEventKind, TapReceiver};
use ros::bus::Graph;
use ros::codec::{JsonOptions, NonFinite, to_json};
use ros::schema::{MessageType, Registry};
use serde_json::Value;
use tokio::sync::watch;
use tokio::time::Instant;

use super::exchanges::Exchanges;
use super::topics::{self, HeardMessage, MirroredTopics};
use crate::decide::shadow::{DifferingField, ShadowSide, Tally, Tolerance, differences, overall_verdict};
use crate::lives::handle::{Failure, Handle, Life};
use crate::{Choreographer, Error, MeasuredServant};

/// Time for messages in flight at the end.
const GRACE: Duration = Duration::from_secs(5);
/// Time without messages, at equal counts on both sides, after which nothing is in flight any more.
const QUIET: Duration = Duration::from_secs(2);
/// Minimum and maximum time to wait for publishers.
const SETTLES: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(2));
/// Maximum size of a message as JSON, in bytes; a larger one is compared as a whole.
const LONGEST: usize = 4 << 20;
/// Maximum number of interface differences reported.
const MAX_NAMED_DIFFERENCES: usize = 8;

/// A comparison.
pub(super) struct Mirror<'a> {
    options: &'a ShadowOptions,
    tolerance: Tolerance,
    present: &'a Handle,
    candidate: &'a MeasuredServant,
    registry: Arc<Registry>,
    graph: watch::Receiver<Arc<Graph>>,
    tapping: TapReceiver,
    topics: MirroredTopics,
    exchanges: Exchanges,
    notes: ComparisonNotes,
}

/// Parts that could not be compared, with the reasons.
#[derive(Default)]
pub(super) struct ComparisonNotes(BTreeMap<(String, String), u64>);

impl ComparisonNotes {
    pub(super) fn add(&mut self, what: &str, why: &str) {
        self.add_many(what, why, 1);
    }

    fn add_many(&mut self, what: &str, why: &str, count: u64) {
        *self.0.entry((what.to_owned(), why.to_owned())).or_default() += count;
    }

    fn into_not_compared(self) -> Vec<NotCompared> {
        let notes = self.0.into_iter();
        notes.map(|((what, why), count)| NotCompared { what, why, count }).collect()
    }
}

/// End of a comparison.
enum ComparisonEnd {
    /// Messages in flight are waited for.
    Soon(String),
    /// The candidate is gone; the flag says whether its nodes failed.
    Now(String, bool),
}

impl<'a> Mirror<'a> {
    pub(super) async fn open(
        choreographer: &Choreographer,
        present: &'a Handle,
        (candidate, reach): (&'a MeasuredServant, &dyn Reach),
        options: &'a ShadowOptions,
        budget: &Budget,
    ) -> Result<Mirror<'a>, Error> {
        let gone = || Error::Shadow(format!("robot {} left while the candidate was starting", present.robot));
        let there = present.reach().ok_or_else(gone)?;
        let tapping = there.tap(budget).await.ok_or_else(|| {
            Error::Shadow(format!(
                "servant {} of robot {} is already being compared with a candidate; wait until that ends",
                present.id, present.robot
            ))
        })?;
        let revision = &present.revision;
        let opener = &choreographer.inner.opener;
        // A robot of a shared service has no servant of its own, and no topics. The look connects to no external host.
        let look = match present.container() {
            Some(container) => {
                Some(opener.observe(&container, revision.flavour.ros.ros_version(), topics::NODE, &[]).await?)
            }
            None => None,
        };
        let definitions = &revision.interface.definitions;
        let ros = revision.flavour.ros.ros_version();
        let registry = Registry::with_definitions(ros, definitions)
            .map_err(|error| Error::Shadow(format!("invalid message definition of {}: {error}", revision.service)))?;
        let registry = Arc::new(registry);
        let (from, to) = (there.bus(), reach.bus());
        let mut notes = ComparisonNotes::default();
        let robot = (from.node(), present.is_linked());
        let topics = MirroredTopics::new(look, Arc::clone(&to), robot, &registry, budget);
        note_interfaces(present, candidate.lease.handle(), &mut notes);
        let graph = from.graph();
        let mut mirror = Mirror {
            options,
            tolerance: Tolerance { number: options.tolerance, ignore: options.ignore.clone() },
            present,
            candidate,
            registry,
            graph,
            tapping,
            topics,
            exchanges: Exchanges::new(from, to),
            notes,
        };
        mirror.settle_in().await;
        Ok(mirror)
    }

    /// Subscribes to the existing topics, and starts once publishers are likely to know of it: a ROS 1 publisher
    /// registers a subscriber some time after it has answered it, without telling anyone. That takes about as long as
    /// its answer.
    async fn settle_in(&mut self) {
        let began = Instant::now();
        self.follow().await;
        tokio::time::sleep((began.elapsed() * 2).clamp(SETTLES.0, SETTLES.1)).await;
        // Messages that the new subscriptions triggered may have been missed.
        while self.tapping.told.try_recv().is_ok() {}
    }

    async fn follow(&mut self) {
        let graph = self.graph.borrow_and_update().clone();
        self.topics.follow(&graph, &mut self.notes).await;
    }

    /// Runs the comparison to its end.
    pub(super) async fn run(mut self) -> Shadow {
        let began = Instant::now();
        let ends = began + Duration::from_secs_f64(self.options.seconds);
        let mut present = self.present.watch();
        let (reason, failed) = loop {
            if self.has_enough() {
                break (format!("{} requests were compared", self.given_count()), None);
            }
            let end = tokio::select! {
                told = self.tapping.told.recv() => self.on_tapped(told, false).await,
                Some(heard) = self.topics.heard.recv() => {
                    // Calls are reported before they are carried out, so their outputs are handled after them here,
                    // too.
                    let end = self.catch_up().await;
                    let enough = self.has_enough();
                    self.on_heard(heard, enough).await;
                    end
                }
                Some(answer) = self.exchanges.answers.join_next() => { self.on_candidate_answer(answer); None }
                Ok(()) = self.graph.changed() => { self.follow().await; None }
                () = wait_left(&mut present) => Some(ComparisonEnd::Soon("the robot's servant has ended".to_owned())),
                () = wait_over(self.candidate) => Some(candidates_end(self.candidate)),
                () = tokio::time::sleep_until(ends) => Some(ComparisonEnd::Soon("its time is up".to_owned())),
            };
            match end {
                None => {}
                Some(ComparisonEnd::Soon(reason)) => break (reason, None),
                Some(ComparisonEnd::Now(reason, failed)) => {
                    break (reason.clone(), failed.then_some(reason));
                }
            }
        };
        let seconds = began.elapsed().as_secs_f64();
        let (ended, failed) = match (failed, self.candidate.lease.handle().life().is_over()) {
            (None, false) => self.settle(reason).await,
            (failed, _) => (reason, failed),
        };
        // A candidate that was ended has not answered what was in flight.
        let cut = failed.is_none() && self.candidate.lease.handle().life().is_over();
        self.into_report(seconds, ended, failed, cut)
    }

    /// Handles the calls and goals reported so far.
    async fn catch_up(&mut self) -> Option<ComparisonEnd> {
        while !self.has_enough() {
            let Ok(told) = self.tapping.told.try_recv() else {
                break;
            };
            let end = self.on_tapped(Some(told), false).await;
            if end.is_some() {
                return end;
            }
        }
        None
    }

    /// Waits for messages in flight, and accepts no new requests.
    async fn settle(&mut self, reason: String) -> (String, Option<String>) {
        let ends = Instant::now() + GRACE;
        // What the robot's servant does after its next request has no counterpart.
        let mut over_there = false;
        loop {
            let even = self.exchanges.is_even() && self.topics.is_even();
            let end = tokio::select! {
                told = self.tapping.told.recv() => {
                    over_there |= told.as_ref().is_none_or(|told| !matches!(told.what, TapEventKind::Answered { .. }));
                    self.on_tapped(told, true).await;
                    None
                }
                Some(heard) = self.topics.heard.recv() => {
                    over_there |= self.topics.is_request(&heard);
                    if !(over_there && MirroredTopics::is_present(&heard)) {
                        self.on_heard(heard, true).await;
                    }
                    None
                }
                Some(answer) = self.exchanges.answers.join_next() => { self.on_candidate_answer(answer); None }
                () = wait_over(self.candidate) => Some(candidates_end(self.candidate)),
                () = tokio::time::sleep(QUIET), if even => break,
                () = tokio::time::sleep_until(ends) => break,
            };
            if let Some(ComparisonEnd::Now(reason, failed)) = end {
                return (reason.clone(), failed.then_some(reason));
            }
        }
        (reason, None)
    }

    fn given_count(&self) -> u64 {
        self.topics.given + self.exchanges.given
    }

    fn has_enough(&self) -> bool {
        self.options.requests.is_some_and(|enough| self.given_count() >= enough)
    }

    async fn on_tapped(&mut self, told: Option<TapEvent>, ending: bool) -> Option<ComparisonEnd> {
        let Some(TapEvent { number, at, what }) = told else {
            return Some(ComparisonEnd::Soon("the robot's servant has ended".to_owned()));
        };
        match what {
            TapEventKind::Answered { answer, took } => {
                self.on_answer(ShadowSide::Present, (number, answer, millis(took)));
            }
            TapEventKind::Cancel => self.exchanges.cancel(number),
            TapEventKind::Call { .. } | TapEventKind::Goal { .. } if ending => {}
            // These are received by their topics.
            TapEventKind::Goal { .. } if self.present.is_linked() => {}
            asked => {
                self.topics.on_request(at);
                let (registry, notes) = (&self.registry, &mut self.notes);
                self.exchanges.ask(number, asked, registry, notes).await;
            }
        }
        None
    }

    async fn on_heard(&mut self, heard: HeardMessage, ending: bool) {
        if !self.topics.is_request(&heard) {
            self.topics.on_output(heard, &self.tolerance, &mut self.notes);
        } else if !ending {
            self.topics.give(heard, &mut self.notes).await;
        }
    }

    fn on_candidate_answer(&mut self, answer: Result<(u64, TapAnswer, f64), tokio::task::JoinError>) {
        if let Ok(answer) = answer {
            self.on_answer(ShadowSide::Candidate, answer);
        }
    }

    fn on_answer(&mut self, side: ShadowSide, answer: (u64, TapAnswer, f64)) {
        let (tolerance, notes) = (&self.tolerance, &mut self.notes);
        self.exchanges.record_answer(side, answer, tolerance, notes);
    }

    fn into_report(mut self, seconds: f64, ended: String, failed: Option<String>, cut: bool) -> Shadow {
        let given = self.given_count();
        self.exchanges.end(cut, &mut self.notes);
        self.topics.end(cut, &self.tolerance, &mut self.notes);
        let left_out = self.tapping.omitted_count();
        if left_out > 0 {
            let why = "too many arrived at once";
            self.notes.add_many("calls and goals", why, left_out);
        }
        let tallies = self.topics.into_tallies().chain(self.exchanges.into_tallies());
        let compared: Vec<_> = tallies.map(Tally::into_compared).collect();
        let (verdict, why) = overall_verdict(&compared, failed.as_deref(), self.options.bound);
        let revision = &self.present.revision;
        Shadow {
            service: revision.service.clone(),
            robot: self.present.robot.clone(),
            revision: revision.number,
            candidate: self.candidate.lease.handle().revision.number,
            verdict,
            why,
            seconds,
            ended,
            given,
            compared,
            not_compared: self.notes.into_not_compared(),
        }
    }
}

async fn wait_left(present: &mut watch::Receiver<Life>) {
    let _ = present.wait_for(Life::is_over).await;
}

async fn wait_over(candidate: &MeasuredServant) {
    candidate.lease.wait_over().await;
}

fn candidates_end(candidate: &MeasuredServant) -> ComparisonEnd {
    let life = candidate.lease.handle().life();
    let reason = life.reason().unwrap_or_default();
    match life.failure {
        Some(Failure::Broken { .. }) => ComparisonEnd::Now(reason, true),
        _ => ComparisonEnd::Now(format!("the candidate was ended: {reason}"), false),
    }
}

/// Reason for answers in flight when the candidate was ended.
pub(super) const CUT: &str = "the candidate was ended before it answered";

/// Notes differences of the interfaces, which are known to have no counterpart.
fn note_interfaces(present: &Handle, candidate: &Handle, notes: &mut ComparisonNotes) {
    let (one, other) = (&present.revision, &candidate.revision);
    let difference = Difference::compare(&one.interface, &other.interface);
    let breaking = difference.changes.iter().filter(|it| !it.compatible);
    for change in breaking.take(MAX_NAMED_DIFFERENCES) {
        let why = format!("the interfaces of revisions {} and {} differ", one.number, other.number);
        notes.add_many(&change.to_string(), &why, 0);
    }
    if one.plan.stateful || other.plan.stateful {
        let why = "the candidate started without the robot's earlier inputs";
        notes.add_many("state of the nodes", why, 0);
    }
}

pub(super) fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// A message as JSON; `None` if it cannot be decoded or is too long.
pub(super) type JsonMessage = Option<Value>;

pub(super) fn read_json(of: Option<&MessageType>, message: &[u8]) -> JsonMessage {
    let options = JsonOptions { non_finite: NonFinite::String, max_bytes: LONGEST, ..JsonOptions::default() };
    let mut json = Vec::new();
    to_json(of?, message, &mut json, &options).ok()?;
    serde_json::from_slice(&json).ok()
}

/// Returns the differences of two messages; undecodable ones differ as a whole.
pub(super) fn message_differences(
    read: Option<(&Value, &Value)>,
    (one, other): (&Bytes, &Bytes),
    tolerance: &Tolerance,
) -> Vec<DifferingField> {
    match read {
        _ if one == other => Vec::new(),
        Some((one, other)) => differences(one, other, tolerance),
        None => {
            let bytes = |of: &Bytes| format!("{} bytes", of.len());
            vec![DifferingField::whole_answer(bytes(one), bytes(other))]
        }
    }
}

pub(super) fn compare(
    of: Option<&MessageType>,
    one: &Bytes,
    other: &Bytes,
    tolerance: &Tolerance,
) -> Vec<DifferingField> {
    if one == other {
        return Vec::new();
    }
    let (read_one, read_other) = (read_json(of, one), read_json(of, other));
    let values = read_one.as_ref().zip(read_other.as_ref());
    message_differences(values, (one, other), tolerance)
}
