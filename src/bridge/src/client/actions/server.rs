//! A client as an action server, on actionlib's topics.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use ros::codec::Time;
use ros::schema::{ActionDef, MessageType};
use rosbridge::{AdvertiseAction, CancelActionGoal, Compression, Id, Writer};
use tokio_util::sync::{CancellationToken, DropGuard};

use super::{common_type, is_type};
use crate::actionlib::{self, GoalId, GoalState, Status};
use crate::client::{Client, print_format};
use crate::hub::{Listener, Listening};
use crate::outlet::Outlet;
use crate::sample::{Frame, Sample};

/// actionlib's rate.
const STATUS_PERIOD: Duration = Duration::from_millis(200);
/// How long an ended goal stays in the status list.
const STATUS_KEPT: Duration = Duration::from_secs(5);
/// Goals of one action that a client may have on its hands.
const MAX_GOALS: usize = 1000;

/// One action that a client serves.
pub(super) struct ActionServer {
    name: String,
    /// As the client wrote it.
    written: String,
    pub(super) def: Arc<ActionDef>,
    compression: Compression,
    status: Arc<Outlet>,
    feedback: Arc<Outlet>,
    result: Arc<Outlet>,
    goals: Mutex<HashMap<String, Served>>,
    /// Goals up to this stamp were cancelled, those that come after their cancel included.
    cancelled_up_to: Mutex<Time>,
    /// Set once, right after it was made: the listeners need the server itself.
    listening: Mutex<Vec<Listening>>,
    client: Weak<Client>,
    _ticking: DropGuard,
}

struct Served {
    state: GoalState,
    /// What the client calls it; empty where it was never told of it.
    request: String,
    ended: Option<Instant>,
}

impl Served {
    /// A goal that the client is not told of.
    fn unknown(state: GoalState) -> Self {
        Self {
            state,
            request: String::new(),
            ended: Some(Instant::now()),
        }
    }
}

#[derive(Clone, Copy)]
enum Topic {
    Goal,
    Cancel,
}

struct TopicListener {
    server: Weak<ActionServer>,
    topic: Topic,
    expected: Arc<MessageType>,
}

impl Listener for TopicListener {
    fn sample(&self, sample: &Arc<Sample>, _replay: bool) {
        let Some(server) = self.server.upgrade() else {
            return;
        };
        if !is_type(&sample.wire_type, &self.expected) {
            return;
        }
        match self.topic {
            Topic::Goal => server.goal(&sample.bytes),
            Topic::Cancel => server.cancel(&sample.bytes),
        }
    }

    fn failed(&self, reason: &str) {
        if let Some(server) = self.server.upgrade()
            && let Some(client) = server.client.upgrade()
        {
            let text = format!("advertise_action: action {}: {reason}", server.name);
            client.status(
                rosbridge::Level::Error,
                None,
                print_format(server.compression),
                &text,
            );
        }
    }
}

impl ActionServer {
    pub(super) fn open(
        client: &Arc<Client>,
        name: &str,
        op: &AdvertiseAction<'_>,
        def: Arc<ActionDef>,
    ) -> Result<Arc<Self>, String> {
        let shared = &client.shared;
        let goal_id = common_type(shared, "actionlib_msgs/GoalID")?;
        let states = common_type(shared, "actionlib_msgs/GoalStatusArray")?;
        let ticking = CancellationToken::new();
        let server = Arc::new(Self {
            name: name.to_owned(),
            written: op.action.clone().into_owned(),
            compression: op.compression,
            status: client.action_outlet(format!("{name}/status"), &states, true),
            feedback: client.action_outlet(format!("{name}/feedback"), &def.action_feedback, false),
            result: client.action_outlet(format!("{name}/result"), &def.action_result, false),
            goals: Mutex::default(),
            cancelled_up_to: Mutex::default(),
            listening: Mutex::default(),
            client: Arc::downgrade(client),
            def: def.clone(),
            _ticking: ticking.clone().drop_guard(),
        });
        let listen = |part: &str, topic, expected: &Arc<MessageType>| {
            let listener = TopicListener {
                server: Arc::downgrade(&server),
                topic,
                expected: expected.clone(),
            };
            shared
                .hub(&format!("{name}/{part}"), Some(expected))
                .listen(Arc::new(listener))
        };
        let listening = vec![
            listen("goal", Topic::Goal, &def.action_goal),
            listen("cancel", Topic::Cancel, &goal_id),
        ];
        *server.listening.lock() = listening;
        server.publish_status();
        tokio::spawn(tick(Arc::downgrade(&server), ticking));
        Ok(server)
    }

    fn goal(&self, bytes: &Bytes) {
        let Some((mut goal, body)) = actionlib::read_goal(bytes) else {
            return;
        };
        let Some(client) = self.client.upgrade() else {
            return;
        };
        let number = client.shared.next_number();
        if goal.id.is_empty() {
            goal.id = format!("{}-{number}", self.name);
        }
        let request = format!("action_goal:{}:{number}", self.name);
        let cancelled_up_to = *self.cancelled_up_to.lock();
        let mut goals = self.goals.lock();
        let recalled = match goals.get(&goal.id) {
            Some(known) if known.state.status == Status::Recalling => true,
            Some(_) => return,
            None => goal.stamp != Time::default() && goal.stamp <= cancelled_up_to,
        };
        if recalled {
            // Its cancel came first: the client need not hear of it.
            let state = GoalState {
                goal: goal.clone(),
                status: Status::Recalled,
                text: "the goal was cancelled before it came".to_owned(),
            };
            goals.insert(goal.id, Served::unknown(state.clone()));
            drop(goals);
            self.publish_result(&state, &vec![0; self.def.result.min_size()]);
            self.publish_status();
            return;
        }
        let frame = if goals.len() >= MAX_GOALS {
            Err(format!("{MAX_GOALS} goals wait for this server already"))
        } else {
            self.frame(&client, &request, &body)
        };
        let status = if frame.is_ok() {
            Status::Active
        } else {
            Status::Rejected
        };
        let text = frame.as_ref().err().cloned().unwrap_or_default();
        let state = GoalState {
            goal: goal.clone(),
            status,
            text,
        };
        let ended = status.is_terminal().then(Instant::now);
        goals.insert(
            goal.id,
            Served {
                state: state.clone(),
                request,
                ended,
            },
        );
        drop(goals);
        self.publish_status();
        match frame {
            Ok(frame) => client.send_as(frame, self.compression, None),
            Err(_) => self.publish_result(&state, &vec![0; self.def.result.min_size()]),
        }
    }

