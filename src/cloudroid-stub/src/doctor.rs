//! `cloudroid-stub doctor`: checks everything that a stub needs, and shows the commands that fix problems.

mod check;
mod middleware;
mod overlay;
mod ros_version;
mod server;

use std::path::Path;
use std::process::ExitCode;

use foreign::terminal;
use ros::bus::RosVersion;

use crate::arguments::{DoctorPart, StubDoctorArgs};
use check::CheckVerdict;

/// Runs the checks and prints them; fails if any is bad.
pub fn examine(asked: &StubDoctorArgs) -> anyhow::Result<ExitCode> {
    let stub = overlay::ExaminedStub::from_args(asked)?;
    let config = crate::config::load(&stub.share, std::env::vars())?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let variable = |name: &str| std::env::var(name).ok();
    let is_asked = |part| asked.only.is_none_or(|only| only == part);
    let mut checks = Vec::new();
    if is_asked(DoctorPart::Ros) {
        let wanted = stub.revision().ros();
        checks.push(ros_version::check(wanted, &config.service, &variable, Path::new(ros_version::UPSTREAM_SPACES)));
        if wanted == RosVersion::Two {
            checks.push(middleware::check(&variable));
        }
    }
    if is_asked(DoctorPart::Server) {
        checks.extend(runtime.block_on(server::checks(&config, &stub)));
    }
    if asked.only.is_none() {
        checks.extend(runtime.block_on(overlay::checks(&stub, &config, &variable)));
    }
    for check in &checks {
        println!("{}", terminal::escape(&check.render(), false));
    }
    let bad = checks.iter().any(|check| check.verdict == CheckVerdict::Bad);
    Ok(if bad { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

#[cfg(test)]
mod tests {
    use super::check::Check;

    #[test]
    fn a_check_names_the_command_that_mends_it() {
        let check = Check::bad("token", "the server wants one", "sh install.sh --token TOKEN");
        assert_eq!(
            check.render(),
            "FAIL  token      the server wants one\n                 fix it:  sh install.sh --token TOKEN"
        );
        assert_eq!(Check::good("clock", "in step").render(), "ok    clock      in step");
    }
}
