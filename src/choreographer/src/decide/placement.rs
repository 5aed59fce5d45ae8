//! Which servant a robot is given: the one that it has, or a new one.

use super::warm_pool::Warm;
use super::{End, Servant};

/// What a robot that asks for a service is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Placement<'a> {
    /// The servant that it has, which is named by its id.
    Keep(&'a str),
    /// A new one.
    Start {
        /// The one that it has is ended before.
        ends: Option<End<'a>>,
        /// The new one is made of the service's container in the warm pool, unless that is gone when it is needed.
        warm: bool,
    },
}

/// `has` is the servant that this robot is given for this service so far, `warm` the service's container in the warm pool.
/// The revision that is published now has the number `current` and this `image`.
///
/// A robot that is connected keeps the revision that it works with. A servant that is being ended is given to nobody.
pub fn place<'a>(
    has: Option<&Servant<'a>>,
    warm: Option<&Warm<'_>>,
    current: u64,
    image: &str,
) -> Placement<'a> {
    let mut ends = None;
    if let Some(servant) = has.filter(|servant| !servant.ending) {
        if servant.revision == current || servant.connections > 0 {
            return Placement::Keep(servant.id);
        }
        ends = Some(End {
            id: servant.id,
            reason: "another revision takes its place",
        });
    }
    let warm = warm.is_some_and(|warm| warm.runs && warm.is_of(current, image));
    Placement::Start { ends, warm }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_keeps_its_servant_until_another_revision_or_its_end() {
        let end = End {
            id: "one",
            reason: "another revision takes its place",
        };
        let start = |ends| Placement::Start { ends, warm: false };
        for (revision, connections, ending, expected) in [
            (2, 0, false, Placement::Keep("one")),
            (2, 1, false, Placement::Keep("one")),
            (1, 1, false, Placement::Keep("one")),
            (1, 0, false, start(Some(end))),
            (2, 1, true, start(None)),
            (1, 0, true, start(None)),
        ] {
            let has = Servant {
                id: "one",
                revision,
                connections,
                promised: None,
                idle_until: None,
                ending,
            };
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
            let warm = Warm {
                id: "two",
                service: "detect",
                revision,
                image,
                runs,
                nodes: false,
            };
            let placement = place(None, Some(&warm), 2, "sha256:2");
            let expected = Placement::Start {
                ends: None,
                warm: used,
            };
            assert_eq!(placement, expected, "{warm:?}");
        }
    }
}
