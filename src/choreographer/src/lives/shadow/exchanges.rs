//! Calls and goals of the robot that the candidate carries out as well, and their answers.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use api::shadow::Kind;
use bytes::Bytes;
use parking_lot::Mutex;
use reach::tap::{TapAnswer, TapEventKind};
use ros::bus::{ActionClient, Bus, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome};
use ros::schema::{ActionDef, MessageType, Registry, ServiceDef};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::mirror::{CUT, ComparisonNotes, compare, millis};
use crate::decide::shadow::{DifferingField, ShadowSide, Tally, Tolerance};

/// Timeout for a call of the candidate, and for its action servers to appear.
const CALL: Duration = Duration::from_secs(60);
const ACTION: Duration = Duration::from_secs(10);
/// Timeout for looking up a service's type.
const TYPE: Duration = Duration::from_secs(5);
/// Maximum number of calls and goals by which the candidate may be behind; more are left out.
const MAX_BACKLOG: usize = 64;

/// Calls and goals, in progress and answered.
pub(super) struct Exchanges {
    /// The bus on which the robot asks; used for the types of its services.
    from: Arc<dyn Bus>,
    to: Arc<dyn Bus>,
    under_way: HashMap<u64, Exchange>,
    /// The candidate's answers.
    pub(super) answers: JoinSet<(u64, TapAnswer, f64)>,
    /// Answers that the robot had received before its next request; the candidate is sent that request once it has
    /// answered those, too.
    before: Vec<CancellationToken>,
    services: HashMap<String, AnswerType>,
    clients: HashMap<String, Arc<dyn ActionClient>>,
    tallies: BTreeMap<(Kind, String), Tally>,
    pub(super) given: u64,
}

struct Exchange {
    kind: Kind,
    name: String,
    of: AnswerType,
    present: Option<(TapAnswer, f64)>,
    candidate: Option<(TapAnswer, f64)>,
    /// Cancelled once the candidate has answered.
    done: CancellationToken,
    goal: Option<(Arc<dyn ActionClient>, String)>,
}

/// Type by which an answer is decoded.
#[derive(Clone)]
enum AnswerType {
    Service(Arc<ServiceDef>),
    Action(Arc<ActionDef>),
    Unknown,
}

impl AnswerType {
    fn answer(&self) -> Option<&MessageType> {
        match self {
            AnswerType::Service(of) => Some(&of.response),
            AnswerType::Action(of) => Some(&of.result),
            AnswerType::Unknown => None,
        }
    }
}

impl Exchanges {
    pub(super) fn new(from: Arc<dyn Bus>, to: Arc<dyn Bus>) -> Exchanges {
        Exchanges {
            from,
            to,
            under_way: HashMap::new(),
            answers: JoinSet::new(),
            before: Vec::new(),
            services: HashMap::new(),
            clients: HashMap::new(),
            tallies: BTreeMap::new(),
            given: 0,
        }
    }

    /// Returns true if nothing is in progress.
    pub(super) fn is_even(&self) -> bool {
        self.under_way.is_empty()
    }

    /// Handles a request of the robot: sends it to the candidate, too.
    pub(super) async fn ask(
        &mut self,
        number: u64,
        what: TapEventKind,
        registry: &Registry,
        notes: &mut ComparisonNotes,
    ) {
        if self.answers.len() >= MAX_BACKLOG {
            let why = format!("the candidate had {MAX_BACKLOG} unanswered calls and goals");
            return notes.add(name_of(&what), &why);
        }
        let done = CancellationToken::new();
        let before = self.before.clone();
        let exchange = match what {
            TapEventKind::Call { service, request } => {
                let (of, digest) = self.resolve_service(&service, registry).await;
                let (to, name) = (Arc::clone(&self.to), service.clone());
                let over = done.clone();
                self.answers.spawn(async move {
                    wait_all(before).await;
                    let asked = Instant::now();
                    let response = match digest {
                        Some(digest) => to.call_typed(&name, &digest, request, CALL).await,
                        None => to.call(&name, request, CALL).await,
                    };
                    over.cancel();
                    (number, TapAnswer::from_call(&response), millis(asked.elapsed()))
                });
                Exchange { kind: Kind::Service, name: service, of, present: None, candidate: None, done, goal: None }
            }
            TapEventKind::Goal { action, of, goal } => {
                let client = match self.action_client(&action, &of) {
                    Ok(client) => client,
                    Err(error) => return notes.add(&action, &error.to_string()),
                };
                let id = format!("cloudroid-shadow-{number}");
                let sent = (Arc::clone(&client), id.clone());
                let over = done.clone();
                self.answers.spawn(async move {
                    wait_all(before).await;
                    let (answer, took) = run_goal(&*client, &id, goal).await;
                    over.cancel();
                    (number, answer, took)
                });
                Exchange {
                    kind: Kind::Action,
                    name: action,
                    of: AnswerType::Action(of),
                    present: None,
                    candidate: None,
                    done,
                    goal: Some(sent),
                }
            }
            TapEventKind::Cancel | TapEventKind::Answered { .. } => return,
        };
        self.given += 1;
        self.under_way.insert(number, exchange);
    }

