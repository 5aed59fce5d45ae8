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
use ros::schema::ActionDef;
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use super::dispatch::{End, Kind, Lost, Robot};
use super::{Errand, Group, Servant, Told, lost_in_words};

/// For an action server of a servant that has its interface.
const CONNECTS: Duration = Duration::from_secs(10);

/// One action, as a robot's.
pub(super) struct GroupClient {
    group: Arc<Group>,
    robot: Robot,
    name: Arc<str>,
    of: Arc<ActionDef>,
    goals: Arc<Mutex<HashMap<String, CancellationToken>>>,
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
        }
    }
}

#[async_trait]
impl ActionClient for GroupClient {
    async fn ready(&self, patience: Duration) -> Result<(), BusError> {
        let mut members = self.group.members.subscribe();
        let any = async {
            loop {
                let now = members.borrow_and_update().clone();
                let clients = now
                    .values()
                    .map(|servant| servant.action(&self.name, &self.of));
                let clients: Vec<_> = clients.collect::<Result<_, _>>()?;
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
        let cancelled = CancellationToken::new();
        self.goals.lock().insert(id.to_owned(), cancelled.clone());
        let goal = Goal {
            // Robots do not know each other's ids.
            id: format!("{}-{id}", self.robot),
            body: goal,
            name: Arc::clone(&self.name),
            of: Arc::clone(&self.of),
            cancelled,
        };
        let errand = self
            .group
            .begin(self.robot, &Kind::Goal(Arc::clone(&self.name)));
        let (goals, id) = (Arc::clone(&self.goals), id.to_owned());
        tokio::spawn(async move {
            let end = goal.follow(errand, &events).await;
            goals.lock().remove(&id);
            events.ended(end);
        });
    }

    fn cancel(&self, id: &str) {
        if let Some(cancelled) = self.goals.lock().get(id) {
            cancelled.cancel();
        }
    }
}

impl Drop for GroupClient {
    fn drop(&mut self) {
        for cancelled in self.goals.lock().values() {
            cancelled.cancel();
        }
    }
}

struct Goal {
    id: String,
    body: Bytes,
    name: Arc<str>,
    of: Arc<ActionDef>,
    cancelled: CancellationToken,
}

/// What a servant says of a goal.
enum Said {
    Feedback(Bytes),
    Ended(Result<GoalEnd, String>),
}

struct Ear {
    servant: Arc<Servant>,
    said: mpsc::UnboundedSender<(Arc<Servant>, Said)>,
}

impl GoalEvents for Ear {
    fn feedback(&self, feedback: Bytes) {
        let _ = self
            .said
            .send((Arc::clone(&self.servant), Said::Feedback(feedback)));
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        let _ = self
            .said
            .send((Arc::clone(&self.servant), Said::Ended(end)));
    }
}

/// An attempt to send the goal to a servant.
type Sending = BoxFuture<'static, (Arc<Servant>, Result<Arc<dyn ActionClient>, BusError>)>;

impl Goal {
    /// From asked for to its end.
    async fn follow(
        &self,
        mut errand: Errand,
        events: &Arc<dyn GoalEvents>,
    ) -> Result<GoalEnd, String> {
        let (group, began) = (Arc::clone(&errand.group), Instant::now());
        let (sender, mut said) = mpsc::unbounded_channel::<(Arc<Servant>, Said)>();
        let mut sending: FuturesUnordered<Sending> = FuturesUnordered::new();
        let mut at: Option<(Arc<Servant>, Arc<dyn ActionClient>)> = None;
        let mut last: Option<Arc<Servant>> = None;
        let mut told_to_end = false;
        loop {
            tokio::select! {
                biased;
                Some((servant, what)) = said.recv() => {
                    let here = at.as_ref().is_some_and(|(now, _)| now.member == servant.member);
                    match what {
                        _ if !here => {}
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
                () = self.cancelled.cancelled(), if !told_to_end => {
                    told_to_end = true;
                    match &at {
                        Some((_, client)) => client.cancel(&self.id),
                        None => return Ok(self.recalled()),
                    }
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
            result: vec![0; self.of.result.min_size()].into(),
        }
    }
}
