//! Which services have a container in the warm pool, and which containers are no longer of use.

use super::End;

/// A container of the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Warm<'a> {
    /// Its id.
    pub id: &'a str,
    /// The service whose servant it can become.
    pub service: &'a str,
    /// The revision that it was made from.
    pub revision: u64,
    /// The revision's image.
    pub image: &'a str,
    /// It has not ended.
    pub runs: bool,
}

impl Warm<'_> {
    /// Whether it was made from this revision of its service.
    pub fn is_of(&self, revision: u64, image: &str) -> bool {
        self.revision == revision && self.image == image
    }
}

/// A published revision that is to have a container in the warm pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted<'a> {
    /// Its service.
    pub service: &'a str,
    /// Its number.
    pub revision: u64,
    /// Its image.
    pub image: &'a str,
}

/// The `count` services of `published` that are to have one: those asked for last first, `asked_for` having the last one
/// last, then those that nobody has asked for.
pub fn deserving(published: &[String], asked_for: &[String], count: usize) -> Vec<String> {
    let asked = asked_for.iter().rev().filter(|it| published.contains(it));
    let mut order: Vec<String> = Vec::new();
    for service in asked.chain(published) {
        if order.len() < count && !order.contains(service) {
            order.push(service.clone());
        }
    }
    order
}

/// Those of `pool` that are of none of the wanted revisions, or do not run.
pub fn stale<'a>(pool: impl Iterator<Item = Warm<'a>>, wanted: &[Wanted<'_>]) -> Vec<End<'a>> {
    let is_wanted = |warm: &Warm<'_>| {
        wanted.iter().any(|wanted| {
            warm.service == wanted.service && warm.is_of(wanted.revision, wanted.image)
        })
    };
    pool.filter_map(|warm| {
        let reason = match (warm.runs, is_wanted(&warm)) {
            (true, true) => return None,
            (true, false) => "its revision is not wanted",
            (false, _) => "it does not run",
        };
        Some(End {
            id: warm.id,
            reason,
        })
    })
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_services_asked_for_last_have_containers() {
        let names =
            |names: &[&str]| -> Vec<String> { names.iter().map(|it| (*it).into()).collect() };
        let published = names(&["a", "b", "c", "d"]);
        for (asked_for, count, expected) in [
            (names(&[]), 2, ["a", "b"].as_slice()),
            (names(&["gone", "d", "c"]), 3, &["c", "d", "a"]),
            (names(&["c"]), 0, &[]),
            (names(&["c"]), 9, &["c", "a", "b", "d"]),
        ] {
            let order = deserving(&published, &asked_for, count);
            assert_eq!(order, expected, "{asked_for:?}");
        }
    }

    #[test]
    fn containers_end_that_do_not_run_or_are_of_what_is_not_wanted() {
        let wanted = [Wanted {
            service: "a",
            revision: 2,
            image: "sha256:2",
        }];
        let warm = |service, revision, image, runs| Warm {
            id: "it",
            service,
            revision,
            image,
            runs,
        };
        for (warm, stays) in [
            (warm("a", 2, "sha256:2", true), true),
            (warm("a", 2, "sha256:2", false), false),
            (warm("a", 1, "sha256:2", true), false),
            (warm("a", 2, "sha256:1", true), false),
            (warm("b", 2, "sha256:2", true), false),
        ] {
            let ends = stale([warm].into_iter(), &wanted);
            assert_eq!(ends.is_empty(), stays, "{warm:?}");
        }
    }
}
