//! The stories of burglary and of grants, on a machine with cgroup v2 only.

use std::net::TcpListener;
use std::path::Path;

use anyhow::Context;
use support::grants::{CdiSpecification, KIND, check_grants, create_models};
use support::{Verdict, burglary};

use crate::machine::daemon;

/// Volume and egress address, as configured in `tests/vm/home`.
const MODELS: &str = "/run/cloudroid-vm/models";
const OUTSIDE_ADDRESS: &str = "127.0.0.1:8098";

/// Returns lines of the `[allow]` section.
pub fn allow_config() -> String {
    format!("devices = [\"{KIND}=*\"]\nvolumes = [\"{MODELS}\"]\negress = [\"{OUTSIDE_ADDRESS}\"]")
}

pub fn no_attempt_to_break_out_succeeds() -> Verdict {
    burglary::no_attempt_to_break_out_succeeds(&daemon()?)
}

pub fn nothing_of_the_host_is_reached() -> Verdict {
    burglary::nothing_of_the_host_is_reached(&daemon()?)
}

pub fn neighbours_are_not_reached() -> Verdict {
    burglary::neighbours_are_not_reached(&daemon()?)
}

pub fn a_service_is_given_what_its_operator_allows() -> Verdict {
    let _specification = CdiSpecification::write(KIND)?;
    create_models(Path::new(MODELS))?;
    let listener = TcpListener::bind(OUTSIDE_ADDRESS)?;
    let mut robot = daemon()?.robot("granted?robot=given")?;
    check_grants(&mut robot, &listener)?;
    daemon()?.deployer().run(&["stop", "--service", "granted"])?.expect_success()?;
    let place = Path::new(MODELS).parent().context("a directory of its own")?;
    std::fs::remove_dir_all(place)?;
    Ok(())
}
