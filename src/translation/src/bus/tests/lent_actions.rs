//! Goals of the servant's nodes at servers of a robot of the other ROS.

use ros::bus::{
    ActionClient, ActionEndpoint, GoalEnd, GoalError, GoalEvents, GoalOutcome, Publisher, split_action_endpoint,
};
use ros::codec::Time;
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId, GoalState};
use ros::ros2::actions::goal_services::GoalServices;
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

use super::actions::count;
use super::*;

/// An id as clients of ROS 2 make them.
const UUID: &str = "00112233-4455-6677-8899-aabbccddeeff";
const QOS: QosProfile = QosProfile::keep_last(100);

/// An event that is reported to a goal's sender.
#[derive(Debug, PartialEq)]
enum Told {
    Waiting,
    Accepted,
    Feedback(Value),
    Ended(GoalOutcome, Value),
    /// With the words for people.
    Rejected(String),
    Lost(String),
}

struct GoalSender {
    version: RosVersion,
    told: mpsc::UnboundedSender<Told>,
}

impl GoalEvents for GoalSender {
    fn on_waiting(&self) {
        let _ = self.told.send(Told::Waiting);
    }

    fn on_accepted(&self) {
        let _ = self.told.send(Told::Accepted);
    }

    fn on_feedback(&self, feedback: Bytes) {
        let _ = self.told.send(Told::Feedback(parse(&count(self.version).feedback, &feedback)["part"].clone()));
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let _ = self.told.send(match end {
            Ok(GoalEnd { outcome: GoalOutcome::Rejected, text, .. }) => Told::Rejected(text),
            Ok(GoalEnd { outcome: GoalOutcome::Aborted, text, .. }) => Told::Lost(text),
            Ok(end) => Told::Ended(end.outcome, parse(&count(self.version).result, &end.result)["sum"].clone()),
            Err(error) => Told::Lost(error.to_string()),
        });
    }
}

/// A client of a node of the servant.
struct ServantClient {
    version: RosVersion,
    client: Box<dyn ActionClient>,
}

impl ServantClient {
    fn new(node: &dyn Bus) -> Self {
        let version = node.version();
        Self { version, client: node.action_client("/count", &count(version)).expect("a client") }
    }

    fn send(&self, id: &str, order: i32) -> mpsc::UnboundedReceiver<Told> {
        let (told, tells) = mpsc::unbounded_channel();
        let goal = serialize(&count(self.version).goal, &json!({ "order": order }));
        self.client.send_goal(id, goal, Arc::new(GoalSender { version: self.version, told }));
        tells
    }

    async fn wait_for_server(&self) {
        self.client.wait_for_server(LONG).await.expect("the robot's server");
    }
}

async fn next_told(told: &mut mpsc::UnboundedReceiver<Told>) -> Told {
    timeout(LONG, told.recv()).await.expect("it is told").expect("the goal is there")
}

/// Returns what is told first beside that the goal waits, which a server of ROS 1 says until it accepts the goal.
async fn next_told_after_waiting(told: &mut mpsc::UnboundedReceiver<Told>) -> Told {
    loop {
        let next = next_told(told).await;
        if next != Told::Waiting {
            return next;
        }
    }
}

/// A server of ROS 1 on the robot, whose topics a link carries.
struct TopicServer {
    goals: Subscription,
    cancels: Subscription,
    feedback: Box<dyn Publisher>,
    result: Box<dyn Publisher>,
    status: Box<dyn Publisher>,
}

impl TopicServer {
    async fn new(bus: &TranslatedBus) -> Self {
        let of = count(RosVersion::One);
        let wire = |part: &Arc<MessageType>| WireType::from_message(part);
        let status = Registry::new().message("actionlib_msgs/GoalStatusArray").expect("known to all");
        Self {
            goals: bus.subscribe("/count/goal", WireType::any(), QOS).await.expect("a topic"),
            cancels: bus.subscribe("/count/cancel", WireType::any(), QOS).await.expect("a topic"),
            feedback: bus.advertise("/count/feedback", wire(&of.action_feedback), QOS).await.expect("a topic"),
            result: bus.advertise("/count/result", wire(&of.action_result), QOS).await.expect("a topic"),
            status: bus.advertise("/count/status", wire(&status), QOS).await.expect("a topic"),
        }
    }

