//! A robot of ROS 1 at a server of ROS 2.

use super::*;

const QOS: QosProfile = QosProfile::keep_last(100);

/// An actionlib client of the robot.
struct Robot {
    goal: Box<dyn Publisher>,
    cancel: Box<dyn Publisher>,
    status: Subscription,
    feedback: Subscription,
    result: Subscription,
}

impl Robot {
    async fn new(world: &World) -> Robot {
        let topic = |part: &str| format!("/count/{part}");
        let any = WireType::any;
        let bus = &world.bus;
        Robot {
            goal: bus.advertise(&topic("goal"), any(), QOS).await.expect("a topic"),
            cancel: bus.advertise(&topic("cancel"), any(), QOS).await.expect("a topic"),
            status: bus.subscribe(&topic("status"), any(), QOS).await.expect("a topic"),
            feedback: bus.subscribe(&topic("feedback"), any(), QOS).await.expect("a topic"),
            result: bus.subscribe(&topic("result"), any(), QOS).await.expect("a topic"),
        }
    }

    fn send_bytes(&self, id: &str, body: &[u8]) {
        let goal = GoalId { id: id.to_owned(), ..GoalId::default() };
        self.goal.publish(messages::write_goal(Time::default(), &goal, body));
    }

    fn send(&self, id: &str) {
        self.send_bytes(id, &number(RosVersion::One, 7));
    }

    fn cancel_goal(&self, id: &str) {
        self.cancel.publish(messages::write_cancel(&GoalId { id: id.to_owned(), ..GoalId::default() }));
    }

    /// Returns the next result: id, status, text and the result itself.
    async fn next_result(&mut self) -> (String, ActionlibStatus, String, Bytes) {
        let message = timeout(PATIENCE, self.result.messages.recv()).await.expect("it comes").expect("a result");
        let (state, body) = messages::read_state(&message.bytes).expect("a result");
        (state.goal.id, state.status, state.text, body)
    }

    /// Returns the status of a goal that was published last.
    fn status(&mut self, id: &str) -> Option<ActionlibStatus> {
        let last = drain(&mut self.status.messages).pop().expect("a status");
        let states = messages::read_states(&last).expect("a status").into_iter();
        states.map(|state| (state.goal.id, state.status)).find(|(of, _)| of == id).map(|(_, status)| status)
    }
}

#[tokio::test]
async fn goals_feedback_and_results_are_translated() {
    let world = World::new(RosVersion::Two);
    let mut robot = Robot::new(&world).await;
    robot.send("robot-1");
    assert_eq!(robot.status("robot-1"), Some(ActionlibStatus::Pending));
    let (goal, events) = world.server.goal("robot-1").await;
    assert_eq!(goal, number(RosVersion::Two, 7));
    events.on_accepted();
    assert_eq!(robot.status("robot-1"), Some(ActionlibStatus::Active));
    events.on_feedback(number(RosVersion::Two, 3));
    let heard = robot.feedback.messages.try_recv().expect("feedback");
    assert_eq!((heard.publisher.node(), &*heard.wire_type.name), ("/counter", "x_msgs/CountActionFeedback"));
    let (state, body) = messages::read_state(&heard.bytes).expect("feedback");
    assert_eq!((&*state.goal.id, body), ("robot-1", number(RosVersion::One, 3)));
    events.on_ended(end(RosVersion::Two, GoalOutcome::Succeeded));
    let expected = ("robot-1".to_owned(), ActionlibStatus::Succeeded, String::new(), number(RosVersion::One, 9));
    assert_eq!(robot.next_result().await, expected);
}

#[tokio::test]
async fn ends_become_those_of_actionlib() {
    let world = World::new(RosVersion::Two);
    let mut robot = Robot::new(&world).await;
    let gone = || Err(GoalError::ServerGone("/count".to_owned()));
    let ended = |outcome| end(RosVersion::Two, outcome);
    for (number, (accepted, end, expected)) in [
        (true, ended(GoalOutcome::Succeeded), ActionlibStatus::Succeeded),
        (true, ended(GoalOutcome::Canceled), ActionlibStatus::Preempted),
        (true, ended(GoalOutcome::Aborted), ActionlibStatus::Aborted),
        (true, ended(GoalOutcome::Unknown), ActionlibStatus::Aborted),
        (true, gone(), ActionlibStatus::Aborted),
        (false, ended(GoalOutcome::Rejected), ActionlibStatus::Rejected),
        (false, ended(GoalOutcome::Canceled), ActionlibStatus::Recalled),
        (false, gone(), ActionlibStatus::Aborted),
        // The result is there before the answer to the goal.
        (false, ended(GoalOutcome::Succeeded), ActionlibStatus::Succeeded),
    ]
    .into_iter()
    .enumerate()
    {
        let id = number.to_string();
        robot.send(&id);
        let (_, events) = world.server.goal(&id).await;
        if accepted {
            events.on_accepted();
        }
        events.on_ended(end);
        let (of, status, ..) = robot.next_result().await;
        assert_eq!((of, status), (id, expected), "{number}");
    }
}

