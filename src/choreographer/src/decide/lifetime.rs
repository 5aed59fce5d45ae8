//! Decides how long a servant is waited for, and how long it is kept.

use std::time::{Duration, Instant};

/// Time without changes after which the missing part of an interface is considered permanent: for an adopted servant,
/// whose nodes may have been told to remove it, and for a revision that has kept robots waiting in vain.
pub const SETTLE_TIME: Duration = Duration::from_secs(5);

/// Stage of a servant's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ServantStage {
    /// It waits for capacity.
    Queued,
    /// It has capacity, and nothing runs.
    Admitted,
    /// It has a container, and its interface is not registered yet.
    Starting,
    /// It can be used.
    Ready,
}

/// Input for deciding whether a servant is needed.
#[derive(Debug, Clone, Copy)]
pub struct Tenancy {
    /// Stage of its life.
    pub stage: ServantStage,
    /// It was started by an earlier daemon.
    pub adopted: bool,
    /// The robot gave no name and cannot come back to it.
    pub anonymous: bool,
    /// Number of connections.
    pub connections: usize,
    /// Time since which a ready servant has had no connection.
    pub idle_since: Option<Instant>,
    /// Time for which it is kept without a connection.
    pub grace: Duration,
}

/// Decision whether a servant is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Retention {
    /// It is kept as long as its tenancy does not change.
    Stays,
    /// It is unused and kept until this time.
    Until(Instant),
    /// It is no longer needed, for this reason.
    Over(String),
}

/// Decides whether a servant is needed at `now`. Robots that can come back find it within their grace time, whatever
/// its stage once it was admitted.
pub fn retention(of: &Tenancy, now: Instant) -> Retention {
    let left = |words: &str| Retention::Over(format!("its robot left{words}"));
    match of.stage {
        _ if of.connections > 0 => Retention::Stays,
        ServantStage::Queued => left(" while it was queued"),
        ServantStage::Admitted if of.anonymous => left(" before it was started"),
        ServantStage::Starting if of.anonymous && !of.adopted => left(" before it was ready"),
        ServantStage::Admitted | ServantStage::Starting => Retention::Stays,
        ServantStage::Ready => {
            let until = of.idle_since.unwrap_or(now) + of.grace;
            match of.grace.as_secs() {
                _ if now < until => Retention::Until(until),
                0 => left(""),
                seconds => Retention::Over(format!("no robot was connected for {seconds} s")),
            }
        }
    }
}

/// Input for deciding whether a servant can be used.
#[derive(Debug, Clone, Copy)]
pub struct InterfaceStatus<'a> {
    /// Missing parts of its interface, in words.
    pub missing: &'a [String],
    /// Nodes that have registered nothing.
    pub nodes_missing: &'a [String],
    /// More may come: the nodes may take all the time of a start between their registration and their first topic.
    pub patient: bool,
    /// Time of the last registration change.
    pub changed: Instant,
    /// Deadline for becoming ready.
    pub deadline: Instant,
    /// Duration of that limit, counted from its start.
    pub limit: Duration,
}

/// Decision whether a servant can be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Readiness {
    /// The interface is complete.
    Ready,
    /// Parts of the interface are missing and not expected any more.
    Incomplete,
    /// It waits for a change; at this time it is evaluated again.
    Waits(Instant),
    /// It has failed, for this reason.
    Late(String),
}