    /// Returns the id and the order of the next goal.
    async fn next_goal(&mut self) -> (String, Value) {
        let message = next(&mut self.goals).await;
        assert_eq!(message.publisher.node(), "/see", "links pass on what their nodes send");
        let (id, goal) = messages::read_goal(&message.bytes).expect("a goal");
        (id.id, parse(&count(RosVersion::One).goal, &goal)["order"].clone())
    }

    fn write(&self, id: &str, status: ActionlibStatus, body: &[u8]) -> Bytes {
        let goal = GoalId { id: id.to_owned(), ..GoalId::default() };
        messages::write_state(Time::default(), &GoalState { goal, status, text: "why".to_owned() }, body)
    }

    fn publish_feedback(&self, id: &str, part: i32) {
        let body = serialize(&count(RosVersion::One).feedback, &json!({ "part": part }));
        self.feedback.publish(self.write(id, ActionlibStatus::Active, &body));
    }

    fn publish_status(&self, id: &str, status: ActionlibStatus) {
        let goal = GoalId { id: id.to_owned(), ..GoalId::default() };
        let state = GoalState { goal, status, text: String::new() };
        self.status.publish(messages::write_states(Time::default(), std::iter::once(&state)));
    }

    fn end(&self, id: &str, status: ActionlibStatus, sum: i32) {
        let body = serialize(&count(RosVersion::One).result, &json!({ "sum": sum }));
        self.result.publish(self.write(id, status, &body));
    }
}

/// Returns the bus of a robot of ROS 1, and a client in the servant of ROS 2 that the robot sees.
async fn client_of_ros2() -> (Arc<TranslatedBus>, Arc<RecordedLosses>, ServantClient, Arc<MemoryBus>) {
    let (bus, losses, node) = servant_of_ros2();
    let client = ServantClient::new(&*node);
    wait_graph(&*bus, |graph| graph.actions.contains_key("/count")).await;
    (bus, losses, client, node)
}

#[tokio::test]
async fn a_node_of_ros_2_has_goals_carried_out_by_a_server_of_ros_1() {
    let (bus, losses, client, _node) = client_of_ros2().await;
    let graph = bus.graph().borrow().clone();
    assert_eq!(graph.topics["/count/goal"].publishers, ["/see"]);
    assert_eq!(graph.topics["/count/status"].subscribers, ["/see"]);
    assert!(graph.actions["/count"].servers.is_empty() && bus.left_out().borrow().is_empty());
    let mut robot = TopicServer::new(&bus).await;
    client.wait_for_server().await;
    wait_graph(&*bus, |graph| graph.actions["/count"].servers == ["/bridge"]).await;
    let mut told = client.send(UUID, 7);
    assert_eq!(robot.next_goal().await, (UUID.to_owned(), json!(7)));
    assert!(told.is_empty(), "the robot's server has not answered it");
    robot.publish_status(UUID, ActionlibStatus::Pending);
    assert_eq!(next_told(&mut told).await, Told::Waiting);
    robot.publish_feedback(UUID, 3);
    assert_eq!(next_told(&mut told).await, Told::Accepted);
    assert_eq!(next_told(&mut told).await, Told::Feedback(json!(3)));
    robot.end(UUID, ActionlibStatus::Succeeded, 9);
    assert_eq!(next_told(&mut told).await, Told::Ended(GoalOutcome::Succeeded, json!(9)));
    // One that is cancelled, beside one that the server rejects.
    let (mut cancelled, mut rejected) = (client.send("one", 1), client.send("two", 2));
    client.client.cancel_goal("one");
    let cancel = messages::read_cancel(&next(&mut robot.cancels).await.bytes).expect("a cancel");
    assert_eq!(cancel.id, "one");
    robot.end("one", ActionlibStatus::Preempted, 4);
    robot.end("two", ActionlibStatus::Rejected, 0);
    assert_eq!(next_told(&mut cancelled).await, Told::Ended(GoalOutcome::Canceled, json!(4)));
    assert_eq!(next_told(&mut rejected).await, Told::Rejected("why".to_owned()));
    assert!(losses.0.lock().is_empty());
}

#[tokio::test(start_paused = true)]
async fn goals_end_with_the_robots_server_of_ros_1_and_another_one_takes_new_ones() {
    let (bus, _, client, _node) = client_of_ros2().await;
    let robot = TopicServer::new(&bus).await;
    client.wait_for_server().await;
    let mut told = client.send("one", 1);
    drop(robot);
    assert_eq!(next_told(&mut told).await, Told::Lost("action server /count is gone".to_owned()));
    wait_graph(&*bus, |graph| graph.actions["/count"].servers.is_empty()).await;
    let mut robot = TopicServer::new(&bus).await;
    client.wait_for_server().await;
    let _told = client.send("two", 2);
    assert_eq!(robot.next_goal().await, ("two".to_owned(), json!(2)));
}

