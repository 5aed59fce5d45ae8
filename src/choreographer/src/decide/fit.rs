//! Whether one more servant would fit, what that would cost the others in cores and in time, and how many more would.

use super::admission::Book;
use super::capacity::{Lacking, make_room};
use super::controller::Measured;
use super::shares::{Claim, fill};
use super::{Amount, Servant};

/// A servant that works, and what of the cores it uses.
#[derive(Debug, Clone, Copy)]
pub struct Neighbour<'a> {
    /// As decisions about several servants see it.
    pub servant: Servant<'a>,
    /// Thousandths of a core, on the average over the last seconds.
    pub uses: u64,
    /// What its requests took lately, where that is known.
    pub measured: Option<Measured>,
}

/// How one more would fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// It would be admitted at once.
    pub now: bool,
    /// Ids of idle servants that would be ended for it.
    pub ends: Vec<String>,
    /// What would be lacking then; nothing where it would be admitted.
    pub lacking: Amount,
    /// What of the cores others would lose if the new one used all that it is promised.
    pub costs: Vec<Cost>,
    /// So many of its kind would fit, one after the other, idle servants being ended for them; none: as many as one likes.
    pub more: Option<u64>,
    /// What would be lacking for one more than these.
    pub beyond: Amount,
}

impl Fit {
    /// Of one that needs nothing.
    pub const NOTHING: Fit = Fit {
        now: true,
        ends: Vec::new(),
        lacking: Amount::NONE,
        costs: Vec::new(),
        more: None,
        beyond: Amount::NONE,
    };
}

/// What one more would cost another servant.
#[derive(Debug, Clone, PartialEq)]
pub struct Cost {
    /// Its id.
    pub id: String,
    /// Thousandths of a core that it uses.
    pub uses: u64,
    /// What it would have left of that: at least what it is promised, as far as it uses that.
    pub left: u64,
    /// What 19 of 20 of its requests did not exceed lately, and would not then: milliseconds. None where nothing is known, or
    /// where it would get no time at all.
    pub times: Option<(f64, f64)>,
}

