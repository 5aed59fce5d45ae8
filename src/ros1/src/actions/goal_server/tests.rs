use std::time::Duration;

use ros_message::schema::Registry;
use tokio::time::advance;

use super::*;
use crate::actions::messages::{ActionlibStatus::*, *};

/// A message that a server published: the goal's id, its status and, for a result, the text.
#[derive(Debug, Clone, PartialEq)]
enum Published {
    Status(Vec<(String, ActionlibStatus)>),
    Feedback(String, ActionlibStatus),
    Result(String, ActionlibStatus, String),
}

#[derive(Default)]
struct Recorder(Mutex<Vec<Published>>);

impl GoalServerTopics for Recorder {
    fn publish_status(&self, message: Bytes) {
        let states = read_states(&message).expect("statuses").into_iter();
        let mut states: Vec<_> = states.map(|state| (state.goal.id, state.status)).collect();
        states.sort_by(|one, other| one.0.cmp(&other.0));
        self.0.lock().push(Published::Status(states));
    }

    fn publish_feedback(&self, message: Bytes) {
        let (state, _) = read_state(&message).expect("feedback");
        self.0.lock().push(Published::Feedback(state.goal.id, state.status));
    }

    fn publish_result(&self, message: Bytes) {
        let (state, _) = read_state(&message).expect("a result");
        self.0.lock().push(Published::Result(state.goal.id, state.status, state.text));
    }
}

type Server = GoalServer<Recorder>;

fn server_with(limits: GoalLimits) -> Server {
    let definitions = Registry::new();
    definitions.insert("x/action/Do", "int32 order\n---\nint32 sum\n---\nint32 part\n").expect("a definition");
    let of = definitions.action("x/Do").expect("an action");
    GoalServer::new("/do", &of, Recorder::default(), limits)
}

fn server() -> Server {
    server_with(GoalLimits { goals: 3, budget: Budget::without_limit(), holder: "this server" })
}

impl Server {
    fn send(&self, id: &str, secs: u32) -> Option<String> {
        let goal = GoalId { stamp: Time { secs, nsecs: 0 }, id: id.to_owned() };
        self.begin(&write_goal(Time::default(), &goal, &7i32.to_le_bytes())).map(|(id, _)| id)
    }

    fn cancel_goal(&self, id: &str, secs: u32) -> Vec<String> {
        let wanted = GoalId { stamp: Time { secs, nsecs: 0 }, id: id.to_owned() };
        let mut cancelled = self.cancel(&write_cancel(&wanted));
        cancelled.sort();
        cancelled
    }

    fn end(&self, id: &str, outcome: GoalOutcome) -> bool {
        self.end_without_result(id, outcome, "why".to_owned())
    }

    /// Returns what was published since the last call.
    fn take_published(&self) -> Vec<Published> {
        std::mem::take(&mut *self.topics.0.lock())
    }

    /// Returns the status of a goal, as it is published.
    fn status(&self, id: &str) -> Option<ActionlibStatus> {
        self.publish_status();
        match self.topics.0.lock().pop() {
            Some(Published::Status(all)) => all.into_iter().find(|(of, _)| of == id).map(|(_, status)| status),
            other => panic!("{other:?}"),
        }
    }
}

/// An event of a goal.
#[derive(Debug, Clone, Copy)]
enum Step {
    Accept,
    Cancel,
    Feedback,
    End(GoalOutcome),
}

