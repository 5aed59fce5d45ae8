//! Names of parameters of several levels, which ROS 1 separates by slashes, as in other names, and ROS 2 by dots.

/// Returns a name or path of ROS 2 as ROS 1 spells it: `gains/p` for `gains.p`.
pub fn spell_in_ros1(name: &str) -> String {
    name.replace('.', "/")
}

/// Returns a name or path of ROS 1 as ROS 2 spells it: `gains.p` for `gains/p`.
pub fn spell_in_ros2(name: &str) -> String {
    name.replace('/', ".")
}
