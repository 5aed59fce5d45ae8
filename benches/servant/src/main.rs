//! `make bench ONLY=servant`: what a servant costs, beside the same node started alone, libcontainer called from a bare
//! program, and the runtimes and the engine of others that are installed (runc, crun, podman). The word `starts` as an argument runs that part alone.
//! Needs root. The program calls itself for the bare container (`bare HOW DIRECTORY`).

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
mod robot;
mod root;
mod starts;
mod upgrade;

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use bench_report::Report;
use bench_servant::{Daemon, space};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

use image::Image;

/// Room is not what is measured; servants stay until they are ended.
const CONFIG: &str = "[capacity]\ncpus = 4096.0\nmemory = \"4096G\"\n\
    [servant]\nreserve_cpus = 0.01\ngrace = \"1h\"\nanonymous_grace = \"0s\"\n";

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match words
        .iter()
        .map(String::as_str)
        .collect::<Vec<_>>()
        .as_slice()
    {
        [] => measure(true),
        ["starts"] => measure(false),
        ["bare", how, directory] => bare::run(how, Path::new(directory)),
        _ => bail!("it takes the word starts, or nothing; CLOUDROID_BENCH_FULL=1 measures longer"),
    }
}

/// A daemon with the relay published; `servants` is added to the configuration's `[servant]`.
fn serving(servants: &str) -> Result<Daemon> {
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let daemon = Daemon::start(place, &format!("{CONFIG}{servants}"), &[])?;
    eprintln!("pushing a launch file for topic_tools/relay");
    let space = space(daemon.place(), "relay_only", None)?;
    daemon.push(&[
        space.to_str().context("UTF-8")?,
        "--name",
        "relay",
        "--launch",
        "relay.launch",
    ])?;
    Ok(daemon)
}

/// How servants start; and how many there can be, if there is time for a `crowd`.
fn measure(crowd: bool) -> Result<()> {
    ensure!(
        nix::unistd::geteuid().is_root(),
        "servants are made by root: sudo make bench"
    );
    // While there is one thread: whatever is mounted from here on is gone when we are, however we end.
    unshare(CloneFlags::CLONE_NEWNS).context("a mount namespace of our own")?;
    let private = MsFlags::MS_REC | MsFlags::MS_PRIVATE;
    mount(None::<&str>, "/", None::<&str>, private, None::<&str>)
        .context("making mounts private")?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    let daemon = serving("")?;
    let image = Image::of(&daemon, "relay")?;
    let mut report = Report::new("servant");
    let without_warm_pool = serving("warm_pool = 0\n")?;
    let warm_nodes = serving("warm_nodes = 1\n")?;
    starts::measure(
        &mut report,
        &daemon,
        &without_warm_pool,
        &warm_nodes,
        &image,
        runtime.handle(),
    )?;
    drop(without_warm_pool);
    drop(warm_nodes);
    if crowd {
        crowd::measure(&mut report, &daemon, &image)?;
    }
    report.finish()?;
    Ok(())
}
