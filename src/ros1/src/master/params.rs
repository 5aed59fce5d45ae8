//! The parameter server's tree. Pure state.

use std::collections::BTreeMap;

use crate::names;
use crate::xmlrpc::{MAX_DEPTH, Value};

/// Maximum size of all parameters in bytes. They are held by the shim, whose memory is bounded, and reading all of them
/// takes three times their size in addition.
const MAX_BYTES: usize = 24 << 20;

/// Nested structs, as in ROS: `/a/b` is member `b` of member `a`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Params {
    root: Value,
    /// Approximate size of the tree; never less than that of its values.
    size: usize,
}

impl Default for Params {
    fn default() -> Self {
        Self { root: Value::Struct(BTreeMap::new()), size: 0 }
    }
}

/// Error setting a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum ParamError {
    #[error("the root of the parameter tree can only be a dictionary")]
    Root,
    #[error("the parameter server is full; its limit is {MAX_BYTES} bytes")]
    Full,
    #[error("the value is nested too deep; the limit is {MAX_DEPTH} levels below the root")]
    Deep,
}

impl Params {
    /// Sets `key` (canonical). A struct replaces the whole namespace; a value on the path becomes a namespace.
    pub(super) fn set(&mut self, key: &str, value: Value) -> Result<(), ParamError> {
        let depth = names::parts(key).count();
        if depth == 0 && value.as_struct().is_none() {
            return Err(ParamError::Root);
        }
        if depth + value.depth() > MAX_DEPTH {
            return Err(ParamError::Deep);
        }
        let replaced = self.get(key).map_or(0, Value::size);
        let added = value.size() + key.len();
        let mut size = self.size.saturating_sub(replaced) + added;
        if size > MAX_BYTES {
            // The running sum can only be too high: count again before refusing.
            size = self.root.size().saturating_sub(replaced) + added;
        }
        if size > MAX_BYTES {
            return Err(ParamError::Full);
        }
        let mut place = &mut self.root;
        for part in names::parts(key) {
            if place.as_struct().is_none() {
                *place = Value::Struct(BTreeMap::new());
            }
            let Value::Struct(members) = place else {
                return Err(ParamError::Root);
            };
            place = members.entry(part.to_owned()).or_insert_with(|| Value::Struct(BTreeMap::new()));
        }
        *place = value;
        self.size = size;
        Ok(())
    }

    /// Returns the approximate size of the tree in bytes; never less than that of its values.
    pub(super) fn size(&self) -> usize {
        self.size
    }

    /// Returns the value or namespace at `key`.
    pub(super) fn get(&self, key: &str) -> Option<&Value> {
        names::parts(key).try_fold(&self.root, |place, part| place.get(part))
    }

    /// Deletes `key`; returns false if it was not set. Deleting the root empties the tree.
    pub(super) fn delete(&mut self, key: &str) -> bool {
        let mut parts: Vec<&str> = names::parts(key).collect();
        let Some(last) = parts.pop() else {
            *self = Self::default();
            return true;
        };
        let mut place = &mut self.root;
        for part in parts {
            let Value::Struct(members) = place else {
                return false;
            };
            let Some(next) = members.get_mut(part) else {
                return false;
            };
            place = next;
        }
        let Value::Struct(members) = place else {
            return false;
        };
        let Some(gone) = members.remove(last) else {
            return false;
        };
        self.size = self.size.saturating_sub(gone.size() + key.len());
        true
    }

    /// Searches for `key` in `namespace` and the enclosing namespaces; only the first part of the key must exist.
    pub(super) fn search(&self, namespace: &str, key: &str) -> Option<String> {
        if key.starts_with('/') {
            return self.get(key).map(|_| key.to_owned());
        }
        let first = names::parts(key).next()?;
        let mut around: Vec<&str> = names::parts(namespace).collect();
        loop {
            let base = around.join("/");
            if self.get(&format!("{base}/{first}")).is_some() {
                return Some(names::canonical(&format!("{base}/{key}")));
            }
            around.pop()?;
        }
    }

    /// Returns the keys of all values that are not namespaces.
    pub(super) fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        collect(&self.root, &mut String::new(), &mut names);
        names
    }
}

fn collect(value: &Value, path: &mut String, names: &mut Vec<String>) {
    match value {
        Value::Struct(members) => {
            for (name, member) in members {
                let length = path.len();
                path.push('/');
                path.push_str(name);
                collect(member, path, names);
                path.truncate(length);
            }
        }
        _ => names.push(path.clone()),
    }
}

