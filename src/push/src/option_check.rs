//! Names and arguments in the options of a push that would otherwise have no effect, or break the build.

use api::PushOptions;
use catalogue::names::validate_service;
use package::names;

use super::OptionsError;

/// Maximum number of packages in an option, of nodes (as in an exported service), of underlays, and of arguments of
/// CMake; maximum length of an argument in bytes.
const MOST_PACKAGES: usize = 1000;
const MOST_NODES: usize = 256;
const MOST_UNDERLAYS: usize = 16;
const MOST_ARGUMENTS: usize = 64;
const LONGEST_ARGUMENT: usize = 1024;
/// Variables of CMake that the server sets.
const SERVERS_OWN: [&str; 2] = ["CMAKE_INSTALL_PREFIX", "CATKIN_DEVEL_PREFIX"];

/// Rejects keys of parameters and launch arguments that are no names (`rate:` of a `rate:=1` that was split at its
/// equals sign), and values of the build options that cannot be used.
pub(super) fn check_options(options: &PushOptions) -> Result<(), OptionsError> {
    check_keys("parameter", options.params.keys())?;
    check_keys("launch argument", options.args.keys())?;
    check_underlays(options)?;
    check_packages("--packages-up-to", &options.packages_up_to)?;
    check_packages("--packages-skip", &options.packages_skip)?;
    if options.nodes.len() > MOST_NODES {
        return Err(OptionsError::TooMany { option: "--node", most: MOST_NODES });
    }
    if options.cmake_args.len() > MOST_ARGUMENTS {
        return Err(OptionsError::TooMany { option: "--cmake-args", most: MOST_ARGUMENTS });
    }
    options.cmake_args.iter().try_for_each(|argument| check_argument(argument))
}

fn check_keys<'a>(what: &'static str, keys: impl Iterator<Item = &'a String>) -> Result<(), OptionsError> {
    let is_sign = |c: char| c == ':' || c == '=' || c.is_whitespace() || c.is_control();
    let mut keys = keys;
    match keys.find(|key| key.is_empty() || key.contains(is_sign)) {
        Some(name) => Err(OptionsError::ParameterName { what, name: name.clone() }),
        None => Ok(()),
    }
}

/// Rejects names that no underlay has, and options about a service for an underlay.
fn check_underlays(options: &PushOptions) -> Result<(), OptionsError> {
    if options.on.len() > MOST_UNDERLAYS {
        return Err(OptionsError::TooMany { option: "--on", most: MOST_UNDERLAYS });
    }
    let check = |option, name: &String| {
        validate_service(name).map_err(|problem| OptionsError::UnderlayName { option, problem })
    };
    options.on.iter().try_for_each(|name| check("--on", name))?;
    let Some(name) = &options.as_underlay else {
        return Ok(());
    };
    check("--as-underlay", name)?;
    let built = PushOptions {
        on: options.on.clone(),
        as_underlay: options.as_underlay.clone(),
        base: options.base.clone(),
        map: options.map.clone(),
        with: options.with.clone(),
        packages_up_to: options.packages_up_to.clone(),
        packages_skip: options.packages_skip.clone(),
        cmake_args: options.cmake_args.clone(),
        created: options.created,
        source: options.source.clone(),
        ..PushOptions::default()
    };
    if built == *options { Ok(()) } else { Err(OptionsError::AsUnderlay) }
}

fn check_packages(option: &'static str, packages: &[String]) -> Result<(), OptionsError> {
    if packages.len() > MOST_PACKAGES {
        return Err(OptionsError::TooMany { option, most: MOST_PACKAGES });
    }
    match packages.iter().find(|name| !names::is_package(name)) {
        Some(name) => Err(OptionsError::PackageName { option, name: name.clone() }),
        None => Ok(()),
    }
}

