//! The stories of burglary and of grants, on a machine with nothing but cgroup v2.

use std::net::TcpListener;
use std::path::Path;

use anyhow::Context;
use support::grants::{KIND, Specification, are_there_and_no_more, lay_out};
use support::{Verdict, burglary};

use crate::machine::daemon;

/// Where `tests/vm/home` says that the volume and the way out are.
const MODELS: &str = "/run/cloudroid-vm/models";
const OUT: &str = "127.0.0.1:8098";

/// Lines for `[allow]`.
pub fn allowed() -> String {
    format!("devices = [\"{KIND}=*\"]\nvolumes = [\"{MODELS}\"]\negress = [\"{OUT}\"]")
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
    let _specification = Specification::write(KIND)?;
    lay_out(Path::new(MODELS))?;
    let listener = TcpListener::bind(OUT)?;
    let mut robot = daemon()?.robot("granted?robot=given")?;
    are_there_and_no_more(&mut robot, &listener)?;
    daemon()?
        .deployer()
        .types(&["stop", "--service", "granted"])?
        .succeeded()?;
    let place = Path::new(MODELS)
        .parent()
        .context("a directory of its own")?;
    std::fs::remove_dir_all(place)?;
    Ok(())
}
