//! What a stateful service loses when one side hands over to the other: whatever only one of them was given.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::request::Side;

/// Names that are told; of the others only how many there are.
const NAMED: usize = 5;

/// Which inputs and calls each side was given, by name. What both have (latched messages, say) is not noted.
#[derive(Debug, Clone, Default)]
pub struct Ledger {
    entries: BTreeMap<Arc<str>, Entry>,
    /// The cloud that is reached next is not the first one.
    reached: bool,
    /// Another servant has taken the place of the one that was told all this.
    renewed: bool,
}

#[derive(Debug, Clone)]
struct Entry {
    told: u64,
    since: Instant,
    missed: [Behind; 2],
}

/// What one side was not given.
#[derive(Debug, Clone, Copy, Default)]
struct Behind {
    count: u64,
    since: Option<Instant>,
}

/// Inputs or calls of one name that a side was not given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Missed {
    /// The topic, service or action.
    pub name: Arc<str>,
    /// The number of inputs.
    pub count: u64,
    /// How long ago the first of them was.
    pub since: Duration,
}

/// One side goes on in place of the other.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HandOver {
    /// Who goes on.
    pub to: Side,
    /// The cloud's side is another servant than before: it knows nothing.
    pub renewed: bool,
    /// What it was not given, the most first; never empty.
    pub missed: Vec<Missed>,
}

impl Ledger {
    /// The application has published an input, or has called.
    pub fn told(&mut self, now: Instant, name: &Arc<str>) {
        let entry = self.entries.entry(name.clone()).or_insert_with(|| Entry {
            told: 0,
            since: now,
            missed: [Behind::default(); 2],
        });
        entry.told += 1;
        for missed in &mut entry.missed {
            missed.count += 1;
            missed.since.get_or_insert(now);
        }
    }

    /// A side was given one of these.
    pub fn given(&mut self, side: Side, name: &str) {
        if let Some(entry) = self.entries.get_mut(name) {
            let missed = &mut entry.missed[side.index()];
            missed.count = missed.count.saturating_sub(1);
            if missed.count == 0 {
                missed.since = None;
            }
        }
    }

    /// The process of the local original is a new one: it was given nothing.
    pub fn original_begins(&mut self) {
        self.forget(Side::Local);
    }

    /// The link is up; unless it is `resumed`, or this is the first time, the servant is a new one.
    pub fn link_up(&mut self, resumed: bool) {
        if std::mem::replace(&mut self.reached, true) && !resumed {
            self.forget(Side::Cloud);
            self.renewed = true;
        }
    }

    fn forget(&mut self, side: Side) {
        for entry in self.entries.values_mut() {
            entry.missed[side.index()] = Behind {
                count: entry.told,
                since: Some(entry.since),
            };
        }
    }

    /// This side goes on from now on: what it was not given until now. None where it has all; told once.
    pub fn hands_over(&mut self, now: Instant, to: Side) -> Option<HandOver> {
        let renewed = to == Side::Cloud && std::mem::take(&mut self.renewed);
        let mut missed = Vec::new();
        for (name, entry) in &mut self.entries {
            let behind = std::mem::take(&mut entry.missed[to.index()]);
            if let Some(since) = behind.since {
                missed.push(Missed {
                    name: name.clone(),
                    count: behind.count,
                    since: now.saturating_duration_since(since),
                });
            }
        }
        missed.sort_by(|a, b| b.count.cmp(&a.count).then_with(|| a.name.cmp(&b.name)));
        (!missed.is_empty()).then_some(HandOver {
            to,
            renewed,
            missed,
        })
    }
}

