//! libcontainer alone: the same container made by a program with one thread that does nothing else. Namespaces, mounts,
//! seccomp filter, ids and root are those of a servant; what the engine does besides (cgroup and limits, shim, Master,
//! log, init, node) is not there.

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
use serde_json::{Value, json};
use servant::local::DEFAULT_UID_BASE;
use servant::rootfs::{Rootfs, Staged, make_skeleton};
use servant::spec::Spec;
use servant::uids;

/// What the container runs, and stays.
const PROGRAM: [&str; 2] = ["/bin/sleep", "60"];

/// Makes one in a process of its own, with its bundle in `place`; from the call of libcontainer to its return.
pub(crate) fn time(place: &Path, spec: &Spec) -> Result<Duration> {
    fs::create_dir_all(place)?;
    fs::write(place.join("spec.json"), serde_json::to_vec(spec)?)?;
    let output = Command::new(std::env::current_exe()?)
        .arg("bare")
        .arg(place)
        .output()?;
    let said = String::from_utf8_lossy(&output.stdout);
    let seconds: f64 = said.trim().parse().with_context(|| {
        format!(
            "the bare program: {}",
            String::from_utf8_lossy(&output.stderr)
        )
    })?;
    fs::remove_dir_all(place)?;
    Ok(Duration::from_secs_f64(seconds))
}

/// The process: prints the seconds.
pub(crate) fn run(place: &Path) -> Result<()> {
    let spec: Spec = serde_json::from_slice(&fs::read(place.join("spec.json"))?)?;
    let (first, _lock) = uids::take(DEFAULT_UID_BASE)?;
    let uid_range = (first, uids::RANGE);
    let skeleton = place.join("skeleton");
    make_skeleton(&skeleton, &spec.id, &spec.layers, &spec.mounts)?;
    let rootfs = Rootfs {
        layers: &spec.layers,
        skeleton: &skeleton,
        upper: None,
        uid_range,
    };
    // From here on libcontainer sees no cgroup of the host.
    let staged = rootfs.mount(&spec.mounts)?;
    let config = configuration(&spec, &staged, uid_range)?;
    fs::write(place.join("config.json"), serde_json::to_vec(&config)?)?;
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
    // Ours to reap, or already reaped by whoever adopted it.
    let _ = waitpid(pid, None);
    Ok(())
}

/// A servant's, with the network namespace that the engine makes itself.
pub(crate) fn configuration(spec: &Spec, staged: &Staged, uid_range: (u32, u32)) -> Result<Value> {
    let mut config = serde_json::to_value(servant::bundle::config(spec, staged, uid_range)?)?;
    config["process"]["args"] = json!(PROGRAM);
    config["process"]["env"] = json!(["PATH=/usr/bin:/bin", "HOME=/"]);
    let namespaces = config["linux"]["namespaces"]
        .as_array_mut()
        .context("namespaces")?;
    namespaces.push(json!({ "type": "network" }));
    Ok(config)
}
