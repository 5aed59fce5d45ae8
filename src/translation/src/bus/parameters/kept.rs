//! Parameters that are set for no running node: those of nodes that have not started, and those that a robot of ROS 1
//! shares among all nodes. A Master keeps both; in ROS 2 there is no place for them.

use std::collections::BTreeMap;
use std::ops::Bound;

use budget::{Budget, Exceeded, Permit};
use parking_lot::Mutex;
use ros::bus::ParamValue;
use ros::ros1::names::canonical;

use super::names::{join, strip_parent};
use super::values::{Tree, put_at};

/// Bytes charged for a parameter in addition to its key and value.
const OVERHEAD: usize = 256;

/// Values by key, without dictionaries. Each is paid for.
pub(super) struct KeptParameters {
    budget: Budget,
    values: Mutex<BTreeMap<String, Kept>>,
}

struct Kept {
    value: ParamValue,
    _held: Permit,
}

impl KeptParameters {
    pub(super) fn new(budget: Budget) -> Self {
        Self { budget, values: Mutex::default() }
    }

    /// Keeps a value, or those of a dictionary, and forgets what was at the key, below it and above it.
    ///
    /// # Errors
    /// There is no memory for all of them; then nothing changes.
    pub(super) fn set(&self, key: &str, value: ParamValue) -> Result<(), Exceeded> {
        let mut leaves = Vec::new();
        self.take_leaves(key.to_owned(), value, &mut leaves)?;
        let mut values = self.values.lock();
        remove_at(&mut values, key);
        let mut above = key;
        while let Some((parent, _)) = above.rsplit_once('/') {
            values.remove(parent);
            above = parent;
        }
        values.extend(leaves);
        Ok(())
    }

    fn take_leaves(&self, key: String, value: ParamValue, into: &mut Vec<(String, Kept)>) -> Result<(), Exceeded> {
        if let ParamValue::Map(entries) = value {
            for (entry, value) in entries {
                let below = canonical(&join(&key, &entry));
                // An entry without a name cannot be found.
                if below != key {
                    self.take_leaves(below, value, into)?;
                }
            }
            return Ok(());
        }
        let held = self.budget.take(OVERHEAD + key.len() + value.bytes_held())?;
        into.push((key, Kept { value, _held: held }));
        Ok(())
    }

    /// Replaces the value of a key that is kept; others stay unknown.
    pub(super) fn update(&self, key: &str, value: &ParamValue) {
        let is_kept = self.values.lock().contains_key(key);
        if is_kept && self.set(key, value.clone()).is_err() {
            // The old one is wrong, and there is no memory for the new one.
            self.remove(key);
        }
    }

    /// Forgets what is at a key and below it; returns false if there is nothing.
    pub(super) fn remove(&self, key: &str) -> bool {
        remove_at(&mut self.values.lock(), key)
    }

    /// Returns the value of a key; a dictionary of those below it.
    pub(super) fn get(&self, key: &str) -> Option<ParamValue> {
        let values = self.values.lock();
        if let Some(kept) = values.get(key) {
            return Some(kept.value.clone());
        }
        let mut tree = Tree::new();
        for (rest, kept) in entries_below(&values, key) {
            put_at(&mut tree, rest, kept.value.clone());
        }
        (!tree.is_empty()).then_some(ParamValue::Map(tree))
    }

    /// Returns the keys.
    #[cfg(test)]
    pub(super) fn keys(&self) -> Vec<String> {
        self.values.lock().keys().cloned().collect()
    }
}

/// Returns the values below a key, with the rest of their keys.
fn entries_below<'v>(values: &'v BTreeMap<String, Kept>, key: &'v str) -> impl Iterator<Item = (&'v str, &'v Kept)> {
    let first = join(key, "");
    let from = (Bound::Included(first.clone()), Bound::Unbounded);
    let following = values.range::<String, _>(from).take_while(move |(other, _)| other.starts_with(&first));
    following.filter_map(move |(other, kept)| Some((strip_parent(other, key)?, kept)))
}

fn remove_at(values: &mut BTreeMap<String, Kept>, key: &str) -> bool {
    let gone: Vec<String> = entries_below(values, key).map(|(rest, _)| join(key, rest)).collect();
    let has_more = !gone.is_empty();
    for key in gone {
        values.remove(&key);
    }
    values.remove(key).is_some() || has_more
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(json: &str) -> ParamValue {
        serde_json::from_str(json).expect(json)
    }

    #[test]
    fn a_value_replaces_what_is_below_and_above_it() {
        let kept = KeptParameters::new(Budget::without_limit());
        kept.set("/a", value(r#"{"b": {"c": 1, "d": 2}, "e": 3}"#)).expect("memory");
        kept.set("/ab", value("9")).expect("memory");
        assert_eq!(kept.get("/a/b"), Some(value(r#"{"c": 1, "d": 2}"#)));
        assert_eq!(kept.get("/"), Some(value(r#"{"a": {"b": {"c": 1, "d": 2}, "e": 3}, "ab": 9}"#)));
        kept.set("/a/b", value(r#"{"x": 4}"#)).expect("memory");
        assert_eq!(kept.get("/a"), Some(value(r#"{"b": {"x": 4}, "e": 3}"#)));
        kept.set("/a/e/f", value("5")).expect("memory");
        assert_eq!(kept.get("/a/e"), Some(value(r#"{"f": 5}"#)));
        assert_eq!(kept.keys(), ["/a/b/x", "/a/e/f", "/ab"]);
        assert!(kept.remove("/a"));
        assert!(!kept.remove("/a"), "it is gone");
        assert_eq!(kept.get("/"), Some(value(r#"{"ab": 9}"#)));
        kept.update("/ab", &value("10"));
        kept.update("/unknown", &value("11"));
        assert_eq!(kept.get("/"), Some(value(r#"{"ab": 10}"#)));
    }

    #[test]
    fn what_is_kept_is_paid_for_and_a_refused_value_changes_nothing() {
        let budget = Budget::new("parameters", 4096);
        let kept = KeptParameters::new(budget.clone());
        kept.set("/a", value(r#"{"b": 1}"#)).expect("memory");
        let long = ParamValue::String("x".repeat(4000));
        let refused = kept.set("/a", ParamValue::Map([("b".to_owned(), long.clone()), ("c".to_owned(), long)].into()));
        assert_eq!(refused.expect_err("no memory").name, "parameters");
        assert_eq!(kept.get("/a/b"), Some(value("1")));
        assert!(budget.used_bytes() > OVERHEAD);
        kept.remove("/");
        assert_eq!(budget.used_bytes(), 0);
    }
}
