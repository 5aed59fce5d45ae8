//! Names of ROS as written by clients, and as spelled by the servant's ROS.

use std::borrow::Cow;

use ros::bus::{RosVersion, WireFormat, WireType};

/// Reasons why the name of a topic, service or action cannot be resolved.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ResolveNameError {
    #[error("{0:?} is a private name, which a client does not have; write the full name")]
    Private(String),
    #[error("{shown:?} is not a ROS name: letters, digits, _ and / are allowed, {rule}")]
    Malformed {
        /// The name, shortened.
        shown: String,
        /// The rule on first characters in this version of ROS.
        rule: &'static str,
    },
}

/// A topic, service or action that has another type than the client gives.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what} has type {theirs}, not {said}; use the type that it has")]
pub(crate) struct DeclaredTypeError {
    what: String,
    theirs: String,
    said: String,
}

impl DeclaredTypeError {
    /// Creates the error of `what`, such as `topic /text`, whose type is `theirs` instead of `said`.
    pub(crate) fn new(what: String, theirs: &str, said: &str) -> Self {
        Self { what, theirs: theirs.to_owned(), said: said.to_owned() }
    }
}

/// Resolves the name of a topic, service or action to its absolute form; clients are in the namespace `/`.
pub(crate) fn resolve(version: RosVersion, name: &str) -> Result<Cow<'_, str>, ResolveNameError> {
    let well_formed = |part: &str| {
        let mut characters = part.chars();
        characters.next().is_some_and(|first| first.is_ascii_alphabetic())
            && characters.all(|other| other.is_ascii_alphanumeric() || other == '_')
    };
    if name.starts_with('~') {
        return Err(ResolveNameError::Private(name.to_owned()));
    }
    if name.strip_prefix('/').unwrap_or(name).split('/').all(well_formed) {
        return Ok(if name.starts_with('/') { Cow::Borrowed(name) } else { Cow::Owned(format!("/{name}")) });
    }
    // Duplicate and trailing slashes are tolerated.
    let parts: Vec<&str> = name.split('/').filter(|part| !part.is_empty()).collect();
    let characters = |part: &&str| part.chars().all(|other| other.is_ascii_alphanumeric() || other == '_');
    let starts = match version {
        // Components may start with a digit or an underscore, except for the first.
        RosVersion::One => parts.first().is_some_and(|first| well_formed(first)),
        // No component may start with a digit; those that start with an underscore are hidden.
        RosVersion::Two => {
            let digit = |part: &&str| part.starts_with(|first: char| first.is_ascii_digit());
            !parts.is_empty() && !parts.iter().any(digit)
        }
    };
    if starts && parts.iter().all(characters) {
        return Ok(Cow::Owned(parts.iter().flat_map(|part| ["/", part]).collect()));
    }
    let shown = name.chars().take(64).collect();
    let rule = match version {
        RosVersion::One => "a letter comes first",
        RosVersion::Two => "no part begins with a digit",
    };
    Err(ResolveNameError::Malformed { shown, rule })
}

/// Converts the name of a type, as written by clients and either ROS, to `package/Type`: `package/msg/Type` means the
/// same.
pub(crate) fn short_type_name(name: &str) -> Cow<'_, str> {
    for middle in ["/msg/", "/srv/", "/action/"] {
        if let Some((package, rest)) = name.split_once(middle) {
            return Cow::Owned(format!("{package}/{rest}"));
        }
    }
    Cow::Borrowed(name)
}

/// Returns whether both names mean the same type, however they are spelled.
pub(crate) fn is_same_type(one: &str, other: &str) -> bool {
    one == other || short_type_name(one) == short_type_name(other)
}

