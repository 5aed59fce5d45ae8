//! Tracks what a stateful service loses at a hand-over: the inputs and calls that only one side received.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::request::Responder;

/// Number of names listed in the message; the others are only counted.
const NAMED: usize = 5;

/// Counts, by name, the inputs and calls that each side did not receive. Messages that both receive, such as latched
/// ones, are not recorded.
#[derive(Debug, Clone, Default)]
pub struct HandOverLedger {
    entries: BTreeMap<Arc<str>, LedgerEntry>,
    /// The cloud was reached before, so the next one is not the first.
    reached: bool,
    /// The servant was replaced by a new one that knows nothing.
    renewed: bool,
}

#[derive(Debug, Clone)]
struct LedgerEntry {
    told: u64,
    since: Instant,
    missed: [UnsentInputs; 2],
}

/// Inputs and calls of one name that one side did not receive.
#[derive(Debug, Clone, Copy, Default)]
struct UnsentInputs {
    count: u64,
    since: Option<Instant>,
}

/// Inputs or calls of one name that a side did not receive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MissedInputs {
    /// Name of the topic, service or action.
    pub name: Arc<str>,
    /// Number of inputs or calls.
    pub count: u64,
    /// Time since the first of them.
    pub since: Duration,
}

/// A hand-over from one side to the other.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HandOver {
    /// The side that takes over.
    pub to: Responder,
    /// The servant is a new one without any state.
    pub renewed: bool,
    /// Inputs and calls it did not receive, largest count first; never empty.
    pub missed: Vec<MissedInputs>,
}

impl HandOverLedger {
    /// Records an input or a call of the application.
    pub fn record_input(&mut self, now: Instant, name: &Arc<str>) {
        let entry = self.entries.entry(name.clone()).or_insert_with(|| LedgerEntry {
            told: 0,
            since: now,
            missed: [UnsentInputs::default(); 2],
        });
        entry.told += 1;
        for missed in &mut entry.missed {
            missed.count += 1;
            missed.since.get_or_insert(now);
        }
    }

    /// Records that a side received one of them.
    pub fn record_delivery(&mut self, side: Responder, name: &str) {
        if let Some(entry) = self.entries.get_mut(name) {
            let missed = &mut entry.missed[side.index()];
            missed.count = missed.count.saturating_sub(1);
            if missed.count == 0 {
                missed.since = None;
            }
        }
    }

    /// Handles the start of a new process of the local original, which has received nothing.
    pub fn on_local_start(&mut self) {
        self.forget(Responder::Local);
    }

    /// Handles the link coming up; unless it is `resumed` or comes up for the first time, the servant is a new one.
    pub fn link_up(&mut self, resumed: bool) {
        if std::mem::replace(&mut self.reached, true) && !resumed {
            self.forget(Responder::Cloud);
            self.renewed = true;
        }
    }

    fn forget(&mut self, side: Responder) {
        for entry in self.entries.values_mut() {
            entry.missed[side.index()] = UnsentInputs { count: entry.told, since: Some(entry.since) };
        }
    }

    /// Hands over to `to` and returns what that side did not receive, once. Returns `None` if it received everything.
    pub fn hand_over(&mut self, now: Instant, to: Responder) -> Option<HandOver> {
        let renewed = to == Responder::Cloud && std::mem::take(&mut self.renewed);
        let mut missed = Vec::new();
        for (name, entry) in &mut self.entries {
            let behind = std::mem::take(&mut entry.missed[to.index()]);
            if let Some(since) = behind.since {
                missed.push(MissedInputs {
                    name: name.clone(),
                    count: behind.count,
                    since: now.saturating_duration_since(since),
                });
            }
        }
        missed.sort_by(|a, b| b.count.cmp(&a.count).then_with(|| a.name.cmp(&b.name)));
        (!missed.is_empty()).then_some(HandOver { to, renewed, missed })
    }
}

impl fmt::Display for HandOver {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (who, other) = match (self.to, self.renewed) {
            (Responder::Local, _) => ("the local original", "the cloud"),
            (Responder::Cloud, false) => ("the cloud", "the local original"),
            (Responder::Cloud, true) => ("a new servant", "the previous one"),
        };
        write!(out, "{who} takes over without having received: ")?;
        for (index, missed) in self.missed.iter().take(NAMED).enumerate() {
            let comma = if index == 0 { "" } else { ", " };
            let since = missed.since.as_secs_f64();
            write!(out, "{comma}{} of {} since {since:.1} s ago", missed.count, missed.name)?;
        }
        match self.missed.len().saturating_sub(NAMED) {
            0 => {}
            more => write!(out, ", and {more} more names")?,
        }
        write!(out, "; state that {other} built from them is not transferred")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn name(text: &str) -> Arc<str> {
        text.into()
    }

