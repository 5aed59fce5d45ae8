//! Suppresses the echo of parameter changes that one end makes on behalf of the other.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{BuildHasher, RandomState};

use parking_lot::Mutex;
use ros::bus::ParamValue;

/// Number of values remembered per parameter. If a parameter is set more often than this before the first change is
/// reported, its last values are echoed.
const MAX_STAMPS: usize = 64;

/// Parameter values that were set on behalf of the other end and whose changes may still be reported, in order. Only
/// hashes of the values are kept, because all parameters of a robot may be among them.
#[derive(Debug, Default)]
pub struct Echoes {
    hashing: RandomState,
    set: Mutex<BTreeMap<String, VecDeque<u64>>>,
}

impl Echoes {
    /// Records that this value is about to be set.
    pub fn expect(&self, key: &str, value: &ParamValue) {
        let hash = self.hashing.hash_one(value);
        let mut set = self.set.lock();
        let values = set.entry(key.to_owned()).or_default();
        if values.back() != Some(&hash) {
            if values.len() == MAX_STAMPS {
                values.pop_front();
            }
            values.push_back(hash);
        }
    }

    /// Forgets a parameter that is no longer set on behalf of the other end.
    pub fn forget(&self, key: &str) {
        self.set.lock().remove(key);
    }

    /// Returns whether a change is the echo of a value set here, or the deletion of a parameter that was not set here.
    /// If it is not, the parameter is forgotten: it belongs to this end again.
    pub fn is_echo(&self, key: &str, value: Option<&ParamValue>) -> bool {
        let hash = value.map(|value| self.hashing.hash_one(value));
        let mut set = self.set.lock();
        let Some(values) = set.get_mut(key) else {
            return hash.is_none();
        };
        match values.iter().position(|known| Some(*known) == hash) {
            // Changes are reported in order, so the earlier values will not be reported any more.
            Some(at) => drop(values.drain(..at)),
            None => {
                set.remove(key);
                return false;
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_set_here_is_an_echo_until_it_changes() {
        let echoes = Echoes::default();
        let (one, two) = (ParamValue::Double(f64::NAN), ParamValue::Int(2));
        echoes.expect("/a", &one);
        assert!(echoes.is_echo("/a", Some(&one)));
        assert!(!echoes.is_echo("/a", Some(&two)));
        assert!(!echoes.is_echo("/a", Some(&one)), "it is set by this end now");
        echoes.expect("/a", &one);
        assert!(!echoes.is_echo("/a", None), "it was removed here");
        // Values are reported in the order in which they were set.
        let three = ParamValue::Int(3);
        for value in [&one, &two, &two, &three] {
            echoes.expect("/a", value);
        }
        for value in [&one, &three, &three] {
            assert!(echoes.is_echo("/a", Some(value)), "{value:?}");
        }
        assert!(!echoes.is_echo("/a", Some(&two)), "this end has set it back");
        for number in 0..1000 {
            echoes.expect("/a", &ParamValue::Int(number));
        }
        assert_eq!(echoes.set.lock()["/a"].len(), MAX_STAMPS);
        assert!(echoes.is_echo("/a", Some(&ParamValue::Int(999))));
        echoes.expect("/a", &one);
        echoes.forget("/a");
        assert!(echoes.is_echo("/a", None), "as the other end did");
    }
}
