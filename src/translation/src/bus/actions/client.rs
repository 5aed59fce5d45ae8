//! A client with the robot's type of an action of the servant.
//!
//! Goals are sent in order, once a server is there: one that is sent before its server listens is lost in ROS 1, and a
//! client that sends a newer goal relies on the order. What waits is bounded by number and charged to the robot.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::{Budget, Exceeded, Permit};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{ActionClient, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome};
use ros::codec::default_message;
use ros::schema::MessageType;
use tokio::sync::mpsc;
use tracing::Instrument;

use crate::bus::state::Translation;
use crate::{ActionTwin, MessageTranslator, TranslationError};

/// Time for which goals wait for a server that the graph shows.
const CONNECTS: Duration = Duration::from_secs(10);

/// Maximum number of goals and cancels that wait to be carried out. Those in front of the client hold fewer goals, and
/// of each only one cancel waits.
const MOST_ORDERS: usize = 2048;

/// A client of one action. Goals that are under way when it is dropped are cancelled.
pub(crate) struct TranslatedActionClient {
    carrier: Arc<ActionCarrier>,
    inner: Arc<dyn ActionClient>,
    /// Budget for goals that wait.
    budget: Budget,
    orders: mpsc::Sender<Order>,
    cancels: WaitingCancels,
}

/// Ids of the goals whose cancels wait.
type WaitingCancels = Arc<Mutex<BTreeSet<String>>>;

/// Translates the messages of one action.
pub(super) struct ActionCarrier {
    pub(super) translation: Arc<Translation>,
    pub(super) action: String,
    /// The servant's type, and the robot's as its twin.
    pub(super) twin: Arc<ActionTwin>,
}

impl ActionCarrier {
    /// Returns the end of a goal with its result carried by `by` to the type `of`. A goal has not succeeded for
    /// somebody who cannot read what came of it.
    pub(super) fn carry_end(&self, end: GoalEnd, by: &MessageTranslator, of: &MessageType) -> GoalEnd {
        let GoalEnd { outcome, text, result } = end;
        match self.translation.losses.translate(&self.action, by, &result) {
            Ok(result) => GoalEnd { outcome, text, result },
            Err(error) => GoalEnd {
                outcome: if outcome == GoalOutcome::Succeeded { GoalOutcome::Aborted } else { outcome },
                text: format!("the result is not carried to the other ROS: {error}; {text}"),
                result: default_message(of).into(),
            },
        }
    }
}

/// Operations that are carried out in order.
enum Order {
    Send(WaitingGoal),
    Cancel(String),
}

/// A goal of the servant's type on its way.
struct WaitingGoal {
    id: String,
    goal: Bytes,
    events: Arc<TranslatedEvents>,
    /// Held until it is sent.
    _held: Permit,
}

impl TranslatedActionClient {
    /// Opens a client of the servant's action; goals that wait are charged to `budget`. Call it within a Tokio runtime.
    pub(super) fn open(
        translation: &Arc<Translation>,
        action: &str,
        twin: &Arc<ActionTwin>,
        budget: &Budget,
    ) -> Result<Self, BusError> {
        let inner: Arc<dyn ActionClient> = Arc::from(translation.inner.action_client(action, &twin.original)?);
        let carrier =
            ActionCarrier { translation: Arc::clone(translation), action: action.to_owned(), twin: Arc::clone(twin) };
        let (orders, ordered) = mpsc::channel(MOST_ORDERS);
        let cancels = WaitingCancels::default();
        // It ends with the sender of the orders.
        let carrying = carry_out(carrier.action.clone(), Arc::clone(&inner), ordered, Arc::clone(&cancels));
        tokio::spawn(carrying.in_current_span());
        Ok(Self { carrier: Arc::new(carrier), inner, budget: budget.clone(), orders, cancels })
    }

    /// Lets a goal of the robot's type wait for its turn.
    fn queue_goal(&self, id: &str, goal: &[u8], events: &Arc<TranslatedEvents>) -> Result<(), UnsentGoal> {
        let ActionCarrier { translation, action, twin } = &*self.carrier;
        let goal = translation.losses.translate(action, &twin.goal.from_twin, goal)?;
        let held = self.budget.take(size_of::<WaitingGoal>() + id.len() + goal.len())?;
        let goal = WaitingGoal { id: id.to_owned(), goal, events: Arc::clone(events), _held: held };
        // Received as long as this client exists.
        self.orders.try_send(Order::Send(goal)).map_err(|_| UnsentGoal::TooMany)
    }
}