    /// Cancels a goal at the candidate.
    pub(super) fn cancel(&self, number: u64) {
        let exchange = self.under_way.get(&number);
        if let Some((client, id)) = exchange.and_then(|exchange| exchange.goal.as_ref()) {
            client.cancel_goal(id);
        }
    }

    /// Records an answer to the robot or to the candidate.
    pub(super) fn record_answer(
        &mut self,
        side: ShadowSide,
        (number, answer, took): (u64, TapAnswer, f64),
        tolerance: &Tolerance,
        notes: &mut ComparisonNotes,
    ) {
        let Some(exchange) = self.under_way.get_mut(&number) else {
            return;
        };
        match side {
            ShadowSide::Present => {
                exchange.present = Some((answer, took));
                self.before.push(exchange.done.clone());
            }
            ShadowSide::Candidate => exchange.candidate = Some((answer, took)),
        }
        self.before.retain(|done| !done.is_cancelled());
        if exchange.present.is_none() || exchange.candidate.is_none() {
            return;
        }
        let Some(Exchange {
            kind,
            name,
            of,
            present: Some((present, took)),
            candidate: Some((candidate, took_there)),
            ..
        }) = self.under_way.remove(&number)
        else {
            return;
        };
        if present == TapAnswer::GivenUp {
            return notes.add(&name, "the robot did not wait for the answer");
        }
        let tally = self.tallies.entry((kind, name.clone()));
        let tally = tally.or_insert_with(|| Tally::new(kind, &name));
        tally.record_time(ShadowSide::Present, took);
        tally.record_time(ShadowSide::Candidate, took_there);
        tally.record_pair(answer_differences(&present, &candidate, of.answer(), tolerance));
    }

    /// Ends the comparison: open requests have no answer of the candidate.
    pub(super) fn end(&mut self, cut: bool, notes: &mut ComparisonNotes) {
        for exchange in std::mem::take(&mut self.under_way).into_values() {
            let name = exchange.name;
            match exchange.present {
                None => notes.add(&name, "the robot had no answer yet when the comparison ended"),
                Some((TapAnswer::GivenUp, _)) => {
                    notes.add(&name, "the robot did not wait for the answer");
                }
                Some(_) if cut => notes.add(&name, CUT),
                Some(_) => {
                    let tally = self.tallies.entry((exchange.kind, name.clone()));
                    tally.or_insert_with(|| Tally::new(exchange.kind, &name)).record_missing();
                }
            }
        }
    }

    pub(super) fn into_tallies(self) -> impl Iterator<Item = Tally> {
        self.tallies.into_values()
    }

    /// Returns the type of a service's answers, and the digest with which its requests were serialized.
    async fn resolve_service(&mut self, service: &str, registry: &Registry) -> (AnswerType, Option<ros::bus::Digest>) {
        let asked = tokio::time::timeout(TYPE, self.from.service_type(service)).await;
        let Ok(Ok(known)) = asked else {
            return (AnswerType::Unknown, None);
        };
        let of = self.services.entry(service.to_owned()).or_insert_with(|| {
            let of = registry.service(&known.name).ok();
            let of = of.filter(|of| known.digest.is_compatible_with(&ros::bus::Digest::from(&of.md5)));
            of.map_or(AnswerType::Unknown, AnswerType::Service)
        });
        (of.clone(), Some(known.digest))
    }

