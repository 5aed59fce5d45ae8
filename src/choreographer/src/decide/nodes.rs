//! Decides what the exit of a node means for its servant.

use std::time::Duration;

use super::back_off::{RECOVERY_TIME, double_pause};

const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// Number of failures in a row after which a node is given up.
const ATTEMPTS: u32 = 6;

/// State of the servant whose node has exited.
#[derive(Debug, Clone, Copy)]
pub struct NodeExitContext {
    /// The nodes are started and ended by a robot's stubs.
    pub linked: bool,
    /// The servant is ready.
    pub ready: bool,
    /// Failed nodes are restarted.
    pub restarts: bool,
    /// Number of nodes that run or will run again, including this one.
    pub alive: usize,
}

/// Exit of a node.
#[derive(Debug, Clone, Copy)]
pub struct EndedNode<'a> {
    /// Name of the node.
    pub node: &'a str,
    /// Description of its end, as a phrase that starts with a verb.
    pub how: &'a str,
    /// It did not exit with status 0.
    pub failed: bool,
    /// The servant exceeded its memory limit.
    pub out_of_memory: bool,
    /// Time for which it ran.
    pub ran: Duration,
    /// Number of failures in a row before this one.
    pub failures: u32,
}

/// An event about a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeReport {
    /// Kind of the event.
    pub kind: &'static str,
    /// Human-readable message.
    pub message: String,
}

/// Action after the exit of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NodeExitAction {
    /// No action is necessary.
    Nothing,
    /// The servant continues without the node.
    Without(NodeReport),
    /// The node is restarted.
    Restart {
        /// Pause before the restart.
        after: Duration,
        /// Number of failures in a row, including this one.
        failures: u32,
        /// Event to report.
        event: NodeReport,
    },
    /// The servant has failed.
    Fail {
        /// Event to report before.
        event: Option<NodeReport>,
        /// Reason, as a phrase that starts with a verb.
        reason: String,
    },
}

/// Decides what happens after a node has exited.
pub fn decide_after_exit(crew: NodeExitContext, end: EndedNode<'_>) -> NodeExitAction {
    let EndedNode { node, how, .. } = end;
    let fail = |reason| NodeExitAction::Fail { event: None, reason };
    let event = |kind, message| NodeReport { kind, message };
    if crew.linked {
        // A stub manages the nodes.
        return NodeExitAction::Nothing;
    }
    if end.out_of_memory {
        // Its state is lost, and a restarted node would do the same again: the robot is told and starts anew.
        return NodeExitAction::Fail {
            event: Some(event("out-of-memory", format!("{node} {how}"))),
            reason: format!("lost {node}: it {how}"),
        };
    }
    if end.failed && !crew.ready {
        return fail(format!("did not become ready: {node} {how}"));
    }
    if end.failed && crew.restarts {
        let (failures, pause) = restart_pause(end.failures, end.ran);
        let Some(after) = pause else {
            return fail(format!("gave up on {node}: it {how} repeatedly"));
        };
        let message = format!("{node} {how}; restart in {} ms", after.as_millis());
        return NodeExitAction::Restart { after, failures, event: event("node-failed", message) };
    }
    if crew.alive <= 1 {
        return fail(format!("has no running nodes left: {node} {how}"));
    }
    NodeExitAction::Without(event("node-ended", format!("{node} {how}")))
}

