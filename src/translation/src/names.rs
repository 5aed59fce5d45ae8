//! Names of types: `package/Type` in ROS 1, `package/kind/Type` in ROS 2.

use ros_message::RosVersion;

/// The parts of a type's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TypeName<'a> {
    pub(crate) package: &'a str,
    /// `msg`, `srv` or `action` in ROS 2; otherwise empty.
    pub(crate) kind: &'a str,
    pub(crate) short: &'a str,
}

impl<'a> TypeName<'a> {
    pub(crate) fn parse(name: &'a str) -> TypeName<'a> {
        let (package, rest) = name.split_once('/').unwrap_or(("", name));
        let (kind, short) = rest.rsplit_once('/').unwrap_or(("", rest));
        TypeName { package, kind, short }
    }
}

/// Returns the name of a type of this kind (`msg`, `srv` or `action`).
pub(crate) fn write_name(version: RosVersion, package: &str, kind: &str, short: &str) -> String {
    match version {
        RosVersion::One => format!("{package}/{short}"),
        RosVersion::Two => format!("{package}/{kind}/{short}"),
    }
}

/// Suffixes of the messages of services and actions in ROS 2, by kind.
const PARTS: [(&str, &str); 5] =
    [("srv", "_Request"), ("srv", "_Response"), ("action", "_Goal"), ("action", "_Result"), ("action", "_Feedback")];

/// Splits the name of a service's or action's message in ROS 2 into the name of the service or action and what follows
/// it in ROS 1: `Type_Request` is `Type` and `Request`.
pub(crate) fn split_part<'a>(name: TypeName<'a>) -> Option<(&'a str, &'static str)> {
    let parts = PARTS.into_iter().filter(|(kind, _)| *kind == name.kind);
    let mut found = parts.filter_map(|(_, suffix)| Some((name.short.strip_suffix(suffix)?, &suffix[1..])));
    found.next()
}

/// Returns the name that a field of ROS 1 has in ROS 2, which takes lower-case letters, digits and single underscores:
/// `frameId` becomes `frame_id`.
pub(crate) fn lower_name(name: &str) -> String {
    let mut lower = String::with_capacity(name.len() + 4);
    let mut before = '_';
    for character in name.chars() {
        let begins_word = character.is_ascii_uppercase() && (before.is_ascii_lowercase() || before.is_ascii_digit());
        if begins_word {
            lower.push('_');
        }
        if character != '_' || !lower.ends_with('_') {
            lower.push(character.to_ascii_lowercase());
        }
        before = character;
    }
    let trimmed = lower.trim_end_matches('_');
    trimmed.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_parts() {
        let name = |package, kind, short| TypeName { package, kind, short };
        assert_eq!(TypeName::parse("a/B"), name("a", "", "B"));
        assert_eq!(TypeName::parse("a/srv/B_Request"), name("a", "srv", "B_Request"));
        assert_eq!(split_part(TypeName::parse("a/srv/B_Request")), Some(("B", "Request")));
        assert_eq!(split_part(TypeName::parse("a/action/B_Goal")), Some(("B", "Goal")));
        assert_eq!(split_part(TypeName::parse("a/msg/B_Goal")), None);
    }

    #[test]
    fn fields_are_lower_case_in_ros_2() {
        for (name, expected) in [
            ("D", "d"),
            ("frameId", "frame_id"),
            ("frame_id", "frame_id"),
            ("a__B_", "a_b"),
            ("x2Y", "x2_y"),
            ("URL", "url"),
        ] {
            assert_eq!(lower_name(name), expected);
        }
    }
}