/// Returns the name of a type as spelled by the servant's ROS: `package/Type` in ROS 1, `package/KIND/Type` in ROS 2,
/// where `kind` is `msg`, `srv` or `action`. Anything else is returned unchanged.
pub(crate) fn ros_type_name<'a>(version: RosVersion, name: &'a str, kind: &str) -> Cow<'a, str> {
    match version {
        RosVersion::One => short_type_name(name),
        RosVersion::Two => match name.split_once('/') {
            Some((package, rest)) if !rest.contains('/') => Cow::Owned(format!("{package}/{kind}/{rest}")),
            _ => Cow::Borrowed(name),
        },
    }
}

/// Returns the name of a type for looking up the servant's definitions.
pub(crate) fn lookup_name(version: RosVersion, name: &str) -> Cow<'_, str> {
    match version {
        RosVersion::One => short_type_name(name),
        // Full names are known as they are, short ones are resolved by the lookup.
        RosVersion::Two => Cow::Borrowed(name),
    }
}

/// Returns the type of this name (any at all for `*`), with any definition.
pub(crate) fn wildcard_type(version: RosVersion, name: &str) -> WireType {
    WireType { format: WireFormat::for_version(version), ..WireType::with_name(name) }
}

/// Returns the term of each ROS for what identifies a definition.
pub(crate) fn digest_word(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "MD5",
        RosVersion::Two => "type hash",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOTH_VERSIONS: [RosVersion; 2] = [RosVersion::One, RosVersion::Two];

    #[test]
    fn names_become_absolute() {
        for version in BOTH_VERSIONS {
            assert!(matches!(resolve(version, "/camera/image_raw"), Ok(Cow::Borrowed("/camera/image_raw"))));
            assert_eq!(resolve(version, "chatter").unwrap(), "/chatter");
            assert_eq!(resolve(version, "//a///b/").unwrap(), "/a/b");
            assert_eq!(resolve(version, "/a/_b").unwrap(), "/a/_b");
            for name in ["", "/", "~x", "/1a", "/a b", "/ä", "a\n"] {
                assert!(resolve(version, name).is_err(), "{name}");
            }
        }
        let reason = |version, name| resolve(version, name).unwrap_err().to_string();
        assert_eq!(resolve(RosVersion::One, "/a/2").unwrap(), "/a/2");
        assert_eq!(
            reason(RosVersion::Two, "/a/2"),
            "\"/a/2\" is not a ROS name: letters, digits, _ and / are allowed, no part begins with a digit"
        );
        assert_eq!(resolve(RosVersion::Two, "/_x").unwrap(), "/_x");
        assert_eq!(
            reason(RosVersion::One, "/_x"),
            "\"/_x\" is not a ROS name: letters, digits, _ and / are allowed, a letter comes first"
        );
    }

    #[test]
    fn types_are_written_as_either_ros_does() {
        let message = |version, name| ros_type_name(version, name, "msg").into_owned();
        for name in ["std_msgs/msg/String", "std_msgs/String"] {
            assert_eq!(short_type_name(name), "std_msgs/String");
            assert_eq!(message(RosVersion::One, name), "std_msgs/String");
            assert_eq!(message(RosVersion::Two, name), "std_msgs/msg/String");
            assert!(is_same_type(name, "std_msgs/String"));
            assert!(!is_same_type(name, "std_msgs/Int32"));
        }
        assert_eq!(message(RosVersion::Two, "a/action/B_Goal"), "a/action/B_Goal");
        assert_eq!(ros_type_name(RosVersion::Two, "a/B", "srv"), "a/srv/B");
        assert_eq!(message(RosVersion::Two, "*"), "*");
        assert_eq!(message(RosVersion::Two, ""), "");
    }

    #[test]
    fn whoever_takes_any_definition_takes_those_of_its_ros() {
        for version in BOTH_VERSIONS {
            let any = wildcard_type(version, "*");
            let own = WireType { format: WireFormat::for_version(version), ..WireType::new("a/B", "1234", "") };
            assert!(any.is_compatible_with(&own));
            for other in BOTH_VERSIONS {
                assert_eq!(wildcard_type(other, "a/B").is_compatible_with(&own), other == version);
            }
        }
    }
}
