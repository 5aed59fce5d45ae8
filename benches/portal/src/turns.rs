//! Turns of what is compared.

use anyhow::Result;

/// Takes a turn of each item in every round, so that disturbances affect all of them.
pub(crate) fn take_turns<T>(
    what: &str,
    rounds: usize,
    items: &mut [T],
    mut turn: impl FnMut(&mut T) -> Result<()>,
) -> Result<()> {
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        items.iter_mut().try_for_each(&mut turn)?;
    }
    Ok(())
}
