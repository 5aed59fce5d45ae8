//! Goals of one robot in a group.

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
use ros::bus::{ActionClient, BusError, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome};
use ros::codec::default_message;
use ros::schema::ActionDef;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use super::dispatch::{AttemptOutcome, Kind, LossReason, RobotNumber};
use super::{DispatchEvent, MemberServant, PendingRequest, ServantGroup, describe_loss};

/// Timeout for connecting to the action server of a servant that has registered its interface.
const CONNECTS: Duration = Duration::from_secs(10);
/// Maximum number of pending goals per action and robot; more are rejected.
const MAX_GOALS: usize = 256;
/// Time a node may take to end a goal whose robot is gone. After that its servant gets goals of other robots.
const END_TIMEOUT: Duration = Duration::from_secs(10);

/// A client of one action for one robot.
pub(super) struct GroupClient {
    group: Arc<ServantGroup>,
    robot: RobotNumber,
    name: Arc<str>,
    of: Arc<ActionDef>,
    /// Pending goals, with the number of cancel requests for each.
    goals: Arc<Mutex<HashMap<String, watch::Sender<u32>>>>,
    gone: CancellationToken,
}

impl GroupClient {
    pub(super) fn new(group: &Arc<ServantGroup>, robot: RobotNumber, name: &str, of: &Arc<ActionDef>) -> GroupClient {
        GroupClient {
            group: Arc::clone(group),
            robot,
            name: name.into(),
            of: Arc::clone(of),
            goals: Arc::default(),
            gone: CancellationToken::new(),
        }
    }

    /// Cancels all goals because nobody waits for them any more; they are not followed for long.
    pub(super) fn abandon(&self) {
        self.gone.cancel();
    }
}

#[async_trait]
impl ActionClient for GroupClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        let mut members = self.group.members.subscribe();
        let any = async {
            loop {
                let now = members.borrow_and_update().clone();
                // A servant that is going away returns an error; others may still answer.
                let clients = now.values().filter_map(|servant| servant.action(&self.name, &self.of).ok());
                let clients: Vec<_> = clients.collect();
                let opened = clients.iter().map(|client| client.wait_for_server(patience));
                let mut opened: FuturesUnordered<_> = opened.collect();
                tokio::select! {
                    Some(ready) = opened.next() => return ready,
                    changed = members.changed() => if changed.is_err() { return Err(BusError::Closed) },
                }
            }
        };
        timeout(patience, any)
            .await
            .unwrap_or_else(|_| Err(BusError::Timeout { what: format!("action {}", self.name), after: patience }))
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let (wishes, wished) = watch::channel(0);
        {
            let mut goals = self.goals.lock();
            let refused = match goals.len() {
                _ if goals.contains_key(id) => Some(format!("another goal has the id {id:?}")),
                MAX_GOALS.. => Some(format!("{MAX_GOALS} goals of this robot have not ended; wait for one of them")),
                _ => None,
            };
            if let Some(text) = refused {
                let end =
                    GoalEnd { outcome: GoalOutcome::Rejected, text, result: default_message(&self.of.result).into() };
                // In a task, because the sender may hold a lock that the receiver needs.
                tokio::spawn(async move { events.on_ended(Ok(end)) });
                return;
            }
            goals.insert(id.to_owned(), wishes);
        }
        let errand = self.group.begin_request(self.robot, Kind::Goal(Arc::clone(&self.name)));
        let goal = GroupGoal {
            // Robots, and nodes of one robot, choose ids independently.
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
            events.on_ended(end);
        });
    }

    fn cancel_goal(&self, id: &str) {
        if let Some(wishes) = self.goals.lock().get(id) {
            wishes.send_modify(|wishes| *wishes += 1);
        }
    }
}

impl Drop for GroupClient {
    fn drop(&mut self) {
        self.abandon();
    }
}

struct GroupGoal {
    id: String,
    body: Bytes,
    name: Arc<str>,
    of: Arc<ActionDef>,
    /// Cancelled when the robot is gone.
    gone: CancellationToken,
}

/// An update of a servant about a goal.
enum GoalUpdate {
    Accepted,
    CancelAnswered(bool),
    Feedback(Bytes),
    Ended(Result<GoalEnd, GoalError>),
}

struct GoalUpdateSender {
    servant: Arc<MemberServant>,
    said: mpsc::UnboundedSender<(Arc<MemberServant>, GoalUpdate)>,
}

impl GoalUpdateSender {
    fn send_update(&self, said: GoalUpdate) {
        let _ = self.said.send((Arc::clone(&self.servant), said));
    }
}

impl GoalEvents for GoalUpdateSender {
    fn on_accepted(&self) {
        self.send_update(GoalUpdate::Accepted);
    }

    fn on_cancel_response(&self, ends: bool) {
        self.send_update(GoalUpdate::CancelAnswered(ends));
    }

    fn on_feedback(&self, feedback: Bytes) {
        self.send_update(GoalUpdate::Feedback(feedback));
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        self.send_update(GoalUpdate::Ended(end));
    }
}

