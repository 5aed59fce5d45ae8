//! Middlewares of nodes, by the names of their RMW implementations: which of them the bus speaks.

use std::collections::BTreeMap;

/// Environment variable that selects the implementation.
pub const VARIABLE: &str = "RMW_IMPLEMENTATION";
/// Implementations that speak RTPS, as the bus does, in order of preference.
pub const SUPPORTED: [&str; 3] = ["rmw_fastrtps_cpp", "rmw_cyclonedds_cpp", "rmw_fastrtps_dynamic_cpp"];
/// Maximum length of a name in a message, in characters.
const LONGEST: usize = 64;

/// An RMW implementation whose nodes the bus does not reach.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UnsupportedMiddleware {
    /// It speaks Zenoh.
    #[error("{0} speaks Zenoh, and Cloudroid speaks DDS only")]
    Zenoh(String),
    /// It is not known to speak RTPS.
    #[error("{0:?} is none of {known}", known = SUPPORTED.join(", "))]
    Unknown(String),
}

/// Returns whether a name is that of an implementation over Zenoh, such as `rmw_zenoh_cpp`.
pub fn is_zenoh(name: &str) -> bool {
    name.starts_with("rmw_zenoh")
}

/// Checks that the bus reaches nodes with a value of [`VARIABLE`]. An empty value stands for the default, which is Fast
/// DDS in all distributions.
///
/// # Errors
/// It does not.
pub fn check(value: &str) -> Result<(), UnsupportedMiddleware> {
    if value.is_empty() || SUPPORTED.contains(&value) {
        return Ok(());
    }
    let name = value.chars().filter(|c| !c.is_control()).take(LONGEST).collect();
    Err(if is_zenoh(value) { UnsupportedMiddleware::Zenoh(name) } else { UnsupportedMiddleware::Unknown(name) })
}

/// Checks an environment; see [`check`].
///
/// # Errors
/// It selects an implementation whose nodes the bus does not reach.
pub fn check_environment(environment: &BTreeMap<String, String>) -> Result<(), UnsupportedMiddleware> {
    environment.get(VARIABLE).map_or(Ok(()), |value| check(value))
}

/// Checks the environment and the command line of a process; the latter may set the variable, too (`env NAME=VALUE`).
///
/// # Errors
/// One of them selects an implementation whose nodes the bus does not reach.
pub fn check_process(environment: &BTreeMap<String, String>, argv: &[String]) -> Result<(), UnsupportedMiddleware> {
    check_environment(environment)?;
    argv.iter().filter_map(|word| word.strip_prefix(VARIABLE)?.strip_prefix('=')).try_for_each(check)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn implementations_of_dds_are_told_from_others() {
        for name in ["", "rmw_fastrtps_cpp", "rmw_cyclonedds_cpp", "rmw_fastrtps_dynamic_cpp"] {
            assert_eq!(check(name), Ok(()), "{name}");
        }
        let zenoh = check("rmw_zenoh_cpp").expect_err("it is not DDS").to_string();
        assert_eq!(zenoh, "rmw_zenoh_cpp speaks Zenoh, and Cloudroid speaks DDS only");
        let unknown = check("rmw_fastrtps").expect_err("a slip").to_string();
        assert!(unknown.starts_with("\"rmw_fastrtps\" is none of rmw_fastrtps_cpp, rmw_cyclonedds_cpp"), "{unknown}");
        let long = check(&format!("rmw_zenoh\n{}", "x".repeat(1 << 20))).expect_err("long").to_string();
        assert!(long.len() < 200 && !long.contains('\n'), "{long}");
    }

    #[test]
    fn a_command_line_may_select_it_too() {
        let words = |line: &str| line.split(' ').map(str::to_owned).collect::<Vec<_>>();
        let environment = |value: &str| BTreeMap::from([(VARIABLE.to_owned(), value.to_owned())]);
        let none = BTreeMap::new();
        for line in ["/x/talker", "env RMW_IMPLEMENTATION=rmw_cyclonedds_cpp /x/talker", "/x RMW_IMPLEMENTATION_X=y"] {
            check_process(&none, &words(line)).expect(line);
        }
        let line = words("env RMW_IMPLEMENTATION=rmw_zenoh_cpp /x/talker");
        check_process(&none, &line).expect_err("in front of the program");
        check_process(&environment("rmw_zenoh_cpp"), &words("/x/talker")).expect_err("in the environment");
        check_process(&environment("rmw_fastrtps_cpp"), &words("/x/talker")).expect("Fast DDS");
    }
}
