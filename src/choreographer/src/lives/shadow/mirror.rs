//! One comparison, from its first request to what was found.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use api::shadow::{NotCompared, Shadow, ShadowOptions};
use budget::Budget;
use bytes::Bytes;
use package::difference::Difference;
use reach::Reach;
use reach::tap::{Answer, Tapped, Tapping, What};
use ros::bus::Graph;
use ros::codec::{JsonOptions, NonFinite, to_json};
use ros::schema::{MessageType, Registry};
use serde_json::Value;
use tokio::sync::watch;
use tokio::time::Instant;

use super::exchanges::Exchanges;
use super::topics::{self, Heard, Topics};
use crate::decide::shadow::{Differing, Side, Tally, Tolerance, differences, verdict};
use crate::lives::handle::{Failure, Handle, Life};
use crate::{Choreographer, Error, Measured};

/// What is on its way when it ends has so long to come.
const GRACE: Duration = Duration::from_secs(5);
/// So long nothing has come, and as much of both sides: then nothing is on its way any more.
const QUIET: Duration = Duration::from_secs(2);
/// What is waited for publishers, at least and at most.
const SETTLES: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(2));
/// Bytes of JSON that a message may become; a longer one is compared as a whole.
const LONGEST: usize = 4 << 20;
/// Differences of interfaces that are named.
const NAMED: usize = 8;

/// A comparison.
pub(super) struct Mirror<'a> {
    options: &'a ShadowOptions,
    tolerance: Tolerance,
    present: &'a Handle,
    candidate: &'a Measured,
    registry: Arc<Registry>,
    graph: watch::Receiver<Arc<Graph>>,
    tapping: Tapping,
    topics: Topics,
    exchanges: Exchanges,
    notes: Notes,
}

/// What could not be compared, and why.
#[derive(Default)]
pub(super) struct Notes(BTreeMap<(String, String), u64>);

impl Notes {
    pub(super) fn add(&mut self, what: &str, why: &str) {
        self.add_many(what, why, 1);
    }

    fn add_many(&mut self, what: &str, why: &str, count: u64) {
        *self.0.entry((what.to_owned(), why.to_owned())).or_default() += count;
    }

    fn shown(self) -> Vec<NotCompared> {
        let notes = self.0.into_iter();
        notes
            .map(|((what, why), count)| NotCompared { what, why, count })
            .collect()
    }
}

/// How a comparison ends.
enum End {
    /// What is on its way is waited for.
    Soon(String),
    /// The candidate is there no longer; whether its nodes failed.
    Now(String, bool),
}

