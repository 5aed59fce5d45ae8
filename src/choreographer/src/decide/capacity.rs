//! Decides which idle servants are ended, and which pushes give their capacity back, to make room for waiting requests.

use super::admission::Ticket;
use super::{Amount, ServantFacts, StopOrder};

/// Capacity that would have to be freed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Shortage {
    /// Amount missing for all waiting requests.
    pub all: Amount,
    /// Amount missing for the first waiting robot.
    pub first_robot: Amount,
}

/// An admitted push.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PushPromise {
    /// Ticket of the push.
    pub ticket: Ticket,
    /// The promised amount.
    pub has: Amount,
    /// It was asked to give the amount back.
    pub gives_way: bool,
}

/// Measures to make room for waiting requests.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct RoomPlan<'a> {
    /// Servants to end.
    pub ends: Vec<StopOrder<'a>>,
    /// Pushes that are to give their capacity back.
    pub give_way: Vec<Ticket>,
}

/// Chooses idle servants to end, longest idle first, until there will be capacity for all waiting requests. If that is
/// not enough for the first robot, pushes whose capacity makes up for it give way, latest first.
pub fn make_room<'a>(
    lacking: Shortage,
    servants: impl Iterator<Item = ServantFacts<'a>>,
    pushes: &[PushPromise],
) -> RoomPlan<'a> {
    let Shortage { all: mut lacking, mut first_robot } = lacking;
    if lacking == Amount::NONE {
        return RoomPlan::default();
    }
    let mut idle = Vec::new();
    for servant in servants {
        let Some(has) = servant.promised else {
            continue;
        };
        if servant.ending {
            // Its capacity is about to be free.
            lacking = lacking.minus(has);
            first_robot = first_robot.minus(has);
        } else if let Some(until) = servant.idle_until {
            idle.push((until, servant.id, has));
        }
    }
    for push in pushes.iter().filter(|push| push.gives_way) {
        lacking = lacking.minus(push.has);
        first_robot = first_robot.minus(push.has);
    }
    idle.sort_unstable_by_key(|(until, id, _)| (*until, *id));
    let mut ends = Vec::new();
    for (_, id, has) in idle {
        // It may hold none of the missing resource.
        if lacking.minus(has) != lacking {
            lacking = lacking.minus(has);
            first_robot = first_robot.minus(has);
            let reason = "its capacity was needed";
            ends.push(StopOrder { id, reason });
        }
    }
    let mut stay: Vec<&PushPromise> = pushes.iter().filter(|push| !push.gives_way).collect();
    stay.sort_unstable_by_key(|push| std::cmp::Reverse(push.ticket));
    let mut give_way = Vec::new();
    for push in stay {
        if first_robot.minus(push.has) != first_robot {
            first_robot = first_robot.minus(push.has);
            give_way.push(push.ticket);
        }
    }
    if first_robot != Amount::NONE {
        // It would not be enough.
        give_way.clear();
    }
    RoomPlan { ends, give_way }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn servant(id: &str, millicpus: u64, idle_until: Option<u64>) -> ServantFacts<'_> {
        let memory = 0;
        ServantFacts {
            id,
            revision: 1,
            connections: 0,
            promised: Some(Amount { millicpus, memory }),
            idle_until,
            ending: false,
        }
    }

    #[test]
    fn as_many_idle_servants_end_as_it_takes() {
        let newest = servant("newest", 500, Some(30));
        let oldest = servant("oldest", 500, Some(10));
        let middle = servant("middle", 500, Some(20));
        let busy = servant("busy", 500, None);
        let queued = ServantFacts { promised: None, ..servant("queued", 0, Some(1)) };
        let useless = servant("useless", 0, Some(5));
        let ending = ServantFacts { ending: true, ..servant("ending", 1000, None) };
        let idle = [newest, busy, oldest, queued, useless, middle];
        for (lacking, extra, expected) in [
            (0, None, vec![]),
            (1, None, vec!["oldest"]),
            (500, None, vec!["oldest"]),
            (501, None, vec!["oldest", "middle"]),
            (9000, None, vec!["oldest", "middle", "newest"]),
            (1000, Some(ending), vec![]),
            (1100, Some(ending), vec!["oldest"]),
        ] {
            let lacking = Amount { millicpus: lacking, memory: 0 };
            let lacking = Shortage { all: lacking, ..Shortage::default() };
            let room = make_room(lacking, idle.into_iter().chain(extra), &[]);
            let ids: Vec<&str> = room.ends.iter().map(|end| end.id).collect();
            assert_eq!(ids, expected, "{lacking:?}");
        }
        let lacking = Shortage { all: Amount { millicpus: 0, memory: 1 }, ..Shortage::default() };
        let room = make_room(lacking, idle.into_iter(), &[]);
        assert_eq!(room, RoomPlan::default(), "none has any");
    }

    #[test]
    fn pushes_give_way_to_the_first_robot_where_that_helps() {
        let push = |ticket, memory, gives_way| PushPromise { ticket, has: Amount { millicpus: 10, memory }, gives_way };
        let idle = servant("idle", 100, Some(1));
        let idle = ServantFacts { promised: Some(Amount::new(0.1, 50)), ..idle };
        let pushes = [push(1, 500, false), push(2, 300, false)];
        let leaving = [push(1, 500, false), push(2, 300, true)];
        for (lacks, pushes, expected) in [
            (0, pushes, vec![]),
            // An idle servant is ended first.
            (50, pushes, vec![]),
            (51, pushes, vec![2]),
            (350, pushes, vec![2]),
            (351, pushes, vec![2, 1]),
            (850, pushes, vec![2, 1]),
            (851, pushes, vec![]),
            (350, leaving, vec![]),
            (351, leaving, vec![1]),
        ] {
            let first_robot = Amount { millicpus: 0, memory: lacks };
            let lacking = Shortage { all: first_robot.plus(Amount::new(0.0, 1000)), first_robot };
            let room = make_room(lacking, [idle].into_iter(), &pushes);
            assert_eq!(room.give_way, expected, "{lacks} {pushes:?}");
        }
    }
}