/// Returns the number of failures in a row, including the one of a node that ran for `ran`, and the pause before its
/// restart; `None` if it is given up.
fn restart_pause(failures: u32, ran: Duration) -> (u32, Option<Duration>) {
    let failures = if ran >= RECOVERY_TIME { 1 } else { failures + 1 };
    let pause = || double_pause(FIRST_PAUSE, failures - 1, LONGEST_PAUSE);
    (failures, (failures <= ATTEMPTS).then(pause))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CREW: NodeExitContext = NodeExitContext { linked: false, ready: true, restarts: true, alive: 2 };

    const END: EndedNode<'_> = EndedNode {
        node: "/a",
        how: "exited with status 1",
        failed: true,
        out_of_memory: false,
        ran: Duration::ZERO,
        failures: 0,
    };

    #[test]
    fn what_the_end_of_a_node_means() {
        let done = EndedNode { failed: false, how: "exited with status 0", ..END };
        let killed = EndedNode { out_of_memory: true, how: "was killed", ..END };
        let starting = NodeExitContext { ready: false, ..CREW };
        let last = NodeExitContext { alive: 1, ..CREW };
        let fragile = NodeExitContext { restarts: false, ..CREW };
        let linked = NodeExitContext { linked: true, ready: false, ..CREW };
        let in_words = |next| match next {
            NodeExitAction::Nothing => "nothing".to_owned(),
            NodeExitAction::Without(event) => format!("{}: {}", event.kind, event.message),
            NodeExitAction::Restart { event, .. } => format!("{}: {}", event.kind, event.message),
            NodeExitAction::Fail { event: None, reason } => format!("it {reason}"),
            NodeExitAction::Fail { event: Some(event), reason } => format!("{}, it {reason}", event.kind),
        };
        for (crew, end, expected) in [
            (CREW, END, "node-failed: /a exited with status 1; restart in 500 ms"),
            (CREW, done, "node-ended: /a exited with status 0"),
            (CREW, killed, "out-of-memory, it lost /a: it was killed"),
            (starting, END, "it did not become ready: /a exited with status 1"),
            (starting, done, "node-ended: /a exited with status 0"),
            (fragile, END, "node-ended: /a exited with status 1"),
            (last, END, "node-failed: /a exited with status 1; restart in 500 ms"),
            (last, done, "it has no running nodes left: /a exited with status 0"),
            (linked, END, "nothing"),
            (linked, killed, "nothing"),
        ] {
            assert_eq!(in_words(decide_after_exit(crew, end)), expected, "{crew:?} {end:?}");
        }
    }

    /// Returns the pauses before the restarts of a node with these run times, and whether it is given up.
    fn pauses(runs: impl IntoIterator<Item = Duration>) -> (Vec<Duration>, bool) {
        let mut failures = 0;
        let mut pauses = Vec::new();
        for ran in runs {
            let end = EndedNode { ran, failures, ..END };
            match decide_after_exit(CREW, end) {
                NodeExitAction::Restart { after, failures: now, .. } => {
                    failures = now;
                    pauses.push(after);
                }
                NodeExitAction::Fail { reason, .. } => {
                    assert_eq!(reason, "gave up on /a: it exited with status 1 repeatedly");
                    return (pauses, true);
                }
                other => panic!("{other:?}"),
            }
        }
        (pauses, false)
    }

    #[test]
    fn pauses_double_until_a_node_is_given_up() {
        let (pauses, given_up) = pauses([Duration::ZERO; 9]);
        let pauses: Vec<_> = pauses.iter().map(Duration::as_millis).collect();
        assert_eq!(pauses, [500, 1000, 2000, 4000, 8000, 16_000]);
        assert!(given_up);
    }

    proptest::proptest! {
        #[test]
        fn a_node_is_given_up_after_six_failures_in_a_row(
            runs in proptest::collection::vec(0u64..90, 0..40),
        ) {
            let runs: Vec<_> = runs.into_iter().map(Duration::from_secs).collect();
            let (pauses, given_up) = pauses(runs.iter().copied());
            let mut in_a_row = 0;
            let mut expected = 0;
            for ran in &runs {
                in_a_row = if *ran >= RECOVERY_TIME { 1 } else { in_a_row + 1 };
                if in_a_row > ATTEMPTS {
                    break;
                }
                expected += 1;
            }
            proptest::prop_assert_eq!(pauses.len(), expected);
            proptest::prop_assert_eq!(given_up, expected < runs.len());
            for pause in pauses {
                proptest::prop_assert!((FIRST_PAUSE..=LONGEST_PAUSE).contains(&pause));
            }
        }
    }
}
