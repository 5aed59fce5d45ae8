//! Keeps the promise for one node: carries out what [`qos::Governor`] decides, on the link, the local original and
//! the application.

mod context;
mod effects;
mod goal_messages;
mod goals;
mod inputs;
mod kept;
mod managing;

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Instant;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use parking_lot::Mutex;
use qos::{
    Event, Failure, Governor, HandOver, Ledger, Limits, LocalState, Mode, Outcome, Pair, Phases,
    RequestId, SafeStop, Side, Sla, Verdict,
};
use ros::bus::{Message, WireType};
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::time::sleep_until;

use super::original::{Interface, News, Original};
use super::remembered::Remembered;
use super::stamp::{Stamps, age};
use context::Context;
use goals::Goals;
use kept::{KeptInput, KeptInputs};

/// The way to the servant.
pub trait Cloud: Send + Sync + 'static {
    /// Sends an input; never blocks.
    fn publish(&self, topic: &str, message: &Message);
    /// Sends a call; its answer comes by [`Keeper::cloud_answered`] under the same id.
    fn call(&self, request: RequestId, service: &str, bytes: Bytes);
    /// Sends a call that is not measured, and gives its answer. While the link is away that waits.
    fn ask(&self, service: &str, bytes: Bytes) -> Answer;
}

/// What a call of one side will come to.
pub type Answer = BoxFuture<'static, Result<Bytes, Failure>>;

/// The robot's nodes.
pub trait Application: Send + Sync + 'static {
    /// Publishes an output of the local original.
    fn deliver(&self, topic: &str, message: Message);
    /// The local original has latched this while it does not speak for the node: its last word, once it does.
    fn latched(&self, topic: &str, message: Message);
    /// Publishes the safe-stop message: nobody has answered in time.
    fn safe_stop(&self, stop: &SafeStop);
    /// A decision about the local original.
    fn decided(&self, event: &Event);
    /// A stateful service: who goes on, and without what.
    fn handed_over(&self, over: &HandOver);
    /// The side that goes on was not given these calls and goals, of a service that is not stateful: most lose nothing by that.
    fn lacks(&self, over: &HandOver);
    /// How a request went.
    fn told(&self, outcome: &Outcome);
}

/// What a request carries.
#[derive(Debug, Clone)]
pub enum Payload {
    /// An input message.
    Input(Arc<KeptInput>),
    /// A serialized service request.
    Call(Bytes),
    /// A goal of an action that is made of calls (ROS 2).
    Goal(Arc<goals::Sent>),
}

/// One node's keeper. Its tasks end with it, and so does the local original.
pub struct Keeper {
    state: Mutex<State>,
    cloud: Arc<dyn Cloud>,
    robot: Arc<dyn Application>,
    original: Option<Arc<Original>>,
    /// What the node was told to be.
    remembered: Arc<Remembered>,
    /// Of that the cloud was not told something.
    cloud_missed: AtomicBool,
    safe_stop: Option<SafeStop>,
    ending: AtomicBool,
    /// The next deadline may have changed.
    wake: Arc<Notify>,
    this: Weak<Self>,
}

struct State {
    governor: Governor<Payload>,
    context: Context,
    kept: KeptInputs,
    stamps: Stamps,
    /// What each side was given: of a stateful service all, of any other the calls and goals, each of which may switch how a node behaves.
    ledger: Ledger,
    is_stateful: bool,
    /// What was lost at the last hand-over.
    lost: Option<(Instant, String)>,
    callers: HashMap<RequestId, oneshot::Sender<Result<Bytes, String>>>,
    goals: Goals,
}

impl Keeper {
    /// Begins, with the link down. Without an `original` the cloud is alone; where no time is promised that is said when
    /// it would be needed, else at once.
    pub fn start(
        sla: Sla,
        pairs: Vec<Pair>,
        original: Option<(Original, mpsc::UnboundedReceiver<News>)>,
        cloud: Arc<dyn Cloud>,
        robot: Arc<dyn Application>,
    ) -> Arc<Self> {
        let (original, news) = original.unzip();
        let promised = !sla.is_of_link();
        let safe_stop = sla.safe_stop.clone();
        let state = State {
            ledger: Ledger::default(),
            is_stateful: sla.mode == Mode::Stateful,
            lost: None,
            context: Context::of(&pairs),
            kept: KeptInputs::default(),
            governor: Governor::new(sla, pairs, Limits::default()),
            stamps: Stamps::default(),
            callers: HashMap::new(),
            goals: Goals::default(),
        };
        let remembered = original.as_ref().map(|original| original.remembered());
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
        tokio::spawn(keep_time(Arc::downgrade(&keeper), keeper.wake.clone()));
        match news {
            Some(news) => drop(tokio::spawn(listen(Arc::downgrade(&keeper), news))),
            None if promised => keeper.missing(),
            None => {}
        }
        keeper.with(|state, now| state.governor.begin(now));
        keeper
    }

    /// More of the interface has become known.
    pub async fn learn(&self, pairs: Vec<Pair>, interface: Interface) -> anyhow::Result<()> {
        self.with(|state, now| {
            state.context.learn(&pairs);
            state.governor.learn(now, pairs);
        });
        match &self.original {
            Some(original) => original.adapt(interface).await,
            None => Ok(()),
        }
    }

