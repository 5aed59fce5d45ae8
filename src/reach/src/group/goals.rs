//! Goals of one robot at a group.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use parking_lot::Mutex;
use ros::bus::{ActionClient, BusError, GoalEnd, GoalEvents, Outcome};
use ros::codec::default_message;
use ros::schema::ActionDef;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use super::dispatch::{End, Kind, Lost, Robot};
use super::{Errand, Group, Servant, Told, lost_in_words};

/// For an action server of a servant that has its interface.
const CONNECTS: Duration = Duration::from_secs(10);
/// Goals of one action of one robot that have not ended; more are rejected.
const MOST: usize = 256;
/// How long a node may take to end a goal whose robot has gone. Then its servant carries out other robots' goals.
const GONE: Duration = Duration::from_secs(10);

/// Hears of a goal what only a group can tell.
pub(super) trait GroupEvents: GoalEvents {
    /// No servant has it, and the group keeps it until one is free.
    fn waits(&self) {}
}

/// Who hears of a goal as of any server's.
struct OfAny(Arc<dyn GoalEvents>);

impl GoalEvents for OfAny {
    fn accepted(&self) {
        self.0.accepted();
    }

    fn cancel_answered(&self, ends: bool) {
        self.0.cancel_answered(ends);
    }

    fn feedback(&self, feedback: Bytes) {
        self.0.feedback(feedback);
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        self.0.ended(end);
    }
}

impl GroupEvents for OfAny {}

/// One action, as a robot's.
pub(super) struct GroupClient {
    group: Arc<Group>,
    robot: Robot,
    name: Arc<str>,
    of: Arc<ActionDef>,
    /// Those that have not ended, with how often each was to be cancelled.
    goals: Arc<Mutex<HashMap<String, watch::Sender<u32>>>>,
    gone: CancellationToken,
}

impl GroupClient {
    pub(super) fn new(
        group: &Arc<Group>,
        robot: Robot,
        name: &str,
        of: &Arc<ActionDef>,
    ) -> GroupClient {
        GroupClient {
            group: Arc::clone(group),
            robot,
            name: name.into(),
            of: Arc::clone(of),
            goals: Arc::default(),
            gone: CancellationToken::new(),
        }
    }

    /// As [`ActionClient::send`], for who wants to hear more.
    pub(super) fn sends(&self, id: &str, goal: Bytes, events: Arc<dyn GroupEvents>) {
        let (wishes, wished) = watch::channel(0);
        {
            let mut goals = self.goals.lock();
            let refused = match goals.len() {
                _ if goals.contains_key(id) => Some(format!("another goal has the id {id:?}")),
                MOST.. => Some(format!(
                    "{MOST} goals of this robot have not ended; wait for one of them"
                )),
                _ => None,
            };
            if let Some(text) = refused {
                let end = GoalEnd {
                    outcome: Outcome::Rejected,
                    text,
                    result: default_message(&self.of.result).into(),
                };
                // Not at once: whoever sends may hold what hears of it.
                tokio::spawn(async move { events.ended(Ok(end)) });
                return;
            }
            goals.insert(id.to_owned(), wishes);
        }
        let errand = self
            .group
            .begin(self.robot, Kind::Goal(Arc::clone(&self.name)));
        let goal = Goal {
            // Robots, and nodes of one robot, do not know each other's ids.
            id: format!("{}-{id}", errand.ticket),
            body: goal,
            name: Arc::clone(&self.name),
            of: Arc::clone(&self.of),
            gone: self.gone.clone(),
        };
        let (goals, id) = (Arc::clone(&self.goals), id.to_owned());
        tokio::spawn(async move {
            let end = goal.follow(errand, wished, &*events).await;
            goals.lock().remove(&id);
            events.ended(end);
        });
    }

    /// Nobody waits for the goals any more: they are cancelled, and not followed for long.
    pub(super) fn leave(&self) {
        self.gone.cancel();
    }
}

#[async_trait]
impl ActionClient for GroupClient {
    async fn ready(&self, patience: Duration) -> Result<(), BusError> {
        let mut members = self.group.members.subscribe();
        let any = async {
            loop {
                let now = members.borrow_and_update().clone();
                // One that is going says no; others may still answer.
                let clients = now
                    .values()
                    .filter_map(|servant| servant.action(&self.name, &self.of).ok());
                let clients: Vec<_> = clients.collect();
                let opened = clients.iter().map(|client| client.ready(patience));
                let mut opened: FuturesUnordered<_> = opened.collect();
                tokio::select! {
                    Some(ready) = opened.next() => return ready,
                    changed = members.changed() => if changed.is_err() { return Err(BusError::Closed) },
                }
            }
        };
        timeout(patience, any).await.unwrap_or_else(|_| {
            Err(BusError::Timeout {
                what: format!("action {}", self.name),
                after: patience,
            })
        })
    }

    fn send(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        self.sends(id, goal, Arc::new(OfAny(events)));
    }

    fn cancel(&self, id: &str) {
        if let Some(wishes) = self.goals.lock().get(id) {
            wishes.send_modify(|wishes| *wishes += 1);
        }
    }
}

impl Drop for GroupClient {
    fn drop(&mut self) {
        self.leave();
    }
}

struct Goal {
    id: String,
    body: Bytes,
    name: Arc<str>,
    of: Arc<ActionDef>,
    /// Its robot has gone.
    gone: CancellationToken,
}

/// What a servant says of a goal.
enum Said {
    Accepted,
    CancelAnswered(bool),
    Feedback(Bytes),
    Ended(Result<GoalEnd, String>),
}

