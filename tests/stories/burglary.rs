//! Ways out of a servant and into its neighbours, on this machine.

use support::world::{BURGLAR, GREETER, world};
use support::{Verdict, burglary};

pub fn no_attempt_to_break_out_succeeds() -> Verdict {
    burglary::no_attempt_to_break_out_succeeds(&*world().daemon_with(BURGLAR)?)
}

pub fn nothing_of_the_host_is_reached() -> Verdict {
    burglary::nothing_of_the_host_is_reached(&*world().daemon_with(BURGLAR)?)
}

pub fn neighbours_are_not_reached() -> Verdict {
    world().daemon_with(GREETER)?;
    burglary::neighbours_are_not_reached(&*world().daemon_with(BURGLAR)?)
}
