//! Compatibility of a stub with a later revision than the one it was built from: it remains usable unless the interface
//! that it relies on has changed.

use package::difference::Difference;

use store::{RevisionRecord, State};

/// Maximum number of differences named in an error.
const NAMED: usize = 8;

/// Checks whether a stub built from revision `made_of`, with this image, is compatible with `now`. Otherwise returns
/// the incompatible differences and the next step.
pub fn check_stub_compatibility(
    state: &State,
    now: &RevisionRecord,
    made_of: Option<u64>,
    image: &str,
) -> Result<(), String> {
    let Some(number) = made_of.filter(|_| image != now.image) else {
        return Ok(());
    };
    let service = &now.service;
    let earlier = state
        .revision(service, number)
        .map_err(|error| error.to_string())?;
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
    let breaking = difference
        .changes
        .iter()
        .filter(|change| !change.compatible);
    let mut words: Vec<String> = breaking.map(ToString::to_string).collect();
    if words.len() > NAMED {
        let more = words.len() - NAMED;
        words.truncate(NAMED);
        words.push(format!("{more} more"));
    }
    Err(format!(
        "service {service} is at revision {}, but this robot's stub was made from revision {number}, and they differ: \
            {}; install the stub again from /stubs/{service}.tar.gz, or roll the server back: cloudroidctl rollback \
            {service} {number}",
        now.number,
        words.join("; "),
    ))
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
            interface: Interface {
                topics: topics.iter().map(topic).collect(),
                ..Interface::default()
            },
        }
    }

    #[test]
    fn a_stub_goes_on_until_something_it_relies_on_is_gone() {
        let place = tempfile::tempdir().expect("a directory");
        let state = State::open(&place.path().join("cloudroid.db")).expect("a database");
        let all = [
            revision(1, &["/a"]),
            revision(2, &["/a", "/b"]),
            revision(3, &["/b"]),
        ];
        for revision in &all {
            state
                .publish(revision, &Default::default())
                .expect("published");
        }
        let fits = |now: usize, image: &str| {
            super::check_stub_compatibility(&state, &all[now], Some(1), image)
        };
        assert_eq!(fits(1, "sha256:1"), Ok(()), "something is new");
        let refused = fits(2, "sha256:1").expect_err("something is gone");
        assert!(
            refused.contains("output topic /a was removed") && refused.contains("/stubs/s.tar.gz"),
            "{refused}"
        );
        assert_eq!(fits(2, "sha256:of another server"), Ok(()));
        assert_eq!(
            super::check_stub_compatibility(&state, &all[2], None, ""),
            Ok(())
        );
    }
}
