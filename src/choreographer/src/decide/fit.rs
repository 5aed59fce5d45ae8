//! Predicts whether one more servant would fit, what it would cost the others in cores and time, and how many more
//! would fit.

use super::admission::AdmissionLedger;
use super::capacity::{Shortage, make_room};
use super::controller::MeasuredTimes;
use super::shares::{Claim, fill_shares};
use super::{Amount, ServantFacts};

/// A running servant and its use of cores.
#[derive(Debug, Clone, Copy)]
pub struct Neighbour<'a> {
    /// The servant, as seen by decisions about several servants.
    pub servant: ServantFacts<'a>,
    /// Used cores in thousandths, averaged over the last seconds.
    pub uses: u64,
    /// Recent response times, if known.
    pub measured: Option<MeasuredTimes>,
}

/// Prediction for one more servant.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// It would be admitted at once.
    pub now: bool,
    /// Ids of idle servants that would be ended for it.
    pub ends: Vec<String>,
    /// Capacity that would still be missing; zero if it would be admitted.
    pub lacking: Amount,
    /// Cores that other servants would lose if the new one used all of its promise.
    pub costs: Vec<NeighbourCost>,
    /// Number of such servants that would fit, one after the other, with idle servants ended for them; `None` for any
    /// number.
    pub more: Option<u64>,
    /// Capacity missing for one more than these.
    pub beyond: Amount,
}

impl Fit {
    /// Prediction for a servant that needs no capacity.
    pub const NOTHING: Fit =
        Fit { now: true, ends: Vec::new(), lacking: Amount::NONE, costs: Vec::new(), more: None, beyond: Amount::NONE };
}

/// Cost of one more servant to another one.
#[derive(Debug, Clone, PartialEq)]
pub struct NeighbourCost {
    /// Id of the other servant.
    pub id: String,
    /// Cores that it uses, in thousandths.
    pub uses: u64,
    /// Cores that it would keep: at least its promise, as far as it uses that.
    pub left: u64,
    /// 95th percentiles of its response times, now and then, in milliseconds. `None` if unknown, or if it would get no
    /// cores at all.
    pub times: Option<(f64, f64)>,
}

/// Predicts how one more servant of this priority that is promised `wanted` would fit on a machine of so many `cores`
/// (thousandths); these exist, whatever is promised of them.
pub fn fit((wanted, priority): (Amount, i32), book: &AdmissionLedger, cores: u64, others: &[Neighbour<'_>]) -> Fit {
    let free = book.capacity().minus(book.promised_total());
    let spoken_for = book.wanted_before(priority);
    let lacking = wanted.plus(spoken_for).minus(free);
    let asked = Shortage { all: lacking, first_robot: Amount::NONE };
    let room = make_room(asked, others.iter().map(|other| other.servant), &[]);
    let comes_free = |ends: &[&str]| {
        let leave = others.iter().map(|other| &other.servant);
        let leave = leave.filter(|it| it.ending || ends.contains(&it.id));
        let leave = leave.filter_map(|it| it.promised);
        leave.fold(Amount::NONE, Amount::plus)
    };
    let ends: Vec<&str> = room.ends.iter().map(|end| end.id).collect();
    let lacking = if wanted.fits(book.capacity()) {
        lacking.minus(comes_free(&ends))
    } else {
        // It would not fit even if all others ended.
        wanted.minus(book.capacity())
    };
    let fits = lacking == Amount::NONE;
    let idle = others.iter().filter(|other| other.servant.idle_until.is_some());
    let idle: Vec<&str> = idle.map(|other| other.servant.id).collect();
    let usable = free.plus(comes_free(&idle)).minus(spoken_for);
    let more = count_parts(usable, wanted);
    Fit {
        now: fits && ends.is_empty() && book.stall_reason().is_none() && wanted.plus(spoken_for).fits(free),
        ends: if fits { ends.iter().map(|id| (*id).to_owned()).collect() } else { Vec::new() },
        lacking,
        costs: neighbour_costs(wanted, cores, others),
        more,
        beyond: more.map_or(Amount::NONE, |more| wanted.times(more.saturating_add(1)).minus(usable)),
    }
}

/// Forecast for servants whose promise of cores tells nothing of their use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UseForecast {
    /// Cores in thousandths that a servant of the service uses, on average.
    pub uses: u64,
    /// Number of such servants for which the unused cores suffice, and what can be promised.
    pub more: u64,
}

