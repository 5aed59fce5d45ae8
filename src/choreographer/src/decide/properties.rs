//! Property tests of all decisions together, for any sequence of events: a machine with its robots, servants, pushes
//! and deployers is simulated by the decisions alone.

mod machine;

use proptest::prelude::*;

use super::Amount;
use super::admission::{AdmissionLedger, AdmissionRequest, AdmissionVerdict, AdmittedRequest, MAX_OVERTAKES, Ticket};
use machine::MachineModel;

/// Services of the machine, with the thousandths of a core promised to each servant; the first needs all cores.
const SERVICES: [(&str, u64); 3] = [("map", 4000), ("detect", 1000), ("plan", 2500)];

/// An event on the machine. Numbers select one of the existing objects, if any.
#[derive(Debug, Clone)]
enum MachineStep {
    /// A robot requests a service.
    Asks { service: usize, robot: usize, priority: i32 },
    /// One connection of a servant ends.
    Leaves(usize),
    /// A servant advances by one stage.
    Proceeds(usize),
    /// The end of a servant is requested.
    Stopped(usize),
    /// A servant that is being ended has ended.
    Gone(usize),
    /// Another size is requested for a servant.
    Resized(usize, u64),
    /// The deadline of a waiting request passes.
    GivesUp(usize),
    /// A push requests capacity.
    Pushes(u64),
    /// A push ends.
    Pushed(usize),
    /// The machine stalls, or stops stalling.
    Stalls(bool),
    /// A revision is published.
    Published(usize),
    /// The warm pool is maintained.
    Tidied,
    /// A container of the warm pool ends unexpectedly.
    WarmDies(usize),
    /// So many seconds pass.
    Passes(u64),
}

fn any_step() -> impl Strategy<Value = MachineStep> {
    let any = 0usize..16;
    prop_oneof![
        5 => (0..SERVICES.len(), 0usize..5, 0i32..3)
            .prop_map(|(service, robot, priority)| MachineStep::Asks { service, robot, priority }),
        3 => any.clone().prop_map(MachineStep::Leaves),
        4 => any.clone().prop_map(MachineStep::Proceeds),
        1 => any.clone().prop_map(MachineStep::Stopped),
        3 => any.clone().prop_map(MachineStep::Gone),
        1 => (any.clone(), 0u64..5000).prop_map(|(which, size)| MachineStep::Resized(which, size)),
        1 => any.clone().prop_map(MachineStep::GivesUp),
        1 => (1u64..5000).prop_map(MachineStep::Pushes),
        1 => any.clone().prop_map(MachineStep::Pushed),
        1 => any.clone().prop_map(|which| MachineStep::Stalls(which % 3 == 0)),
        1 => (0..SERVICES.len()).prop_map(MachineStep::Published),
        2 => Just(MachineStep::Tidied),
        1 => any.prop_map(MachineStep::WarmDies),
        1 => (0u64..90).prop_map(MachineStep::Passes),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(1000) })]
    #[test]
    fn promises_are_kept_whatever_happens(steps in prop::collection::vec(any_step(), 1..200)) {
        let mut machine = MachineModel::new();
        for step in steps {
            machine.apply(step);
            machine.check_invariants();
        }
        machine.drain();
    }
}

/// Events of robots at a machine of four cores.
#[derive(Debug, Clone)]
enum QueueStep {
    /// A robot requests so many thousandths of a core, with this priority.
    Asks(u64, i32),
    /// An admitted robot leaves.
    Leaves(usize),
    /// A waiting robot gives up.
    GivesUp(usize),
}

fn any_queue_step() -> impl Strategy<Value = QueueStep> {
    prop_oneof![
        3 => (1u64..4000, 0i32..4).prop_map(|(size, priority)| QueueStep::Asks(size, priority)),
        3 => (0usize..32).prop_map(QueueStep::Leaves),
        1 => (0usize..32).prop_map(QueueStep::GivesUp),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(500) })]
    /// Whatever the priorities of others, a waiting robot is overtaken by a bounded number of later ones.
    #[test]
    fn nobody_starves(steps in prop::collection::vec(any_queue_step(), 1..300)) {
        let cores = |millicpus| Amount { millicpus, memory: 0 };
        let mut book = AdmissionLedger::new(cores(4000), 1000);
        let mut works: Vec<u64> = Vec::new();
        // Ticket, size, priority, and number of times it was overtaken.
        let mut waits: Vec<(Ticket, u64, i32, u32)> = Vec::new();
        for (ticket, step) in (0..).zip(steps) {
            let admitted = match step {
                QueueStep::Asks(size, priority) => {
                    waits.push((ticket, size, priority, 0));
                    let (verdict, mut others) = book.request(ticket, AdmissionRequest::robot(cores(size), priority));
                    if verdict == AdmissionVerdict::Admitted {
                        others.insert(0, AdmittedRequest { ticket, amount: cores(size) });
                    }
                    others
                }
                QueueStep::Leaves(which) if !works.is_empty() => {
                    let size = works.swap_remove(which % works.len());
                    book.release(cores(size))
                }
                QueueStep::GivesUp(which) if !waits.is_empty() => {
                    let gone = waits.remove(which % waits.len());
                    book.withdraw(gone.0)
                }
                _ => Vec::new(),
            };
            for AdmittedRequest { ticket, amount } in admitted {
                let at = waits.iter().position(|one| one.0 == ticket).expect("it waits");
                let (_, size, priority, _) = waits.remove(at);
                prop_assert_eq!(cores(size), amount);
                works.push(size);
                for earlier in &mut waits[..at] {
                    prop_assert!(earlier.2 < priority, "overtaken by one of no higher priority");
                    earlier.3 += 1;
                    prop_assert!(earlier.3 <= MAX_OVERTAKES, "overtaken for ever");
                }
            }
            let promised: u64 = works.iter().sum();
            prop_assert!(promised <= 4000);
            let first = book.queue_positions().next().map(|one| one.0);
            if let Some((_, size, ..)) = waits.iter().find(|one| Some(one.0) == first) {
                prop_assert!(promised + size > 4000, "it waits for what is free");
            }
            prop_assert_eq!(book.queue_positions().count(), waits.len());
        }
    }
}
