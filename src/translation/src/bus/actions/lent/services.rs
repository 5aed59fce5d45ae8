//! A server of ROS 2 on the robot, whose services are lent one by one.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{
    ActionEndpoint, BusError, FailureReason, GoalError, GoalEvents, Lender, MessageSender, PeerId, SerializedMessage,
    ServiceHandler, ServiceType, WireType, message_queue,
};
use ros::ros2::actions::ActionInterfaces;
use ros::ros2::actions::goal_client::{ActionCalls, GoalClient};
use ros::schema::ActionDef;
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};
use tracing::Instrument;

/// Pause before a server that was not found is looked for again.
const AGAIN: Duration = Duration::from_secs(1);
/// Queue length for feedback while goals' events are delivered.
const QUEUE: usize = 100;

/// The services of one action, and the goals sent to it.
pub(super) struct RobotServices {
    name: String,
    of: Arc<ActionDef>,
    parts: ActionInterfaces,
    lender: watch::Receiver<Option<Arc<dyn Lender>>>,
    connected: Mutex<Option<ConnectedServer>>,
}

/// A server that was found.
struct ConnectedServer {
    goals: Arc<GoalClient<LentCalls>>,
    feedback: MessageSender,
    wire_type: Arc<WireType>,
    /// Each becomes true when its service is gone.
    gone: [watch::Receiver<bool>; 3],
}

/// A service that was found.
struct LentPart {
    handler: Arc<dyn ServiceHandler>,
    gone: watch::Receiver<bool>,
}

/// The services that were found.
struct LentParts {
    send_goal: LentPart,
    get_result: LentPart,
    cancel_goal: LentPart,
}

impl RobotServices {
    pub(super) fn new(
        action: &str,
        of: &Arc<ActionDef>,
        lender: watch::Receiver<Option<Arc<dyn Lender>>>,
    ) -> Result<Self, BusError> {
        let parts = ActionInterfaces::for_action(action, of)?;
        Ok(Self { name: action.to_owned(), of: Arc::clone(of), parts, lender, connected: Mutex::default() })
    }

    /// Returns the type of a topic.
    pub(super) fn wire_type(&self, end: ActionEndpoint) -> Option<&WireType> {
        match end {
            ActionEndpoint::Feedback => Some(&self.parts.feedback.1),
            ActionEndpoint::Status => Some(&self.parts.status.1),
            _ => None,
        }
    }

    /// Looks for a server on behalf of the first of these nodes until there is one.
    pub(super) async fn connect(&self, clients: &watch::Sender<Vec<String>>, report: impl Fn(&str)) {
        loop {
            let client = clients.borrow().first().cloned().unwrap_or_default();
            match self.find(&client).await {
                Ok(Some(parts)) => return self.begin(client, parts),
                Ok(None) => {}
                Err(error) => report(&error.to_string()),
            }
            sleep(AGAIN).await;
        }
    }

    /// Finds the services on behalf of a node.
    async fn find(&self, client: &str) -> Result<Option<LentParts>, BusError> {
        let lender = self.lender.clone().wait_for(Option::is_some).await.ok().and_then(|lender| lender.clone());
        let Some(lender) = lender else {
            return Ok(None);
        };
        let ActionInterfaces { send_goal, get_result, cancel_goal, .. } = &self.parts;
        let Some(send_goal) = find_part(&*lender, send_goal, client).await? else {
            return Ok(None);
        };
        let Some(get_result) = find_part(&*lender, get_result, client).await? else {
            return Ok(None);
        };
        let cancel_goal = find_part(&*lender, cancel_goal, client).await?;
        Ok(cancel_goal.map(|cancel_goal| LentParts { send_goal, get_result, cancel_goal }))
    }

