//! Keeps the promise for one node: executes the decisions of [`qos::Governor`] on the link, the local original and the
//! application.

mod context;
mod effects;
mod goal_messages;
mod goals;
mod inputs;
mod kept_inputs;
mod managing;

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use qos::{
    DeliveryVerdict, Failure, Governor, HandOver, HandOverLedger, LocalState, Mode, OutputAge, Phases, QosEvent,
    QosSla, RequestId, RequestOutcome, Responder, RetentionLimits, SafeStop, TopicPair,
};
use ros::bus::{FailureReason, SerializedMessage, WireType};
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::time::sleep_until;

use super::expected::ExpectedInterface;
use super::original::{Original, OriginalEvent};
use super::pending_answer::PendingAnswer;
use super::remembered::RememberedSettings;
use super::stamp::{StampReader, age};
use context::LocalContext;
use goals::KeeperGoals;
use kept_inputs::{RetainedInput, RetainedInputs};

/// The connection to the servant.
pub trait Cloud: Send + Sync + 'static {
    /// Sends an input; never blocks.
    fn publish(&self, topic: &str, message: &SerializedMessage);
    /// Sends a call; its answer arrives in [`Keeper::on_cloud_answer`] with the same id.
    fn call(&self, request: RequestId, service: &str, bytes: Bytes);
    /// Makes a call that is not measured and returns its answer. Waits while the link is down.
    fn call_unmeasured(&self, service: &str, bytes: Bytes) -> PendingAnswer;
}

/// The robot's nodes.
pub trait Application: Send + Sync + 'static {
    /// Publishes an output of the local original.
    fn deliver(&self, topic: &str, message: SerializedMessage);
    /// Stores a message that the local original has latched while it does not speak for the node, to be published when
    /// it does.
    fn on_latched_output(&self, topic: &str, message: SerializedMessage);
    /// Publishes the safe-stop message: neither side has answered in time.
    fn safe_stop(&self, stop: &SafeStop);
    /// Reports a decision about the local original.
    fn on_decision(&self, event: &QosEvent);
    /// Reports a hand-over of a stateful service: the side that continues, and the messages that it did not receive.
    fn on_hand_over(&self, over: &HandOver);
    /// Reports calls and goals that the continuing side of a stateless service did not receive; most services lose
    /// nothing by that.
    fn on_missed_requests(&self, over: &HandOver);
    /// Reports the outcome of a request.
    fn on_outcome(&self, outcome: &RequestOutcome);
}

/// Content of a request.
#[derive(Debug, Clone)]
pub enum Payload {
    /// An input message.
    Input(Arc<RetainedInput>),
    /// A serialized service request.
    Call(Bytes),
    /// A goal of an action that consists of service calls (ROS 2).
    Goal(Arc<goals::GoalRequest>),
}

/// The keeper of one node's promise. Its tasks and the local original end with it.
pub struct Keeper {
    state: Mutex<State>,
    cloud: Arc<dyn Cloud>,
    robot: Arc<dyn Application>,
    original: Option<Arc<Original>>,
    /// Settings that the node was given, to be repeated to a new process or servant.
    remembered: Arc<RememberedSettings>,
    /// Set if a setting has not reached the cloud.
    cloud_missed: AtomicBool,
    safe_stop: Option<SafeStop>,
    ending: AtomicBool,
    /// Notified when the next deadline may have changed.
    wake: Arc<Notify>,
    this: Weak<Self>,
}

struct State {
    governor: Governor<Payload>,
    context: LocalContext,
    kept: RetainedInputs,
    stamps: StampReader,
    /// Record of the messages that each side received: for a stateful service all, otherwise calls and goals, which may
    /// change a node's mode.
    ledger: HandOverLedger,
    is_stateful: bool,
    /// Losses of the last hand-over.
    lost: Option<(Instant, String)>,
    callers: HashMap<RequestId, oneshot::Sender<Result<Bytes, FailureReason>>>,
    goals: KeeperGoals,
}