fn check_argument(argument: &str) -> Result<(), OptionsError> {
    let variable = argument.strip_prefix("-D").map(|rest| rest.split([':', '=']).next().unwrap_or_default());
    let problem = if argument.len() > LONGEST_ARGUMENT {
        "it is longer than 1024 bytes"
    } else if argument.contains(char::is_control) {
        "it contains control characters"
    } else if !argument.starts_with('-') {
        "it should begin with a hyphen, as -DNAME=VALUE does"
    } else if variable.is_some_and(|variable| SERVERS_OWN.contains(&variable)) {
        "the server sets this variable; leave it out"
    } else {
        return Ok(());
    };
    Err(OptionsError::CmakeArgument { argument: argument.chars().take(LONGEST_ARGUMENT).collect(), problem })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_that_have_no_effect_are_refused() {
        let with = |key: &str| PushOptions { params: [(key.to_owned(), 1.into())].into(), ..PushOptions::default() };
        for key in ["rate", "~rate", "_rate", "/lab/rate", "camera.width", "camera/width"] {
            check_options(&with(key)).expect(key);
        }
        for (key, meant) in [("rate:", "rate"), ("rate:=1", "rate"), ("rate =", "rate"), ("", "rate"), (":", "rate")] {
            let refused = check_options(&with(key)).expect_err(key).to_string();
            assert!(refused.starts_with("parameter ") && refused.ends_with(&format!("such as {meant:?}")), "{refused}");
        }
        let args = [("word:".to_owned(), String::new())].into();
        let refused = check_options(&PushOptions { args, ..PushOptions::default() }).expect_err("a sign").to_string();
        assert!(refused.starts_with("launch argument \"word:\" is no name"), "{refused}");
    }

    #[test]
    fn an_underlay_has_a_name_and_runs_nothing() {
        let underlay = PushOptions {
            as_underlay: Some("maps".to_owned()),
            on: vec!["lab".to_owned()],
            base: Some("b".to_owned()),
            cmake_args: vec!["-DA=1".to_owned()],
            ..PushOptions::default()
        };
        check_options(&underlay).expect("it is built");
        let more = [
            PushOptions { name: Some("maps".to_owned()), ..underlay.clone() },
            PushOptions { nodes: vec!["node".to_owned()], ..underlay.clone() },
            PushOptions { stateful: true, ..underlay.clone() },
        ];
        for options in more {
            let refused = check_options(&options).expect_err("it is about a service").to_string();
            assert!(refused.starts_with("--as-underlay takes only"), "{refused}");
        }
        let refused = check_options(&PushOptions { on: vec!["../x".to_owned()], ..PushOptions::default() });
        let refused = refused.expect_err("no name").to_string();
        assert!(refused.starts_with("--on: \"../x\" cannot name"), "{refused}");
    }

    #[test]
    fn what_cannot_be_built_is_refused() {
        let cmake = |argument: &str| {
            check_options(&PushOptions { cmake_args: vec![argument.to_owned()], ..PushOptions::default() })
        };
        for argument in ["-DA=1", "-DA:BOOL=ON", "-Wno-dev", "-DCMAKE_INSTALL_PREFIX_X=1"] {
            cmake(argument).expect(argument);
        }
        for argument in ["A=1", "", "/x", "-DCMAKE_INSTALL_PREFIX=/usr", "-DCATKIN_DEVEL_PREFIX:PATH=/x", "-DA=\n"] {
            let refused = cmake(argument).expect_err(argument).to_string();
            assert!(refused.starts_with("--cmake-args "), "{refused}");
        }
        let nodes = PushOptions { nodes: vec!["a".to_owned(); MOST_NODES + 1], ..PushOptions::default() };
        let refused = check_options(&nodes).expect_err("too many").to_string();
        assert_eq!(refused, "--node may be given at most 256 times");
        let skip = PushOptions { packages_skip: vec!["../x".to_owned()], ..PushOptions::default() };
        let refused = check_options(&skip).expect_err("no name").to_string();
        assert!(refused.starts_with("--packages-skip: \"../x\" is not a package name"), "{refused}");
    }
}
