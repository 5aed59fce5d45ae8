//! Decides which servant a robot gets: its existing one, or a new one.

use super::warm_pool::WarmContainer;
use super::{ServantFacts, StopOrder};

/// Placement of a robot that requests a service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Placement<'a> {
    /// The robot's existing servant, by id.
    Keep(&'a str),
    /// A new servant.
    Start {
        /// The robot's existing servant, to be ended first.
        ends: Option<StopOrder<'a>>,
        /// Use the service's container in the warm pool, unless that is gone when it is needed.
        warm: bool,
    },
}

/// Decides the placement. `has` is the robot's existing servant of this service, `warm` the service's container in the
/// warm pool. The current revision has the number `current` and this `image`.
///
/// A connected robot keeps its revision. A servant that is being ended is not given to a robot.
pub fn place<'a>(
    has: Option<&ServantFacts<'a>>,
    warm: Option<&WarmContainer<'_>>,
    current: u64,
    image: &str,
) -> Placement<'a> {
    let mut ends = None;
    if let Some(servant) = has.filter(|servant| !servant.ending) {
        if servant.revision == current || servant.connections > 0 {
            return Placement::Keep(servant.id);
        }
        ends = Some(StopOrder { id: servant.id, reason: "replaced by another revision" });
    }
    let warm = warm.is_some_and(|warm| warm.runs && warm.is_from(current, image));
    Placement::Start { ends, warm }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_keeps_its_servant_until_another_revision_or_its_end() {
        let end = StopOrder { id: "one", reason: "replaced by another revision" };
        let start = |ends| Placement::Start { ends, warm: false };
        for (revision, connections, ending, expected) in [
            (2, 0, false, Placement::Keep("one")),
            (2, 1, false, Placement::Keep("one")),
            (1, 1, false, Placement::Keep("one")),
            (1, 0, false, start(Some(end))),
            (2, 1, true, start(None)),
            (1, 0, true, start(None)),
        ] {
            let has = ServantFacts { id: "one", revision, connections, promised: None, idle_until: None, ending };
            assert_eq!(place(Some(&has), None, 2, "sha256:2"), expected, "{has:?}");
        }
        assert_eq!(place(None, None, 2, "sha256:2"), start(None));
    }

    #[test]
    fn a_container_of_the_pool_is_used_where_it_runs_and_is_of_the_published_image() {
        for (revision, image, runs, used) in [
            (2, "sha256:2", true, true),
            (2, "sha256:2", false, false),
            (1, "sha256:2", true, false),
            // Of a service that was removed and published anew.
            (2, "sha256:1", true, false),
        ] {
            let warm = WarmContainer { id: "two", service: "detect", revision, image, runs, nodes: false };
            let placement = place(None, Some(&warm), 2, "sha256:2");
            let expected = Placement::Start { ends: None, warm: used };
            assert_eq!(placement, expected, "{warm:?}");
        }
    }
}
