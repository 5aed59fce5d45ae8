//! A client with the robot's type of an action of the servant.
//!
//! Goals are sent in order, once a server is there: one that is sent before its server listens is lost in ROS 1, and a
//! client that sends a newer goal relies on the order.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{ActionClient, BusError, GoalEnd, GoalError, GoalEvents, GoalOutcome};
use ros::codec::default_message;
use ros::schema::MessageType;
use tokio::sync::mpsc;
use tracing::Instrument;

use crate::bus::state::Translation;
use crate::{ActionTwin, MessageTranslator};

/// Time for which goals wait for a server that the graph shows.
const CONNECTS: Duration = Duration::from_secs(10);

/// A client of one action. Goals that are under way when it is dropped are cancelled.
pub(crate) struct TranslatedActionClient {
    carrier: Arc<ActionCarrier>,
    inner: Arc<dyn ActionClient>,
    orders: mpsc::UnboundedSender<Order>,
}

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

/// What is to be done in order.
enum Order {
    Send(WaitingGoal),
    Cancel(String),
}

/// A goal of the servant's type on its way.
struct WaitingGoal {
    id: String,
    goal: Bytes,
    events: Arc<TranslatedEvents>,
}

impl TranslatedActionClient {
    /// Opens a client of the servant's action. Call it within a Tokio runtime.
    pub(super) fn open(translation: &Arc<Translation>, action: &str, twin: &Arc<ActionTwin>) -> Result<Self, BusError> {
        let inner: Arc<dyn ActionClient> = Arc::from(translation.inner.action_client(action, &twin.original)?);
        let carrier =
            ActionCarrier { translation: Arc::clone(translation), action: action.to_owned(), twin: Arc::clone(twin) };
        Ok(Self::with_client(carrier, inner))
    }

    fn with_client(carrier: ActionCarrier, inner: Arc<dyn ActionClient>) -> Self {
        let (orders, ordered) = mpsc::unbounded_channel();
        // It ends with the sender of the orders.
        tokio::spawn(carry_out(carrier.action.clone(), Arc::clone(&inner), ordered).in_current_span());
        Self { carrier: Arc::new(carrier), inner, orders }
    }
}

#[async_trait]
impl ActionClient for TranslatedActionClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        self.inner.wait_for_server(patience).await
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let carrier = &self.carrier;
        let events = TranslatedEvents { carrier: Arc::clone(carrier), events };
        let losses = &carrier.translation.losses;
        match losses.translate(&carrier.action, &carrier.twin.goal.from_twin, &goal) {
            Ok(goal) => {
                let goal = WaitingGoal { id: id.to_owned(), goal, events: Arc::new(events) };
                // Received as long as this client exists.
                let _ = self.orders.send(Order::Send(goal));
            }
            Err(error) => {
                let text = format!("the goal is not carried to the other ROS: {error}");
                events.end(GoalOutcome::Rejected, text);
            }
        }
    }

    fn cancel_goal(&self, id: &str) {
        let _ = self.orders.send(Order::Cancel(id.to_owned()));
    }
}

/// Sends and cancels goals in order until their client is dropped.
async fn carry_out(action: String, inner: Arc<dyn ActionClient>, mut orders: mpsc::UnboundedReceiver<Order>) {
    while let Some(order) = orders.recv().await {
        let mut waiting = VecDeque::new();
        follow(order, &mut waiting, &*inner);
        if waiting.is_empty() {
            continue;
        }
        let mut ready = std::pin::pin!(inner.wait_for_server(CONNECTS));
        let ready = loop {
            tokio::select! {
                biased;
                ready = &mut ready => break ready,
                order = orders.recv() => match order {
                    Some(order) => follow(order, &mut waiting, &*inner),
                    None => break Err(BusError::Closed),
                },
            }
        };
        let failure = ready.err().map(|error| match error {
            BusError::Timeout { .. } => GoalError::NoServer(action.clone()),
            other => other.into(),
        });
        for WaitingGoal { id, goal, events } in waiting {
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
