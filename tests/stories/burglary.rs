//! Ways out of a servant and into its neighbours, on this machine.

use support::world::{BURGLAR, GREETER, world};
use support::{Told, burglary};

pub fn no_attempt_to_break_out_succeeds() -> Told {
    burglary::no_attempt_to_break_out_succeeds(&*world().with(BURGLAR)?)
}

pub fn nothing_of_the_host_is_reached() -> Told {
    burglary::nothing_of_the_host_is_reached(&*world().with(BURGLAR)?)
}

pub fn neighbours_are_not_reached() -> Told {
    world().with(GREETER)?;
    burglary::neighbours_are_not_reached(&*world().with(BURGLAR)?)
}