#[tokio::test(start_paused = true)]
async fn a_goal_that_the_robots_server_does_not_answer_is_cancelled_and_rejected() {
    let (bus, _, client, _node) = client_of_ros2().await;
    let mut robot = TopicServer::new(&bus).await;
    client.wait_for_server().await;
    let (mut answered, mut silent) = (client.send("one", 1), client.send("two", 2));
    robot.next_goal().await;
    robot.publish_status("one", ActionlibStatus::Active);
    assert_eq!(next_told(&mut answered).await, Told::Accepted);
    let rejected = Told::Rejected("the robot's server did not answer it in 60 s".to_owned());
    assert_eq!(next_told(&mut silent).await, rejected);
    let cancel = messages::read_cancel(&next(&mut robot.cancels).await.bytes).expect("a cancel");
    assert_eq!(cancel.id, "two");
    assert!(answered.is_empty(), "it is executed for as long as it takes");
}

#[tokio::test]
async fn goals_are_cancelled_on_the_robot_when_nobody_waits_for_them() {
    let (bus, _, client, _node) = client_of_ros2().await;
    let mut robot = TopicServer::new(&bus).await;
    client.wait_for_server().await;
    let _told = client.send("one", 1);
    robot.next_goal().await;
    drop(client);
    let cancel = messages::read_cancel(&next(&mut robot.cancels).await.bytes).expect("a cancel");
    assert_eq!(cancel.id, "one");
}

#[tokio::test]
async fn goals_under_way_on_the_robot_are_bounded() {
    let (bus, _, client, _node) = client_of_ros2().await;
    let robot = TopicServer::new(&bus).await;
    client.wait_for_server().await;
    let mut all: Vec<_> = (0..257).map(|number| client.send(&number.to_string(), number)).collect();
    let refused = next_told(&mut all[256]).await;
    assert!(matches!(&refused, Told::Rejected(text) if text.contains("256 goals")), "{refused:?}");
    robot.end("0", ActionlibStatus::Succeeded, 1);
    next_told(&mut all[0]).await;
    let mut next = client.send("next", 1);
    robot.publish_feedback("next", 5);
    assert_eq!(next_told(&mut next).await, Told::Accepted);
    assert_eq!(next_told(&mut next).await, Told::Feedback(json!(5)));
}

#[tokio::test]
async fn a_server_of_another_type_is_not_used_and_the_robot_is_told() {
    let (bus, losses, _client, _node) = client_of_ros2().await;
    let refused = bus.advertise("/count/result", string(RosVersion::One), QOS).await.err();
    assert!(matches!(refused, Some(BusError::TypeMismatch { .. })), "{refused:?}");
    let told = losses.0.lock().clone();
    assert!(told.len() == 1 && told[0].contains("action /count of the robot cannot be used"), "{told:?}");
}

/// A request to a ROS 2 server on the robot.
enum Asked {
    Goal(String, Bytes, Arc<dyn GoalEvents>),
    Cancel(String),
}

/// Executes the goals of such a server, which the test plays.
struct Played(mpsc::UnboundedSender<Asked>);

#[async_trait]
impl ActionClient for Played {
    async fn wait_for_server(&self, _: Duration) -> Result<(), BusError> {
        Ok(())
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        let _ = self.0.send(Asked::Goal(id.to_owned(), goal, events));
    }

    fn cancel_goal(&self, id: &str) {
        let _ = self.0.send(Asked::Cancel(id.to_owned()));
    }
}

/// A server of ROS 2 on the robot, whose services are lent.
struct ServiceServer {
    services: Arc<GoalServices<Played>>,
    gone: watch::Sender<bool>,
}

/// One of its services.
struct Part {
    services: Arc<GoalServices<Played>>,
    end: ActionEndpoint,
}

#[async_trait]
impl ServiceHandler for Part {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        assert_eq!(caller, "/see");
        let answer = self.services.call((self.end, "/count"), &Digest::any(), request, LONG).await;
        answer.map_err(|error| FailureReason::new(error.to_string()))
    }
}