struct Ear {
    servant: Arc<Servant>,
    said: mpsc::UnboundedSender<(Arc<Servant>, Said)>,
}

impl Ear {
    fn tell(&self, said: Said) {
        let _ = self.said.send((Arc::clone(&self.servant), said));
    }
}

impl GoalEvents for Ear {
    fn accepted(&self) {
        self.tell(Said::Accepted);
    }

    fn cancel_answered(&self, ends: bool) {
        self.tell(Said::CancelAnswered(ends));
    }

    fn feedback(&self, feedback: Bytes) {
        self.tell(Said::Feedback(feedback));
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        self.tell(Said::Ended(end));
    }
}

/// An attempt to send the goal to a servant.
type Sending = BoxFuture<'static, (Arc<Servant>, Result<Arc<dyn ActionClient>, BusError>)>;

impl Goal {
    /// From asked for to its end.
    async fn follow(
        &self,
        mut errand: Errand,
        mut wished: watch::Receiver<u32>,
        events: &dyn GroupEvents,
    ) -> Result<GoalEnd, String> {
        let (group, began) = (Arc::clone(&errand.group), Instant::now());
        let (sender, mut said) = mpsc::unbounded_channel::<(Arc<Servant>, Said)>();
        let mut sending: FuturesUnordered<Sending> = FuturesUnordered::new();
        let mut at: Option<(Arc<Servant>, Arc<dyn ActionClient>)> = None;
        let mut last: Option<Arc<Servant>> = None;
        let (mut told_to_end, mut waits) = (false, false);
        let given_up = async {
            self.gone.cancelled().await;
            tokio::time::sleep(GONE).await;
        };
        let mut given_up = std::pin::pin!(given_up);
        loop {
            let idle = at.is_none() && sending.is_empty();
            let end_wanted = async {
                tokio::select! {
                    () = self.gone.cancelled(), if !told_to_end => {}
                    Ok(()) = wished.changed() => {}
                    else => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                Some((servant, what)) = said.recv() => {
                    let here = at.as_ref().is_some_and(|(now, _)| now.member == servant.member);
                    match what {
                        _ if !here => {}
                        Said::Accepted => events.accepted(),
                        Said::CancelAnswered(ends) => events.cancel_answered(ends),
                        Said::Feedback(feedback) => events.feedback(feedback),
                        Said::Ended(Ok(end)) => {
                            errand.ended(&servant, End::Answered);
                            group.counts.answered(began.elapsed());
                            return Ok(end);
                        }
                        Said::Ended(Err(reason)) => {
                            tracing::debug!("servant {} lost a goal: {reason}", servant.id);
                            at = None;
                            errand.ended(&servant, End::Lost);
                            last = Some(servant);
                        }
                    }
                }
                Some((servant, ready)) = sending.next(), if !sending.is_empty() => {
                    match ready {
                        Ok(client) => {
                            let ear = Ear { servant: Arc::clone(&servant), said: sender.clone() };
                            client.send(&self.id, self.body.clone(), Arc::new(ear));
                            at = Some((servant, client));
                        }
                        Err(error) => {
                            tracing::debug!("servant {} takes no goal: {error}", servant.id);
                            if matches!(error, BusError::CallFailed { .. }) {
                                servant.forget_action(&self.name);
                            }
                            errand.ended(&servant, End::NotTaken);
                        }
                    }
                }
                Some(told) = errand.told.recv() => match told {
                    Told::Ask(_) if told_to_end => return Ok(self.recalled()),
                    Told::Ask(servant) => {
                        if last.is_some() {
                            group.counts.asked_again.fetch_add(1, Ordering::Relaxed);
                        }
                        let (name, of) = (Arc::clone(&self.name), Arc::clone(&self.of));
                        sending.push(Box::pin(async move {
                            let ready = async {
                                let client = servant.action(&name, &of)?;
                                client.ready(CONNECTS).await?;
                                Ok(client)
                            };
                            let ready = ready.await;
                            (servant, ready)
                        }));
                    }
                    Told::Drop(servant) => {
                        last = Some(servant);
                        sending.clear();
                        at = None;
                    }
                    Told::Fail(why) => {
                        errand.over = true;
                        return Err(self.failed(&group, last.as_deref(), why));
                    }
                },
                () = &mut given_up => {
                    let at = at.as_ref().map_or("no servant", |(servant, _)| servant.id.as_str());
                    let words = format!(
                        "its robot has gone, and {at} does not end it after {GONE:?}: other robots' goals go there, too"
                    );
                    tracing::warn!("goal {} of {}: {words}", self.id, self.name);
                    return Err(words);
                }
                () = end_wanted => {
                    told_to_end = true;
                    match &at {
                        Some((_, client)) => client.cancel(&self.id),
                        None => return Ok(self.recalled()),
                    }
                }
                // Nothing else is to be done now.
                () = std::future::ready(()), if idle && !waits => {
                    waits = true;
                    events.waits();
                }
            }
        }
    }

    fn failed(&self, group: &Group, last: Option<&Servant>, why: Lost) -> String {
        group.counts.failed.fetch_add(1, Ordering::Relaxed);
        lost_in_words(last, why)
    }

    /// The end of a goal that no servant has had.
    fn recalled(&self) -> GoalEnd {
        GoalEnd {
            outcome: Outcome::Canceled,
            text: "it was cancelled before a servant had begun with it".to_owned(),
            result: default_message(&self.of.result).into(),
        }
    }
}
