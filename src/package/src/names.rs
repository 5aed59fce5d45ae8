//! Validation of names that are used in paths, commands and addresses.

/// Returns whether a text is the name of a ROS package: a letter, then letters, digits, `_` and `-` (REP 144, extended
/// by what is in use).
pub fn is_package(name: &str) -> bool {
    name.len() <= 128
        && name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c))
}

/// Returns whether a text is the name of a dependency: a package or a rosdep key, such as `libstdc++6` or
/// `python3.11-dev`.
pub fn is_dependency(name: &str) -> bool {
    name.len() <= 128
        && name.starts_with(|c: char| c.is_ascii_alphanumeric())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.+".contains(c))
}

/// Returns whether a text is the second part of a type: a letter, then letters, digits and `_`.
pub fn is_type(name: &str) -> bool {
    name.len() <= 128
        && name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// Returns whether a text is the name of an executable: a file name without characters that are special in commands and
/// scripts.
pub fn is_executable(name: &str) -> bool {
    (1..=255).contains(&name.len())
        && !name.starts_with(['.', '-'])
        && name.chars().all(|c| !c.is_control() && !"'\"`$\\/".contains(c))
}

/// Returns whether a text is a qualified C++ class, such as `image_tools::ShowImage`.
pub fn is_class(name: &str) -> bool {
    name.len() <= 512 && name.split("::").all(is_type)
}

/// Returns whether a text is the path of a library in an install space, such as `lib/libtalker.so`.
pub fn is_library(path: &str) -> bool {
    path.len() <= 512 && path.split('/').all(is_executable)
}

/// Returns whether a text is a type: `package/Type`, or `package/msg/Type` as in ROS 2.
pub fn is_full_type(name: &str) -> bool {
    let parts: Vec<&str> = name.splitn(4, '/').collect();
    match parts[..] {
        [package, of_it] | [package, "msg" | "srv" | "action", of_it] => is_package(package) && is_type(of_it),
        _ => false,
    }
}

/// Returns the key of a type's definition: `package/kind/Type`. `kind` (`msg`, `srv`, `action`) is used for names
/// without a kind, as in ROS 1.
pub fn definition_key(type_name: &str, kind: &str) -> String {
    match type_name.split_once('/') {
        Some((package, short)) if !short.contains('/') => format!("{package}/{kind}/{short}"),
        _ => type_name.to_owned(),
    }
}

/// Returns whether a text is an absolute graph name, such as `/camera/image_raw`.
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
    fn what_names_packages_types_and_topics() {
        assert!(is_package("image_proc") && !is_package("1x") && !is_package("a b") && !is_package("../x"));
        assert!(is_dependency("libstdc++6") && !is_dependency("-oDir=/") && !is_dependency("a;b"));
        assert!(is_full_type("sensor_msgs/Image") && !is_full_type("Image") && !is_full_type("a/b/C"));
        assert!(
            is_full_type("sensor_msgs/msg/Image")
                && is_full_type("a/srv/B")
                && is_full_type("a/action/B")
                && !is_full_type("a/msg/b/C")
                && !is_full_type("a/msg/")
        );
        assert_eq!(definition_key("a/B", "srv"), "a/srv/B");
        assert_eq!(definition_key("a/msg/B", "srv"), "a/msg/B");
        assert!(is_class("image_tools::ShowImage") && !is_class("a::") && !is_class("a b"));
        assert!(is_library("lib/libx.so") && !is_library("/lib/libx.so") && !is_library("lib/../x"));
        assert!(is_graph_name("/camera/image_raw") && is_graph_name("/_x") && !is_graph_name("image"));
        assert!(!is_graph_name("/") && !is_graph_name("/a//b") && !is_graph_name("/a/") && !is_graph_name("/a b"));
    }
}