impl<'a> Mirror<'a> {
    pub(super) async fn open(
        choreographer: &Choreographer,
        present: &'a Handle,
        (candidate, reach): (&'a Measured, &dyn Reach),
        options: &'a ShadowOptions,
        budget: &Budget,
    ) -> Result<Mirror<'a>, Error> {
        let gone = || {
            Error::Shadow(format!(
                "robot {} has left while the candidate was started",
                present.robot
            ))
        };
        let there = present.reach().ok_or_else(gone)?;
        let tap = there.tap().ok_or_else(gone)?;
        let tapping = tap.listen(budget).ok_or_else(|| {
            Error::Shadow(format!(
                "servant {} of robot {} is compared with a candidate already; wait for that to end",
                present.id, present.robot
            ))
        })?;
        let revision = &present.revision;
        let opener = &choreographer.inner.opener;
        // A robot that shares its servants has none of its own, and no topics. It connects to no host outside.
        let look = match present.container() {
            Some(container) => Some(
                opener
                    .look(&container, revision.flavour.ros.bus(), topics::NODE, &[])
                    .await?,
            ),
            None => None,
        };
        let definitions = &revision.interface.definitions;
        let ros = revision.flavour.ros.bus();
        let registry = Registry::of_definitions(ros, definitions).map_err(|error| {
            Error::Shadow(format!("a definition of {}: {error}", revision.service))
        })?;
        let registry = Arc::new(registry);
        let (from, to) = (there.bus(), reach.bus());
        let mut notes = Notes::default();
        let robot = (from.node(), present.is_linked());
        let topics = Topics::new(look, Arc::clone(&to), robot, &registry, budget);
        note_interfaces(present, candidate.lease.handle(), &mut notes);
        let graph = from.graph();
        let mut mirror = Mirror {
            options,
            tolerance: Tolerance {
                number: options.tolerance,
                ignore: options.ignore.clone(),
            },
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

    /// Follows what there is, and begins once publishers are likely to know of it: a publisher of ROS 1 counts a subscriber some time
    /// after it has answered it, and tells nobody. That takes it about as long as it took to answer.
    async fn settle_in(&mut self) {
        let began = Instant::now();
        self.follow().await;
        tokio::time::sleep((began.elapsed() * 2).clamp(SETTLES.0, SETTLES.1)).await;
        // What these made nodes publish may not have been heard.
        while self.tapping.told.try_recv().is_ok() {}
    }

    async fn follow(&mut self) {
        let graph = self.graph.borrow_and_update().clone();
        self.topics.follow(&graph, &mut self.notes).await;
    }

    /// Compares until it is over.
    pub(super) async fn run(mut self) -> Shadow {
        let began = Instant::now();
        let ends = began + Duration::from_secs_f64(self.options.seconds);
        let mut present = self.present.watch();
        let (reason, failed) = loop {
            if self.has_enough() {
                break (format!("{} requests were given", self.given()), None);
            }
            let end = tokio::select! {
                told = self.tapping.told.recv() => self.told(told, false).await,
                Some(heard) = self.topics.heard.recv() => {
                    // Calls are told before they are carried out: what is heard of them comes after them here, too.
                    let end = self.catch_up().await;
                    let enough = self.has_enough();
                    self.heard(heard, enough).await;
                    end
                }
                Some(answer) = self.exchanges.answers.join_next() => { self.candidate_answers(answer); None }
                Ok(()) = self.graph.changed() => { self.follow().await; None }
                () = left(&mut present) => Some(End::Soon("the robot's servant has ended".to_owned())),
                () = over(self.candidate) => Some(candidates_end(self.candidate)),
                () = tokio::time::sleep_until(ends) => Some(End::Soon("its time is over".to_owned())),
            };
            match end {
                None => {}
                Some(End::Soon(reason)) => break (reason, None),
                Some(End::Now(reason, failed)) => break (reason.clone(), failed.then_some(reason)),
            }
        };
        let seconds = began.elapsed().as_secs_f64();
        let (ended, failed) = match (failed, self.candidate.lease.handle().life().is_over()) {
            (None, false) => self.settle(reason).await,
            (failed, _) => (reason, failed),
        };
        // One that was ended has given no answer to what was on its way.
        let cut = failed.is_none() && self.candidate.lease.handle().life().is_over();
        self.found(seconds, ended, failed, cut)
    }

    /// Takes up the calls and goals that were told until now.
    async fn catch_up(&mut self) -> Option<End> {
        while !self.has_enough() {
            let Ok(told) = self.tapping.told.try_recv() else {
                break;
            };
            let end = self.told(Some(told), false).await;
            if end.is_some() {
                return end;
            }
        }
        None
    }

    /// Waits for what is on its way, and takes up nothing new.
    async fn settle(&mut self, reason: String) -> (String, Option<String>) {
        let ends = Instant::now() + GRACE;
        // What the robot's servant does from its next request on has no counterpart.
        let mut over_there = false;
        loop {
            let even = self.exchanges.is_even() && self.topics.is_even();
            let end = tokio::select! {
                told = self.tapping.told.recv() => {
                    over_there |= told.as_ref().is_none_or(|told| !matches!(told.what, What::Answered { .. }));
                    self.told(told, true).await;
                    None
                }
                Some(heard) = self.topics.heard.recv() => {
                    over_there |= self.topics.is_request(&heard);
                    if !(over_there && Topics::is_present(&heard)) {
                        self.heard(heard, true).await;
                    }
                    None
                }
                Some(answer) = self.exchanges.answers.join_next() => { self.candidate_answers(answer); None }
                () = over(self.candidate) => Some(candidates_end(self.candidate)),
                () = tokio::time::sleep(QUIET), if even => break,
                () = tokio::time::sleep_until(ends) => break,
            };
            if let Some(End::Now(reason, failed)) = end {
                return (reason.clone(), failed.then_some(reason));
            }
        }
        (reason, None)
    }

    fn given(&self) -> u64 {
        self.topics.given + self.exchanges.given
    }

    fn has_enough(&self) -> bool {
        self.options
            .requests
            .is_some_and(|enough| self.given() >= enough)
    }

    async fn told(&mut self, told: Option<Tapped>, ending: bool) -> Option<End> {
        let Some(Tapped { number, at, what }) = told else {
            return Some(End::Soon("the robot's servant has ended".to_owned()));
        };
        match what {
            What::Answered { answer, took } => {
                self.answered(Side::Present, (number, answer, millis(took)));
            }
            What::Cancel => self.exchanges.cancel(number),
            What::Call { .. } | What::Goal { .. } if ending => {}
            // Heard by their topics.
            What::Goal { .. } if self.present.is_linked() => {}
            asked => {
                self.topics.asked(at);
                let (registry, notes) = (&self.registry, &mut self.notes);
                self.exchanges.ask(number, asked, registry, notes).await;
            }
        }
        None
    }

    async fn heard(&mut self, heard: Heard, ending: bool) {
        match self.topics.is_request(&heard) {
            true if ending => {}
            true => self.topics.give(heard, &mut self.notes).await,
            false => self
                .topics
                .answered(heard, &self.tolerance, &mut self.notes),
        }
    }

    fn candidate_answers(&mut self, answer: Result<(u64, Answer, f64), tokio::task::JoinError>) {
        if let Ok(answer) = answer {
            self.answered(Side::Candidate, answer);
        }
    }

    fn answered(&mut self, side: Side, answer: (u64, Answer, f64)) {
        let (tolerance, notes) = (&self.tolerance, &mut self.notes);
        self.exchanges.answered(side, answer, tolerance, notes);
    }

    fn found(mut self, seconds: f64, ended: String, failed: Option<String>, cut: bool) -> Shadow {
        let given = self.given();
        self.exchanges.end(cut, &mut self.notes);
        self.topics.end(cut, &self.tolerance, &mut self.notes);
        let left_out = self.tapping.left_out();
        if left_out > 0 {
            let why = "more came at once than may be held";
            self.notes.add_many("calls and goals", why, left_out);
        }
        let tallies = self
            .topics
            .into_tallies()
            .chain(self.exchanges.into_tallies());
        let compared: Vec<_> = tallies.map(Tally::shown).collect();
        let (verdict, why) = verdict(&compared, failed.as_deref(), self.options.bound);
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
            not_compared: self.notes.shown(),
        }
    }
}

async fn left(present: &mut watch::Receiver<Life>) {
    let _ = present.wait_for(Life::is_over).await;
}

async fn over(candidate: &Measured) {
    candidate.lease.over().await;
}

fn candidates_end(candidate: &Measured) -> End {
    let life = candidate.lease.handle().life();
    let reason = life.reason().unwrap_or_default();
    match life.failure {
        Some(Failure::Broken { .. }) => End::Now(reason, true),
        _ => End::Now(format!("the candidate was ended: {reason}"), false),
    }
}

/// Of what was on its way when the candidate was ended.
pub(super) const CUT: &str = "the candidate was ended before it answered";

/// What is known beforehand to have no counterpart.
fn note_interfaces(present: &Handle, candidate: &Handle, notes: &mut Notes) {
    let (one, other) = (&present.revision, &candidate.revision);
    let difference = Difference::between(&one.interface, &other.interface);
    let breaking = difference.changes.iter().filter(|it| !it.compatible);
    for change in breaking.take(NAMED) {
        let why = format!(
            "the interfaces of revisions {} and {} differ",
            one.number, other.number
        );
        notes.add_many(&change.to_string(), &why, 0);
    }
    if one.plan.stateful || other.plan.stateful {
        let why = "the candidate began without what the robot's servant had been given before";
        notes.add_many("what the nodes keep", why, 0);
    }
}

pub(super) fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// A message as JSON; none where it cannot be read or is too long.
pub(super) type Read = Option<Value>;

pub(super) fn read(of: Option<&MessageType>, message: &[u8]) -> Read {
    let options = JsonOptions {
        non_finite: NonFinite::String,
        max_bytes: LONGEST,
        ..JsonOptions::default()
    };
    let mut json = Vec::new();
    to_json(of?, message, &mut json, &options).ok()?;
    serde_json::from_slice(&json).ok()
}

/// In what two messages differ; those that cannot be read differ as a whole.
pub(super) fn differing(
    read: Option<(&Value, &Value)>,
    (one, other): (&Bytes, &Bytes),
    tolerance: &Tolerance,
) -> Vec<Differing> {
    match read {
        _ if one == other => Vec::new(),
        Some((one, other)) => differences(one, other, tolerance),
        None => {
            let bytes = |of: &Bytes| format!("{} bytes", of.len());
            vec![Differing::whole(bytes(one), bytes(other))]
        }
    }
}

pub(super) fn compare(
    of: Option<&MessageType>,
    one: &Bytes,
    other: &Bytes,
    tolerance: &Tolerance,
) -> Vec<Differing> {
    if one == other {
        return Vec::new();
    }
    let (read_one, read_other) = (read(of, one), read(of, other));
    let values = read_one.as_ref().zip(read_other.as_ref());
    differing(values, (one, other), tolerance)
}
