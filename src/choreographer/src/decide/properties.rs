//! What holds of all decisions together, whatever happens in whatever order: a machine with its robots, servants, pushes
//! and deployers is played by the decisions alone.

mod machine;

use proptest::prelude::*;

use super::Amount;
use super::admission::{Admitted, Ask, Book, OVERTAKEN, Ticket, Verdict};
use machine::Machine;

/// Services of the machine, of which so many thousandths of a core are promised to each servant; the first needs all of it.
const SERVICES: [(&str, u64); 3] = [("map", 4000), ("detect", 1000), ("plan", 2500)];

/// What happens on the machine. Numbers choose one of what there is, if there is any.
#[derive(Debug, Clone)]
enum Step {
    /// A robot asks for a service.
    Asks {
        service: usize,
        robot: usize,
        priority: i32,
    },
    /// One connection of a servant ends.
    Leaves(usize),
    /// A servant comes one stage further.
    Proceeds(usize),
    /// Somebody asks for a servant's end.
    Stopped(usize),
    /// What is being ended has ended.
    Gone(usize),
    /// Another size is asked for a servant.
    Resized(usize, u64),
    /// One that waits has waited until its deadline.
    GivesUp(usize),
    /// A push asks for capacity.
    Pushes(u64),
    /// A push ends.
    Pushed(usize),
    /// The machine stalls, or does no longer.
    Stalls(bool),
    /// A revision is published.
    Published(usize),
    /// The warm pool is looked after.
    Tidied,
    /// A container of the warm pool ends by itself.
    WarmDies(usize),
    /// So many seconds pass.
    Passes(u64),
}

fn step() -> impl Strategy<Value = Step> {
    let any = 0usize..16;
    prop_oneof![
        5 => (0..SERVICES.len(), 0usize..5, 0i32..3)
            .prop_map(|(service, robot, priority)| Step::Asks { service, robot, priority }),
        3 => any.clone().prop_map(Step::Leaves),
        4 => any.clone().prop_map(Step::Proceeds),
        1 => any.clone().prop_map(Step::Stopped),
        3 => any.clone().prop_map(Step::Gone),
        1 => (any.clone(), 0u64..5000).prop_map(|(which, size)| Step::Resized(which, size)),
        1 => any.clone().prop_map(Step::GivesUp),
        1 => (1u64..5000).prop_map(Step::Pushes),
        1 => any.clone().prop_map(Step::Pushed),
        1 => any.clone().prop_map(|which| Step::Stalls(which % 3 == 0)),
        1 => (0..SERVICES.len()).prop_map(Step::Published),
        2 => Just(Step::Tidied),
        1 => any.prop_map(Step::WarmDies),
        1 => (0u64..90).prop_map(Step::Passes),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(1000) })]
    #[test]
    fn promises_are_kept_whatever_happens(steps in prop::collection::vec(step(), 1..200)) {
        let mut machine = Machine::new();
        for step in steps {
            machine.takes(step);
            machine.holds();
        }
        machine.empties();
    }
}

/// Robots before a machine of four cores.
#[derive(Debug, Clone)]
enum Queueing {
    /// One asks for so many thousandths of a core, with this priority.
    Asks(u64, i32),
    /// One that was admitted leaves.
    Leaves(usize),
    /// One that waits gives up.
    GivesUp(usize),
}

fn queueing() -> impl Strategy<Value = Queueing> {
    prop_oneof![
        3 => (1u64..4000, 0i32..4).prop_map(|(size, priority)| Queueing::Asks(size, priority)),
        3 => (0usize..32).prop_map(Queueing::Leaves),
        1 => (0usize..32).prop_map(Queueing::GivesUp),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(500) })]
    /// Whatever priorities others have, one that waits sees at most so many of those who came later go before it.
    #[test]
    fn nobody_starves(steps in prop::collection::vec(queueing(), 1..300)) {
        let cores = |millicpus| Amount { millicpus, memory: 0 };
        let mut book = Book::new(cores(4000), 1000);
        let mut works: Vec<u64> = Vec::new();
        // Ticket, size, priority, and how often it was overtaken.
        let mut waits: Vec<(Ticket, u64, i32, u32)> = Vec::new();
        for (ticket, step) in (0..).zip(steps) {
            let admitted = match step {
                Queueing::Asks(size, priority) => {
                    waits.push((ticket, size, priority, 0));
                    let (verdict, mut others) = book.ask(ticket, Ask::robot(cores(size), priority));
                    if verdict == Verdict::Admitted {
                        others.insert(0, Admitted { ticket, amount: cores(size) });
                    }
                    others
                }
                Queueing::Leaves(which) if !works.is_empty() => {
                    let size = works.swap_remove(which % works.len());
                    book.release(cores(size))
                }
                Queueing::GivesUp(which) if !waits.is_empty() => {
                    let gone = waits.remove(which % waits.len());
                    book.leave(gone.0)
                }
                _ => Vec::new(),
            };
            for Admitted { ticket, amount } in admitted {
                let at = waits.iter().position(|one| one.0 == ticket).expect("it waits");
                let (_, size, priority, _) = waits.remove(at);
                prop_assert_eq!(cores(size), amount);
                works.push(size);
                for earlier in &mut waits[..at] {
                    prop_assert!(earlier.2 < priority, "overtaken by one of no higher priority");
                    earlier.3 += 1;
                    prop_assert!(earlier.3 <= OVERTAKEN, "overtaken for ever");
                }
            }
            let promised: u64 = works.iter().sum();
            prop_assert!(promised <= 4000);
            let first = book.places().next().map(|one| one.0);
            if let Some((_, size, ..)) = waits.iter().find(|one| Some(one.0) == first) {
                prop_assert!(promised + size > 4000, "it waits for what is free");
            }
            prop_assert_eq!(book.places().count(), waits.len());
        }
    }
}