    /// These types have become known, which messages of ROS 2 have without their definitions.
    pub fn learn_types<'a>(&self, types: impl Iterator<Item = &'a WireType>) {
        let mut state = self.state.lock();
        for wire_type in types {
            state.stamps.learn(wire_type);
        }
    }

    /// The local original, where there is one.
    pub fn original(&self) -> Option<&Arc<Original>> {
        self.original.as_ref()
    }

    fn missing(&self) {
        self.with(|state, now| state.governor.local(now, LocalState::Missing));
    }

    /// The local original is given messages, too.
    pub fn is_local_fed(&self) -> bool {
        self.state.lock().governor.sides().local
    }

    /// Somebody on the robot listens to an output, or nobody does.
    pub fn wanted(&self, output: &str, wanted: bool) {
        self.with(|state, now| state.governor.wanted(now, output, wanted));
    }

    /// The application calls a service. When the caller goes, so does the request.
    pub async fn call(
        self: &Arc<Self>,
        service: &Arc<str>,
        request: Bytes,
    ) -> Result<Bytes, String> {
        let (sender, answer) = oneshot::channel();
        let id = self.with(|state, now| {
            state.ledger.told(now, service);
            let id = state.governor.call(now, service, Payload::Call(request));
            state.callers.insert(id, sender);
            id
        });
        let waiting = Waiting { keeper: self, id };
        let answer = answer.await;
        drop(waiting);
        answer.unwrap_or_else(|_| Err("the node is ending".to_owned()))
    }

    /// The cloud answered a call.
    pub fn cloud_answered(
        &self,
        id: RequestId,
        result: Result<Bytes, Failure>,
        phases: Option<Phases>,
    ) {
        self.answered(Side::Cloud, id, result, phases);
    }

    /// The servant's node published. True where the application is to have it.
    pub fn cloud_output(&self, topic: &str, message: &Message, phases: Option<Phases>) -> bool {
        self.output(Side::Cloud, topic, message, phases)
    }

    /// The link is up; `resumed`: what was sent will be answered yet.
    pub fn link_up(&self, resumed: bool) {
        self.with(|state, now| {
            state.ledger.link_up(resumed);
            state.governor.link_up(now, resumed);
        });
        self.tell_cloud(resumed);
    }

    /// The link is down.
    pub fn link_down(&self) {
        self.with(|state, now| state.governor.link_down(now));
    }

    /// The node is ending: the local original ends, too, and is not started again. roslaunch's signal has reached it
    /// already, so its end is no crash.
    pub fn end(&self) {
        self.ending.store(true, Ordering::Relaxed);
        if let Some(original) = &self.original {
            original.stop();
        }
    }

    /// How it stands.
    pub fn report(&self) -> qos::Report {
        let (state, now) = (self.state.lock(), Instant::now());
        let lost = state.lost.as_ref();
        qos::Report {
            lost: lost.map(|(at, text)| ((now - *at).as_secs_f64(), text.clone())),
            ..state.governor.report(now)
        }
    }

    fn output(&self, side: Side, topic: &str, message: &Message, phases: Option<Phases>) -> bool {
        let verdict = self.with(|state, now| {
            let stamp = state.stamps.of(message).filter(|stamp| !stamp.is_zero());
            let age = stamp.map(age).unwrap_or_default();
            let key = goals::key_of_feedback(topic, message);
            let key = key.or_else(|| state.stamps.key(message));
            let verdict = state.governor.output(now, side, topic, key, age);
            if let Some(phases) = phases {
                state.governor.phases(&phases);
            }
            verdict
        });
        verdict == Verdict::Deliver
    }

    fn answered(
        &self,
        side: Side,
        id: RequestId,
        result: Result<Bytes, Failure>,
        phases: Option<Phases>,
    ) {
        self.with(|state, now| {
            match result {
                Ok(bytes) => {
                    if state.governor.answered(now, side, id) == Verdict::Deliver {
                        state.reply(id, Ok(bytes));
                    }
                }
                Err(failure) => state.governor.failed(now, side, id, &failure),
            }
            if let Some(phases) = phases {
                state.governor.phases(&phases);
            }
        });
    }

    /// Time has passed; gives the next deadline.
    fn tick(&self) -> Option<Instant> {
        self.change(|state, now| state.governor.tick(now));
        self.state.lock().governor.deadline()
    }

    /// Something happened: changes the state, does what follows, and has the deadline looked at again.
    fn with<T>(&self, change: impl FnOnce(&mut State, Instant) -> T) -> T {
        let result = self.change(change);
        self.wake.notify_one();
        result
    }
}

impl State {
    fn reply(&mut self, id: RequestId, answer: Result<Bytes, String>) {
        if let Some(caller) = self.callers.remove(&id) {
            let _ = caller.send(answer);
        }
    }
}

/// Cancels a request whose caller has gone.
struct Waiting<'a> {
    keeper: &'a Keeper,
    id: RequestId,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let id = self.id;
        self.keeper.with(|state, now| {
            if state.callers.remove(&id).is_some() {
                state.governor.cancel(now, id);
            }
        });
    }
}

/// Wakes the governor at its deadlines.
async fn keep_time(keeper: Weak<Keeper>, wake: Arc<Notify>) {
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

/// Takes what the local original says.
async fn listen(keeper: Weak<Keeper>, mut news: mpsc::UnboundedReceiver<News>) {
    while let Some(news) = news.recv().await {
        let Some(keeper) = keeper.upgrade() else {
            return;
        };
        match news {
            News::State(local) => keeper.with(|state, now| {
                state.context.is_now(local);
                state.governor.local(now, local);
            }),
            News::Crashed(reason) => {
                keeper.with(|state, now| state.governor.local_crashed(now, &reason))
            }
            News::Output(topic, message) => {
                if keeper.output(Side::Local, &topic, &message, None) {
                    keeper.robot.deliver(&topic, message);
                } else if message.latching {
                    keeper.robot.latched(&topic, message);
                }
            }
        }
    }
}
