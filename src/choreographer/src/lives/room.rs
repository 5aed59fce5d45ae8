//! Room for those who wait: of the servants that nobody is connected to, as many are ended as it takes.

use super::Inner;
use crate::admission::Amount;

impl Inner {
    /// Ends idle servants, those first that have been idle longest, until there will be room for everybody who waits.
    pub(crate) fn make_room(&self) {
        let servants = self.servants.lock();
        let mut lacking = self.admission.lacking();
        if lacking == Amount::default() {
            return;
        }
        let (ending, living): (Vec<_>, Vec<_>) = servants
            .all
            .values()
            .filter(|handle| handle.promise().is_some())
            .partition(|handle| handle.is_ending());
        // What those have is about to be free.
        for handle in ending {
            lacking = lacking.minus(self.promised(handle));
        }
        let idle = living.into_iter();
        let mut idle: Vec<_> = idle
            .filter_map(|handle| Some((handle.idle_until()?, handle)))
            .collect();
        idle.sort_by_key(|(until, _)| *until);
        for (_, handle) in idle {
            if lacking == Amount::default() {
                return;
            }
            let has = self.promised(handle);
            // It may have none of what is lacking.
            if lacking.minus(has) != lacking {
                handle.end("its room was needed");
                lacking = lacking.minus(has);
            }
        }
    }
}