/// An attempt to connect to a servant for the goal.
type SendAttempt = BoxFuture<'static, (Arc<MemberServant>, Result<Arc<dyn ActionClient>, BusError>)>;

impl GroupGoal {
    /// Follows the goal from its request to its end.
    async fn follow(
        &self,
        mut errand: PendingRequest,
        mut wished: watch::Receiver<u32>,
        events: &dyn GoalEvents,
    ) -> Result<GoalEnd, GoalError> {
        let (group, began) = (Arc::clone(&errand.group), Instant::now());
        let (sender, mut said) = mpsc::unbounded_channel::<(Arc<MemberServant>, GoalUpdate)>();
        let mut sending: FuturesUnordered<SendAttempt> = FuturesUnordered::new();
        let mut at: Option<(Arc<MemberServant>, Arc<dyn ActionClient>)> = None;
        let mut last: Option<Arc<MemberServant>> = None;
        let (mut told_to_end, mut waits) = (false, false);
        let given_up = async {
            self.gone.cancelled().await;
            tokio::time::sleep(END_TIMEOUT).await;
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
                        GoalUpdate::Accepted => events.on_accepted(),
                        GoalUpdate::CancelAnswered(ends) => events.on_cancel_response(ends),
                        GoalUpdate::Feedback(feedback) => events.on_feedback(feedback),
                        GoalUpdate::Ended(Ok(end)) => {
                            errand.finish_attempt(&servant, AttemptOutcome::Answered);
                            group.counts.record_answer(began.elapsed());
                            return Ok(end);
                        }
                        GoalUpdate::Ended(Err(error)) => {
                            tracing::debug!("servant {} lost a goal: {error}", servant.id);
                            at = None;
                            errand.finish_attempt(&servant, AttemptOutcome::Lost);
                            last = Some(servant);
                        }
                    }
                }
                Some((servant, ready)) = sending.next(), if !sending.is_empty() => {
                    match ready {
                        Ok(client) => {
                            let ear = GoalUpdateSender { servant: Arc::clone(&servant), said: sender.clone() };
                            client.send_goal(&self.id, self.body.clone(), Arc::new(ear));
                            at = Some((servant, client));
                        }
                        Err(error) => {
                            tracing::debug!("servant {} accepts no goal: {error}", servant.id);
                            if matches!(error, BusError::CallFailed { .. }) {
                                servant.forget_action(&self.name);
                            }
                            errand.finish_attempt(&servant, AttemptOutcome::NotTaken);
                        }
                    }
                }
                Some(told) = errand.told.recv() => match told {
                    DispatchEvent::Ask(_) if told_to_end => return Ok(self.canceled_end()),
                    DispatchEvent::Ask(servant) => {
                        if last.is_some() {
                            group.counts.asked_again.fetch_add(1, Ordering::Relaxed);
                        }
                        let (name, of) = (Arc::clone(&self.name), Arc::clone(&self.of));
                        sending.push(Box::pin(async move {
                            let ready = async {
                                let client = servant.action(&name, &of)?;
                                client.wait_for_server(CONNECTS).await?;
                                Ok(client)
                            };
                            let ready = ready.await;
                            (servant, ready)
                        }));
                    }
                    DispatchEvent::Drop(servant) => {
                        last = Some(servant);
                        sending.clear();
                        at = None;
                    }
                    DispatchEvent::Fail(why) => {
                        errand.over = true;
                        return Err(self.fail_goal(&group, last.as_deref(), why));
                    }
                },
                () = &mut given_up => {
                    let at = at.as_ref().map_or("no servant", |(servant, _)| servant.id.as_str());
                    let words = format!(
                        "its robot is gone, and {at} did not end it within {END_TIMEOUT:?}; other robots' goals \
                         run there, too"
                    );
                    tracing::warn!("goal {} of {}: {words}", self.id, self.name);
                    return Err(GoalError::GivenUp(FailureReason::new(words)));
                }
                () = end_wanted => {
                    told_to_end = true;
                    match &at {
                        Some((_, client)) => client.cancel_goal(&self.id),
                        None => return Ok(self.canceled_end()),
                    }
                }
                // Nothing else is to be done at the moment.
                () = std::future::ready(()), if idle && !waits => {
                    waits = true;
                    events.on_waiting();
                }
            }
        }
    }

    fn fail_goal(&self, group: &ServantGroup, last: Option<&MemberServant>, why: LossReason) -> GoalError {
        group.counts.failed.fetch_add(1, Ordering::Relaxed);
        GoalError::GivenUp(FailureReason::new(describe_loss(last, why)))
    }

    /// Returns the end of a goal that was cancelled before any servant had it.
    fn canceled_end(&self) -> GoalEnd {
        GoalEnd {
            outcome: GoalOutcome::Canceled,
            text: "it was cancelled before a servant had started it".to_owned(),
            result: default_message(&self.of.result).into(),
        }
    }
}

#[cfg(test)]
mod tests;