impl fmt::Display for HandOver {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (who, other) = match (self.to, self.renewed) {
            (Side::Local, _) => ("the local original", "the cloud"),
            (Side::Cloud, false) => ("the cloud", "the local original"),
            (Side::Cloud, true) => ("a new servant", "the earlier one"),
        };
        write!(out, "{who} goes on without what it was not given: ")?;
        for (index, missed) in self.missed.iter().take(NAMED).enumerate() {
            let comma = if index == 0 { "" } else { ", " };
            let since = missed.since.as_secs_f64();
            write!(
                out,
                "{comma}{} of {} since {since:.1} s ago",
                missed.count, missed.name
            )?;
        }
        match self.missed.len().saturating_sub(NAMED) {
            0 => {}
            more => write!(out, ", and {more} more names")?,
        }
        write!(out, "; what {other} has made of them is not handed over")
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
        let mut ledger = Ledger::default();
        let (scan, reset, now) = (name("/scan"), name("/reset"), Instant::now());
        ledger.link_up(false);
        for second in 0..10 {
            ledger.told(now + second * SECOND, &scan);
            ledger.given(Side::Cloud, "/scan");
        }
        ledger.told(now + 4 * SECOND, &reset);
        ledger.given(Side::Cloud, "/reset");
        ledger.original_begins();
        let over = ledger.hands_over(now + 10 * SECOND, Side::Local).unwrap();
        assert_eq!(
            over.to_string(),
            "the local original goes on without what it was not given: 10 of /scan since 10.0 s ago, 1 of /reset since \
             6.0 s ago; what the cloud has made of them is not handed over"
        );
        for second in 10..13 {
            ledger.told(now + second * SECOND, &scan);
            ledger.given(Side::Local, "/scan");
        }
        ledger.link_up(true);
        let back = ledger.hands_over(now + 14 * SECOND, Side::Cloud).unwrap();
        assert_eq!(
            (back.missed[0].count, back.missed[0].since),
            (3, 4 * SECOND)
        );
        assert!(back.to_string().starts_with("the cloud goes on without"));
        assert_eq!(back.missed.len(), 1, "it has /reset");
        // What was told is not told again.
        assert_eq!(ledger.hands_over(now + 14 * SECOND, Side::Cloud), None);
        assert_eq!(ledger.hands_over(now + 14 * SECOND, Side::Local), None);
    }

    #[test]
    fn a_new_servant_knows_nothing_and_the_first_one_has_what_waited_for_it() {
        let mut ledger = Ledger::default();
        let (scan, now) = (name("/scan"), Instant::now());
        ledger.told(now, &scan);
        ledger.given(Side::Cloud, "/scan");
        ledger.link_up(false);
        assert_eq!(ledger.hands_over(now, Side::Cloud), None);
        ledger.link_up(false);
        let back = ledger.hands_over(now + SECOND, Side::Cloud).unwrap();
        let text = back.to_string();
        assert!(
            text.starts_with(
                "a new servant goes on without what it was not given: 1 of /scan since 1.0 s ago"
            ),
            "{text}"
        );
    }

    #[test]
    fn what_is_told_is_short() {
        let mut ledger = Ledger::default();
        for number in 0..100 {
            ledger.told(Instant::now(), &name(&format!("/topic{number}")));
        }
        let text = ledger.hands_over(Instant::now(), Side::Local).unwrap();
        let text = text.to_string();
        assert!(text.contains(", and 95 more names;"), "{text}");
    }

    proptest! {
        /// Whatever happens: a side lacks as many as were told and not given to it since it was told of last.
        #[test]
        fn nothing_is_counted_twice_or_left_out(ops in prop::collection::vec((0u8..6, any::<bool>()), 0..200)) {
            let mut ledger = Ledger::default();
            let (scan, now) = (name("/scan"), Instant::now());
            let (mut told, mut lacks) = (0u64, [0u64; 2]);
            ledger.link_up(false);
            for (op, flag) in ops {
                let side = if flag { Side::Cloud } else { Side::Local };
                match op {
                    0..=2 => {
                        ledger.told(now, &scan);
                        told += 1;
                        for lacks in &mut lacks {
                            *lacks += 1;
                        }
                        ledger.given(side, "/scan");
                        lacks[side.index()] -= 1;
                    }
                    3 => {
                        ledger.original_begins();
                        lacks[Side::Local.index()] = told;
                    }
                    4 => {
                        ledger.link_up(flag);
                        if !flag {
                            lacks[Side::Cloud.index()] = told;
                        }
                    }
                    _ => {
                        let over = ledger.hands_over(now, side);
                        let count = over.map_or(0, |over| over.missed[0].count);
                        prop_assert_eq!(count, lacks[side.index()]);
                        lacks[side.index()] = 0;
                    }
                }
            }
        }
    }
}
