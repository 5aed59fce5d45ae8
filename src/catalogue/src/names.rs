//! Which names may be given: to services (they become paths on the portal, repositories under `/v2/` and parts of
//! container names) and to robots.

/// First path segments that the portal keeps for itself.
pub const RESERVED: [&str; 7] = [
    "api", "v2", "stubs", "metrics", "healthz", "assets", "foxglove",
];

/// A name that cannot be given.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum NameError {
    /// Not in the form that a service's name has.
    #[error(
        "{0:?} cannot name a service: use 1 to 63 lower-case letters, digits, `_` and `-`, \
         beginning with a letter and not ending with `_` or `-`"
    )]
    Service(String),
    /// The portal serves something else there.
    #[error(
        "{0:?} is a reserved name: the portal serves something else at that path; choose another with --name"
    )]
    Reserved(String),
    /// Not in the form that a robot's name has.
    #[error(
        "{0:?} cannot name a robot: use 1 to 64 letters, digits, `.`, `_` and `-`, beginning with a letter or digit"
    )]
    Robot(String),
}

/// Accepts a service's name.
pub fn service(name: &str) -> Result<(), NameError> {
    let inner = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == '-';
    let well_formed = name.len() <= 63
        && name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.ends_with(|c: char| c.is_ascii_lowercase() || c.is_ascii_digit())
        && name.chars().all(inner);
    if !well_formed {
        return Err(NameError::Service(name.to_owned()));
    }
    if RESERVED.contains(&name) {
        return Err(NameError::Reserved(name.to_owned()));
    }
    Ok(())
}

/// Accepts a robot's name.
pub fn robot(name: &str) -> Result<(), NameError> {
    let inner = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    let well_formed = (1..=64).contains(&name.len())
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name.chars().all(inner);
    if well_formed {
        Ok(())
    } else {
        Err(NameError::Robot(name.to_owned()))
    }
}

/// An id for a servant of `service`: its name as a host name allows it, and something random.
pub fn servant_id(service: &str) -> String {
    let mut id: String = service
        .chars()
        .take(32)
        .map(|c| if c == '_' { '-' } else { c })
        .collect();
    id.push('-');
    id.push_str(&random(8));
    id
}

/// `length` random characters of `[a-z0-9]`.
pub fn random(length: usize) -> String {
    use rand::Rng;
    const ALPHABET: &[u8; 36] = b"abcdefghijklmnopqrstuvwxyz0123456789";
    let mut random = rand::rng();
    (0..length)
        .map(|_| char::from(ALPHABET[random.random_range(0..ALPHABET.len())]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ros_package_names_name_services() {
        for name in ["opencv_apps", "image-proc", "a", "slam2d"] {
            assert_eq!(service(name), Ok(()), "{name}");
        }
    }

    #[test]
    fn what_breaks_a_path_names_no_service() {
        let long = "a".repeat(64);
        for name in [
            "", "Image", "2d", "a/b", "..", "a b", "a_", "-a", "é", "a.b", &long,
        ] {
            assert_eq!(service(name), Err(NameError::Service(name.to_owned())));
        }
    }

    #[test]
    fn the_portals_own_paths_are_reserved() {
        for name in RESERVED {
            assert_eq!(service(name), Err(NameError::Reserved(name.to_owned())));
        }
    }

    #[test]
    fn robots_are_named_more_freely() {
        for name in ["r1", "Turtlebot.3_b-2", "0"] {
            assert_eq!(robot(name), Ok(()), "{name}");
        }
        for name in ["", "a b", "../x", "a/b", "-x", ".", &"r".repeat(65)] {
            assert_eq!(robot(name), Err(NameError::Robot(name.to_owned())));
        }
    }

    #[test]
    fn servant_ids_are_host_names() {
        let id = servant_id(&"a_".repeat(31));
        assert!(
            id.len() <= 48
                && id
                    .chars()
                    .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-'),
            "{id}"
        );
        assert_ne!(servant_id("a"), servant_id("a"));
    }
}