    fn begin(&self, client: String, parts: LentParts) {
        let gone = [&parts.send_goal, &parts.get_result, &parts.cancel_goal].map(|part| part.gone.clone());
        let (feedback, heard) = message_queue(QUEUE);
        let calls = LentCalls { name: self.name.clone(), client, parts, runtime: Handle::current() };
        let goals = Arc::new(GoalClient::new(&self.name, &self.of, calls, heard));
        let wire_type = Arc::new(self.parts.feedback.1.clone());
        *self.connected.lock() = Some(ConnectedServer { goals, feedback, wire_type, gone });
    }

    /// Waits until a service of the server is gone.
    pub(super) async fn wait_until_gone(&self) {
        let gone = self.connected.lock().as_ref().map(|server| server.gone.clone());
        let Some([send_goal, get_result, cancel_goal]) = gone else {
            return;
        };
        tokio::select! {
            () = wait_gone(send_goal) => {}
            () = wait_gone(get_result) => {}
            () = wait_gone(cancel_goal) => {}
        }
    }

    /// Cancels all goals and forgets the server.
    pub(super) fn disconnect(&self) {
        let server = self.connected.lock().take();
        drop(server);
    }

    pub(super) fn send_goal(&self, id: &str, goal: &[u8], events: Arc<dyn GoalEvents>) -> Result<(), FailureReason> {
        let goals = self.goals().ok_or_else(|| FailureReason::new("the robot's server is gone"))?;
        goals.send_goal(id, goal, events);
        Ok(())
    }

    pub(super) fn cancel_goal(&self, id: &str) {
        if let Some(goals) = self.goals() {
            goals.cancel_goal(id);
        }
    }

    fn goals(&self) -> Option<Arc<GoalClient<LentCalls>>> {
        self.connected.lock().as_ref().map(|server| Arc::clone(&server.goals))
    }

    /// Receives a message of the robot's server. Its status says nothing that its answers do not.
    pub(super) fn on_message(&self, end: ActionEndpoint, bytes: Bytes) {
        if end != ActionEndpoint::Feedback {
            return;
        }
        if let Some(server) = &*self.connected.lock() {
            server.feedback.send(SerializedMessage {
                bytes,
                wire_type: Arc::clone(&server.wire_type),
                publisher: PeerId::from(&*self.name),
                latching: false,
            });
        }
    }
}

/// Finds one service; fails if it has another type.
async fn find_part(
    lender: &dyn Lender,
    (service, of): &(String, ServiceType),
    client: &str,
) -> Result<Option<LentPart>, BusError> {
    // A service that has just gone counts as not found.
    let found = lender.find_service(service, client).await.filter(|lent| !*lent.gone.borrow());
    let Some(lent) = found else {
        return Ok(None);
    };
    if !lent.service_type.matches(of) {
        return Err(lent.service_type.mismatch(of, format!("service {service}")));
    }
    Ok(Some(LentPart { handler: lent.handler, gone: lent.gone }))
}

async fn wait_gone(mut gone: watch::Receiver<bool>) {
    // If the sender is gone, the service is no longer available either.
    drop(gone.wait_for(|gone| *gone).await);
}

/// Calls the services of a robot's server.
struct LentCalls {
    name: String,
    /// Node of the servant in whose name it is called.
    client: String,
    parts: LentParts,
    runtime: Handle,
}

#[async_trait]
impl ActionCalls for LentCalls {
    async fn call(&self, end: ActionEndpoint, request: Bytes, patience: Duration) -> Result<Bytes, GoalError> {
        let part = match end {
            ActionEndpoint::SendGoal => &self.parts.send_goal,
            ActionEndpoint::CancelGoal => &self.parts.cancel_goal,
            _ => &self.parts.get_result,
        };
        match timeout(patience, part.handler.call(request, &self.client)).await {
            Ok(answer) => answer.map_err(GoalError::GivenUp),
            Err(_) => Err(BusError::Timeout { what: format!("action {}", self.name), after: patience }.into()),
        }
    }

    fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        self.runtime.spawn(task.in_current_span()).abort_handle()
    }
}
