//! `make bench ONLY=servant`: cost of a servant beside the same node alone, libcontainer alone, and runc, crun and
//! podman. The argument `starts` runs that part alone. Needs root. The program runs itself as `bare HOW DIRECTORY`.

#![deny(unsafe_code)]

mod bare;
mod bundle;
mod cgroups;
mod cost;
mod crowd;
mod engine;
mod image;
mod native;
mod peers;
mod root;
mod starts;
mod upgrade;

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use bench_report::{BenchDaemon, BenchReport, write_install_space};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

use image::ServiceImage;

/// Capacity should not limit the measurement; servants are kept until they are stopped.
const CONFIG: &str = "[capacity]\ncpus = 4096.0\nmemory = \"4096G\"\n\
    [servant]\nreserve_cpus = 0.01\ngrace = \"1h\"\nanonymous_grace = \"0s\"\n";

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        [] => measure(true),
        ["starts"] => measure(false),
        ["bare", how, directory] => bare::run_process(how, Path::new(directory)),
        _ => bail!("it takes the word starts, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"),
    }
}

/// Starts a daemon and publishes the relay; `servants` is appended to the `[servant]` section of the configuration.
fn start_daemon(servants: &str) -> Result<BenchDaemon> {
    let daemon = BenchDaemon::start(&format!("{CONFIG}{servants}"))?;
    eprintln!("pushing a launch file for topic_tools/relay");
    let space = write_install_space(daemon.directory(), "relay_only", None)?;
    daemon.push(&[space.to_str().context("UTF-8")?, "--name", "relay", "--launch", "relay.launch"])?;
    Ok(daemon)
}

/// Measures how servants start and, with `crowd`, how many of them fit.
fn measure(crowd: bool) -> Result<()> {
    ensure!(nix::unistd::geteuid().is_root(), "servants are made by root: sudo make bench");
    // Before there are threads: mounts made from here on disappear with this process, however it ends.
    unshare(CloneFlags::CLONE_NEWNS).context("a mount namespace of our own")?;
    let private = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
    mount(None::<&str>, "/", None::<&str>, private, None::<&str>).context("making mounts private")?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let daemon = start_daemon("")?;
    let image = ServiceImage::inspect(&daemon, "relay")?;
    let mut report = BenchReport::new("servant");
    let without_warm_pool = start_daemon("warm_pool = 0\n")?;
    let warm_nodes = start_daemon("warm_nodes = 1\n")?;
    starts::measure(&mut report, &daemon, &without_warm_pool, &warm_nodes, &image, runtime.handle())?;
    drop(without_warm_pool);
    drop(warm_nodes);
    if crowd {
        crowd::measure(&mut report, &daemon, &image)?;
    }
    report.finish()?;
    Ok(())
}
