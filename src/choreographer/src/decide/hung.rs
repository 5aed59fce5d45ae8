//! Whether nodes hang: they are given inputs and answer none of them for many times the T_max that their robot stated.

use std::time::{Duration, Instant};

/// Fewer inputs without an answer are no sign: a node need not answer each.
const INPUTS: u64 = 3;
/// Nothing hangs for less, however short its T_max.
const LEAST: Duration = Duration::from_secs(1);

/// What went to nodes and came from them so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Flow {
    /// Messages and calls that they were given.
    pub inputs: u64,
    /// Messages and answers that they gave.
    pub outputs: u64,
    /// How often one of them was started.
    pub starts: u64,
}

/// What was seen of a flow so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Watched {
    /// As it was when there was an output last.
    answered: Flow,
    /// Outputs before one of them was started last, as far as that was seen.
    outputs_before: u64,
    /// When the first input was seen that came after it.
    since: Option<Instant>,
    /// It was told that they hang, and there was no output since.
    told: bool,
}

/// Nodes hang.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hung {
    /// So many inputs are not answered.
    pub inputs: u64,
    /// The first of them since so long.
    pub since: Duration,
}

impl Watched {
    /// Whether it was told that they hang, and there was no output since.
    pub fn hangs(&self) -> bool {
        self.told
    }
}

/// Looks at a flow again: what is to be remembered, and whether it is to be told that the nodes hang, which it is once until
/// there is an output again. Nodes that never had an output may have none; nor do those that were started again and still load
/// what they need.
pub fn look(
    before: Option<Watched>,
    flow: Flow,
    patience: Duration,
    now: Instant,
) -> (Watched, Option<Hung>) {
    let fresh = Watched {
        answered: flow,
        outputs_before: match before {
            Some(before) if before.answered.starts != flow.starts => flow.outputs,
            // Those of other nodes, or of a bridge that was opened anew.
            Some(before) if before.outputs_before <= flow.outputs => before.outputs_before,
            _ => 0,
        },
        since: None,
        told: false,
    };
    let same = |before: &Watched| {
        before.answered.outputs == flow.outputs
            && before.answered.inputs <= flow.inputs
            && before.answered.starts == flow.starts
    };
    let Some(mut watched) = before.filter(same) else {
        return (fresh, None);
    };
    let inputs = flow.inputs - watched.answered.inputs;
    if inputs == 0 || flow.outputs == watched.outputs_before {
        return (watched, None);
    }
    let since = now - *watched.since.get_or_insert(now);
    let hangs = !watched.told && inputs >= INPUTS && since >= patience.max(LEAST);
    watched.told |= hangs;
    (watched, hangs.then_some(Hung { inputs, since }))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(3);

    /// Looked at every second: at which second it is told that they hang.
    fn told(flows: &[(u64, u64)]) -> Vec<usize> {
        let begun = Instant::now();
        let mut watched = None;
        let mut told = Vec::new();
        for (second, (inputs, outputs)) in flows.iter().enumerate() {
            let flow = Flow {
                inputs: *inputs,
                outputs: *outputs,
                starts: 0,
            };
            let now = begun + Duration::from_secs(second as u64);
            let (next, hung) = look(watched, flow, PATIENCE, now);
            watched = Some(next);
            told.extend(hung.map(|_| second));
        }
        told
    }

    #[test]
    fn nodes_hang_that_answered_and_answer_no_more() {
        for (flows, expected) in [
            (
                &[(0, 0), (9, 0), (9, 0), (9, 0), (9, 0), (9, 0)][..],
                &[][..],
            ),
            (&[(1, 1), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1)], &[]),
            (&[(1, 1), (4, 1), (5, 1), (6, 1), (7, 1), (8, 1)], &[4]),
            // Too few.
            (&[(1, 1), (3, 1), (3, 1), (3, 1), (3, 1), (3, 1)], &[]),
            (&[(1, 1), (3, 1), (3, 1), (3, 1), (4, 1), (4, 1)], &[4]),
            // An answer every now and then.
            (&[(1, 1), (9, 1), (9, 1), (9, 2), (19, 2), (19, 2)], &[]),
            // It was started again.
            (&[(9, 9), (3, 9), (6, 9), (6, 9), (6, 9), (6, 9)], &[5]),
        ] {
            assert_eq!(told(flows), expected, "{flows:?}");
        }
        let begun = Instant::now();
        let flow = |inputs| Flow {
            inputs,
            outputs: 1,
            starts: 0,
        };
        let (watched, _) = look(None, flow(1), Duration::ZERO, begun);
        let (watched, _) = look(Some(watched), flow(9), Duration::ZERO, begun);
        let (_, hung) = look(Some(watched), flow(9), Duration::ZERO, begun + LEAST / 2);
        assert_eq!(hung, None, "not for so short a time");
    }

    #[test]
    fn a_node_that_was_started_again_may_take_its_time() {
        let begun = Instant::now();
        let mut watched = None;
        let mut hangs = |second: u32, inputs, outputs, starts| {
            let flow = Flow {
                inputs,
                outputs,
                starts,
            };
            let now = begun + Duration::from_secs(second.into());
            let (next, hung) = look(watched, flow, PATIENCE, now);
            watched = Some(next);
            hung.is_some()
        };
        assert!(!hangs(0, 9, 9, 1));
        assert!(!hangs(1, 19, 9, 1));
        // It has crashed, and loads its model while inputs go on.
        for second in 2..60 {
            assert!(!hangs(second, u64::from(second) * 10, 9, 2), "{second}");
        }
        assert!(!hangs(60, 600, 10, 2), "it answers");
        for second in 61..64 {
            assert!(!hangs(second, u64::from(second) * 10, 10, 2), "{second}");
        }
        assert!(hangs(64, 640, 10, 2), "now it hangs");
    }

    proptest! {
        #[test]
        fn it_is_told_once_until_there_is_an_answer(
            steps in prop::collection::vec((0u64..4, 0u64..2), 1..60),
        ) {
            let mut sum = (0, 0);
            let flows: Vec<(u64, u64)> = steps.iter().map(|(inputs, outputs)| {
                // Most seconds have no output.
                sum = (sum.0 + inputs, sum.1 + outputs * u64::from(*inputs == 3));
                sum
            }).collect();
            let told = told(&flows);
            for pair in told.windows(2) {
                prop_assert!(flows[pair[0]].1 < flows[pair[1]].1, "told again");
            }
            for second in told {
                prop_assert!(flows[second].1 > 0);
                let quiet = flows[second - 3..=second].iter().all(|flow| flow.1 == flows[second].1);
                prop_assert!(quiet, "there was an output");
            }
        }
    }
}
