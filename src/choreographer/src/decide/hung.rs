//! Detects hung nodes: nodes that receive inputs and answer none of them for many times their robot's T_max.

use std::time::{Duration, Instant};

/// Minimum number of unanswered inputs for a sign of trouble: a node need not answer each.
const INPUTS: u64 = 3;
/// Minimum time after which a node counts as hung, however short its T_max.
const MIN_SILENCE: Duration = Duration::from_secs(1);

/// Cumulative messages to and from nodes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Flow {
    /// Number of messages and calls that they received.
    pub inputs: u64,
    /// Number of messages and answers that they sent.
    pub outputs: u64,
    /// Number of starts of any of them.
    pub starts: u64,
}

/// State of the watch over a flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlowWatch {
    /// The flow at the time of the last output.
    answered: Flow,
    /// Number of outputs before the last start, as far as known.
    outputs_before: u64,
    /// Time at which the first later input was seen.
    since: Option<Instant>,
    /// The hang was reported, and there was no output since.
    told: bool,
}

/// A detected hang.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HungNodes {
    /// Number of unanswered inputs.
    pub inputs: u64,
    /// Time since the first of them.
    pub since: Duration,
}

impl FlowWatch {
    /// Returns true if the hang was reported, and there was no output since.
    pub fn is_reported_hung(&self) -> bool {
        self.told
    }
}

/// Evaluates a flow: returns the new state, and the hang if it is to be reported now, which happens once until there is
/// an output again. Nodes that never had an output may have none; nor may restarted ones that still load what they
/// need.
pub fn observe_flow(
    before: Option<FlowWatch>,
    flow: Flow,
    patience: Duration,
    now: Instant,
) -> (FlowWatch, Option<HungNodes>) {
    let fresh = FlowWatch {
        answered: flow,
        outputs_before: match before {
            Some(before) if before.answered.starts != flow.starts => flow.outputs,
            // Outputs of other nodes, or of a reopened bridge.
            Some(before) if before.outputs_before <= flow.outputs => before.outputs_before,
            _ => 0,
        },
        since: None,
        told: false,
    };
    let same = |before: &FlowWatch| {
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
    let hangs = !watched.told && inputs >= INPUTS && since >= patience.max(MIN_SILENCE);
    watched.told |= hangs;
    (watched, hangs.then_some(HungNodes { inputs, since }))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(3);

    /// Evaluates the flows once per second; returns the seconds at which a hang is reported.
    fn seconds_reported(flows: &[(u64, u64)]) -> Vec<usize> {
        let begun = Instant::now();
        let mut watched = None;
        let mut told = Vec::new();
        for (second, (inputs, outputs)) in flows.iter().enumerate() {
            let flow = Flow { inputs: *inputs, outputs: *outputs, starts: 0 };
            let now = begun + Duration::from_secs(second as u64);
            let (next, hung) = observe_flow(watched, flow, PATIENCE, now);
            watched = Some(next);
            told.extend(hung.map(|_| second));
        }
        told
    }

    #[test]
    fn nodes_hang_that_answered_and_answer_no_more() {
        for (flows, expected) in [
            (&[(0, 0), (9, 0), (9, 0), (9, 0), (9, 0), (9, 0)][..], &[][..]),
            (&[(1, 1), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1)], &[]),
            (&[(1, 1), (4, 1), (5, 1), (6, 1), (7, 1), (8, 1)], &[4]),
            // Too few.
            (&[(1, 1), (3, 1), (3, 1), (3, 1), (3, 1), (3, 1)], &[]),
            (&[(1, 1), (3, 1), (3, 1), (3, 1), (4, 1), (4, 1)], &[4]),
            // An answer every now and then.
            (&[(1, 1), (9, 1), (9, 1), (9, 2), (19, 2), (19, 2)], &[]),
            // It was restarted.
            (&[(9, 9), (3, 9), (6, 9), (6, 9), (6, 9), (6, 9)], &[5]),
        ] {
            assert_eq!(seconds_reported(flows), expected, "{flows:?}");
        }
        let begun = Instant::now();
        let flow = |inputs| Flow { inputs, outputs: 1, starts: 0 };
        let (watched, _) = observe_flow(None, flow(1), Duration::ZERO, begun);
        let (watched, _) = observe_flow(Some(watched), flow(9), Duration::ZERO, begun);
        let (_, hung) = observe_flow(Some(watched), flow(9), Duration::ZERO, begun + MIN_SILENCE / 2);
        assert_eq!(hung, None, "not for so short a time");
    }

    #[test]
    fn a_node_that_was_started_again_may_take_its_time() {
        let begun = Instant::now();
        let mut watched = None;
        let mut hangs = |second: u32, inputs, outputs, starts| {
            let flow = Flow { inputs, outputs, starts };
            let now = begun + Duration::from_secs(second.into());
            let (next, hung) = observe_flow(watched, flow, PATIENCE, now);
            watched = Some(next);
            hung.is_some()
        };
        assert!(!hangs(0, 9, 9, 1));
        assert!(!hangs(1, 19, 9, 1));
        // It has crashed, and loads its model while inputs continue.
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
            let told = seconds_reported(&flows);
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