/// How one more of this priority that is promised `wanted` would fit on a machine of so many `cores` (thousandths): these exist, whatever is
/// promised of them.
pub fn fit(
    (wanted, priority): (Amount, i32),
    book: &Book,
    cores: u64,
    others: &[Neighbour<'_>],
) -> Fit {
    let free = book.capacity().minus(book.promised());
    let spoken_for = book.wanted_before(priority);
    let lacking = wanted.plus(spoken_for).minus(free);
    let asked = Lacking {
        all: lacking,
        first_robot: Amount::NONE,
    };
    let room = make_room(asked, others.iter().map(|other| other.servant), &[]);
    let comes_free = |ends: &[&str]| {
        let leave = others.iter().map(|other| &other.servant);
        let leave = leave.filter(|it| it.ending || ends.contains(&it.id));
        let leave = leave.filter_map(|it| it.promised);
        leave.fold(Amount::NONE, Amount::plus)
    };
    let ends: Vec<&str> = room.ends.iter().map(|end| end.id).collect();
    let lacking = match wanted.fits(book.capacity()) {
        true => lacking.minus(comes_free(&ends)),
        // Whatever ends, it never will.
        false => wanted.minus(book.capacity()),
    };
    let fits = lacking == Amount::NONE;
    let idle = others
        .iter()
        .filter(|other| other.servant.idle_until.is_some());
    let idle: Vec<&str> = idle.map(|other| other.servant.id).collect();
    let usable = free.plus(comes_free(&idle)).minus(spoken_for);
    let more = times(usable, wanted);
    Fit {
        now: fits
            && ends.is_empty()
            && book.stalled().is_none()
            && wanted.plus(spoken_for).fits(free),
        ends: match fits {
            true => ends.iter().map(|id| (*id).to_owned()).collect(),
            false => Vec::new(),
        },
        lacking,
        costs: costs(wanted, cores, others),
        more,
        beyond: more.map_or(Amount::NONE, |more| {
            wanted.times(more.saturating_add(1)).minus(usable)
        }),
    }
}

/// What each would lose that loses something.
fn costs(wanted: Amount, cores: u64, others: &[Neighbour<'_>]) -> Vec<Cost> {
    let claim = |other: &Neighbour<'_>| Claim {
        floor: other.servant.promised.unwrap_or_default().millicpus,
        wants: other.uses,
    };
    let new = Claim {
        floor: wanted.millicpus,
        wants: wanted.millicpus,
    };
    let claims: Vec<Claim> = others.iter().map(claim).chain([new]).collect();
    let shares = fill(cores, &claims);
    let pairs = others.iter().zip(shares);
    pairs
        .filter(|(other, left)| *left < other.uses)
        .map(|(other, left)| Cost {
            id: other.servant.id.to_owned(),
            uses: other.uses,
            left,
            times: other
                .measured
                .and_then(|measured| slower(measured, other.uses, left)),
        })
        .collect()
}

/// What requests take, and would take with what is left of the cores: what they wait and compute in the cloud grows as the
/// cores shrink, what is spent on the way does not.
fn slower(measured: Measured, uses: u64, left: u64) -> Option<(f64, f64)> {
    let Measured { total, cloud } = measured;
    let cloud = cloud.clamp(0.0, total);
    let then = total - cloud + cloud * uses as f64 / left as f64;
    (left > 0).then_some((total, then))
}

/// How often `part` is in `whole`.
fn times(whole: Amount, part: Amount) -> Option<u64> {
    let cores = whole.millicpus.checked_div(part.millicpus);
    let memory = whole.memory.checked_div(part.memory);
    cores.into_iter().chain(memory).min()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::decide::admission::Ask;

    fn other(id: &str, promised: f64, uses: u64, idle_until: Option<u64>) -> Neighbour<'_> {
        Neighbour {
            servant: Servant {
                id,
                revision: 1,
                connections: 0,
                promised: Some(Amount::new(promised, 100)),
                idle_until,
                ending: false,
            },
            uses,
            measured: None,
        }
    }

    /// A machine of four cores with these promises, and what robots wait for.
    fn book(promised: f64, waits: Option<f64>) -> Book {
        let mut book = Book::new(Amount::new(4.0, 1000), 8);
        book.promise(Amount::new(promised, 0));
        if let Some(cpus) = waits {
            let _ = book.ask(1, Ask::robot(Amount::new(cpus, 0), 0));
        }
        book
    }

    #[test]
    fn one_more_fits_now_after_others_or_not() {
        let idle = other("idle", 1.0, 0, Some(9));
        let busy = other("busy", 2.0, 2000, None);
        let both = [idle, busy];
        for (wanted, waits, now, ends, lacking, more, beyond) in [
            (1.0, None, true, vec![], 0.0, Some(2), 1.0),
            (2.0, None, false, vec!["idle"], 0.0, Some(1), 2.0),
            (2.1, None, false, vec![], 0.1, Some(0), 0.1),
            (5.0, None, false, vec![], 1.0, Some(0), 3.0),
            (1.0, Some(2.0), false, vec![], 1.0, Some(0), 1.0),
            (0.0, None, true, vec![], 0.0, None, 0.0),
        ] {
            let fit = fit((Amount::new(wanted, 0), 0), &book(3.0, waits), 4000, &both);
            let got = (fit.now, fit.ends, fit.lacking, fit.more, fit.beyond);
            let ends: Vec<String> = ends.into_iter().map(str::to_owned).collect();
            assert_eq!(
                got,
                (
                    now,
                    ends,
                    Amount::new(lacking, 0),
                    more,
                    Amount::new(beyond, 0)
                ),
                "{wanted} {waits:?}"
            );
        }
        let mut stalls = book(3.0, None);
        stalls.stall(Some("it swaps".into()));
        assert!(!fit((Amount::new(0.5, 0), 0), &stalls, 4000, &both).now);
    }

    #[test]
    fn others_lose_what_they_use_beyond_their_promise() {
        let others = [
            other("modest", 1.0, 500, None),
            other("greedy", 0.0, 3500, None),
            other("kept", 1.0, 1000, None),
        ];
        let cost = |wanted| {
            let fit = fit((Amount::new(wanted, 0), 0), &book(2.0, None), 4000, &others);
            let costs = fit.costs.into_iter();
            costs.map(|cost| (cost.id, cost.left)).collect::<Vec<_>>()
        };
        assert_eq!(
            cost(0.0),
            [("greedy".to_owned(), 2500)],
            "they lack cores already"
        );
        assert_eq!(cost(1.5), [("greedy".to_owned(), 1000)]);
        // Times grow with what is spent in the cloud.
        let times = |uses, promised, total, cloud| {
            let measured = Some(Measured { total, cloud });
            let one = Neighbour {
                measured,
                ..other("one", promised, uses, None)
            };
            let fit = fit((Amount::new(3.0, 0), 0), &book(0.0, None), 4000, &[one]);
            fit.costs[0].times
        };
        for (uses, promised, total, cloud, then) in [
            (2000, 0.0, 100.0, 60.0, Some((100.0, 160.0))),
            (2000, 0.0, 100.0, 0.0, Some((100.0, 100.0))),
            // Its robot told nonsense.
            (2000, 0.0, 100.0, 1e9, Some((100.0, 200.0))),
            (4000, 0.0, 100.0, 100.0, Some((100.0, 400.0))),
        ] {
            assert_eq!(times(uses, promised, total, cloud), then, "{uses} {cloud}");
        }
        let nothing = Measured {
            total: 1.0,
            cloud: 1.0,
        };
        assert_eq!(slower(nothing, 5, 0), None, "for ever");
        let others = [other("small", 0.0, 100, None)];
        let fit = fit((Amount::new(1.0, 0), 0), &book(0.0, None), 4000, &others);
        assert_eq!(fit.costs, []);
    }

    proptest! {
        #[test]
        fn what_is_said_to_fit_is_admitted(
            sizes in prop::collection::vec(0u64..2000, 0..6),
            wanted in 1u64..3000,
        ) {
            let mut book = Book::new(Amount::new(4.0, 0), 8);
            for (ticket, size) in (1..).zip(sizes) {
                let _ = book.ask(ticket, Ask::robot(Amount { millicpus: size, memory: 0 }, 0));
            }
            let wanted = Amount { millicpus: wanted, memory: 0 };
            let fit = fit((wanted, 0), &book, 4000, &[]);
            let mut ticket = 100;
            let mut admitted = 0;
            while book.ask(ticket, Ask::robot(wanted, 0)).0 == crate::decide::admission::Verdict::Admitted {
                ticket += 1;
                admitted += 1;
            }
            prop_assert_eq!(fit.now, admitted > 0);
            prop_assert_eq!(fit.more, Some(admitted));
            prop_assert!(fit.beyond.millicpus > 0 && fit.beyond.fits(wanted));
        }
    }
}
