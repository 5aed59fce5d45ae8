//! Packing that outlives the build that began it, and what ends it all the same: the end of the daemon, or a disk that
//! has no room for it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use foreign::cancel::Cancel;

/// Flags of the builds that pack layers, by the ids of the builds.
#[derive(Debug, Clone, Default)]
pub(crate) struct Packings(Arc<Mutex<PackingFlags>>);

#[derive(Debug, Default)]
struct PackingFlags {
    /// The daemon ends.
    are_over: bool,
    of_builds: HashMap<String, Cancel>,
}

impl Packings {
    /// Returns the flag under which layers of this build are packed.
    pub(crate) fn begin(&self, build: &str) -> Cancel {
        let mut all = self.lock();
        let flag = all.of_builds.entry(build.to_owned()).or_default().clone();
        if all.are_over {
            flag.cancel();
        }
        flag
    }

    /// Gives up the packing of this build.
    pub(crate) fn give_up(&self, build: &str) {
        if let Some(flag) = self.lock().of_builds.get(build) {
            flag.cancel();
        }
    }

    /// Gives up all packing, also what would begin later.
    pub(crate) fn give_up_all(&self) {
        let mut all = self.lock();
        all.are_over = true;
        all.of_builds.values().for_each(Cancel::cancel);
    }

    /// Forgets a build that packs nothing any more.
    pub(crate) fn forget(&self, build: &str) {
        self.lock().of_builds.remove(build);
    }

    fn lock(&self) -> MutexGuard<'_, PackingFlags> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packing_of_one_build_or_of_all_is_given_up() {
        let packings = Packings::default();
        let (one, again, two) = (packings.begin("one"), packings.begin("one"), packings.begin("two"));
        packings.give_up("one");
        packings.give_up("unknown");
        assert_eq!([&one, &again, &two].map(Cancel::is_cancelled), [true, true, false]);
        packings.forget("one");
        assert!(!packings.begin("one").is_cancelled());
        packings.give_up_all();
        assert!(two.is_cancelled() && packings.begin("three").is_cancelled());
    }
}
