//! Parameters that one end sets in the other's name: their changes do not go back.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{BuildHasher, RandomState};

use parking_lot::Mutex;
use ros::bus::ParamValue;

/// Values of one parameter that are remembered: who sets it so often before the first change is told is heard again by its last ones.
const REMEMBERED: usize = 64;

/// What was set in the name of the other end, and may be told yet, in that order. Of values only hashes are kept: all of a robot's
/// parameters may be among them.
#[derive(Debug, Default)]
pub struct Echoes {
    hashing: RandomState,
    set: Mutex<BTreeMap<String, VecDeque<u64>>>,
}

impl Echoes {
    /// Notes that this value is about to be set.
    pub fn expect(&self, key: &str, value: &ParamValue) {
        let hash = self.hashing.hash_one(value);
        let mut set = self.set.lock();
        let values = set.entry(key.to_owned()).or_default();
        if values.back() != Some(&hash) {
            if values.len() == REMEMBERED {
                values.pop_front();
            }
            values.push_back(hash);
        }
    }

    /// Forgets a parameter that is set here no more.
    pub fn forget(&self, key: &str) {
        self.set.lock().remove(key);
    }

    /// Whether a parameter is now as it was set here, or neither was set here nor is there. If not, it is forgotten: it belongs to this
    /// end again.
    pub fn is_echo(&self, key: &str, value: Option<&ParamValue>) -> bool {
        let hash = value.map(|value| self.hashing.hash_one(value));
        let mut set = self.set.lock();
        let Some(values) = set.get_mut(key) else {
            return hash.is_none();
        };
        match values.iter().position(|known| Some(*known) == hash) {
            // Changes are told in their order; those before it will not be told any more.
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
    fn what_was_set_here_is_an_echo_until_it_changes() {
        let echoes = Echoes::default();
        let (one, two) = (ParamValue::Double(f64::NAN), ParamValue::Int(2));
        echoes.expect("/a", &one);
        assert!(echoes.is_echo("/a", Some(&one)));
        assert!(!echoes.is_echo("/a", Some(&two)));
        assert!(
            !echoes.is_echo("/a", Some(&one)),
            "it is set by this end now"
        );
        echoes.expect("/a", &one);
        assert!(!echoes.is_echo("/a", None), "it was removed here");
        // One that was set after the other is told after the other.
        let three = ParamValue::Int(3);
        for value in [&one, &two, &two, &three] {
            echoes.expect("/a", value);
        }
        for value in [&one, &three, &three] {
            assert!(echoes.is_echo("/a", Some(value)), "{value:?}");
        }
        assert!(
            !echoes.is_echo("/a", Some(&two)),
            "this end has set it back"
        );
        for number in 0..1000 {
            echoes.expect("/a", &ParamValue::Int(number));
        }
        assert_eq!(echoes.set.lock()["/a"].len(), REMEMBERED);
        assert!(echoes.is_echo("/a", Some(&ParamValue::Int(999))));
        echoes.expect("/a", &one);
        echoes.forget("/a");
        assert!(echoes.is_echo("/a", None), "as the other end did");
    }
}