    fn frame(&self, client: &Client, request: &str, body: &Bytes) -> Result<Frame, String> {
        let format = print_format(self.compression);
        let mut out = Vec::with_capacity(256 + body.len());
        let mut writer = Writer::op(
            &mut out,
            format,
            "send_action_goal",
            Some(&Id::from(request)),
        );
        writer.text("action", &self.written);
        writer.text("action_type", &self.def.name);
        if self.compression == Compression::CborRaw {
            writer.text("compression", self.compression.name());
            writer.raw("args", None, body);
        } else {
            writer.value("args", |out| {
                client.print_payload(&self.def.goal, body, format, out)
            })?;
        }
        writer.boolean("feedback", true);
        writer.end();
        Ok(Frame::new(format, out))
    }

    /// actionlib's policy: an empty id means all goals up to the stamp, a zero stamp with it means all. A cancel may be
    /// faster than its goal, which comes on another topic: it is kept.
    fn cancel(&self, bytes: &[u8]) {
        let Some(wanted) = actionlib::read_cancel(bytes) else {
            return;
        };
        let Some(client) = self.client.upgrade() else {
            return;
        };
        let zero = wanted.stamp == Time::default();
        let matches = |goal: &GoalId| {
            goal.id == wanted.id
                || (wanted.id.is_empty() && zero)
                || (!zero && goal.stamp <= wanted.stamp)
        };
        {
            let mut up_to = self.cancelled_up_to.lock();
            *up_to = wanted.stamp.max(*up_to);
        }
        let mut requests = Vec::new();
        let mut goals = self.goals.lock();
        if !wanted.id.is_empty() && !goals.contains_key(&wanted.id) && goals.len() < MAX_GOALS {
            let state = GoalState {
                goal: wanted.clone(),
                status: Status::Recalling,
                text: String::new(),
            };
            goals.insert(wanted.id.clone(), Served::unknown(state));
        }
        for served in goals.values_mut() {
            if served.ended.is_none()
                && served.state.status == Status::Active
                && matches(&served.state.goal)
            {
                served.state.status = Status::Preempting;
                requests.push(served.request.clone());
            }
        }
        drop(goals);
        self.publish_status();
        for request in requests {
            let op = CancelActionGoal {
                id: request.into(),
                action: (&*self.written).into(),
            };
            client.send(op.into(), print_format(self.compression));
        }
    }

    /// Passes on how the goal that the client calls `request` gets on.
    pub(super) fn publish_feedback(&self, request: &str, body: &[u8]) -> Result<(), String> {
        let state = {
            let goals = self.goals.lock();
            let served = goals
                .values()
                .find(|served| served.request == request && served.ended.is_none());
            served
                .ok_or_else(|| no_such_goal(&self.name, request))?
                .state
                .clone()
        };
        self.feedback
            .publish(actionlib::write_state(Time::now(), &state, body));
        Ok(())
    }

    /// Ends the goal that the client calls `request`.
    pub(super) fn end_goal(
        &self,
        request: &str,
        status: Status,
        text: &str,
        body: &[u8],
    ) -> Result<(), String> {
        let mut goals = self.goals.lock();
        let served = goals
            .values_mut()
            .find(|served| served.request == request && served.ended.is_none());
        let served = served.ok_or_else(|| no_such_goal(&self.name, request))?;
        served.state.status = status;
        served.state.text = text.to_owned();
        served.ended = Some(Instant::now());
        let state = served.state.clone();
        drop(goals);
        self.publish_result(&state, body);
        self.publish_status();
        Ok(())
    }

    fn publish_result(&self, state: &GoalState, body: &[u8]) {
        self.result
            .publish(actionlib::write_state(Time::now(), state, body));
    }

    fn publish_status(&self) {
        let mut goals = self.goals.lock();
        goals.retain(|_, served| {
            served
                .ended
                .is_none_or(|ended| ended.elapsed() < STATUS_KEPT)
        });
        let states: Vec<_> = goals.values().map(|served| served.state.clone()).collect();
        drop(goals);
        self.status
            .publish(actionlib::write_states(Time::now(), states.iter()));
    }
}

impl Drop for ActionServer {
    fn drop(&mut self) {
        let body = vec![0; self.def.result.min_size()];
        for served in self
            .goals
            .get_mut()
            .values_mut()
            .filter(|served| served.ended.is_none())
        {
            served.state.status = Status::Aborted;
            served.state.text = "the client that serves this action is gone".to_owned();
            self.result
                .publish(actionlib::write_state(Time::now(), &served.state, &body));
        }
    }
}

async fn tick(server: Weak<ActionServer>, stop: CancellationToken) {
    let mut period = tokio::time::interval(STATUS_PERIOD);
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = period.tick() => match server.upgrade() {
                Some(server) => server.publish_status(),
                None => return,
            },
        }
    }
}

fn no_such_goal(action: &str, request: &str) -> String {
    format!("action {action} has no goal with id {request:?} under way")
}
