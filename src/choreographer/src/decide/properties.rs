//! What holds of all decisions together, whatever happens in whatever order: a machine with its robots, servants, pushes
//! and deployers is played by the decisions alone.

mod machine;

use proptest::prelude::*;

use machine::Machine;

/// Services of the machine, of which so many thousandths of a core are promised to each servant; the first needs all of it.
const SERVICES: [(&str, u64); 3] = [("map", 4000), ("detect", 1000), ("plan", 2500)];

/// What happens on the machine. Numbers choose one of what there is, if there is any.
#[derive(Debug, Clone)]
enum Step {
    /// A robot asks for a service.
    Asks { service: usize, robot: usize },
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
        4 => (0..SERVICES.len(), 0usize..5).prop_map(|(service, robot)| Step::Asks { service, robot }),
        3 => any.clone().prop_map(Step::Leaves),
        4 => any.clone().prop_map(Step::Proceeds),
        1 => any.clone().prop_map(Step::Stopped),
        3 => any.clone().prop_map(Step::Gone),
        1 => (any.clone(), 0u64..5000).prop_map(|(which, size)| Step::Resized(which, size)),
        1 => any.clone().prop_map(Step::GivesUp),
        1 => (1u64..5000).prop_map(Step::Pushes),
        1 => any.clone().prop_map(Step::Pushed),
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
