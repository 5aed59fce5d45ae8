//! Compatibility of a stub with a later revision than the one it was built from: it remains usable unless the interface
//! that it relies on has changed.

use package::difference::{Change, Difference};

use store::{RevisionRecord, State};

/// Maximum number of differences named in an error.
const MAX_NAMED_DIFFERENCES: usize = 8;

/// Reason why a stub cannot be used with a service.
#[derive(Debug, thiserror::Error)]
pub enum StubError {
    /// The interface that the stub relies on has changed.
    #[error(
        "service {service} is at revision {current}, but this robot's stub was made from revision {made_of}, and they \
            differ: {}; install the stub again from /stubs/{service}.tar.gz, or roll the server back: cloudroidctl \
            rollback {service} {made_of}", join_changes(.breaking)
    )]
    Incompatible {
        /// Name of the service.
        service: String,
        /// Current revision.
        current: u64,
        /// Revision that the stub was made from.
        made_of: u64,
        /// Incompatible differences.
        breaking: Vec<Change>,
    },
    /// Error of the state database.
    #[error(transparent)]
    State(#[from] store::Error),
}

fn join_changes(changes: &[Change]) -> String {
    let mut words: Vec<String> = changes.iter().map(ToString::to_string).collect();
    if words.len() > MAX_NAMED_DIFFERENCES {
        let more = words.len() - MAX_NAMED_DIFFERENCES;
        words.truncate(MAX_NAMED_DIFFERENCES);
        words.push(format!("{more} more"));
    }
    words.join("; ")
}

/// Checks whether a stub built from revision `made_of`, with this image, is compatible with `now`. Otherwise returns
/// the incompatible differences and the next step.
pub fn check_stub_compatibility(
    state: &State,
    now: &RevisionRecord,
    made_of: Option<u64>,
    image: &str,
) -> Result<(), StubError> {
    let Some(number) = made_of.filter(|_| image != now.image) else {
        return Ok(());
    };
    let service = &now.service;
    let earlier = state.revision(service, number)?;
    let Some(earlier) = earlier.filter(|earlier| earlier.image == image) else {
        tracing::warn!(
            "a stub of {service} was made from revision {number} of another server, so it may not match revision {}",
            now.number
        );
        return Ok(());
    };
    let difference = Difference::compare(&earlier.interface, &now.interface);
    if difference.compatible() {
        return Ok(());
    }
    let changes = difference.changes.into_iter();
    Err(StubError::Incompatible {
        service: service.clone(),
        current: now.number,
        made_of: number,
        breaking: changes.filter(|change| !change.compatible).collect(),
    })
}

#[cfg(test)]
mod tests {
    use package::interface::{Direction, Interface, Topic};

    use super::*;

    fn revision(number: u64, topics: &[&str]) -> RevisionRecord {
        let topic = |name: &&str| Topic {
            name: (*name).into(),
            type_name: "std_msgs/String".into(),
            md5: "aa".into(),
            direction: Direction::Output,
            nodes: vec![],
            latched: false,
            lazy: false,
            qos: None,
        };
        RevisionRecord {
            service: "s".into(),
            number,
            image: format!("sha256:{number}"),
            published: 0,
            package: "p".into(),
            owner: None,
            source: String::new(),
            flavour: Default::default(),
            plan: Default::default(),
            interface: Interface { topics: topics.iter().map(topic).collect(), ..Interface::default() },
        }
    }

    #[test]
    fn a_stub_goes_on_until_something_it_relies_on_is_gone() {
        let place = tempfile::tempdir().expect("a directory");
        let state = State::open(&place.path().join("cloudroid.db")).expect("a database");
        let all = [revision(1, &["/a"]), revision(2, &["/a", "/b"]), revision(3, &["/b"])];
        for revision in &all {
            state.publish(revision, &Default::default()).expect("published");
        }
        let fits = |now: usize, image: &str| super::check_stub_compatibility(&state, &all[now], Some(1), image);
        fits(1, "sha256:1").expect("something is new");
        let refused = fits(2, "sha256:1").expect_err("something is gone").to_string();
        assert!(refused.contains("output topic /a was removed") && refused.contains("/stubs/s.tar.gz"), "{refused}");
        fits(2, "sha256:of another server").expect("nothing is known of it");
        super::check_stub_compatibility(&state, &all[2], None, "").expect("it names no revision");
    }
}