#[test]
fn goals_take_the_states_of_actionlib() {
    use GoalOutcome::*;
    use Step::*;
    for (steps, expected) in [
        (vec![], Pending),
        (vec![Accept], Active),
        (vec![Accept, Accept], Active),
        (vec![Cancel], Recalling),
        (vec![Accept, Cancel], Preempting),
        (vec![Accept, Cancel, Accept], Preempting),
        (vec![Cancel, Accept], Preempting),
        (vec![Feedback], Active),
        (vec![Cancel, Feedback], Preempting),
        (vec![End(Succeeded)], ActionlibStatus::Succeeded),
        (vec![End(Canceled)], Recalled),
        (vec![End(Rejected)], ActionlibStatus::Rejected),
        (vec![End(Aborted)], ActionlibStatus::Aborted),
        (vec![Cancel, End(Canceled)], Recalled),
        (vec![Cancel, End(Rejected)], ActionlibStatus::Rejected),
        (vec![Cancel, End(Succeeded)], ActionlibStatus::Succeeded),
        (vec![Accept, End(Succeeded)], ActionlibStatus::Succeeded),
        (vec![Accept, End(Canceled)], Preempted),
        (vec![Accept, End(Aborted)], ActionlibStatus::Aborted),
        (vec![Accept, End(Unknown)], ActionlibStatus::Aborted),
        (vec![Accept, End(Rejected)], ActionlibStatus::Aborted),
        (vec![Accept, Cancel, End(Canceled)], Preempted),
        (vec![Accept, Cancel, End(Succeeded)], ActionlibStatus::Succeeded),
        (vec![Cancel, Accept, End(Canceled)], Preempted),
        // The first end counts.
        (vec![Accept, End(Succeeded), Cancel, End(Aborted)], ActionlibStatus::Succeeded),
        (vec![End(Canceled), Accept, Feedback], Recalled),
    ] {
        let server = server();
        assert_eq!(server.send("one", 1).as_deref(), Some("one"));
        for step in &steps {
            match step {
                Accept => server.accept("one"),
                Cancel => drop(server.cancel_goal("one", 0)),
                Feedback => drop(server.publish_feedback("one", &[0; 4])),
                End(outcome) => drop(server.end("one", *outcome)),
            }
        }
        assert_eq!(server.status("one"), Some(expected), "{steps:?}");
    }
}

#[test]
fn a_result_comes_before_the_status_that_lists_it_and_feedback_after_acceptance() {
    let server = server();
    server.send("one", 1);
    assert_eq!(server.take_published(), [], "who executes it decides first");
    assert!(server.publish_feedback("one", &[0; 4]));
    assert!(server.end("one", GoalOutcome::Succeeded));
    let one = |status| ("one".to_owned(), status);
    let expected = [
        Published::Status(vec![one(Active)]),
        Published::Feedback("one".to_owned(), Active),
        Published::Result("one".to_owned(), Succeeded, "why".to_owned()),
        Published::Status(vec![one(Succeeded)]),
    ];
    assert_eq!(server.take_published(), expected);
    assert!(!server.publish_feedback("one", &[0; 4]) && !server.end("one", GoalOutcome::Aborted));
    assert!(!server.publish_feedback("two", &[0; 4]) && !server.end("two", GoalOutcome::Aborted));
    assert_eq!(server.take_published(), []);
}

#[test]
fn a_cancel_names_one_goal_or_those_up_to_a_stamp_or_all() {
    for (id, secs, expected) in [
        ("two", 0, vec!["two"]),
        ("", 0, vec!["one", "three", "two"]),
        ("", 2, vec!["one", "two"]),
        ("three", 1, vec!["one", "three"]),
        ("four", 0, vec![]),
    ] {
        let server = server();
        for (id, secs) in [("one", 1), ("two", 2), ("three", 3)] {
            server.send(id, secs);
            server.accept(id);
        }
        assert_eq!(server.cancel_goal(id, secs), expected, "{id} {secs}");
        assert_eq!(server.cancel_goal(id, secs), Vec::<String>::new(), "again: {id} {secs}");
    }
    assert_eq!(server().cancel(b"no cancel"), Vec::<String>::new());
}

#[test]
fn a_cancel_that_overtakes_its_goal_recalls_it() {
    let server = server();
    server.cancel_goal("early", 0);
    assert_eq!(server.status("early"), Some(Recalling));
    server.take_published();
    assert_eq!(server.send("early", 9), None);
    let words = "the goal was cancelled before it came".to_owned();
    assert_eq!(server.take_published()[0], Published::Result("early".to_owned(), Recalled, words));
    // By stamp.
    server.cancel_goal("", 5);
    assert_eq!(server.send("old", 5), None);
    assert_eq!(server.status("old"), Some(Recalled));
    assert_eq!(server.send("new", 6).as_deref(), Some("new"));
    assert_eq!(server.send("timeless", 0).as_deref(), Some("timeless"));
}

