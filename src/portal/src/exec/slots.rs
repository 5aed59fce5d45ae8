//! Number of exec sessions that each principal has.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use crate::errors::Error;

/// Limit on the sessions of one principal. A servant has its own limit.
const MOST: usize = 4;

type OpenSessions = Arc<Mutex<HashMap<String, usize>>>;

/// Exec sessions by the name of their principal.
#[derive(Debug, Default)]
pub struct ExecSlots(OpenSessions);

/// Slot of one exec session; released when dropped.
#[derive(Debug)]
pub struct ExecSlot {
    open: OpenSessions,
    who: String,
}

impl ExecSlots {
    pub(super) fn acquire(&self, who: &str) -> Result<ExecSlot, Error> {
        let mut open = self.0.lock();
        let own = open.entry(who.to_owned()).or_default();
        if *own >= MOST {
            return Err(Error::TooManyExecs { who: who.to_owned(), most: MOST });
        }
        *own += 1;
        Ok(ExecSlot { open: Arc::clone(&self.0), who: who.to_owned() })
    }
}

impl Drop for ExecSlot {
    fn drop(&mut self) {
        let mut open = self.open.lock();
        if let Some(own) = open.get_mut(&self.who) {
            *own -= 1;
            if *own == 0 {
                open.remove(&self.who);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_principal_has_so_many_sessions() {
        let slots = ExecSlots::default();
        let mut own: Vec<_> = (0..MOST).map(|_| slots.acquire("alice").expect("room")).collect();
        let refused = slots.acquire("alice").expect_err("hers are taken").problem();
        assert_eq!(refused.status, 429);
        let other = slots.acquire("bob").expect("his own");
        own.pop();
        own.push(slots.acquire("alice").expect("room again"));
        drop((own, other));
        assert!(slots.0.lock().is_empty(), "nothing is left behind");
    }
}