#[tokio::test]
async fn cancels_reach_the_server_and_goals_of_two_clients_do_not_meet() {
    let world = World::new(RosVersion::Two);
    let (mut one, mut two) = (Robot::new(&world).await, Robot::new(&world).await);
    one.send("one");
    two.send("two");
    let (first, second) = (world.server.goal("one").await.1, world.server.goal("two").await.1);
    // Before the server has answered.
    one.cancel_goal("one");
    world.server.wait_cancelled("one").await;
    assert_eq!(one.status("one"), Some(ActionlibStatus::Recalling));
    first.on_accepted();
    assert_eq!(two.status("one"), Some(ActionlibStatus::Preempting), "each sees all goals of the robot");
    first.on_cancel_response(true);
    second.on_accepted();
    first.on_ended(end(RosVersion::Two, GoalOutcome::Canceled));
    assert_eq!(one.next_result().await.1, ActionlibStatus::Preempted);
    assert_eq!(*world.server.cancelled.lock(), ["one"]);
    // All.
    one.cancel_goal("");
    world.server.wait_cancelled("two").await;
    second.on_ended(end(RosVersion::Two, GoalOutcome::Succeeded));
    two.next_result().await;
    assert_eq!(two.next_result().await.1, ActionlibStatus::Succeeded, "its server went on");
}

#[tokio::test]
async fn goals_wait_for_the_server_in_their_order_and_can_be_cancelled_until_then() {
    let world = World::starting(RosVersion::Two);
    let mut robot = Robot::new(&world).await;
    for id in ["a", "b", "c"] {
        robot.send(id);
    }
    robot.cancel_goal("b");
    assert_eq!(robot.next_result().await.1, ActionlibStatus::Recalled);
    assert!(world.server.goals.lock().is_empty());
    world.server.ready.send_replace(true);
    world.server.goal("c").await;
    assert_eq!(*world.server.order.lock(), ["a", "c"]);
}

#[tokio::test]
async fn goals_that_wait_for_the_server_are_charged_to_the_robot() {
    let budget = Budget::new("the robot", 8 << 10);
    let world = World::with_budget(RosVersion::Two, &budget);
    let mut robot = Robot::new(&world).await;
    (0..100).for_each(|number| robot.send(&number.to_string()));
    let (id, status, text, _) = robot.next_result().await;
    assert_eq!(status, ActionlibStatus::Rejected);
    assert!(text.contains("the goals and results of actions"), "{id}: {text}");
    let waiting = budget.used_bytes();
    world.server.ready.send_replace(true);
    let first_refused: usize = id.parse().expect("a number");
    world.server.goal(&(first_refused - 1).to_string()).await;
    assert!(budget.used_bytes() < waiting / 2, "{} of {waiting}", budget.used_bytes());
}

#[tokio::test(start_paused = true)]
async fn a_goal_without_a_server_is_aborted_after_a_while() {
    let world = World::starting(RosVersion::Two);
    let mut robot = Robot::new(&world).await;
    robot.send("lost");
    let (_, status, text, _) = robot.next_result().await;
    assert_eq!((status, &*text), (ActionlibStatus::Aborted, "action /count has no server"));
}

#[tokio::test]
async fn a_goal_that_cannot_be_carried_is_rejected_and_a_result_aborts_it() {
    let world = World::new(RosVersion::Two);
    let mut robot = Robot::new(&world).await;
    robot.send_bytes("torn", &[7]);
    let (_, status, text, body) = robot.next_result().await;
    assert_eq!((status, body), (ActionlibStatus::Rejected, number(RosVersion::One, 0)));
    assert!(text.starts_with("the goal is not carried to the other ROS"), "{text}");
    robot.send("one");
    let (_, events) = world.server.goal("one").await;
    events.on_accepted();
    events.on_feedback(Bytes::from_static(&[0, 1, 0, 0, 1]));
    let torn = Bytes::from_static(&[0, 1, 0, 0]);
    events.on_ended(Ok(GoalEnd { outcome: GoalOutcome::Succeeded, text: "done".to_owned(), result: torn }));
    let (_, status, text, _) = robot.next_result().await;
    assert!(status == ActionlibStatus::Aborted && text.ends_with("; done"), "{text}");
    assert!(robot.feedback.messages.is_empty());
    assert_eq!(world.bus.losses()[0].untranslated, 3);
    assert_eq!(world.notices.0.lock().len(), 1, "further ones are only counted");
}

