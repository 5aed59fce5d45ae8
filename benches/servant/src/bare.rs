//! libcontainer alone: the same container created by a single-threaded program, either with limits, or without any
//! cgroup, which is the lower bound. Shim, Master, log, init and node are not included.

use std::fs::{self, File};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use libcontainer::container::builder::ContainerBuilder;
use libcontainer::syscall::syscall::SyscallType;
use nix::sys::signal::{Signal, kill};
use nix::sys::wait::waitpid;
use nix::unistd::Pid;
use servant::container::ContainerSpec;
use servant::local::DEFAULT_UID_BASE;
use servant::rootfs::{Rootfs, make_skeleton};
use servant::uids;

use crate::bundle::{self, Bundle};

/// Measures with limits, in a separate process; from the call of libcontainer to its return.
pub(crate) fn time_limited(place: &Path, spec: &ContainerSpec) -> Result<Duration> {
    let bundle = Bundle::make(place, spec, |_| {})?;
    let took = time_in_process(place, "limited", spec);
    drop(bundle);
    fs::remove_dir_all(place)?;
    took
}

/// Measures without limits and without a visible cgroup hierarchy.
pub(crate) fn time_unlimited(place: &Path, spec: &ContainerSpec) -> Result<Duration> {
    fs::create_dir_all(place)?;
    let took = time_in_process(place, "unlimited", spec);
    fs::remove_dir_all(place)?;
    took
}

fn time_in_process(place: &Path, how: &str, spec: &ContainerSpec) -> Result<Duration> {
    fs::write(place.join("spec.json"), serde_json::to_vec(spec)?)?;
    let mut command = Command::new(std::env::current_exe()?);
    let output = command.args(["bare", how]).arg(place).output()?;
    let said = String::from_utf8_lossy(&output.stdout);
    let complaint = || format!("{how}: {}", String::from_utf8_lossy(&output.stderr));
    let seconds: f64 = said.trim().parse().with_context(complaint)?;
    Ok(Duration::from_secs_f64(seconds))
}

/// Runs in the child process; prints the seconds.
pub(crate) fn run_process(how: &str, place: &Path) -> Result<()> {
    let spec: ContainerSpec = serde_json::from_slice(&fs::read(place.join("spec.json"))?)?;
    if how == "unlimited" {
        stage_root(place, &spec)?;
    }
    let null = || File::options().read(true).write(true).open("/dev/null");
    let begun = Instant::now();
    let mut container = ContainerBuilder::new(spec.id, SyscallType::default())
        .with_root_path(place.join("state"))?
        .with_stdin(null()?)
        .with_stdout(null()?)
        .with_stderr(null()?)
        .validate_id()?
        .as_init(place)
        .with_systemd(false)
        .with_detach(true)
        .build()?;
    container.start()?;
    println!("{}", begun.elapsed().as_secs_f64());
    let pid = Pid::from_raw(container.pid().context("the container's pid")?.as_raw());
    kill(pid, Signal::SIGKILL)?;
    // Either our child, or already reaped by the process that adopted it.
    let _ = waitpid(pid, None);
    if how == "limited" {
        container.delete(true)?;
    }
    Ok(())
}

/// Prepares root and configuration as our own container creation does. From here on no cgroup of the host is visible.
fn stage_root(place: &Path, spec: &ContainerSpec) -> Result<()> {
    let uid_range = (DEFAULT_UID_BASE, uids::RANGE);
    let skeleton = place.join("skeleton");
    make_skeleton(&skeleton, &spec.id, &spec.layers, &spec.mounts, &spec.hosts)?;
    let rootfs = Rootfs { layers: &spec.layers, skeleton: &skeleton, upper: None, uid_range };
    let staged = rootfs.mount(&spec.mounts)?;
    let config = bundle::configuration(spec, &staged, uid_range)?;
    fs::write(place.join("config.json"), serde_json::to_vec(&config)?)?;
    Ok(())
}
