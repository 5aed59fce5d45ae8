//! Names that go into paths, commands and addresses.

use crate::Error;

/// First parts of the portal's own addresses; no service can have them.
pub const RESERVED: [&str; 6] = ["api", "v2", "stubs", "metrics", "healthz", "assets"];

/// The longest service name: a label of a host name.
const MAX_SERVICE: usize = 63;

/// Checks that a service can be reached at `/NAME`: 1 to 63 letters, digits, `_` and `-`, the first a letter or
/// digit, and none of [`RESERVED`] (in any case, as a proxy may fold it).
pub fn check_service(name: &str) -> Result<(), Error> {
    let wrong = |problem: String| {
        Err(Error::ServiceName {
            name: name.to_owned(),
            problem,
        })
    };
    if name.is_empty() || name.len() > MAX_SERVICE {
        return wrong(format!(
            "it has {} characters, and 1 to {MAX_SERVICE} are possible",
            name.len()
        ));
    }
    if let Some(bad) = name
        .chars()
        .find(|c| !(c.is_ascii_alphanumeric() || "_-".contains(*c)))
    {
        return wrong(format!(
            "it contains {bad:?}, and only letters, digits, _ and - are possible"
        ));
    }
    if !name.starts_with(|c: char| c.is_ascii_alphanumeric()) {
        return wrong("it must begin with a letter or digit".to_owned());
    }
    if RESERVED
        .iter()
        .any(|reserved| name.eq_ignore_ascii_case(reserved))
    {
        return wrong("the portal's own pages have that name".to_owned());
    }
    Ok(())
}

/// A ROS package's name: a letter, then letters, digits, `_` and `-` (REP 144, with what is in use beside it).
pub fn is_package(name: &str) -> bool {
    name.len() <= 128
        && name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "_-".contains(c))
}

/// A dependency's name: a package's or a rosdep key, such as `libstdc++6` or `python3.11-dev`.
pub fn is_dependency(name: &str) -> bool {
    name.len() <= 128
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "_-.+".contains(c))
}

/// The second half of a type: a letter, then letters, digits and `_`.
pub fn is_type(name: &str) -> bool {
    name.len() <= 128
        && name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// The name of a program in a package: that of a file, which commands and scripts can hold without surprises.
pub fn is_executable(name: &str) -> bool {
    (1..=255).contains(&name.len())
        && !name.starts_with(['.', '-'])
        && name
            .chars()
            .all(|c| !c.is_control() && !"'\"`$\\/".contains(c))
}

/// `package/Type`.
pub fn is_full_type(name: &str) -> bool {
    name.split_once('/')
        .is_some_and(|(package, of_it)| is_package(package) && is_type(of_it))
}

/// An absolute graph name such as `/camera/image_raw`.
pub fn is_graph_name(name: &str) -> bool {
    name.len() <= 512
        && name.strip_prefix('/').is_some_and(|parts| {
            parts.split('/').all(|part| {
                part.starts_with(|c: char| c.is_ascii_alphanumeric() || c == '_')
                    && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            })
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn service_names_are_those_of_packages() {
        for good in ["opencv_apps", "a", "3d-mapper", "Foo_Bar", &"x".repeat(63)] {
            assert!(check_service(good).is_ok(), "{good}");
        }
    }

    #[test]
    fn other_service_names_are_refused_with_the_reason() {
        let cases = [
            ("", "0 characters"),
            (&"x".repeat(64), "64 characters"),
            ("a/b", "contains '/'"),
            ("ä", "contains 'ä'"),
            ("../x", "contains '.'"),
            ("-x", "begin with a letter or digit"),
            ("_x", "begin with a letter or digit"),
            ("api", "portal's own"),
            ("Metrics", "portal's own"),
        ];
        for (name, reason) in cases {
            let text = check_service(name).unwrap_err().to_string();
            assert!(text.contains(reason) && text.contains("--name"), "{text}");
        }
        for reserved in RESERVED {
            assert!(check_service(reserved).is_err());
        }
    }

    #[test]
    fn names_of_other_things() {
        assert!(
            is_package("image_proc")
                && !is_package("1x")
                && !is_package("a b")
                && !is_package("../x")
        );
        assert!(is_dependency("libstdc++6") && !is_dependency("-oDir=/") && !is_dependency("a;b"));
        assert!(
            is_full_type("sensor_msgs/Image") && !is_full_type("Image") && !is_full_type("a/b/C")
        );
        assert!(
            is_graph_name("/camera/image_raw") && is_graph_name("/_x") && !is_graph_name("image")
        );
        assert!(
            !is_graph_name("/")
                && !is_graph_name("/a//b")
                && !is_graph_name("/a/")
                && !is_graph_name("/a b")
        );
    }
}