/// Predicts how many more servants would find the `cores` (thousandths) that the present ones `of_service` use on
/// average, if all servants together use `used`; `most` is the number that fit by their promises. `None` if none is
/// there or they use nothing: nothing follows from that.
pub fn forecast_by_use(of_service: &[u64], used: u64, cores: u64, most: Option<u64>) -> Option<UseForecast> {
    let sum: u64 = of_service.iter().sum();
    let uses = sum.checked_div(of_service.len() as u64)?;
    let more = cores.saturating_sub(used).checked_div(uses)?;
    Some(UseForecast { uses, more: most.map_or(more, |most| most.min(more)) })
}

/// Returns the costs of the servants that would lose something.
fn neighbour_costs(wanted: Amount, cores: u64, others: &[Neighbour<'_>]) -> Vec<NeighbourCost> {
    let claim = |other: &Neighbour<'_>| Claim {
        floor: other.servant.promised.unwrap_or_default().millicpus,
        wants: other.uses,
    };
    let new = Claim { floor: wanted.millicpus, wants: wanted.millicpus };
    let claims: Vec<Claim> = others.iter().map(claim).chain([new]).collect();
    let shares = fill_shares(cores, &claims);
    let pairs = others.iter().zip(shares);
    pairs
        .filter(|(other, left)| *left < other.uses)
        .map(|(other, left)| NeighbourCost {
            id: other.servant.id.to_owned(),
            uses: other.uses,
            left,
            times: other.measured.and_then(|measured| slowed_times(measured, other.uses, left)),
        })
        .collect()
}

/// Returns the response times now and with the remaining cores: the part in the cloud grows as the cores shrink, the
/// part on the network does not.
fn slowed_times(measured: MeasuredTimes, uses: u64, left: u64) -> Option<(f64, f64)> {
    let MeasuredTimes { total, cloud } = measured;
    let cloud = cloud.clamp(0.0, total);
    let then = total - cloud + cloud * uses as f64 / left as f64;
    (left > 0).then_some((total, then))
}

