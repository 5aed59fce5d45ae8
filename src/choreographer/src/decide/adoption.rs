//! Decides about containers that an earlier daemon left.

/// A running container that this daemon did not start.
#[derive(Debug, Clone, Copy)]
pub struct LeftoverContainer {
    /// The database lists it as a robot's servant.
    pub recorded: bool,
    /// The database lists it as kept ready for a robot that had not come.
    pub nobodys: bool,
    /// The revision that it was started from is known.
    pub published: bool,
    /// No node was ever started in it.
    pub empty: bool,
}

/// The fate of a left container.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeftoverFate {
    /// It stays its robot's servant.
    Kept,
    /// It is ended without an event: it belonged to the warm pool, or was killed before it had nodes.
    Unused,
    /// It is ended with an event.
    Unknown,
}

/// Decides what is done with a left container.
pub fn decide_fate(found: LeftoverContainer) -> LeftoverFate {
    match found {
        LeftoverContainer { nobodys: true, .. } => LeftoverFate::Unused,
        LeftoverContainer { recorded: true, published: true, .. } => LeftoverFate::Kept,
        LeftoverContainer { recorded: false, empty: true, .. } => LeftoverFate::Unused,
        _ => LeftoverFate::Unknown,
    }
}

/// A node that was started in the container.
#[derive(Debug, Clone, Copy)]
pub struct StartedNode {
    /// It has the name of one of the revision's own nodes, like a stub's node whose robot gives no other name.
    pub planned: bool,
    /// The run was stated when it was started, as stubs do.
    pub run: bool,
}

/// Returns true if the robot's stubs start and end its nodes. Stubs of earlier versions do not state the run.
pub fn is_linked(started: &[StartedNode]) -> bool {
    started.iter().any(|node| node.run) || !started.iter().any(|node| node.planned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stubs_are_known_by_the_runs_of_their_nodes() {
        for (started, linked) in [
            (&[][..], true),
            (&[(false, true)], true),
            (&[(false, false)], true),
            // One of the package's nodes, under its default name; the package may have others.
            (&[(true, true)], true),
            (&[(true, false), (true, true)], true),
            (&[(true, false), (true, false)], false),
        ] {
            let nodes = started.iter().map(|(planned, run)| StartedNode { planned: *planned, run: *run });
            let nodes: Vec<StartedNode> = nodes.collect();
            assert_eq!(is_linked(&nodes), linked, "{started:?}");
        }
    }

    #[test]
    fn what_was_left_is_kept_for_its_robot_or_ended() {
        for (recorded, nobodys, published, empty, expected) in [
            (true, false, true, false, LeftoverFate::Kept),
            // Its stubs have started no node yet.
            (true, false, true, true, LeftoverFate::Kept),
            (true, false, false, false, LeftoverFate::Unknown),
            (true, false, false, true, LeftoverFate::Unknown),
            (false, false, false, true, LeftoverFate::Unused),
            (false, false, true, true, LeftoverFate::Unused),
            (false, false, false, false, LeftoverFate::Unknown),
            (true, true, true, false, LeftoverFate::Unused),
            (true, true, false, false, LeftoverFate::Unused),
        ] {
            let found = LeftoverContainer { recorded, nobodys, published, empty };
            assert_eq!(decide_fate(found), expected, "{found:?}");
        }
    }
}
