//! What becomes of what an earlier daemon left.

/// A container that runs although this daemon did not start it.
#[derive(Debug, Clone, Copy)]
pub struct Found {
    /// The database knows it as a robot's servant.
    pub recorded: bool,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_left_is_kept_for_its_robot_or_ended() {
        for (recorded, published, empty, expected) in [
            (true, true, false, Fate::Kept),
            // Its stubs have started none yet.
            (true, true, true, Fate::Kept),
            (true, false, false, Fate::Unknown),
            (true, false, true, Fate::Unknown),
            (false, false, true, Fate::Unused),
            (false, true, true, Fate::Unused),
            (false, false, false, Fate::Unknown),
        ] {
            let found = Found {
                recorded,
                published,
                empty,
            };
            assert_eq!(fate(found), expected, "{found:?}");
        }
    }
}