#[async_trait]
impl Lender for ServiceServer {
    async fn find_service(&self, service: &str, _node: &str) -> Option<LentService> {
        let (action, end) = split_action_endpoint(RosVersion::Two, service)?;
        assert_eq!(action, "/count");
        let services = Arc::clone(&self.services);
        let service_type = services.service_type(end).clone();
        Some(LentService { service_type, handler: Arc::new(Part { services, end }), gone: self.gone.subscribe() })
    }
}

#[tokio::test]
async fn a_node_of_ros_1_has_goals_carried_out_by_a_server_of_ros_2() {
    let (bus, _, node) = servant_of_ros1().await;
    let client = ServantClient::new(&*node);
    // The robot is shown what a client of its own ROS subscribes to.
    let feedback = "/count/_action/feedback";
    let subscribes = |graph: &Graph| graph.ends.get("/see").is_some_and(|ends| ends.subscribers.contains_key(feedback));
    wait_graph(&*bus, subscribes).await;
    let (asks, mut asked) = mpsc::unbounded_channel();
    let of = count(RosVersion::Two);
    let budget = Budget::without_limit();
    let services = GoalServices::new(("/count", "/arm"), &of, Played(asks), &budget, Arc::new(|_: String| {}));
    let services = services.expect("an action");
    let mut published = services.subscribe(ActionEndpoint::Feedback, &WireType::any(), QOS).expect("a topic");
    let carried = bus.advertise(feedback, WireType::from_message(&of.action_feedback), QOS).await.expect("a topic");
    let _carrying = AbortOnDropHandle::new(tokio::spawn(async move {
        while let Some(message) = published.messages.recv().await {
            carried.publish(message.bytes);
        }
    }));
    let gone = watch::Sender::new(false);
    bus.lend_actions(Arc::new(ServiceServer { services, gone: gone.clone() }));
    client.wait_for_server().await;
    let mut ask = async || timeout(LONG, asked.recv()).await.expect("it is asked").expect("a server");
    let sum = |sum: i32| serialize(&of.result, &json!({ "sum": sum }));
    let end = |outcome, result| Ok(GoalEnd { outcome, text: String::new(), result });
    // Clients of ROS 1 make ids of their own kind.
    let mut told = client.send("/see-1-12.5", 7);
    let Asked::Goal(_, goal, events) = ask().await else { panic!("it is a goal") };
    assert_eq!(parse(&of.goal, &goal), json!({ "order": 7 }));
    let is_answered = std::iter::from_fn(|| told.try_recv().ok()).any(|told| told != Told::Waiting);
    assert!(!is_answered, "the robot's server has not answered it");
    events.on_accepted();
    assert_eq!(next_told_after_waiting(&mut told).await, Told::Accepted);
    events.on_feedback(serialize(&of.feedback, &json!({ "part": 3 })));
    assert_eq!(next_told_after_waiting(&mut told).await, Told::Feedback(json!(3)));
    events.on_ended(end(GoalOutcome::Succeeded, sum(9)));
    assert_eq!(next_told_after_waiting(&mut told).await, Told::Ended(GoalOutcome::Succeeded, json!(9)));
    // A UUID stays what it is.
    let mut told = client.send(UUID, 8);
    let Asked::Goal(id, _, events) = ask().await else { panic!("it is a goal") };
    assert_eq!(id, UUID);
    events.on_accepted();
    assert_eq!(next_told_after_waiting(&mut told).await, Told::Accepted);
    client.client.cancel_goal(UUID);
    let Asked::Cancel(id) = ask().await else { panic!("it is a cancel") };
    assert_eq!(id, UUID);
    events.on_cancel_response(true);
    events.on_ended(end(GoalOutcome::Canceled, sum(4)));
    assert_eq!(next_told_after_waiting(&mut told).await, Told::Ended(GoalOutcome::Canceled, json!(4)));
    let mut told = client.send("rejected", 9);
    let Asked::Goal(_, _, events) = ask().await else { panic!("it is a goal") };
    events.on_ended(end(GoalOutcome::Rejected, Bytes::new()));
    assert_eq!(
        next_told_after_waiting(&mut told).await,
        Told::Rejected("the robot's server did not accept it".to_owned())
    );
    // Goals end with the server.
    let mut told = client.send("last", 9);
    let Asked::Goal(_, _, events) = ask().await else { panic!("it is a goal") };
    events.on_accepted();
    assert_eq!(next_told_after_waiting(&mut told).await, Told::Accepted);
    gone.send_replace(true);
    let lost = next_told_after_waiting(&mut told).await;
    assert!(matches!(&lost, Told::Lost(text) if text.contains("gone")), "{lost:?}");
}