/// Decides whether a servant can be used at `now`. Topics may come and go depending on a node's inputs; nodes may not.
pub fn readiness(of: &InterfaceStatus<'_>, now: Instant) -> Readiness {
    if of.missing.is_empty() {
        return Readiness::Ready;
    }
    let nodes_there = of.nodes_missing.is_empty();
    let until = if of.patient || !nodes_there { of.deadline } else { of.deadline.min(of.changed + SETTLE_TIME) };
    if now < until {
        Readiness::Waits(until)
    } else if nodes_there {
        Readiness::Incomplete
    } else {
        Readiness::Late(format!(
            "did not become ready within {} s: {} did not register ({} missing)",
            of.limit.as_secs(),
            of.nodes_missing.join(", "),
            of.missing.join(", ")
        ))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const GRACE: Duration = Duration::from_secs(60);

    #[test]
    fn a_servant_is_kept_for_as_long_as_its_robot_can_come_back() {
        let now = Instant::now();
        let over = |words: &str| Retention::Over(words.to_owned());
        let (long, short) = (Some(now - GRACE), Some(now - GRACE / 3));
        let waits = Retention::Until(now + GRACE * 2 / 3);
        for (stage, anonymous, idle_since, expected) in [
            (ServantStage::Queued, false, None, over("its robot left while it was queued")),
            (ServantStage::Queued, true, None, over("its robot left while it was queued")),
            (ServantStage::Admitted, false, None, Retention::Stays),
            (ServantStage::Admitted, true, None, over("its robot left before it was started")),
            (ServantStage::Starting, false, None, Retention::Stays),
            (ServantStage::Starting, true, None, over("its robot left before it was ready")),
            (ServantStage::Ready, false, short, waits),
            (ServantStage::Ready, false, long, over("no robot was connected for 60 s")),
        ] {
            let tenancy = Tenancy { stage, adopted: false, anonymous, connections: 0, idle_since, grace: GRACE };
            assert_eq!(retention(&tenancy, now), expected, "{tenancy:?}");
            let used = Tenancy { connections: 1, ..tenancy };
            assert_eq!(retention(&used, now), Retention::Stays, "{used:?}");
            let adopted = Tenancy { adopted: true, ..tenancy };
            if stage == ServantStage::Starting {
                assert_eq!(retention(&adopted, now), Retention::Stays, "{adopted:?}");
            }
        }
        let no_grace = Tenancy {
            stage: ServantStage::Ready,
            adopted: false,
            anonymous: true,
            connections: 0,
            idle_since: Some(now),
            grace: Duration::ZERO,
        };
        assert_eq!(retention(&no_grace, now), over("its robot left"));
    }

    #[test]
    fn a_servant_is_waited_for_until_what_is_coming_is_there() {
        let began = Instant::now();
        let second = Duration::from_secs(1);
        let topic = ["the publisher of /out".to_owned()];
        let node = ["/node".to_owned()];
        let late = "did not become ready within 30 s: /node did not register (the publisher of /out missing)";
        let waits = |seconds| Readiness::Waits(began + second * seconds);
        for (missing, nodes, patient, at, expected) in [
            (&[][..], &[][..], true, 0, Readiness::Ready),
            (&[], &[], true, 99, Readiness::Ready),
            (&topic, &[], true, 0, waits(30)),
            (&topic, &[], true, 30, Readiness::Incomplete),
            (&topic, &[], false, 2, waits(7)),
            (&topic, &[], false, 7, Readiness::Incomplete),
            (&topic, &node, false, 7, waits(30)),
            (&topic, &node, true, 29, waits(30)),
            (&topic, &node, true, 30, Readiness::Late(late.to_owned())),
        ] {
            let shown = InterfaceStatus {
                missing,
                nodes_missing: nodes,
                patient,
                changed: began + second * 2,
                deadline: began + second * 30,
                limit: second * 30,
            };
            let now = began + second * at;
            assert_eq!(readiness(&shown, now), expected, "{shown:?} after {at} s");
        }
    }

    proptest! {
        /// A decision with a time holds until then, and an end is final.
        #[test]
        fn time_takes_nothing_back(
            stage in prop_oneof![
                Just(ServantStage::Queued), Just(ServantStage::Admitted), Just(ServantStage::Starting),
                    Just(ServantStage::Ready)
            ],
            adopted: bool,
            anonymous: bool,
            connections in 0usize..2,
            idle in 0u64..100,
            grace in 0u64..100,
            patient: bool,
            nodes in 0usize..2,
            changed in 0u64..40,
            times in prop::collection::vec(0u64..120, 2..9),
        ) {
            let began = Instant::now();
            let at = |seconds: u64| began + Duration::from_secs(seconds);
            let tenancy = Tenancy {
                stage,
                adopted,
                anonymous,
                connections,
                idle_since: Some(at(idle)),
                grace: Duration::from_secs(grace),
            };
            let missing = ["the service /s".to_owned()];
            let nodes_missing = vec!["/node".to_owned(); nodes];
            let shown = InterfaceStatus {
                missing: &missing,
                nodes_missing: &nodes_missing,
                patient,
                changed: at(changed),
                deadline: at(30),
                limit: Duration::from_secs(30),
            };
            let mut times = times;
            times.sort_unstable();
            let mut needs: Option<Retention> = None;
            let mut waits: Option<Readiness> = None;
            for seconds in times {
                let now = at(idle + seconds);
                let need = retention(&tenancy, now);
                prop_assert_eq!(&need, &retention(&tenancy, now));
                match (&needs, &need) {
                    (Some(Retention::Until(then)), _) if now < *then => prop_assert_eq!(&need, needs.as_ref().unwrap()),
                    (Some(Retention::Until(_)), _) => prop_assert!(matches!(need, Retention::Over(_))),
                    (Some(before), _) => prop_assert_eq!(before, &need),
                    (None, Retention::Until(then)) => {
                        prop_assert!(now < *then);
                        prop_assert!(matches!(retention(&tenancy, *then), Retention::Over(_)));
                    }
                    (None, _) => {}
                }
                needs = Some(need);
                let now = at(changed + seconds / 3);
                let now_shown = readiness(&shown, now);
                prop_assert_eq!(&now_shown, &readiness(&shown, now));
                match &waits {
                    Some(Readiness::Waits(then)) if now >= *then => {
                        prop_assert!(!matches!(now_shown, Readiness::Waits(_) | Readiness::Ready));
                    }
                    Some(before) => prop_assert_eq!(before, &now_shown),
                    None => {}
                }
                if let Readiness::Waits(then) = now_shown {
                    prop_assert!(now < then && then <= shown.deadline);
                }
                waits = Some(now_shown);
            }
        }
    }
}
