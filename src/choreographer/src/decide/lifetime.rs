//! How long a servant is waited for, and how long it is kept.

use std::time::{Duration, Instant};

/// When nothing changes for so long although something of the interface is missing, it is not coming: of a servant that
/// was adopted, whose nodes may have been told to take it away, and of a revision that has kept robots waiting in vain.
pub const SETTLED: Duration = Duration::from_secs(5);

/// How far a servant has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// It waits for capacity.
    Queued,
    /// It has capacity, and nothing runs.
    Admitted,
    /// It has a container, and its interface is not there.
    Starting,
    /// It can be used.
    Ready,
}

/// What decides whether a servant is needed.
#[derive(Debug, Clone, Copy)]
pub struct Tenancy {
    /// How far it has come.
    pub stage: Stage,
    /// An earlier daemon started it.
    pub adopted: bool,
    /// Its robot named no name, and cannot come back to it.
    pub anonymous: bool,
    /// Connections that use it.
    pub connections: usize,
    /// Since when there has been none, of a servant that is ready.
    pub idle_since: Option<Instant>,
    /// How long it is kept without a connection.
    pub grace: Duration,
}

/// Whether a servant is needed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Need {
    /// As long as nothing of its tenancy changes.
    Stays,
    /// Nobody uses it; it is kept until then.
    Until(Instant),
    /// No longer, with the reason.
    Over(String),
}

/// Whether a servant is needed at `now`. Robots that can come back find it within their grace time, however far it has come
/// once it was admitted.
pub fn needed(of: &Tenancy, now: Instant) -> Need {
    let left = |words: &str| Need::Over(format!("its robot left{words}"));
    match of.stage {
        _ if of.connections > 0 => Need::Stays,
        Stage::Queued => left(" before there was room"),
        Stage::Admitted if of.anonymous => left(" before it was started"),
        Stage::Starting if of.anonymous && !of.adopted => left(" before it was ready"),
        Stage::Admitted | Stage::Starting => Need::Stays,
        Stage::Ready => {
            let until = of.idle_since.unwrap_or(now) + of.grace;
            match of.grace.as_secs() {
                _ if now < until => Need::Until(until),
                0 => left(""),
                seconds => Need::Over(format!("no robot was connected for {seconds} s")),
            }
        }
    }
}

/// What decides whether a servant can be used.
#[derive(Debug, Clone, Copy)]
pub struct Shown<'a> {
    /// What of its interface is not registered, in words.
    pub missing: &'a [String],
    /// Its nodes that have registered nothing.
    pub nodes_missing: &'a [String],
    /// More is to come: its nodes may take all the time of a start between their registration and their first topic.
    pub patient: bool,
    /// When what is registered changed last.
    pub changed: Instant,
    /// Until when it has to be ready.
    pub deadline: Instant,
    /// What that is from its start on.
    pub limit: Duration,
}

/// Whether a servant can be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Readiness {
    /// All of its interface is there.
    Ready,
    /// All that is coming is there.
    Incomplete,
    /// Not before something changes; at this time it is decided anew.
    Waits(Instant),
    /// It has failed, with the reason.
    Late(String),
}

/// Whether a servant can be used at `now`. Topics can come and go with what a node is told; nodes cannot.
pub fn readiness(of: &Shown<'_>, now: Instant) -> Readiness {
    if of.missing.is_empty() {
        return Readiness::Ready;
    }
    let nodes_there = of.nodes_missing.is_empty();
    let until = match of.patient || !nodes_there {
        true => of.deadline,
        false => of.deadline.min(of.changed + SETTLED),
    };
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
        let over = |words: &str| Need::Over(words.to_owned());
        let (long, short) = (Some(now - GRACE), Some(now - GRACE / 3));
        let waits = Need::Until(now + GRACE * 2 / 3);
        for (stage, anonymous, idle_since, expected) in [
            (
                Stage::Queued,
                false,
                None,
                over("its robot left before there was room"),
            ),
            (
                Stage::Queued,
                true,
                None,
                over("its robot left before there was room"),
            ),
            (Stage::Admitted, false, None, Need::Stays),
            (
                Stage::Admitted,
                true,
                None,
                over("its robot left before it was started"),
            ),
            (Stage::Starting, false, None, Need::Stays),
            (
                Stage::Starting,
                true,
                None,
                over("its robot left before it was ready"),
            ),
            (Stage::Ready, false, short, waits),
            (
                Stage::Ready,
                false,
                long,
                over("no robot was connected for 60 s"),
            ),
        ] {
            let tenancy = Tenancy {
                stage,
                adopted: false,
                anonymous,
                connections: 0,
                idle_since,
                grace: GRACE,
            };
            assert_eq!(needed(&tenancy, now), expected, "{tenancy:?}");
            let used = Tenancy {
                connections: 1,
                ..tenancy
            };
            assert_eq!(needed(&used, now), Need::Stays, "{used:?}");
            let adopted = Tenancy {
                adopted: true,
                ..tenancy
            };
            if stage == Stage::Starting {
                assert_eq!(needed(&adopted, now), Need::Stays, "{adopted:?}");
            }
        }
        let no_grace = Tenancy {
            stage: Stage::Ready,
            adopted: false,
            anonymous: true,
            connections: 0,
            idle_since: Some(now),
            grace: Duration::ZERO,
        };
        assert_eq!(needed(&no_grace, now), over("its robot left"));
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
            let shown = Shown {
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
        /// What is decided for a time holds until then, and what is over stays over.
        #[test]
        fn time_takes_nothing_back(
            stage in prop_oneof![
                Just(Stage::Queued), Just(Stage::Admitted), Just(Stage::Starting), Just(Stage::Ready)
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
            let shown = Shown {
                missing: &missing,
                nodes_missing: &nodes_missing,
                patient,
                changed: at(changed),
                deadline: at(30),
                limit: Duration::from_secs(30),
            };
            let mut times = times;
            times.sort_unstable();
            let mut needs: Option<Need> = None;
            let mut waits: Option<Readiness> = None;
            for seconds in times {
                let now = at(idle + seconds);
                let need = needed(&tenancy, now);
                prop_assert_eq!(&need, &needed(&tenancy, now));
                match (&needs, &need) {
                    (Some(Need::Until(then)), _) if now < *then => prop_assert_eq!(&need, needs.as_ref().unwrap()),
                    (Some(Need::Until(_)), _) => prop_assert!(matches!(need, Need::Over(_))),
                    (Some(before), _) => prop_assert_eq!(before, &need),
                    (None, Need::Until(then)) => {
                        prop_assert!(now < *then);
                        prop_assert!(matches!(needed(&tenancy, *then), Need::Over(_)));
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
