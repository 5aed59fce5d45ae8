//! The values at a Master, by their hashes: whoever sets a parameter again, as servers of dynamic_reconfigure do with
//! all of theirs, has not changed it.

use std::collections::{BTreeMap, HashMap};
use std::hash::{BuildHasher, RandomState};

use ros::bus::{ParamChange, ParamValue};

use super::super::names::{join, strip_parent};

/// Maximum number of parameters that are known; beyond it all are forgotten, and count as changed when they are set.
const MAX_PARAMETERS: usize = 50_000;

/// Hashes of values by key, without dictionaries.
#[derive(Default)]
pub(super) struct KnownValues {
    hashing: RandomState,
    hashes: HashMap<String, u64>,
}

impl KnownValues {
    /// Remembers a value, or those of a dictionary.
    pub(super) fn new(key: &str, value: &ParamValue) -> Self {
        let mut known = Self::default();
        known.select_changed(key, value.clone());
        known
    }

    /// Returns what differs from before, and remembers it; `None` if that is nothing.
    pub(super) fn select_change(&mut self, (key, value): ParamChange) -> Option<ParamChange> {
        // A Master reports namespaces with a slash at the end.
        let key = match key.trim_end_matches('/') {
            "" => "/".to_owned(),
            key => key.to_owned(),
        };
        match value {
            Some(value) => Some((key.clone(), Some(self.select_changed(&key, value)?))),
            None => {
                self.hashes.retain(|known, _| *known != key && strip_parent(known, &key).is_none());
                Some((key, None))
            }
        }
    }

    fn select_changed(&mut self, key: &str, value: ParamValue) -> Option<ParamValue> {
        if let ParamValue::Map(entries) = value {
            let changed = entries.into_iter().filter_map(|(entry, value)| {
                let value = self.select_changed(&join(key, &entry), value)?;
                Some((entry, value))
            });
            let changed: BTreeMap<_, _> = changed.collect();
            return (!changed.is_empty()).then_some(ParamValue::Map(changed));
        }
        let hash = self.hashing.hash_one(&value);
        if self.hashes.len() >= MAX_PARAMETERS {
            self.hashes.clear();
        }
        (self.hashes.insert(key.to_owned(), hash) != Some(hash)).then_some(value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(json: &str) -> ParamValue {
        serde_json::from_str(json).expect(json)
    }

    #[test]
    fn what_is_set_again_has_not_changed() {
        let mut known = KnownValues::new("/", &value(r#"{"see": {"gain": 0.5, "mode": 1}}"#));
        let mut select = |key: &str, json: Option<&str>| known.select_change((key.to_owned(), json.map(value)));
        let changed = |key: &str, json: Option<&str>| Some((key.to_owned(), json.map(value)));
        assert_eq!(select("/see/gain", Some("0.5")), None);
        assert_eq!(select("/see/gain", Some("1.0")), changed("/see/gain", Some("1.0")));
        let again = r#"{"gain": 1.0, "mode": 1}"#;
        assert_eq!(select("/see/", Some(again)), None);
        assert_eq!(select("/see/", Some(r#"{"gain": 1.0, "mode": 2}"#)), changed("/see", Some(r#"{"mode": 2}"#)));
        // What was deleted is new.
        assert_eq!(select("/see/mode", None), changed("/see/mode", None));
        assert_eq!(select("/see/mode", Some("2")), changed("/see/mode", Some("2")));
        assert_eq!(select("/see", None), changed("/see", None));
        assert_eq!(select("/see/", Some(again)), changed("/see", Some(again)));
    }
}
