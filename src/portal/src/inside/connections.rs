//! Connections that look into servants: how many there are, and what each may do.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::errors::Error;

/// Limit on the connections that look into one servant.
const MAX_CONNECTIONS: usize = 16;
/// Limit on one principal's share of them, so that nobody can lock others out.
const MAX_CONNECTIONS_OF_ONE: usize = 4;

/// Connections that look into servants.
#[derive(Debug, Default)]
pub struct InsideConnections {
    /// Names of principals, by servant.
    all: Arc<Mutex<HashMap<String, Vec<String>>>>,
}

/// Slot of one connection that looks into a servant; released when dropped.
#[derive(Debug)]
pub struct InsideSlot {
    all: Arc<Mutex<HashMap<String, Vec<String>>>>,
    servant: String,
    who: String,
}

impl InsideConnections {
    pub(crate) fn acquire(&self, servant: &str, who: &str) -> Result<InsideSlot, Error> {
        let mut all = self.all.lock();
        let there = all.entry(servant.to_owned()).or_default();
        let own = there.iter().filter(|other| *other == who).count();
        if there.len() >= MAX_CONNECTIONS || own >= MAX_CONNECTIONS_OF_ONE {
            return Err(Error::TooManyLook {
                servant: servant.to_owned(),
                most: MAX_CONNECTIONS,
                each: MAX_CONNECTIONS_OF_ONE,
            });
        }
        there.push(who.to_owned());
        Ok(InsideSlot { all: Arc::clone(&self.all), servant: servant.to_owned(), who: who.to_owned() })
    }
}

impl Drop for InsideSlot {
    fn drop(&mut self) {
        let mut all = self.all.lock();
        let Some(there) = all.get_mut(&self.servant) else {
            return;
        };
        if let Some(at) = there.iter().position(|other| *other == self.who) {
            there.swap_remove(at);
        }
        if there.is_empty() {
            all.remove(&self.servant);
        }
    }
}

/// Permission level inside a servant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InsideRole {
    /// All operations that the policy grants.
    Acts,
    /// Subscribe only.
    Looks,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_servant_is_looked_into_by_so_many_and_nobody_keeps_the_others_out() {
        let lookers = InsideConnections::default();
        let mut eves: Vec<_> =
            (0..MAX_CONNECTIONS_OF_ONE).map(|_| lookers.acquire("s1", "eve").expect("room")).collect();
        let refused = lookers.acquire("s1", "eve").expect_err("hers are taken");
        assert!(matches!(refused, Error::TooManyLook { .. }), "{refused}");
        let elsewhere = lookers.acquire("s2", "eve").expect("another servant");
        let others: Vec<_> = (0..MAX_CONNECTIONS - MAX_CONNECTIONS_OF_ONE)
            .map(|index| lookers.acquire("s1", &format!("p{index}")).expect("room"))
            .collect();
        lookers.acquire("s1", "late").expect_err("all are taken");
        eves.pop();
        let late = lookers.acquire("s1", "late").expect("room again");
        drop((eves, elsewhere, others, late));
        assert!(lookers.all.lock().is_empty(), "nothing is left behind");
    }
}