#[tokio::test(start_paused = true)]
async fn ended_goals_are_listed_for_a_while_and_their_ids_are_taken_until_then() {
    let server = server();
    server.send("one", 1);
    assert_eq!(server.send("one", 1), None, "it is under way");
    server.end("one", GoalOutcome::Succeeded);
    server.take_published();
    assert_eq!(server.send("one", 1), None);
    assert_eq!(server.take_published(), [], "it is ignored, as by actionlib");
    advance(Duration::from_secs(6)).await;
    assert_eq!(server.status("one"), None);
    assert_eq!(server.send("one", 1).as_deref(), Some("one"));
}

#[test]
fn goals_without_an_id_get_one() {
    let server = server();
    let ids = [server.send("", 0), server.send("", 0)].map(Option::unwrap);
    assert!(ids[0].starts_with("/do-") && ids[0] != ids[1], "{ids:?}");
}

#[test]
fn senders_cannot_have_a_server_hold_goals_without_end() {
    let budget = Budget::new("the robot", 8);
    let server = server_with(GoalLimits { goals: 3, budget: budget.clone(), holder: "this robot" });
    // Two goals of four bytes fit into the budget.
    for (number, expected) in [true, true, false].into_iter().enumerate() {
        assert_eq!(server.send(&format!("{number}"), 1).is_some(), expected, "{number}");
    }
    match &server.take_published()[..] {
        [Published::Result(id, Rejected, text), Published::Status(_)] => {
            assert!(id == "2" && text.contains("the robot"), "{id} {text}");
        }
        other => panic!("{other:?}"),
    }
    server.end("0", GoalOutcome::Succeeded);
    assert_eq!(budget.used_bytes(), 4);

    let server = self::server();
    for number in 0..20 {
        assert_eq!(server.send(&format!("{number}"), 1).is_some(), number < 3);
        server.cancel_goal(&format!("unknown {number}"), 0);
    }
    server.publish_status();
    match server.take_published().last() {
        Some(Published::Status(all)) => assert_eq!(all.len(), 3 + 3),
        other => panic!("{other:?}"),
    }
    let text = "3 goals of this server are under way already";
    let longest = "i".repeat(LONGEST_ID);
    server.end("0", GoalOutcome::Succeeded);
    server.take_published();
    assert_eq!(server.send(&format!("{longest}i"), 1), None);
    assert_eq!(server.take_published(), [], "each status would repeat it");
    assert_eq!(server.send(&longest, 1), Some(longest));
    server.send("late", 1);
    match &server.take_published()[0] {
        Published::Result(_, Rejected, found) => assert!(found.starts_with(text), "{found}"),
        other => panic!("{other:?}"),
    }
    assert_eq!(server.begin(&Bytes::from_static(b"no goal")), None);
}

#[tokio::test(start_paused = true)]
async fn statuses_are_published_at_a_bounded_rate_whatever_is_sent() {
    let server = server();
    let count = || server.take_published().iter().filter(|it| matches!(it, Published::Status(_))).count();
    let results = |published: &[Published]| published.iter().filter(|it| matches!(it, Published::Result(..))).count();
    for number in 0..3 {
        server.send(&format!("taken {number}"), 1);
    }
    for round in 0..2 {
        for number in 0..1000 {
            server.send(&format!("{round} {number}"), 1);
        }
        let published = server.take_published();
        assert_eq!(results(&published), 1000, "each is told that it was rejected");
        let most = usize::try_from(MOST_AT_CHANGES).expect("few");
        assert_eq!(published.len() - results(&published), most);
        (0..1000).for_each(|_| drop(server.cancel_goal("unknown", 0)));
        server.accept("taken 0");
        assert_eq!(count(), 0);
        // The next periodic one has what was left out.
        server.publish_status();
        match &server.take_published()[..] {
            [Published::Status(all)] => assert!(all.contains(&("taken 0".to_owned(), Active)), "{all:?}"),
            other => panic!("{other:?}"),
        }
        advance(STATUS_PERIOD).await;
    }
    server.end("taken 0", GoalOutcome::Succeeded);
    assert_eq!(count(), 1);
}
