//! Client of an action over DDS.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros_bus::{
    ActionClient, ActionEndpoint, BusError, CallFate, GoalError, GoalEvents, MessageSender, PeerId, SerializedMessage,
    ServiceType, WireType, message_queue,
};
use ros_message::schema::ActionDef;
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::goal_client::{ActionCalls, GoalClient};
use super::{ActionInterfaces, QUEUE};
use crate::calls;
use crate::client::ServiceClient;
use crate::raw::{self, RawListener, RawReader};
use crate::state::Ros2BusState;

/// Time after which a server that does not acknowledge our feedback reader is assumed to know it.
const UNSURE: Duration = Duration::from_millis(200);
/// Grace period for a server that was there a moment ago.
const GRACE: Duration = Duration::from_secs(3);

/// A client of one action.
pub(crate) struct Ros2ActionClient {
    goals: GoalClient<ServerParts>,
    feedback: RawReader,
}

/// The services of the servers.
struct ServerParts {
    bus: Arc<Ros2BusState>,
    name: String,
    of: Arc<ActionDef>,
    send_goal: Arc<ServiceClient>,
    get_result: Arc<ServiceClient>,
    cancel_goal: Arc<ServiceClient>,
}

impl Ros2ActionClient {
    /// Opens the action's services and topics; servers are discovered in the background.
    pub(crate) fn open(bus: &Arc<Ros2BusState>, name: &str, of: &Arc<ActionDef>) -> Result<Self, BusError> {
        bus.check_open()?;
        let parts = ActionInterfaces::for_action(name, of)?;
        let client = |(service, of): (String, ServiceType)| calls::client_for(bus, &service, &of);
        let (queue, heard) = message_queue(QUEUE);
        let (topic, wire_type) = parts.feedback;
        let wire_type = Arc::new(wire_type);
        let ear = Arc::new(FeedbackSink { queue, wire_type: Arc::clone(&wire_type), publisher: PeerId::from(name) });
        let qos = ActionInterfaces::feedback_qos();
        let services = ServerParts {
            bus: bus.clone(),
            name: name.to_owned(),
            of: of.clone(),
            send_goal: client(parts.send_goal)?,
            get_result: client(parts.get_result)?,
            cancel_goal: client(parts.cancel_goal)?,
        };
        let feedback = raw::reader(bus, &topic, &wire_type, &qos, ear)?;
        Ok(Self { goals: GoalClient::new(name, of, services, heard), feedback })
    }
}

#[async_trait]
impl ActionClient for Ros2ActionClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        let parts = self.goals.calls();
        let ready = async {
            tokio::try_join!(
                parts.send_goal.wait_until_ready(patience),
                parts.get_result.wait_until_ready(patience),
                parts.cancel_goal.wait_until_ready(patience),
            )?;
            self.feedback.wait_for_writer(UNSURE).await;
            Ok(())
        };
        match timeout(patience, ready).await {
            Ok(Err(BusError::Timeout { .. })) | Err(_) => {
                Err(BusError::Timeout { what: format!("action {}", parts.name), after: patience })
            }
            Ok(Err(of_part @ BusError::TypeMismatch { .. })) => Err(parts.type_mismatch().unwrap_or(of_part)),
            Ok(ready) => ready,
        }
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        self.goals.send_goal(id, &goal, events);
    }

    /// The server is asked as soon as it has accepted the goal.
    fn cancel_goal(&self, id: &str) {
        self.goals.cancel_goal(id);
    }
}

#[async_trait]
impl ActionCalls for ServerParts {
    async fn call(&self, end: ActionEndpoint, request: Bytes, patience: Duration) -> Result<Bytes, GoalError> {
        let part = match end {
            ActionEndpoint::SendGoal => &self.send_goal,
            ActionEndpoint::CancelGoal => &self.cancel_goal,
            _ => &self.get_result,
        };
        if end != ActionEndpoint::CancelGoal {
            // The call itself would wait for a later server, which must not be given an old goal.
            let mut servers = part.servers();
            let there = servers.wait_for(|servers| servers.count() > 0);
            if timeout(GRACE, there).await.is_err() {
                return Err(GoalError::NoServer(self.name.clone()));
            }
        }
        let answer = part.call(request, patience).await;
        answer.map_err(|error| match error {
            BusError::CallFailed { fate: CallFate::Unknown, .. } => GoalError::ServerGone(self.name.clone()),
            other => other.into(),
        })
    }

    fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        self.bus.spawn(task)
    }

    fn check_open(&self) -> Result<(), BusError> {
        self.bus.check_open()
    }
}

impl ServerParts {
    /// Returns the error if the server has another type, under the action's name: the type of a part is
    /// `Fibonacci_SendGoal`.
    fn type_mismatch(&self) -> Option<BusError> {
        let services = self.of.services.as_ref()?;
        let parts = [(&self.send_goal, &services.send_goal), (&self.get_result, &services.get_result)];
        parts.into_iter().find_map(|(part, ours)| {
            let of_action = |of: ServiceType| {
                let name = of.name.rsplit_once('_').map(|(action, _)| action.to_owned());
                ServiceType { name: name.unwrap_or_default(), ..of }
            };
            let theirs = of_action(part.mismatched_type()?);
            let what = format!("action {}", self.name);
            Some(theirs.mismatch(&of_action(ServiceType::from_service(ours)), what))
        })
    }
}

/// Queues feedback while the participant calls; it is delivered later.
struct FeedbackSink {
    queue: MessageSender,
    wire_type: Arc<WireType>,
    publisher: PeerId,
}

impl RawListener for FeedbackSink {
    fn on_message(&self, payload: Bytes) {
        self.queue.send(SerializedMessage {
            bytes: payload,
            wire_type: self.wire_type.clone(),
            publisher: self.publisher.clone(),
            latching: false,
        });
    }
}
