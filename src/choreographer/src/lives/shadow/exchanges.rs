//! Calls and goals of the robot, carried out by the candidate, too, and what was answered to them.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use api::shadow::Kind;
use bytes::Bytes;
use parking_lot::Mutex;
use reach::tap::{Answer, What};
use ros::bus::{ActionClient, Bus, GoalEnd, GoalEvents, Outcome};
use ros::schema::{ActionDef, MessageType, Registry, ServiceDef};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::mirror::{CUT, Notes, compare, millis};
use crate::decide::shadow::{Differing, Side, Tally, Tolerance};

/// How long a call of the candidate may take, and its action servers may take to be there.
const CALL: Duration = Duration::from_secs(60);
const ACTION: Duration = Duration::from_secs(10);
/// For the type of a service.
const TYPE: Duration = Duration::from_secs(5);
/// The candidate may be behind by so many; more are left out.
const BEHIND: usize = 64;

/// Calls and goals, those under way and those that were answered.
pub(super) struct Exchanges {
    /// Where the robot asks; for the types of its services.
    from: Arc<dyn Bus>,
    to: Arc<dyn Bus>,
    under_way: HashMap<u64, Exchange>,
    /// The candidate's answers.
    pub(super) answers: JoinSet<(u64, Answer, f64)>,
    /// Of what the robot had been answered before it asked on; a candidate is asked on once it has answered that, too.
    before: Vec<CancellationToken>,
    services: HashMap<String, Of>,
    clients: HashMap<String, Arc<dyn ActionClient>>,
    tallies: BTreeMap<(Kind, String), Tally>,
    pub(super) given: u64,
}

struct Exchange {
    kind: Kind,
    name: String,
    of: Of,
    present: Option<(Answer, f64)>,
    candidate: Option<(Answer, f64)>,
    /// The candidate has answered.
    done: CancellationToken,
    goal: Option<(Arc<dyn ActionClient>, String)>,
}

/// What an answer is read by.
#[derive(Clone)]
enum Of {
    Service(Arc<ServiceDef>),
    Action(Arc<ActionDef>),
    Unknown,
}

