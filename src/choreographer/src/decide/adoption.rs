//! What becomes of what an earlier daemon left.

/// A container that runs although this daemon did not start it.
#[derive(Debug, Clone, Copy)]
pub struct Found {
    /// The database knows it as a robot's servant.
    pub recorded: bool,
    /// The database knows it as one that was ready for a robot that had not come.
    pub nobodys: bool,
    /// The revision that it was started from is known.
    pub published: bool,
    /// No node was ever started in it.
    pub empty: bool,
}

/// What becomes of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// It is its robot's servant, as before.
    Kept,
    /// It is ended, and nobody is told: of the warm pool, or killed before it had nodes.
    Unused,
    /// It is ended, and its end is told.
    Unknown,
}

/// What becomes of one.
pub fn fate(found: Found) -> Fate {
    match found {
        Found { nobodys: true, .. } => Fate::Unused,
        Found {
            recorded: true,
            published: true,
            ..
        } => Fate::Kept,
        Found {
            recorded: false,
            empty: true,
            ..
        } => Fate::Unused,
        _ => Fate::Unknown,
    }
}

/// A node that was started in it.
#[derive(Debug, Clone, Copy)]
pub struct Started {
    /// It has the name of one of the revision's own nodes, as a stub's node has where its robot gives no other.
    pub planned: bool,
    /// Whoever started it said for which run, as stubs do.
    pub run: bool,
}

/// Whether its robot's stubs start and end its nodes. Those of earlier versions do not say for which run.
pub fn is_linked(started: &[Started]) -> bool {
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
            // One of the package's nodes, under the name that it always has; the package may have others.
            (&[(true, true)], true),
            (&[(true, false), (true, true)], true),
            (&[(true, false), (true, false)], false),
        ] {
            let nodes = started.iter().map(|(planned, run)| Started {
                planned: *planned,
                run: *run,
            });
            let nodes: Vec<Started> = nodes.collect();
            assert_eq!(is_linked(&nodes), linked, "{started:?}");
        }
    }

    #[test]
    fn what_was_left_is_kept_for_its_robot_or_ended() {
        for (recorded, nobodys, published, empty, expected) in [
            (true, false, true, false, Fate::Kept),
            // Its stubs have started none yet.
            (true, false, true, true, Fate::Kept),
            (true, false, false, false, Fate::Unknown),
            (true, false, false, true, Fate::Unknown),
            (false, false, false, true, Fate::Unused),
            (false, false, true, true, Fate::Unused),
            (false, false, false, false, Fate::Unknown),
            (true, true, true, false, Fate::Unused),
            (true, true, false, false, Fate::Unused),
        ] {
            let found = Found {
                recorded,
                nobodys,
                published,
                empty,
            };
            assert_eq!(fate(found), expected, "{found:?}");
        }
    }
}