/// The reason why a goal is rejected before it is sent.
#[derive(Debug, thiserror::Error)]
enum UnsentGoal {
    /// The goal is not of the action's type, or the other ROS cannot express it.
    #[error("the goal is not carried to the other ROS: {0}")]
    Untranslated(#[from] TranslationError),
    /// The goal does not fit into the budget.
    #[error(transparent)]
    NoMemory(#[from] Exceeded),
    /// The limit of waiting orders is reached.
    #[error("{MOST_ORDERS} goals and cancels wait for this action already; wait for some to end")]
    TooMany,
}

#[async_trait]
impl ActionClient for TranslatedActionClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        self.inner.wait_for_server(patience).await
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let events = Arc::new(TranslatedEvents { carrier: Arc::clone(&self.carrier), events });
        if let Err(reason) = self.queue_goal(id, &goal, &events) {
            events.end(GoalOutcome::Rejected, reason.to_string());
        }
    }

    fn cancel_goal(&self, id: &str) {
        // One that waits says it all.
        if self.cancels.lock().insert(id.to_owned()) && self.orders.try_send(Order::Cancel(id.to_owned())).is_err() {
            self.cancels.lock().remove(id);
        }
    }
}

/// Sends and cancels goals in order until their client is dropped.
async fn carry_out(
    action: String,
    inner: Arc<dyn ActionClient>,
    mut orders: mpsc::Receiver<Order>,
    cancels: WaitingCancels,
) {
    let take = |order: Order, waiting: &mut VecDeque<WaitingGoal>| {
        if let Order::Cancel(id) = &order {
            cancels.lock().remove(id);
        }
        follow(order, waiting, &*inner);
    };
    while let Some(order) = orders.recv().await {
        let mut waiting = VecDeque::new();
        take(order, &mut waiting);
        if waiting.is_empty() {
            continue;
        }
        let mut ready = std::pin::pin!(inner.wait_for_server(CONNECTS));
        let ready = loop {
            tokio::select! {
                biased;
                ready = &mut ready => break ready,
                order = orders.recv() => match order {
                    Some(order) => take(order, &mut waiting),
                    None => break Err(BusError::Closed),
                },
            }
        };
        let failure = ready.err().map(|error| match error {
            BusError::Timeout { .. } => GoalError::NoServer(action.clone()),
            other => other.into(),
        });
        for WaitingGoal { id, goal, events, .. } in waiting {
            match &failure {
                None => inner.send_goal(&id, goal, events),
                Some(error) => events.on_ended(Err(error.clone())),
            }
        }
    }
}

/// Carries out an order, or keeps the goal that is to be sent. A goal that was not sent yet can be cancelled by itself.
fn follow(order: Order, waiting: &mut VecDeque<WaitingGoal>, inner: &dyn ActionClient) {
    match order {
        Order::Send(goal) => waiting.push_back(goal),
        Order::Cancel(id) => match waiting.iter().position(|goal| goal.id == id) {
            Some(at) => {
                let text = "it was cancelled before a server was there".to_owned();
                if let Some(goal) = waiting.remove(at) {
                    goal.events.end(GoalOutcome::Canceled, text);
                }
            }
            None => inner.cancel_goal(&id),
        },
    }
}

/// Translates what a server of the servant reports.
struct TranslatedEvents {
    carrier: Arc<ActionCarrier>,
    events: Arc<dyn GoalEvents>,
}

impl TranslatedEvents {
    /// Ends the goal with a default result.
    fn end(&self, outcome: GoalOutcome, text: String) {
        let result = default_message(&self.carrier.twin.twin.result).into();
        self.events.on_ended(Ok(GoalEnd { outcome, text, result }));
    }
}

impl GoalEvents for TranslatedEvents {
    fn on_waiting(&self) {
        self.events.on_waiting();
    }

    fn on_accepted(&self) {
        self.events.on_accepted();
    }

    fn on_cancel_response(&self, ends: bool) {
        self.events.on_cancel_response(ends);
    }

    fn on_feedback(&self, feedback: Bytes) {
        let ActionCarrier { translation, action, twin } = &*self.carrier;
        // What cannot be carried was counted.
        if let Ok(feedback) = translation.losses.translate(action, &twin.feedback.to_twin, &feedback) {
            self.events.on_feedback(feedback);
        }
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        match end {
            // Nothing came of it that could be carried.
            Ok(GoalEnd { outcome: GoalOutcome::Rejected, text, .. }) => self.end(GoalOutcome::Rejected, text),
            Ok(end) => {
                let twin = &self.carrier.twin;
                let end = self.carrier.carry_end(end, &twin.result.to_twin, &twin.twin.result);
                self.events.on_ended(Ok(end));
            }
            Err(error) => self.events.on_ended(Err(error)),
        }
    }
}
