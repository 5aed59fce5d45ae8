//! What the end of a node means for its servant.

use std::time::Duration;

use super::back_off::{RECOVERED, doubled};

const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// Failures in a row after which it is given up.
const ATTEMPTS: u32 = 6;

/// What is known of a servant where one of its nodes has ended.
#[derive(Debug, Clone, Copy)]
pub struct Crew {
    /// Its nodes are started and ended by a robot's stubs.
    pub linked: bool,
    /// It is ready.
    pub ready: bool,
    /// Nodes that fail are started again.
    pub restarts: bool,
    /// Nodes that run or will run again, with this one.
    pub alive: usize,
}

/// The end of a node.
#[derive(Debug, Clone, Copy)]
pub struct Ended<'a> {
    /// Its name.
    pub node: &'a str,
    /// In words, beginning with a verb.
    pub how: &'a str,
    /// It did not exit with status 0.
    pub failed: bool,
    /// The servant needed more memory than its limit.
    pub out_of_memory: bool,
    /// How long it ran.
    pub ran: Duration,
    /// Its failures in a row before this one.
    pub failures: u32,
}

/// An event about a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// Its kind.
    pub kind: &'static str,
    /// In words.
    pub message: String,
}

/// What happens next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Next {
    /// Nothing follows.
    Nothing,
    /// The servant works on without the node.
    Without(Event),
    /// The node is started again.
    Restart {
        /// After this time.
        after: Duration,
        /// Its failures in a row, with this one.
        failures: u32,
        /// To be told.
        event: Event,
    },
    /// The servant has failed.
    Fail {
        /// To be told before.
        event: Option<Event>,
        /// Beginning with a verb.
        reason: String,
    },
}

/// What happens after a node has ended.
pub fn after(crew: Crew, end: Ended<'_>) -> Next {
    let Ended { node, how, .. } = end;
    let fail = |reason| Next::Fail {
        event: None,
        reason,
    };
    let event = |kind, message| Event { kind, message };
    if crew.linked {
        // A stub took its place.
        return Next::Nothing;
    }
    if end.out_of_memory {
        // What it knew is lost, and it would do the same again: its robot is told and begins anew.
        return Next::Fail {
            event: Some(event("out-of-memory", format!("{node} {how}"))),
            reason: format!("lost {node}: it {how}"),
        };
    }
    if end.failed && !crew.ready {
        return fail(format!("did not become ready: {node} {how}"));
    }
    if end.failed && crew.restarts {
        let (failures, pause) = back_off(end.failures, end.ran);
        let Some(after) = pause else {
            return fail(format!("gave {node} up: it {how}, again and again"));
        };
        let message = format!(
            "{node} {how}; it is started again in {} ms",
            after.as_millis()
        );
        return Next::Restart {
            after,
            failures,
            event: event("node-failed", message),
        };
    }
    if crew.alive <= 1 {
        return fail(format!("has no node left: {node} {how}"));
    }
    Next::Without(event("node-ended", format!("{node} {how}")))
}

/// A node failed after it ran for `ran`, and `failures` times in a row before: how often in a row now, and how long to wait
/// before it is started again, or none when it is given up.
fn back_off(failures: u32, ran: Duration) -> (u32, Option<Duration>) {
    let failures = match ran >= RECOVERED {
        true => 1,
        false => failures + 1,
    };
    let pause = || doubled(FIRST_PAUSE, failures - 1, LONGEST_PAUSE);
    (failures, (failures <= ATTEMPTS).then(pause))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CREW: Crew = Crew {
        linked: false,
        ready: true,
        restarts: true,
        alive: 2,
    };

    const END: Ended<'_> = Ended {
        node: "/a",
        how: "exited with status 1",
        failed: true,
        out_of_memory: false,
        ran: Duration::ZERO,
        failures: 0,
    };

    #[test]
    fn what_the_end_of_a_node_means() {
        let done = Ended {
            failed: false,
            how: "exited with status 0",
            ..END
        };
        let killed = Ended {
            out_of_memory: true,
            how: "was killed",
            ..END
        };
        let starting = Crew {
            ready: false,
            ..CREW
        };
        let last = Crew { alive: 1, ..CREW };
        let fragile = Crew {
            restarts: false,
            ..CREW
        };
        let linked = Crew {
            linked: true,
            ready: false,
            ..CREW
        };
        let in_words = |next| match next {
            Next::Nothing => "nothing".to_owned(),
            Next::Without(event) => format!("{}: {}", event.kind, event.message),
            Next::Restart { event, .. } => format!("{}: {}", event.kind, event.message),
            Next::Fail {
                event: None,
                reason,
            } => format!("it {reason}"),
            Next::Fail {
                event: Some(event),
                reason,
            } => format!("{}, it {reason}", event.kind),
        };
        for (crew, end, expected) in [
            (
                CREW,
                END,
                "node-failed: /a exited with status 1; it is started again in 500 ms",
            ),
            (CREW, done, "node-ended: /a exited with status 0"),
            (CREW, killed, "out-of-memory, it lost /a: it was killed"),
            (
                starting,
                END,
                "it did not become ready: /a exited with status 1",
            ),
            (starting, done, "node-ended: /a exited with status 0"),
            (fragile, END, "node-ended: /a exited with status 1"),
            (
                last,
                END,
                "node-failed: /a exited with status 1; it is started again in 500 ms",
            ),
            (last, done, "it has no node left: /a exited with status 0"),
            (linked, END, "nothing"),
            (linked, killed, "nothing"),
        ] {
            assert_eq!(in_words(after(crew, end)), expected, "{crew:?} {end:?}");
        }
    }

    /// The pauses before a node that runs so long each time is started again, until it is given up.
    fn pauses(runs: impl IntoIterator<Item = Duration>) -> (Vec<Duration>, bool) {
        let mut failures = 0;
        let mut pauses = Vec::new();
        for ran in runs {
            let end = Ended {
                ran,
                failures,
                ..END
            };
            match after(CREW, end) {
                Next::Restart {
                    after,
                    failures: now,
                    ..
                } => {
                    failures = now;
                    pauses.push(after);
                }
                Next::Fail { reason, .. } => {
                    assert_eq!(
                        reason,
                        "gave /a up: it exited with status 1, again and again"
                    );
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
                in_a_row = if *ran >= RECOVERED { 1 } else { in_a_row + 1 };
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
