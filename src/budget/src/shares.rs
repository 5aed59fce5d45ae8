//! Budgets by name, such as one per client.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;

use crate::{Budget, BudgetNode, WorkLimit};

/// One budget per name, all of the same size, below a common parent. A name's budget exists for as long as there is a
/// handle to it or a permit of it.
#[derive(Debug)]
pub struct Shares {
    whole: Budget,
    what: &'static str,
    each: usize,
    work: Option<WorkLimit>,
    known: Mutex<HashMap<String, Weak<BudgetNode>>>,
}

impl Shares {
    /// Creates a set of budgets of `each` bytes below `whole`; their names start with `what` (such as "client").
    pub fn new(whole: &Budget, what: &'static str, each: usize) -> Self {
        Self { whole: whole.clone(), what, each, work: None, known: Mutex::default() }
    }

    /// Limits the processor time of each name's tasks too.
    pub fn with_work(self, work: WorkLimit) -> Self {
        Self { work: Some(work), ..self }
    }

    /// Returns the budget for `name`, creating it if necessary.
    pub fn for_name(&self, name: &str) -> Budget {
        let mut known = self.known.lock();
        if let Some(node) = known.get(name).and_then(Weak::upgrade) {
            return Budget::from(node);
        }
        known.retain(|_, node| node.strong_count() > 0);
        let full_name = format!("{} {name}", self.what);
        let budget = match self.work {
            Some(work) => self.whole.child_with_work(full_name, self.each, work),
            None => self.whole.child(full_name, self.each),
        };
        known.insert(name.to_owned(), Arc::downgrade(&budget.node));
        budget
    }

    /// Returns the number of names that have a budget now.
    pub fn len(&self) -> usize {
        let known = self.known.lock();
        known.values().filter(|node| node.strong_count() > 0).count()
    }

    /// Returns whether no name has a budget now.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl std::fmt::Debug for BudgetNode {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(&self.name)
    }
}
