//! Parameters that one end sets in the other's name: their changes do not go back.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};

use parking_lot::Mutex;
use ros::bus::ParamValue;

/// What was set in the name of the other end. Of values only hashes are kept: all of a robot's parameters may be among them.
#[derive(Debug, Default)]
pub struct Echoes {
    hashing: RandomState,
    set: Mutex<BTreeMap<String, u64>>,
}

impl Echoes {
    /// Notes that this value is about to be set.
    pub fn expect(&self, key: &str, value: &ParamValue) {
        let hash = self.hashing.hash_one(value);
        self.set.lock().insert(key.to_owned(), hash);
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
        let is_echo = set.get(key).copied() == hash;
        if !is_echo {
            set.remove(key);
        }
        is_echo
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
        echoes.expect("/a", &one);
        echoes.forget("/a");
        assert!(echoes.is_echo("/a", None), "as the other end did");
    }
}