impl Of {
    fn answer(&self) -> Option<&MessageType> {
        match self {
            Of::Service(of) => Some(&of.response),
            Of::Action(of) => Some(&of.result),
            Of::Unknown => None,
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

    /// Whether nothing is under way.
    pub(super) fn is_even(&self) -> bool {
        self.under_way.is_empty()
    }

    /// The robot asks something, in which the candidate follows it.
    pub(super) async fn ask(
        &mut self,
        number: u64,
        what: What,
        registry: &Registry,
        notes: &mut Notes,
    ) {
        if self.answers.len() >= BEHIND {
            let why = format!("the candidate was behind by {BEHIND} calls and goals");
            return notes.add(name_of(&what), &why);
        }
        let done = CancellationToken::new();
        let before = self.before.clone();
        let exchange = match what {
            What::Call { service, request } => {
                let (of, digest) = self.service(&service, registry).await;
                let (to, name) = (Arc::clone(&self.to), service.clone());
                let over = done.clone();
                self.answers.spawn(async move {
                    all(before).await;
                    let asked = Instant::now();
                    let response = match digest {
                        Some(digest) => to.call_typed(&name, &digest, request, CALL).await,
                        None => to.call(&name, request, CALL).await,
                    };
                    over.cancel();
                    (number, Answer::of_call(&response), millis(asked.elapsed()))
                });
                Exchange {
                    kind: Kind::Service,
                    name: service,
                    of,
                    present: None,
                    candidate: None,
                    done,
                    goal: None,
                }
            }
            What::Goal { action, of, goal } => {
                let client = match self.client(&action, &of) {
                    Ok(client) => client,
                    Err(why) => return notes.add(&action, &why),
                };
                let id = format!("cloudroid-shadow-{number}");
                let sent = (Arc::clone(&client), id.clone());
                let over = done.clone();
                self.answers.spawn(async move {
                    all(before).await;
                    let (answer, took) = carried_out(&*client, &id, goal).await;
                    over.cancel();
                    (number, answer, took)
                });
                Exchange {
                    kind: Kind::Action,
                    name: action,
                    of: Of::Action(of),
                    present: None,
                    candidate: None,
                    done,
                    goal: Some(sent),
                }
            }
            What::Cancel | What::Answered { .. } => return,
        };
        self.given += 1;
        self.under_way.insert(number, exchange);
    }

    /// The robot wants a goal to end.
    pub(super) fn cancel(&self, number: u64) {
        let exchange = self.under_way.get(&number);
        if let Some((client, id)) = exchange.and_then(|exchange| exchange.goal.as_ref()) {
            client.cancel(id);
        }
    }

    /// The robot, or the candidate, was answered.
    pub(super) fn answered(
        &mut self,
        side: Side,
        (number, answer, took): (u64, Answer, f64),
        tolerance: &Tolerance,
        notes: &mut Notes,
    ) {
        let Some(exchange) = self.under_way.get_mut(&number) else {
            return;
        };
        match side {
            Side::Present => {
                exchange.present = Some((answer, took));
                self.before.push(exchange.done.clone());
            }
            Side::Candidate => exchange.candidate = Some((answer, took)),
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
        if present == Answer::GivenUp {
            return notes.add(&name, "the robot did not wait for the answer");
        }
        let tally = self.tallies.entry((kind, name.clone()));
        let tally = tally.or_insert_with(|| Tally::of(kind, &name));
        tally.time(Side::Present, took);
        tally.time(Side::Candidate, took_there);
        tally.pair(differing(&present, &candidate, of.answer(), tolerance));
    }

    /// It is over: what has no answer of the candidate has none.
    pub(super) fn end(&mut self, cut: bool, notes: &mut Notes) {
        for exchange in std::mem::take(&mut self.under_way).into_values() {
            let name = exchange.name;
            match exchange.present {
                None => notes.add(&name, "the robot had no answer yet when it ended"),
                Some((Answer::GivenUp, _)) => {
                    notes.add(&name, "the robot did not wait for the answer");
                }
                Some(_) if cut => notes.add(&name, CUT),
                Some(_) => {
                    let tally = self.tallies.entry((exchange.kind, name.clone()));
                    tally
                        .or_insert_with(|| Tally::of(exchange.kind, &name))
                        .missing();
                }
            }
        }
    }

    pub(super) fn into_tallies(self) -> impl Iterator<Item = Tally> {
        self.tallies.into_values()
    }

    /// What the answers of a service are read by, and the digest that its requests were written by.
    async fn service(
        &mut self,
        service: &str,
        registry: &Registry,
    ) -> (Of, Option<ros::bus::Digest>) {
        let asked = tokio::time::timeout(TYPE, self.from.service_type(service)).await;
        let Ok(Ok(known)) = asked else {
            return (Of::Unknown, None);
        };
        let of = self.services.entry(service.to_owned()).or_insert_with(|| {
            let of = registry.service(&known.name).ok();
            let of = of.filter(|of| known.digest.agrees(&ros::bus::Digest::from(&of.md5)));
            of.map_or(Of::Unknown, Of::Service)
        });
        (of.clone(), Some(known.digest))
    }

    fn client(
        &mut self,
        action: &str,
        of: &Arc<ActionDef>,
    ) -> Result<Arc<dyn ActionClient>, String> {
        if let Some(known) = self.clients.get(action) {
            return Ok(Arc::clone(known));
        }
        let client = self.to.action_client(action, of);
        let client: Arc<dyn ActionClient> = client.map_err(|error| error.to_string())?.into();
        self.clients.insert(action.to_owned(), Arc::clone(&client));
        Ok(client)
    }
}

fn name_of(what: &What) -> &str {
    match what {
        What::Call { service, .. } => service,
        What::Goal { action, .. } => action,
        What::Cancel | What::Answered { .. } => "",
    }
}

async fn all(before: Vec<CancellationToken>) {
    for done in before {
        done.cancelled().await;
    }
}

/// Has the candidate carry out a goal, and waits for its end.
async fn carried_out(client: &dyn ActionClient, id: &str, goal: Bytes) -> (Answer, f64) {
    if let Err(error) = client.ready(ACTION).await {
        return (Answer::Refused(error.to_string()), 0.0);
    }
    let (sender, ended) = oneshot::channel();
    let asked = Instant::now();
    client.send(id, goal, Arc::new(Ending(Mutex::new(Some(sender)))));
    let end = ended
        .await
        .unwrap_or_else(|_| Err("nobody knows how it ended".to_owned()));
    (Answer::of_goal(&end), millis(asked.elapsed()))
}

/// Hears how a goal of the candidate ends.
struct Ending(Mutex<Option<oneshot::Sender<Result<GoalEnd, String>>>>);

impl GoalEvents for Ending {
    fn feedback(&self, _feedback: Bytes) {}

    fn ended(&self, end: Result<GoalEnd, String>) {
        if let Some(sender) = self.0.lock().take() {
            let _ = sender.send(end);
        }
    }
}

/// In what two answers differ. Words of refusals are not compared: they may name times and addresses.
fn differing(
    present: &Answer,
    candidate: &Answer,
    of: Option<&MessageType>,
    tolerance: &Tolerance,
) -> Vec<Differing> {
    match (present, candidate) {
        (Answer::Given(one, _), Answer::Given(other, _)) if one != other => {
            vec![Differing::whole(outcome(*one), outcome(*other))]
        }
        (Answer::Given(_, one), Answer::Given(_, other)) => compare(of, one, other, tolerance),
        (Answer::Refused(_), Answer::Refused(_)) => Vec::new(),
        (one, other) => vec![Differing::whole(in_words(one), in_words(other))],
    }
}

fn outcome(outcome: Option<Outcome>) -> String {
    outcome.map_or_else(
        || "answered".to_owned(),
        |outcome| format!("{outcome:?}").to_lowercase(),
    )
}

fn in_words(answer: &Answer) -> String {
    match answer {
        Answer::Given(of, _) => outcome(*of),
        Answer::Refused(reason) => format!("failed: {reason}"),
        Answer::GivenUp => "not answered".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_the_same_and_a_refusal_is_no_answer() {
        let tolerance = Tolerance {
            number: 0.0,
            ignore: Vec::new(),
        };
        let given = |outcome, bytes: &'static [u8]| Answer::Given(outcome, bytes.into());
        let refused = |why: &str| Answer::Refused(why.into());
        for (present, candidate, words) in [
            (given(None, b"a"), given(None, b"a"), None),
            (refused("one"), refused("other"), None),
            (
                given(None, b"a"),
                refused("no"),
                Some(("answered", "failed: no")),
            ),
            (
                given(Some(Outcome::Succeeded), b""),
                given(Some(Outcome::Aborted), b""),
                Some(("succeeded", "aborted")),
            ),
            (
                given(None, b"a"),
                given(None, b"bc"),
                Some(("1 bytes", "2 bytes")),
            ),
        ] {
            let found = differing(&present, &candidate, None, &tolerance);
            let said = found.first();
            let said = said.map(|one| (one.present.as_str(), one.candidate.as_str()));
            assert_eq!(said, words, "{present:?} {candidate:?}");
        }
    }
}