#[tokio::test]
async fn the_graph_has_the_five_topics() {
    let world = World::new(RosVersion::Two);
    let graph = world.wait_for_graph(|graph| graph.actions.contains_key("/count")).await;
    assert!(world.bus.left_out().borrow().is_empty());
    let action = &graph.actions["/count"];
    assert_eq!((&*action.type_name, &*action.servers), ("x_msgs/Count", &["/counter".to_owned()][..]));
    assert_eq!(action.topics.len(), 5);
    let goal = &graph.topics["/count/goal"];
    assert_eq!((&*goal.type_name, &goal.subscribers), ("x_msgs/CountActionGoal", &vec!["/counter".to_owned()]));
    assert_eq!(goal.publishers, ["/user"], "the bus itself is no node of the servant");
    let status = &graph.topics["/count/status"];
    assert_eq!((&*status.type_name, &status.publishers), ("actionlib_msgs/GoalStatusArray", &goal.subscribers));
    let told = world.bus.topic_type("/count/result").await.expect("a type");
    assert_eq!(told.name, "x_msgs/CountActionResult");
    let refused = world.bus.advertise("/count/result", WireType::any(), QOS).await.err();
    assert!(refused.is_some_and(|error| error.to_string().contains("/count/result")));
}

#[tokio::test]
async fn topics_outlive_a_server_that_comes_back_but_not_its_type() {
    let world = World::new(RosVersion::Two);
    let mut robot = Robot::new(&world).await;
    world.servant.graph.send_replace(graph(RosVersion::Two, &[]));
    let has_no_server = |graph: &Graph| graph.actions.get("/count").is_some_and(|action| action.servers.is_empty());
    let shown = world.wait_for_graph(has_no_server).await;
    assert_eq!(shown.topics["/count/result"].subscribers, ["/user"], "a server of the robot may take its place");
    robot.send("meanwhile");
    let (_, events) = world.server.goal("meanwhile").await;
    events.on_ended(end(RosVersion::Two, GoalOutcome::Succeeded));
    assert_eq!(robot.next_result().await.0, "meanwhile");
    assert!(world.bus.subscribe("/count/result", WireType::any(), QOS).await.is_ok());
    robot.send("old");
    world.server.goal("old").await;
    let mut other = Graph::clone(&graph(RosVersion::Two, &["/counter"]));
    other.actions.get_mut("/count").expect("the action").type_name = "x_msgs/action/Unknown".to_owned();
    world.servant.graph.send_replace(Arc::new(other));
    let refused = world.bus.subscribe("/count/result", WireType::any(), QOS).await.err();
    let refused = refused.expect("its type is unknown").to_string();
    assert!(refused.contains("x_msgs/action/Unknown"), "{refused}");
}

#[tokio::test]
async fn goals_are_cancelled_when_the_robot_has_gone() {
    let world = World::new(RosVersion::Two);
    let robot = Robot::new(&world).await;
    robot.send("one");
    world.server.goal("one").await;
    let World { bus, server, .. } = world;
    drop((robot, bus));
    server.wait_cancelled("one").await;
}

#[tokio::test]
async fn an_action_of_the_robots_side_is_served_in_the_servant() {
    struct Handler(Mutex<Vec<(String, Bytes)>>);
    impl ActionHandler for Handler {
        fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
            self.0.lock().push((id.to_owned(), goal));
            Ok(())
        }

        fn on_cancel(&self, _id: &str) {}

        fn on_failed(&self, reason: &str) {
            panic!("{reason}");
        }
    }
    let world = World::new(RosVersion::Two);
    let registry = Registry::new();
    registry.insert("x_msgs/action/Count", DEFINITION).expect("a definition");
    let of = registry.action("x_msgs/Count").expect("an action");
    let handler = Arc::new(Handler(Mutex::default()));
    let server = world.bus.serve_action("/count", &of, Arc::clone(&handler) as _).expect("served");
    let given = world.server.handler.lock().clone().expect("a handler");
    given.on_goal("one", number(RosVersion::Two, 5)).expect("taken");
    assert_eq!(*handler.0.lock(), [("one".to_owned(), number(RosVersion::One, 5))]);
    assert!(given.on_goal("torn", Bytes::from_static(&[0, 1, 0, 0, 5])).is_err());
    assert!(server.end_goal("one", end(RosVersion::One, GoalOutcome::Succeeded).expect("an end")));
    let (id, ended) = world.server.ends.lock()[0].clone();
    assert_eq!((&*id, ended.outcome, ended.result), ("one", GoalOutcome::Succeeded, number(RosVersion::Two, 9)));
}
