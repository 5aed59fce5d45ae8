//! Validation of the names of services (used as paths on the portal, as repositories under `/v2/`, and in container
//! names) and of robots.

/// First path segments reserved by the portal.
pub const RESERVED_NAMES: [&str; 7] = ["api", "v2", "stubs", "metrics", "healthz", "assets", "foxglove"];

/// An invalid name.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum NameError {
    /// Malformed service name.
    #[error(
        "{0:?} cannot name a service: use 1 to 63 lower-case letters, digits, `_` and `-`, \
         beginning with a letter and not ending with `_` or `-`"
    )]
    Service(String),
    /// Path reserved by the portal.
    #[error("{0:?} is a reserved name: the portal serves something else at that path; choose another with --name")]
    Reserved(String),
    /// Malformed robot name.
    #[error(
        "{0:?} cannot name a robot: use 1 to 64 letters, digits, `.`, `_` and `-`, beginning with a letter or digit"
    )]
    Robot(String),
}

/// Validates the name of a service.
pub fn validate_service(name: &str) -> Result<(), NameError> {
    let inner = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == '-';
    let well_formed = name.len() <= 63
        && name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.ends_with(|c: char| c.is_ascii_lowercase() || c.is_ascii_digit())
        && name.chars().all(inner);
    if !well_formed {
        return Err(NameError::Service(name.to_owned()));
    }
    if RESERVED_NAMES.contains(&name) {
        return Err(NameError::Reserved(name.to_owned()));
    }
    Ok(())
}

/// Validates the name of a robot.
pub fn validate_robot(name: &str) -> Result<(), NameError> {
    let inner = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    let well_formed = (1..=64).contains(&name.len())
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name.chars().all(inner);
    if well_formed { Ok(()) } else { Err(NameError::Robot(name.to_owned())) }
}

/// Generates an id for a servant of `service`: the service name as a valid host name, followed by random characters.
pub fn servant_id(service: &str) -> String {
    let mut id: String = service.chars().take(32).map(|c| if c == '_' { '-' } else { c }).collect();
    id.push('-');
    id.push_str(&random(8));
    id
}

/// Generates `length` random characters of `[a-z0-9]`.
pub fn random(length: usize) -> String {
    use rand::Rng;
    const ALPHABET: &[u8; 36] = b"abcdefghijklmnopqrstuvwxyz0123456789";
    let mut random = rand::rng();
    (0..length).map(|_| char::from(ALPHABET[random.random_range(0..ALPHABET.len())])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ros_package_names_name_services() {
        for name in ["opencv_apps", "image-proc", "a", "slam2d"] {
            assert_eq!(validate_service(name), Ok(()), "{name}");
        }
    }

    #[test]
    fn what_breaks_a_path_names_no_service() {
        let long = "a".repeat(64);
        for name in ["", "Image", "2d", "a/b", "..", "a b", "a_", "-a", "é", "a.b", &long] {
            assert_eq!(validate_service(name), Err(NameError::Service(name.to_owned())));
        }
    }

    #[test]
    fn the_portals_own_paths_are_reserved() {
        for name in RESERVED_NAMES {
            assert_eq!(validate_service(name), Err(NameError::Reserved(name.to_owned())));
        }
    }

    #[test]
    fn robots_are_named_more_freely() {
        for name in ["r1", "Turtlebot.3_b-2", "0"] {
            assert_eq!(validate_robot(name), Ok(()), "{name}");
        }
        for name in ["", "a b", "../x", "a/b", "-x", ".", &"r".repeat(65)] {
            assert_eq!(validate_robot(name), Err(NameError::Robot(name.to_owned())));
        }
    }

    #[test]
    fn servant_ids_are_host_names() {
        let id = servant_id(&"a_".repeat(31));
        assert!(id.len() <= 48 && id.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-'), "{id}");
        assert_ne!(servant_id("a"), servant_id("a"));
    }
}