impl Keeper {
    /// Starts the keeper, with the link down. Without an `original` there is only the cloud; if no time is promised
    /// this is reported when the original would be needed, otherwise at once.
    pub fn start(
        sla: QosSla,
        pairs: Vec<TopicPair>,
        original: Option<(Original, mpsc::UnboundedReceiver<OriginalEvent>)>,
        cloud: Arc<dyn Cloud>,
        robot: Arc<dyn Application>,
    ) -> Arc<Self> {
        let (original, news) = original.unzip();
        let promised = !sla.is_link_based();
        let safe_stop = sla.safe_stop.clone();
        let state = State {
            ledger: HandOverLedger::default(),
            is_stateful: sla.mode == Mode::Stateful,
            lost: None,
            context: LocalContext::new(&pairs),
            kept: RetainedInputs::default(),
            governor: Governor::new(sla, pairs, RetentionLimits::default()),
            stamps: StampReader::default(),
            callers: HashMap::new(),
            goals: KeeperGoals::default(),
        };
        let remembered = original.as_ref().map(|original| original.remembered_settings());
        let keeper = Arc::new_cyclic(|this| Self {
            state: Mutex::new(state),
            cloud,
            robot,
            remembered: remembered.unwrap_or_default(),
            cloud_missed: AtomicBool::new(false),
            original: original.map(Arc::new),
            safe_stop,
            ending: AtomicBool::new(false),
            wake: Arc::default(),
            this: this.clone(),
        });
        tokio::spawn(run_timer(Arc::downgrade(&keeper), keeper.wake.clone()));
        match news {
            Some(news) => drop(tokio::spawn(process_original_events(Arc::downgrade(&keeper), news))),
            None if promised => keeper.report_missing_original(),
            None => {}
        }
        keeper.update(|state, now| state.governor.begin(now));
        keeper
    }

    /// Adds newly known parts of the interface.
    pub async fn learn(&self, pairs: Vec<TopicPair>, interface: ExpectedInterface) -> anyhow::Result<()> {
        self.update(|state, now| {
            state.context.learn(&pairs);
            state.governor.add_pairs(now, pairs);
        });
        match &self.original {
            Some(original) => original.adapt(interface).await,
            None => Ok(()),
        }
    }

    /// Adds newly known types, since ROS 2 messages have no definitions of their types.
    pub fn learn_types<'a>(&self, types: impl Iterator<Item = &'a WireType>) {
        let mut state = self.state.lock();
        for wire_type in types {
            state.stamps.learn(wire_type);
        }
    }

    /// Returns the local original, if there is one.
    pub fn original(&self) -> Option<&Arc<Original>> {
        self.original.as_ref()
    }

    fn report_missing_original(&self) {
        self.update(|state, now| state.governor.on_local_state(now, LocalState::Missing));
    }

    /// Returns whether the local original is fed messages.
    pub fn is_local_fed(&self) -> bool {
        self.state.lock().governor.sides().local
    }

    /// Records whether an output has subscribers on the robot.
    pub fn set_wanted(&self, output: &str, wanted: bool) {
        self.update(|state, now| state.governor.set_listened(now, output, wanted));
    }

    /// Handles a service call of the application. The request is cancelled if the returned future is dropped.
    pub async fn call(self: &Arc<Self>, service: &Arc<str>, request: Bytes) -> Result<Bytes, FailureReason> {
        let (sender, answer) = oneshot::channel();
        let id = self.update(|state, now| {
            state.ledger.record_input(now, service);
            let id = state.governor.call(now, service, Payload::Call(request));
            state.callers.insert(id, sender);
            id
        });
        let waiting = CallGuard { keeper: self, id };
        let answer = answer.await;
        drop(waiting);
        answer.unwrap_or_else(|_| Err(FailureReason::new("the node is ending")))
    }

    /// Handles an answer of the cloud to a call.
    pub fn on_cloud_answer(&self, id: RequestId, result: Result<Bytes, Failure>, phases: Option<Phases>) {
        self.on_answer(Responder::Cloud, id, result, phases);
    }

    /// Handles a message that the servant's node has published; returns whether to publish it to the application.
    pub fn on_cloud_output(&self, topic: &str, message: &SerializedMessage, timing: OutputTiming) -> bool {
        self.on_output(Responder::Cloud, topic, message, timing)
    }

    /// Handles a link that is up; `resumed` is set if earlier requests will still be answered.
    pub fn link_up(&self, resumed: bool) {
        self.update(|state, now| {
            state.ledger.link_up(resumed);
            state.governor.link_up(now, resumed);
        });
        self.replay_to_cloud(resumed);
    }

    /// Handles a link that is down.
    pub fn link_down(&self) {
        self.update(|state, now| state.governor.link_down(now));
    }

    /// Ends the local original for good, because the node is ending. roslaunch's signal has reached its process
    /// already, so its end is no crash.
    pub fn end(&self) {
        self.ending.store(true, Ordering::Relaxed);
        if let Some(original) = &self.original {
            original.stop();
        }
    }

    /// Returns the state of the promise.
    pub fn report(&self) -> qos::QosReport {
        let (state, now) = (self.state.lock(), Instant::now());
        let lost = state.lost.as_ref();
        qos::QosReport {
            lost: lost.map(|(at, text)| ((now - *at).as_secs_f64(), text.clone())),
            ..state.governor.report(now)
        }
    }

    fn on_output(&self, side: Responder, topic: &str, message: &SerializedMessage, timing: OutputTiming) -> bool {
        let verdict = self.update(|state, now| {
            let stamp = state.stamps.read_stamp(message).filter(|stamp| !stamp.is_zero());
            let age = OutputAge { since_stamp: stamp.map(age).unwrap_or_default(), since_input: timing.since_input };
            let key = goals::feedback_key(topic, message);
            let key = key.or_else(|| state.stamps.key(message));
            let verdict = state.governor.output(now, side, topic, key, age);
            if let Some(phases) = timing.phases {
                state.governor.record_phases(&phases);
            }
            verdict
        });
        verdict == DeliveryVerdict::Deliver
    }

    fn on_answer(&self, side: Responder, id: RequestId, result: Result<Bytes, Failure>, phases: Option<Phases>) {
        self.update(|state, now| {
            match result {
                Ok(bytes) => {
                    if state.governor.on_result(now, side, id) == DeliveryVerdict::Deliver {
                        state.reply(id, Ok(bytes));
                    }
                }
                Err(failure) => state.governor.on_failure(now, side, id, &failure),
            }
            if let Some(phases) = phases {
                state.governor.record_phases(&phases);
            }
        });
    }

    /// Advances the governor's time and returns its next deadline.
    fn tick(&self) -> Option<Instant> {
        self.change(|state, now| state.governor.tick(now));
        self.state.lock().governor.deadline()
    }

    /// Changes the state, applies the effects and wakes the timer to check the deadline.
    fn update<T>(&self, change: impl FnOnce(&mut State, Instant) -> T) -> T {
        let result = self.change(change);
        self.wake.notify_one();
        result
    }
}