/// Returns the notifications for parameter subscribers after `key` was set to `value` (deleted: an empty struct): the
/// changed keys for each subscribed key, as rosmaster computes them.
pub(super) fn updates(
    watchers: &BTreeMap<String, Vec<String>>,
    key: &str,
    value: &Value,
) -> Vec<(String, String, Value)> {
    let changed = with_slash(key);
    let mut updates = Vec::new();
    for (watched, apis) in watchers {
        let namespace = with_slash(watched);
        let update = if changed.starts_with(&namespace) {
            (changed.clone(), value.clone())
        } else if let Some(below) = namespace.strip_prefix(&changed) {
            let now = names::parts(below).try_fold(value, |place, part| place.get(part));
            let gone = || Value::Struct(BTreeMap::new());
            (namespace.clone(), now.cloned().unwrap_or_else(gone))
        } else {
            continue;
        };
        for api in apis {
            updates.push((api.clone(), update.0.clone(), update.1.clone()));
        }
    }
    updates
}

fn with_slash(key: &str) -> String {
    if key.ends_with('/') { key.to_owned() } else { format!("{key}/") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Params {
        let mut params = Params::default();
        params.set("/a/b", Value::Int(1)).unwrap();
        params.set("/a/c/d", Value::from("x")).unwrap();
        params.set("/top", Value::Bool(true)).unwrap();
        params
    }

    #[test]
    fn namespaces_are_structs() {
        let mut params = sample();
        assert_eq!(params.get("/a/c").unwrap().get("d"), Some(&Value::from("x")));
        assert_eq!(params.names(), ["/a/b", "/a/c/d", "/top"]);
        params.set("/top/below", Value::Int(2)).unwrap();
        assert_eq!(params.get("/top/below"), Some(&Value::Int(2)));
        params.set("/a", Value::Struct(BTreeMap::new())).unwrap();
        assert_eq!(params.names(), ["/top/below"]);
        assert_eq!(params.set("/", Value::Int(1)), Err(ParamError::Root));
        let deep = "/x".repeat(MAX_DEPTH);
        params.set(&deep, Value::Int(1)).unwrap();
        let deeper = params.set(&deep, Value::Array(Vec::new()));
        assert_eq!(deeper, Err(ParamError::Deep));
    }

    #[test]
    fn deleting_takes_only_what_is_there() {
        let mut params = sample();
        assert!(!params.delete("/a/x"));
        assert!(!params.delete("/top/x"));
        assert!(params.delete("/a"));
        assert_eq!(params.names(), ["/top"]);
        assert!(params.delete("/"));
        assert_eq!(params, Params::default());
    }

    #[test]
    fn search_goes_upwards_by_the_first_part() {
        let params = sample();
        assert_eq!(params.search("/a/n", "b").as_deref(), Some("/a/b"));
        assert_eq!(params.search("/a/c/n", "top").as_deref(), Some("/top"));
        assert_eq!(params.search("/a/n", "c/none").as_deref(), Some("/a/c/none"));
        assert_eq!(params.search("/a", "nope"), None);
        assert_eq!(params.search("/a", "/top").as_deref(), Some("/top"));
    }

    #[test]
    fn the_tree_has_a_size() {
        let mut params = Params::default();
        let big = Value::Base64(vec![0; MAX_BYTES / 2]);
        params.set("/a", big.clone()).unwrap();
        assert_eq!(params.set("/b", big.clone()), Err(ParamError::Full));
        params.set("/a", big.clone()).unwrap();
        assert!(params.delete("/a"));
        params.set("/b", big).unwrap();
    }

    #[test]
    fn watchers_hear_of_what_concerns_them() {
        let watchers: BTreeMap<_, _> =
            ["/a/", "/a/b", "/other"].map(|key| (key.to_owned(), vec![format!("api of {key}")])).into();
        let told = |key: &str, value: Value| -> Vec<(String, Value)> {
            let all = updates(&watchers, key, &value);
            all.into_iter().map(|(_, key, value)| (key, value)).collect()
        };
        let one = Value::Int(1);
        assert_eq!(told("/a/b", one.clone()), [("/a/b/".to_owned(), one.clone()), ("/a/b/".to_owned(), one.clone())]);
        assert_eq!(told("/a/x/y", one.clone()), [("/a/x/y/".to_owned(), one.clone())]);
        let tree = Value::Struct([("b".to_owned(), one.clone())].into());
        assert_eq!(told("/a", tree.clone()), [("/a/".to_owned(), tree), ("/a/b/".to_owned(), one)]);
        let empty = Value::Struct(BTreeMap::new());
        assert_eq!(told("/a", empty.clone()), [("/a/".to_owned(), empty.clone()), ("/a/b/".to_owned(), empty.clone())]);
        assert_eq!(told("/aa", empty), []);
    }
}