/// Returns how often `part` fits into `whole`.
fn count_parts(whole: Amount, part: Amount) -> Option<u64> {
    let cores = whole.millicpus.checked_div(part.millicpus);
    let memory = whole.memory.checked_div(part.memory);
    cores.into_iter().chain(memory).min()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::decide::admission::AdmissionRequest;

    fn neighbour(id: &str, promised: f64, uses: u64, idle_until: Option<u64>) -> Neighbour<'_> {
        Neighbour {
            servant: ServantFacts {
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

    /// Returns a machine of four cores with these promises and a waiting robot's request.
    fn book(promised: f64, waits: Option<f64>) -> AdmissionLedger {
        let mut book = AdmissionLedger::new(Amount::new(4.0, 1000), 8);
        book.promise(Amount::new(promised, 0));
        if let Some(cpus) = waits {
            let _ = book.request(1, AdmissionRequest::robot(Amount::new(cpus, 0), 0));
        }
        book
    }

    #[test]
    fn one_more_fits_now_after_others_or_not() {
        let idle = neighbour("idle", 1.0, 0, Some(9));
        let busy = neighbour("busy", 2.0, 2000, None);
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
            assert_eq!(got, (now, ends, Amount::new(lacking, 0), more, Amount::new(beyond, 0)), "{wanted} {waits:?}");
        }
        let mut stalls = book(3.0, None);
        stalls.set_stall(Some("it swaps".into()));
        assert!(!fit((Amount::new(0.5, 0), 0), &stalls, 4000, &both).now);
    }

    #[test]
    fn others_lose_what_they_use_beyond_their_promise() {
        let others = [
            neighbour("modest", 1.0, 500, None),
            neighbour("greedy", 0.0, 3500, None),
            neighbour("kept", 1.0, 1000, None),
        ];
        let cost = |wanted| {
            let fit = fit((Amount::new(wanted, 0), 0), &book(2.0, None), 4000, &others);
            let costs = fit.costs.into_iter();
            costs.map(|cost| (cost.id, cost.left)).collect::<Vec<_>>()
        };
        assert_eq!(cost(0.0), [("greedy".to_owned(), 2500)], "they lack cores already");
        assert_eq!(cost(1.5), [("greedy".to_owned(), 1000)]);
        // Times grow with the part spent in the cloud.
        let times = |uses, promised, total, cloud| {
            let measured = Some(MeasuredTimes { total, cloud });
            let one = Neighbour { measured, ..neighbour("one", promised, uses, None) };
            let fit = fit((Amount::new(3.0, 0), 0), &book(0.0, None), 4000, &[one]);
            fit.costs[0].times
        };
        for (uses, promised, total, cloud, then) in [
            (2000, 0.0, 100.0, 60.0, Some((100.0, 160.0))),
            (2000, 0.0, 100.0, 0.0, Some((100.0, 100.0))),
            // Its robot reported nonsense.
            (2000, 0.0, 100.0, 1e9, Some((100.0, 200.0))),
            (4000, 0.0, 100.0, 100.0, Some((100.0, 400.0))),
        ] {
            assert_eq!(times(uses, promised, total, cloud), then, "{uses} {cloud}");
        }
        let nothing = MeasuredTimes { total: 1.0, cloud: 1.0 };
        assert_eq!(slowed_times(nothing, 5, 0), None, "for ever");
        let others = [neighbour("small", 0.0, 100, None)];
        let fit = fit((Amount::new(1.0, 0), 0), &book(0.0, None), 4000, &others);
        assert_eq!(fit.costs, []);
    }

    #[test]
    fn what_servants_use_tells_how_many_more_find_it() {
        let forecast = |of_service: &[u64], used, most| {
            let found = forecast_by_use(of_service, used, 4000, most);
            found.map(|found| (found.uses, found.more))
        };
        assert_eq!(forecast(&[300, 500], 1000, None), Some((400, 7)));
        assert_eq!(forecast(&[300, 500], 1000, Some(2)), Some((400, 2)), "their memory is promised");
        assert_eq!(forecast(&[2500, 2500], 5000, None), Some((2500, 0)), "all is used");
        assert_eq!(forecast(&[], 1000, None), None);
        assert_eq!(forecast(&[0, 0], 0, None), None);
    }

    proptest! {
        #[test]
        fn what_is_said_to_fit_is_admitted(
            sizes in prop::collection::vec(0u64..2000, 0..6),
            wanted in 1u64..3000,
        ) {
            let mut book = AdmissionLedger::new(Amount::new(4.0, 0), 8);
            for (ticket, size) in (1..).zip(sizes) {
                let _ = book.request(ticket, AdmissionRequest::robot(Amount { millicpus: size, memory: 0 }, 0));
            }
            let wanted = Amount { millicpus: wanted, memory: 0 };
            let fit = fit((wanted, 0), &book, 4000, &[]);
            let mut ticket = 100;
            let mut admitted = 0;
            while book.request(ticket, AdmissionRequest::robot(wanted,
                0)).0 == crate::decide::admission::AdmissionVerdict::Admitted {
                ticket += 1;
                admitted += 1;
            }
            prop_assert_eq!(fit.now, admitted > 0);
            prop_assert_eq!(fit.more, Some(admitted));
            prop_assert!(fit.beyond.millicpus > 0 && fit.beyond.fits(wanted));
        }
    }
}