impl State {
    fn reply(&mut self, id: RequestId, answer: Result<Bytes, FailureReason>) {
        if let Some(caller) = self.callers.remove(&id) {
            let _ = caller.send(answer);
        }
    }
}

/// Times of an output, as far as the link knows them.
#[derive(Debug, Clone, Copy, Default)]
pub struct OutputTiming {
    /// See [`OutputAge::since_input`].
    pub since_input: Option<Duration>,
    /// Phases of the input that it may answer.
    pub phases: Option<Phases>,
}

/// Cancels a request whose caller is gone.
struct CallGuard<'a> {
    keeper: &'a Keeper,
    id: RequestId,
}

impl Drop for CallGuard<'_> {
    fn drop(&mut self) {
        let id = self.id;
        self.keeper.update(|state, now| {
            if state.callers.remove(&id).is_some() {
                state.governor.cancel(now, id);
            }
        });
    }
}

/// Wakes the governor at its deadlines.
async fn run_timer(keeper: Weak<Keeper>, wake: Arc<Notify>) {
    loop {
        let Some(deadline) = keeper.upgrade().map(|keeper| keeper.tick()) else {
            return;
        };
        match deadline {
            Some(deadline) => tokio::select! {
                () = sleep_until(deadline.into()) => {}
                () = wake.notified() => {}
            },
            None => wake.notified().await,
        }
    }
}

/// Handles the events of the local original.
async fn process_original_events(keeper: Weak<Keeper>, mut news: mpsc::UnboundedReceiver<OriginalEvent>) {
    while let Some(news) = news.recv().await {
        let Some(keeper) = keeper.upgrade() else {
            return;
        };
        match news {
            OriginalEvent::State(local) => keeper.update(|state, now| {
                state.context.set_state(local);
                state.governor.on_local_state(now, local);
            }),
            OriginalEvent::Crashed(reason) => keeper.update(|state, now| state.governor.on_local_crash(now, &reason)),
            OriginalEvent::Output(topic, message) => {
                if keeper.on_output(Responder::Local, &topic, &message, OutputTiming::default()) {
                    keeper.robot.deliver(&topic, message);
                } else if message.latching {
                    keeper.robot.on_latched_output(&topic, message);
                }
            }
        }
    }
}