    fn action_client(&mut self, action: &str, of: &Arc<ActionDef>) -> Result<Arc<dyn ActionClient>, BusError> {
        if let Some(known) = self.clients.get(action) {
            return Ok(Arc::clone(known));
        }
        let client: Arc<dyn ActionClient> = self.to.action_client(action, of)?.into();
        self.clients.insert(action.to_owned(), Arc::clone(&client));
        Ok(client)
    }
}

fn name_of(what: &TapEventKind) -> &str {
    match what {
        TapEventKind::Call { service, .. } => service,
        TapEventKind::Goal { action, .. } => action,
        TapEventKind::Cancel | TapEventKind::Answered { .. } => "",
    }
}

async fn wait_all(before: Vec<CancellationToken>) {
    for done in before {
        done.cancelled().await;
    }
}

/// Sends a goal to the candidate and waits for its end.
async fn run_goal(client: &dyn ActionClient, id: &str, goal: Bytes) -> (TapAnswer, f64) {
    if let Err(error) = client.wait_for_server(ACTION).await {
        return (TapAnswer::Refused(error.to_string()), 0.0);
    }
    let (sender, ended) = oneshot::channel();
    let asked = Instant::now();
    client.send_goal(id, goal, Arc::new(GoalEndSender(Mutex::new(Some(sender)))));
    let answer = match ended.await {
        Ok(end) => TapAnswer::from_goal(&end),
        Err(_) => TapAnswer::Refused("its outcome is unknown".to_owned()),
    };
    (answer, millis(asked.elapsed()))
}

/// Reports how a goal of the candidate ends.
struct GoalEndSender(Mutex<Option<oneshot::Sender<Result<GoalEnd, GoalError>>>>);

impl GoalEvents for GoalEndSender {
    fn on_feedback(&self, _feedback: Bytes) {}

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        if let Some(sender) = self.0.lock().take() {
            let _ = sender.send(end);
        }
    }
}

/// Returns the differences of two answers. Texts of refusals are not compared: they may contain times and addresses.
fn answer_differences(
    present: &TapAnswer,
    candidate: &TapAnswer,
    of: Option<&MessageType>,
    tolerance: &Tolerance,
) -> Vec<DifferingField> {
    match (present, candidate) {
        (TapAnswer::Given(one, _), TapAnswer::Given(other, _)) if one != other => {
            vec![DifferingField::whole_answer(outcome_in_words(*one), outcome_in_words(*other))]
        }
        (TapAnswer::Given(_, one), TapAnswer::Given(_, other)) => compare(of, one, other, tolerance),
        (TapAnswer::Refused(_), TapAnswer::Refused(_)) => Vec::new(),
        (one, other) => vec![DifferingField::whole_answer(answer_in_words(one), answer_in_words(other))],
    }
}

fn outcome_in_words(outcome: Option<GoalOutcome>) -> String {
    outcome.map_or_else(|| "answered".to_owned(), |outcome| format!("{outcome:?}").to_lowercase())
}

fn answer_in_words(answer: &TapAnswer) -> String {
    match answer {
        TapAnswer::Given(of, _) => outcome_in_words(*of),
        TapAnswer::Refused(reason) => format!("failed: {reason}"),
        TapAnswer::GivenUp => "not answered".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_the_same_and_a_refusal_is_no_answer() {
        let tolerance = Tolerance { number: 0.0, ignore: Vec::new() };
        let given = |outcome, bytes: &'static [u8]| TapAnswer::Given(outcome, bytes.into());
        let refused = |why: &str| TapAnswer::Refused(why.into());
        for (present, candidate, words) in [
            (given(None, b"a"), given(None, b"a"), None),
            (refused("one"), refused("other"), None),
            (given(None, b"a"), refused("no"), Some(("answered", "failed: no"))),
            (
                given(Some(GoalOutcome::Succeeded), b""),
                given(Some(GoalOutcome::Aborted), b""),
                Some(("succeeded", "aborted")),
            ),
            (given(None, b"a"), given(None, b"bc"), Some(("1 bytes", "2 bytes"))),
        ] {
            let found = answer_differences(&present, &candidate, None, &tolerance);
            let said = found.first();
            let said = said.map(|one| (one.present.as_str(), one.candidate.as_str()));
            assert_eq!(said, words, "{present:?} {candidate:?}");
        }
    }
}
