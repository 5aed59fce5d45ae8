//! ROS names as clients write them.

use std::borrow::Cow;

/// The absolute form of a topic's, service's or action's name; clients live in the namespace `/`.
pub(crate) fn resolve(name: &str) -> Result<Cow<'_, str>, String> {
    let well_formed = |part: &str| {
        let mut characters = part.chars();
        characters
            .next()
            .is_some_and(|first| first.is_ascii_alphabetic())
            && characters.all(|other| other.is_ascii_alphanumeric() || other == '_')
    };
    if name.starts_with('~') {
        return Err(format!(
            "{name:?} is a private name, which a client does not have; write the full name"
        ));
    }
    if name
        .strip_prefix('/')
        .unwrap_or(name)
        .split('/')
        .all(well_formed)
    {
        return Ok(if name.starts_with('/') {
            Cow::Borrowed(name)
        } else {
            Cow::Owned(format!("/{name}"))
        });
    }
    // ROS forgives doubled and trailing slashes, and parts that begin with a digit or underscore after the first.
    let parts: Vec<&str> = name.split('/').filter(|part| !part.is_empty()).collect();
    let allowed = |part: &&str| {
        part.chars()
            .all(|other| other.is_ascii_alphanumeric() || other == '_')
    };
    if parts.first().is_some_and(|first| well_formed(first)) && parts.iter().all(allowed) {
        return Ok(Cow::Owned(
            parts.iter().flat_map(|part| ["/", part]).collect(),
        ));
    }
    let shown: String = name.chars().take(64).collect();
    Err(format!(
        "{shown:?} is not a ROS name: letters, digits, _ and / are allowed, a letter comes first"
    ))
}

/// `package/Type` of what clients write, ROS 2's `package/msg/Type` included.
pub(crate) fn plain_type(name: &str) -> Cow<'_, str> {
    for middle in ["/msg/", "/srv/", "/action/"] {
        if let Some((package, rest)) = name.split_once(middle) {
            return Cow::Owned(format!("{package}/{rest}"));
        }
    }
    Cow::Borrowed(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_absolute() {
        assert!(matches!(
            resolve("/camera/image_raw"),
            Ok(Cow::Borrowed("/camera/image_raw"))
        ));
        assert_eq!(resolve("chatter").unwrap(), "/chatter");
        assert_eq!(resolve("//a///b/").unwrap(), "/a/b");
        assert_eq!(resolve("/a/_b/2").unwrap(), "/a/_b/2");
        for name in ["", "/", "~x", "/1a", "/a b", "/ä", "a\n", "/_x"] {
            assert!(resolve(name).is_err(), "{name}");
        }
    }

    #[test]
    fn types_of_ros_2_are_understood() {
        assert_eq!(plain_type("std_msgs/msg/String"), "std_msgs/String");
        assert_eq!(plain_type("std_msgs/String"), "std_msgs/String");
    }
}
