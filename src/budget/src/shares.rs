//! Budgets by name, such as one for each client.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;

use crate::{Budget, Node};

/// One budget for each name, all of the same size, below a common budget. A name's budget exists for as long as there is
/// a handle or a permit of it.
#[derive(Debug)]
pub struct Shares {
    whole: Budget,
    what: &'static str,
    each: usize,
    known: Mutex<HashMap<String, Weak<Node>>>,
}

impl Shares {
    /// Budgets of `each` bytes below `whole`; their names begin with `what` (such as "client").
    pub fn new(whole: &Budget, what: &'static str, each: usize) -> Self {
        Self {
            whole: whole.clone(),
            what,
            each,
            known: Mutex::default(),
        }
    }

    /// The budget of this name.
    pub fn of(&self, name: &str) -> Budget {
        let mut known = self.known.lock();
        if let Some(node) = known.get(name).and_then(Weak::upgrade) {
            return Budget::from(node);
        }
        known.retain(|_, node| node.strong_count() > 0);
        let budget = self
            .whole
            .within(format!("{} {name}", self.what), self.each);
        known.insert(name.to_owned(), Arc::downgrade(&budget.node));
        budget
    }

    /// How many names have a budget now.
    pub fn len(&self) -> usize {
        let known = self.known.lock();
        known
            .values()
            .filter(|node| node.strong_count() > 0)
            .count()
    }

    /// Whether no name has a budget now.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl std::fmt::Debug for Node {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(&self.name)
    }
}
