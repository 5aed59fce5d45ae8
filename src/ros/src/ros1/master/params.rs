//! The parameter server's tree. Pure state.

use std::collections::BTreeMap;

use crate::ros1::names;
use crate::ros1::xmlrpc::{MAX_DEPTH, Value};

/// All parameters together, at most. They are in the shim, whose memory is bounded, and whoever reads all of them has the
/// shim hold them three times more.
const MAX_BYTES: usize = 24 << 20;

/// Nested structs, as ROS has it: `/a/b` is member `b` of member `a`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Params {
    root: Value,
    /// Roughly what the tree takes; never less than its values.
    size: usize,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            root: Value::Struct(BTreeMap::new()),
            size: 0,
        }
    }
}

/// Why a value was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum Refused {
    #[error("the root of the parameter tree can only be a dictionary")]
    Root,
    #[error("the parameter server is full; {MAX_BYTES} bytes is all it takes")]
    Full,
    #[error("the value is nested too deep; {MAX_DEPTH} levels below the root is all it takes")]
    Deep,
}

impl Params {
    /// Sets `key` (canonical); a struct replaces the whole namespace, a value in the way becomes one.
    pub(super) fn set(&mut self, key: &str, value: Value) -> Result<(), Refused> {
        let depth = names::parts(key).count();
        if depth == 0 && value.as_struct().is_none() {
            return Err(Refused::Root);
        }
        if depth + value.depth() > MAX_DEPTH {
            return Err(Refused::Deep);
        }
        let replaced = self.get(key).map_or(0, Value::size);
        let added = value.size() + key.len();
        let mut size = self.size.saturating_sub(replaced) + added;
        if size > MAX_BYTES {
            // The running sum only ever errs upwards: count again before saying no.
            size = self.root.size().saturating_sub(replaced) + added;
        }
        if size > MAX_BYTES {
            return Err(Refused::Full);
        }
        let mut place = &mut self.root;
        for part in names::parts(key) {
            if place.as_struct().is_none() {
                *place = Value::Struct(BTreeMap::new());
            }
            let Value::Struct(members) = place else {
                return Err(Refused::Root);
            };
            place = members
                .entry(part.to_owned())
                .or_insert_with(|| Value::Struct(BTreeMap::new()));
        }
        *place = value;
        self.size = size;
        Ok(())
    }

    /// About how many bytes the tree takes; never less than its values.
    pub(super) fn size(&self) -> usize {
        self.size
    }

    /// The value or namespace at `key`.
    pub(super) fn get(&self, key: &str) -> Option<&Value> {
        names::parts(key).try_fold(&self.root, |place, part| place.get(part))
    }

    /// Removes `key`; false if it was not set. The root is emptied.
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

    /// Looks for `key` in `namespace` and the namespaces around it; only the key's first part must be there.
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

    /// Keys of all values that are no namespaces.
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

/// What the subscribers of parameters must be told after `key` was set to `value` (deleted: an empty struct):
/// the keys that changed for each subscribed key, as rosmaster computes them.
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
    if key.ends_with('/') {
        key.to_owned()
    } else {
        format!("{key}/")
    }
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
        assert_eq!(
            params.get("/a/c").unwrap().get("d"),
            Some(&Value::from("x"))
        );
        assert_eq!(params.names(), ["/a/b", "/a/c/d", "/top"]);
        params.set("/top/below", Value::Int(2)).unwrap();
        assert_eq!(params.get("/top/below"), Some(&Value::Int(2)));
        params.set("/a", Value::Struct(BTreeMap::new())).unwrap();
        assert_eq!(params.names(), ["/top/below"]);
        assert_eq!(params.set("/", Value::Int(1)), Err(Refused::Root));
        let deep = "/x".repeat(MAX_DEPTH);
        params.set(&deep, Value::Int(1)).unwrap();
        let deeper = params.set(&deep, Value::Array(Vec::new()));
        assert_eq!(deeper, Err(Refused::Deep));
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
        assert_eq!(
            params.search("/a/n", "c/none").as_deref(),
            Some("/a/c/none")
        );
        assert_eq!(params.search("/a", "nope"), None);
        assert_eq!(params.search("/a", "/top").as_deref(), Some("/top"));
    }

    #[test]
    fn the_tree_has_a_size() {
        let mut params = Params::default();
        let big = Value::Base64(vec![0; MAX_BYTES / 2]);
        params.set("/a", big.clone()).unwrap();
        assert_eq!(params.set("/b", big.clone()), Err(Refused::Full));
        params.set("/a", big.clone()).unwrap();
        assert!(params.delete("/a"));
        params.set("/b", big).unwrap();
    }

    #[test]
    fn watchers_hear_of_what_concerns_them() {
        let watchers: BTreeMap<_, _> = ["/a/", "/a/b", "/other"]
            .map(|key| (key.to_owned(), vec![format!("api of {key}")]))
            .into();
        let told = |key: &str, value: Value| -> Vec<(String, Value)> {
            let all = updates(&watchers, key, &value);
            all.into_iter()
                .map(|(_, key, value)| (key, value))
                .collect()
        };
        let one = Value::Int(1);
        assert_eq!(
            told("/a/b", one.clone()),
            [
                ("/a/b/".to_owned(), one.clone()),
                ("/a/b/".to_owned(), one.clone())
            ]
        );
        assert_eq!(
            told("/a/x/y", one.clone()),
            [("/a/x/y/".to_owned(), one.clone())]
        );
        let tree = Value::Struct([("b".to_owned(), one.clone())].into());
        assert_eq!(
            told("/a", tree.clone()),
            [("/a/".to_owned(), tree), ("/a/b/".to_owned(), one)]
        );
        let empty = Value::Struct(BTreeMap::new());
        assert_eq!(
            told("/a", empty.clone()),
            [
                ("/a/".to_owned(), empty.clone()),
                ("/a/b/".to_owned(), empty.clone())
            ]
        );
        assert_eq!(told("/aa", empty), []);
    }
}