    #[test]
    fn each_side_lacks_what_only_the_other_was_given() {
        let mut ledger = HandOverLedger::default();
        let (scan, reset, now) = (name("/scan"), name("/reset"), Instant::now());
        ledger.link_up(false);
        for second in 0..10 {
            ledger.record_input(now + second * SECOND, &scan);
            ledger.record_delivery(Responder::Cloud, "/scan");
        }
        ledger.record_input(now + 4 * SECOND, &reset);
        ledger.record_delivery(Responder::Cloud, "/reset");
        ledger.on_local_start();
        let over = ledger.hand_over(now + 10 * SECOND, Responder::Local).unwrap();
        assert_eq!(
            over.to_string(),
            "the local original takes over without having received: 10 of /scan since 10.0 s ago, 1 of /reset since \
                6.0 s ago; state that the cloud built from them is not transferred"
        );
        for second in 10..13 {
            ledger.record_input(now + second * SECOND, &scan);
            ledger.record_delivery(Responder::Local, "/scan");
        }
        ledger.link_up(true);
        let back = ledger.hand_over(now + 14 * SECOND, Responder::Cloud).unwrap();
        assert_eq!((back.missed[0].count, back.missed[0].since), (3, 4 * SECOND));
        assert!(back.to_string().starts_with("the cloud takes over without"));
        assert_eq!(back.missed.len(), 1, "it has /reset");
        // A loss is reported once.
        assert_eq!(ledger.hand_over(now + 14 * SECOND, Responder::Cloud), None);
        assert_eq!(ledger.hand_over(now + 14 * SECOND, Responder::Local), None);
    }

    #[test]
    fn a_new_servant_knows_nothing_and_the_first_one_has_what_waited_for_it() {
        let mut ledger = HandOverLedger::default();
        let (scan, now) = (name("/scan"), Instant::now());
        ledger.record_input(now, &scan);
        ledger.record_delivery(Responder::Cloud, "/scan");
        ledger.link_up(false);
        assert_eq!(ledger.hand_over(now, Responder::Cloud), None);
        ledger.link_up(false);
        let back = ledger.hand_over(now + SECOND, Responder::Cloud).unwrap();
        let text = back.to_string();
        assert!(
            text.starts_with("a new servant takes over without having received: 1 of /scan since 1.0 s ago"),
            "{text}"
        );
    }

    #[test]
    fn what_is_told_is_short() {
        let mut ledger = HandOverLedger::default();
        for number in 0..100 {
            ledger.record_input(Instant::now(), &name(&format!("/topic{number}")));
        }
        let text = ledger.hand_over(Instant::now(), Responder::Local).unwrap();
        let text = text.to_string();
        assert!(text.contains(", and 95 more names;"), "{text}");
    }

    proptest! {
        /// For any sequence of events, a side lacks as many messages as were recorded and not delivered to it since its
        /// last hand-over.
        #[test]
        fn nothing_is_counted_twice_or_left_out(ops in prop::collection::vec((0u8..6, any::<bool>()), 0..200)) {
            let mut ledger = HandOverLedger::default();
            let (scan, now) = (name("/scan"), Instant::now());
            let (mut told, mut lacks) = (0u64, [0u64; 2]);
            ledger.link_up(false);
            for (op, flag) in ops {
                let side = if flag { Responder::Cloud } else { Responder::Local };
                match op {
                    0..=2 => {
                        ledger.record_input(now, &scan);
                        told += 1;
                        for lacks in &mut lacks {
                            *lacks += 1;
                        }
                        ledger.record_delivery(side, "/scan");
                        lacks[side.index()] -= 1;
                    }
                    3 => {
                        ledger.on_local_start();
                        lacks[Responder::Local.index()] = told;
                    }
                    4 => {
                        ledger.link_up(flag);
                        if !flag {
                            lacks[Responder::Cloud.index()] = told;
                        }
                    }
                    _ => {
                        let over = ledger.hand_over(now, side);
                        let count = over.map_or(0, |over| over.missed[0].count);
                        prop_assert_eq!(count, lacks[side.index()]);
                        lacks[side.index()] = 0;
                    }
                }
            }
        }
    }
}
